//! The rod of `rod` with a material for large strains.

use pliant_modal::{Material, ModalModel, ReducedElasticity};

use crate::rod::{AREA, LENGTH, rod};

/// A rod with a material: cubature points at the stations, each with its share of the volume.
pub fn nonlinear_rod(young: f64, modes: usize, zeta: f64) -> ModalModel {
    let mut parts = rod(young, modes, zeta, false).parts().clone();
    let points = 16;
    let mut gradients = Vec::new();
    for point in 0..points {
        let x = (f64::from(point) + 0.5) / f64::from(points) * LENGTH;
        for entry in 0..9 {
            for k in 0..modes {
                // Only the stretch along the rod.
                let wave = (2 * k + 1) as f64 * std::f64::consts::FRAC_PI_2 / LENGTH;
                let slope = (2.0 / parts.mass).sqrt() * wave * (wave * x).cos();
                gradients.push(if entry == 0 { slope as f32 } else { 0.0 });
            }
        }
    }
    let weights = vec![AREA * LENGTH / f64::from(points); points as usize];
    // Without sides that give way, the material is a spring along the rod.
    parts.info.poisson = 0.0;
    let material = Material::StVenantKirchhoff;
    parts.reduced = Some(ReducedElasticity { material, weights, gradients, mesh: None });
    ModalModel::from_parts(parts).unwrap()
}
