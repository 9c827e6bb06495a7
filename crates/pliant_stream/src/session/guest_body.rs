//! One body at a guest: waits for the model and a snapshot, then plays tick by tick.

mod missing;

use std::sync::Arc;
use std::time::Duration;

use nalgebra::Vector3;
use pliant_modal::{HeldPlace, HeldShapes, ModalModel};

use crate::newmark::Newmark;
use crate::playout::{LATE_ROW, PlayoutClock};
use crate::prediction::{HitchGuard, PredictedHand, Ring};
use crate::recovery::{HISTORY, Policy, Receiver, RecoveryConfig, RepairCounts, VisualGrab};
use crate::replica::Replica;
use crate::state::{BodyId, GrabKey, Placement, RigidState, State, Tick, UserId};
use crate::wire::{BodyInfo, Payload, SnapshotBytes, TickFrame};
use missing::TickRequest;

/// Largest number of frames that wait for the snapshot.
const WAITING: usize = HISTORY;
/// Backlog beyond which the receiver does not catch up tick by tick, ticks. A snapshot is faster.
const CATCH_UP: u64 = 120;
/// Silence after which the host may have paused.
const QUIET: Duration = Duration::from_millis(100);
/// Ticks that a host is behind the time of a silence if it has paused.
const PAUSED: f64 = 2.0;

/// A body as the guest shows it.
#[derive(Debug)]
pub struct StreamedBody {
    pub(crate) id: BodyId,
    pub(crate) info: BodyInfo,
    pub(crate) placement: Option<Placement>,
    /// The limit of modes that the host was sent.
    pub(crate) interest: Option<u16>,
    pub(crate) model: Option<Arc<ModalModel>>,
    pub(crate) receiver: Option<Receiver>,
    /// The counts of former receivers.
    counted: RepairCounts,
    pub(crate) playout: PlayoutClock,
    pub(crate) predicted: Option<PredictedHand>,
    predicts: bool,
    pub(super) hitches: HitchGuard,
    /// Digest of the other users' hands at the last tick that was received.
    other_hands: u64,
    config: RecoveryConfig,
    newmark: Newmark,
    waiting: Vec<TickFrame>,
    /// A snapshot that waits for the model, or for its tick.
    snapshot: Option<SnapshotBytes>,
    /// Frames after a silence until the schedule knows whether the host has paused.
    waits_for: usize,
    requests: Ring<TickRequest>,
    /// Ticks up to here need no NACK: they are known, or lie before the run or the snapshot.
    resolved: Tick,
    resting: bool,
    /// Tick at which the body came to rest, if the last snapshot said that it rests.
    rests_at: Option<Tick>,
    fade_at: Duration,
    stalled: bool,
    received_at: Duration,
    snapshot_requested: Option<Duration>,
    pub(crate) wants_snapshot: bool,
    pub(crate) resynced: bool,
    /// The host steps the body with other settings from the next snapshot on.
    retuned: bool,
    /// The receiver was rebuilt for new settings, and no event has reported it yet.
    pub(crate) changed: bool,
}

impl StreamedBody {
    pub(crate) fn new(info: BodyInfo, newmark: Newmark, config: RecoveryConfig, predicts: bool) -> Self {
        Self {
            id: BodyId(info.body),
            info,
            placement: None,
            interest: None,
            model: None,
            receiver: None,
            counted: RepairCounts::default(),
            playout: PlayoutClock::new(newmark.h, config.playout),
            predicted: None,
            predicts,
            hitches: HitchGuard::new(newmark.h),
            other_hands: 0,
            config,
            newmark,
            waiting: Vec::new(),
            snapshot: None,
            waits_for: 0,
            requests: Ring::new(HISTORY),
            resolved: 0,
            resting: false,
            rests_at: None,
            fade_at: Duration::ZERO,
            stalled: false,
            received_at: Duration::ZERO,
            snapshot_requested: None,
            wants_snapshot: false,
            resynced: false,
            retuned: false,
            changed: false,
        }
    }

    /// Number of the body in the session.
    pub fn id(&self) -> BodyId {
        self.id
    }

    /// Description of the body by the host.
    pub fn info(&self) -> &BodyInfo {
        &self.info
    }

    /// Where the host has placed an anchored body; `None` before the host has said so.
    pub fn placement(&self) -> Option<Placement> {
        self.placement
    }

