//! The host's encoder: one for all receivers of a body that take the same stream.
//!
//! It carries the receiver's own step along (the *mirror*) and quantises in a closed loop: each frame is chosen so that
//! the mirror, which has only what was sent, meets the truth. Rounding therefore does not add up.

use std::collections::VecDeque;
use std::sync::Arc;

use pliant_modal::ModalModel;

use crate::StreamError;
use crate::check::projection;
use crate::newmark::Newmark;
use crate::state::{BodyId, GrabKey, GrabState, ModalState, Tick, TickState};
use crate::stepper::{BodySetup, ForceStepper};
use crate::wire::{
    AccelerationCoding, Accelerations, Frame, FrameGrab, Payload, Repeat, RepeatGrab, Slice, SnapshotBytes,
    StreamWish, Writer, round24,
};

/// Frames kept for resending.
pub(crate) const SENT: usize = 256;
/// Ticks between checksums.
const CHECK_EVERY: u64 = 8;
/// Loads are sent from when their static effect first exceeds this share of the shape.
const LOAD_FLOOR: f64 = 2e-2;
/// How fast the estimate of the unexplained load follows: about so many ticks.
const LOAD_TICKS: f64 = 8.0;
/// The estimate costs a step of its own: it is made every so many ticks.
const LOAD_EVERY: u64 = 4;

/// What was sent for a tick, for repeats and for resending.
#[derive(Debug, Clone)]
struct Sent {
    tick: Tick,
    /// The frame without repeats, marked as resent.
    bytes: Arc<[u8]>,
    grabs: Vec<FrameGrab>,
    accelerations: Option<Accelerations>,
}

/// Encodes one body for one kind of receiver.
#[derive(Debug)]
pub struct Encoder {
    body: BodyId,
    wish: StreamWish,
    modes: usize,
    limit: usize,
    newmark: Newmark,
    stepper: ForceStepper,
    mirror: ModalState,
    truth: ModalState,
    load: Vec<f64>,
    unexplained: Vec<f64>,
    loaded: bool,
    next_slice: usize,
    frames: u64,
    started: Option<Tick>,
    last: Tick,
    sent: VecDeque<Sent>,
    scratch: Vec<f64>,
}

impl Encoder {
    /// For the first `wish.modes` of a model, in datagrams of at most `limit` bytes (with the 3 of the header).
    ///
    /// # Errors
    /// [`StreamError::Config`] when not even one mode fits, [`StreamError::Model`].
    pub fn new(
        body: BodyId,
        model: Arc<ModalModel>,
        setup: &BodySetup,
        newmark: Newmark,
        wish: StreamWish,
        limit: usize,
    ) -> Result<Self, StreamError> {
        newmark.check()?;
        let modes = Self::modes_for(&wish, model.mode_count(), limit);
        if modes == 0 {
            return Err(StreamError::Config {
                what: "datagram size",
                found: limit.to_string(),
                expected: "room for a frame with one mode",
            });
        }
        let stepper = ForceStepper::new(model, setup, modes, newmark.h)?;
        Ok(Self {
            body,
            wish,
            modes,
            limit,
            newmark,
            stepper,
            mirror: ModalState::zero(modes),
            truth: ModalState::zero(modes),
            load: vec![0.0; modes],
            unexplained: vec![0.0; modes],
            loaded: false,
            next_slice: 0,
            frames: 0,
            started: None,
            last: 0,
            sent: VecDeque::with_capacity(SENT),
            scratch: Vec::new(),
        })
    }

    /// How many modes a stream carries: what is wished, what the model has, and (accelerations) what fits beside four
    /// grabs and a pose into one datagram.
    pub fn modes_for(wish: &StreamWish, model_modes: usize, limit: usize) -> usize {
        let wanted = usize::from(wish.modes).min(model_modes);
        match wish.payload {
            Payload::Forces => wanted,
            Payload::Accelerations(coding) => {
                let fixed = 3 + 12 + 4 * 34 + 46 + 7 + 4 + 1;
                wanted.min(limit.saturating_sub(fixed) / coding.bytes_per_mode())
            }
        }
    }

