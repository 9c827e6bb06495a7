//! Network metrics, as a resource for games and as diagnostics for tools that display them.

use std::collections::BTreeMap;
use std::time::Duration;

use bevy::diagnostic::{Diagnostic, DiagnosticPath, Diagnostics, RegisterDiagnostic};
use bevy::platform::time::Instant;
use bevy::prelude::*;
use pliant_stream::{LinkStats, PeerId};

use crate::transport::{DropCounts, PeerStats};

/// Diagnostic: smoothed round trip, ms. On a host, the longest of all guests.
pub const ROUND_TRIP: DiagnosticPath = DiagnosticPath::const_new("pliant/net/round_trip");
/// Diagnostic: smoothed deviation of the round trip, ms. Among peers, of the one-way delay to this
/// peer. The largest of all connections.
pub const JITTER: DiagnosticPath = DiagnosticPath::const_new("pliant/net/jitter");
/// Diagnostic: how long packets wait in queues on the path, ms: [`NetStats::queue`].
pub const QUEUE: DiagnosticPath = DiagnosticPath::const_new("pliant/net/queue");
/// Diagnostic: datagrams that this end dropped ([`NetStats::dropped`]), per second.
pub const DROPPED: DiagnosticPath = DiagnosticPath::const_new("pliant/net/dropped");
/// Diagnostic: share of the other side's datagrams that do not arrive here, %.
pub const LOSS_IN: DiagnosticPath = DiagnosticPath::const_new("pliant/net/loss_in");
/// Diagnostic: share of this side's datagrams that do not arrive there, %.
pub const LOSS_OUT: DiagnosticPath = DiagnosticPath::const_new("pliant/net/loss_out");
/// Diagnostic: UDP payload received, kbit/s.
pub const RATE_IN: DiagnosticPath = DiagnosticPath::const_new("pliant/net/rate_in");
/// Diagnostic: UDP payload sent, kbit/s.
pub const RATE_OUT: DiagnosticPath = DiagnosticPath::const_new("pliant/net/rate_out");
/// Diagnostic: ticks requested again (NACKs), per second.
pub const NACKS: DiagnosticPath = DiagnosticPath::const_new("pliant/net/nacks");
/// Diagnostic: ticks that were displayed with a prediction and then corrected, per second.
pub const RECOVERED: DiagnosticPath = DiagnosticPath::const_new("pliant/net/recovered");
/// Diagnostic: known distance of a guest's visual state from the estimate of the true state, % of
/// the state's size.
pub const VISUAL_OFFSET: DiagnosticPath = DiagnosticPath::const_new("pliant/net/visual_offset");

/// Network metrics, refreshed every frame.
///
/// Counts start with the session and never fall in it: closed connections stay counted. A host adds
/// up its guests, and a peer adds up the other peers. Both report the worst round trip and the mean
/// loss. Without a session all is zero.
#[derive(Resource, Reflect, Debug, Clone, Copy, Default, PartialEq)]
#[reflect(Resource, Debug, Default, Clone, PartialEq)]
pub struct NetStats {
    /// Number of open connections.
    pub peers: usize,
    /// Smoothed round trip between the sessions. Zero before the first measurement.
    pub round_trip: Duration,
    /// Smoothed deviation of the round trip. Among peers, of the one-way delay to this peer. The
    /// largest of all connections.
    pub jitter: Duration,
    /// Share of the other side's datagrams that do not arrive here, 0 to 1.
    pub loss_in: f64,
    /// Share of this side's datagrams that do not arrive there, 0 to 1, as the other side reports.
    pub loss_out: f64,
    /// Datagrams of the session sent.
    pub datagrams_out: u64,
    /// Datagrams of the session received and accepted.
    pub datagrams_in: u64,
    /// UDP payload sent, bytes.
    pub bytes_out: u64,
    /// UDP payload received, bytes.
    pub bytes_in: u64,
    /// UDP payload sent in the last second, bytes per second.
    pub bytes_out_per_s: f64,
    /// UDP payload received in the last second, bytes per second.
    pub bytes_in_per_s: f64,
    /// NACKs sent (guest) or received (host). Among peers, requests sent for missing inputs.
    pub nacks: u64,
    /// Guest: ticks whose data was missing when they were displayed.
    pub guessed: u64,
    /// Guest: the part of these that was corrected when their data arrived.
    pub recovered: u64,
    /// Guest: ticks displayed.
    pub displayed_ticks: u64,
    /// Guest: states taken over from snapshots.
    pub snapshots: u64,
    /// Invalid datagrams and messages received.
    pub rejected: u64,
    /// Datagrams that this end dropped, by reason.
    pub dropped: DropCounts,
    /// Share of the sent packets that QUIC counts as lost on the path to the other side, 0 to 1.
    pub packet_loss: f64,
    /// How much longer the round trip is than the shortest one seen, which is how long packets wait
    /// in queues. The longest of all connections.
    pub queue: Duration,
    /// Whether a peer's round trip has grown by more than 50 ms. Packets then wait in a queue, and
    /// the app should send less.
    pub queueing: bool,
    /// Guest: distance of the visual state from the best estimate of the true state, as a share of
    /// the state's size (0 to 1 and beyond). The largest of all bodies. It is the part of the error
    /// that the receiver knows: what corrections have found and the blend has not yet removed.
    pub visual_offset: f64,
}

