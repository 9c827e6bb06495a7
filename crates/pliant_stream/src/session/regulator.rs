//! How much a guest's stream is cut down so that its path bears it.

use std::time::Duration;

use crate::wire::{Payload, StreamSubscription};

/// Judged this often.
const WINDOW: Duration = Duration::from_secs(1);
/// A round trip that is longer than its least by this means a queue, s.
const QUEUE: f64 = 0.05;
/// Quiet windows before more is tried again; doubles each time that it was too much.
const PATIENCE: u32 = 5;
/// The last level.
const LAST: u8 = 6;

/// Lowers and raises the level of one guest's stream.
#[derive(Debug, Clone)]
pub(crate) struct Regulator {
    level: u8,
    since: Option<(Duration, u64)>,
    least: f64,
    last: f64,
    calm: u32,
    patience: u32,
}

impl Default for Regulator {
    fn default() -> Self {
        Self { level: 0, since: None, least: 3600.0, last: 0.0, calm: 0, patience: PATIENCE }
    }
}

impl Regulator {
    /// Judges the last window. `bytes`: sent in all; `round_trip`: the lesser of the last two, unsmoothed; `rate`: bits a second that are allowed.
    pub(crate) fn judge(&mut self, now: Duration, bytes: u64, round_trip: Duration, rate: f64) {
        let (from, before) = *self.since.get_or_insert((now, bytes));
        let passed = now.saturating_sub(from);
        if passed < WINDOW {
            return;
        }
        self.since = Some((now, bytes));
        let bits = 8.0 * bytes.saturating_sub(before) as f64 / passed.as_secs_f64();
        let round_trip = round_trip.as_secs_f64();
        if round_trip > 0.0 {
            // The least is forgotten within a minute: routes change for longer ones too.
            self.least = round_trip.min(self.least + 0.02 * (round_trip - self.least).clamp(0.0, 1.0));
        }
        // A queue that shrinks by a third in a second is already being dealt with.
        let excess = round_trip - self.least;
        let queued = excess > QUEUE && excess > 0.7 * self.last;
        self.last = excess;
        if bits > rate || queued {
            if self.calm > 0 && self.calm < self.patience {
                // It was raised not long ago, and that was too much.
                self.patience = (self.patience * 2).min(600);
            }
            self.level = (self.level + 1).min(LAST);
            self.calm = 0;
        } else if self.level > 0 {
            self.calm += 1;
            // The next level up costs less than half as much again.
            if self.calm >= self.patience && bits < 0.6 * rate {
                self.level -= 1;
                self.calm = 1;
            }
        }
    }

    /// The present level; 0: everything that was wished.
    pub(crate) fn level(&self) -> u8 {
        self.level
    }

    /// What is left of a wish: repeats go first, then refreshes, then modes.
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
            let modes = usize::from(subscription.modes).min(model_modes) >> (self.level - 3);
            subscription.modes = modes.max(8).min(usize::from(subscription.modes)) as u16;
            if subscription.payload == Payload::Forces {
                subscription.refresh = subscription.refresh.saturating_mul(2);
            }
        }
        subscription
    }
}
