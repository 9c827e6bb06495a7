//! One body at a peer: stepped at once, and stepped again when a late input says otherwise.

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_modal::ModalModel;

use super::inputs::{InputLog, WINDOW};
use super::wire::{HeldAt, PeerBodyState};
use crate::StreamError;
use crate::newmark::Newmark;
use crate::recovery::{Blend, Forecast};
use crate::state::{BodyId, GrabKey, GrabState, ModalState, Tick, UserId};
use crate::stepper::{BodySetup, ForceStepper, Hold};

/// How a late input is put right.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Repair {
    /// Back to the tick before it, and step again with what is known now: exact. The default.
    #[default]
    Rollback,
    /// The paper's: the acceleration that the late target would have made at its tick, less the one that was made, moves
    /// displacement and velocity by equations (8) and (9). Cheaper by the number of ticks, and right only as far as the
    /// body does not answer within them.
    Compensate,
}

#[derive(Debug, Clone, Default)]
struct Past {
    tick: Tick,
    state: ModalState,
    pulls: Vec<(GrabKey, Vector3<f64>)>,
    used: Vec<(UserId, HeldAt)>,
}

/// A body that this peer steps.
#[derive(Debug)]
pub struct PeerBody {
    pub(crate) id: BodyId,
    pub(crate) model: Arc<ModalModel>,
    stepper: ForceStepper,
    forecast: Forecast,
    newmark: Newmark,
    repair: Repair,
    tick: Tick,
    state: ModalState,
    pulls: Vec<(GrabKey, Vector3<f64>)>,
    past: Vec<Past>,
    held: Vec<(UserId, HeldAt)>,
    blend: Blend,
    shown: ModalState,
    grabs: Vec<GrabState>,
    restepped: u64,
}

impl PeerBody {
    pub(crate) fn new(
        id: BodyId,
        model: Arc<ModalModel>,
        setup: &BodySetup,
        h: f64,
        repair: Repair,
        blend_ticks: u16,
    ) -> Result<Self, StreamError> {
        if model.is_free() {
            return Err(StreamError::Config {
                what: "body",
                found: "a free one".into(),
                expected: "an anchored body: peers do not step rigid frames",
            });
        }
        let stepper = ForceStepper::new(model.clone(), setup, model.mode_count(), h)?;
        let modes = stepper.modes();
        let (beta, gamma) = setup.integrator.newmark().unwrap_or((0.25, 0.5));
        let mut made = Self {
            id,
            model,
            stepper,
            forecast: Forecast::new(h),
            newmark: Newmark { h, beta, gamma },
            repair,
            tick: 0,
            state: ModalState::zero(modes),
            pulls: Vec::new(),
            past: vec![Past::default(); WINDOW],
            held: Vec::new(),
            blend: Blend::new(h, blend_ticks),
            shown: ModalState::zero(modes),
            grabs: Vec::new(),
            restepped: 0,
        };
        // The beginning can be gone back to like any other tick.
        made.remember();
        Ok(made)
    }

    /// Its number.
    pub fn id(&self) -> BodyId {
        self.id
    }

    /// Its model.
    pub fn model(&self) -> &Arc<ModalModel> {
        &self.model
    }

    /// The tick that it has reached.
    pub fn tick(&self) -> Tick {
        self.tick
    }

    /// Best estimate of what all peers will agree on.
    pub fn hidden(&self) -> &ModalState {
        &self.state
    }

    /// What the eye and the hand get: continuous in position and velocity.
    pub fn shown(&self) -> &ModalState {
        &self.shown
    }

    /// Everything that holds the body, with its reactions.
    pub fn grabs(&self) -> &[GrabState] {
        &self.grabs
    }

    /// Ticks that were stepped again.
    pub fn restepped(&self) -> u64 {
        self.restepped
    }

    /// The state after a tick that is still remembered.
    pub(crate) fn past(&self, tick: Tick) -> Option<&ModalState> {
        let past = &self.past[(tick % WINDOW as u64) as usize];
        (past.tick == tick && tick <= self.tick && past.state.modes() > 0).then_some(&past.state)
    }

    /// The reactions of the hands at a tick that is still remembered: user, N.
    pub(crate) fn reactions_at(&self, tick: Tick) -> Option<Vec<(u16, [f64; 3])>> {
        self.past(tick)?;
        let past = &self.past[(tick % WINDOW as u64) as usize];
        Some(past.pulls.iter().map(|(key, pull)| (key.user.0, (-pull).into())).collect())
    }

    pub(crate) fn export(&self, tick: Tick) -> Option<PeerBodyState> {
        let past = &self.past[(tick % WINDOW as u64) as usize];
        (past.tick == tick && past.state.modes() > 0).then(|| PeerBodyState {
            body: self.id.0,
            q: past.state.q.clone(),
            v: past.state.v.clone(),
            a: past.state.a.clone(),
            pulls: past.pulls.iter().map(|(k, p)| (k.user.0, k.grab, (*p).into())).collect(),
        })
    }

