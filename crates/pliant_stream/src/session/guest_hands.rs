//! The guest's own hands: their grabs, and how their targets are sent.

use std::collections::VecDeque;
use std::time::Duration;

use nalgebra::Vector3;
use pliant_modal::GrabConfig;

use super::MIN_DATAGRAM;
use super::guest::GuestSession;
use crate::StreamError;
use crate::state::{BodyId, in_range, next_free};
use crate::wire::{Datagram, GuestMessage, MAX_TARGETS, TargetEntry, Targets, check_hold};

/// Interval at which an unchanged target is sent again.
const TARGET_EVERY: Duration = Duration::from_millis(250);
/// A hand jumps when its way over its last targets is farther than this share of the body's size,
/// and farther than its longest ways before these by this factor. The host eases such a jump, as a
/// [`HandPlayout`](crate::HandPlayout) does whose hand moves by twenty sizes a second at most.
const JUMP: [f64; 2] = [0.0075, 1.5];
/// Number of targets over which a hand may jump. A device that has been away does not always come
/// back with one.
const JUMP_TARGETS: usize = 3;
/// Factor by which a way is forgotten from one target to the next.
const FORGETTING: f64 = 0.98;
/// Number of recent targets of a grab in each datagram.
pub(super) const TARGET_REPEATS: usize = 3;

#[derive(Debug)]
pub(super) struct LocalGrab {
    pub(super) body: BodyId,
    /// The recent targets, newest last, at most three.
    targets: VecDeque<TargetEntry>,
    /// For each of the last [`JUMP_TARGETS`] targets, newest last: the target before it, and the
    /// longest way from one to the next until then, m.
    before: VecDeque<(Vector3<f64>, f64)>,
    /// The last target, and the longest way from one to the next of late, m.
    last: Vector3<f64>,
    usual: f64,
    fresh: bool,
    sent_at: Duration,
}

impl LocalGrab {
    /// Time at which the target is to be sent next; `None` without a target.
    pub(super) fn due(&self, now: Duration) -> Option<Duration> {
        let due = if self.fresh { now } else { self.sent_at + TARGET_EVERY };
        (!self.targets.is_empty()).then_some(due)
    }

    /// Takes the next target. Returns whether the hand has jumped over its last targets, farther
    /// than `least` m. A jump says nothing of how a hand moves, so its usual way grows slowly.
    fn jumped(&mut self, target: Vector3<f64>, least: f64) -> bool {
        let last = std::mem::replace(&mut self.last, target);
        if self.before.len() >= JUMP_TARGETS {
            self.before.pop_front();
        }
        self.before.push_back((last, self.usual));
        let fastest = least.max(JUMP[1] * self.usual);
        self.usual = (target - last).norm().min(fastest).max(FORGETTING * self.usual);
        let mut ways = self.before.iter().rev().zip(1..);
        let jumped = ways.any(|(&(from, usual), count)| {
            (target - from).norm() > least.max(JUMP[1] * f64::from(count) * usual)
        });
        if jumped {
            self.before.clear();
        }
        jumped
    }
}

impl GuestSession {
    /// Grabs a body and returns the number of the grab.
    ///
    /// `hold` gives the hand's own spring and damper, capped at what devices have, or a grab as
    /// stiff as the patch allows ([`GrabConfig::default`]). The other calls name the grab by its
    /// number. The host may answer with
    /// [`GuestEvent::GrabRefused`](crate::GuestEvent::GrabRefused).
    ///
    /// # Errors
    /// Returns [`StreamError::State`] before the welcome, [`StreamError::UnknownBody`] for an
    /// unknown body, [`StreamError::NotFinite`] for a target or radius out of range,
    /// [`StreamError::Config`] for a spring or damper out of range, and [`StreamError::Full`]
    /// beyond 16 grabs.
    pub fn begin_grab(
        &mut self,
        now: Duration,
        body: BodyId,
        vertex: u32,
        radius: f64,
        target: [f64; 3],
        hold: GrabConfig,
    ) -> Result<u16, StreamError> {
        if self.user().is_none() {
            let (what, state) = ("begin_grab", "not in");
            return Err(StreamError::State { what, state, needed: "the host's welcome" });
        }
        if !self.bodies.contains_key(&body) {
            return Err(StreamError::UnknownBody(body));
        }
        if !in_range(&target) || !(0.0..=1e9).contains(&radius) {
            return Err(StreamError::NotFinite { what: "grab" });
        }
        // The host applies the same limits.
        let hold = check_hold(hold)?;
        let limit = super::host_peer::MAX_GUEST_GRABS;
        if self.grabs.len() >= limit {
            return Err(StreamError::Full { what: "grabs", limit });
        }
        let grab = next_free(&mut self.next_grab, |grab| !self.grabs.contains_key(&grab));
        let (targets, before, last) = (VecDeque::new(), VecDeque::new(), target.into());
        let own = LocalGrab { body, targets, before, last, usual: 0.0, fresh: false, sent_at: now };
        self.grabs.insert(grab, own);
        if let Some(predicted) = self.bodies.get_mut(&body).and_then(|b| b.predicted.as_mut()) {
            predicted.begin(grab, vertex, radius, target, hold);
        }
        self.message(&GuestMessage::GrabBegin { grab, body: body.0, vertex, radius, target, hold });
        Ok(grab)
    }

