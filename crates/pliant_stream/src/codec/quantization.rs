//! How coarse each mode may be: steps that look alike on the surface.
//!
//! A mode's *visible amplitude* `s` is the largest displacement that a unit of its coordinate makes on the surface. With a
//! step of `unit / s` in the coordinate, rounding moves no point of the surface by more than half the `unit` (m), whichever
//! the mode: the error is spread evenly, and a mode gets as many bits as it is large to the eye. The same is done for what
//! leads to displacements: velocity (`unit omega / s`), load (`unit omega^2 / s`), flow (`unit / s`), acceleration
//! (`unit / (s beta h^2)`). Both sides have the model, so the steps do not cross.

use pliant_modal::ModalModel;

use crate::newmark::Newmark;

/// Vertices looked at for the visible amplitude, evenly chosen.
const VERTICES: usize = 4096;
/// Modes that are less visible than this share of the most visible one count as that visible.
const FAINT: f64 = 1e-4;
/// Slowest rate that velocities are counted by, rad/s.
const SLOW: f64 = 0.3;

/// What a step of one metre of visible displacement is in each mode's numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct Quanta {
    /// Coordinates and flows, `1 / s`.
    pub(crate) place: Vec<f64>,
    /// Velocities.
    pub(crate) speed: Vec<f64>,
    /// Modal forces.
    pub(crate) load: Vec<f64>,
    /// Accelerations of a stream that is integrated.
    pub(crate) acceleration: Vec<f64>,
}

impl Quanta {
    /// For the first `modes` of a model; accelerations are integrated by `newmark`.
    pub fn new(model: &ModalModel, modes: usize, newmark: &Newmark) -> Self {
        Self::stiffened(model, 1.0, modes, newmark)
    }

    /// For a body whose stiffness is `scale` times the baked one: its velocities and forces are as much larger for one displacement.
    pub(crate) fn stiffened(model: &ModalModel, scale: f64, modes: usize, newmark: &Newmark) -> Self {
        Self::of_visible(model, &Self::visible_of(model, modes), scale, newmark)
    }

    /// The visible amplitudes of the first `modes` of a model, m for a unit of the coordinate. Costs a look at every mode at up to 4,096
    /// vertices, so it is kept where it is needed often.
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

    /// From the visible amplitudes of as many modes as are wanted.
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

    /// All modes alike: a step is 1 in each of their numbers.
    pub fn even(modes: usize) -> Self {
        let one = || vec![1.0; modes];
        Self { place: one(), speed: one(), load: one(), acceleration: one() }
    }

    /// Number of modes.
    pub fn modes(&self) -> usize {
        self.place.len()
    }

    /// How far the most visible mode of a state moves the surface, its velocity counted as where it leads, m.
    pub(crate) fn visible(&self, q: &[f64], v: &[f64]) -> f64 {
        let shape = q.iter().zip(&self.place).fold(0.0_f64, |m, (q, p)| m.max(q.abs() / p));
        v.iter().zip(&self.speed).fold(shape, |m, (v, p)| m.max(v.abs() / p))
    }
}
