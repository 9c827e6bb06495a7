//! Newmark's method as a linear filter of the acceleration stream.
//!
//! ```text
//! v_{n+1} = v_n + h ((1 - gamma) a_n + gamma a_{n+1})
//! q_{n+1} = q_n + h v_n + h^2 ((1/2 - beta) a_n + beta a_{n+1})
//! ```
//!
//! The filter is linear. An acceleration that was wrong by `da` at tick `i` therefore leaves, at
//! tick `j`, exactly
//!
//! ```text
//! j = i:  dv = gamma h da,   dq = beta h^2 da
//! j > i:  dv = h da,         dq = (j - i + gamma - 1/2) h^2 da
//! ```
//!
//! These are equations (8) and (9) of Tang et al. 2013 for beta = 1/4, gamma = 1/2, stated here for
//! any pair. Proof: a wrong `a_i` enters `v_i` with weight `gamma h` and `v_{i+1}` with
//! `(1 - gamma) h` more. The sum is `h`, and later steps do not change it. `q_i` gets `beta h^2`.
//! `q_{i+1}` gets `h v_i` = `gamma h^2` and `(1/2 - beta) h^2` more, which sums to
//! `(gamma + 1/2) h^2`. Every later step adds `h dv = h^2`.

use pliant_modal::Relaxation;

use crate::StreamError;
use crate::state::State;

/// A member of Newmark's family with its step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Newmark {
    /// Length of a step, s.
    pub h: f64,
    /// Weight of the new acceleration in the displacement. The default of
    /// [`crate::HostSessionConfig`] is 4/9.
    pub beta: f64,
    /// Weight of the new acceleration in the velocity. The default of [`crate::HostSessionConfig`]
    /// is 5/6.
    pub gamma: f64,
}

impl Newmark {
    /// Average acceleration (beta = 1/4, gamma = 1/2), the method of the paper.
    pub fn average(h: f64) -> Self {
        Self { h, beta: 0.25, gamma: 0.5 }
    }

    /// Checks the ranges: `h` 10 us to 1 s, `beta` and `gamma` 0 to 1.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a value outside its range.
    pub fn check(&self) -> Result<(), StreamError> {
        let fail = |what, found: f64, expected| {
            Err(StreamError::Config { what, found: found.to_string(), expected })
        };
        if !(1e-5..=1.0).contains(&self.h) {
            return fail("step", self.h, "1e-5 to 1 s");
        }
        if !(0.0..=1.0).contains(&self.beta) {
            return fail("beta", self.beta, "0..=1");
        }
        if !(0.0..=1.0).contains(&self.gamma) {
            return fail("gamma", self.gamma, "0..=1");
        }
        Ok(())
    }

    /// Steps one coordinate and returns the new `(q, v)`.
    pub fn step(&self, q: f64, v: f64, a_old: f64, a_new: f64) -> (f64, f64) {
        let h = self.h;
        (
            q + h * v + h * h * ((0.5 - self.beta) * a_old + self.beta * a_new),
            v + h * ((1.0 - self.gamma) * a_old + self.gamma * a_new),
        )
    }

    /// Steps all coordinates of a state to the new accelerations.
    pub fn advance(&self, state: &mut State, a_new: &[f64]) {
        for (((q, v), a), &a_new) in state.q.iter_mut().zip(&mut state.v).zip(&mut state.a).zip(a_new) {
            (*q, *v) = self.step(*q, *v, *a, a_new);
            *a = a_new;
        }
    }

    /// Returns the displacement and velocity that an acceleration wrong by 1 leaves `age` = j - i
    /// ticks later, by the equations of the module.
    pub fn response(&self, age: u64) -> (f64, f64) {
        let h = self.h;
        if age == 0 {
            (self.beta * h * h, self.gamma * h)
        } else {
            ((age as f64 + self.gamma - 0.5) * h * h, h)
        }
    }
}

/// Viscoelastic state of a body as a filter of its coordinates
/// ([`Relaxation::linear_weights`]).
///
/// A stream of accelerations gives the coordinates, and the viscoelastic state follows from the
/// coordinates. An error of the viscoelastic state decays by its own weight in each step.
#[derive(Debug, Clone, PartialEq)]
pub struct ViscoelasticFilter {
    weights: [f64; 3],
    responses: Vec<f64>,
}

impl ViscoelasticFilter {
    /// Creates the filter for a material. `ages` says how many ticks back an acceleration may be
    /// corrected.
    pub fn new(relaxation: Relaxation, newmark: &Newmark, ages: usize) -> Self {
        let mut made = Self { weights: relaxation.linear_weights(newmark.h), responses: Vec::new() };
        let (mut z, mut last) = (0.0, 0.0);
        for age in 0..ages as u64 {
            let (q, _) = newmark.response(age);
            z = made.step(z, last, q);
            last = q;
            made.responses.push(z);
        }
        made
    }

    /// Returns the viscoelastic state after a step in which the coordinate moved from `q0` to `q1`.
    pub fn step(&self, z0: f64, q0: f64, q1: f64) -> f64 {
        let [keep, by_old, by_new] = self.weights;
        keep * z0 + by_old * q0 + by_new * q1
    }

    /// Does the first half of a step of all viscoelastic states, from the old coordinates. Call it
    /// before the coordinates are stepped.
    pub(crate) fn begin(&self, state: &mut State) {
        for (z, q) in state.z.iter_mut().zip(&state.q) {
            *z = self.step(*z, *q, 0.0);
        }
    }

    /// Does the second half of the step, from the new coordinates.
    pub(crate) fn finish(&self, state: &mut State) {
        for (z, q) in state.z.iter_mut().zip(&state.q) {
            *z += self.weights[2] * q;
        }
    }

    /// Returns the change that an acceleration wrong by 1 leaves in the viscoelastic state `age`
    /// ticks later, or 0 beyond the ages given to [`ViscoelasticFilter::new`].
    pub fn response(&self, age: u64) -> f64 {
        usize::try_from(age).ok().and_then(|age| self.responses.get(age)).copied().unwrap_or(0.0)
    }
}