    /// The model of the body, after its download.
    pub fn model(&self) -> Option<&Arc<ModalModel>> {
        self.model.as_ref()
    }

    /// Returns whether model and snapshot have arrived. Before that the view holds no state.
    pub fn is_ready(&self) -> bool {
        self.receiver.is_some()
    }

    /// The displayed tick; 0 before the body is ready.
    pub fn tick(&self) -> Tick {
        self.receiver.as_ref().map_or(0, Receiver::tick)
    }

    /// The confirmed state: the best estimate of the true state at the displayed tick. The physics
    /// of the next step uses it. Display and hands use [`StreamedBody::visual`].
    pub fn confirmed(&self) -> Option<&State> {
        self.receiver.as_ref().map(Receiver::confirmed)
    }

    /// The visual state at the displayed tick, for display and hands. It is continuous in position
    /// and velocity.
    pub fn visual(&self) -> Option<&State> {
        self.receiver.as_ref().map(Receiver::visual)
    }

    /// All grabs of the body at the displayed tick, with the reactions that belong to the visual
    /// state.
    pub fn grabs(&self) -> &[VisualGrab] {
        self.receiver.as_ref().map_or(&[], Receiver::grabs)
    }

    /// The newer copy of the body with the guest's own hands at their present targets.
    ///
    /// The result is `None` unless the guest holds the body or the copy still fades to the
    /// confirmed state. The copy needs [`Policy::ForceDriven`] and
    /// [`crate::GuestSessionConfig::predict_hand`]. Show it instead of [`StreamedBody::visual`]
    /// when it exists.
    pub fn predicted_hand(&self) -> Option<&PredictedHand> {
        self.predicted.as_ref().filter(|predicted| predicted.is_active())
    }

    /// The patches that hands hold, own and others', and where they are in the shown state.
    ///
    /// It is empty where their own shapes cannot be shown
    /// ([`GuestSession::set_held_shapes`](crate::GuestSession::set_held_shapes)): where no hand is
    /// predicted, where the elasticity is linear, and where the stream has fewer coordinates than
    /// the model.
    pub fn held_places(&self) -> Vec<HeldPlace> {
        let (Some(predicted), Some(receiver), Some(model)) = (&self.predicted, &self.receiver, &self.model)
        else {
            return Vec::new();
        };
        let whole = receiver.confirmed().modes() == model.mode_count();
        if !whole || !self.info.settings.is_reduced(model) {
            return Vec::new();
        }
        let patches = predicted.patches().chain(receiver.grabs().iter().map(|g| (g.vertex, g.radius)));
        patches.map(|(vertex, radius)| predicted.place(vertex, radius)).collect()
    }

    /// The own shapes of held patches in the displayed state, and their coordinates.
    pub fn held_shapes(&self) -> Option<(&Arc<HeldShapes>, &[f64])> {
        let predicted = self.predicted.as_ref()?;
        Some((predicted.held_shapes()?, predicted.columns()))
    }

    /// The reaction that is displayed to a hand of the guest's own, world, N: that of
    /// [`StreamedBody::predicted_hand`] if there is one.
    ///
    /// After a hitch of the host, the network or this guest, it exceeds what the host has sent in
    /// the last second by no more than a fifth, and until the host has told of the hand, what it
    /// has ever sent of hands that held for half a second. Where no frame comes, it fades.
    pub fn hand_reaction(&self, user: UserId, grab: u16) -> Option<[f64; 3]> {
        let confirmed = self.grabs().iter().find(|g| g.key == GrabKey { user, grab }).map(|g| g.reaction);
        let reaction = self.predicted_hand().and_then(|own| own.reaction(grab)).or(confirmed)?;
        Some(self.hitches.bound(reaction, confirmed.is_some()))
    }

    /// The rigid frame of a free body at the displayed tick.
    pub fn pose(&self) -> Option<RigidState> {
        self.receiver.as_ref().and_then(Receiver::pose)
    }

    /// Counts of stepped, guessed and repaired ticks since the body is here, also of what was
    /// received with another number of modes.
    pub fn counts(&self) -> RepairCounts {
        self.counted + self.receiver.as_ref().map(Receiver::counts).unwrap_or_default()
    }

    /// Returns whether the host reports that the body sleeps.
    pub fn is_resting(&self) -> bool {
        self.resting
    }

