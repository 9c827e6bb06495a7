//! Where a held patch is on a shape that somebody else steps.

use bevy::math::DVec3;
use pliant_body::Grab;
use pliant_modal::{GrabConfig, ModalModel, ModelError, Patch, warp};

/// The mean of a patch over its vertices, as a function of the modal coordinates.
#[derive(Debug, Clone)]
pub(crate) struct PatchPoint {
    rest: DVec3,
    displacement: Vec<DVec3>,
    rotation: Vec<DVec3>,
}

impl PatchPoint {
    pub(crate) fn new(model: &ModalModel, vertex: u32, radius: f64) -> Result<Self, ModelError> {
        let surface = model.surface();
        let patch = Patch::around(surface, vertex, radius)?;
        let modes = model.mode_count();
        let mut point = Self {
            rest: DVec3::ZERO,
            displacement: vec![DVec3::ZERO; modes],
            rotation: vec![DVec3::ZERO; modes],
        };
        for &(vertex, weight) in patch.entries() {
            if let Some(&position) = surface.positions().get(vertex as usize) {
                point.rest += weight * DVec3::from(position.map(f64::from));
            }
            for mode in 0..modes {
                for axis in 0..3 {
                    point.displacement[mode][axis] +=
                        weight * f64::from(model.displacement_row(vertex, axis, mode));
                    point.rotation[mode][axis] += weight * f64::from(model.rotation_row(vertex, axis, mode));
                }
            }
        }
        Ok(point)
    }

    /// The mean position, in body axes, m. With warp `u = R~(w) d` of the patch's mean displacement and rotation.
    pub(crate) fn at(&self, q: &[f64], warped: bool) -> DVec3 {
        let sum = |columns: &[DVec3]| {
            columns.iter().zip(q).fold(DVec3::ZERO, |sum, (column, &q)| sum + *column * q)
        };
        let displacement = sum(&self.displacement);
        if !warped {
            return self.rest + displacement;
        }
        let bent = warp(sum(&self.rotation).into(), displacement.into());
        self.rest + DVec3::from(bent)
    }
}

/// A hand's own spring and damper.
pub(crate) fn hold_of(grab: &Grab) -> GrabConfig {
    GrabConfig { stiffness: grab.stiffness, relaxation: grab.relaxation }
}

/// Whether a grab still holds so. By bits: what is not a number is told, and refused, once.
pub(crate) fn holds_so(grab: &Grab, hold: &GrabConfig) -> bool {
    let bits = |hold: &GrabConfig| (hold.stiffness.map(f64::to_bits), hold.relaxation.to_bits());
    bits(&hold_of(grab)) == bits(hold)
}
