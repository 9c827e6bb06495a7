//! The host's encoder: one for all receivers of a body that take the same stream.
//!
//! The encoder keeps a copy of the receiver's state (the *mirror*) and quantizes in a closed loop:
//! each frame is chosen so that the mirror, which uses only sent data, meets the true state.
//! Rounding errors therefore do not add up.

mod mirror;
mod packing;

use std::collections::VecDeque;
use std::sync::Arc;

use nalgebra::Vector3;
use pliant_modal::{ModalModel, StepSettings};

use crate::codec::checksum::checksum;
use crate::codec::quantization::Quanta;
use crate::newmark::{Newmark, ViscoelasticFilter};
use crate::prediction::{BodyCopy, HandState};
use crate::replica::{self, Replica};
use crate::state::{BodyId, GrabState, RigidState, Tick, TickState};
use crate::wire::{
    FrameGrab, Payload, SliceEntry, SnapshotBytes, StreamSubscription, TickFrame, Writer, round24,
};
use crate::{StreamError, Surroundings};

/// Number of ticks whose frames are kept for resending.
pub(crate) const SENT: usize = 256;
/// Ticks between checksums.
const CHECK_EVERY: u64 = 8;

/// Displacement of the surface by one quantization step, as a share of the body's deformation.
pub(crate) const QUANTUM: f64 = 1.0 / 16_384.0;

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
}

fn write(frame: &TickFrame) -> Arc<[u8]> {
    let mut w = Writer::with_capacity(frame.bytes());
    frame.encode(&mut w);
    w.into_bytes().into()
}