    /// Moves a hand. The target is sent with the next [`GuestSession::update`] and twice more with
    /// the targets after it.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownGrab`] for an unknown grab and [`StreamError::NotFinite`] for
    /// a target out of range. The old target then stays.
    pub fn set_target(&mut self, grab: u16, target: [f64; 3]) -> Result<(), StreamError> {
        if !in_range(&target) {
            return Err(StreamError::NotFinite { what: "target" });
        }
        let own = self.grabs.get_mut(&grab).ok_or(StreamError::UnknownGrab(grab))?;
        if own.targets.len() >= TARGET_REPEATS {
            own.targets.pop_front();
        }
        self.input = self.input.wrapping_add(1);
        own.targets.push_back(TargetEntry { grab, input: self.input, target });
        own.fresh = true;
        let target = Vector3::from(target);
        let Some(body) = self.bodies.get_mut(&own.body) else { return Ok(()) };
        if own.jumped(target, body.model().map_or(f64::INFINITY, |model| JUMP[0] * model.size())) {
            body.hitches.jump();
        }
        if let Some(predicted) = body.predicted.as_mut() {
            predicted.set(grab, target.into());
        }
        Ok(())
    }

    /// Ends a grab. Ending it twice is not an error.
    pub fn end_grab(&mut self, grab: u16) {
        if let Some(own) = self.grabs.remove(&grab) {
            self.forget_own(own.body, grab);
            self.message(&GuestMessage::GrabEnd { grab });
        }
    }

    /// Applies an impulse (N s, world axes) to a surface vertex of a body at the host's next tick.
    ///
    /// It brings the body at most [`MAX_IMPULSE_SPEED`](crate::MAX_IMPULSE_SPEED), and is seen here
    /// a round trip later. The host may ignore it, and does so if this user may only watch.
    ///
    /// # Errors
    /// Returns [`StreamError::State`] before the welcome, [`StreamError::UnknownBody`] for an
    /// unknown body, [`StreamError::NotFinite`] for an impulse out of range, and
    /// [`StreamError::Full`] beyond 60 impulses a second (120 at once).
    pub fn apply_impulse(
        &mut self,
        now: Duration,
        body: BodyId,
        vertex: u32,
        impulse: [f64; 3],
    ) -> Result<(), StreamError> {
        if self.user().is_none() {
            let (what, state) = ("apply_impulse", "not in");
            return Err(StreamError::State { what, state, needed: "the host's welcome" });
        }
        if !self.bodies.contains_key(&body) {
            return Err(StreamError::UnknownBody(body));
        }
        if !in_range(&impulse) {
            return Err(StreamError::NotFinite { what: "impulse" });
        }
        if !self.impulse_budget.spend(now, 1.0) {
            return Err(StreamError::Full { what: "impulses", limit: super::budgets::IMPULSES_AT_ONCE });
        }
        self.message(&GuestMessage::Impulse { body: body.0, vertex, impulse });
        Ok(())
    }

    /// Iterates over the guest's grabs: number and body.
    pub fn grabs(&self) -> impl Iterator<Item = (u16, BodyId)> {
        self.grabs.iter().map(|(k, g)| (*k, g.body))
    }

    pub(super) fn forget_own(&mut self, body: BodyId, grab: u16) {
        if let Some(predicted) = self.bodies.get_mut(&body).and_then(|b| b.predicted.as_mut()) {
            predicted.end(grab);
        }
    }

    pub(super) fn send_targets(&mut self, now: Duration) {
        let mut entries = Vec::new();
        let room = ((self.link.max_datagram.max(MIN_DATAGRAM) - 4) / 18).min(MAX_TARGETS);
        for g in self.grabs.values_mut() {
            let again = now.saturating_sub(g.sent_at) >= TARGET_EVERY;
            if g.targets.is_empty() || !(g.fresh || again) {
                continue;
            }
            let first = if g.fresh { 0 } else { g.targets.len() - 1 };
            if entries.len() + g.targets.len() - first > room {
                continue;
            }
            entries.extend(g.targets.iter().skip(first));
            g.fresh = false;
            g.sent_at = now;
        }
        if !entries.is_empty() {
            self.datagram(&Datagram::Targets(Targets { entries }));
        }
    }
}
