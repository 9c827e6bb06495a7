//! The host's encoder: one for all receivers of a body that take the same stream.
//!
//! The encoder keeps a copy of the receiver's state (the *mirror*) and quantizes in a closed loop:
//! each frame is chosen so that the mirror, which uses only sent data, meets the true state.
//! Rounding errors therefore do not add up.

use std::collections::VecDeque;
use std::sync::Arc;

use nalgebra::Vector3;
use pliant_modal::{Frame, ModalModel, StepSettings};

use crate::codec::checksum::checksum;
use crate::codec::quantization::Quanta;
use crate::newmark::{Newmark, ViscoelasticFilter};
use crate::prediction::{BodyCopy, HandState};
use crate::replica::{self, Replica};
use crate::state::{BodyId, GrabKey, GrabState, RigidState, Tick, TickState};
use crate::wire::{
    AccelerationCoding, Accelerations, FrameGrab, MAX_PARTS, Payload, Repeat, RepeatGrab, Slice, SliceEntry,
    SnapshotBytes, StreamSubscription, TickFrame, Writer, round24,
};
use crate::{StreamError, Surroundings};

/// Number of ticks whose frames are kept for resending.
pub(crate) const SENT: usize = 256;
/// Ticks between checksums.
const CHECK_EVERY: u64 = 8;
/// The encoder starts to send loads when their static effect first exceeds this share of the shape.
const LOAD_FLOOR: f64 = 2e-2;
/// Time constant of the estimate of the unexplained load, ticks.
const LOAD_TICKS: f64 = 8.0;
/// Ticks between updates of that estimate. Each update costs an extra step of the model.
const LOAD_EVERY: u64 = 4;

/// Displacement of the surface by one quantization step, as a share of the body's deformation.
pub(crate) const QUANTUM: f64 = 1.0 / 16_384.0;
/// Acceleration streams use steps finer by this factor, because prediction multiplies their
/// rounding error and the receiver integrates it twice.
const FINER: f64 = 64.0;
/// Decay of the remembered deformation per tick.
const VISIBLE_KEEP: f64 = 0.98;

/// The frames that were sent for a tick, kept for repeats and resending.
#[derive(Debug, Clone)]
struct Sent {
    tick: Tick,
    /// The frames without repeats, marked as resent. More than one if the grabs did not fit in one
    /// frame.
    frames: Vec<TickFrame>,
}

impl Sent {
    fn grabs(&self) -> impl Iterator<Item = &FrameGrab> {
        self.frames.iter().flat_map(|f| &f.grabs)
    }
}

/// The encoded frames of a tick without datagram headers. One frame, unless the grabs do not fit.
#[derive(Debug, Clone)]
pub struct Encoded {
    /// The frame, or its first part.
    pub first: Arc<[u8]>,
    /// The other parts.
    pub more: Vec<Arc<[u8]>>,
    /// True when the set of grabs changed at this tick. No forecast can predict such a change, so
    /// the frame is worth sending more than once.
    pub events: bool,
}

impl Encoded {
    /// The bytes of all frames, one item per datagram.
    pub fn all(&self) -> impl Iterator<Item = &Arc<[u8]>> {
        std::iter::once(&self.first).chain(&self.more)
    }
}

/// Encodes one body for one stream subscription.
#[derive(Debug)]
pub struct Encoder {
    body: BodyId,
    subscription: StreamSubscription,
    modes: usize,
    limit: usize,
    newmark: Newmark,
    /// Filter by which receivers of accelerations compute the viscoelastic state, if the body
    /// relaxes.
    viscoelastic: Option<ViscoelasticFilter>,
    replica: Replica,
    /// The receiver's copy, and the true state.
    mirror: BodyCopy,
    truth: BodyCopy,
    /// The pose of a free body at the last tick, as it was sent.
    pose: Option<RigidState>,
    load: Vec<f64>,
    unexplained: Vec<f64>,
    loaded: bool,
    next_slice: usize,
    frames: u64,
    started: Option<Tick>,
    last: Tick,
    sent: VecDeque<Sent>,
    scratch: Vec<f64>,
    quanta: Quanta,
    /// Displacement of the surface by one quantization step, as a share of the body's deformation.
    quantum: f64,
    /// Deformation of the body that sets the size of the quantization steps, m.
    visible: f64,
    chosen: Vec<u16>,
    wrong: Vec<(f64, u16)>,
    entries: Vec<SliceEntry>,
}

