//! Predicted hand: a guest's own hand does not wait for the round trip.
//!
//! The confirmed state of a body at a guest is old by the path from the host and the playout delay.
//! The targets of the guest's own hand reach the host after the path to the host. A reaction with
//! all these delays would be wrong for the hand that causes it. The guest therefore keeps a second,
//! newer copy of the body. The copy starts from the confirmed state and steps to the tick at which
//! the host will apply the hand's present target. The guest's own hands are at the targets that are
//! on their way, and the remote hands are at their extrapolated targets. At every tick the copy is
//! stepped again from the confirmed state (a step costs microseconds), and the resulting change
//! fades.
//!
//! The number of ticks to step ahead needs no clock: the host's frames say which target each hand
//! had, and the guest knows how many ticks ago it sent that target.

use std::collections::VecDeque;
use std::sync::Arc;

use nalgebra::Vector3;
use pliant_modal::{Frame, GrabConfig, Hand, HeldPlace, HeldShapes, Hold, Kernel, Load, RigidMotion};

use super::{BodyCopy, HandState, VisualCopy};
use crate::recovery::{Forecast, Receiver};
use crate::replica::{self, Replica};
use crate::state::{GrabKey, RigidState, State, Tick, UserId};

/// Number of targets remembered, which also bounds the lead, ticks.
const REMEMBERED: usize = 64;
/// Number of frames that must disagree with the lead before it changes.
const VOTES: u32 = 4;
/// Smoothing gain of the estimate of unexplained forces on a free body.
const LEARN: f64 = 0.25;

#[derive(Debug)]
struct PredictedGrab {
    grab: u16,
    vertex: u32,
    radius: f64,
    hold: GrabConfig,
    target: Option<[f64; 3]>,
    /// The target at each of the last ticks, newest last; `None` where the grab did not hold.
    past: VecDeque<Option<[f64; 3]>>,
    /// Force of the body on the hand, world, N.
    reaction: [f64; 3],
    /// The reaction that would follow without new information, world, N.
    would: [f64; 3],
    /// Viscoelastic state of the residual flexibility under the hand at the confirmed tick, body
    /// axes, m.
    viscoelastic: Vector3<f64>,
    offset: [f64; 3],
}

impl PredictedGrab {
    /// Takes the reaction from a copy that the grab has held.
    fn take_reaction(&mut self, copy: &BodyCopy, user: UserId) {
        if let Some(hand) = copy.hand(GrabKey { user, grab: self.grab }) {
            self.reaction = (-hand.pull).into();
        }
    }
}

/// A guest's newer copy of a body that the guest holds.
#[derive(Debug)]
pub struct PredictedHand {
    replica: Replica,
    grabs: Vec<PredictedGrab>,
    lead: usize,
    votes: u32,
    astray: bool,
    /// Largest change of a reaction by new information in the last step, N.
    surprise: f64,
    tick: Tick,
    active: bool,
    copy: BodyCopy,
    /// The copy that would follow without new information.
    expected: BodyCopy,
    visual: VisualCopy,
    /// The confirmed frame of the tick before, for a free body.
    last_frame: Option<Frame>,
    /// Force and torque on the frame that the stream does not explain, world axes.
    push: (Vector3<f64>, Vector3<f64>),
    forecast: Forecast,
    fade: f64,
    /// The own shapes of held patches that are taken with the next step.
    next_shapes: Option<Option<Arc<HeldShapes>>>,
    /// The kernel without shapes, where `replica` has some.
    plain: Option<Kernel>,
    /// The modal force that steps with shapes lack, and scratch.
    load: Vec<f64>,
    force: Vec<f64>,
    /// The columns of held patches at the confirmed tick, in the shown state, and scratch.
    confirmed_columns: Vec<f64>,
    columns: Vec<f64>,
    settled: State,
    /// The held patches and where they are in the shown state.
    places: Vec<HeldPlace>,
}

