//! Patch kinematics: the position of a held patch on a shape that another app steps.

use bevy::math::DVec3;
use pliant_modal::{ModalModel, ModelError, Patch, warp};

use crate::view::Held;

/// The mean position of a patch's vertices as a function of the modal coordinates.
#[derive(Debug, Clone)]
pub(crate) struct PatchPoint {
    vertex: u32,
    radius: f64,
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
            vertex,
            radius,
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

    /// Returns the patch's mean position in body axes, m. With `warped`, the displacement is
    /// `u = R~(w) d`, where `d` and `w` are the patch's mean displacement and rotation. `held` are
    /// the own shapes of held patches with their coordinates.
    pub(crate) fn at(&self, q: &[f64], warped: bool, held: Held<'_>) -> DVec3 {
        let sum = |columns: &[DVec3]| {
            columns.iter().zip(q).fold(DVec3::ZERO, |sum, (column, &q)| sum + *column * q)
        };
        // The session has radii in single precision.
        let own = held.and_then(|(shapes, s)| {
            let radius = |radius: f64| shapes.mean(self.vertex, radius, s);
            radius(self.radius).or_else(|| radius(f64::from(self.radius as f32)))
        });
        let displacement = sum(&self.displacement) + DVec3::from(own.unwrap_or_default());
        if !warped {
            return self.rest + displacement;
        }
        let bent = warp(sum(&self.rotation).into(), displacement.into());
        self.rest + DVec3::from(bent)
    }
}
