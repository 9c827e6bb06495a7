//! Reduces a guest's stream to what its path carries.

use std::time::Duration;

use crate::link::JUDGED;
use crate::wire::{Payload, StreamSubscription};

/// Length of the window over which the stream is judged.
const WINDOW: Duration = Duration::from_secs(1);
/// Excess of round trips over their minimum that indicates a queue, s, where they do not scatter.
const QUEUE: f64 = 0.05;
/// Where they scatter, they exceed it by more: by so many times the mean excess of the newest over
/// the smallest of the last ones, of which no more than this is counted, s. A queue that stands
/// lengthens all, and is no scatter.
const SCATTER: f64 = 2.5;
const MOST_SCATTER: f64 = 0.07;
const WINDOWS: f64 = 16.0;
/// Windows without scatter that are taken to have been before the first.
const QUIET: f64 = 3.0;
/// Number of quiet windows before the level is lowered again. It doubles each time that lowering it
/// was too much.
const PATIENCE: u32 = 5;
/// The highest level, which reduces the stream most.
const LAST: u8 = 6;

/// Sets the level of one guest's stream.
#[derive(Debug, Clone)]
pub(crate) struct Regulator {
    level: u8,
    since: Option<(Duration, u64)>,
    least: f64,
    last: f64,
    scatter: f64,
    windows: f64,
    calm: u32,
    patience: u32,
}

impl Default for Regulator {
    fn default() -> Self {
        Self {
            level: 0,
            since: None,
            least: 3600.0,
            last: 0.0,
            scatter: 0.0,
            windows: QUIET,
            calm: 0,
            patience: PATIENCE,
        }
    }
}

impl Regulator {
    /// Judges the last window. `bytes` is the total sent so far, `round_trips` are the last
    /// unsmoothed ones, and `rate` is the allowed rate in bit/s.
    pub(crate) fn judge(&mut self, now: Duration, bytes: u64, round_trips: [Duration; JUDGED], rate: f64) {
        let (from, before) = *self.since.get_or_insert((now, bytes));
        let passed = now.saturating_sub(from);
        if passed < WINDOW {
            return;
        }
        self.since = Some((now, bytes));
        let bits = 8.0 * bytes.saturating_sub(before) as f64 / passed.as_secs_f64();
        let [.., newest] = round_trips.map(|t| t.as_secs_f64());
        let round_trip = round_trips.into_iter().min().unwrap_or_default().as_secs_f64();
        if round_trip > 0.0 {
            // The minimum is forgotten within a minute, since routes also change to longer ones.
            self.least = round_trip.min(self.least + 0.02 * (round_trip - self.least).clamp(0.0, 1.0));
        }
        // A queue that shrinks by a third in a second is already being resolved.
        let excess = round_trip - self.least;
        let queued = excess > QUEUE + SCATTER * self.scatter && excess > 0.7 * self.last;
        self.last = excess;
        if round_trip > 0.0 {
            self.windows = (self.windows + 1.0).min(WINDOWS);
            let scatter = (newest - round_trip).clamp(0.0, MOST_SCATTER);
            self.scatter += (scatter - self.scatter) / self.windows;
        }
        if bits > rate || queued {
            if self.calm > 0 && self.calm < self.patience {
                // The level was lowered recently, and that was too much.
                self.patience = (self.patience * 2).min(600);
            }
            self.level = (self.level + 1).min(LAST);
            self.calm = 0;
        } else if self.level > 0 {
            self.calm += 1;
            // Lowering the level by one costs less than half as much again.
            if self.calm >= self.patience && bits < 0.6 * rate {
                self.level -= 1;
                self.calm = 1;
            }
        }
    }

    /// The present level; 0 leaves the subscription as it is.
    pub(crate) fn level(&self) -> u8 {
        self.level
    }

    /// Reduces a subscription to the present level: first repeats, then refreshes, then the modes
    /// of a stream of accelerations.
    ///
    /// A stream of reactions keeps all modes. They cost nothing but their refreshes, and a receiver
    /// of fewer has another body: with reduced elasticity one that hardly bends, because the
    /// coordinates that shorten it are missing.
    pub(crate) fn cut(&self, mut subscription: StreamSubscription, model_modes: usize) -> StreamSubscription {
        if self.level >= 1 {
            subscription.repeats = subscription.repeats.min(1);
        }
        if self.level >= 2 {
            subscription.repeats = 0;
        }
        if self.level >= 3 {
            subscription.refresh = subscription.refresh.saturating_mul(2);
        }
        if self.level >= 4 {
            if subscription.payload == Payload::Forces {
                subscription.refresh = subscription.refresh.saturating_mul(2 << (self.level - 3));
            } else {
                let modes = usize::from(subscription.modes).min(model_modes) >> (self.level - 3);
                subscription.modes = modes.max(8).min(usize::from(subscription.modes)) as u16;
            }
        }
        subscription
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::AccelerationCoding;

    #[test]
    fn the_last_level_takes_modes_from_accelerations_only() {
        let regulator = Regulator { level: LAST, ..Regulator::default() };
        for (payload, modes) in
            [(Payload::Forces, 40), (Payload::Accelerations(AccelerationCoding::Visible), 8)]
        {
            let whole = StreamSubscription { payload, modes: 40, repeats: 3, refresh: 15 };
            assert_eq!(Regulator::default().cut(whole, 40), whole);
            let cut = regulator.cut(whole, 40);
            assert_eq!((cut.modes, cut.repeats), (modes, 0));
            // What is refreshed with each frame is at most an eighth of what it was.
            let refreshed = |of: StreamSubscription| f64::from(of.modes) / f64::from(of.refresh);
            assert!(refreshed(cut) <= refreshed(whole) / 8.0, "{cut:?}");
        }
    }
}
