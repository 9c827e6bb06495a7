//! A guest's hand, tick by tick, out of targets that come late, unevenly and with gaps.

use std::collections::VecDeque;

use bevy::math::DVec3;

/// Targets that wait at most; older ones go.
const MOST_WAITING: usize = 64;
/// A gap of more ticks is a pause, not a loss.
const LONGEST_GAP: u32 = 8;
/// A correction fades by this factor a tick: to a twentieth in six.
const FADE: f64 = 0.6;
/// A hand of which nothing comes goes on, slower by this factor each tick.
const SLOWING: f64 = 0.7;

/// Plays a guest's targets back one a tick, as they were said one a tick.
///
/// The first of a movement is held back by `depth` ticks; what comes a little late then still comes in time, and the hand here does exactly what the
/// guest's did, that much later: the guest finds its own targets again in the frames, and knows how far ahead its hand is. When nothing is there in
/// the middle of a movement the hand goes on and slows down; what that was wrong by, like every jump, fades instead of jerking.
#[derive(Debug, Clone)]
pub(super) struct HandPlayout {
    queue: VecDeque<DVec3>,
    newest: Option<u32>,
    /// Ticks until the first waiting target is played.
    wait: usize,
    playing: bool,
    /// The last tick was a guess.
    guessed: bool,
    /// The target played last, and where the hand is.
    said: DVec3,
    shown: DVec3,
    /// A tick's.
    velocity: DVec3,
}

impl HandPlayout {
    pub(super) fn new(at: DVec3) -> Self {
        Self {
            queue: VecDeque::new(),
            newest: None,
            wait: 0,
            playing: false,
            guessed: false,
            said: at,
            shown: at,
            velocity: DVec3::ZERO,
        }
    }

    /// A target has come. `input` counts all targets of the guest, `hands` of which it moves at a time: what is missing between two is filled in
    /// evenly.
    pub(super) fn take(&mut self, input: u32, hands: usize, target: DVec3) {
        let step = self.newest.map_or(1, |newest| input.wrapping_sub(newest)) / hands.max(1) as u32;
        self.newest = Some(input);
        let from = self.queue.back().copied();
        if let (Some(from), 2..=LONGEST_GAP) = (from, step) {
            self.queue.extend((1..step).map(|k| from.lerp(target, f64::from(k) / f64::from(step))));
        }
        self.queue.push_back(target);
        while self.queue.len() > MOST_WAITING {
            self.queue.pop_front();
        }
    }

    /// The next tick. `depth`: ticks to hold a movement back by; `most`: the hand moves no farther than this, m.
    pub(super) fn next(&mut self, depth: usize, most: f64) -> DVec3 {
        let expected = self.shown + self.velocity;
        if !self.playing && !self.queue.is_empty() {
            if self.wait == 0 {
                self.wait = depth.max(1);
            }
            self.wait -= 1;
            self.playing = self.wait == 0;
        }
        let mut to = self.shown;
        if self.playing {
            // A burst after a gap, or a guest whose clock is faster: one more than its turn, until the queue is what it should be.
            let skipped = if self.queue.len() > depth + 2 { self.queue.pop_front() } else { None };
            match self.queue.pop_front() {
                Some(target) => {
                    let follows = skipped.is_none() && !self.guessed;
                    let offset = if follows { self.shown - self.said } else { expected - target };
                    let before = skipped.unwrap_or(self.said);
                    if !self.guessed {
                        self.velocity = target - before;
                    }
                    (self.said, self.guessed) = (target, false);
                    to = target + faded(offset, most);
                }
                None => {
                    self.velocity *= SLOWING;
                    self.playing = self.velocity.length() > 1e-4 * most;
                    if self.playing {
                        self.guessed = true;
                        to = self.shown + self.velocity;
                    } else {
                        self.velocity = DVec3::ZERO;
                    }
                }
            }
        }
        if !self.playing {
            // A guest that rests says so a few times only: what is left of a correction fades in
            // silence, too.
            to = self.said + faded(self.shown - self.said, most);
        }
        // However wild the targets, the hand moves no faster than a hand.
        let way = to - self.shown;
        self.shown = if way.length() <= most { to } else { self.shown + way.clamp_length_max(most) };
        self.shown
    }
}