impl NetStats {
    /// Adds the metrics of one open connection. [`NetStats::count`] adds its counts.
    pub(crate) fn add(&mut self, link: &LinkStats, transport: &PeerStats) {
        let before = self.peers as f64;
        let mean = |old: f64, new: f64| (old * before + new) / (before + 1.0);
        self.round_trip = self.round_trip.max(link.round_trip);
        self.jitter = self.jitter.max(link.jitter);
        self.loss_in = mean(self.loss_in, link.loss_in);
        self.loss_out = mean(self.loss_out, link.loss_out);
        self.packet_loss = mean(self.packet_loss, transport.loss());
        self.queue = self.queue.max(transport.round_trip.saturating_sub(transport.min_round_trip));
        self.queueing |= transport.queueing();
        self.peers += 1;
    }

    /// Takes over the counts of all connections, including closed ones.
    pub(crate) fn count(&mut self, links: &LinkStats, lines: &SourceCounts) {
        self.datagrams_out = links.datagrams_out;
        self.datagrams_in = links.datagrams_in;
        self.nacks = links.nacks;
        self.rejected = links.rejected;
        (self.bytes_out, self.bytes_in, self.dropped) = (lines.bytes_out, lines.bytes_in, lines.dropped);
    }
}

/// The transport's counts.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct SourceCounts {
    bytes_out: u64,
    bytes_in: u64,
    dropped: DropCounts,
}

impl SourceCounts {
    fn of(line: &PeerStats) -> Self {
        Self { bytes_out: line.sent_bytes, bytes_in: line.received_bytes, dropped: line.dropped }
    }

    fn add(&mut self, other: &Self) {
        self.bytes_out += other.bytes_out;
        self.bytes_in += other.bytes_in;
        self.dropped.send_queue_full += other.dropped.send_queue_full;
        self.dropped.receive_queue_full += other.dropped.receive_queue_full;
        self.dropped.too_large += other.dropped.too_large;
        self.dropped.not_connected += other.dropped.not_connected;
    }
}

/// Keeps the counts of closed connections, so that sums never fall. Traffic of a connection after
/// the last frame that saw it open is not included.
#[derive(Debug, Default)]
pub(crate) struct Ledger {
    open: BTreeMap<PeerId, SourceCounts>,
    over: SourceCounts,
}

impl Ledger {
    /// Returns the sums, including the connections that are open now.
    pub(crate) fn sum(&mut self, open: impl Iterator<Item = (PeerId, PeerStats)>) -> SourceCounts {
        let now: BTreeMap<PeerId, SourceCounts> =
            open.map(|(peer, line)| (peer, SourceCounts::of(&line))).collect();
        for (peer, before) in std::mem::take(&mut self.open) {
            // The number may belong to a new connection, whose byte counts start at zero.
            if now.get(&peer).is_none_or(|now| now.bytes_out < before.bytes_out) {
                self.over.add(&before);
            }
        }
        self.open = now;
        let mut sum = self.over;
        self.open.values().for_each(|line| sum.add(line));
        sum
    }
}

/// Counts at the last measurement of the rates.
#[derive(Resource, Debug, Default)]
pub(crate) struct RateMarks {
    since: Option<Instant>,
    bytes_in: u64,
    bytes_out: u64,
    nacks: u64,
    recovered: u64,
    dropped: u64,
}

