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
use pliant_modal::{Frame, GrabConfig, Hand, Hold, Load, RigidMotion};

use crate::recovery::{Blend, Forecast, PoseBlend, Receiver};
use crate::replica::{self, Mean, Replica};
use crate::state::{GrabKey, Pose, State, Tick, UserId};

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
pub struct PredictedHand {
    replica: Replica,
    grabs: Vec<OwnGrab>,
    lead: usize,
    votes: u32,
    tick: Tick,
    active: bool,
    state: State,
    /// The forces over the last step of all hands of `state`, N, world axes.
    means: Vec<Mean>,
    expected: State,
    visual: State,
    blend: Blend,
    /// The confirmed frame of the tick before, where the body is free.
    last_frame: Option<Frame>,
    pose: Option<Pose>,
    pose_blend: PoseBlend,
    /// Force and torque on the frame that nothing told explains, world axes.
    push: (Vector3<f64>, Vector3<f64>),
    forecast: Forecast,
    fade: f64,
    hands: Vec<Hand>,
    keys: Vec<GrabKey>,
    own: Vec<usize>,
}

impl PredictedHand {
    pub(crate) fn new(replica: Replica, blend_ticks: u16) -> Self {
        let (rest, h) = (replica.kernel().at_rest(), replica.kernel().h());
        Self {
            replica,
            grabs: Vec::new(),
            lead: 0,
            votes: 0,
            tick: 0,
            active: false,
            state: rest.clone(),
            means: Vec::new(),
            expected: rest.clone(),
            visual: rest,
            blend: Blend::new(h, blend_ticks),
            last_frame: None,
            pose: None,
            pose_blend: PoseBlend::new(h, blend_ticks),
            push: (Vector3::zeros(), Vector3::zeros()),
            forecast: Forecast::new(h),
            fade: (-3.0 / f64::from(blend_ticks.max(1))).exp(),
            hands: Vec::new(),
            keys: Vec::new(),
            own: Vec::new(),
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
    pub fn visual(&self) -> &State {
        &self.visual
    }

    /// The rigid frame that belongs to [`PredictedHand::shown`], where the body is free.
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

    /// The rigid frame of a copy, where the body is free.
    fn frame_of(&self, state: &State) -> Option<Frame> {
        self.replica.model().is_free().then_some(state.frame)
    }

    /// A tick of the confirmed state has passed. `guess`: the lead to begin with, ticks.
    pub(crate) fn step(&mut self, receiver: &Receiver, user: UserId, guess: usize) {
        let confirmed_frame = receiver.frame().and_then(|p| p.frame(self.replica.model()));
        if self.state.modes() != receiver.confirmed().modes()
            || self.replica.model().is_free() != confirmed_frame.is_some()
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
            self.take(receiver.visual());
            replica::place(&mut self.state, self.replica.model(), receiver.pose().as_ref());
            self.visual.clone_from(&self.state);
            self.blend.clear();
            self.pose_blend.clear();
        }
        self.vote(receiver, user);
        self.tick = confirmed + self.lead as u64;

        // What the copy would have become, had nothing new been learnt.
        let mut expected = std::mem::take(&mut self.expected);
        expected.clone_from(&self.state);
        let mut means = std::mem::take(&mut self.means);
        self.one_step(&mut expected, &mut means, receiver, user, self.lead);
        for g in &mut self.grabs {
            g.would = g.reaction;
        }

        let mut state = std::mem::take(&mut self.state);
        state.clone_from(receiver.confirmed());
        if let Some(frame) = confirmed_frame {
            state.frame = frame;
        }
        for g in &mut self.grabs {
            g.flowing = g.flow;
            let key = GrabKey { user, grab: g.grab };
            let told = receiver.grabs().iter().find(|told| told.key == key);
            g.reaction = told.map_or(g.reaction, |told| told.reaction);
        }
        means.clear();
        means.extend_from_slice(receiver.means());
        for j in 1..=self.lead {
            self.one_step(&mut state, &mut means, receiver, user, j);
        }
        self.means = means;
        self.blend.advance();
        self.blend.add(
            expected.q.iter().zip(&state.q).map(|(e, s)| e - s),
            expected.v.iter().zip(&state.v).map(|(e, s)| e - s),
        );
        self.pose_blend.advance();
        if self.replica.model().is_free() {
            let model = self.replica.model();
            let (expected, now) = (&expected.frame, &state.frame);
            self.pose_blend.add(&Pose::of_frame(model, expected), &Pose::of_frame(model, now));
        }
        for g in &mut self.grabs {
            for ((offset, would), now) in g.offset.iter_mut().zip(g.would).zip(g.reaction) {
                *offset = self.fade * (*offset + would - now);
            }
        }
        self.state = state;
        self.expected = expected;
        self.show();
    }

    /// What pushes the frame of a free body besides gravity and the hands that the stream tells of (contacts): from the last
    /// two confirmed ticks, smoothed.
    fn learn_push(&mut self, receiver: &Receiver, now: Option<Frame>) {
        let last = std::mem::replace(&mut self.last_frame, now);
        let (Some(mut from), Some(to)) = (last, now) else { return };
        let (model, h) = (self.replica.model().clone(), self.replica.kernel().h());
        let zero = Vector3::zeros();
        let gravity = Vector3::from(receiver.settings().gravity);
        let rigid = RigidMotion::predict(&mut from, &model, h, gravity, zero, zero);
        let (mut force, mut torque) = (zero, zero);
        let tick = receiver.tick();
        let mut patches = Vec::with_capacity(receiver.grabs().len());
        patches.extend(receiver.grabs().iter().map(|g| (g.key, g.vertex, g.radius)));
        for (key, vertex, radius) in patches {
            let Some(g) = receiver.history().grab(key, tick, &self.forecast) else { continue };
            let Some(patch) = self.replica.patch(vertex, radius) else { continue };
            let at = from.to_world(patch.rest() + Vector3::from(g.displacement));
            let arm = at - Vector3::from(from.center());
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
        if receiver.settings().relaxation.is_none() {
            return;
        }
        let turn = receiver.frame().and_then(|p| p.frame(self.replica.model())).unwrap_or_default();
        for g in &mut self.grabs {
            let key = GrabKey { user, grab: g.grab };
            if !receiver.means().iter().any(|(known, _)| *known == key) {
                continue;
            }
            let Some(patch) = self.replica.patch(g.vertex, g.radius) else { continue };
            let pull = turn.rotation().inverse() * replica::mean_of(receiver.means(), key);
            let hand = Hand { flow: g.flow, ..Hand::new(patch, Hold::Measured(Vector3::zeros())) };
            g.flow = self.replica.kernel().flow(&hand, pull);
        }
    }

    /// Steps to `j` ticks after the confirmed one, and leaves the own reactions in the grabs.
    fn one_step(
        &mut self,
        state: &mut State,
        means: &mut Vec<Mean>,
        receiver: &Receiver,
        user: UserId,
        j: usize,
    ) {
        let history = receiver.history();
        let (tick, h) = (receiver.tick() + j as u64, self.replica.kernel().h());
        let free = self.replica.model().is_free();
        let (mut hands, mut keys) = (std::mem::take(&mut self.hands), std::mem::take(&mut self.keys));
        hands.clear();
        keys.clear();
        for g in receiver.grabs().iter().filter(|g| g.key.user != user) {
            let Some(g) = history.grab(g.key, tick, &self.forecast) else { continue };
            let Some(mut hand) = self.replica.measured(&g) else { continue };
            hand.mean = replica::mean_of(means, g.state.key);
            if free {
                // The frame moves on from what is confirmed: the other's hand is where it goes, not where the patch was.
                let (velocity, config) = (Vector3::zeros(), GrabConfig::default());
                hand.hold = Hold::Target { target: g.state.target.into(), velocity, config };
            }
            hands.push(hand);
            keys.push(g.state.key);
        }
        let others = hands.len();
        let mut own = std::mem::take(&mut self.own);
        own.clear();
        for (index, g) in self.grabs.iter().enumerate() {
            // Newest is the target that arrives `lead` ticks after the confirmed one.
            let at = (g.past.len() + j).checked_sub(1 + self.lead);
            let target = at.and_then(|i| g.past.get(i).copied().flatten()).map(Vector3::from);
            let (Some(target), Some(patch)) = (target, self.replica.patch(g.vertex, g.radius)) else {
                continue;
            };
            let before = at.and_then(|i| i.checked_sub(1)).and_then(|i| g.past.get(i).copied().flatten());
            let velocity = before.map_or_else(Vector3::zeros, |b| (target - Vector3::from(b)) / h);
            let hold = Hold::Target { target, velocity, config: g.hold };
            let (key, pull) = (GrabKey { user, grab: g.grab }, -Vector3::from(g.reaction));
            let mean = replica::mean_of(means, key);
            hands.push(Hand { patch, hold, pull, mean, flow: g.flowing });
            keys.push(key);
            own.push(index);
        }
        let (force, torque) = self.push;
        let load = Load { modal: receiver.load(), force, torque, frame_is_given: false };
        self.replica.step(state, &mut hands, &load);
        for (hand, &index) in hands[others..].iter().zip(&own) {
            self.grabs[index].reaction = (-hand.pull).into();
            self.grabs[index].flowing = hand.flow;
        }
        means.clear();
        means.extend(keys.iter().copied().zip(hands.iter().map(|hand| hand.mean)));
        self.own = own;
        (self.hands, self.keys) = (hands, keys);
    }

    /// Takes a state over; the forces of the last step stay.
    fn take(&mut self, from: &State) {
        let (frame, f) = (self.state.frame, std::mem::take(&mut self.state.f));
        self.state.clone_from(from);
        (self.state.frame, self.state.f) = (frame, f);
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
        let new = receiver.visual();
        let h = self.replica.kernel().h();
        let old = &self.state;
        self.blend.add(
            (0..new.modes()).map(|k| old.q[k] + h * old.v[k] - new.q[k]),
            (0..new.modes()).map(|k| old.v[k] - new.v[k]),
        );
        self.pose_blend.advance();
        let mut old = self.state.frame;
        self.take(new);
        if let (true, Some(new)) = (self.replica.model().is_free(), receiver.pose()) {
            let model = self.replica.model();
            // Where the copy would have been by now.
            let zero = Vector3::zeros();
            RigidMotion::predict(&mut old, model, h, zero, zero, zero);
            self.pose_blend.add(&Pose::of_frame(model, &old), &new);
            replica::place(&mut self.state, model, Some(&new));
        }
        self.show();
        // From here on the confirmed state is followed without new offsets.
        let offset = self.visual.q.iter().zip(&new.q).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let size = new.q.iter().fold(1e-12_f64, |m, q| m.max(q.abs()));
        self.active = offset > 1e-6 * size || !self.pose_blend.is_empty();
    }

    fn show(&mut self) {
        self.visual.clone_from(&self.state);
        self.blend.apply(&mut self.visual.q, &mut self.visual.v);
        let pose = self.frame_of(&self.state).map(|frame| Pose::of_frame(self.replica.model(), &frame));
        self.pose = pose.map(|pose| self.pose_blend.apply(&pose));
    }
}
