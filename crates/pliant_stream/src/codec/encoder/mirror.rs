//! Steps of the mirror with what the receivers are sent.

use nalgebra::Vector3;
use pliant_modal::Frame;

use super::Encoder;
use crate::newmark::Newmark;
use crate::prediction::HandState;
use crate::state::TickState;
use crate::wire::{AccelerationCoding, Accelerations, FrameGrab, Payload};

/// The encoder starts to send loads when their static effect first exceeds this share of the shape.
const LOAD_FLOOR: f64 = 2e-2;
/// Time constant of the estimate of the unexplained load, ticks.
const LOAD_TICKS: f64 = 8.0;
/// Ticks between updates of that estimate. Each update costs an extra step of the model.
const LOAD_EVERY: u64 = 4;
/// Acceleration streams use steps finer by this factor, because prediction multiplies their
/// rounding error and the receiver integrates it twice.
const FINER: f64 = 64.0;
/// Decay of the remembered deformation per tick.
const VISIBLE_KEEP: f64 = 0.98;

impl Encoder {
    /// Displacement of the surface by one quantization step, m: a share of the current or expected
    /// deformation. It decays slowly.
    pub(super) fn unit(&mut self, state: &TickState<'_>) -> f32 {
        let count = self.modes.min(state.q.len());
        let now = self.quanta.visible(&state.q[..count], &state.v[..count]);
        self.visible = now.max(self.visible * VISIBLE_KEEP);
        let finer = if self.subscription.payload == Payload::Forces { 1.0 } else { FINER };
        let share = self.quantum / finer;
        let unit = (self.visible * share) as f32;
        if unit.is_finite() { unit.clamp(1e-30, 1e6) } else { 1e6 }
    }

    /// Steps the mirror with accelerations chosen so that the mirror meets the true state.
    pub(super) fn step_accelerations(
        &mut self,
        coding: AccelerationCoding,
        state: &TickState<'_>,
        unit: f32,
    ) -> Accelerations {
        let Newmark { h, beta, gamma } = self.newmark;
        // The acceleration that meets the position exactly is a filter of the position with both
        // zeros at `zero`. If `zero` lies outside the unit circle, or on it as for average
        // acceleration, that acceleration oscillates for ever.
        let zero = if beta > 0.0 { (0.5 + gamma - 2.0 * beta) / (2.0 * beta) } else { f64::INFINITY };
        let exact = zero.abs() < 0.9 && ((gamma + 0.5).powi(2) / 4.0 - beta).abs() < 1e-9;
        let truth_at = |slice: &[f64], k: usize| slice.get(k).copied().unwrap_or(0.0);
        self.scratch.clear();
        for k in 0..self.modes {
            let (q, v, a) = (self.mirror.state.q[k], self.mirror.state.v[k], self.mirror.state.a[k]);
            let (free_q, _) = self.newmark.step(q, v, a, 0.0);
            self.scratch.push(if exact {
                (truth_at(state.q, k) - free_q) / (beta * h * h)
            } else {
                // Use the host's own acceleration plus a correction toward the true state. For
                // average acceleration these gains put all three poles of the error within 0.62.
                let (eq, ev) = (self.truth.state.q[k] - q, self.truth.state.v[k] - v);
                truth_at(state.a, k) + 0.1 * eq / (h * h) + 0.5 * ev / h
            });
        }
        let mut accelerations = Accelerations::quantize(coding, &self.scratch, unit, &self.quanta);
        // If the accelerations do not fit in the datagram, use coarser steps. The closed loop
        // corrects the error in later ticks. Grabs have lower priority: those that do not fit get a
        // datagram of their own.
        let pose = if state.pose.is_some() { 46 } else { 0 };
        let room = self.limit.saturating_sub(3 + 12 + 2 + 4 + 1 + pose);
        let mut coarser = unit;
        while accelerations.bytes() > room && coarser < 1e9 && coding == AccelerationCoding::Visible {
            coarser *= 4.0;
            accelerations = Accelerations::quantize(coding, &self.scratch, coarser, &self.quanta);
        }
        for (k, a) in self.scratch.iter_mut().enumerate() {
            *a = accelerations.get(k, &self.quanta);
        }
        if let Some(filter) = &self.viscoelastic {
            filter.begin(&mut self.mirror.state);
        }
        self.newmark.advance(&mut self.mirror.state, &self.scratch);
        if let Some(filter) = &self.viscoelastic {
            filter.finish(&mut self.mirror.state);
        }
        accelerations
    }

    /// Steps the mirror with the quantized reactions and updates the estimate of the load that they
    /// leave unexplained.
    pub(super) fn step_forces(&mut self, grabs: &[FrameGrab], state: &TickState<'_>, frame: Option<Frame>) {
        if self.frames.is_multiple_of(LOAD_EVERY) {
            // The step starts from the true state of the previous tick, as a receiver without error
            // would.
            let mut lacking = std::mem::take(&mut self.scratch);
            let to = [state.q, state.v];
            self.truth.state.f.clone_from(&self.mirror.state.f);
            let hands = self.truth.hands.clone();
            self.truth.contacts.clone_from(&self.mirror.contacts);
            self.replica.lacking(&mut self.truth, to, grabs, &self.load, frame, &mut lacking);
            self.truth.hands = hands;
            let share = LOAD_EVERY as f64 / LOAD_TICKS;
            for ((estimate, load), lacking) in self.unexplained.iter_mut().zip(&self.load).zip(&lacking) {
                *estimate += (load + lacking - *estimate) * share;
            }
            self.scratch = lacking;
        }
        self.replica.step_measured(&mut self.mirror, grabs, &self.load, frame);
        let hands = grabs.iter().map(|g| {
            let (key, end) = (g.state.key, -Vector3::from(g.state.reaction));
            HandState::of_mean(key, self.replica.mean(end, self.truth.mean(key), grabs.len()))
        });
        self.truth.hands = hands.collect();
        if !self.loaded {
            let omega = self.replica.kernel().omega();
            let static_part = |k: usize| self.unexplained[k].abs() / omega[k].powi(2).max(1e-12);
            let largest = |x: &mut dyn Iterator<Item = f64>| x.fold(0.0_f64, f64::max);
            let load = largest(&mut (0..self.modes).map(static_part));
            let shape = largest(&mut state.q.iter().take(self.modes).map(|q| q.abs()));
            self.loaded = load > LOAD_FLOOR * shape && shape > 0.0;
        }
    }
}