/// Interval between two measurements of the rates.
const RATE_WINDOW: Duration = Duration::from_secs(1);

impl NetStats {
    /// Takes the rates over from the previous frame, or measures them anew once a second.
    pub(crate) fn keep_rates(&mut self, before: &Self, marks: &mut RateMarks, diagnostics: &mut Diagnostics) {
        self.bytes_in_per_s = before.bytes_in_per_s;
        self.bytes_out_per_s = before.bytes_out_per_s;
        let now = Instant::now();
        let passed = marks.since.map(|since| now.saturating_duration_since(since));
        if passed.is_some_and(|passed| passed < RATE_WINDOW) {
            return;
        }
        if let Some(passed) = passed {
            let per_s = |new: u64, old: u64| new.saturating_sub(old) as f64 / passed.as_secs_f64();
            self.bytes_in_per_s = per_s(self.bytes_in, marks.bytes_in);
            self.bytes_out_per_s = per_s(self.bytes_out, marks.bytes_out);
            diagnostics.add_measurement(&RATE_IN, || self.bytes_in_per_s * 8e-3);
            diagnostics.add_measurement(&RATE_OUT, || self.bytes_out_per_s * 8e-3);
            diagnostics.add_measurement(&NACKS, || per_s(self.nacks, marks.nacks));
            diagnostics.add_measurement(&RECOVERED, || per_s(self.recovered, marks.recovered));
            diagnostics.add_measurement(&DROPPED, || per_s(self.dropped.all(), marks.dropped));
        }
        *marks = RateMarks {
            since: Some(now),
            bytes_in: self.bytes_in,
            bytes_out: self.bytes_out,
            nacks: self.nacks,
            recovered: self.recovered,
            dropped: self.dropped.all(),
        };
    }

    pub(crate) fn measure(&self, diagnostics: &mut Diagnostics) {
        if self.peers == 0 {
            return;
        }
        diagnostics.add_measurement(&ROUND_TRIP, || self.round_trip.as_secs_f64() * 1e3);
        diagnostics.add_measurement(&JITTER, || self.jitter.as_secs_f64() * 1e3);
        diagnostics.add_measurement(&QUEUE, || self.queue.as_secs_f64() * 1e3);
        diagnostics.add_measurement(&LOSS_IN, || self.loss_in * 100.0);
        diagnostics.add_measurement(&LOSS_OUT, || self.loss_out * 100.0);
        diagnostics.add_measurement(&VISUAL_OFFSET, || self.visual_offset * 100.0);
    }
}

pub(crate) fn register(app: &mut App) {
    for (path, suffix) in [
        (ROUND_TRIP, " ms"),
        (JITTER, " ms"),
        (QUEUE, " ms"),
        (DROPPED, " /s"),
        (LOSS_IN, " %"),
        (LOSS_OUT, " %"),
        (RATE_IN, " kbit/s"),
        (RATE_OUT, " kbit/s"),
        (NACKS, " /s"),
        (RECOVERED, " /s"),
        (VISUAL_OFFSET, " %"),
    ] {
        app.register_diagnostic(Diagnostic::new(path).with_suffix(suffix));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_do_not_fall_when_connections_end_or_their_numbers_begin_anew() {
        let mut ledger = Ledger::default();
        let line = |peer: u64, sent_bytes: u64| {
            let dropped = DropCounts { too_large: sent_bytes / 100, ..DropCounts::default() };
            (PeerId(peer), PeerStats { sent_bytes, received_bytes: 2 * sent_bytes, dropped, ..default() })
        };
        let mut sum = |lines: &[(PeerId, PeerStats)]| {
            let sum = ledger.sum(lines.iter().copied());
            (sum.bytes_out, sum.bytes_in, sum.dropped.all())
        };
        assert_eq!(sum(&[line(1, 1000), line(2, 100)]), (1100, 2200, 11));
        assert_eq!(sum(&[line(2, 200)]), (1200, 2400, 12), "the first, of long standing, is gone");
        assert_eq!(sum(&[]), (1200, 2400, 12));
        assert_eq!(sum(&[line(0, 500)]), (1700, 3400, 17));
        assert_eq!(sum(&[line(0, 100)]), (1800, 3600, 18), "a guest has come back");
        assert_eq!(sum(&[line(0, 300)]), (2000, 4000, 20));
    }
}
