//! What arrives of what was sent, by sequence numbers.

use crate::wire::Report;

/// What a sequence number says of its datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Arrival {
    /// Its first copy.
    New,
    /// It has arrived before.
    Copy,
    /// So far behind that nobody knows. It is not counted: the number may be garbage.
    Old,
}

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
    pub(crate) fn take(&mut self, sequence: u16) -> Arrival {
        if !self.started {
            self.started = true;
            self.first = u64::from(sequence) + 0x1_0000;
            self.highest = self.first;
            self.window = 1;
            self.received = 1;
            return Arrival::New;
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
                return Arrival::Old;
            }
            if self.window >> back & 1 == 1 {
                return Arrival::Copy;
            }
            self.window |= 1 << back;
        }
        self.received += 1;
        Arrival::New
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
