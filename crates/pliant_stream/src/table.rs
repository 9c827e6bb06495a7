//! The recurrences of all modes, column by column, so that loops over the modes vectorise.

use pliant_modal::{Coefficients, Integrator, ModalModel};

use crate::StreamError;
use crate::state::ModalState;
use crate::stepper::BodySetup;

/// What one step makes of every mode.
#[derive(Debug, Clone)]
pub(crate) struct Table {
    /// `free[row][column]`: rows q, v, a; columns q, v, a, force of the last step.
    free: [[Vec<f64>; 4]; 3],
    /// What a unit modal force adds to q, v, a.
    pub(crate) response: [Vec<f64>; 3],
    /// The step looks at the old acceleration and force too.
    memory: bool,
}

impl Table {
    pub(crate) fn new(
        model: &ModalModel,
        setup: &BodySetup,
        modes: usize,
        h: f64,
    ) -> Result<Self, StreamError> {
        let made = model.omega()[..modes]
            .iter()
            .zip(model.damping())
            .map(|(&omega, &c)| Coefficients::new(setup.integrator, omega, c * setup.damping_scale, h))
            .collect::<Result<Vec<_>, _>>()
            .map_err(|e| StreamError::Model(e.to_string()))?;
        Ok(Self {
            free: std::array::from_fn(|row| {
                std::array::from_fn(|column| made.iter().map(|c| c.free[row][column]).collect())
            }),
            response: std::array::from_fn(|row| made.iter().map(|c| c.response[row]).collect()),
            memory: setup.integrator != Integrator::Exact,
        })
    }

    /// Number of modes.
    pub(crate) fn modes(&self) -> usize {
        self.response[0].len()
    }

    /// The step without forces; `old`: modal forces of the last one.
    pub(crate) fn step(&self, state: &ModalState, old: &[f64], out: &mut [Vec<f64>; 3]) {
        let n = self.modes();
        let (q, v, a, old) = (&state.q[..n], &state.v[..n], &state.a[..n], &old[..n]);
        for (columns, out) in self.free.iter().zip(out) {
            let [by_q, by_v, by_a, by_f] = columns.each_ref().map(|c| &c[..n]);
            let out = &mut out[..n];
            if self.memory {
                for k in 0..n {
                    out[k] = (by_q[k] * q[k] + by_v[k] * v[k]) + (by_a[k] * a[k] + by_f[k] * old[k]);
                }
            } else {
                for k in 0..n {
                    out[k] = by_q[k] * q[k] + by_v[k] * v[k];
                }
            }
        }
    }

    /// Adds what a modal force does to the step without forces.
    pub(crate) fn press(&self, force: &[f64], out: &mut [Vec<f64>; 3]) {
        for (response, out) in self.response.iter().zip(out) {
            for ((out, r), f) in out.iter_mut().zip(response).zip(force) {
                *out += r * f;
            }
        }
    }
}
