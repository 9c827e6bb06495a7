//! The recurrences of all modes, column by column, so that loops over the modes vectorise.

use pliant_modal::{Coefficients, Integrator, ModalModel, StepError};

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
    flow: Option<FlowTable>,
}

/// What relaxation adds; see [`pliant_modal::Flow`].
#[derive(Debug, Clone)]
struct FlowTable {
    onto: [Vec<f64>; 3],
    free: [Vec<f64>; 4],
    carry: Vec<f64>,
    response: Vec<f64>,
}

impl Table {
    pub(crate) fn new(
        model: &ModalModel,
        setup: &BodySetup,
        modes: usize,
        h: f64,
    ) -> Result<Self, StreamError> {
        let (mut made, mut flows) = (Vec::with_capacity(modes), Vec::new());
        let (omega, damping) = setup.modes(model, modes);
        for (omega, c) in omega.into_iter().zip(damping) {
            let failed = |e: StepError| StreamError::Model(e.to_string());
            match setup.relaxation {
                None => made.push(Coefficients::new(setup.integrator, omega, c, h).map_err(failed)?),
                Some(r) => {
                    let (one, flow) =
                        Coefficients::relaxing(setup.integrator, omega, c, r, h).map_err(failed)?;
                    made.push(one);
                    flows.push(flow);
                }
            }
        }
        let flow = setup.relaxation.map(|_| FlowTable {
            onto: std::array::from_fn(|row| flows.iter().map(|f| f.onto[row]).collect()),
            free: std::array::from_fn(|column| flows.iter().map(|f| f.free[column]).collect()),
            carry: flows.iter().map(|f| f.carry).collect(),
            response: flows.iter().map(|f| f.response).collect(),
        });
        Ok(Self {
            free: std::array::from_fn(|row| {
                std::array::from_fn(|column| made.iter().map(|c| c.free[row][column]).collect())
            }),
            response: std::array::from_fn(|row| made.iter().map(|c| c.response[row]).collect()),
            memory: setup.integrator != Integrator::Exact,
            flow,
        })
    }

    /// A state of this size, at rest.
    pub(crate) fn rest(&self) -> ModalState {
        match self.flow {
            Some(_) => ModalState::zero_relaxing(self.modes()),
            None => ModalState::zero(self.modes()),
        }
    }

    /// Number of modes.
    pub(crate) fn modes(&self) -> usize {
        self.response[0].len()
    }

    /// The step without forces, into q, v, a and z; `old`: modal forces of the last one.
    pub(crate) fn step(&self, state: &ModalState, old: &[f64], out: &mut [Vec<f64>; 4]) {
        let n = self.modes();
        let (q, v, a, old) = (&state.q[..n], &state.v[..n], &state.a[..n], &old[..n]);
        for (columns, out) in self.free.iter().zip(out.iter_mut()) {
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
        let Some(flow) = self.flow.as_ref().filter(|_| state.z.len() == n) else { return };
        let [out_q, out_v, out_a, out_z] = out;
        out_z.resize(n, 0.0);
        for (out, onto) in [out_q, out_v, out_a].into_iter().zip(&flow.onto) {
            for ((out, onto), z) in out.iter_mut().zip(onto).zip(&state.z) {
                *out += onto * z;
            }
        }
        let [by_q, by_v, by_a, by_f] = flow.free.each_ref().map(|c| &c[..n]);
        let (carry, z, out) = (&flow.carry[..n], &state.z[..n], &mut out_z[..n]);
        for k in 0..n {
            let free = (by_q[k] * q[k] + by_v[k] * v[k]) + (by_a[k] * a[k] + by_f[k] * old[k]);
            out[k] = free + carry[k] * z[k];
        }
    }

    /// Adds what a modal force does to the step without forces.
    pub(crate) fn press(&self, force: &[f64], out: &mut [Vec<f64>; 4]) {
        let flow = self.flow.as_ref().map(|f| &f.response);
        for (response, out) in self.response.iter().chain(flow).zip(out) {
            for ((out, r), f) in out.iter_mut().zip(response).zip(force) {
                *out += r * f;
            }
        }
    }
}
