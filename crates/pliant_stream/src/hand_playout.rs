//! Plays out a guest's hand, one target per tick, from targets that arrive late, unevenly and with
//! gaps.

use std::collections::VecDeque;

use nalgebra::Vector3;

/// Most targets that wait. Older ones are dropped.
const MAX_WAITING: usize = 64;
/// Longest gap in targets that counts as a loss. A longer gap is a pause.
const LONGEST_GAP: u32 = 8;
/// Factor by which a correction fades per tick. After six ticks about a twentieth is left.
const FADE: f64 = 0.6;
/// Slowest hand that counts, as a share of the farthest that a hand may move in a tick, and factor
/// by which the speed of a hand is forgotten per tick. A correction moves the hand no faster than
/// the hand has moved of late.
const SLOWEST: f64 = 0.01;
const FORGETTING: f64 = 0.98;
/// Largest factor by which the speed of a hand grows per tick.
const GROWTH: f64 = 1.5;
/// Factor by which an extrapolated hand slows down per tick while no target arrives.
const SLOWING: f64 = 0.7;

/// Plays back a guest's targets one per tick, as the guest sent them.
///
/// The first target of a movement is delayed by `depth` ticks. Targets that arrive slightly late
/// are then still in time, and the hand repeats the guest's movement exactly, with that delay. The
/// guest therefore recognizes its own targets in the frames, and knows how far ahead its hand is.
/// If a target is missing during a movement, the hand goes on and slows down. The error of this
/// extrapolation fades, like every jump, no faster than the hand has moved of late, so that the
/// hand does not jerk.
#[derive(Debug, Clone)]
pub struct HandPlayout {
    queue: VecDeque<Vector3<f64>>,
    newest: Option<u32>,
    /// Ticks until the first waiting target is played.
    wait: usize,
    playing: bool,
    /// Whether the last tick was extrapolated.
    guessed: bool,
    /// The target that was played last (`played`), and the position of the hand (`displayed`).
    played: Vector3<f64>,
    displayed: Vector3<f64>,
    /// Velocity of the hand, meters per tick.
    velocity: Vector3<f64>,
    /// Largest speed of the received targets of late, meters per tick.
    usual: f64,
}

impl HandPlayout {
    /// Creates a hand that rests at a place, m.
    pub fn new(at: Vector3<f64>) -> Self {
        Self {
            queue: VecDeque::new(),
            newest: None,
            wait: 0,
            playing: false,
            guessed: false,
            played: at,
            displayed: at,
            velocity: Vector3::zeros(),
            usual: 0.0,
        }
    }

    /// Number of targets that wait to be played.
    pub fn waiting(&self) -> usize {
        self.queue.len()
    }

    /// Takes a received target. `input` numbers all targets of the guest, which moves `hands` hands
    /// at a time. Missing targets between two received ones are interpolated linearly.
    pub fn take(&mut self, input: u32, hands: usize, target: Vector3<f64>) {
        let step = self.newest.map_or(1, |newest| input.wrapping_sub(newest)) / hands.max(1) as u32;
        self.newest = Some(input);
        let from = self.queue.back().copied();
        if let (Some(from), 2..=LONGEST_GAP) = (from, step) {
            self.queue.extend((1..step).map(|k| from.lerp(&target, f64::from(k) / f64::from(step))));
        }
        self.queue.push_back(target);
        while self.queue.len() > MAX_WAITING {
            self.queue.pop_front();
        }
    }

    /// Returns the hand's position in the next tick. `depth` is the delay of a movement in ticks,
    /// and `most` is the farthest that the hand may move, m.
    pub fn next(&mut self, depth: usize, most: f64) -> Vector3<f64> {
        let expected = self.displayed + self.velocity;
        self.usual = (self.usual * FORGETTING).max(SLOWEST * most).min(most);
        if !self.playing && !self.queue.is_empty() {
            if self.wait == 0 {
                self.wait = depth.max(1);
            }
            self.wait -= 1;
            self.playing = self.wait == 0;
        }
        let mut to = self.displayed;
        if self.playing {
            // After a burst, or with a guest whose clock is faster, one target is skipped per tick
            // until the queue has its proper length.
            let skipped = if self.queue.len() > depth + 2 { self.queue.pop_front() } else { None };
            match self.queue.pop_front() {
                Some(target) => {
                    let way = target - skipped.unwrap_or(self.played);
                    // A hand that has been out of touch jumps between two of its targets.
                    let fastest = (GROWTH * self.usual).min(most);
                    let jumps = way.norm() > fastest;
                    let follows = skipped.is_none() && !self.guessed && !jumps;
                    let offset = if follows { self.displayed - self.played } else { expected - target };
                    if !self.guessed {
                        self.velocity = way.cap_magnitude(fastest);
                        self.usual = self.usual.max(self.velocity.norm());
                    }
                    (self.played, self.guessed) = (target, false);
                    to = target + faded(offset, self.usual, most);
                }
                None => {
                    self.velocity *= SLOWING;
                    self.playing = self.velocity.norm() > 1e-4 * most;
                    if self.playing {
                        self.guessed = true;
                        to = self.displayed + self.velocity;
                    } else {
                        self.velocity = Vector3::zeros();
                    }
                }
            }
        }
        if !self.playing {
            // A resting guest repeats its target only a few times, so the rest of a correction must
            // also fade without new targets.
            to = self.played + faded(self.displayed - self.played, self.usual, most);
        }
        // The speed of the hand is limited, whatever the targets.
        let way = to - self.displayed;
        self.displayed = if way.norm() <= most { to } else { self.displayed + way.cap_magnitude(most) };
        self.displayed
    }
}