    /// Takes a state over and steps on from it to the tick reached.
    pub(crate) fn import(&mut self, tick: Tick, to: Tick, state: &PeerBodyState, inputs: &InputLog) -> bool {
        if state.q.len() != self.state.modes() {
            return false;
        }
        let before = self.state.clone();
        self.state = ModalState { q: state.q.clone(), v: state.v.clone(), a: state.a.clone() };
        let pull = |p: &(u16, u16, [f64; 3])| (GrabKey { user: UserId(p.0), grab: p.1 }, Vector3::from(p.2));
        self.pulls = state.pulls.iter().map(pull).collect();
        let fresh = self.tick == 0;
        self.tick = tick;
        self.stepper.restart();
        self.remember();
        while self.tick < to {
            self.step_once(inputs);
        }
        if fresh {
            self.blend.clear();
        } else {
            self.add_blend(&before);
        }
        self.show();
        true
    }

    /// Steps to the next tick.
    pub(crate) fn advance(&mut self, inputs: &InputLog) {
        self.step_once(inputs);
        self.blend.advance();
        self.show();
    }

    /// Puts right what inputs for `from` and later say, from `from` on. False when that is too long ago.
    pub(crate) fn correct(&mut self, from: Tick, inputs: &InputLog) -> bool {
        if from > self.tick {
            return true;
        }
        let Some(base) = from.checked_sub(1) else { return false };
        let past = &self.past[(base % WINDOW as u64) as usize];
        if past.tick != base || past.state.modes() == 0 {
            return false;
        }
        let before = self.state.clone();
        match self.repair {
            Repair::Rollback => {
                let to = self.tick;
                self.state.copy_from(&past.state);
                self.pulls.clone_from(&past.pulls);
                self.tick = base;
                self.stepper.restart();
                while self.tick < to {
                    self.step_once(inputs);
                    self.restepped += 1;
                }
            }
            Repair::Compensate => self.compensate(from, inputs),
        }
        self.add_blend(&before);
        true
    }

    /// Equations (8) and (9) for every tick from `from` on whose inputs are not what was used.
    fn compensate(&mut self, from: Tick, inputs: &InputLog) {
        let mut held = Vec::new();
        for tick in from..=self.tick {
            let index = (tick % WINDOW as u64) as usize;
            let known = inputs.held(tick, self.id, &self.forecast, &mut held);
            if self.past[index].tick != tick || !known || held == self.past[index].used {
                continue;
            }
            let before = &self.past[((tick - 1) % WINDOW as u64) as usize];
            if before.tick + 1 != tick {
                continue;
            }
            let (start, pulls) = (before.state.clone(), before.pulls.clone());
            let mut with = start.clone();
            let mut pulled = pulls.clone();
            Self::press(&mut self.stepper, &mut with, &mut pulled, &held);
            let mut without = start;
            let mut pulled = pulls;
            let used = std::mem::take(&mut self.past[index].used);
            Self::press(&mut self.stepper, &mut without, &mut pulled, &used);
            let (to_q, to_v) = self.newmark.response(self.tick - tick);
            for k in 0..self.state.modes() {
                let da = with.a[k] - without.a[k];
                self.state.q[k] += to_q * da;
                self.state.v[k] += to_v * da;
            }
            self.past[index].used.clone_from(&held);
            self.restepped += 1;
        }
    }

    fn step_once(&mut self, inputs: &InputLog) {
        let tick = self.tick + 1;
        let mut held = std::mem::take(&mut self.held);
        inputs.held(tick, self.id, &self.forecast, &mut held);
        Self::press(&mut self.stepper, &mut self.state, &mut self.pulls, &held);
        self.held = held;
        self.tick = tick;
        self.remember();
    }

    /// One step of a state with hands; `pulls` go in as where to begin and come out as what acted.
    fn press(
        stepper: &mut ForceStepper,
        state: &mut ModalState,
        pulls: &mut Vec<(GrabKey, Vector3<f64>)>,
        held: &[(UserId, HeldAt)],
    ) {
        let mut holds = Vec::with_capacity(held.len());
        let mut keys = Vec::with_capacity(held.len());
        for (user, g) in held {
            let Some(rest) = stepper.rest(g.vertex, g.radius) else { continue };
            let key = g.key(*user);
            let pull = pulls.iter().find(|p| p.0 == key).map_or_else(Vector3::zeros, |p| p.1);
            let place = Vector3::from(g.target) - rest;
            holds.push(Hold { vertex: g.vertex, radius: g.radius, pull, place, target: true, hand: 0.0 });
            keys.push(key);
        }
        stepper.step_held(state, &mut holds, &[]);
        pulls.clear();
        pulls.extend(keys.into_iter().zip(holds.iter().map(|h| h.pull)));
    }

    fn remember(&mut self) {
        let past = &mut self.past[(self.tick % WINDOW as u64) as usize];
        past.tick = self.tick;
        past.state.copy_from(&self.state);
        past.pulls.clone_from(&self.pulls);
        past.used.clone_from(&self.held);
    }

    fn add_blend(&mut self, before: &ModalState) {
        let now = &self.state;
        self.blend.add(
            before.q.iter().zip(&now.q).map(|(b, n)| b - n),
            before.v.iter().zip(&now.v).map(|(b, n)| b - n),
        );
    }

    fn show(&mut self) {
        self.shown.copy_from(&self.state);
        self.blend.apply(&mut self.shown.q, &mut self.shown.v);
        self.grabs.clear();
        for (user, g) in &self.held {
            let key = g.key(*user);
            let pull = self.pulls.iter().find(|p| p.0 == key).map_or_else(Vector3::zeros, |p| p.1);
            self.grabs.push(GrabState {
                key,
                vertex: g.vertex,
                radius: g.radius,
                target: g.target,
                reaction: (-pull).into(),
            });
        }
    }
}
