//! Position of a frame between two ticks.

use std::time::Duration;

/// Estimates the session's playout clock from the tick that is displayed after each update.
///
/// If tick `n` is the newest at time `now`, tick 0 was due at some `e` with
/// `e + n h <= now < e + (n + 1) h`. The estimate of `e` is clamped to these bounds in every frame.
/// Its error therefore falls to the smallest remainder of a tick that a frame has had, and the
/// estimate tracks the clock when the clock is slewed. The error shifts the picture evenly by that
/// part of a tick, without the jumps that the frame's own time would cause.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Phase {
    zero: Option<f64>,
}

impl Phase {
    /// Returns the fraction of a tick, 0 to 1, that has passed since `tick` was due.
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
        // The ticks run at 40 Hz and are due 7 ms after the full second. The frames run at 60 Hz
        // with 3 ms of jitter.
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
            // The estimate gets one second to converge.
            if frame > 60 {
                worst = worst.max(error.abs());
            }
        }
        // A remainder below 0.06 of a tick occurs within one second.
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