impl Encoder {
    /// Creates an encoder for the first `subscription.modes` modes of a model. Datagrams have at
    /// most `limit` bytes, including the 3 bytes of the header.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] when not even one mode fits or `newmark` is out of range,
    /// and [`StreamError::Model`] for an unusable model.
    pub fn new(
        body: BodyId,
        model: Arc<ModalModel>,
        settings: &StepSettings,
        newmark: Newmark,
        subscription: StreamSubscription,
        limit: usize,
    ) -> Result<Self, StreamError> {
        let visible = Quanta::visible_of(&model, Self::modes_for(&subscription, model.mode_count(), limit));
        Self::with_visible(body, model, settings, newmark, subscription, limit, &visible)
    }

    /// As [`Encoder::new`], with the visible amplitudes of at least as many modes as the stream
    /// carries.
    pub(crate) fn with_visible(
        body: BodyId,
        model: Arc<ModalModel>,
        settings: &StepSettings,
        newmark: Newmark,
        subscription: StreamSubscription,
        limit: usize,
        visible: &[f64],
    ) -> Result<Self, StreamError> {
        newmark.check()?;
        let modes = Self::modes_for(&subscription, model.mode_count(), limit);
        if modes == 0 {
            return Err(StreamError::Config {
                what: "datagram size",
                found: limit.to_string(),
                expected: "room for a frame with one mode",
            });
        }
        let visible = &visible[..modes.min(visible.len())];
        let quanta = Quanta::of_visible(&model, visible, settings.stiffness_scale, &newmark);
        let replica = Replica::new(model, *settings, modes, newmark.h)?;
        let rest = replica.kernel().at_rest();
        let viscoelastic = settings.relaxation.map(|r| ViscoelasticFilter::new(r, &newmark, 0));
        Ok(Self {
            viscoelastic,
            body,
            subscription,
            modes,
            limit,
            newmark,
            replica,
            mirror: BodyCopy::new(rest.clone()),
            truth: BodyCopy::new(rest),
            pose: None,
            load: vec![0.0; modes],
            unexplained: vec![0.0; modes],
            loaded: false,
            next_slice: 0,
            frames: 0,
            started: None,
            last: 0,
            sent: VecDeque::with_capacity(SENT),
            scratch: Vec::new(),
            quanta,
            quantum: QUANTUM,
            visible: 0.0,
            chosen: Vec::new(),
            wrong: Vec::new(),
            entries: Vec::new(),
        })
    }

    /// Sets the displacement of the surface by one quantization step, as a share of the body's
    /// deformation. See [`crate::HostSessionConfig::quantum`].
    #[must_use]
    pub fn with_quantum(mut self, share: f64) -> Self {
        self.quantum = if share.is_finite() { share.clamp(1e-9, 0.1) } else { QUANTUM };
        self
    }

    /// Lets the receiver's copy touch what stands around the body, as receivers do
    /// ([`Receiver::among`](crate::recovery::Receiver::among)).
    ///
    /// # Errors
    /// Returns the errors of [`Surroundings::check`].
    pub fn among(mut self, around: &Surroundings) -> Result<Self, StreamError> {
        if self.subscription.payload == Payload::Forces {
            self.replica.set_surroundings(around)?;
        }
        Ok(self)
    }

    /// Number of modes that a stream carries. The limits are the subscription, the model and, for
    /// accelerations, the room in one datagram beside four grabs and a pose.
    pub fn modes_for(subscription: &StreamSubscription, model_modes: usize, limit: usize) -> usize {
        let wanted = usize::from(subscription.modes).min(model_modes);
        match subscription.payload {
            Payload::Forces => wanted,
            Payload::Accelerations(coding) => {
                let fixed = 3 + 12 + 4 * 34 + 46 + 7 + 4 + 1;
                wanted.min(limit.saturating_sub(fixed) / coding.bytes_per_mode())
            }
        }
    }

    /// Number of modes that the stream carries.
    pub fn modes(&self) -> usize {
        self.modes
    }

    /// The state of a receiver that got all frames up to the last tick.
    pub fn snapshot(&self, resting: bool) -> SnapshotBytes {
        SnapshotBytes {
            body: self.body.0,
            tick: self.last,
            q: self.mirror.state.q.clone(),
            v: self.mirror.state.v.clone(),
            a: self.mirror.state.a.clone(),
            z: self.mirror.state.z.clone(),
            load: if self.load.iter().any(|x| *x != 0.0) { self.load.clone() } else { Vec::new() },
            means: self
                .mirror
                .hands
                .iter()
                .map(|hand| (hand.key.user.0, hand.key.grab, hand.mean.into()))
                .collect(),
            contacts: self.mirror.contacts.clone(),
            pose: self.pose,
            resting,
        }
    }

