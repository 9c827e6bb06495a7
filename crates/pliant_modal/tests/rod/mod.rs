//! A rod with axial modes in closed form: fixed at x = 0, free at x = L, cross-section A.
//!
//! The modes are `phi_k(x) = sqrt(2 / (rho A L)) sin(k_k x)` with `k_k = (2k - 1) pi / (2L)` and
//! `omega_k = k_k sqrt(E / rho)`. The tip compliance is `L / (E A)`.

use pliant_modal::{BakeInfo, Damping, Element, FlexibilitySite, ModalModel, ModelParts, SurfaceMesh};

pub const LENGTH: f64 = 1.0;
pub const AREA: f64 = 0.01;
pub const DENSITY: f64 = 1000.0;

/// Number of stations along the rod. Each station has the four corners of the square cross-section.
const STATIONS: usize = 21;

pub fn tip() -> u32 {
    (STATIONS as u32 - 1) * 4
}

pub fn rod(young: f64, modes: usize, zeta: f64, free: bool) -> ModalModel {
    let side = AREA.sqrt();
    let mut positions = Vec::new();
    for i in 0..STATIONS {
        let x = (LENGTH * i as f64 / (STATIONS - 1) as f64) as f32;
        for (y, z) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
            positions.push([x, (y - 0.5) * side as f32, (z - 0.5) * side as f32]);
        }
    }
    let mut triangles = Vec::new();
    for i in 0..STATIONS as u32 - 1 {
        for k in 0..4 {
            let (a, b) = (4 * i + k, 4 * i + (k + 1) % 4);
            triangles.push([a, b, b + 4]);
            triangles.push([a, b + 4, a + 4]);
        }
    }
    let mass = DENSITY * AREA * LENGTH;
    let wave = |k: usize| {
        let half_waves = if free { 2 * (k + 1) } else { 2 * k + 1 };
        half_waves as f64 * std::f64::consts::FRAC_PI_2 / LENGTH
    };
    let omega: Vec<f64> = (0..modes).map(|k| wave(k) * (young / DENSITY).sqrt()).collect();
    let mut displacement = Vec::new();
    for k in 0..modes {
        for p in &positions {
            let x = wave(k) * f64::from(p[0]);
            let shape = if free { x.cos() } else { x.sin() };
            displacement.extend([((2.0 / mass).sqrt() * shape) as f32, 0.0, 0.0]);
        }
    }
    let kept: f64 = (0..modes).map(|k| 2.0 / mass / omega[k].powi(2)).sum();
    let residual = (LENGTH / (young * AREA) - kept).max(0.0);
    let participation = (0..modes)
        .map(|k| [if free { 0.0 } else { (2.0 / mass).sqrt() * DENSITY * AREA / wave(k) }, 0.0, 0.0])
        .collect();
    let sites = vec![FlexibilitySite {
        vertex: tip(),
        radius: 0.01,
        flexibility: [[residual, 0.0, 0.0], [0.0; 3], [0.0; 3]],
    }];
    let anchored = positions.iter().map(|p| !free && p[0] == 0.0).collect();
    ModalModel::from_parts(ModelParts {
        info: BakeInfo {
            name: "rod".into(),
            tets: 0,
            nodes: 0,
            element: Element::Tet10,
            young,
            poisson: 0.3,
            density: DENSITY,
            damping: Damping::Ratio(zeta),
            anchors: if free { vec![] } else { vec!["x<=0".into()] },
            residual_max: 0.0,
            orthonormality_max: 0.0,
        },
        surface: SurfaceMesh::new(positions, triangles, None, anchored).unwrap(),
        damping: omega.iter().map(|w| 2.0 * zeta * w).collect(),
        rotation: vec![0.0; displacement.len()],
        displacement,
        omega,
        participation,
        free,
        mass,
        center_of_mass: [LENGTH / 2.0, 0.0, 0.0],
        inertia: [
            [mass * AREA / 6.0, 0.0, 0.0],
            [0.0, mass * (LENGTH * LENGTH + AREA) / 12.0, 0.0],
            [0.0, 0.0, mass * (LENGTH * LENGTH + AREA) / 12.0],
        ],
        sites,
        reduced: None,
    })
    .unwrap()
}