    /// Returns whether frames have been missing for longer than prediction is useful. The body then
    /// stands still.
    pub fn is_stalled(&self) -> bool {
        self.stalled
    }

    /// Delay of the displayed tick behind the earliest arrivals, s.
    pub fn visual_delay(&self) -> f64 {
        self.playout.delay()
    }

    pub(crate) fn set_model(&mut self, model: Arc<ModalModel>) {
        self.model = Some(model);
        self.begin();
    }

    /// Takes new settings of the body, valid from the next snapshot on. Returns false when the
    /// information is about another body.
    pub(crate) fn change(&mut self, info: BodyInfo) -> bool {
        let same = self.info.hash == info.hash && self.info.name == info.name;
        if same {
            self.retuned = true;
            self.info = info;
        }
        same
    }

    /// Takes a snapshot. Returns true when the body became ready with it.
    pub(crate) fn take_snapshot(&mut self, now: Duration, snapshot: SnapshotBytes) -> bool {
        self.resting = snapshot.resting;
        self.rests_at = snapshot.resting.then_some(snapshot.tick);
        self.received_at = now;
        self.wants_snapshot = false;
        let modes = snapshot.q.len();
        let retuned = std::mem::take(&mut self.retuned);
        if let Some(receiver) = &self.receiver
            && receiver.confirmed().modes() == modes
            && !retuned
        {
            // At once, a snapshot of a later tick would move the shown shape by the way of the body
            // until then. It waits until its tick is shown.
            let ahead = snapshot.tick.saturating_sub(receiver.tick());
            self.snapshot = Some(snapshot);
            if self.resting || !(1..=CATCH_UP).contains(&ahead) {
                self.resync();
            }
            return false;
        }
        // The receiver is rebuilt for another number of modes or other step settings.
        self.resolved = self.resolved.max(snapshot.tick);
        self.counted = self.counts();
        let again = self.receiver.take().is_some();
        self.snapshot = Some(snapshot);
        let ready = self.begin();
        self.resynced |= again && ready;
        self.changed |= again && ready && retuned;
        ready && !again
    }

    /// Restarts from the snapshot that waits for its tick, if there is one.
    fn resync(&mut self) {
        let Some(receiver) = &mut self.receiver else { return };
        let Some(snapshot) = self.snapshot.take() else { return };
        receiver.restart(&snapshot);
        self.resolved = self.resolved.max(snapshot.tick);
        self.resynced = true;
    }

    fn begin(&mut self) -> bool {
        if self.receiver.is_some() {
            return false;
        }
        let (Some(model), Some(snapshot)) = (&self.model, &self.snapshot) else { return false };
        let modes = snapshot.q.len();
        let (around, settings) = (&self.info.around, self.info.settings);
        let made =
            Receiver::among(around, model.clone(), settings, modes, self.newmark, &self.config, snapshot);
        let Ok(mut receiver) = made else { return false };
        for frame in self.waiting.drain(..) {
            if frame.tick > snapshot.tick {
                receiver.accept(&frame);
            }
        }
        if let (Policy::ForceDriven { blend_ticks }, true) = (self.config.policy, self.predicts)
            && let Ok(mut replica) = Replica::new(model.clone(), settings, modes, self.newmark.h)
            && replica.set_surroundings(around).is_ok()
        {
            let mut predicted = PredictedHand::new(replica, blend_ticks);
            if let Some(before) = self.predicted.take() {
                predicted.take_grabs(before);
            }
            self.predicted = Some(predicted);
        }
        self.receiver = Some(receiver);
        self.snapshot = None;
        true
    }