    /// The frames of a tick for resending. Empty when the encoder does not keep that tick any more.
    pub fn resend(&self, tick: Tick) -> impl Iterator<Item = Arc<[u8]>> + '_ {
        let index = self.sent.front().and_then(|s| usize::try_from(tick.checked_sub(s.tick)?).ok());
        let sent = index.and_then(|index| self.sent.get(index)).filter(|s| s.tick == tick);
        sent.into_iter().flat_map(|s| &s.frames).map(write)
    }

    /// Takes over the true state as it is. The next frame begins a new run, and receivers need a
    /// [`Encoder::snapshot`]. The contacts of the last step go on.
    pub fn restart(&mut self, state: &TickState<'_>) {
        self.pose = state.pose.map(RigidState::rounded);
        if let Some(pose) = self.pose.as_mut().filter(|_| state.resting) {
            (pose.linear, pose.angular) = ([0.0; 3], [0.0; 3]);
        }
        replica::place(&mut self.mirror.state, self.replica.model(), self.pose.as_ref());
        let mirror = &mut self.mirror;
        replica::fill(&mut mirror.state, [state.q, state.v, state.a, state.z]);
        if state.resting {
            mirror.state.v.fill(0.0);
            mirror.state.a.fill(0.0);
        }
        // The mean forces over the last step are unknown. The current reactions are close to them
        // for hands that change slowly.
        mirror.hands.clear();
        let hand = |g: &GrabState| HandState::of_mean(g.key, -Vector3::from(g.reaction));
        mirror.hands.extend(state.grabs.iter().map(hand));
        self.truth.clone_from(mirror);
        self.load.fill(0.0);
        self.unexplained.fill(0.0);
        self.loaded = false;
        self.sent.clear();
        self.started = Some(state.tick);
        self.last = state.tick;
    }

    /// Begins a new run with the next frame, after `tick`. The mirror stays as it is.
    pub fn begin_run(&mut self, tick: Tick) {
        self.sent.clear();
        self.started = Some(tick);
        self.last = tick;
    }

    /// Forgets what was sent, when nobody receives the stream any more. The patches of hands stay.
    pub(crate) fn retire(&mut self) {
        self.sent.clear();
        self.started = None;
    }

    /// The last tick that was encoded.
    pub(crate) fn last(&self) -> Tick {
        self.last
    }

    /// Returns true before the first [`Encoder::restart`], and after it has been retired.
    pub fn is_fresh(&self) -> bool {
        self.started.is_none()
    }

    /// Encodes the tick after the last one. The bytes have no datagram header yet.
    pub fn encode(&mut self, state: &TickState<'_>) -> Encoded {
        self.pose = state.pose.map(RigidState::rounded);
        let frame = self.replica.end_frame(&self.mirror, self.pose.as_ref());
        let forces = self.subscription.payload == Payload::Forces;
        let grabs: Vec<FrameGrab> = state
            .grabs
            .iter()
            .map(|g| {
                let radius = f64::from(g.radius as f32);
                let displacement = if forces {
                    self.replica.displacement(&state.q[..self.modes.min(state.q.len())], g.vertex, radius)
                } else {
                    [0.0; 3]
                };
                let state = GrabState {
                    radius,
                    target: g.target.map(|x| f64::from(x as f32)),
                    reaction: g.reaction.map(round24),
                    hold: g.hold.capped(),
                    ..*g
                };
                FrameGrab { state, displacement: displacement.map(round24), held: true }
            })
            .collect();
        let unit = self.unit(state);
        let accelerations = match self.subscription.payload {
            Payload::Accelerations(coding) => Some(self.step_accelerations(coding, state, unit)),
            Payload::Forces => {
                self.step_forces(&grabs, state, frame);
                None
            }
        };
        replica::fill(&mut self.truth.state, [state.q, state.v, state.a, state.z]);
        self.truth.state.frame = self.mirror.state.frame;
        let run = state.tick - self.started.unwrap_or(state.tick) - 1;
        let mut frame = TickFrame {
            body: self.body,
            tick: state.tick,
            run: u16::try_from(run).unwrap_or(u16::MAX),
            resting: state.resting,
            resent: false,
            displacements: forces,
            part: None,
            grabs,
            pose: state.pose,
            accelerations,
            slice: None,
            check: None,
            repeats: Vec::new(),
        };
        let check = state.tick.is_multiple_of(CHECK_EVERY);
        let room = if check { self.limit - 4 } else { self.limit };
        let parts = self.split(&mut frame, room);
        if parts.is_empty() {
            self.repeat(&mut frame);
            while 3 + frame.bytes() > room && frame.repeats.pop().is_some() {}
        }
        self.refresh(&mut frame, state, unit, room);
        if frame.repeats.is_empty() {
            // Grabs that ended within the repeated ticks are listed for the repeats only.
            frame.grabs.retain(|g| g.held);
        }
        if check {
            frame.check = Some(checksum(state.tick, &self.mirror.state) as f32);
        }
        let held = || frame.grabs.iter().filter(|g| g.held).map(|g| g.state.key);
        let held = held().chain(parts.iter().flat_map(|p| p.grabs.iter().map(|g| g.state.key)));
        let events = self.sent.back().is_some_and(|last| !held.eq(last.grabs().map(|g| g.state.key)));
        let first = write(&frame);
        let more = parts.iter().map(write).collect();
        self.keep(frame, parts);
        self.last = state.tick;
        self.frames += 1;
        Encoded { first, more, events }
    }

    /// Displacement of the surface by one quantization step, m: a share of the current or expected
    /// deformation. It decays slowly.
    fn unit(&mut self, state: &TickState<'_>) -> f32 {
        let count = self.modes.min(state.q.len());
        let now = self.quanta.visible(&state.q[..count], &state.v[..count]);
        self.visible = now.max(self.visible * VISIBLE_KEEP);
        let finer = if self.subscription.payload == Payload::Forces { 1.0 } else { FINER };
        let share = self.quantum / finer;
        let unit = (self.visible * share) as f32;
        if unit.is_finite() { unit.clamp(1e-30, 1e6) } else { 1e6 }
    }

    /// Moves the grabs that do not fit out of a frame, into parts of their own.
    fn split(&self, frame: &mut TickFrame, room: usize) -> Vec<TickFrame> {
        let mut parts: Vec<TickFrame> = Vec::new();
        if 3 + frame.bytes() <= room {
            return parts;
        }
        let blank = TickFrame { grabs: Vec::new(), pose: None, accelerations: None, ..frame.clone() };
        let mut rest = std::mem::take(&mut frame.grabs).into_iter();
        // 5 bytes: the header of 3 bytes, and the part number and count that are not in any frame
        // yet.
        let fill = |into: &mut TickFrame, rest: &mut std::vec::IntoIter<FrameGrab>| {
            while let Some(g) = rest.as_slice().first()
                && 5 + into.bytes() + into.grab_bytes(g) <= room
            {
                into.grabs.extend(rest.next());
            }
        };
        fill(frame, &mut rest);
        while rest.len() > 0 && parts.len() + 1 < usize::from(MAX_PARTS) {
            let mut part = blank.clone();
            fill(&mut part, &mut rest);
            parts.push(part);
        }
        let of = parts.len() as u8 + 1;
        if of > 1 {
            for (which, part) in std::iter::once(frame).chain(&mut parts).enumerate() {
                part.part = Some((which as u8, of));
            }
        }
        parts
    }

    fn keep(&mut self, mut frame: TickFrame, parts: Vec<TickFrame>) {
        frame.repeats.clear();
        frame.grabs.retain(|g| g.held);
        let tick = frame.tick;
        let mut frames = if self.sent.len() >= SENT {
            // This reuses the allocation of the oldest entry.
            self.sent.pop_front().map(|s| s.frames).unwrap_or_default()
        } else {
            Vec::new()
        };
        frames.clear();
        frames.push(frame);
        frames.extend(parts);
        frames.iter_mut().for_each(|f| f.resent = true);
        self.sent.push_back(Sent { tick, frames });
    }

    /// Steps the mirror with accelerations chosen so that the mirror meets the true state.
    fn step_accelerations(
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
    fn step_forces(&mut self, grabs: &[FrameGrab], state: &TickState<'_>, frame: Option<Frame>) {
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

    /// Adds absolute state to the frame and applies it to the mirror. The slice contains the modes
    /// with the largest error in the mirror, and some modes in turn for receivers that missed
    /// frames.
    fn refresh(&mut self, frame: &mut TickFrame, state: &TickState<'_>, unit: f32, room: usize) {
        if self.subscription.refresh == 0 {
            return;
        }
        let share = self.modes.div_ceil(usize::from(self.subscription.refresh)).min(255);
        let truth = |slice: &[f64], k: usize| slice.get(k).copied().unwrap_or(0.0);
        // A third of the modes is chosen in turn. The rest have the largest error in the mirror,
        // where a velocity error counts as the displacement that it leads to.
        let turn = share.div_ceil(3);
        let (first, modes) = (self.next_slice, self.modes);
        let in_turn = |k: usize| (k + modes - first) % modes < turn;
        self.chosen.clear();
        self.chosen.extend((0..turn).map(|i| ((first + i) % modes) as u16));
        self.wrong.clear();
        for k in (0..modes).filter(|k| !in_turn(*k)) {
            let eq = (truth(state.q, k) - self.mirror.state.q[k]).abs() / self.quanta.place[k];
            let ev = (truth(state.v, k) - self.mirror.state.v[k]).abs() / self.quanta.speed[k];
            let ez = self
                .mirror
                .state
                .z
                .get(k)
                .map_or(0.0, |z| (truth(state.z, k) - z).abs() / self.quanta.place[k]);
            self.wrong.push((eq + ev + ez, k as u16));
        }
        let most = (share - turn).min(self.wrong.len());
        if most > 0 && most < self.wrong.len() {
            self.wrong.select_nth_unstable_by(most - 1, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        }
        self.chosen.extend(self.wrong.iter().take(most).map(|w| w.1));
        let entry = |&mode: &u16| {
            let k = usize::from(mode);
            let load = if self.loaded { self.unexplained[k] } else { 0.0 };
            SliceEntry { mode: k, q: truth(state.q, k), v: truth(state.v, k), load, z: truth(state.z, k) }
        };
        self.entries.clear();
        self.entries.extend(self.chosen.iter().map(entry));
        let viscoelastic = !self.mirror.state.z.is_empty();
        let mut slice = Slice::quantize(&self.entries, unit, self.loaded, viscoelastic, &self.quanta);
        let mut count = slice.steps.len();
        while count > 0 && 3 + frame.bytes() + slice.bytes_of(count) > room {
            // Remove modes first, then repeats.
            if count > share.div_ceil(4) {
                count -= 1;
            } else if frame.repeats.pop().is_some() {
                count = slice.steps.len();
            } else {
                count -= 1;
            }
        }
        if count == 0 {
            return;
        }
        slice.steps.truncate(count);
        self.next_slice = (first + turn.min(count)) % modes;
        for e in slice.entries(&self.quanta) {
            self.mirror.state.q[e.mode] = e.q;
            self.mirror.state.v[e.mode] = e.v;
            self.load[e.mode] = e.load;
            if let Some(z) = self.mirror.state.z.get_mut(e.mode) {
                *z = e.z;
            }
        }
        frame.slice = Some(slice);
    }

    /// Repeats the last ticks in the frame and lists the grabs that ended within them.
    fn repeat(&mut self, frame: &mut TickFrame) {
        for sent in self.sent.iter().rev().take(usize::from(self.subscription.repeats)) {
            let Ok(back) = u8::try_from(frame.tick - sent.tick) else { break };
            let mut grabs = Vec::with_capacity(sent.frames.first().map_or(0, |f| f.grabs.len()));
            for g in sent.grabs() {
                let Some(index) = find_or_add(&mut frame.grabs, g) else { continue };
                grabs.push(RepeatGrab { index, reaction: g.state.reaction, displacement: g.displacement });
            }
            let accelerations = sent.frames.first().and_then(|f| f.accelerations.clone());
            frame.repeats.push(Repeat { back, grabs, accelerations });
        }
    }
}

fn find_or_add(grabs: &mut Vec<FrameGrab>, wanted: &FrameGrab) -> Option<u8> {
    let key: GrabKey = wanted.state.key;
    let index = match grabs.iter().position(|g| g.state.key == key) {
        Some(i) => i,
        None if grabs.len() < crate::state::MAX_GRABS => {
            grabs.push(FrameGrab { held: false, ..*wanted });
            grabs.len() - 1
        }
        None => return None,
    };
    u8::try_from(index).ok()
}

fn write(frame: &TickFrame) -> Arc<[u8]> {
    let mut w = Writer::with_capacity(frame.bytes());
    frame.encode(&mut w);
    w.into_bytes().into()
}
