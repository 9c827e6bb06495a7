//! Quantization steps per mode, chosen so that all modes have the same rounding error on the
//! surface.
//!
//! A mode's *visible amplitude* `s` is the largest displacement that a unit of its coordinate
//! causes on the surface. With a step of `unit / s` in the coordinate, rounding moves no point of
//! the surface by more than half the `unit` (m), for any mode. The error is spread evenly, and a
//! mode gets more bits the larger its visible amplitude. Values that lead to displacements are
//! treated the same way: velocity (`unit omega / s`), load (`unit omega^2 / s`), viscoelastic state
//! (`unit / s`) and acceleration (`unit / (s beta h^2)`). Host and guest both have the model, so
//! the steps are not sent.

use pliant_modal::ModalModel;

use crate::newmark::Newmark;

/// Most vertices that are examined for the visible amplitude, evenly chosen.
const VERTICES: usize = 4096;
/// Smallest visible amplitude that counts, as a share of the largest one. Modes below it get this
/// amplitude.
const FAINT: f64 = 1e-4;
/// Lowest angular frequency for the steps of velocities and loads, rad/s.
const SLOW: f64 = 0.3;

/// The value in each mode's coordinates that corresponds to one meter of visible displacement.
#[derive(Debug, Clone, PartialEq)]
pub struct Quanta {
    /// Coordinates and viscoelastic states, `1 / s`.
    pub(crate) place: Vec<f64>,
    /// Velocities.
    pub(crate) speed: Vec<f64>,
    /// Modal forces.
    pub(crate) load: Vec<f64>,
    /// Accelerations of a stream that the receiver integrates.
    pub(crate) acceleration: Vec<f64>,
}

impl Quanta {
    /// Steps for the first `modes` modes of a model. The receiver integrates accelerations with
    /// `newmark`.
    pub fn new(model: &ModalModel, modes: usize, newmark: &Newmark) -> Self {
        Self::stiffened(model, 1.0, modes, newmark)
    }

    /// Steps for a body whose stiffness is `scale` times the baked one. Its velocities and forces
    /// are larger for the same displacement.
    pub(crate) fn stiffened(model: &ModalModel, scale: f64, modes: usize, newmark: &Newmark) -> Self {
        Self::of_visible(model, &Self::visible_of(model, modes), scale, newmark)
    }

    /// The visible amplitudes of the first `modes` modes of a model, m per unit of the coordinate.
    ///
    /// This examines every mode at up to 4,096 vertices, so callers that need the result often keep
    /// it.
    pub(crate) fn visible_of(model: &ModalModel, modes: usize) -> Vec<f64> {
        let modes = modes.min(model.mode_count());
        let vertices = model.surface().positions().len();
        let every = vertices.div_ceil(VERTICES).max(1);
        let visible = |mode: usize| {
            let size = |v: usize| -> f64 {
                (0..3).map(|axis| f64::from(model.displacement_row(v as u32, axis, mode)).powi(2)).sum()
            };
            (0..vertices).step_by(every).map(size).fold(0.0, f64::max).sqrt()
        };
        (0..modes).map(visible).collect()
    }

    /// Steps from visible amplitudes, one per mode in `all`.
    pub(crate) fn of_visible(model: &ModalModel, all: &[f64], scale: f64, newmark: &Newmark) -> Self {
        let most = all.iter().copied().fold(f64::MIN_POSITIVE.sqrt(), f64::max);
        let place: Vec<f64> = all.iter().map(|s| 1.0 / s.max(FAINT * most)).collect();
        let by_omega = |power: i32| {
            let omega = model.omega().iter().map(|omega| omega * scale.sqrt());
            place.iter().zip(omega).map(|(p, omega)| p * omega.max(SLOW).powi(power)).collect()
        };
        let gain = newmark.beta.max(1.0 / 12.0) * newmark.h * newmark.h;
        Self {
            speed: by_omega(1),
            load: by_omega(2),
            acceleration: place.iter().map(|p| p / gain).collect(),
            place,
        }
    }

    /// Equal steps for all modes: a step is 1 in each coordinate.
    pub fn even(modes: usize) -> Self {
        let one = || vec![1.0; modes];
        Self { place: one(), speed: one(), load: one(), acceleration: one() }
    }

    /// Number of modes.
    pub fn modes(&self) -> usize {
        self.place.len()
    }

    /// Largest displacement of the surface by any one mode of a state, m. A velocity counts as the
    /// displacement that it leads to.
    pub(crate) fn visible(&self, q: &[f64], v: &[f64]) -> f64 {
        let shape = q.iter().zip(&self.place).fold(0.0_f64, |m, (q, p)| m.max(q.abs() / p));
        v.iter().zip(&self.speed).fold(shape, |m, (v, p)| m.max(v.abs() / p))
    }
}