    /// Number of modes carried.
    pub fn modes(&self) -> usize {
        self.modes
    }

    /// What the receivers have after the last tick, if they have all.
    pub fn snapshot(&self, resting: bool) -> SnapshotBytes {
        SnapshotBytes {
            body: self.body.0,
            tick: self.last,
            q: self.mirror.q.clone(),
            v: self.mirror.v.clone(),
            a: self.mirror.a.clone(),
            load: if self.load.iter().any(|x| *x != 0.0) { self.load.clone() } else { Vec::new() },
            resting,
        }
    }

    /// The frame of a tick for resending, if it is still kept.
    pub fn resend(&self, tick: Tick) -> Option<Arc<[u8]>> {
        let first = self.sent.front()?.tick;
        let index = usize::try_from(tick.checked_sub(first)?).ok()?;
        self.sent.get(index).filter(|s| s.tick == tick).map(|s| s.bytes.clone())
    }

    /// Takes the truth over as it is: the next frame begins a new run, and receivers need a [`Encoder::snapshot`].
    pub fn restart(&mut self, state: &TickState<'_>) {
        let take = |mine: &mut Vec<f64>, theirs: &[f64], modes: usize| {
            mine.clear();
            mine.extend(theirs.iter().copied().chain(std::iter::repeat(0.0)).take(modes));
        };
        take(&mut self.mirror.q, state.q, self.modes);
        take(&mut self.mirror.v, state.v, self.modes);
        take(&mut self.mirror.a, state.a, self.modes);
        if state.resting {
            self.mirror.v.fill(0.0);
            self.mirror.a.fill(0.0);
        }
        self.truth.copy_from(&self.mirror);
        self.stepper.restart();
        self.load.fill(0.0);
        self.unexplained.fill(0.0);
        self.loaded = false;
        self.sent.clear();
        self.started = Some(state.tick);
        self.last = state.tick;
    }

    /// The next frame begins a new run after `tick`; the mirror stays as it is.
    pub fn begin_run(&mut self, tick: Tick) {
        self.sent.clear();
        self.started = Some(tick);
        self.last = tick;
    }

    /// True before the first [`Encoder::restart`].
    pub fn is_fresh(&self) -> bool {
        self.started.is_none()
    }

    /// Encodes the tick after the last one. The bytes have no datagram header yet.
    pub fn encode(&mut self, state: &TickState<'_>) -> Arc<[u8]> {
        let rotation = state.pose.map_or([0.0, 0.0, 0.0, 1.0], |p| p.rotation);
        let forces = self.wish.payload == Payload::Forces;
        let grabs: Vec<FrameGrab> = state
            .grabs
            .iter()
            .map(|g| {
                let radius = f64::from(g.radius as f32);
                let displacement = if forces {
                    self.stepper.displacement(&state.q[..self.modes.min(state.q.len())], g.vertex, radius)
                } else {
                    [0.0; 3]
                };
                let state = GrabState {
                    radius,
                    target: g.target.map(|x| f64::from(x as f32)),
                    reaction: g.reaction.map(round24),
                    ..*g
                };
                FrameGrab { state, displacement: displacement.map(round24), held: true }
            })
            .collect();
        let accelerations = match self.wish.payload {
            Payload::Accelerations(coding) => Some(self.step_accelerations(coding, state)),
            Payload::Forces => {
                self.step_forces(&grabs, state, rotation);
                None
            }
        };
        take_truth(&mut self.truth, state);
        let run = state.tick - self.started.unwrap_or(state.tick) - 1;
        let mut frame = Frame {
            body: self.body,
            tick: state.tick,
            run: u16::try_from(run).unwrap_or(u16::MAX),
            resting: state.resting,
            resent: false,
            displacements: forces,
            grabs: grabs.clone(),
            pose: state.pose,
            accelerations,
            slice: None,
            check: None,
            repeats: Vec::new(),
        };
        self.repeat(&mut frame);
        self.refresh(&mut frame, state);
        if state.tick.is_multiple_of(CHECK_EVERY) {
            frame.check = Some(projection(state.tick, &self.mirror.q) as f32);
        }
        while 3 + frame.bytes() > self.limit && frame.repeats.pop().is_some() {}
        let bytes = write(&frame);
        self.keep(frame, grabs);
        self.last = state.tick;
        self.frames += 1;
        bytes
    }