    pub(crate) fn take_frame(&mut self, now: Duration, frame: TickFrame) {
        let quiet = now.saturating_sub(self.received_at);
        self.received_at = now;
        let highest = self.receiver.as_ref().map_or(0, |r| r.history().highest());
        let modes = self.receiver.as_ref().map_or(0, |r| r.confirmed().modes());
        if let Some(a) = &frame.accelerations
            && self.receiver.is_some()
            && a.modes() != modes
        {
            // The frame is from before or after a change of the mode count. The snapshot of the
            // change is on its way.
            return;
        }
        let Some(receiver) = &mut self.receiver else {
            if self.waiting.len() < WAITING {
                self.playout.arrived(now, frame.tick);
                self.waiting.push(frame);
            }
            return;
        };
        // Of a body that rests no frames come, also for a day.
        let due = self.playout.tick_at(now).map_or(0, |tick| tick.max(0.0) as Tick);
        if frame.tick > highest.max(due).saturating_add(1_000_000) {
            // No host runs ahead by hours, so this tick is invalid. A real host would send a
            // snapshot and the frames of a new run.
            return;
        }
        if !frame.resent && frame.tick > highest {
            self.playout.arrived(now, frame.tick);
            let stands = matches!(self.config.policy, Policy::ForceDriven { .. }) && quiet > QUIET;
            // Where as many ticks have passed as time, the network was silent and not the host.
            let passed = (frame.tick - highest) as f64 * self.newmark.h;
            let stands = stands && quiet.as_secs_f64() > passed + PAUSED * self.newmark.h;
            self.waits_for = if stands { LATE_ROW } else { self.waits_for.saturating_sub(1) };
        }
        // Messages may arrive before earlier frames. These wake nobody.
        let before_rest = self.rests_at.is_some_and(|tick| frame.tick <= tick);
        let before_run = frame.tick.saturating_sub(u64::from(frame.run) + 1);
        if frame.run < u16::MAX && before_run > self.resolved {
            self.resolved = before_run;
            if self.resting && !frame.resting && !before_rest {
                // The body wakes up: the sleeping state is the state before the run.
                receiver.skip_to(before_run);
            }
        }
        self.resting = frame.resting || before_rest && self.resting;
        receiver.accept(&frame);
        if self.resting {
            self.resync();
        }
    }

    /// Tells the guard of hitches what the host has sent of the guest's own hands. What is shown
    /// may still contain the error of a prediction.
    fn measure(&mut self, user: UserId) {
        let Some(history) = self.receiver.as_ref().map(Receiver::history) else { return };
        let highest = history.highest();
        let newest = self.hitches.newest().filter(|newest| *newest <= highest);
        let from = newest
            .map_or(highest, |newest| newest.saturating_add(1))
            .max(highest.saturating_sub(HISTORY as u64));
        for tick in from..=highest {
            let Some(data) = history.known(tick) else { continue };
            let own = data.grabs.iter().filter(|g| g.state.key.user == user);
            let reactions = own.map(|g| Vector3::from(g.state.reaction).norm());
            let repeats = tick < highest;
            self.hitches.give(self.received_at, tick, reactions.fold(0.0, f64::max), repeats);
        }
    }

