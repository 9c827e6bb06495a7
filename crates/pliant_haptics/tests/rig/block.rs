//! A block whose modes are known in closed form: the axial modes of a rod, the same on all three
//! axes. The rod is fixed at x = 0 and free at x = L: `phi_k = sqrt(2 / m) sin(k_k x)`,
//! `k_k = (2k - 1) pi / (2L)`, `omega_k = k_k sqrt(E / rho)`.

use pliant_modal::{BakeInfo, Damping, Element, FlexibilitySite, ModalModel, ModelParts, SurfaceMesh};

pub const LENGTH: f64 = 0.1;
const AREA: f64 = 0.0016;
const DENSITY: f64 = 1000.0;
const STATIONS: usize = 11;

pub fn tip() -> u32 {
    (STATIONS as u32 - 1) * 4
}

/// Creates a block with `modes` modes in total, a third of them along each axis.
pub fn block(young: f64, modes: usize) -> ModalModel {
    let zeta = 0.05;
    let side = AREA.sqrt() as f32;
    let mut positions = Vec::new();
    for i in 0..STATIONS {
        let x = (LENGTH * i as f64 / (STATIONS - 1) as f64) as f32;
        for (y, z) in [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)] {
            positions.push([x, y * side, z * side]);
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
    let each = modes / 3;
    let wave = |k: usize| (2 * k + 1) as f64 * std::f64::consts::FRAC_PI_2 / LENGTH;
    let (mut omega, mut displacement, mut participation) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..each {
        for axis in 0..3 {
            omega.push(wave(k) * (young / DENSITY).sqrt());
            for p in &positions {
                let mut row = [0.0f32; 3];
                row[axis] = ((2.0 / mass).sqrt() * (wave(k) * f64::from(p[0])).sin()) as f32;
                displacement.extend(row);
            }
            let mut part = [0.0; 3];
            part[axis] = (2.0 / mass).sqrt() * DENSITY * AREA / wave(k);
            participation.push(part);
        }
    }
    let kept: f64 = (0..each).map(|k| 2.0 / mass / (wave(k) * (young / DENSITY).sqrt()).powi(2)).sum();
    let residual = (LENGTH / (young * AREA) - kept).max(0.0);
    let flexibility = [[residual, 0.0, 0.0], [0.0, residual, 0.0], [0.0, 0.0, residual]];
    let anchored = positions.iter().map(|p| p[0] == 0.0).collect();
    let inertia = mass * LENGTH * LENGTH / 12.0;
    ModalModel::from_parts(ModelParts {
        info: BakeInfo {
            name: "block".into(),
            tets: 0,
            nodes: 0,
            element: Element::Tet10,
            young,
            poisson: 0.3,
            density: DENSITY,
            damping: Damping::Ratio(zeta),
            anchors: vec!["x<=0".into()],
            residual_max: 0.0,
            orthonormality_max: 0.0,
        },
        surface: SurfaceMesh::new(positions, triangles, None, anchored).unwrap(),
        damping: omega.iter().map(|w| 2.0 * zeta * w).collect(),
        rotation: vec![0.0; displacement.len()],
        displacement,
        omega,
        participation,
        free: false,
        mass,
        center_of_mass: [LENGTH / 2.0, 0.0, 0.0],
        inertia: [[inertia, 0.0, 0.0], [0.0, inertia, 0.0], [0.0, 0.0, inertia]],
        sites: vec![FlexibilitySite { vertex: tip(), radius: 0.01, flexibility }],
        reduced: None,
    })
    .unwrap()
}
