//! One body at a receiver: the received data, the confirmed state and the visual state.

mod visual;

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_modal::{ContactState, ModalModel, StepSettings};

use super::{
    AccelerationDriven, Blend, ForceDriven, HISTORY, History, Policy, Predict, Recovery, RecoveryConfig,
};
use super::{Forecast, PassivityGuard, PoseBlend};
use crate::codec::checksum::checksum;
use crate::codec::quantization::Quanta;
use crate::newmark::Newmark;
use crate::prediction::{HandState, Ring};
use crate::replica::Replica;
use crate::state::{GrabKey, GrabState, RigidState, State, Tick, UserId};
use crate::wire::{SnapshotBytes, TickFrame};
use crate::{StreamError, Surroundings};

/// Number of disagreeing checksums in a row before the receiver wants a snapshot. A slice or a
/// repair may correct a single disagreement.
const CHECKS: u32 = 3;
/// Largest difference of a checksum, as a share of the state's norm.
const CHECK_TOLERANCE: f64 = 2e-3;

/// A visual grab. Its reaction belongs to the visual state.
pub type VisualGrab = GrabState;

/// Effect of a received frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Arrival {
    /// Ticks that were not known before and had not been stepped yet.
    pub in_time: u32,
    /// Ticks that had been stepped with a prediction and are corrected.
    pub repaired: u32,
    /// Ticks that came too late to be used.
    pub too_late: u32,
}

/// Tick counts since the receiver was created.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct RepairCounts {
    /// Ticks stepped.
    pub stepped: u64,
    /// Stepped ticks whose data arrived in time.
    pub in_time: u64,
    /// Stepped ticks that used a prediction.
    pub guessed: u64,
    /// Predicted ticks whose data arrived later and was used.
    pub repaired: u64,
    /// Predicted ticks whose data arrived too late to be used.
    pub too_late: u64,
    /// States taken over from a snapshot.
    pub snapshots: u64,
    /// Checksums that disagreed.
    pub mismatches: u64,
}

impl std::ops::Add for RepairCounts {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            stepped: self.stepped + other.stepped,
            in_time: self.in_time + other.in_time,
            guessed: self.guessed + other.guessed,
            repaired: self.repaired + other.repaired,
            too_late: self.too_late + other.too_late,
            snapshots: self.snapshots + other.snapshots,
            mismatches: self.mismatches + other.mismatches,
        }
    }
}

/// A body at a receiver.
pub struct Receiver {
    settings: StepSettings,
    replica: Replica,
    history: History,
    quanta: Quanta,
    policy: Box<dyn Recovery>,
    blend: Blend,
    guard: Option<PassivityGuard>,
    tick: Tick,
    visual: State,
    grabs: Vec<VisualGrab>,
    /// The tick of `grabs`, and the visual grabs of the two ticks before, the newer first.
    grabs_at: Tick,
    trail: [Vec<VisualGrab>; 2],
    /// The forces over the steps to this tick and to the tick before, if they are computed from the
    /// state.
    implied: [Vec<HandState>; 2],
    /// The best estimate of the rigid pose at the current tick, and the visual pose.
    frame: Option<RigidState>,
    pose: Option<RigidState>,
    pose_blend: PoseBlend,
    free: bool,
    counts: RepairCounts,
    /// The newest counted tick, and the predicted ticks for which no data has arrived yet.
    counted: Tick,
    guessed: Ring<bool>,
    mismatched: u32,
    before: State,
    forecast: Forecast,
    h: f64,
    blend_ticks: u16,
}

impl std::fmt::Debug for Receiver {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Receiver")
            .field("tick", &self.tick)
            .field("counts", &self.counts)
            .finish_non_exhaustive()
    }
}

impl Receiver {
    /// Creates a receiver for the first `modes` modes of a model, stepped with `newmark.h`, from a
    /// snapshot.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] or [`StreamError::Model`] for settings out of range or an
    /// unusable model, and [`StreamError::Length`] when the snapshot has another number of modes.
    pub fn new(
        model: Arc<ModalModel>,
        settings: StepSettings,
        modes: usize,
        newmark: Newmark,
        config: &RecoveryConfig,
        snapshot: &SnapshotBytes,
    ) -> Result<Self, StreamError> {
        Self::among(&Surroundings::default(), model, settings, modes, newmark, config, snapshot)
    }

