//! A block with a valley of 90 degrees in its top. Its modes are those of a rod that stands on its
//! fixed bottom.

use pliant_modal::{FlexibilitySite, ModalModel};

use super::rod::{DENSITY, Rod};

/// Height of the valley above the ground, m.
pub const VALLEY: f64 = 0.03;
/// Half of the width and of the length of the block, m.
const HALF: f64 = 0.05;
/// Distance of the vertices of the faces, m.
const SPACING: f64 = 0.005;

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
    // A punch of the radius of a site on a half-space.
    let dent = 0.91 / (2.0 * young * 0.5 * SPACING) * 0.5;
    let flexibility = std::array::from_fn(|i| std::array::from_fn(|j| if i == j { dent } else { 0.0 }));
    let free = positions.iter().enumerate().filter(|(_, p)| p[1] > 0.0);
    let sites =
        free.map(|(vertex, _)| FlexibilitySite { vertex: vertex as u32, radius: SPACING, flexibility });
    let sites = sites.collect();
    let rod = Rod {
        name: "valley",
        along: 1,
        length: height,
        mass,
        young,
        each: 3,
        zeta: 0.3,
        inertia: mass * HALF * HALF / 3.0,
    };
    rod.model(positions, triangles, sites)
}
