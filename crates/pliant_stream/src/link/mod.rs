//! State of one connection, the same for a host's guest, a guest's host and a peer's peer.

mod budget;
mod events;
mod round_trip;
mod stats;
mod tally;

use std::collections::VecDeque;
use std::time::Duration;

pub(crate) use budget::{AwayBudgets, Budget, PatchBudget, SharedBudgets, pay, state_budget};
pub(crate) use events::Events;
pub use stats::LinkStats;

use crate::session::{Channel, Output};
use crate::state::PeerId;
use crate::wire::{Clock, ReceiverReport};
use round_trip::RoundTrip;
use tally::{DatagramArrival, Tally, loss_of};

/// Number of round trips by which a queue is judged.
pub(crate) const JUDGED: usize = 3;
/// Pause between two updates beyond which what comes next may have waited here.
pub(crate) const STOOD_STILL: Duration = Duration::from_millis(45);

/// State of a connection: sequence numbers, loss, round trip, time of the last reception, and
/// counts.
#[derive(Debug)]
pub(crate) struct Link {
    peer: PeerId,
    /// Largest size of a datagram, bytes.
    pub(crate) max_datagram: usize,
    received_at: Duration,
    updated_at: Duration,
    /// The update before the last one, if this process stood still between the two.
    stood_since: Option<Duration>,
    sequence: u16,
    received: Tally,
    round_trip: RoundTrip,
    /// Unsmoothed, the newest last.
    last_round_trips: [Duration; JUDGED],
    /// The last one, until the other side is told.
    measured: Option<Duration>,
    /// Counts, and values that only one role measures. [`Link::stats`] adds the other values.
    pub(crate) stats: LinkStats,
}

impl Link {
    pub(crate) fn new(peer: PeerId, now: Duration, max_datagram: usize) -> Self {
        Self {
            peer,
            max_datagram,
            received_at: now,
            updated_at: now,
            stood_since: None,
            sequence: 0,
            received: Tally::default(),
            round_trip: RoundTrip::default(),
            last_round_trips: [Duration::ZERO; JUDGED],
            measured: None,
            stats: LinkStats::default(),
        }
    }

    /// Restarts the idle timeout, because the other side sent something or is given more time.
    pub(crate) fn received_at(&mut self, now: Duration) {
        self.received_at = now;
    }

    /// Notes the time of an update, which comes after what has arrived was processed.
    pub(crate) fn updated(&mut self, now: Duration) {
        let stood = now.saturating_sub(self.updated_at) > STOOD_STILL;
        self.stood_since = stood.then_some(self.updated_at);
        self.updated_at = now;
    }

    /// Time that a datagram which arrives `now` may have waited for this process, which stood still
    /// before; zero where it did not. Those who know the time of each arrival need this only where
    /// their own network stood still, too. It may be read one update after the process went on.
    pub(crate) fn waited(&self, now: Duration) -> Duration {
        let waited = now.saturating_sub(self.stood_since.unwrap_or(self.updated_at));
        if waited > STOOD_STILL { waited } else { Duration::ZERO }
    }

    /// Returns whether nothing was received for longer than `patience`.
    pub(crate) fn is_silent(&self, now: Duration, patience: Duration) -> bool {
        now.saturating_sub(self.received_at) > patience
    }

    /// Time at which the connection will have been silent for longer than `patience`.
    pub(crate) fn silent_at(&self, patience: Duration) -> Duration {
        self.received_at + patience + Duration::from_millis(1)
    }

    /// Counts a datagram that could be decoded. Returns false for a duplicate.
    pub(crate) fn receive_datagram(&mut self, now: Duration, sequence: u16, bytes: usize) -> bool {
        self.received_at = now;
        let arrival = self.received.take(sequence);
        if arrival == DatagramArrival::New {
            self.stats.datagrams_in += 1;
            self.stats.bytes_in += bytes as u64;
        }
        arrival != DatagramArrival::Copy
    }

    /// Counts a message. The message may still turn out to be invalid.
    pub(crate) fn receive_message(&mut self, now: Duration, bytes: usize) {
        self.received_at = now;
        self.stats.message_bytes_in += bytes as u64;
    }

    /// Counts bytes that could not be decoded or were invalid.
    pub(crate) fn reject(&mut self) {
        self.stats.rejected += 1;
    }

    /// Sends the datagram that `encode` makes from its sequence number.
    pub(crate) fn send_datagram(&mut self, encode: impl FnOnce(u16) -> Vec<u8>, out: &mut VecDeque<Output>) {
        let bytes = encode(self.sequence);
        self.sequence = self.sequence.wrapping_add(1);
        self.stats.datagrams_out += 1;
        self.stats.bytes_out += bytes.len() as u64;
        out.push_back(Output { peer: self.peer, channel: Channel::Datagram, bytes: bytes.into() });
    }

    /// Skips a datagram for which the output queue has no room. The other side counts it as lost.
    pub(crate) fn drop_datagram(&mut self) {
        self.sequence = self.sequence.wrapping_add(1);
    }

    /// Sends a message.
    pub(crate) fn send_message(&mut self, bytes: Vec<u8>, out: &mut VecDeque<Output>) {
        self.stats.message_bytes_out += bytes.len() as u64;
        out.push_back(Output { peer: self.peer, channel: Channel::Message, bytes: bytes.into() });
    }

    /// Stores the other side's report on the datagrams sent from here.
    pub(crate) fn take_report(&mut self, report: ReceiverReport) {
        self.stats.loss_out = loss_of(report);
    }

    /// Returns a clock exchange with the report, and the round trip that was measured since the
    /// last one, without timestamps.
    pub(crate) fn clock(&mut self) -> Clock {
        let round_trip = std::mem::take(&mut self.measured).map_or(0, micros);
        let round_trip = u32::try_from(round_trip).unwrap_or(u32::MAX);
        Clock { report: self.received.report(), round_trip, ..Clock::default() }
    }

    /// Adds a round trip that this side or the other side measured. The datagrams have `waited` for
    /// some part of it at most, because a process stood still. Such a sample is taken for as long
    /// as the path is known to be, where that is possible.
    pub(crate) fn sample_round_trip(&mut self, sample: Duration, waited: Duration) {
        let known = self.round_trip().filter(|_| !waited.is_zero());
        let sample = known.map_or(sample, |known| known.clamp(sample.saturating_sub(waited), sample));
        self.round_trip.sample(sample);
        self.last_round_trips.rotate_left(1);
        self.last_round_trips[JUDGED - 1] = sample;
        self.measured = Some(sample);
    }

    /// The smoothed round trip; `None` before the first measurement.
    pub(crate) fn round_trip(&self) -> Option<Duration> {
        self.round_trip.known().map(|[smooth, _]| smooth)
    }

    /// The last three unsmoothed round trips, zero before there are three.
    pub(crate) fn last_round_trips(&self) -> [Duration; JUDGED] {
        self.last_round_trips
    }

    /// Returns all metrics of the connection.
    pub(crate) fn stats(&self) -> LinkStats {
        let mut stats = self.stats;
        stats.loss_in = self.received.loss();
        if let Some([round_trip, jitter]) = self.round_trip.known() {
            (stats.round_trip, stats.jitter) = (round_trip, jitter);
        }
        stats
    }
}

pub(crate) fn micros(t: Duration) -> u64 {
    u64::try_from(t.as_micros()).unwrap_or(u64::MAX)
}
