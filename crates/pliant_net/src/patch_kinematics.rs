//! Patch kinematics: the position of a held patch on a shape that another app steps.

use bevy::math::DVec3;
use pliant_modal::{HeldPatch, ModalModel, Patch};

use crate::view::Held;

/// The mean position of a patch's vertices as a function of the modal coordinates.
#[derive(Debug, Clone)]
pub(crate) struct PatchPoint(HeldPatch);

impl PatchPoint {
    /// Returns `None` for a patch that is not on the model.
    pub(crate) fn new(model: &ModalModel, vertex: u32, radius: f64) -> Option<Self> {
        let patch = Patch::around(model.surface(), vertex, radius).ok()?;
        HeldPatch::new(model, &patch, model.mode_count()).ok().map(Self)
    }

    /// Returns the patch's mean position in body axes, m. `held` are the own shapes of held patches
    /// with their coordinates, which bodies that are warped do not have.
    pub(crate) fn at(&self, q: &[f64], warped: bool, held: Held<'_>) -> DVec3 {
        // The session has radii in single precision.
        let own = held.and_then(|(shapes, s)| {
            let (vertex, radius) = self.0.center_and_radius();
            let mean = |radius: f64| shapes.mean(vertex, radius, s);
            mean(radius).or_else(|| mean(f64::from(radius as f32)))
        });
        let place: [f64; 3] = (self.0.rest() + self.0.displacement(q, warped)).into();
        DVec3::from(place) + DVec3::from(own.unwrap_or_default())
    }
}