    /// Steps to all ticks that are due by now. Returns the number of ticks.
    pub(crate) fn advance(&mut self, now: Duration, user: UserId, round_trip: Duration) -> u64 {
        let guesses = self.guesses();
        if self.receiver.is_none() {
            return 0;
        }
        self.measure(user);
        self.hitches.pass(now, self.resting, round_trip / 2);
        let quiet = if self.resting { Duration::ZERO } else { now.saturating_sub(self.received_at) };
        let quiet = quiet > self.config.stall_after;
        let behind = |receiver: &Receiver| receiver.tick() + CATCH_UP < receiver.history().highest();
        if quiet || self.receiver.as_ref().is_some_and(behind) {
            // The tick of a snapshot that waits is not reached soon.
            self.resync();
        }
        let Some(receiver) = &mut self.receiver else { return 0 };
        if self.resting {
            self.stalled = false;
            if now >= self.fade_at && receiver.is_fading() {
                receiver.fade();
                self.fade_at = now + Duration::from_secs_f64(self.newmark.h);
            }
            return 0;
        }
        let highest = receiver.history().highest();
        self.stalled = quiet && receiver.tick() >= highest;
        let most = highest.saturating_add(guesses);
        let mut stepped = 0;
        while let Some(receiver) = &mut self.receiver
            && let Some(due) = self.playout.due(receiver.tick() + 1)
        {
            // Prediction never runs far beyond the newest received tick, whatever the schedule
            // says.
            if due > now || (quiet && receiver.tick() >= highest) || receiver.tick() >= most {
                break;
            }
            if receiver.tick() + CATCH_UP < highest {
                self.wants_snapshot = true;
                break;
            }
            receiver.advance();
            stepped += 1;
            if self.snapshot.as_ref().is_some_and(|snapshot| snapshot.tick <= receiver.tick()) {
                self.resync();
            }
            let Some(receiver) = &self.receiver else { break };
            if let Some(data) = receiver.history().known(receiver.tick()) {
                let others = data.grabs.iter().map(|g| g.state.key).filter(|key| key.user != user);
                let hands = others.fold(0_u64, |sum, key| {
                    // A digest, since no list is kept: the numbers of a hand, spread and added.
                    let number = u64::from(key.user.0) << 16 | u64::from(key.grab);
                    sum.wrapping_add((number + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15))
                });
                if std::mem::replace(&mut self.other_hands, hands) != hands {
                    self.hitches.disturb(now);
                }
            }
            if let Some(predicted) = &mut self.predicted {
                let way = round_trip.as_secs_f64() + self.playout.delay();
                predicted.step(receiver, user, (way / self.newmark.h).ceil() as usize);
                if predicted.is_astray() {
                    self.hitches.prolong(now);
                }
                self.hitches.surprise(now, predicted.surprise());
            }
        }
        if self.receiver.as_ref().is_some_and(|receiver| !receiver.is_fading()) {
            // A correction that begins after a pause does not catch up on the pause.
            self.fade_at = self.fade_at.max(now);
        }
        if stepped > 0 {
            self.fade_at = now + Duration::from_secs_f64(self.newmark.h);
        } else if now >= self.fade_at
            && self.receiver.as_ref().is_some_and(Receiver::is_fading)
            && self.pauses(now)
        {
            // The schedule waits for a host that has paused. Corrections go on meanwhile, twice as
            // fast as the body steps: it stands still, and is to be right when it goes on.
            let half = Duration::from_secs_f64(0.5 * self.newmark.h);
            self.fade_at = self.fade_at.max(now.saturating_sub(4 * half));
            while let Some(receiver) = &mut self.receiver
                && self.fade_at <= now
            {
                receiver.fade();
                self.fade_at += half;
            }
        }
        let waits = self.snapshot.is_some();
        if self.config.snapshots && !waits && self.receiver.as_ref().is_some_and(Receiver::wants_snapshot) {
            self.wants_snapshot = true;
        }
        stepped
    }

    /// Ticks that may be shown beyond the newest received one. After a pause of the host, there are
    /// none until the schedule knows how long the pause was.
    fn guesses(&self) -> u64 {
        let most = (self.config.stall_after.as_secs_f64() / self.newmark.h).round() as u64;
        if self.waits_for > 0 { 0 } else { most.saturating_add(1) }
    }

    /// Returns whether no tick is shown within the next step, because the schedule waits for the
    /// host or no guess is allowed.
    fn pauses(&self, now: Duration) -> bool {
        let Some(receiver) = &self.receiver else { return false };
        let soon = now + Duration::from_secs_f64(self.newmark.h);
        receiver.tick() >= receiver.history().highest().saturating_add(self.guesses())
            || self.playout.due(receiver.tick() + 1).is_none_or(|due| due > soon)
    }

    /// Time at which the next tick is due.
    pub(crate) fn next_tick_due(&self, now: Duration) -> Option<Duration> {
        let receiver = self.receiver.as_ref()?;
        if self.resting {
            return receiver.is_fading().then_some(self.fade_at.max(now));
        }
        let highest = receiver.history().highest();
        let waits = self.wants_snapshot && receiver.tick() + CATCH_UP < highest;
        let fades = (receiver.is_fading() && self.pauses(now)).then_some(self.fade_at.max(now));
        if self.stalled || waits || receiver.tick() >= highest.saturating_add(self.guesses()) {
            return fades;
        }
        let due = self.playout.due(receiver.tick() + 1).map(|t| t.max(now));
        due.map(|due| fades.map_or(due, |fades| due.min(fades)))
    }

    /// Returns true, at most once a second, when a snapshot is to be requested.
    pub(crate) fn request_snapshot(&mut self, now: Duration) -> bool {
        if !self.wants_snapshot {
            return false;
        }
        let again = Duration::from_secs(1);
        if self.snapshot_requested.is_some_and(|at| now.saturating_sub(at) < again) {
            return false;
        }
        self.snapshot_requested = Some(now);
        true
    }

    /// Returns what the frames of this guest's stream carry.
    pub fn payload(&self) -> Payload {
        match self.config.policy {
            Policy::ForceDriven { .. } => Payload::Forces,
            Policy::None | Policy::Paper { .. } => Payload::Accelerations(self.config.coding),
        }
    }
}
