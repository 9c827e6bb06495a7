//! A block with a valley of 90 degrees in its top. Its modes are those of a rod that stands on its
//! fixed bottom, as for [`super::block`].

use std::f64::consts::FRAC_PI_2;

use pliant_modal::{BakeInfo, Damping, Element, FlexibilitySite, ModalModel, ModelParts, SurfaceMesh};

/// Height of the valley above the ground, m.
pub const VALLEY: f64 = 0.03;
/// Half of the width and of the length of the block, m.
const HALF: f64 = 0.05;
/// Distance of the vertices of the faces, m.
const SPACING: f64 = 0.005;
const DENSITY: f64 = 1000.0;

/// Outlines of the block from one end of the valley to the other, beginning in the middle of the
/// bottom.
fn outlines() -> Vec<Vec<[f32; 3]>> {
    let parts = (HALF / SPACING).round() as i32;
    let mut outline = vec![[0.0, 0.0], [HALF, 0.0]];
    outline.extend(
        (-parts..=parts).rev().map(|k| [SPACING * f64::from(k), VALLEY + SPACING * f64::from(k.abs())]),
    );
    outline.push([-HALF, 0.0]);
    let slice =
        |k: i32| outline.iter().map(|[x, y]| [*x, *y, SPACING * f64::from(k)].map(|x| x as f32)).collect();
    (-parts..=parts).map(slice).collect()
}

/// Creates the block with three modes along each axis. What they leave out is the dent of a site.
pub fn valley(young: f64) -> ModalModel {
    let slices = outlines();
    let count = slices[0].len() as u32;
    let last = slices.len() as u32 - 1;
    let positions: Vec<[f32; 3]> = slices.concat();
    let mut triangles = Vec::new();
    for slice in 0..last {
        for k in 0..count {
            let (a, b) = (count * slice + k, count * slice + (k + 1) % count);
            triangles.extend([[a, b, b + count], [a, b + count, a + count]]);
        }
    }
    for k in 1..count - 1 {
        let end = count * last;
        triangles.extend([[0, k + 1, k], [end, end + k, end + k + 1]]);
    }
    let height = VALLEY + 0.5 * HALF;
    let mass = DENSITY * height * (2.0 * HALF).powi(2);
    let wave = |k: usize| (2 * k + 1) as f64 * FRAC_PI_2 / height;
    let size = (2.0 / mass).sqrt();
    let (mut omega, mut displacement, mut participation) = (Vec::new(), Vec::new(), Vec::new());
    for (k, axis) in (0..3).flat_map(|k| (0..3).map(move |axis| (k, axis))) {
        omega.push(wave(k) * (young / DENSITY).sqrt());
        for p in &positions {
            let mut row = [0.0f32; 3];
            row[axis] = (size * (wave(k) * f64::from(p[1]).min(height)).sin()) as f32;
            displacement.extend(row);
        }
        let mut part = [0.0; 3];
        part[axis] = size * mass / (wave(k) * height);
        participation.push(part);
    }
    let zeta = 0.3;
    // A punch of the radius of a site on a half-space.
    let dent = 0.91 / (2.0 * young * 0.5 * SPACING) * 0.5;
    let flexibility = std::array::from_fn(|i| std::array::from_fn(|j| if i == j { dent } else { 0.0 }));
    let free = positions.iter().enumerate().filter(|(_, p)| p[1] > 0.0);
    let sites =
        free.map(|(vertex, _)| FlexibilitySite { vertex: vertex as u32, radius: SPACING, flexibility });
    let sites = sites.collect();
    let anchored = positions.iter().map(|p| p[1] == 0.0).collect();
    let inertia = mass * HALF * HALF / 3.0;
    ModalModel::from_parts(ModelParts {
        info: BakeInfo {
            name: "valley".into(),
            tets: 0,
            nodes: 0,
            element: Element::Tet10,
            young,
            poisson: 0.3,
            density: DENSITY,
            damping: Damping::Ratio(zeta),
            anchors: vec!["y<=0".into()],
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
        center_of_mass: [0.0, 0.5 * height, 0.0],
        inertia: [[inertia, 0.0, 0.0], [0.0, inertia, 0.0], [0.0, 0.0, inertia]],
        sites,
        reduced: None,
    })
    .unwrap()
}
