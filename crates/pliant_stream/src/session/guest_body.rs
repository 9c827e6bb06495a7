//! One body at a guest: waiting for model and snapshot, then shown tick by tick.

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::ModalModel;

use super::predicted_hand::PredictedHand;
use crate::newmark::Newmark;
use crate::playout::PlayoutClock;
use crate::recovery::{HISTORY, Policy, Receiver, RecoveryConfig, RepairCounts, VisualGrab};
use crate::replica::Replica;
use crate::state::{BodyId, Pose, State, Tick, UserId};
use crate::wire::{BodyInfo, Frame, MAX_NACK_RUNS, Nack, NackRun, Payload, SnapshotBytes};

/// Frames that wait for the snapshot.
const WAITING: usize = HISTORY;
/// A missing tick is asked for at most so often.
const ASKS: u8 = 12;
/// Ticks older than this are not asked for any more.
const ASK_WITHIN: u64 = 200;
/// More ticks than this are not caught up with in one update: a snapshot is quicker.
const CATCH_UP: u64 = 120;

#[derive(Debug, Clone, Copy, Default)]
struct Ask {
    tick: Tick,
    times: u8,
    next: Duration,
}

/// What a guest sees of a body.
#[derive(Debug)]
pub struct BodyView {
    pub(crate) id: BodyId,
    pub(crate) info: BodyInfo,
    pub(crate) model: Option<Arc<ModalModel>>,
    pub(crate) receiver: Option<Receiver>,
    pub(crate) playout: PlayoutClock,
    pub(crate) own: Option<PredictedHand>,
    own_first: bool,
    config: RecoveryConfig,
    newmark: Newmark,
    waiting: Vec<Frame>,
    snapshot: Option<SnapshotBytes>,
    asks: Vec<Ask>,
    /// Ticks up to here need no asking: before the run, or before the snapshot.
    settled: Tick,
    resting: bool,
    fade_at: Duration,
    stalled: bool,
    received_at: Duration,
    snapshot_asked: Option<Duration>,
    pub(crate) wants_snapshot: bool,
    pub(crate) resynced: bool,
    /// The host steps it otherwise from the next snapshot on.
    retuned: bool,
    /// It was made anew for that, and nobody was told yet.
    pub(crate) changed: bool,
}

impl BodyView {
    pub(crate) fn new(info: BodyInfo, newmark: Newmark, config: RecoveryConfig, own_first: bool) -> Self {
        Self {
            id: BodyId(info.body),
            info,
            model: None,
            receiver: None,
            playout: PlayoutClock::new(newmark.h, config.playout),
            own: None,
            own_first,
            config,
            newmark,
            waiting: Vec::new(),
            snapshot: None,
            asks: vec![Ask::default(); HISTORY],
            settled: 0,
            resting: false,
            fade_at: Duration::ZERO,
            stalled: false,
            received_at: Duration::ZERO,
            snapshot_asked: None,
            wants_snapshot: false,
            resynced: false,
            retuned: false,
            changed: false,
        }
    }

    /// Its number in the session.
    pub fn id(&self) -> BodyId {
        self.id
    }

    /// What the host told of it.
    pub fn info(&self) -> &BodyInfo {
        &self.info
    }

    /// Its model, once it is here.
    pub fn model(&self) -> Option<&Arc<ModalModel>> {
        self.model.as_ref()
    }

    /// Model and snapshot are here: the rest of the view means something.
    pub fn is_ready(&self) -> bool {
        self.receiver.is_some()
    }

    /// The tick that is shown; 0 before the body is ready.
    pub fn tick(&self) -> Tick {
        self.receiver.as_ref().map_or(0, Receiver::tick)
    }

    /// Best estimate of the truth at the shown tick: for the next step's physics, not for the eye.
    pub fn confirmed(&self) -> Option<&State> {
        self.receiver.as_ref().map(Receiver::confirmed)
    }

    /// What the eye and the hand get at the shown tick: continuous in position and velocity.
    pub fn visual(&self) -> Option<&State> {
        self.receiver.as_ref().map(Receiver::visual)
    }

    /// Everything that holds the body at the shown tick, with the reactions that belong to the shape shown.
    pub fn grabs(&self) -> &[VisualGrab] {
        self.receiver.as_ref().map_or(&[], Receiver::grabs)
    }

    /// The newer copy of the body in which the guest's own hands have arrived already; `None` when it holds nothing, for
    /// policies that do not own the model, and for free bodies. Show this instead of [`BodyView::shown`] where it is there.
    pub fn predicted_hand(&self) -> Option<&PredictedHand> {
        self.own.as_ref().filter(|own| own.is_active())
    }

    /// The rigid frame of a free body at the shown tick.
    pub fn pose(&self) -> Option<Pose> {
        self.receiver.as_ref().and_then(Receiver::pose)
    }

    /// What became of the ticks.
    pub fn counts(&self) -> RepairCounts {
        self.receiver.as_ref().map(Receiver::counts).unwrap_or_default()
    }

