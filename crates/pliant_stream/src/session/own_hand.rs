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

use nalgebra::{Matrix3, Vector3};
use pliant_modal::{Frame, GrabConfig, RigidMotion};

use crate::recovery::{Blend, Forecast, PoseBlend, Receiver};
use crate::state::{GrabKey, ModalState, Pose, Tick, UserId};
use crate::stepper::{ForceStepper, FrameStep, Hold, inverse_rotation};

/// Targets remembered, and so the largest lead, ticks.
const REMEMBERED: usize = 64;
/// Frames that must agree on another lead before it is taken.
const VOTES: u32 = 4;
/// How fast the estimate of what else pushes a free body follows.
const LEARN: f64 = 0.25;

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
    /// What the reaction would have become, had nothing new been learnt.
    would: [f64; 3],
    /// How far the residual flexibility under the hand has flown, body axes, m: at the confirmed tick, and in the copy.
    flow: Vector3<f64>,
    flowing: Vector3<f64>,
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
    /// The rigid frame of the copy, where the body is free, and the confirmed one of the tick before.
    frame: Option<Frame>,
    last_frame: Option<Frame>,
    pose: Option<Pose>,
    pose_blend: PoseBlend,
    /// Force and torque on the frame that nothing told explains, world axes.
    push: (Vector3<f64>, Vector3<f64>),
    forecast: Forecast,
    fade: f64,
    holds: Vec<Hold>,
    own: Vec<usize>,
    h: f64,
}

