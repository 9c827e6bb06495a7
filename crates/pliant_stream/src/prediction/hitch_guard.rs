//! Bounds the displayed force of a hand while its reaction cannot be known well: during a hitch of
//! the host, the network or this guest, and for a second after it.
//!
//! The predicted copy follows the hand's own targets. When time has passed unseen, the hand jumps
//! within a tick, and the copy answers with a force that the body never gives, because the host
//! plays the same targets smoothly. The host's own reactions, which arrive with every tick, are the
//! measure: after a hitch, no hand is displayed more than a fifth beyond the largest of the last
//! second of this guest's time, until the host has the hand where this guest sent it. The same
//! holds for a second after another's hand has come or gone, after a jump of the hand itself, and
//! after an event that has changed what the copy predicts by more than a twentieth of that measure.
//! It also holds where frames are due and none comes, and if it lasts, the reaction fades. A hand
//! of which the host has not told yet may have taken hold of a body that swings, at another moment
//! than here: it is displayed no more than a fifth beyond the largest reaction of all hands that
//! have held for half a second.

use std::collections::VecDeque;
use std::time::Duration;

use nalgebra::Vector3;

use crate::state::Tick;

/// A pause in the calls, or in the frames, that counts as a hitch: at least this long, and at least
/// four ticks.
const HITCH: Duration = Duration::from_millis(100);
/// A shorter pause in the calls, after which a hand may have jumped: at least this long, and at
/// least so many times the usual one of late.
const PAUSE: Duration = Duration::from_millis(45);
const PAUSES: f64 = 2.0;
/// Factor by which a usual pause grows at most, and is forgotten, from one call to the next.
const GROWING: f64 = 1.5;
const FORGETTING: f64 = 0.98;
/// A pause in the frames from which on the bound applies, until one comes and for
/// [`PROLONGED`] after it: at least this long, and at least so many ticks.
const WAITS: Duration = Duration::from_millis(60);
const WAITS_TICKS: f64 = 2.5;
/// How long the bound applies after a hitch, and how long a reaction counts that the host has made.
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

/// The largest reaction of a guest's hands at a tick.
#[derive(Debug, Clone, Copy)]
struct Given {
    tick: Tick,
    /// When its frame has come on this guest's clock, or would have if it had not waited.
    at: Duration,
    /// N.
    reaction: f64,
}

/// Bounds the reactions of a guest's own hands on one body.
#[derive(Debug)]
pub(crate) struct HitchGuard {
    /// What the host has sent for each tick of the last second of the body.
    given: VecDeque<Given>,
    /// The largest reaction that the host has ever sent of hands that held for half a second, N.
    largest: f64,
    /// Time that a frame is on its way.
    way: Duration,
    called: Option<Duration>,
    /// The usual time between two calls of late.
    usual: Duration,
    bounded_until: Duration,
    /// Share of the reaction that is displayed, 0 to 1.
    share: f64,
    hitch: Duration,
    /// Length of a tick, and ticks in a second.
    h: Duration,
    second: u64,
}

impl HitchGuard {
    /// Creates a guard for a body with steps of `h` seconds.
    pub(crate) fn new(h: f64) -> Self {
        Self {
            given: VecDeque::new(),
            largest: 0.0,
            way: Duration::ZERO,
            called: None,
            usual: Duration::ZERO,
            bounded_until: Duration::ZERO,
            share: 1.0,
            hitch: HITCH.max(Duration::from_secs_f64(4.0 * h)),
            h: Duration::from_secs_f64(h),
            second: (1.0 / h) as u64,
        }
    }

