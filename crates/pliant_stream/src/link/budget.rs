//! Rate limits.

use std::time::Duration;

/// A token bucket.
#[derive(Debug, Clone)]
pub(crate) struct Budget {
    rate: f64,
    most: f64,
    left: f64,
    at: Duration,
}

impl Budget {
    /// Creates a full bucket that gains `rate` per second and holds at most `most`.
    pub(crate) fn new(rate: f64, most: f64) -> Self {
        Self { rate, most, left: most, at: Duration::ZERO }
    }

    fn refill(&mut self, now: Duration) {
        let passed = now.saturating_sub(self.at).as_secs_f64();
        self.left = (self.left + passed * self.rate).min(self.most);
        self.at = self.at.max(now);
    }

    /// Returns whether `amount` is available.
    pub(crate) fn has(&mut self, now: Duration, amount: f64) -> bool {
        self.refill(now);
        self.left >= amount
    }

    /// Takes `amount` if it is available, and returns whether it was.
    pub(crate) fn spend(&mut self, now: Duration, amount: f64) -> bool {
        let there = self.has(now, amount);
        if there {
            self.left -= amount;
        }
        there
    }

    /// Returns the time at which `amount` will be available.
    pub(crate) fn ready_at(&self, amount: f64) -> Duration {
        let missing = (amount.min(self.most) - self.left).max(0.0);
        self.at
            + Duration::from_secs_f64((missing / self.rate.max(1e-9)).min(3600.0))
            + Duration::from_micros(1)
    }
}
