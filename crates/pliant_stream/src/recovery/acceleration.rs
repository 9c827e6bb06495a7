//! Policies that integrate a stream of accelerations: [`super::Policy::None`] and the paper's
//! policy.

use pliant_modal::{ContactState, Relaxation};

use super::{HISTORY, History, Predict, Recovery};
use crate::newmark::{Newmark, ViscoelasticFilter};
use crate::prediction::{HandState, Ring};
use crate::replica;
use crate::state::{State, Tick};

/// Integrates the received accelerations and predicts missing ones. When a missing acceleration
/// arrives late, the policy removes the prediction's error exactly.
#[derive(Debug)]
pub struct AccelerationDriven {
    newmark: Newmark,
    /// Filter that computes the viscoelastic state from the coordinates, if the body relaxes.
    viscoelastic: Option<ViscoelasticFilter>,
    predict: Predict,
    compensate: bool,
    tick: Tick,
    first: Tick,
    state: State,
    /// The accelerations that each tick was stepped with.
    used: Ring<Vec<f64>>,
    /// Per mode: the tick at which the policy last took over the absolute state. Errors made up to
    /// that tick no longer count.
    anchored: Vec<Tick>,
    next: Vec<f64>,
}

impl AccelerationDriven {
    /// Starts at rest at tick 0. With `compensate` false, the policy ignores late accelerations.
    pub fn new(newmark: Newmark, predict: Predict, compensate: bool, modes: usize) -> Self {
        Self {
            newmark,
            viscoelastic: None,
            predict,
            compensate,
            tick: 0,
            first: 0,
            state: State::zero(modes, false),
            used: Ring::new(HISTORY),
            anchored: vec![0; modes],
            next: vec![0.0; modes],
        }
    }

    /// Adds the viscoelastic state of a body that relaxes. The state is filtered from the
    /// coordinates.
    pub fn relaxing(mut self, relaxation: Option<Relaxation>) -> Self {
        self.viscoelastic = relaxation.map(|r| ViscoelasticFilter::new(r, &self.newmark, HISTORY));
        if self.viscoelastic.is_some() {
            self.state = State::zero(self.state.modes(), true);
        }
        self
    }

    fn used(&self, tick: Tick) -> Option<&Vec<f64>> {
        self.used.get(tick).filter(|_| (self.first..=self.tick).contains(&tick))
    }

    /// Fills `next` with the predicted accelerations for `tick`, from the accelerations that the
    /// two ticks before were stepped with.
    fn predict(&mut self, tick: Tick) {
        let last = tick.checked_sub(1).and_then(|t| self.used(t)).cloned();
        let before = tick.checked_sub(2).and_then(|t| self.used(t)).cloned();
        match (self.predict, last, before) {
            (Predict::Linear, Some(a1), Some(a0)) => {
                for ((n, a1), a0) in self.next.iter_mut().zip(&a1).zip(&a0) {
                    *n = 2.0 * a1 - a0;
                }
            }
            (Predict::Hold | Predict::Linear, Some(a1), _) => self.next.copy_from_slice(&a1),
            _ => self.next.fill(0.0),
        }
    }
}

impl Recovery for AccelerationDriven {
    fn restart(&mut self, tick: Tick, state: &State, _: &[f64], _: &[HandState], _: &ContactState) {
        replica::fill(&mut self.state, [&state.q, &state.v, &state.a, &state.z]);
        self.tick = tick;
        self.first = tick;
        self.anchored.fill(tick);
        self.used.place(tick).0.clone_from(&self.state.a);
    }

    fn advance(&mut self, tick: Tick, history: &History) {
        match history.known(tick).filter(|d| d.accelerations.len() == self.state.modes()) {
            Some(data) => self.next.copy_from_slice(&data.accelerations),
            None => self.predict(tick),
        }
        if let Some(filter) = &self.viscoelastic {
            filter.begin(&mut self.state);
        }
        self.newmark.advance(&mut self.state, &self.next);
        if let Some(filter) = &self.viscoelastic {
            filter.finish(&mut self.state);
        }
        self.tick = tick;
        self.used.place(tick).0.clone_from(&self.next);
    }

    fn correct(&mut self, from: Tick, history: &History) -> bool {
        if !self.compensate {
            return false;
        }
        let Some(data) = history.known(from).filter(|d| d.accelerations.len() == self.state.modes()) else {
            return false;
        };
        if !(self.first + 1..=self.tick).contains(&from) {
            return false;
        }
        let Some(used) = self.used.get_mut(from) else { return false };
        let (to_q, to_v) = self.newmark.response(self.tick - from);
        let to_z = self.viscoelastic.as_ref().map_or(0.0, |filter| filter.response(self.tick - from));
        for (k, (used, received)) in used.iter_mut().zip(&data.accelerations).enumerate() {
            if from <= self.anchored[k] {
                continue;
            }
            let da = received - *used;
            self.state.q[k] += to_q * da;
            self.state.v[k] += to_v * da;
            if let Some(z) = self.state.z.get_mut(k) {
                *z += to_z * da;
            }
            if from == self.tick {
                self.state.a[k] += da;
            }
            *used = *received;
        }
        true
    }

    fn refresh(&mut self, tick: Tick, history: &History) {
        if tick != self.tick {
            // An absolute value of an earlier tick cannot be carried forward through a stream of
            // accelerations that has gaps.
            return;
        }
        let Some(data) = history.known(tick) else { return };
        let modes = self.anchored.len();
        for e in data.slice.iter().filter(|e| e.mode < modes) {
            self.state.q[e.mode] = e.q;
            self.state.v[e.mode] = e.v;
            if let Some(z) = self.state.z.get_mut(e.mode) {
                *z = e.z;
            }
            self.anchored[e.mode] = tick;
        }
    }

    fn confirmed(&self) -> &State {
        &self.state
    }

    fn driven_by_reactions(&self) -> bool {
        false
    }
}