    /// Keeps the largest reaction (N) of the guest's hands at a tick whose frame has arrived, or
    /// that a later frame `repeats`.
    pub(crate) fn give(&mut self, now: Duration, tick: Tick, reaction: f64, repeats: bool) {
        // A touch says little of how hard the next hand pulls.
        if self.knows() {
            self.largest = self.largest.max(reaction);
        }
        // A host that began anew goes on at an earlier tick, and what was given later is another's.
        while self.given.back().is_some_and(|last| last.tick >= tick) {
            self.given.pop_back();
        }
        while self.given.front().is_some_and(|first| tick - first.tick > self.second) {
            self.given.pop_front();
        }
        // Of frames that have waited on their way and come at once, the older ones are older.
        for before in self.given.iter_mut().rev() {
            let since = self.h * tick.saturating_sub(before.tick) as u32;
            if before.at + since <= now {
                break;
            }
            before.at = now.saturating_sub(since);
        }
        // Who stood still does not know when a frame came, nor anybody when the host made what is
        // repeated. Both count as made by a host that ran.
        let waited = repeats || self.called.is_some_and(|called| now.saturating_sub(called) > self.hitch);
        let expected =
            self.given.back().filter(|_| waited).map(|last| last.at + self.h * (tick - last.tick) as u32);
        self.given.push_back(Given { tick, at: expected.map_or(now, |at| at.min(now)), reaction });
    }

    /// The newest tick that was given.
    pub(crate) fn newest(&self) -> Option<Tick> {
        self.given.back().map(|given| given.tick)
    }

    /// Notes the time of a call, whether the body rests, so that no frames come and it gives what
    /// it gave last, and how long a frame is on its way.
    pub(crate) fn pass(&mut self, now: Duration, resting: bool, way: Duration) {
        self.way = way;
        if let (true, Some(last)) = (resting, self.given.back_mut()) {
            last.at = now;
        }
        let quiet = self.given.back().map_or(Duration::ZERO, |last| now.saturating_sub(last.at));
        let passed = self.called.map_or(Duration::ZERO, |called| now.saturating_sub(called));
        self.called = Some(now);
        if quiet > WAITS.max(self.h.mul_f64(WAITS_TICKS)) && self.knows() {
            self.bounded_until = self.bounded_until.max(now + PROLONGED);
        }
        let paused = passed > PAUSE.max(self.usual.mul_f64(PAUSES)) && self.most() > 0.0;
        if paused || passed > self.hitch || quiet > self.hitch {
            self.bounded_until = now + AFTER;
        }
        // An app with long frames does not stand still.
        let longest = PAUSE.max(self.usual.mul_f64(GROWING));
        self.usual = passed.min(longest).max(self.usual.mul_f64(FORGETTING));
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
        if self.knows() {
            self.bounded_until = self.bounded_until.max(now + AFTER);
        }
    }