    /// As [`Receiver::new`], for a body that may touch what stands around it.
    ///
    /// # Errors
    /// Returns also the errors of [`Surroundings::check`].
    pub fn among(
        around: &Surroundings,
        model: Arc<ModalModel>,
        settings: StepSettings,
        modes: usize,
        newmark: Newmark,
        config: &RecoveryConfig,
        snapshot: &SnapshotBytes,
    ) -> Result<Self, StreamError> {
        config.check()?;
        newmark.check()?;
        let modes = modes.min(model.mode_count());
        if snapshot.q.len() != modes {
            return Err(StreamError::Length { what: "snapshot", found: snapshot.q.len(), expected: modes });
        }
        let replica = || Replica::new(model.clone(), settings, modes, newmark.h);
        let integrating = |predict, compensate| {
            AccelerationDriven::new(newmark, predict, compensate, modes).relaxing(settings.relaxation)
        };
        let (policy, blend_ticks): (Box<dyn Recovery>, u16) = match config.policy {
            Policy::None => (Box::new(integrating(Predict::Zero, false)), 1),
            Policy::Paper { predict, blend_ticks } => (Box::new(integrating(predict, true)), blend_ticks),
            Policy::ForceDriven { blend_ticks } => {
                let mut replica = replica()?;
                replica.set_surroundings(around)?;
                (Box::new(ForceDriven::new(replica, Forecast::new(newmark.h))), blend_ticks)
            }
        };
        let guard = config.passive.then(|| {
            let (omega, damping): (Vec<f64>, Vec<f64>) =
                (0..modes).map(|mode| settings.mode(&model, mode)).unzip();
            PassivityGuard::new(&omega, &damping, newmark.h).relaxing(settings.relaxation)
        });
        let replica = replica()?;
        let rest = replica.kernel().at_rest();
        let mut receiver = Self {
            settings,
            replica,
            history: History::new(snapshot.tick),
            quanta: Quanta::stiffened(&model, settings.stiffness_scale, modes, &newmark),
            policy,
            blend: Blend::new(newmark.h, blend_ticks),
            guard,
            tick: snapshot.tick,
            visual: rest.clone(),
            grabs: Vec::new(),
            grabs_at: snapshot.tick,
            trail: [Vec::new(), Vec::new()],
            implied: [Vec::new(), Vec::new()],
            frame: None,
            pose: None,
            pose_blend: PoseBlend::new(newmark.h, blend_ticks),
            free: model.is_free(),
            counts: RepairCounts::default(),
            counted: snapshot.tick,
            guessed: Ring::new(HISTORY),
            mismatched: 0,
            before: rest,
            forecast: Forecast::new(newmark.h),
            h: newmark.h,
            blend_ticks,
        };
        receiver.take(snapshot);
        receiver.visual.clone_from(receiver.policy.confirmed());
        receiver.frame = receiver.best_pose();
        receiver.pose = receiver.frame;
        Ok(receiver)
    }

    /// The current tick.
    pub fn tick(&self) -> Tick {
        self.tick
    }

    /// The received data.
    pub fn history(&self) -> &History {
        &self.history
    }

    /// The best estimate of the host's state.
    pub fn confirmed(&self) -> &State {
        self.policy.confirmed()
    }

    /// The best estimate of the rigid pose at the current tick. `None` if the body is not free.
    pub(crate) fn frame(&self) -> Option<RigidState> {
        self.frame
    }

    /// What the contacts of the confirmed tick have left.
    pub(crate) fn contacts(&self) -> Option<&ContactState> {
        self.policy.contacts()
    }

    /// The contact forces of the confirmed tick, see [`Recovery::contact_push`].
    pub(crate) fn contact_push(&self) -> [Vector3<f64>; 2] {
        self.policy.contact_push()
    }

