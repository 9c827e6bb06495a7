//! A bar of 1 x 0.2 x 0.2 m and 40 kg along x, clamped at x = 0, with four assumed modes in closed
//! form.

use pliant_modal::{BakeInfo, Damping, Element, ModalModel, ModelParts, SurfaceMesh};
use std::f64::consts::TAU;

pub const LENGTH: f64 = 1.0;
pub const SIDE: f64 = 0.2;
pub const MASS: f64 = 40.0;
const CELLS: [usize; 3] = [20, 4, 4];

/// Frequencies of bending along y, bending along z, twist and stretch, Hz.
pub const FREQUENCIES: [f64; 4] = [1.0, 1.2, 5.0, 8.0];

/// Returns the vertex in the middle of the end face: (1, 0, 0).
pub fn tip() -> u32 {
    let model = bar();
    let positions = model.surface().positions();
    positions.iter().position(|p| *p == [1.0, 0.0, 0.0]).unwrap() as u32
}

pub fn bar() -> ModalModel {
    bar_with(false, 1.0)
}

/// Returns a body with the same elastic shapes and without anchors.
pub fn free_bar() -> ModalModel {
    bar_with(true, 1.0)
}

/// Returns the bar with frequencies that are `factor` times as high.
pub fn stiff_bar(factor: f64) -> ModalModel {
    bar_with(false, factor)
}

/// Displacement and rotation of a mode at a point, for the mode's scale.
type Shape = fn([f64; 3], f64) -> ([f64; 3], [f64; 3]);

fn bar_with(free: bool, factor: f64) -> ModalModel {
    let surface = surface();
    // The modes are mass-normalized: the integral of rho |phi|^2 over the bar is 1, with plane
    // sections and without rotational inertia.
    let bend = (5.0 / MASS).sqrt();
    let stretch = (3.0 / MASS).sqrt();
    let twist = (18.0 / (MASS * SIDE * SIDE)).sqrt();
    let shapes: [Shape; 4] = [
        |[x, y, _], s| ([-2.0 * s * x * y, s * x * x, 0.0], [0.0, 0.0, 2.0 * s * x]),
        |[x, _, z], s| ([-2.0 * s * x * z, 0.0, s * x * x], [0.0, -2.0 * s * x, 0.0]),
        |[x, y, z], s| ([0.0, -s * x * z, s * x * y], [s * x, -0.5 * s * y, -0.5 * s * z]),
        |[x, _, _], s| ([s * x, 0.0, 0.0], [0.0; 3]),
    ];
    let (mut displacement, mut rotation) = (Vec::new(), Vec::new());
    for (shape, scale) in shapes.iter().zip([bend, bend, twist, stretch]) {
        for p in surface.positions() {
            let (u, w) = shape(p.map(f64::from), scale);
            displacement.extend(u.map(|x| x as f32));
            rotation.extend(w.map(|x| x as f32));
        }
    }
    let omega: Vec<f64> = FREQUENCIES.iter().map(|f| TAU * f * factor).collect();
    let damping = omega.iter().map(|w| Damping::Ratio(0.2).coefficient(*w)).collect();
    // The integral of rho phi is a third of the tip value for bending and a half for stretch.
    let participation = [
        [0.0, bend * MASS / 3.0, 0.0],
        [0.0, 0.0, bend * MASS / 3.0],
        [0.0; 3],
        [stretch * MASS / 2.0, 0.0, 0.0],
    ];
    let long = MASS / 12.0 * (LENGTH * LENGTH + SIDE * SIDE);
    ModalModel::from_parts(ModelParts {
        info: BakeInfo {
            name: "bar in closed form".into(),
            tets: 0,
            nodes: 0,
            element: Element::Tet10,
            young: 1e6,
            poisson: 0.3,
            density: 1000.0,
            damping: Damping::Ratio(0.2),
            anchors: if free { Vec::new() } else { vec!["x<0.001".into()] },
            residual_max: 0.0,
            orthonormality_max: 0.0,
        },
        surface,
        omega,
        damping,
        displacement,
        rotation,
        participation: if free { vec![[0.0; 3]; 4] } else { participation.to_vec() },
        free,
        mass: MASS,
        center_of_mass: [LENGTH / 2.0, 0.0, 0.0],
        inertia: [[MASS / 6.0 * SIDE * SIDE, 0.0, 0.0], [0.0, long, 0.0], [0.0, 0.0, long]],
        sites: Vec::new(),
        reduced: None,
    })
    .unwrap()
}

/// Returns the six faces of the bar as a welded grid.
fn surface() -> SurfaceMesh {
    let mut positions: Vec<[f32; 3]> = Vec::new();
    let mut index = std::collections::HashMap::new();
    let mut vertex = |i: [usize; 3]| {
        *index.entry(i).or_insert_with(|| {
            let at = |k: usize, length: f64| i[k] as f64 / CELLS[k] as f64 * length;
            positions.push([
                at(0, LENGTH) as f32,
                (at(1, SIDE) - SIDE / 2.0) as f32,
                (at(2, SIDE) - SIDE / 2.0) as f32,
            ]);
            positions.len() as u32 - 1
        })
    };
    let mut triangles = Vec::new();
    for axis in 0..3 {
        let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
        for end in [0, CELLS[axis]] {
            for i in 0..CELLS[b] {
                for j in 0..CELLS[c] {
                    let mut corner = |db: usize, dc: usize| {
                        let mut at = [0; 3];
                        (at[axis], at[b], at[c]) = (end, i + db, j + dc);
                        vertex(at)
                    };
                    let [p, q, r, s] = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
                    let (q, s) = if end == 0 { (s, q) } else { (q, s) };
                    triangles.extend([[p, q, r], [p, r, s]]);
                }
            }
        }
    }
    SurfaceMesh::new(positions, triangles, None, Vec::new()).unwrap()
}