/// Returns the part of a correction that is left after a tick in which the hand moves by at most
/// `usual`. A very small part becomes zero, so that the guest recognizes its own targets.
fn faded(offset: Vector3<f64>, usual: f64, most: f64) -> Vector3<f64> {
    let size = offset.norm();
    let left = (size * FADE).max(size - usual);
    if left > 1e-4 * most { offset * (left / size) } else { Vector3::zeros() }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MAX: f64 = 0.5;

    /// A hand that moves on a circle, with 40 targets per second.
    fn circle(tick: u32) -> Vector3<f64> {
        let t = f64::from(tick) / 40.0;
        Vector3::new(0.1 * (3.0 * t).sin(), 0.1 * (3.0 * t).cos() - 0.1, 0.0)
    }

    /// Plays `arrivals`, pairs of the host's tick and the target's number. Returns the positions
    /// and their largest second difference, m.
    fn play(arrivals: &[(u32, u32)], ticks: u32, depth: usize) -> (Vec<Vector3<f64>>, f64) {
        let mut hand = HandPlayout::new(Vector3::zeros());
        let mut played = Vec::new();
        for tick in 0..ticks {
            for &(_, input) in arrivals.iter().filter(|(at, _)| *at == tick) {
                hand.take(input, 1, circle(input));
            }
            played.push(hand.next(depth, MAX));
        }
        let jerk = |w: &[Vector3<f64>]| (w[0] - 2.0 * w[1] + w[2]).norm();
        let worst = played.windows(3).map(jerk).fold(0.0, f64::max);
        (played, worst)
    }

    /// Bound on the second difference of the circle itself, m: 0.1 m (3 / 40)^2, and 0.1 m x 3 / 40
    /// for the start from rest.
    const EVEN: f64 = 0.0076;

    #[test]
    fn targets_that_come_unevenly_are_played_evenly_and_exactly() {
        // Up to three targets arrive at once, then none for two ticks.
        let arrivals: Vec<(u32, u32)> = (0..200).map(|input| ((input / 3) * 3 + 3, input)).collect();
        let (played, worst) = play(&arrivals, 190, 3);
        assert!(worst < EVEN, "{worst}");
        let first = played.iter().position(|at| *at == circle(0) || *at == circle(1)).unwrap() as u32;
        for tick in 20..180 {
            // Every target is played in its turn, exact to the bit.
            let at = played[tick as usize];
            assert!((0..12).any(|lag| at == circle(tick - lag)), "tick {tick}, begun at {first}");
        }
    }

    #[test]
    fn gaps_and_bursts_bend_the_path_and_do_not_break_it() {
        // Ten targets arrive together, up to half a second late. Twelve others are lost.
        let arrivals: Vec<(u32, u32)> = (0..300)
            .filter(|input| !(150..162).contains(input))
            .map(|input| (if (80..90).contains(&input) { 100 } else { input + 2 }, input))
            .collect();
        let (played, worst) = play(&arrivals, 300, 2);
        // A jump to the hand's position by then would be 20 x 0.0075 m.
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
        let mut hand = HandPlayout::new(Vector3::zeros());
        hand.take(1, 1, Vector3::x() * 1e6);
        let mut at = Vector3::zeros();
        for _ in 0..50 {
            let next = hand.next(1, MAX);
            assert!((next - at).norm() <= MAX * 1.000_001);
            at = next;
        }
        // Many more targets than may wait arrive, and the oldest are dropped.
        for input in 0..10_000 {
            hand.take(input, 1, circle(input));
        }
        assert!(hand.queue.len() <= MAX_WAITING);
    }

    /// A resting guest sends its target six times and is then silent.
    #[test]
    fn a_silent_hand_comes_to_rest_where_it_was_said() {
        let mut hand = HandPlayout::new(Vector3::zeros());
        for input in 0..5 {
            hand.take(input, 1, Vector3::x() * 0.01 * f64::from(input));
            hand.next(1, MAX);
        }
        // A tick without a target is extrapolated, so the next target causes a correction that
        // fades.
        hand.next(1, MAX);
        let end = Vector3::y() * 0.3;
        for input in 5..11 {
            hand.take(input, 1, end);
            hand.next(1, MAX);
        }
        // It is led there at the speed of a hand.
        for _ in 0..80 {
            hand.next(1, MAX);
        }
        assert_eq!(hand.next(1, MAX), end);
    }

    #[test]
    fn a_bound_of_zero_gives_no_infinity() {
        let mut hand = HandPlayout::new(Vector3::zeros());
        for input in 1..20 {
            hand.take(input, 1, Vector3::y());
            let at = hand.next(1, 0.0);
            assert!(at.iter().all(|x| x.is_finite()), "{at}");
        }
        // No panic either where the bound is not a number.
        hand.next(1, f64::NAN);
    }

    #[test]
    fn a_hand_that_rests_and_moves_again_is_where_it_says() {
        let mut hand = HandPlayout::new(Vector3::zeros());
        for input in 0..10 {
            hand.take(input, 1, Vector3::x() * 0.01 * f64::from(input));
            hand.next(2, MAX);
        }
        for _ in 0..40 {
            hand.next(2, MAX);
        }
        let end = Vector3::x() * 0.09;
        hand.take(10, 1, end);
        for _ in 0..60 {
            hand.next(2, MAX);
        }
        // The hand went on a little when no target arrived, and then returned.
        assert_eq!(hand.next(2, MAX), end);
        for input in 11..80 {
            hand.take(input, 1, end);
            hand.next(2, MAX);
        }
        assert_eq!(hand.next(2, MAX), end);
    }
}
