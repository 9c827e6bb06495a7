//! Sequence numbers, loss accounting and rate budgets: the parts that both sides of a session share.

use std::time::Duration;

use super::LinkStats;
use crate::wire::Report;

/// Counts what arrives from one sender by its sequence numbers.
#[derive(Debug, Clone, Default)]
pub(crate) struct Tally {
    started: bool,
    first: u64,
    highest: u64,
    received: u64,
    /// Bit i: sequence `highest - i` has arrived. A second copy is not counted.
    window: u64,
}

impl Tally {
    /// Takes a sequence number; false for a copy of one that has arrived.
    pub(crate) fn take(&mut self, sequence: u16) -> bool {
        if !self.started {
            self.started = true;
            self.first = u64::from(sequence) + 0x1_0000;
            self.highest = self.first;
            self.window = 1;
            self.received = 1;
            return true;
        }
        // The full number nearest to the highest seen.
        let delta = i64::from(sequence.wrapping_sub(self.highest as u16) as i16);
        let full = self.highest.saturating_add_signed(delta);
        if full > self.highest {
            let ahead = full - self.highest;
            self.window = if ahead < 64 { self.window << ahead | 1 } else { 1 };
            self.highest = full;
        } else {
            let back = self.highest - full;
            if back >= 64 {
                // Too old to know whether it is a copy; far-off garbage must not count as received.
                return false;
            }
            if self.window >> back & 1 == 1 {
                return false;
            }
            self.window |= 1 << back;
        }
        self.received += 1;
        true
    }

    pub(crate) fn report(&self) -> Report {
        let sent = if self.started { self.highest + 1 - self.first } else { 0 };
        Report { received: self.received as u32, highest: sent as u32 }
    }

    /// Share of what was sent up to the highest number that has not arrived.
    pub(crate) fn loss(&self) -> f64 {
        loss_of(self.report())
    }
}

/// The share lost according to a report.
pub(crate) fn loss_of(report: Report) -> f64 {
    if report.highest == 0 {
        0.0
    } else {
        (1.0 - f64::from(report.received) / f64::from(report.highest)).clamp(0.0, 1.0)
    }
}

/// A token bucket.
#[derive(Debug, Clone)]
pub(crate) struct Budget {
    rate: f64,
    most: f64,
    left: f64,
    at: Duration,
}

impl Budget {
    /// `rate` a second, at most `most` at once; full at the beginning.
    pub(crate) fn new(rate: f64, most: f64) -> Self {
        Self { rate, most, left: most, at: Duration::ZERO }
    }

    fn refill(&mut self, now: Duration) {
        let passed = now.saturating_sub(self.at).as_secs_f64();
        self.left = (self.left + passed * self.rate).min(self.most);
        self.at = self.at.max(now);
    }

    /// Whether `amount` is there.
    pub(crate) fn has(&mut self, now: Duration, amount: f64) -> bool {
        self.refill(now);
        self.left >= amount
    }

    /// Takes `amount` if it is there.
    pub(crate) fn spend(&mut self, now: Duration, amount: f64) -> bool {
        let there = self.has(now, amount);
        if there {
            self.left -= amount;
        }
        there
    }

    /// When `amount` will be there.
    pub(crate) fn ready_at(&self, amount: f64) -> Duration {
        let missing = (amount.min(self.most) - self.left).max(0.0);
        self.at
            + Duration::from_secs_f64((missing / self.rate.max(1e-9)).min(3600.0))
            + Duration::from_micros(1)
    }
}

/// Smoothed round trip (RFC 6298: gains 1/8 and 1/4).
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RoundTrip {
    smooth: f64,
    deviation: f64,
    known: bool,
}

impl RoundTrip {
    pub(crate) fn sample(&mut self, rtt: Duration) {
        let x = rtt.as_secs_f64();
        if self.known {
            self.deviation += 0.25 * ((x - self.smooth).abs() - self.deviation);
            self.smooth += 0.125 * (x - self.smooth);
        } else {
            (self.smooth, self.deviation, self.known) = (x, 0.5 * x, true);
        }
    }

    pub(crate) fn smooth(&self) -> Duration {
        Duration::from_secs_f64(self.smooth.clamp(0.0, 3600.0))
    }

    pub(crate) fn write(&self, stats: &mut LinkStats) {
        stats.round_trip = self.smooth();
        stats.jitter = Duration::from_secs_f64(self.deviation.clamp(0.0, 3600.0));
    }

    pub(crate) fn is_known(&self) -> bool {
        self.known
    }
}