    pub(crate) fn hands(&self) -> &[HandState] {
        self.policy.hands()
    }

    pub(crate) fn load(&self) -> &[f64] {
        self.policy.load()
    }

    /// The state for rendering and haptics.
    pub fn visual(&self) -> &State {
        &self.visual
    }

    /// The grabs at the current tick with their reactions.
    pub fn grabs(&self) -> &[VisualGrab] {
        &self.grabs
    }

    /// The visual rigid pose at the current tick. `None` if the body is not free.
    pub fn pose(&self) -> Option<RigidState> {
        self.pose
    }

    /// The tick counts.
    pub fn counts(&self) -> RepairCounts {
        self.counts
    }

    /// The passivity guard, if the configuration asks for one.
    pub fn guard(&self) -> Option<&PassivityGuard> {
        self.guard.as_ref()
    }

    /// Returns true when checksums have disagreed several times in a row, so that a snapshot would
    /// help.
    pub fn wants_snapshot(&self) -> bool {
        self.mismatched >= CHECKS
    }

    /// The host's step settings for the body.
    pub fn settings(&self) -> &StepSettings {
        &self.settings
    }

    /// Takes in a frame. Data for ticks that were already stepped corrects the confirmed state at
    /// once. The visual state does not jump, and the difference fades.
    pub fn accept(&mut self, frame: &TickFrame) -> Arrival {
        let mut arrival = Arrival::default();
        let (mut earliest, mut late) = (Tick::MAX, [(0, false); 8]);
        let mut late_count = 0;
        let tick = self.tick;
        self.history.take(frame, &self.quanta, |t, first| {
            if t > tick {
                arrival.in_time += u32::from(first);
            } else {
                earliest = earliest.min(t);
                if late_count < late.len() {
                    late[late_count] = (t, first);
                    late_count += 1;
                }
            }
        });
        if late_count > 0 {
            self.remember_before();
            let late = &mut late[..late_count];
            late.sort_unstable();
            let whole = self.policy.driven_by_reactions();
            for &(t, first) in late.iter() {
                // Stepping again from the earliest tick includes all later ticks.
                let done = if whole && t != earliest { true } else { self.policy.correct(t, &self.history) };
                // If a repeat of the tick arrived in time, the tick's own frame refines it and does
                // not count as a repair.
                if first && self.guessed.get_mut(t).is_some_and(std::mem::take) {
                    arrival.repaired += u32::from(done);
                    arrival.too_late += u32::from(!done);
                }
            }
            if late.iter().any(|(t, _)| *t == tick) {
                self.policy.refresh(tick, &self.history);
            }
            self.blend_from_before();
            self.counts.repaired += u64::from(arrival.repaired);
            self.counts.too_late += u64::from(arrival.too_late);
        }
        arrival
    }

    /// Steps to the next tick, with received data or with a prediction.
    pub fn advance(&mut self) {
        self.correct_pose();
        let tick = self.tick + 1;
        self.tick = tick;
        // A tick that is stepped again after a snapshot of an earlier tick has already been
        // counted.
        if tick > self.counted {
            self.counted = tick;
            self.counts.stepped += 1;
            if self.history.known(tick).is_some() {
                self.counts.in_time += 1;
            } else {
                self.counts.guessed += 1;
                *self.guessed.place(tick).0 = true;
            }
        }
        self.policy.advance(tick, &self.history);
        self.blend.advance();
        if !self.policy.driven_by_reactions() && self.history.head(tick).is_some_and(|d| !d.slice.is_empty())
        {
            self.remember_before();
            self.policy.refresh(tick, &self.history);
            self.blend_from_before();
        }
        if let Some(guard) = &mut self.guard {
            let confirmed = self.policy.confirmed();
            self.visual.clone_from(confirmed);
            self.blend.apply(&mut self.visual.q, &mut self.visual.v);
            let share = guard.admit(confirmed, &self.visual);
            if share < 1.0 {
                self.blend.scale(share);
            }
        }
        self.show();
        self.compare_check();
    }