impl PredictedHand {
    pub(crate) fn new(replica: Replica, blend_ticks: u16) -> Self {
        let (rest, h) = (replica.kernel().at_rest(), replica.kernel().h());
        Self {
            grabs: Vec::new(),
            lead: 0,
            votes: 0,
            astray: false,
            surprise: 0.0,
            tick: 0,
            active: false,
            copy: BodyCopy::new(rest.clone()),
            expected: BodyCopy::new(rest.clone()),
            visual: VisualCopy::new(replica.model(), rest, h, blend_ticks),
            replica,
            last_frame: None,
            push: (Vector3::zeros(), Vector3::zeros()),
            forecast: Forecast::new(h),
            fade: (-3.0 / f64::from(blend_ticks.max(1))).exp(),
            next_shapes: None,
            plain: None,
            load: Vec::new(),
            force: Vec::new(),
            confirmed_columns: Vec::new(),
            columns: Vec::new(),
            settled: State::default(),
            places: Vec::new(),
        }
    }

    /// Sets the own shapes of the patches that hands hold on the body, from the next step on.
    /// What that changes in the hands and in the shown state fades in.
    pub(crate) fn set_held_shapes(&mut self, shapes: Option<Arc<HeldShapes>>) {
        self.next_shapes = Some(shapes);
    }

    /// Takes the shapes that were set.
    fn take_shapes(&mut self) {
        let Some(shapes) = self.next_shapes.take() else { return };
        self.confirmed_columns.clear();
        self.columns.clear();
        self.replica.set_held_shapes(shapes);
        if self.held_shapes().is_none() {
            self.plain = None;
        } else if self.plain.is_none() {
            let kernel = self.replica.kernel();
            let model = kernel.model().clone();
            self.plain = Kernel::new(model, *kernel.settings(), kernel.modes(), kernel.h()).ok();
        }
    }

    /// The own shapes of held patches that are used.
    pub(crate) fn held_shapes(&self) -> Option<&Arc<HeldShapes>> {
        self.replica.kernel().held_shapes()
    }

    /// Finds the columns of held patches in a copy at the confirmed tick, and the load of steps
    /// with them.
    ///
    /// The streamed load is what steps without columns lack, as receivers make them. Where the host
    /// has columns, it is mostly the elastic force of these. Steps with columns lack as much less.
    fn equilibrate_columns(&mut self, copy: &mut BodyCopy, receiver: &Receiver) {
        self.load.clear();
        self.load.extend_from_slice(receiver.load());
        let Some(plain) = &self.plain else {
            copy.state.s.clear();
            return;
        };
        copy.state.s.clone_from(&self.confirmed_columns);
        let held = receiver.grabs().iter().map(|g| (g.vertex, g.radius, g.reaction));
        self.replica.equilibrate_columns(&mut copy.state, held);
        self.confirmed_columns.clone_from(&copy.state.s);
        self.force.resize(self.load.len(), 0.0);
        for (kernel, sign) in [(self.replica.kernel(), 1.0), (plain, -1.0)] {
            kernel.elastic_force(&copy.state, &mut self.force);
            self.load.iter_mut().zip(&self.force).for_each(|(load, force)| *load += sign * force);
        }
    }

    /// The columns of held patches in the shown state.
    pub(crate) fn columns(&self) -> &[f64] {
        &self.columns
    }

