//! Own hand first: a guest's hand does not wait for the round trip.
//!
//! What a guest is shown of a body is confirmed, and old by the way back and the playout; what its own hand does reaches
//! the host after the way out. A hand that feels its own motion that late feels it wrong. So the guest keeps a second,
//! newer copy: from the confirmed state it steps on to the tick at which the host will apply the hand's present target, the
//! own hands at the targets that are on their way, the others' where they are going. It starts anew from the confirmed state
//! at every tick (a step costs microseconds), and what changed by that fades.
//!
//! How many ticks to step ahead needs no clock: the host's frames say which target each hand had, and the guest knows how
//! many ticks ago it said that one.

use std::collections::VecDeque;

use nalgebra::Vector3;
use pliant_modal::GrabConfig;

use crate::recovery::{Blend, Forecast, Receiver};
use crate::state::{GrabKey, ModalState, Tick, UserId};
use crate::stepper::{ForceStepper, Hold, inverse_rotation};

/// Targets remembered, and so the largest lead, ticks.
const REMEMBERED: usize = 64;
/// Frames that must agree on another lead before it is taken.
const VOTES: u32 = 4;

#[derive(Debug)]
struct OwnGrab {
    grab: u16,
    vertex: u32,
    radius: f64,
    hold: GrabConfig,
    target: Option<[f64; 3]>,
    /// The target at each of the last ticks, newest last; none where it did not hold.
    past: VecDeque<Option<[f64; 3]>>,
    /// World, N.
    reaction: [f64; 3],
    offset: [f64; 3],
}

/// A guest's newer copy of a body that it holds.
#[derive(Debug)]
pub struct OwnHand {
    stepper: ForceStepper,
    grabs: Vec<OwnGrab>,
    lead: usize,
    votes: u32,
    tick: Tick,
    active: bool,
    state: ModalState,
    expected: ModalState,
    shown: ModalState,
    blend: Blend,
    forecast: Forecast,
    fade: f64,
    holds: Vec<Hold>,
    h: f64,
}

impl OwnHand {
    pub(crate) fn new(stepper: ForceStepper, h: f64, blend_ticks: u16) -> Self {
        let modes = stepper.modes();
        Self {
            stepper,
            grabs: Vec::new(),
            lead: 0,
            votes: 0,
            tick: 0,
            active: false,
            state: ModalState::zero(modes),
            expected: ModalState::zero(modes),
            shown: ModalState::zero(modes),
            blend: Blend::new(h, blend_ticks),
            forecast: Forecast::new(h),
            fade: (-3.0 / f64::from(blend_ticks.max(1))).exp(),
            holds: Vec::new(),
            h,
        }
    }

    /// The tick that the copy stands for: the host's when the present target will reach it.
    pub fn tick(&self) -> Tick {
        self.tick
    }

    /// How many ticks the copy is ahead of the confirmed state.
    pub fn lead(&self) -> usize {
        self.lead
    }

    /// The body as its holder is to see it: continuous in position and velocity.
    pub fn shown(&self) -> &ModalState {
        &self.shown
    }

    /// The reaction of one of the guest's own grabs at this moment, world, N.
    pub fn reaction(&self, grab: u16) -> Option<[f64; 3]> {
        let g = self.grabs.iter().find(|g| g.grab == grab && g.target.is_some())?;
        Some(std::array::from_fn(|k| g.reaction[k] + g.offset[k]))
    }

    /// False when the guest does not hold the body and nothing fades any more: the confirmed state is what is shown.
    pub fn is_active(&self) -> bool {
        self.active
    }

    /// Goes on with the grabs of another copy.
    pub(crate) fn take_grabs(&mut self, other: Self) {
        self.grabs = other.grabs;
        self.lead = other.lead;
    }

    pub(crate) fn begin(&mut self, grab: u16, vertex: u32, radius: f64, target: [f64; 3], hold: GrabConfig) {
        self.grabs.retain(|g| g.grab != grab);
        self.grabs.push(OwnGrab {
            grab,
            vertex,
            // As the host's frames will say it.
            radius: f64::from(radius as f32),
            hold,
            target: Some(target),
            past: VecDeque::with_capacity(REMEMBERED),
            reaction: [0.0; 3],
            offset: [0.0; 3],
        });
    }

    pub(crate) fn set(&mut self, grab: u16, target: [f64; 3]) {
        if let Some(g) = self.grabs.iter_mut().find(|g| g.grab == grab && g.target.is_some()) {
            g.target = Some(target);
        }
    }

    pub(crate) fn end(&mut self, grab: u16) {
        for g in self.grabs.iter_mut().filter(|g| g.grab == grab) {
            g.target = None;
        }
    }