    /// The host says that the body sleeps.
    pub fn is_resting(&self) -> bool {
        self.resting
    }

    /// Frames have failed for longer than prediction makes sense: the body stands still.
    pub fn is_stalled(&self) -> bool {
        self.stalled
    }

    /// How far the shown tick lies behind the earliest arrivals, s.
    pub fn shown_delay(&self) -> f64 {
        self.playout.delay()
    }

    pub(crate) fn set_model(&mut self, model: Arc<ModalModel>) {
        self.model = Some(model);
        self.begin();
    }

    /// Another way to be stepped, from the next snapshot on; false where it is another body.
    pub(crate) fn change(&mut self, info: BodyInfo) -> bool {
        let same = self.info.hash == info.hash && self.info.name == info.name;
        if same {
            self.retuned = true;
            self.info = info;
        }
        same
    }

    /// Takes a snapshot; true when the body became ready with it.
    pub(crate) fn take_snapshot(&mut self, now: Duration, snapshot: SnapshotBytes) -> bool {
        self.resting = snapshot.resting;
        self.received_at = now;
        self.wants_snapshot = false;
        self.settled = self.settled.max(snapshot.tick);
        let modes = snapshot.q.len();
        let retuned = std::mem::take(&mut self.retuned);
        if let Some(receiver) = &mut self.receiver
            && receiver.confirmed().modes() == modes
            && !retuned
        {
            receiver.restart(&snapshot);
            self.resynced = true;
            return false;
        }
        // Another number of modes, or another way to be stepped: the receiver is made anew.
        let again = self.receiver.take().is_some();
        self.snapshot = Some(snapshot);
        let ready = self.begin();
        self.resynced |= again && ready;
        self.changed |= again && ready && retuned;
        ready && !again
    }

    fn begin(&mut self) -> bool {
        if self.receiver.is_some() {
            return false;
        }
        let (Some(model), Some(snapshot)) = (&self.model, &self.snapshot) else { return false };
        let modes = snapshot.q.len();
        let made =
            Receiver::new(model.clone(), self.info.settings, modes, self.newmark, &self.config, snapshot);
        let Ok(mut receiver) = made else { return false };
        for frame in self.waiting.drain(..) {
            if frame.tick > snapshot.tick {
                receiver.accept(&frame);
            }
        }
        if let (Policy::ForceDriven { blend_ticks }, true) = (self.config.policy, self.own_first)
            && let Ok(replica) = Replica::new(model.clone(), self.info.settings, modes, self.newmark.h)
        {
            let mut own = PredictedHand::new(replica, blend_ticks);
            if let Some(before) = self.own.take() {
                own.take_grabs(before);
            }
            self.own = Some(own);
        }
        self.receiver = Some(receiver);
        self.snapshot = None;
        true
    }

    pub(crate) fn take_frame(&mut self, now: Duration, frame: Frame) {
        self.received_at = now;
        let highest = self.receiver.as_ref().map_or(0, |r| r.history().highest());
        let modes = self.receiver.as_ref().map_or(0, |r| r.confirmed().modes());
        if let Some(a) = &frame.accelerations
            && self.receiver.is_some()
            && a.modes() != modes
        {
            // From before or after a change of the mode count: its snapshot is on the way.
            return;
        }
        let Some(receiver) = &mut self.receiver else {
            if self.waiting.len() < WAITING {
                self.playout.arrived(now, frame.tick);
                self.waiting.push(frame);
            }
            return;
        };
        if frame.tick > highest + 1_000_000 {
            // The far future: no host runs ahead by hours. A real one sends a snapshot, and frames of a new run.
            return;
        }
        if !frame.resent && frame.tick > highest {
            self.playout.arrived(now, frame.tick);
        }
        let before_run = frame.tick.saturating_sub(u64::from(frame.run) + 1);
        if frame.run < u16::MAX && before_run > self.settled {
            self.settled = before_run;
            if self.resting && !frame.resting {
                // Waking: the sleeping state is the one before the run.
                receiver.skip_to(before_run);
            }
        }
        self.resting = frame.resting;
        receiver.accept(&frame);
    }

    /// Steps to whatever is due by now. Returns the number of ticks.
    pub(crate) fn advance(&mut self, now: Duration, user: UserId, round_trip: Duration) -> u64 {
        let Some(receiver) = &mut self.receiver else { return 0 };
        if self.resting {
            self.stalled = false;
            if now >= self.fade_at && receiver.is_fading() {
                receiver.fade();
                self.fade_at = now + Duration::from_secs_f64(self.newmark.h);
            }
            return 0;
        }
        let quiet = now.saturating_sub(self.received_at) > self.config.stall_after;
        let highest = receiver.history().highest();
        self.stalled = quiet && receiver.tick() >= highest;
        let guesses = (self.config.stall_after.as_secs_f64() / self.newmark.h) as u64 + 1;
        let mut stepped = 0;
        while let Some(due) = self.playout.due(receiver.tick() + 1) {
            // Never far beyond what has been heard of, whatever the schedule says.
            if due > now || (quiet && receiver.tick() >= highest) || receiver.tick() >= highest + guesses {
                break;
            }
            if receiver.tick() + CATCH_UP < highest {
                self.wants_snapshot = true;
                break;
            }
            receiver.advance();
            stepped += 1;
            if let Some(own) = &mut self.own {
                let way = round_trip.as_secs_f64() + self.playout.delay();
                own.step(receiver, user, (way / self.newmark.h).ceil() as usize);
            }
        }
        if self.config.snapshots && receiver.wants_snapshot() {
            self.wants_snapshot = true;
        }
        stepped
    }

