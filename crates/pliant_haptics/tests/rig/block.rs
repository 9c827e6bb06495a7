//! A block whose modes are those of a rod along x.

use pliant_modal::{FlexibilitySite, ModalModel};

use super::rod::{DENSITY, Rod};

pub const LENGTH: f64 = 0.1;
const AREA: f64 = 0.0016;
const STATIONS: usize = 11;

pub fn tip() -> u32 {
    (STATIONS as u32 - 1) * 4
}

/// Creates a block with `modes` modes in total, a third of them along each axis.
pub fn block(young: f64, modes: usize) -> ModalModel {
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
    let rod = Rod {
        name: "block",
        along: 0,
        length: LENGTH,
        mass,
        young,
        each: modes / 3,
        zeta: 0.05,
        inertia: mass * LENGTH * LENGTH / 12.0,
    };
    let residual = (LENGTH / (young * AREA) - rod.compliance()).max(0.0);
    let flexibility = [[residual, 0.0, 0.0], [0.0, residual, 0.0], [0.0, 0.0, residual]];
    rod.model(positions, triangles, vec![FlexibilitySite { vertex: tip(), radius: 0.01, flexibility }])
}
