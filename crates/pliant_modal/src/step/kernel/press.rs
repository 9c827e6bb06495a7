//! Forces and impulses on single vertices of the surface.

use nalgebra::Vector3;

use super::{Kernel, Six, State};
use crate::{ModalModel, StepError, error::finite, step::patch::tangent};

/// Accessor for basis rows, with the arguments vertex, axis and mode.
type BasisEntry = fn(&ModalModel, u32, usize, usize) -> f32;

/// What a force on a vertex does to the modes and the frame.
pub(crate) struct Pressed<'a> {
    model: &'a ModalModel,
    vertex: u32,
    by_displacement: Vector3<f64>,
    by_rotation: Option<Vector3<f64>>,
    /// Arm of the vertex from the center of mass, m, world axes.
    pub arm: Vector3<f64>,
}

impl Pressed<'_> {
    /// The force on one mode, kg^1/2 m/s^2.
    pub fn modal_force(&self, mode: usize) -> f64 {
        let along = |of: BasisEntry| row(self.model, of, self.vertex, mode);
        let force = along(ModalModel::displacement_row).dot(&self.by_displacement);
        self.by_rotation.map_or(force, |by| force + along(ModalModel::rotation_row).dot(&by))
    }
}

fn row(model: &ModalModel, of: BasisEntry, vertex: u32, mode: usize) -> Vector3<f64> {
    Vector3::from_fn(|axis, _| f64::from(of(model, vertex, axis, mode)))
}

impl Kernel {
    /// Finds what a force (N, world axes) on a surface vertex does, by the derivative of the
    /// vertex's position.
    pub(crate) fn press(
        &self,
        state: &State,
        vertex: u32,
        force: &Vector3<f64>,
    ) -> Result<Pressed<'_>, StepError> {
        let model = &*self.model;
        let surface = model.surface().positions();
        let count = surface.len();
        let Some(rest) = surface.get(vertex as usize) else {
            return Err(StepError::Vertex { vertex, count });
        };
        let sum = |of: BasisEntry| -> Vector3<f64> {
            state.q.iter().enumerate().map(|(mode, q)| *q * row(model, of, vertex, mode)).sum()
        };
        let warp = self.warps();
        let d = sum(ModalModel::displacement_row);
        let w = if warp { sum(ModalModel::rotation_row) } else { Vector3::zeros() };
        let (moved, tangent) = tangent(&Six::new(d.x, d.y, d.z, w.x, w.y, w.z), warp);
        let rotation = state.frame.rotation();
        let six = tangent.tr_mul(&(rotation.inverse() * force));
        let at = Vector3::from(rest.map(f64::from)) + moved;
        Ok(Pressed {
            model,
            vertex,
            by_displacement: six.fixed_rows::<3>(0).into(),
            by_rotation: warp.then(|| six.fixed_rows::<3>(3).into()),
            arm: rotation * (at - Vector3::from(model.center_of_mass())),
        })
    }

    /// Applies `impulse` (N s, world axes) to a surface vertex of a state. Velocities change at
    /// once. `spare` is memory for a copy of the state, which may be of any size.
    ///
    /// # Errors
    /// Returns an error if the impulse is not finite, if it brings a velocity or an acceleration
    /// above 1e100, or if the vertex is not on the surface. The state then stays as it was.
    pub fn apply_impulse(
        &self,
        state: &mut State,
        spare: &mut State,
        vertex: u32,
        impulse: [f64; 3],
    ) -> Result<(), StepError> {
        finite("impulse", &impulse)?;
        let impulse = Vector3::from(impulse);
        let pressed = self.press(state, vertex, &impulse)?;
        spare.clone_from(state);
        for (mode, (v, a)) in state.v.iter_mut().zip(&mut state.a).enumerate() {
            let gained = pressed.modal_force(mode);
            *v += gained;
            // The acceleration belongs to the state, so it includes the damping force of the new
            // velocity.
            *a -= self.damping().get(mode).copied().unwrap_or_default() * gained;
        }
        if self.model.is_free() {
            state.frame.add_momentum(&self.model, impulse, pressed.arm.cross(&impulse));
        }
        // An overflow must be rejected here. A later step that fails would only restore the state
        // before that step, which is this state.
        if state.is_moderate() {
            return Ok(());
        }
        state.clone_from(spare);
        let expected = "one that leaves velocities and accelerations below 1e100";
        Err(StepError::Input { what: "impulse", expected, got: impulse.norm() })
    }
}
