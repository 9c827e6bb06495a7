//! Bounds the displayed force of a hand while its reaction cannot be known well: during a hitch of
//! the host, the network or this guest, and for a second after it.
//!
//! The predicted copy follows the hand's own targets. When time has passed unseen, the hand jumps
//! within a tick, and the copy answers with a force that the body never gives, because the host
//! plays the same targets smoothly. The host's own reactions, which arrive with every tick, are the
//! measure: after a hitch, no hand is displayed more than a fifth beyond the largest of the last
//! second, until the host has the hand where this guest sent it. The same holds for a second after
//! another's hand has come or gone, after a jump of the hand itself, and after an event that has
//! changed what the copy predicts by more than a twentieth of that measure.
//! Where no frame comes at all, the reaction fades.

use std::collections::VecDeque;
use std::time::Duration;

use nalgebra::Vector3;

use crate::state::Tick;

/// A pause in the calls, or in the frames, that counts as a hitch: at least this long, and at least
/// four ticks.
const HITCH: Duration = Duration::from_millis(100);
/// How long the bound applies after a hitch.
const AFTER: Duration = Duration::from_secs(1);
/// How long it applies at least after the host has found the hand again.
const PROLONGED: Duration = Duration::from_millis(250);
/// How far a reaction may exceed the largest that the body gave.
const BEYOND: f64 = 1.2;
/// Change of a predicted reaction by an event from the host that counts as a surprise, as a share
/// of the largest reaction that the body gave.
const SURPRISE: f64 = 0.05;
/// Time constant with which a reaction fades where no frame comes, s.
const FADE: f64 = 0.1;
/// Time in which the whole reaction returns, s.
const RETURN: f64 = 0.25;

/// Bounds the reactions of a guest's own hands on one body.
#[derive(Debug)]
pub(crate) struct HitchGuard {
    /// The largest reaction that the host has sent for each tick of the last second, N.
    given: VecDeque<(Tick, f64)>,
    called: Option<Duration>,
    bounded_until: Duration,
    /// Share of the reaction that is displayed, 0 to 1.
    share: f64,
    hitch: Duration,
    /// Ticks in a second.
    second: u64,
}

impl HitchGuard {
    /// Creates a guard for a body with steps of `h` seconds.
    pub(crate) fn new(h: f64) -> Self {
        Self {
            given: VecDeque::new(),
            called: None,
            bounded_until: Duration::ZERO,
            share: 1.0,
            hitch: HITCH.max(Duration::from_secs_f64(4.0 * h)),
            second: (1.0 / h) as u64,
        }
    }

    /// Keeps the largest reaction (N) of the guest's hands at a tick whose frame has arrived.
    pub(crate) fn give(&mut self, tick: Tick, reaction: f64) {
        while self.given.front().is_some_and(|(first, _)| first + self.second < tick) {
            self.given.pop_front();
        }
        self.given.push_back((tick, reaction));
    }

    /// Notes the time of a call, and for how long no frame has come. A body that rests has none.
    pub(crate) fn pass(&mut self, now: Duration, quiet: Duration) {
        let passed = self.called.map_or(Duration::ZERO, |called| now.saturating_sub(called));
        self.called = Some(now);
        if passed > self.hitch || quiet > self.hitch {
            self.bounded_until = now + AFTER;
        }
        if quiet > self.hitch {
            let unknown = passed.min(quiet - self.hitch).as_secs_f64();
            self.share *= (-unknown / FADE).exp();
        } else {
            // A call after a long pause returns no more than a short one does.
            self.share = (self.share + passed.min(HITCH).as_secs_f64() / RETURN).min(1.0);
        }
    }

    /// Prolongs the bound after a hitch: the host does not yet have the hand where the guest sent
    /// it, so the copy cannot know the reaction.
    pub(crate) fn prolong(&mut self, now: Duration) {
        if now < self.bounded_until {
            self.bounded_until = self.bounded_until.max(now + PROLONGED);
        }
    }

    /// Bounds for a second, because another's hand has come or gone: the copy learns of it late. A
    /// hand that has only just taken hold has no measure, and is not bounded.
    pub(crate) fn disturb(&mut self, now: Duration) {
        let held = self.given.iter().filter(|(_, given)| *given > 0.0).count() as u64;
        if held > self.second / 2 {
            self.bounded_until = self.bounded_until.max(now + AFTER);
        }
    }

    /// Bounds for a second, as [`HitchGuard::disturb`] does, because the hand itself has jumped:
    /// its device stood still, or was away.
    pub(crate) fn jump(&mut self) {
        self.called.into_iter().for_each(|now| self.disturb(now));
    }

    /// Bounds for a second, as [`HitchGuard::disturb`] does, where an event from the host has
    /// changed what the copy predicts by so many newtons: another's hand moves as no forecast can
    /// know.
    pub(crate) fn surprise(&mut self, now: Duration, change: f64) {
        if change > SURPRISE * self.most() {
            self.disturb(now);
        }
    }

    /// The largest reaction that the host has sent in the last second, N.
    fn most(&self) -> f64 {
        self.given.iter().map(|(_, given)| *given).fold(0.0, f64::max)
    }