    /// Returns whether the host has told of the hands for half a second of the last one.
    fn knows(&self) -> bool {
        let held = self.given.iter().filter(|given| given.reaction > 0.0).count() as u64;
        held > self.second / 2
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

    /// The largest reaction that the host has made within the last second but a tick, N, of those
    /// that have arrived.
    fn most(&self) -> f64 {
        let since = (self.called.unwrap_or_default() + self.way + self.h).saturating_sub(AFTER);
        let given = self.given.iter().filter(|given| given.at >= since);
        given.map(|given| given.reaction).fold(0.0, f64::max)
    }

    /// Returns the reaction that is displayed to a hand, N. `known` says whether the host has told
    /// of the hand.
    pub(crate) fn bound(&self, reaction: [f64; 3], known: bool) -> [f64; 3] {
        let mut reaction = Vector3::from(reaction) * self.share;
        if !known && self.largest > 0.0 {
            reaction = reaction.cap_magnitude(BEYOND * self.largest);
        }
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

    fn pass(guard: &mut HitchGuard, now: Duration, quiet: Duration) {
        if let (true, Some(last)) = (quiet.is_zero(), guard.given.back_mut()) {
            last.at = now;
        }
        guard.pass(now, false, Duration::ZERO);
    }

    #[test]
    fn a_reaction_is_bounded_for_a_second_after_a_hitch_and_free_before_and_after() {
        let mut guard = HitchGuard::new(0.025);
        for tick in 1..=80 {
            guard.give(tick as u32 * 25 * MS, tick, 0.1 * tick as f64, false);
            pass(&mut guard, tick as u32 * 25 * MS, Duration::ZERO);
        }
        assert_eq!(guard.bound([0.0, 30.0, 0.0], true), [0.0, 30.0, 0.0], "no hitch");
        pass(&mut guard, 2300 * MS, Duration::ZERO);
        let bounded = Vector3::from(guard.bound([0.0, 30.0, 0.0], true)).norm();
        assert!((bounded - 9.6).abs() < 1e-9, "{bounded}");
        assert_eq!(guard.bound([0.0, 3.0, 0.0], true), [0.0, 3.0, 0.0]);
        (0..=50).for_each(|k| pass(&mut guard, (2300 + 20 * k) * MS, Duration::ZERO));
        assert_eq!(guard.bound([0.0, 30.0, 0.0], true), [0.0, 30.0, 0.0], "a second later");
        // Only what was given in the last second counts.
        let given: Vec<Tick> = guard.given.iter().map(|g| g.tick).collect();
        assert!(given[0] == 40 && given.len() == 41, "{given:?}");
    }

    /// A guard that got 3 N at each of 29 ticks and then 1 N, for a second.
    fn ran() -> HitchGuard {
        let mut guard = HitchGuard::new(0.025);
        for tick in 1..=40 {
            guard.give(tick as u32 * 25 * MS, tick, if tick < 30 { 3.0 } else { 1.0 }, false);
            guard.pass(tick as u32 * 25 * MS, false, Duration::ZERO);
        }
        guard
    }

    /// Calls while no frame comes.
    fn wait(guard: &mut HitchGuard, until: u32) {
        (40..=until / 25).for_each(|k| guard.pass(25 * k * MS, false, Duration::ZERO));
    }

    #[test]
    fn a_reaction_counts_for_a_second_of_the_guest_s_time() {
        let mut guard = ran();
        // The 29th tick came after 725 ms, and the host stands still.
        guard.pass(1690 * MS, false, Duration::ZERO);
        assert_eq!(guard.most(), 3.0);
        guard.pass(1690 * MS, false, 20 * MS);
        assert_eq!(guard.most(), 1.0, "it was made earlier than it came");
        guard.pass(1710 * MS, false, Duration::ZERO);
        assert_eq!(guard.most(), 1.0);
        // A body that rests sends nothing, and gives what it gave last.
        guard.pass(9000 * MS, true, Duration::ZERO);
        assert_eq!(guard.most(), 1.0);
    }

    #[test]
    fn a_short_pause_of_an_app_bounds_and_long_frames_do_not() {
        let run = |guard: &mut HitchGuard, from: u32, to: u32, frame: u32| {
            for ms in (from..=to).step_by(frame as usize) {
                guard.give(ms * MS, u64::from(ms / 25), 1.0, false);
                guard.pass(ms * MS, false, Duration::ZERO);
            }
        };
        let shown = |guard: &HitchGuard| guard.bound([9.0, 0.0, 0.0], true)[0];
        let mut guard = HitchGuard::new(0.025);
        run(&mut guard, 0, 1500, 25);
        assert_eq!(shown(&guard), 9.0);
        guard.give(1555 * MS, 62, 1.0, false);
        guard.pass(1555 * MS, false, Duration::ZERO);
        assert_eq!(shown(&guard), 1.2, "55 ms where 25 ms are usual");
        run(&mut guard, 1575, 2600, 25);
        assert_eq!(shown(&guard), 9.0);
        // Twenty frames a second.
        run(&mut guard, 2650, 6000, 50);
        assert_eq!(shown(&guard), 9.0);
        run(&mut guard, 6050, 9000, 50);
        assert_eq!(shown(&guard), 9.0);
        guard.give(9095 * MS, 363, 1.0, false);
        guard.pass(9095 * MS, false, Duration::ZERO);
        assert_eq!(shown(&guard), 9.0, "95 ms where 50 ms are usual");
    }

    #[test]
    fn where_frames_are_due_the_bound_applies_until_one_comes() {
        let mut guard = ran();
        let shown = |guard: &HitchGuard| guard.bound([9.0, 0.0, 0.0], true)[0];
        [1020, 1040, 1060].into_iter().for_each(|ms| guard.pass(ms * MS, false, Duration::ZERO));
        assert_eq!(shown(&guard), 9.0, "two may be lost");
        guard.pass(1065 * MS, false, Duration::ZERO);
        assert!((shown(&guard) - 3.6).abs() < 1e-9, "{}", shown(&guard));
        guard.give(1075 * MS, 43, 1.0, false);
        guard.pass(1075 * MS, false, Duration::ZERO);
        assert!((shown(&guard) - 3.6).abs() < 1e-9, "and not at once: {}", shown(&guard));
        for tick in 44..=53 {
            guard.give(25 * tick as u32 * MS, tick, 1.0, false);
            guard.pass(25 * tick as u32 * MS, false, Duration::ZERO);
        }
        assert_eq!(shown(&guard), 9.0);
        // A host of sixty frames a second sends four ticks of 1/240 s at once.
        let mut guard = HitchGuard::new(1.0 / 240.0);
        for ms in (0..3000).step_by(5) {
            if ms % 17 == 0 {
                (1..=4).for_each(|k| guard.give(ms * MS, u64::from(ms) * 4 / 17 + k, 1.0, false));
            }
            guard.pass(ms * MS, false, Duration::ZERO);
            assert_eq!(shown(&guard), 9.0, "{ms}");
        }
        // A hand that has only just taken hold has no measure.
        let mut guard = HitchGuard::new(0.025);
        guard.give(Duration::ZERO, 1, 1.0, false);
        (0..=4).for_each(|k| guard.pass(20 * k * MS, false, Duration::ZERO));
        assert_eq!(shown(&guard), 9.0);
    }

    #[test]
    fn a_hand_that_the_host_has_not_told_of_is_bounded_by_all_before() {
        let mut guard = HitchGuard::new(0.025);
        assert_eq!(guard.bound([9.0, 0.0, 0.0], false)[0], 9.0, "the first hand has no measure");
        let mut give = |from: u64, to: u64, reaction: f64| {
            for tick in from..=to {
                guard.give(tick as u32 * 25 * MS, tick, reaction, false);
                guard.pass(tick as u32 * 25 * MS, false, Duration::ZERO);
            }
        };
        give(1, 10, 0.1);
        give(11, 60, 0.0);
        give(61, 100, 3.0);
        give(101, 200, 0.0);
        assert!((guard.bound([9.0, 0.0, 0.0], false)[0] - 3.6).abs() < 1e-9);
        assert_eq!(guard.bound([3.0, 0.0, 0.0], false)[0], 3.0);
        assert_eq!(guard.bound([9.0, 0.0, 0.0], true)[0], 9.0);
    }

    #[test]
    fn frames_that_have_waited_are_as_old_as_if_they_had_not() {
        // The network had them, and lets all go at once. Then the host stands still.
        let mut guard = ran();
        wait(&mut guard, 2200);
        for tick in 41..=60 {
            guard.give(2225 * MS, tick, if tick < 46 { 3.0 } else { 1.0 }, false);
        }
        guard.pass(2900 * MS, false, Duration::ZERO);
        assert_eq!(guard.most(), 1.0);
        // The guest itself stood still, and the host soon after it. What it showed is not known.
        let mut guard = ran();
        (41..=44).for_each(|tick| guard.give(1900 * MS, tick, 3.0, false));
        guard.pass(1900 * MS, false, Duration::ZERO);
        let shown = guard.bound([3.0, 0.0, 0.0], true)[0];
        assert!(shown < 0.01, "{shown}");
        // What a frame repeats may be from before the host stood still.
        let mut guard = ran();
        wait(&mut guard, 1775);
        guard.give(1800 * MS, 41, 3.0, true);
        guard.give(1800 * MS, 42, 1.0, false);
        guard.pass(2050 * MS, false, Duration::ZERO);
        assert_eq!(guard.most(), 1.0);
    }

    #[test]
    fn ticks_may_go_back_and_leap_as_far_as_a_host_says() {
        let mut guard = HitchGuard::new(0.025);
        // A host that began anew goes on below, and a hostile one at the end of all numbers.
        for tick in [100, 120, 140, 130, 110, 110, Tick::MAX - 1, Tick::MAX, 1, 2] {
            guard.give(Duration::from_secs(1), tick, 1.0, true);
            assert_eq!(guard.newest(), Some(tick));
        }
        pass(&mut guard, Duration::from_secs(1), Duration::ZERO);
        assert_eq!(guard.given.len(), 2, "{:?}", guard.given);
    }

    #[test]
    fn a_hand_that_comes_or_goes_bounds_the_others_that_have_held_for_a_while() {
        let mut guard = HitchGuard::new(0.025);
        pass(&mut guard, Duration::ZERO, Duration::ZERO);
        guard.give(Duration::ZERO, 1, 1.0, false);
        guard.disturb(Duration::ZERO);
        assert_eq!(guard.bound([9.0, 0.0, 0.0], true)[0], 9.0, "it has only just taken hold");
        for tick in 2..=60 {
            guard.give(tick as u32 * 25 * MS, tick, 1.0, false);
            pass(&mut guard, tick as u32 * 25 * MS, Duration::ZERO);
        }
        guard.disturb(1500 * MS);
        assert_eq!(guard.bound([9.0, 0.0, 0.0], true)[0], 1.2);
        (60..=101).for_each(|k| pass(&mut guard, k * 25 * MS, Duration::ZERO));
        assert_eq!(guard.bound([9.0, 0.0, 0.0], true)[0], 9.0, "a second later");
    }

    #[test]
    fn a_prediction_that_news_change_is_bounded_for_a_second() {
        let mut guard = HitchGuard::new(0.025);
        for tick in 1..=60 {
            guard.give(tick as u32 * 25 * MS, tick, 1.0, false);
            pass(&mut guard, tick as u32 * 25 * MS, Duration::ZERO);
            guard.surprise(tick as u32 * 25 * MS, 0.049);
        }
        assert_eq!(guard.bound([9.0, 0.0, 0.0], true)[0], 9.0, "no surprise");
        guard.surprise(1500 * MS, 0.051);
        assert_eq!(guard.bound([9.0, 0.0, 0.0], true)[0], 1.2);
        (60..=101).for_each(|k| pass(&mut guard, k * 25 * MS, Duration::ZERO));
        assert_eq!(guard.bound([9.0, 0.0, 0.0], true)[0], 9.0, "a second later");
    }

    #[test]
    fn the_bound_lasts_until_the_host_has_found_the_hand() {
        let mut guard = HitchGuard::new(0.025);
        guard.give(Duration::ZERO, 1, 1.0, false);
        pass(&mut guard, Duration::ZERO, Duration::ZERO);
        guard.prolong(Duration::ZERO);
        assert_eq!(guard.bound([9.0, 0.0, 0.0], true)[0], 9.0, "without a hitch, nothing is prolonged");
        for k in 5..=165 {
            guard.give(25 * k * MS, k.into(), 1.0, false);
            pass(&mut guard, 25 * k * MS, Duration::ZERO);
            guard.prolong(25 * k * MS);
            assert_eq!(guard.bound([9.0, 0.0, 0.0], true)[0], 1.2, "{k}");
        }
    }

    #[test]
    fn a_reaction_that_is_not_known_fades_and_returns_slowly() {
        let mut guard = HitchGuard::new(0.025);
        guard.give(Duration::ZERO, 1, 10.0, false);
        let bounded = |guard: &HitchGuard| guard.bound([10.0, 0.0, 0.0], true)[0];
        let mut last = 10.0;
        for k in 0..=70 {
            pass(&mut guard, 10 * k * MS, 10 * k * MS);
            let now = bounded(&guard);
            assert!(now <= last && (k > 10 || now == 10.0), "{now} after {k}0 ms");
            last = now;
        }
        assert!(last < 0.1, "{last} after 0.7 s");
        for k in 71..=100 {
            pass(&mut guard, 10 * k * MS, Duration::ZERO);
            let now = bounded(&guard);
            assert!(now - last <= 0.4 + 1e-9, "from {last} to {now} in 10 ms");
            last = now;
        }
        assert!((last - 10.0).abs() < 1e-9, "{last}");
    }
}
