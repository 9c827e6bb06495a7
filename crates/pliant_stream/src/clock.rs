//! Estimates the offset between two clocks from four timestamps.

use std::collections::VecDeque;
use std::time::Duration;

/// Number of exchanges that the estimate uses.
const WINDOW: usize = 16;
/// Slew rate of the offset toward a better estimate, as a share of the time that passes.
const SLEW: f64 = 0.01;
/// Smallest offset error that counts as a clock jump, s, on top of half the round trip of the
/// exchange.
const JUMP: f64 = 0.5;

/// Estimates `host clock - own clock`.
///
/// Of the last 16 exchanges, the one with the smallest round trip counts. The offset is slewed
/// toward its value by at most 1 %.
///
/// `offset = ((t2 - t1) + (t3 - t4)) / 2`, `round trip = (t4 - t1) - (t3 - t2)` (Mills, RFC 5905).
#[derive(Debug, Clone, Default)]
pub struct ClockEstimate {
    samples: VecDeque<(f64, f64)>,
    offset: Option<f64>,
    at: f64,
}

impl ClockEstimate {
    /// Adds an exchange and returns its round trip.
    ///
    /// All timestamps are in microseconds. The result is `None` when the timestamps contradict each
    /// other.
    pub fn sample(&mut self, t1: u64, t2: u64, t3: u64, t4: u64) -> Option<Duration> {
        let spent = t3.checked_sub(t2)?;
        let round = t4.checked_sub(t1)?.checked_sub(spent)?;
        let difference = |a: u64, b: u64| (i128::from(a) - i128::from(b)) as f64 * 1e-6;
        let offset = 0.5 * (difference(t2, t1) + difference(t3, t4));
        let round_s = round as f64 * 1e-6;
        if self.offset.is_some_and(|old| (offset - old).abs() > JUMP + 0.5 * round_s) {
            // An exchange is never off by more than half its round trip. A larger difference means
            // that a clock jumped, and the older exchanges describe the clock before the jump.
            self.samples.clear();
            self.offset = None;
        }
        if self.samples.len() >= WINDOW {
            self.samples.pop_front();
        }
        self.samples.push_back((round_s, offset));
        let now = t4 as f64 * 1e-6;
        let best = self.samples.iter().min_by(|a, b| a.0.total_cmp(&b.0)).map_or(offset, |s| s.1);
        self.offset = Some(match self.offset {
            Some(old) => {
                let room = SLEW * (now - self.at).max(0.0);
                old + (best - old).clamp(-room, room)
            }
            None => best,
        });
        self.at = now;
        Some(Duration::from_micros(round))
    }

    /// Host clock minus own clock, s; `None` before the first exchange.
    pub fn offset(&self) -> Option<f64> {
        self.offset
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn symmetric_path_gives_the_offset_exactly() {
        let mut clock = ClockEstimate::default();
        // The host clock is 5 s ahead, each direction takes 100 ms and the host spends 2 ms.
        let rtt = clock.sample(1_000_000, 6_100_000, 6_102_000, 1_202_000);
        assert_eq!(rtt, Some(Duration::from_millis(200)));
        assert!((clock.offset().unwrap() - 5.0).abs() < 1e-9);
    }

    #[test]
    fn the_shortest_round_trip_counts_and_moves_the_offset_slowly() {
        let mut clock = ClockEstimate::default();
        // The request is delayed by 150 ms: the offset is +50 ms.
        clock.sample(0, 150_000, 150_000, 200_000);
        assert!((clock.offset().unwrap() - 0.05).abs() < 1e-9);
        // Both directions take 10 ms: the offset is 0.
        clock.sample(1_000_000, 1_010_000, 1_010_000, 1_020_000);
        // After 0.82 s at 1 % the offset is 8.2 ms closer.
        assert!((clock.offset().unwrap() - (0.05 - 0.0082)).abs() < 1e-6);
    }

    #[test]
    fn a_clock_that_jumps_an_hour_is_followed() {
        let mut clock = ClockEstimate::default();
        for k in 0..20 {
            let t = k * 250_000;
            clock.sample(t, t + 10_000, t + 10_000, t + 20_000);
        }
        let hour = 3_600_000_000;
        for k in 20..24 {
            let t = k * 250_000;
            clock.sample(t, t + hour + 10_000, t + hour + 10_000, t + 20_000);
        }
        assert!((clock.offset().unwrap() - 3600.0).abs() < 0.01, "{:?}", clock.offset());
    }

    #[test]
    fn senseless_stamps_are_refused() {
        let mut clock = ClockEstimate::default();
        assert_eq!(clock.sample(10, 20, 10, 30), None, "sent before received");
        assert_eq!(clock.sample(30, 20, 20, 10), None, "back before it left");
        assert_eq!(clock.sample(u64::MAX, 0, u64::MAX, 0), None);
    }
}
