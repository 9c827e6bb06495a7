//! What late inputs change. The ticks since then are stepped again, a few in each update,
//! while the body goes on as it is.

use nalgebra::{UnitQuaternion, Vector3};
use pliant_modal::{Frame, ModalModel};

use super::{LateInputRepair, PeerBody};
use crate::peer::inputs::{BodyInputs, InputLog, WINDOW, step_cost};
use crate::prediction::BodyCopy;
use crate::state::Tick;

/// What going through a tick costs more where the body touches things, as a number of steps without
/// contacts.
pub(crate) const CONTACT_COST: u64 = 4;
/// Number of hands of a tick that take as long to look at as a step without hands.
const HANDS_LOOKED_AT: u64 = 8;
/// A first tick that waits is given up when no more than this number of ticks is left until it is
/// forgotten.
const SPARE: u64 = 8;

/// A way through past ticks. As long as their inputs are those that they were stepped with, they
/// stay as they are.
#[derive(Debug)]
pub(super) struct Pass {
    /// The last tick that is done.
    pub(super) tick: Tick,
    /// The state after that tick, from the first one on that is stepped again.
    pub(super) copy: Option<BodyCopy>,
}

impl PeerBody {
    /// The newest tick whose state has all inputs that are known. The ones after it are, or will
    /// be, stepped again.
    pub(crate) fn resimulated_to(&self) -> Tick {
        let done = self.pass.as_ref().map_or(self.tick(), |pass| pass.tick);
        self.late.map_or(done, |late| done.min(late.saturating_sub(1)))
    }

    /// Whether an input of a tick comes too late to wait until the present pass is done.
    pub(crate) fn cannot_wait(&self, tick: Tick) -> bool {
        let behind = self.tick().saturating_sub(tick);
        behind > WINDOW as u64 / 2 && self.pass.as_ref().is_some_and(|pass| tick <= pass.tick)
    }

    /// Notes that what happens at a tick has changed.
    pub(crate) fn mark(&mut self, tick: Tick) {
        self.late = Some(self.late.map_or(tick, |late| late.min(tick)));
    }

    /// Begins a pass from the first tick that was marked, unless one is under way, which is
    /// finished first. Nothing goes back behind the tick of the state that was `taken` last.
    /// Returns false where the tick is not remembered.
    pub(crate) fn begin_pass(&mut self, taken: Tick, inputs: &InputLog) -> bool {
        let Some(from) = self.late.map(|late| late.max(taken + 1)) else { return true };
        let base = from - 1;
        if let Some(pass) = &self.pass {
            let waits = base < pass.tick;
            let lost = waits && self.tick() - base + SPARE >= WINDOW as u64;
            if lost || !waits {
                self.late = None;
            }
            return !lost;
        }
        self.late = None;
        if from > self.tick() {
            return true;
        }
        if self.rollback.at(base).is_none() {
            return false;
        }
        // Equations (8) and (9) know nothing of shapes of held patches.
        let compensates = self.repair == LateInputRepair::Compensate && self.columns.is_empty();
        if compensates && !self.lacks_impulse(from, inputs) {
            let before = self.live().clone();
            self.compensate(from, inputs);
            self.visual.add(&self.model, &before, &self.rollback.now.state);
        } else {
            // Equations (8) and (9) leave approximate states, which are never taken for equal.
            let exact = self.repair != LateInputRepair::Compensate;
            let copy = if exact { None } else { self.rollback.at(base).cloned() };
            self.pass = Some(Pass { tick: base, copy });
        }
        true
    }

    /// Whether ticks are to be stepped again.
    pub(crate) fn is_behind(&self) -> bool {
        self.pass.is_some()
    }

    /// Goes on with the pass until it is done or the budget is used up. Returns what is left of
    /// the budget.
    pub(crate) fn resimulate(&mut self, inputs: &InputLog, mut budget: u64) -> u64 {
        while budget > 0 && self.pass.is_some() {
            budget = budget.saturating_sub(self.go_on(inputs));
        }
        budget
    }

    /// Goes on with the pass by a tick. Returns what that cost, in steps without hands.
    pub(super) fn go_on(&mut self, inputs: &InputLog) -> u64 {
        let Some(mut pass) = self.pass.take() else { return 0 };
        let tick = pass.tick + 1;
        inputs.of_body(tick, self.id, &self.forecast, &mut self.again);
        let shapes = self.columns.of_step(tick, &self.again);
        if pass.copy.is_none() {
            let past = self.rollback.at(tick).filter(|_| self.used.get(tick) == Some(&self.again));
            let is_same = past.is_some_and(|past| {
                past.shapes.as_ref().map(std::sync::Arc::as_ptr) == shapes.map(std::sync::Arc::as_ptr)
            });
            if !is_same {
                pass.copy = self.rollback.at(pass.tick).cloned();
            }
        }
        pass.tick = tick;
        let mut cost = 1 + self.again.held.len() as u64 / HANDS_LOOKED_AT;
        if let Some(copy) = &mut pass.copy {
            Self::press(&mut self.replica, copy, &self.again, shapes);
            self.rollback.remember(tick, copy);
            self.used.place(tick).0.clone_from(&self.again);
            self.restepped += 1;
            cost = step_cost(self.again.held.len() as u64) + if self.touches() { CONTACT_COST } else { 0 };
        }
        if tick < self.tick() {
            self.pass = Some(pass);
        } else if let Some(copy) = pass.copy {
            let before = std::mem::replace(&mut self.rollback.now, copy);
            std::mem::swap(&mut self.inputs, &mut self.again);
            self.visual.add(&self.model, &before.state, &self.rollback.now.state);
        }
        cost
    }