    /// Takes over the state of a snapshot and steps again from its tick with all data that has
    /// arrived since. The visual state fades over. A snapshot of a later tick moves the receiver to
    /// that tick.
    pub fn restart(&mut self, snapshot: &SnapshotBytes) {
        if snapshot.q.len() != self.visual.modes() {
            return;
        }
        self.remember_before();
        self.take(snapshot);
        if self.history.highest() > snapshot.tick + HISTORY as u64 {
            // A frame carried a tick from far in the future, so current data would look too old to
            // be used.
            self.history = History::new(snapshot.tick);
            self.history.take_pose(snapshot.tick, snapshot.pose);
            self.tick = self.tick.min(snapshot.tick);
        }
        let distance = self.tick.abs_diff(snapshot.tick);
        if snapshot.tick >= self.tick || distance >= HISTORY as u64 {
            self.tick = snapshot.tick;
            self.counted = self.counted.max(snapshot.tick);
        } else {
            for tick in snapshot.tick + 1..=self.tick {
                self.policy.advance(tick, &self.history);
                self.policy.refresh(tick, &self.history);
            }
        }
        self.blend_from_before();
        self.show();
        self.mismatched = 0;
        self.counts.snapshots += 1;
    }

    /// Returns true while the visual state still differs from the confirmed state.
    pub fn is_fading(&self) -> bool {
        !self.blend.is_empty()
    }

    /// Fades the visual offset of a resting body by one tick.
    pub fn fade(&mut self) {
        self.blend.advance();
        self.show();
    }

    /// Moves a resting body to a later tick without stepping it.
    pub fn skip_to(&mut self, tick: Tick) {
        if tick <= self.tick {
            return;
        }
        self.before.clone_from(self.policy.confirmed());
        let rest = State {
            q: self.before.q.clone(),
            z: self.before.z.clone(),
            frame: self.before.frame,
            ..State::zero(self.before.modes(), false)
        };
        let hands = self.policy.hands().to_vec();
        let contacts = self.policy.contacts().cloned().unwrap_or_default();
        let pose = self.best_pose();
        self.policy.restart(tick, &rest, &[], &hands, &contacts);
        self.history.take_pose(tick, pose);
        self.tick = tick;
        self.show();
    }

    /// Takes over the state of a snapshot.
    fn take(&mut self, snapshot: &SnapshotBytes) {
        let frame = snapshot.pose.and_then(|pose| pose.frame(self.replica.model()));
        let state = State {
            q: snapshot.q.clone(),
            v: snapshot.v.clone(),
            a: snapshot.a.clone(),
            z: snapshot.z.clone(),
            frame: frame.unwrap_or(self.policy.confirmed().frame),
            ..State::default()
        };
        let hands = hands_of(snapshot);
        self.policy.restart(snapshot.tick, &state, &snapshot.load, &hands, &snapshot.contacts);
        self.history.take_pose(snapshot.tick, snapshot.pose);
    }

    /// The best estimate of the rigid pose at the current tick.
    fn best_pose(&self) -> Option<RigidState> {
        if !self.free {
            return None;
        }
        let stepped = self.policy.frame().map(|frame| RigidState::of_frame(self.replica.model(), frame));
        stepped.or_else(|| self.history.pose(self.tick, self.h))
    }

    fn compare_check(&mut self) {
        let Some(expected) = self.history.head(self.tick).and_then(|d| d.check) else { return };
        let state = self.policy.confirmed();
        let size = state.q.iter().chain(&state.z).map(|q| q * q).sum::<f64>().sqrt();
        let own = checksum(self.tick, state);
        if (own - f64::from(expected)).abs() <= CHECK_TOLERANCE * size + 1e-7 {
            self.mismatched = 0;
        } else {
            self.mismatched += 1;
            self.counts.mismatches += 1;
        }
    }
}

fn hands_of(snapshot: &SnapshotBytes) -> Vec<HandState> {
    let of = |&(user, grab, mean): &(u16, u16, [f64; 3])| {
        HandState::of_mean(GrabKey { user: UserId(user), grab }, mean.into())
    };
    snapshot.means.iter().map(of).collect()
}