    /// When the next tick is due.
    pub(crate) fn next_tick_due(&self, now: Duration) -> Option<Duration> {
        let receiver = self.receiver.as_ref()?;
        if self.resting {
            return receiver.is_fading().then_some(self.fade_at.max(now));
        }
        let highest = receiver.history().highest();
        let guesses = (self.config.stall_after.as_secs_f64() / self.newmark.h) as u64 + 1;
        let waits = self.wants_snapshot && receiver.tick() + CATCH_UP < highest;
        if self.stalled || waits || receiver.tick() >= highest + guesses {
            return None;
        }
        self.playout.due(receiver.tick() + 1).map(|t| t.max(now))
    }

    /// True, at most once a second, when a snapshot is to be asked for.
    pub(crate) fn ask_snapshot(&mut self, now: Duration) -> bool {
        if !self.wants_snapshot {
            return false;
        }
        let again = Duration::from_secs(1);
        if self.snapshot_asked.is_some_and(|at| now.saturating_sub(at) < again) {
            return false;
        }
        self.snapshot_asked = Some(now);
        true
    }

    /// Ticks that are missing and due to be asked for.
    pub(crate) fn missing(&mut self, now: Duration, round_trip: Duration) -> Option<Nack> {
        let receiver = self.receiver.as_ref()?;
        if !self.config.nack {
            return None;
        }
        let history = receiver.history();
        let highest = history.highest();
        let from = (self.settled + 1).max(highest.saturating_sub(ASK_WITHIN));
        // What a repeat may still bring is not asked for.
        let to = highest.saturating_sub(u64::from(self.config.repeats));
        let step = Duration::from_secs_f64(2.0 * self.newmark.h);
        let again = (round_trip.mul_f64(1.5) + step).max(Duration::from_millis(60));
        if self.settled + 1 < from {
            // Ticks that nobody will say again. A stream of accelerations never gets over them.
            let unknown = (self.settled + 1..from).any(|t| history.known(t).is_none());
            let integrates = !matches!(self.config.policy, Policy::ForceDriven { .. });
            self.wants_snapshot |= unknown && integrates && self.config.snapshots;
            self.settled = from - 1;
        }
        let mut runs: Vec<NackRun> = Vec::new();
        let mut settled = self.settled;
        for tick in from..to {
            if history.known(tick).is_some() {
                if settled + 1 == tick {
                    settled = tick;
                }
                continue;
            }
            let ask = &mut self.asks[(tick % HISTORY as u64) as usize];
            if ask.tick != tick {
                *ask = Ask { tick, times: 0, next: now };
            }
            if ask.times >= ASKS || ask.next > now {
                continue;
            }
            let room = runs.len() < MAX_NACK_RUNS;
            match runs.last_mut() {
                Some(run) if run.first + u64::from(run.count) == tick && run.count < 64 => run.count += 1,
                _ if room => runs.push(NackRun { first: tick, count: 1 }),
                _ => break,
            }
            ask.times += 1;
            // Patient after the fourth time: an answer may be slow rather than lost.
            ask.next = now + again.mul_f64(1.5_f64.powi(i32::from(ask.times.saturating_sub(4))));
        }
        self.settled = settled;
        (!runs.is_empty()).then_some(Nack { body: self.id, runs })
    }

    /// When a missing tick is to be asked for again.
    pub(crate) fn next_ask(&self) -> Option<Duration> {
        let receiver = self.receiver.as_ref().filter(|_| self.config.nack)?;
        let history = receiver.history();
        let highest = history.highest();
        let from = (self.settled + 1).max(highest.saturating_sub(ASK_WITHIN));
        let to = highest.saturating_sub(u64::from(self.config.repeats));
        (from..to)
            .filter(|t| history.known(*t).is_none())
            .map(|t| self.asks[(t % HISTORY as u64) as usize])
            .filter(|a| a.tick != 0 && a.times > 0 && a.times < ASKS)
            .map(|a| a.next)
            .min()
    }

    /// Does the stream of this guest carry accelerations?
    pub fn payload(&self) -> Payload {
        match self.config.policy {
            Policy::ForceDriven { .. } => Payload::Forces,
            Policy::None | Policy::Paper { .. } => Payload::Accelerations(self.config.coding),
        }
    }
}