    /// The patches of the guest's own hands.
    pub(crate) fn patches(&self) -> impl Iterator<Item = (u32, f64)> + '_ {
        self.grabs.iter().filter(|g| g.target.is_some()).map(|g| (g.vertex, g.radius))
    }

    /// Where a held patch is in the shown state. A hand that has just come is at rest.
    pub(crate) fn place(&self, vertex: u32, radius: f64) -> HeldPlace {
        let own = self.places.iter().find(|place| (place.vertex, place.radius) == (vertex, radius));
        own.copied().unwrap_or(HeldPlace { vertex, radius, displacement: [0.0; 3] })
    }

    /// Finds the columns of held patches in the shown state. The last ones are the first guess.
    fn find_columns(&mut self, receiver: &Receiver, user: UserId) {
        self.places.clear();
        let kernel = self.replica.kernel();
        if !kernel.settings().is_reduced(kernel.model()) {
            return;
        }
        self.settled.clone_from(if self.active { &self.visual.state } else { receiver.visual() });
        if self.settled.modes() != kernel.modes() {
            return;
        }
        self.settled.s.clone_from(&self.columns);
        let active = self.active;
        let others = receiver.grabs().iter().filter(|g| !active || g.key.user != user);
        let others = others.map(|g| (g.vertex, g.radius, g.reaction));
        let own = self.grabs.iter().filter(|g| active && g.target.is_some());
        let own = own.map(|g| (g.vertex, g.radius, std::array::from_fn(|k| g.reaction[k] + g.offset[k])));
        let held: Vec<(u32, f64, [f64; 3])> = others.chain(own).collect();
        if self.held_shapes().is_some() {
            self.replica.equilibrate_columns(&mut self.settled, held.iter().copied());
            self.columns.clone_from(&self.settled.s);
        }
        let replica = &mut self.replica;
        let place = |&(vertex, radius, _): &(u32, f64, _)| replica.held_place(&self.settled, vertex, radius);
        self.places.extend(held.iter().filter_map(place));
    }

    /// The tick of the copy: the host's tick when the present target will reach the host.
    pub fn tick(&self) -> Tick {
        self.tick
    }

    /// Number of ticks by which the copy is ahead of the confirmed state.
    pub fn lead(&self) -> usize {
        self.lead
    }

    /// The visual state for the user who holds the body. It is continuous in position and velocity.
    pub fn visual(&self) -> &State {
        &self.visual.state
    }

    /// The rigid frame that belongs to [`PredictedHand::visual`], for a free body.
    pub fn pose(&self) -> Option<RigidState> {
        self.visual.pose
    }

    /// The present reaction of one of the guest's own grabs, world, N.
    pub fn reaction(&self, grab: u16) -> Option<[f64; 3]> {
        let g = self.grabs.iter().find(|g| g.grab == grab && g.target.is_some())?;
        Some(std::array::from_fn(|k| g.reaction[k] + g.offset[k]))
    }

    /// Returns whether the host had a hand of this guest elsewhere than the guest sent it, at the
    /// confirmed tick: it leads the hand back after a hitch, or has lost targets.
    pub(crate) fn is_astray(&self) -> bool {
        self.astray
    }

    /// Largest change of a reaction of the guest's own hands by the last frames, N.
    pub(crate) fn surprise(&self) -> f64 {
        self.surprise
    }

    /// Returns false when the guest does not hold the body and no offset fades. The confirmed state
    /// is then shown.
    pub fn is_active(&self) -> bool {
        self.active
    }

    /// Takes over the grabs and the lead of another copy.
    pub(crate) fn take_grabs(&mut self, other: Self) {
        self.grabs = other.grabs;
        self.lead = other.lead;
    }

    pub(crate) fn begin(&mut self, grab: u16, vertex: u32, radius: f64, target: [f64; 3], hold: GrabConfig) {
        self.grabs.retain(|g| g.grab != grab);
        self.grabs.push(PredictedGrab {
            grab,
            vertex,
            // The host's frames carry the radius in single precision.
            radius: f64::from(radius as f32),
            hold,
            target: Some(target),
            past: VecDeque::with_capacity(REMEMBERED),
            reaction: [0.0; 3],
            would: [0.0; 3],
            viscoelastic: Vector3::zeros(),
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

    /// Steps the copy after a tick of the confirmed state. `guess` is the initial lead, ticks.
    pub(crate) fn step(&mut self, receiver: &Receiver, user: UserId, guess: usize) {
        let confirmed_frame = receiver.frame().and_then(|p| p.frame(self.replica.model()));
        if self.copy.state.modes() != receiver.confirmed().modes()
            || self.replica.model().is_free() != confirmed_frame.is_some()
        {
            self.active = false;
            return;
        }
        self.learn_push(receiver, confirmed_frame);
        self.learn_viscoelastic(receiver, user);
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
            self.take_shapes();
            self.find_columns(receiver, user);
            self.tick = confirmed;
            return;
        }
        if !self.active {
            self.active = true;
            self.lead = guess.min(REMEMBERED - 1);
            self.take_shapes();
            self.take(receiver.visual());
            let mut copy = std::mem::take(&mut self.copy);
            replica::place(&mut copy.state, self.replica.model(), receiver.pose().as_ref());
            copy.contacts = receiver.contacts().cloned().unwrap_or_default();
            self.equilibrate_columns(&mut copy, receiver);
            self.copy = copy;
            self.visual.state.clone_from(&self.copy.state);
            self.visual.clear();
        }
        self.vote(receiver, user);
        self.tick = confirmed + self.lead as u64;

        // This is the copy that would have been reached without new information.
        let mut expected = std::mem::take(&mut self.expected);
        expected.clone_from(&self.copy);
        self.one_step(&mut expected, receiver, user, self.lead);
        for g in &mut self.grabs {
            let key = GrabKey { user, grab: g.grab };
            g.would = expected.hand(key).map_or(g.reaction, |hand| (-hand.pull).into());
        }

        self.take_shapes();
        let mut copy = std::mem::take(&mut self.copy);
        self.confirm(&mut copy, receiver, user, confirmed_frame);
        self.equilibrate_columns(&mut copy, receiver);
        for j in 1..=self.lead {
            self.one_step(&mut copy, receiver, user, j);
        }
        let model = self.replica.model();
        self.visual.advance();
        self.visual.add(model, &expected.state, &copy.state);
        self.visual.show(model, &copy.state);
        self.surprise = 0.0;
        for g in &mut self.grabs {
            g.take_reaction(&copy, user);
            let change = (Vector3::from(g.would) - Vector3::from(g.reaction)).norm();
            self.surprise = self.surprise.max(change);
            for ((offset, would), now) in g.offset.iter_mut().zip(g.would).zip(g.reaction) {
                *offset = self.fade * (*offset + would - now);
            }
        }
        (self.copy, self.expected) = (copy, expected);
        self.find_columns(receiver, user);
    }

    /// Returns a copy to the confirmed tick.
    fn confirm(&mut self, copy: &mut BodyCopy, receiver: &Receiver, user: UserId, frame: Option<Frame>) {
        copy.state.clone_from(receiver.confirmed());
        if let Some(frame) = frame {
            copy.state.frame = frame;
        }
        match receiver.contacts() {
            Some(contacts) => copy.contacts.clone_from(contacts),
            None => copy.contacts.forget(),
        }
        copy.hands.clear();
        copy.hands.extend_from_slice(receiver.hands());
        for g in &mut self.grabs {
            let key = GrabKey { user, grab: g.grab };
            if let Some(confirmed) = receiver.grabs().iter().find(|grab| grab.key == key) {
                g.reaction = confirmed.reaction;
            }
            // The target of the confirmed tick, from which the hand moves in the first step.
            let at = g.past.len().checked_sub(1 + self.lead);
            let target = at.and_then(|i| g.past.get(i).copied().flatten()).map(Vector3::from);
            let (mean, pull) = (copy.mean(key), -Vector3::from(g.reaction));
            copy.hands.retain(|hand| hand.key != key);
            copy.hands.push(HandState { key, pull, mean, target, viscoelastic: g.viscoelastic });
        }
    }

    /// Estimates what drives the frame of a free body besides gravity, the streamed hands and the
    /// contacts that the copy steps itself (other bodies, other loads), from the last two confirmed
    /// ticks, smoothed.
    fn learn_push(&mut self, receiver: &Receiver, now: Option<Frame>) {
        let last = std::mem::replace(&mut self.last_frame, now);
        let (Some(mut from), Some(to)) = (last, now) else { return };
        let (model, h) = (self.replica.model().clone(), self.replica.kernel().h());
        let zero = Vector3::zeros();
        let gravity = Vector3::from(receiver.settings().gravity);
        let rigid = RigidMotion::predict(&mut from, &model, h, gravity, zero, zero);
        let [mut force, mut torque] = receiver.contact_push();
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

    /// Advances the viscoelastic state under the guest's own hands by the confirmed forces, if the
    /// body relaxes.
    fn learn_viscoelastic(&mut self, receiver: &Receiver, user: UserId) {
        if receiver.settings().relaxation.is_none() {
            return;
        }
        let turn = receiver.frame().and_then(|p| p.frame(self.replica.model())).unwrap_or_default();
        for g in &mut self.grabs {
            let key = GrabKey { user, grab: g.grab };
            let Some(known) = receiver.hands().iter().find(|hand| hand.key == key) else { continue };
            let Some(patch) = self.replica.patch(g.vertex, g.radius) else { continue };
            let pull = turn.rotation().inverse() * known.mean;
            let hand =
                Hand { viscoelastic: g.viscoelastic, ..Hand::new(patch, Hold::Measured(Vector3::zeros())) };
            g.viscoelastic = self.replica.kernel().viscoelastic_after(&hand, pull);
        }
    }

    /// Steps a copy to `j` ticks after the confirmed tick.
    fn one_step(&mut self, copy: &mut BodyCopy, receiver: &Receiver, user: UserId, j: usize) {
        let history = receiver.history();
        let tick = receiver.tick() + j as u64;
        self.replica.release_all();
        for g in receiver.grabs().iter().filter(|g| g.key.user != user) {
            let at = |tick| history.grab(g.key, tick, &self.forecast);
            let Some(now) = at(tick) else { continue };
            self.replica.hold_streamed(copy, &now, at(tick - 1).as_ref());
        }
        for g in &self.grabs {
            // The newest target is the one that arrives `lead` ticks after the confirmed tick.
            let at = (g.past.len() + j).checked_sub(1 + self.lead);
            let Some(target) = at.and_then(|i| g.past.get(i).copied().flatten()) else { continue };
            let key = GrabKey { user, grab: g.grab };
            self.replica.hold_at(copy, key, (g.vertex, g.radius), target.into(), g.hold);
        }
        let (force, torque) = self.push;
        let load = Load { modal: &self.load, force, torque, ..Load::default() };
        self.replica.step_held(copy, &load);
    }

    /// Copies the state except its frame and the forces of the last step.
    fn take(&mut self, from: &State) {
        let state = &mut self.copy.state;
        let (frame, f) = (state.frame, std::mem::take(&mut state.f));
        state.clone_from(from);
        (state.frame, state.f) = (frame, f);
    }

    /// Finds how many ticks ago the guest sent the target that the host's frame of the confirmed
    /// tick shows.
    fn vote(&mut self, receiver: &Receiver, user: UserId) {
        let mut found = None;
        self.astray = false;
        for g in &self.grabs {
            let key = GrabKey { user, grab: g.grab };
            let Some(echo) = receiver.grabs().iter().find(|x| x.key == key) else { continue };
            let lags = g.past.iter().rev().enumerate().filter(|(_, t)| {
                t.is_some_and(|t| t.iter().zip(echo.target).all(|(a, b)| f64::from(*a as f32) == b))
            });
            let lag = lags.map(|(lag, _)| lag).min_by_key(|lag| lag.abs_diff(self.lead));
            self.astray |= lag != Some(self.lead);
            found = lag.or(found);
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

    /// Fades from the copy to the confirmed state, because the guest no longer holds the body.
    fn fall_back(&mut self, receiver: &Receiver) {
        self.visual.advance();
        let new = receiver.visual();
        let h = self.replica.kernel().h();
        // This is the copy that would have been reached by this tick.
        let mut old = self.copy.state.clone();
        old.q.iter_mut().zip(&old.v).for_each(|(q, v)| *q += h * v);
        self.take(new);
        let model = self.replica.model();
        if let (true, Some(pose)) = (model.is_free(), receiver.pose()) {
            let zero = Vector3::zeros();
            RigidMotion::predict(&mut old.frame, model, h, zero, zero, zero);
            replica::place(&mut self.copy.state, model, Some(&pose));
        }
        self.visual.add(model, &old, &self.copy.state);
        self.visual.show(model, &self.copy.state);
        // The confirmed state is tracked without new offsets from here on.
        let shown = &self.visual.state;
        let offset = shown.q.iter().zip(&new.q).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let size = new.q.iter().fold(1e-12_f64, |m, q| m.max(q.abs()));
        self.active = offset > 1e-6 * size || self.visual.is_turning();
    }
}