impl OwnHand {
    pub(crate) fn new(stepper: ForceStepper, h: f64, blend_ticks: u16) -> Self {
        let rest = stepper.at_rest();
        Self {
            stepper,
            grabs: Vec::new(),
            lead: 0,
            votes: 0,
            tick: 0,
            active: false,
            state: rest.clone(),
            expected: rest.clone(),
            shown: rest,
            blend: Blend::new(h, blend_ticks),
            frame: None,
            last_frame: None,
            pose: None,
            pose_blend: PoseBlend::new(h, blend_ticks),
            push: (Vector3::zeros(), Vector3::zeros()),
            forecast: Forecast::new(h),
            fade: (-3.0 / f64::from(blend_ticks.max(1))).exp(),
            holds: Vec::new(),
            own: Vec::new(),
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

    /// The rigid frame that belongs to [`OwnHand::shown`], where the body is free.
    pub fn pose(&self) -> Option<Pose> {
        self.pose
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
            would: [0.0; 3],
            flow: Vector3::zeros(),
            flowing: Vector3::zeros(),
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
        let confirmed_frame = receiver.frame().and_then(|p| p.frame(self.stepper.model()));
        if self.state.modes() != receiver.hidden().modes()
            || self.stepper.is_free() != confirmed_frame.is_some()
        {
            self.active = false;
            return;
        }
        self.learn_push(receiver, confirmed_frame);
        self.learn_flow(receiver, user);
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
            self.frame = receiver.pose().and_then(|p| p.frame(self.stepper.model()));
            self.pose_blend.clear();
        }
        self.vote(receiver, user);
        self.tick = confirmed + self.lead as u64;

        // What the copy would have become, had nothing new been learnt.
        self.expected.copy_from(&self.state);
        let mut expected = std::mem::take(&mut self.expected);
        let mut frame = self.frame;
        self.one_step(&mut expected, &mut frame, receiver, user, self.lead);
        for g in &mut self.grabs {
            g.would = g.reaction;
        }
        let expected_frame = frame;

        let mut state = std::mem::take(&mut self.state);
        state.copy_from(receiver.hidden());
        self.stepper.set_last_force(receiver.last_force());
        let mut frame = confirmed_frame;
        self.grabs.iter_mut().for_each(|g| g.flowing = g.flow);
        for j in 1..=self.lead {
            self.one_step(&mut state, &mut frame, receiver, user, j);
        }
        self.blend.advance();
        self.blend.add(
            expected.q.iter().zip(&state.q).map(|(e, s)| e - s),
            expected.v.iter().zip(&state.v).map(|(e, s)| e - s),
        );
        self.pose_blend.advance();
        if let (Some(expected), Some(now)) = (expected_frame, frame) {
            let model = self.stepper.model();
            self.pose_blend.add(&Pose::of_frame(model, &expected), &Pose::of_frame(model, &now));
        }
        for g in &mut self.grabs {
            for ((offset, would), now) in g.offset.iter_mut().zip(g.would).zip(g.reaction) {
                *offset = self.fade * (*offset + would - now);
            }
        }
        self.frame = frame;
        self.state = state;
        self.expected = expected;
        self.show();
    }

    /// What pushes the frame of a free body besides gravity and the hands that the stream tells of (contacts): from the last
    /// two confirmed ticks, smoothed.
    fn learn_push(&mut self, receiver: &Receiver, now: Option<Frame>) {
        let last = std::mem::replace(&mut self.last_frame, now);
        let (Some(mut from), Some(to)) = (last, now) else { return };
        let (model, h) = (self.stepper.model().clone(), self.h);
        let zero = Vector3::zeros();
        let gravity = Vector3::from(receiver.setup().gravity);
        let rigid = RigidMotion::predict(&mut from, &model, h, gravity, zero, zero);
        let (mut force, mut torque) = (zero, zero);
        let tick = receiver.tick();
        let mut patches = Vec::with_capacity(receiver.grabs().len());
        patches.extend(receiver.grabs().iter().map(|g| (g.key, g.vertex, g.radius)));
        for (key, vertex, radius) in patches {
            let Some(g) = receiver.history().grab(key, tick, &self.forecast) else { continue };
            let Some(rest) = self.stepper.rest(vertex, radius) else { continue };
            let arm = from.to_world(rest + Vector3::from(g.displacement)) - Vector3::from(from.center());
            let pull = -Vector3::from(g.state.reaction);
            force += pull;
            torque += arm.cross(&pull);
        }
        rigid.apply(&mut from, &model, force, torque);
        let missing = (Vector3::from(to.velocity()) - Vector3::from(from.velocity())) * (model.mass() / h);
        let turning = (Vector3::from(to.spin()) - Vector3::from(from.spin())) / h;
        self.push.0 += LEARN * (missing - self.push.0);
        self.push.1 += LEARN * (turning - self.push.1);
    }

    /// Lets the flow under the own hands go on by the confirmed pulls, where the body relaxes.
    fn learn_flow(&mut self, receiver: &Receiver, user: UserId) {
        if receiver.setup().relaxation.is_none() {
            return;
        }
        let back = receiver.frame().map_or(Matrix3::identity(), |p| inverse_rotation(p.rotation));
        for g in &mut self.grabs {
            let key = GrabKey { user, grab: g.grab };
            let Some(told) = receiver.history().grab(key, receiver.tick(), &self.forecast) else { continue };
            let pull = -(back * Vector3::from(told.state.reaction));
            g.flow = self.stepper.relax(g.vertex, g.radius, g.flow, pull);
        }
    }

    /// Steps to `j` ticks after the confirmed one, and leaves the own reactions in the grabs.
    fn one_step(
        &mut self,
        state: &mut ModalState,
        frame: &mut Option<Frame>,
        receiver: &Receiver,
        user: UserId,
        j: usize,
    ) {
        let history = receiver.history();
        let tick = receiver.tick() + j as u64;
        let back = Matrix3::identity();
        let mut holds = std::mem::take(&mut self.holds);
        holds.clear();
        for g in receiver.grabs().iter().filter(|g| g.key.user != user) {
            let Some(g) = history.grab(g.key, tick, &self.forecast) else { continue };
            holds.push(if frame.is_some() {
                // The frame moves on from what is confirmed: the other's hand is where it goes, not where the patch was.
                let config = GrabConfig::default();
                Hold::hand(g.state.vertex, g.state.radius, g.state.target, Vector3::zeros(), config)
            } else {
                Hold::measured(&g, &back)
            });
        }
        let others = holds.len();
        let mut own = std::mem::take(&mut self.own);
        own.clear();
        holds.retain(|h| self.stepper.knows(h.vertex, h.radius));
        let others = others.min(holds.len());
        for (index, g) in self.grabs.iter().enumerate() {
            // Newest is the target that arrives `lead` ticks after the confirmed one.
            let at = (g.past.len() + j).checked_sub(1 + self.lead);
            let target = at.and_then(|i| g.past.get(i).copied().flatten());
            let Some(target) = target.filter(|_| self.stepper.knows(g.vertex, g.radius)) else { continue };
            let before = at.and_then(|i| i.checked_sub(1)).and_then(|i| g.past.get(i).copied().flatten());
            let velocity =
                before.map_or_else(Vector3::zeros, |b| (Vector3::from(target) - Vector3::from(b)) / self.h);
            let hand = Hold::hand(g.vertex, g.radius, target, velocity, g.hold);
            holds.push(Hold { flow: g.flowing, ..hand });
            own.push(index);
        }
        let (force, torque) = self.push;
        let frame = frame.as_mut().map(|frame| FrameStep { frame, force, torque });
        self.stepper.step_held(state, &mut holds, receiver.load(), frame);
        for (hold, &index) in holds[others.min(holds.len())..].iter().zip(&own) {
            self.grabs[index].reaction = (-hold.pull).into();
            self.grabs[index].flowing = hold.flow;
        }
        self.own = own;
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
        self.pose_blend.advance();
        if let (Some(old), Some(new)) = (self.frame, receiver.pose()) {
            let model = self.stepper.model();
            let mut old = old;
            // Where the copy would have been by now.
            let zero = Vector3::zeros();
            RigidMotion::predict(&mut old, model, self.h, zero, zero, zero);
            self.pose_blend.add(&Pose::of_frame(model, &old), &new);
            self.frame = new.frame(model);
        }
        self.show();
        // From here on the confirmed state is followed without new offsets.
        let offset = self.shown.q.iter().zip(&new.q).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let size = new.q.iter().fold(1e-12_f64, |m, q| m.max(q.abs()));
        self.active = offset > 1e-6 * size || !self.pose_blend.is_empty();
    }

    fn show(&mut self) {
        self.shown.copy_from(&self.state);
        self.blend.apply(&mut self.shown.q, &mut self.shown.v);
        let pose = self.frame.map(|frame| Pose::of_frame(self.stepper.model(), &frame));
        self.pose = pose.map(|pose| self.pose_blend.apply(&pose));
    }
}
