//! Where between two ticks a frame falls.

use std::time::Duration;

/// Follows the session's playout clock from outside: it is only seen which tick is shown after each update.
///
/// If tick `n` is the newest at time `now`, tick 0 was due at some `e` with `e + n h <= now < e + (n + 1) h`. Holding `e` within these
/// bounds, frame after frame, finds it to within the smallest remainder that a frame happened to have, and follows the clock when it is
/// slewed. The error moves the picture by that part of a tick, evenly; it never jumps as the frame's own time would.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Phase {
    zero: Option<f64>,
}

impl Phase {
    /// The fraction of a tick, 0 to 1, that has passed since `tick` was due.
    pub(crate) fn fraction(&mut self, tick: u64, step: f64, now: Duration) -> f64 {
        let latest = now.as_secs_f64() - tick as f64 * step;
        let zero = self.zero.unwrap_or(latest).clamp(latest - step, latest);
        self.zero = Some(zero);
        if step > 0.0 { ((latest - zero) / step).clamp(0.0, 1.0) } else { 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_picture_moves_evenly_though_frames_and_ticks_beat() {
        // Ticks at 40 Hz, due 7 ms after the full; frames at 60 Hz with 3 ms of jitter.
        let (step, due) = (0.025, 0.007);
        let mut phase = Phase::default();
        let mut jitter = 1u64;
        let mut worst: f64 = 0.0;
        for frame in 0..600 {
            jitter = jitter.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let now = 1.0 + f64::from(frame) / 60.0 + 0.003 * (jitter >> 40) as f64 / (1u64 << 24) as f64;
            let tick = ((now - due) / step).floor();
            let shown = tick + phase.fraction(tick as u64, step, Duration::from_secs_f64(now));
            let error = shown - (now - due) / step;
            // A second to settle in.
            if frame > 60 {
                worst = worst.max(error.abs());
            }
        }
        // A remainder below 0.06 of a tick comes by within a second.
        assert!(worst < 0.1, "the shown time is off by {worst} of a tick");
    }

    #[test]
    fn a_jump_of_the_clock_is_followed() {
        let mut phase = Phase::default();
        assert_eq!(phase.fraction(10, 0.025, Duration::from_secs(1)), 0.0);
        let fraction = phase.fraction(1_000, 0.025, Duration::from_millis(1_010));
        assert!((0.0..=1.0).contains(&fraction));
        assert!(phase.fraction(1_000, 0.0, Duration::from_millis(1_020)) == 1.0);
    }
}