/// What is left of a correction after a tick. One so small is none: then the guest recognises its
/// own targets.
fn faded(offset: DVec3, most: f64) -> DVec3 {
    let offset = offset * FADE;
    if offset.length() < 1e-4 * most { DVec3::ZERO } else { offset }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MOST: f64 = 0.5;

    /// A hand that circles, 40 targets a second.
    fn circle(tick: u32) -> DVec3 {
        let t = f64::from(tick) / 40.0;
        DVec3::new(0.1 * (3.0 * t).sin(), 0.1 * (3.0 * t).cos() - 0.1, 0.0)
    }

    /// What arrives, as (the host's tick, the target's number): played, and the largest second difference of it, m.
    fn play(arrivals: &[(u32, u32)], ticks: u32, depth: usize) -> (Vec<DVec3>, f64) {
        let mut hand = HandPlayout::new(DVec3::ZERO);
        let mut played = Vec::new();
        for tick in 0..ticks {
            for &(_, input) in arrivals.iter().filter(|(at, _)| *at == tick) {
                hand.take(input, 1, circle(input));
            }
            played.push(hand.next(depth, MOST));
        }
        let jerk = |w: &[DVec3]| (w[0] - 2.0 * w[1] + w[2]).length();
        let worst = played.windows(3).map(jerk).fold(0.0, f64::max);
        (played, worst)
    }

    /// Of the circle itself: 0.1 m (3 / 40)^2, and the start from rest, 0.1 m x 3 / 40.
    const EVEN: f64 = 0.0076;

    #[test]
    fn targets_that_come_unevenly_are_played_evenly_and_exactly() {
        // Up to three at once, then none for two ticks.
        let arrivals: Vec<(u32, u32)> = (0..200).map(|input| ((input / 3) * 3 + 3, input)).collect();
        let (played, worst) = play(&arrivals, 190, 3);
        assert!(worst < EVEN, "{worst}");
        let first = played.iter().position(|at| *at == circle(0) || *at == circle(1)).unwrap() as u32;
        for tick in 20..180 {
            // Every target in its turn, to the bit.
            let at = played[tick as usize];
            assert!((0..12).any(|lag| at == circle(tick - lag)), "tick {tick}, begun at {first}");
        }
    }

    #[test]
    fn gaps_and_bursts_bend_the_path_and_do_not_break_it() {
        // Ten targets are late together by half a second; twelve others are lost.
        let arrivals: Vec<(u32, u32)> = (0..300)
            .filter(|input| !(150..162).contains(input))
            .map(|input| (if (80..90).contains(&input) { 100 } else { input + 2 }, input))
            .collect();
        let (played, worst) = play(&arrivals, 300, 2);
        // A jump to where the hand is by then would be 20 x 0.0075 m.
        assert!(worst < 0.06, "{worst}");
        let lag = (0..10).find(|lag| played[299] == circle(299 - lag));
        assert!(lag.is_some(), "and it is found again exactly");
    }

    #[test]
    fn after_a_long_gap_the_path_bends_too() {
        for lost in [14, 16, 20, 30] {
            let arrivals: Vec<(u32, u32)> = (0..300)
                .filter(|input| !(150..150 + lost).contains(input))
                .map(|input| (input + 2, input))
                .collect();
            let (played, worst) = play(&arrivals, 300, 2);
            assert!(worst < 0.08, "{lost} targets lost: {worst}");
            assert!((0..10).any(|lag| played[299] == circle(299 - lag)), "{lost} targets lost");
        }
    }

    #[test]
    fn a_hand_that_is_thrown_moves_no_faster_than_a_hand() {
        let mut hand = HandPlayout::new(DVec3::ZERO);
        hand.take(1, 1, DVec3::X * 1e6);
        let mut at = DVec3::ZERO;
        for _ in 0..50 {
            let next = hand.next(1, MOST);
            assert!(next.distance(at) <= MOST * 1.000_001);
            at = next;
        }
        // Far more than may wait: the oldest go.
        for input in 0..10_000 {
            hand.take(input, 1, circle(input));
        }
        assert!(hand.queue.len() <= MOST_WAITING);
    }

    /// A guest that rests says so six times and is silent then.
    #[test]
    fn a_silent_hand_comes_to_rest_where_it_was_said() {
        let mut hand = HandPlayout::new(DVec3::ZERO);
        for input in 0..5 {
            hand.take(input, 1, DVec3::X * 0.01 * f64::from(input));
            hand.next(1, MOST);
        }
        // A tick without a target is guessed, so what comes next is a correction that fades.
        hand.next(1, MOST);
        let end = DVec3::Y * 0.3;
        for input in 5..11 {
            hand.take(input, 1, end);
            hand.next(1, MOST);
        }
        for _ in 0..40 {
            hand.next(1, MOST);
        }
        assert_eq!(hand.next(1, MOST), end);
    }

    #[test]
    fn a_hand_that_rests_and_moves_again_is_where_it_says() {
        let mut hand = HandPlayout::new(DVec3::ZERO);
        for input in 0..10 {
            hand.take(input, 1, DVec3::X * 0.01 * f64::from(input));
            hand.next(2, MOST);
        }
        for _ in 0..40 {
            hand.next(2, MOST);
        }
        let end = DVec3::X * 0.09;
        hand.take(10, 1, end);
        for _ in 0..60 {
            hand.next(2, MOST);
        }
        // It went on a little when nothing came, and went back.
        assert_eq!(hand.next(2, MOST), end);
        for input in 11..80 {
            hand.take(input, 1, end);
            hand.next(2, MOST);
        }
        assert_eq!(hand.next(2, MOST), end);
    }
}