    fn keep(&mut self, mut frame: Frame, grabs: Vec<FrameGrab>) {
        frame.repeats.clear();
        frame.grabs.retain(|g| g.held);
        frame.resent = true;
        let bytes = write(&frame);
        if self.sent.len() >= SENT {
            self.sent.pop_front();
        }
        self.sent.push_back(Sent { tick: frame.tick, bytes, grabs, accelerations: frame.accelerations });
    }

    /// The mirror's step with accelerations chosen so that it meets the truth.
    fn step_accelerations(&mut self, coding: AccelerationCoding, state: &TickState<'_>) -> Accelerations {
        let Newmark { h, beta, gamma } = self.newmark;
        // The acceleration that meets the position exactly is a filter of it with both zeros at this place; outside
        // the unit circle, or on it as for average acceleration, it rings for ever.
        let zero = if beta > 0.0 { (0.5 + gamma - 2.0 * beta) / (2.0 * beta) } else { f64::INFINITY };
        let exact = zero.abs() < 0.9 && ((gamma + 0.5).powi(2) / 4.0 - beta).abs() < 1e-9;
        let truth_at = |slice: &[f64], k: usize| slice.get(k).copied().unwrap_or(0.0);
        self.scratch.clear();
        for k in 0..self.modes {
            let (q, v, a) = (self.mirror.q[k], self.mirror.v[k], self.mirror.a[k]);
            let (free_q, _) = self.newmark.step(q, v, a, 0.0);
            self.scratch.push(if exact {
                (truth_at(state.q, k) - free_q) / (beta * h * h)
            } else {
                // The host's own acceleration, plus what draws the mirror back: for average acceleration these gains put
                // all three poles of the error within 0.62.
                let (eq, ev) = (self.truth.q[k] - q, self.truth.v[k] - v);
                truth_at(state.a, k) + 0.1 * eq / (h * h) + 0.5 * ev / h
            });
        }
        let accelerations = Accelerations::quantise(coding, &self.scratch);
        for (k, a) in self.scratch.iter_mut().enumerate() {
            *a = accelerations.get(k);
        }
        self.newmark.advance(&mut self.mirror, &self.scratch);
        accelerations
    }

    /// The mirror's step with the reactions as they cross, and the estimate of what they leave unexplained.
    fn step_forces(&mut self, grabs: &[FrameGrab], state: &TickState<'_>, rotation: [f64; 4]) {
        if self.frames.is_multiple_of(LOAD_EVERY) {
            // From the truth of the tick before, as a receiver without error would step.
            let mut lacking = std::mem::take(&mut self.scratch);
            let to = [state.q, state.v];
            self.stepper.lacking(&mut self.truth, to, grabs, rotation, &self.load, &mut lacking);
            let share = LOAD_EVERY as f64 / LOAD_TICKS;
            for ((told, load), lacking) in self.unexplained.iter_mut().zip(&self.load).zip(&lacking) {
                *told += (load + lacking - *told) * share;
            }
            self.scratch = lacking;
        }
        self.stepper.step(&mut self.mirror, grabs, rotation, &self.load);
        if !self.loaded {
            let static_part = |k: usize| self.unexplained[k].abs() / self.stepper.omega(k).powi(2).max(1e-12);
            let largest = |x: &mut dyn Iterator<Item = f64>| x.fold(0.0_f64, f64::max);
            let load = largest(&mut (0..self.modes).map(static_part));
            let shape = largest(&mut state.q.iter().take(self.modes).map(|q| q.abs()));
            self.loaded = load > LOAD_FLOOR * shape && shape > 0.0;
        }
    }