    /// Moves the hands of the next step from where they were guessed to be, as they are known to
    /// have moved. They are where they should be once the pass is done. Until then, the body would
    /// be thrown by hands that jump.
    pub(super) fn lead_on(&mut self, tick: Tick, inputs: &InputLog) {
        let Some(used) = tick.checked_sub(1).and_then(|before| self.used.get(before)) else { return };
        inputs.of_body(tick - 1, self.id, &self.forecast, &mut self.again);
        for (user, held) in &mut self.inputs.held {
            let key = held.key(*user);
            let of = |of: &BodyInputs| {
                let hand = of.held.iter().find(|(user, hand)| hand.key(*user) == key);
                hand.map(|(_, hand)| Vector3::from(hand.target))
            };
            if let (Some(guessed), Some(known)) = (of(used), of(&self.again)) {
                held.target = (Vector3::from(held.target) + (guessed - known)).into();
            }
        }
    }

    /// Whether an impulse at tick `from` or later did not act yet. It changes velocities at once,
    /// which no acceleration of equations (8) and (9) does.
    fn lacks_impulse(&self, from: Tick, inputs: &InputLog) -> bool {
        let mut known = BodyInputs::default();
        (from..=self.tick()).any(|tick| {
            inputs.of_body(tick, self.id, &self.forecast, &mut known);
            self.used.get(tick).is_none_or(|used| used.impulses != known.impulses)
        })
    }

    /// Applies equations (8) and (9) to every tick from `from` on whose known inputs differ from
    /// those used.
    fn compensate(&mut self, from: Tick, inputs: &InputLog) {
        let (mut done, last) = (BodyInputs::default(), self.tick());
        for tick in from..=last {
            let known = inputs.of_body(tick, self.id, &self.forecast, &mut done);
            let Some(used) = self.used.get_mut(tick).filter(|used| known && done != **used) else { continue };
            let Some(before) = self.rollback.at(tick - 1) else { continue };
            let (mut with, mut without) = (before.clone(), before.clone());
            Self::press(&mut self.replica, &mut with, &done, None);
            Self::press(&mut self.replica, &mut without, used, None);
            used.clone_from(&done);
            let (with_frame, without_frame) = (with.state.frame, without.state.frame);
            // The history is corrected like the present state, because later corrections and checks
            // use it.
            for t in tick..=last {
                let (to_q, to_v) = self.newmark.response(t - tick);
                let to_z = self.viscoelastic.as_ref().map_or(0.0, |filter| filter.response(t - tick));
                let seconds = (t - tick) as f64 * self.replica.kernel().h();
                let Some(past) = self.rollback.at_mut(t) else { continue };
                let state = &mut past.state;
                if self.model.is_free() {
                    state.frame = moved(&self.model, &state.frame, [&with_frame, &without_frame], seconds);
                }
                for k in 0..state.modes() {
                    let da = with.state.a[k] - without.state.a[k];
                    // The difference at the tick itself is known exactly.
                    let own = t == tick;
                    state.q[k] += if own { with.state.q[k] - without.state.q[k] } else { to_q * da };
                    state.v[k] += if own { with.state.v[k] - without.state.v[k] } else { to_v * da };
                    if let Some(z) = state.z.get_mut(k) {
                        *z += to_z * da;
                    }
                }
            }
            if let Some(now) = self.rollback.at_mut(tick) {
                (now.state.a, now.state.f) = (with.state.a, with.state.f);
                now.hands = with.hands;
            }
            self.restepped += 1;
        }
        self.rollback.back_to(last);
    }
}

/// Returns the frame as it would be if the body had been at `there` instead of `here` `seconds`
/// ago. The difference in velocity and spin has acted since.
fn moved(model: &ModalModel, frame: &Frame, [there, here]: [&Frame; 2], seconds: f64) -> Frame {
    let of = |f: fn(&Frame) -> [f64; 3]| Vector3::from(f(there)) - Vector3::from(f(here));
    let (faster, spin) = (of(Frame::velocity), of(Frame::spin));
    let center = Vector3::from(frame.center()) + of(Frame::center) + faster * seconds;
    let turning = there.angular_velocity(model) - here.angular_velocity(model);
    let turned = (there.rotation() * here.rotation().inverse()).scaled_axis() + turning * seconds;
    let turn = UnitQuaternion::from_scaled_axis(turned) * frame.rotation();
    let velocity = Vector3::from(frame.velocity()) + faster;
    let spin = Vector3::from(frame.spin()) + spin;
    let q = [turn.i, turn.j, turn.k, turn.w];
    Frame::from_motion(model, center.into(), q, velocity.into(), spin.into()).unwrap_or(*frame)
}