    /// Returns the reaction that is displayed to a hand, N.
    pub(crate) fn bound(&self, reaction: [f64; 3]) -> [f64; 3] {
        let reaction = Vector3::from(reaction) * self.share;
        let bounded = self.called.is_some_and(|now| now < self.bounded_until);
        if !bounded {
            return reaction.into();
        }
        reaction.cap_magnitude(BEYOND * self.most()).into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn a_reaction_is_bounded_for_a_second_after_a_hitch_and_free_before_and_after() {
        let mut guard = HitchGuard::new(0.025);
        for tick in 1..=80 {
            guard.give(tick, 0.1 * tick as f64);
            guard.pass(tick as u32 * 25 * MS, Duration::ZERO);
        }
        assert_eq!(guard.bound([0.0, 30.0, 0.0]), [0.0, 30.0, 0.0], "no hitch");
        guard.pass(2300 * MS, Duration::ZERO);
        let bounded = Vector3::from(guard.bound([0.0, 30.0, 0.0])).norm();
        assert!((bounded - 9.6).abs() < 1e-9, "{bounded}");
        assert_eq!(guard.bound([0.0, 3.0, 0.0]), [0.0, 3.0, 0.0]);
        (0..=50).for_each(|k| guard.pass((2300 + 20 * k) * MS, Duration::ZERO));
        assert_eq!(guard.bound([0.0, 30.0, 0.0]), [0.0, 30.0, 0.0], "a second later");
        // Only what was given in the last second counts.
        let given: Vec<Tick> = guard.given.iter().map(|g| g.0).collect();
        assert!(given[0] == 40 && given.len() == 41, "{given:?}");
    }

    #[test]
    fn a_hand_that_comes_or_goes_bounds_the_others_that_have_held_for_a_while() {
        let mut guard = HitchGuard::new(0.025);
        guard.pass(Duration::ZERO, Duration::ZERO);
        guard.give(1, 1.0);
        guard.disturb(Duration::ZERO);
        assert_eq!(guard.bound([9.0, 0.0, 0.0])[0], 9.0, "it has only just taken hold");
        for tick in 2..=60 {
            guard.give(tick, 1.0);
            guard.pass(tick as u32 * 25 * MS, Duration::ZERO);
        }
        guard.disturb(1500 * MS);
        assert_eq!(guard.bound([9.0, 0.0, 0.0])[0], 1.2);
        (60..=101).for_each(|k| guard.pass(k * 25 * MS, Duration::ZERO));
        assert_eq!(guard.bound([9.0, 0.0, 0.0])[0], 9.0, "a second later");
    }

    #[test]
    fn a_prediction_that_news_change_is_bounded_for_a_second() {
        let mut guard = HitchGuard::new(0.025);
        for tick in 1..=60 {
            guard.give(tick, 1.0);
            guard.pass(tick as u32 * 25 * MS, Duration::ZERO);
            guard.surprise(tick as u32 * 25 * MS, 0.049);
        }
        assert_eq!(guard.bound([9.0, 0.0, 0.0])[0], 9.0, "no surprise");
        guard.surprise(1500 * MS, 0.051);
        assert_eq!(guard.bound([9.0, 0.0, 0.0])[0], 1.2);
        (60..=101).for_each(|k| guard.pass(k * 25 * MS, Duration::ZERO));
        assert_eq!(guard.bound([9.0, 0.0, 0.0])[0], 9.0, "a second later");
    }

    #[test]
    fn the_bound_lasts_until_the_host_has_found_the_hand() {
        let mut guard = HitchGuard::new(0.025);
        guard.give(1, 1.0);
        guard.pass(Duration::ZERO, Duration::ZERO);
        guard.prolong(Duration::ZERO);
        assert_eq!(guard.bound([9.0, 0.0, 0.0])[0], 9.0, "without a hitch, nothing is prolonged");
        for k in 5..=165 {
            guard.pass(25 * k * MS, Duration::ZERO);
            guard.prolong(25 * k * MS);
            assert_eq!(guard.bound([9.0, 0.0, 0.0])[0], 1.2, "{k}");
        }
    }

    #[test]
    fn a_reaction_that_is_not_known_fades_and_returns_slowly() {
        let mut guard = HitchGuard::new(0.025);
        guard.give(1, 10.0);
        let bounded = |guard: &HitchGuard| guard.bound([10.0, 0.0, 0.0])[0];
        let mut last = 10.0;
        for k in 0..=70 {
            guard.pass(10 * k * MS, 10 * k * MS);
            let now = bounded(&guard);
            assert!(now <= last && (k > 10 || now == 10.0), "{now} after {k}0 ms");
            last = now;
        }
        assert!(last < 0.1, "{last} after 0.7 s");
        for k in 71..=100 {
            guard.pass(10 * k * MS, Duration::ZERO);
            let now = bounded(&guard);
            assert!(now - last <= 0.4 + 1e-9, "from {last} to {now} in 10 ms");
            last = now;
        }
        assert!((last - 10.0).abs() < 1e-9, "{last}");
    }
}