    /// Adds absolute state and takes it into the mirror: the modes that are most wrong in the mirror, and some in turn,
    /// for those receivers that missed what the mirror got.
    fn refresh(&mut self, frame: &mut Frame, state: &TickState<'_>) {
        if self.wish.refresh == 0 {
            return;
        }
        let load = self.loaded;
        let share = self.modes.div_ceil(usize::from(self.wish.refresh)).min(255);
        let mut count = share;
        while count > 0 && 3 + frame.bytes() + Slice::bytes_of(count, load) > self.limit {
            // Fewer modes first, then fewer repeats.
            if count > share.div_ceil(4) {
                count -= 1;
            } else if frame.repeats.pop().is_some() {
                count = share;
            } else {
                count -= 1;
            }
        }
        if count == 0 {
            return;
        }
        let truth = |slice: &[f64], k: usize| slice.get(k).copied().unwrap_or(0.0);
        // In turn: a third; the rest by how wrong the mirror is, velocity counted as the displacement it leads to.
        let turn = count.div_ceil(3);
        let mut chosen: Vec<u16> = (0..turn).map(|i| ((self.next_slice + i) % self.modes) as u16).collect();
        let mut wrong: Vec<(f64, u16)> = (0..self.modes)
            .filter(|k| !chosen.contains(&(*k as u16)))
            .map(|k| {
                let eq = (truth(state.q, k) - self.mirror.q[k]).abs();
                let ev = (truth(state.v, k) - self.mirror.v[k]).abs() / self.stepper.omega(k).max(1e-3);
                (eq + ev, k as u16)
            })
            .collect();
        let most = (count - turn).min(wrong.len());
        if most > 0 && most < wrong.len() {
            wrong.select_nth_unstable_by(most - 1, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        }
        chosen.extend(wrong.iter().take(most).map(|w| w.1));
        self.next_slice = (self.next_slice + turn) % self.modes;
        let values: Vec<(u16, [f64; 3])> = chosen
            .iter()
            .map(|&mode| {
                let k = usize::from(mode);
                let told = if load { self.unexplained[k] } else { 0.0 };
                (mode, [truth(state.q, k), truth(state.v, k), told])
            })
            .collect();
        let slice = Slice::quantise(&values);
        for e in slice.entries() {
            self.mirror.q[e.mode] = e.q;
            self.mirror.v[e.mode] = e.v;
            self.load[e.mode] = e.load;
        }
        frame.slice = Some(slice);
    }

    /// Adds the last ticks again, and the grabs that ended within them.
    fn repeat(&mut self, frame: &mut Frame) {
        for sent in self.sent.iter().rev().take(usize::from(self.wish.repeats)) {
            let Ok(back) = u8::try_from(frame.tick - sent.tick) else { break };
            let mut grabs = Vec::with_capacity(sent.grabs.len());
            for g in &sent.grabs {
                let Some(index) = find_or_add(&mut frame.grabs, g) else { continue };
                grabs.push(RepeatGrab { index, reaction: g.state.reaction, displacement: g.displacement });
            }
            frame.repeats.push(Repeat { back, grabs, accelerations: sent.accelerations.clone() });
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

fn take_truth(truth: &mut ModalState, state: &TickState<'_>) {
    for (mine, theirs) in [(&mut truth.q, state.q), (&mut truth.v, state.v), (&mut truth.a, state.a)] {
        for (m, t) in mine.iter_mut().zip(theirs.iter().chain(std::iter::repeat(&0.0))) {
            *m = *t;
        }
    }
}

fn write(frame: &Frame) -> Arc<[u8]> {
    let mut w = Writer::with_capacity(frame.bytes());
    frame.encode(&mut w);
    w.into_bytes().into()
}
