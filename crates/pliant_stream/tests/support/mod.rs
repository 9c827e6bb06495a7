//! A body whose modes are known in closed form, so that the tests need no bake.
#![allow(dead_code, reason = "each test uses its part")]

pub mod direct;

use std::sync::Arc;

use pliant_modal::{BakeInfo, Damping, Element, ModalModel, ModelParts, SurfaceMesh};

/// A square bar of length 1 m, fixed at x = 0, with `modes` modes from four families: shear in y
/// and z, stretch in x, and twist about x. Their shape along the bar is sin((2k - 1) pi x / 2). The
/// mass is 2 kg and the damping ratio is `zeta`.
pub fn bar(modes: usize, zeta: f64) -> Arc<ModalModel> {
    bar_that(16, modes, zeta, false)
}

/// The same bar with `cells` cells along it, and so with `4 (cells + 1)` vertices.
pub fn fine_bar(cells: usize, modes: usize) -> Arc<ModalModel> {
    bar_that(cells, modes, 0.05, false)
}

/// The same bar without the fixed end. It has a rigid pose, and the same mode shapes relative to
/// it.
pub fn loose_bar(modes: usize, zeta: f64) -> Arc<ModalModel> {
    bar_that(16, modes, zeta, true)
}

fn bar_that(nx: usize, modes: usize, zeta: f64, free: bool) -> Arc<ModalModel> {
    let half = 0.08;
    let mut positions = Vec::new();
    for i in 0..=nx {
        for [y, z] in [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0_f64]] {
            positions.push([i as f32 / nx as f32, (y * half) as f32, (z * half) as f32]);
        }
    }
    let mut triangles = Vec::new();
    for i in 0..nx as u32 {
        for k in 0..4 {
            let (a, b) = (4 * i + k, 4 * i + (k + 1) % 4);
            triangles.extend([[a, b + 4, b], [a, a + 4, b + 4]]);
        }
    }
    let end = 4 * nx as u32;
    triangles.extend([[0, 1, 2], [0, 2, 3], [end, end + 2, end + 1], [end, end + 3, end + 2]]);
    let anchored = positions.iter().map(|p| p[0] == 0.0 && !free).collect();
    let surface = SurfaceMesh::new(positions.clone(), triangles, None, anchored).unwrap();

    // Tuples of (family, k, frequency in Hz). The families are shear y, shear z, stretch and twist.
    let mut all: Vec<(usize, usize, f64)> = Vec::new();
    for k in 1..=modes {
        for (family, first) in [(0, 0.9), (1, 1.1), (2, 7.0), (3, 4.0)] {
            all.push((family, k, first * (2 * k - 1) as f64));
        }
    }
    all.sort_by(|a, b| a.2.total_cmp(&b.2));
    all.truncate(modes);
    let mass = 2.0_f64;
    let amplitude = (2.0 / mass).sqrt();
    // For twist, r^2 = 2/3 half^2 averaged over the square section.
    let twist = amplitude / (2.0 / 3.0 * half * half).sqrt();
    let (mut displacement, mut rotation) = (Vec::new(), Vec::new());
    for &(family, k, _) in &all {
        let w = (2 * k - 1) as f64 * std::f64::consts::FRAC_PI_2;
        for p in &positions {
            let [x, y, z] = p.map(f64::from);
            let (s, c) = ((w * x).sin(), w * (w * x).cos());
            let (u, r) = match family {
                0 => ([0.0, amplitude * s, 0.0], [0.0, 0.0, 0.5 * amplitude * c]),
                1 => ([0.0, 0.0, amplitude * s], [0.0, -0.5 * amplitude * c, 0.0]),
                2 => ([amplitude * s, 0.0, 0.0], [0.0; 3]),
                _ => (
                    [0.0, -twist * s * z, twist * s * y],
                    [twist * s, -0.5 * twist * c * y, -0.5 * twist * c * z],
                ),
            };
            displacement.extend(u.map(|x| x as f32));
            rotation.extend(r.map(|x| x as f32));
        }
    }
    let omega: Vec<f64> = all.iter().map(|m| std::f64::consts::TAU * m.2).collect();
    let damping = Damping::Ratio(zeta);
    let parts = ModelParts {
        info: BakeInfo {
            name: "bar".into(),
            tets: 1,
            nodes: positions.len(),
            element: Element::Tet4,
            young: 1e5,
            poisson: 0.3,
            density: 1000.0,
            damping,
            anchors: if free { Vec::new() } else { vec!["x<0.01".into()] },
            residual_max: 0.0,
            orthonormality_max: 0.0,
        },
        surface,
        damping: omega.iter().map(|w| damping.coefficient(*w)).collect(),
        participation: vec![[0.0; 3]; omega.len()],
        omega,
        displacement,
        rotation,
        free,
        mass,
        center_of_mass: [0.5, 0.0, 0.0],
        inertia: [[0.01, 0.0, 0.0], [0.0, 0.17, 0.0], [0.0, 0.0, 0.17]],
        sites: Vec::new(),
        reduced: None,
    };
    Arc::new(ModalModel::from_parts(parts).unwrap())
}
