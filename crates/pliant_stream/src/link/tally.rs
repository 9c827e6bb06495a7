//! Loss statistics from sequence numbers.

use crate::wire::ReceiverReport;

/// Classifies a datagram by its sequence number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DatagramArrival {
    /// The first copy of the datagram.
    New,
    /// A duplicate.
    Copy,
    /// A number too far behind to tell whether it is a duplicate. It is not counted, since it may
    /// be garbage.
    Old,
}

/// Counts the datagrams of one sender by their sequence numbers.
#[derive(Debug, Clone, Default)]
pub(crate) struct Tally {
    started: bool,
    first: u64,
    highest: u64,
    received: u64,
    /// Bit i is set when sequence `highest - i` has arrived. Duplicates are not counted.
    window: u64,
}

impl Tally {
    pub(crate) fn take(&mut self, sequence: u16) -> DatagramArrival {
        if !self.started {
            self.started = true;
            self.first = u64::from(sequence) + 0x1_0000;
            self.highest = self.first;
            self.window = 1;
            self.received = 1;
            return DatagramArrival::New;
        }
        // The full number is the one nearest to the highest number seen.
        let delta = i64::from(sequence.wrapping_sub(self.highest as u16) as i16);
        let full = self.highest.saturating_add_signed(delta);
        if full > self.highest {
            let ahead = full - self.highest;
            self.window = if ahead < 64 { self.window << ahead | 1 } else { 1 };
            self.highest = full;
        } else {
            let back = self.highest - full;
            if back >= 64 {
                return DatagramArrival::Old;
            }
            if self.window >> back & 1 == 1 {
                return DatagramArrival::Copy;
            }
            self.window |= 1 << back;
        }
        self.received += 1;
        DatagramArrival::New
    }

    pub(crate) fn report(&self) -> ReceiverReport {
        let sent = if self.started { self.highest + 1 - self.first } else { 0 };
        ReceiverReport { received: self.received as u32, highest: sent as u32 }
    }

    /// Share of the datagrams up to the highest number that did not arrive.
    pub(crate) fn loss(&self) -> f64 {
        loss_of(self.report())
    }
}

/// Returns the lost share according to a report.
pub(crate) fn loss_of(report: ReceiverReport) -> f64 {
    if report.highest == 0 {
        0.0
    } else {
        (1.0 - f64::from(report.received) / f64::from(report.highest)).clamp(0.0, 1.0)
    }
}