    /// A tick of the confirmed state has passed. `guess`: the lead to begin with, ticks.
    pub(crate) fn step(&mut self, receiver: &Receiver, user: UserId, guess: usize) {
        if self.state.modes() != receiver.hidden().modes() || receiver.pose().is_some() {
            // The frame of a free body is not stepped here.
            self.active = false;
            return;
        }
        for g in &mut self.grabs {
            if g.past.len() >= REMEMBERED {
                g.past.pop_front();
            }
            g.past.push_back(g.target);
        }
        let before = self.grabs.len();
        self.grabs.retain(|g| g.past.iter().any(Option::is_some));
        let confirmed = receiver.tick();
        if self.grabs.is_empty() {
            if before > 0 || self.active {
                self.fall_back(receiver);
            }
            self.tick = confirmed;
            return;
        }
        if !self.active {
            self.active = true;
            self.lead = guess.min(REMEMBERED - 1);
            self.state.copy_from(receiver.shown());
            self.shown.copy_from(receiver.shown());
            self.blend.clear();
        }
        self.vote(receiver, user);
        self.tick = confirmed + self.lead as u64;

        // What the copy would have become, had nothing new been learnt.
        self.expected.copy_from(&self.state);
        let mut expected = std::mem::take(&mut self.expected);
        self.one_step(&mut expected, receiver, user, self.lead);
        let would: Vec<[f64; 3]> = self.grabs.iter().map(|g| g.reaction).collect();

        let mut state = std::mem::take(&mut self.state);
        state.copy_from(receiver.hidden());
        self.stepper.set_last_force(receiver.last_force());
        for g in &mut self.grabs {
            let key = GrabKey { user, grab: g.grab };
            g.reaction = receiver.grabs().iter().find(|x| x.key == key).map_or([0.0; 3], |x| x.reaction);
        }
        for j in 1..=self.lead {
            self.one_step(&mut state, receiver, user, j);
        }
        self.blend.advance();
        self.blend.add(
            expected.q.iter().zip(&state.q).map(|(e, s)| e - s),
            expected.v.iter().zip(&state.v).map(|(e, s)| e - s),
        );
        for (g, would) in self.grabs.iter_mut().zip(would) {
            for ((offset, would), now) in g.offset.iter_mut().zip(would).zip(g.reaction) {
                *offset = self.fade * (*offset + would - now);
            }
        }
        self.state = state;
        self.expected = expected;
        self.show();
    }

    /// Steps to `j` ticks after the confirmed one, and leaves the own reactions in the grabs.
    fn one_step(&mut self, state: &mut ModalState, receiver: &Receiver, user: UserId, j: usize) {
        let history = receiver.history();
        let tick = receiver.tick() + j as u64;
        let back = inverse_rotation([0.0, 0.0, 0.0, 1.0]);
        self.holds.clear();
        let mut holds = std::mem::take(&mut self.holds);
        for g in receiver.grabs().iter().filter(|g| g.key.user != user) {
            if let Some(g) = history.grab(g.key, tick, &self.forecast) {
                holds.push(Hold::measured(&g, &back));
            }
        }
        let others = holds.len();
        let mut own = Vec::with_capacity(self.grabs.len());
        for (index, g) in self.grabs.iter().enumerate() {
            // Newest is the target that arrives `lead` ticks after the confirmed one.
            let target =
                (g.past.len() + j).checked_sub(1 + self.lead).and_then(|i| g.past.get(i).copied().flatten());
            let (Some(target), Some(rest)) = (target, self.stepper.rest(g.vertex, g.radius)) else {
                continue;
            };
            let pull = -Vector3::from(g.reaction);
            let place = Vector3::from(target) - rest;
            let hand = g.hold.stiffness.map_or(0.0, |k| 1.0 / k);
            holds.push(Hold { vertex: g.vertex, radius: g.radius, pull, place, target: true, hand });
            own.push(index);
        }
        self.stepper.step_held(state, &mut holds, receiver.load());
        if holds.len() == others + own.len() {
            for (hold, index) in holds[others..].iter().zip(own) {
                self.grabs[index].reaction = (-hold.pull).into();
            }
        }
        self.holds = holds;
    }

    /// Finds how many ticks ago the target was said that the host's frame of the confirmed tick shows.
    fn vote(&mut self, receiver: &Receiver, user: UserId) {
        let mut found = None;
        for g in &self.grabs {
            let key = GrabKey { user, grab: g.grab };
            let Some(echo) = receiver.grabs().iter().find(|x| x.key == key) else { continue };
            let lags = g.past.iter().rev().enumerate().filter(|(_, t)| {
                t.is_some_and(|t| t.iter().zip(echo.target).all(|(a, b)| f64::from(*a as f32) == b))
            });
            found = lags.map(|(lag, _)| lag).min_by_key(|lag| lag.abs_diff(self.lead)).or(found);
        }
        match found {
            Some(lag) if lag != self.lead => {
                self.votes += 1;
                if self.votes >= VOTES {
                    (self.lead, self.votes) = (lag, 0);
                }
            }
            Some(_) => self.votes = 0,
            None => {}
        }
    }

    /// The guest holds nothing any more: the shown state goes over into the confirmed one.
    fn fall_back(&mut self, receiver: &Receiver) {
        self.blend.advance();
        let new = receiver.shown();
        let h = self.h;
        let old = &self.state;
        self.blend.add(
            (0..new.modes()).map(|k| old.q[k] + h * old.v[k] - new.q[k]),
            (0..new.modes()).map(|k| old.v[k] - new.v[k]),
        );
        self.state.copy_from(new);
        self.show();
        // From here on the confirmed state is followed without new offsets.
        let offset = self.shown.q.iter().zip(&new.q).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let size = new.q.iter().fold(1e-12_f64, |m, q| m.max(q.abs()));
        self.active = offset > 1e-6 * size;
    }

    fn show(&mut self) {
        self.shown.copy_from(&self.state);
        self.blend.apply(&mut self.shown.q, &mut self.shown.v);
    }
}
