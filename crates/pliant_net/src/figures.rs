//! What the network does, in numbers: a resource for games, diagnostics for everything that shows them.

use std::time::{Duration, Instant};

use bevy::diagnostic::{Diagnostic, DiagnosticPath, Diagnostics, RegisterDiagnostic};
use bevy::prelude::*;
use pliant_stream::LinkStats;

use crate::transport::{DropCounts, PeerStats};

/// Diagnostic: smoothed round trip, ms. On a host: the longest of its guests'.
pub const ROUND_TRIP: DiagnosticPath = DiagnosticPath::const_new("pliant/net/round_trip");
/// Diagnostic: share of the other side's datagrams that do not arrive here, %.
pub const LOSS_IN: DiagnosticPath = DiagnosticPath::const_new("pliant/net/loss_in");
/// Diagnostic: share of this side's datagrams that do not arrive there, %.
pub const LOSS_OUT: DiagnosticPath = DiagnosticPath::const_new("pliant/net/loss_out");
/// Diagnostic: UDP payload received, kbit/s.
pub const RATE_IN: DiagnosticPath = DiagnosticPath::const_new("pliant/net/rate_in");
/// Diagnostic: UDP payload sent, kbit/s.
pub const RATE_OUT: DiagnosticPath = DiagnosticPath::const_new("pliant/net/rate_out");
/// Diagnostic: ticks asked for again, a second.
pub const NACKS: DiagnosticPath = DiagnosticPath::const_new("pliant/net/nacks");
/// Diagnostic: ticks that were shown on a guess and then put right, a second.
pub const RECOVERED: DiagnosticPath = DiagnosticPath::const_new("pliant/net/recovered");
/// Diagnostic: how far the shown state of a guest's bodies is known to be from the estimate of the truth, % of the state's size.
pub const SHOWN_OFFSET: DiagnosticPath = DiagnosticPath::const_new("pliant/net/shown_offset");

/// The network's figures, refreshed every frame. Counts are since the start of the connections that are open now; a
/// host adds up its guests, and gives the worst of their round trips and the mean of their losses.
#[derive(Resource, Debug, Clone, Copy, Default, PartialEq)]
pub struct NetStats {
    /// Connections that are open.
    pub peers: usize,
    /// Smoothed round trip between the sessions; zero before the first measurement.
    pub round_trip: Duration,
    /// Smoothed deviation of the round trip.
    pub jitter: Duration,
    /// Share of the other side's datagrams that do not arrive here, 0 to 1.
    pub loss_in: f64,
    /// Share of this side's datagrams that do not arrive there, 0 to 1, as the other side says.
    pub loss_out: f64,
    /// Datagrams of the session sent.
    pub datagrams_out: u64,
    /// Datagrams of the session received and accepted.
    pub datagrams_in: u64,
    /// UDP payload sent, bytes.
    pub bytes_out: u64,
    /// UDP payload received, bytes.
    pub bytes_in: u64,
    /// UDP payload sent in the last second, bytes a second.
    pub bytes_out_per_s: f64,
    /// UDP payload received in the last second, bytes a second.
    pub bytes_in_per_s: f64,
    /// NACKs sent (guest) or received (host).
    pub nacks: u64,
    /// Guest: ticks whose data was not there when they were shown.
    pub guessed: u64,
    /// Guest: of these, put right when their data came.
    pub recovered: u64,
    /// Guest: ticks shown.
    pub shown: u64,
    /// Guest: states taken over from snapshots.
    pub snapshots: u64,
    /// Datagrams and messages from outside that made no sense.
    pub rejected: u64,
    /// Datagrams that this end let go, and why.
    pub dropped: DropCounts,
    /// QUIC's own count of packets sent and lost on the way there, 0 to 1.
    pub packet_loss: f64,
    /// A peer's round trip has grown by more than 50 ms: packets wait in a queue, and less should be sent.
    pub queueing: bool,
    /// Guest: how far what is shown is from the best estimate of the truth, the largest of all bodies, as a share of the state's size (0 to 1
    /// and beyond). It is the part of the error that the receiver knows of: what a correction has found and the blend has not yet taken out.
    pub shown_offset: f64,
}

impl NetStats {
    /// Adds one connection's figures.
    pub(crate) fn add(&mut self, link: &LinkStats, transport: &PeerStats) {
        let before = self.peers as f64;
        let mean = |old: f64, new: f64| (old * before + new) / (before + 1.0);
        self.round_trip = self.round_trip.max(link.round_trip);
        self.jitter = self.jitter.max(link.jitter);
        self.loss_in = mean(self.loss_in, link.loss_in);
        self.loss_out = mean(self.loss_out, link.loss_out);
        self.packet_loss = mean(self.packet_loss, transport.loss());
        self.datagrams_out += link.datagrams_out;
        self.datagrams_in += link.datagrams_in;
        self.bytes_out += transport.sent_bytes;
        self.bytes_in += transport.received_bytes;
        self.nacks += link.nacks;
        self.rejected += link.rejected;
        self.dropped.send_queue_full += transport.dropped.send_queue_full;
        self.dropped.receive_queue_full += transport.dropped.receive_queue_full;
        self.dropped.too_large += transport.dropped.too_large;
        self.dropped.not_connected += transport.dropped.not_connected;
        self.queueing |= transport.queueing();
        self.peers += 1;
    }
}

/// What the rates are measured from.
#[derive(Resource, Debug, Default)]
pub(crate) struct RateMarks {
    since: Option<Instant>,
    bytes_in: u64,
    bytes_out: u64,
    nacks: u64,
    recovered: u64,
}

/// Rates are refreshed so often.
const RATE_WINDOW: Duration = Duration::from_secs(1);

impl NetStats {
    /// Takes the rates over from the frame before, or measures them anew once a second.
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
        }
        *marks = RateMarks {
            since: Some(now),
            bytes_in: self.bytes_in,
            bytes_out: self.bytes_out,
            nacks: self.nacks,
            recovered: self.recovered,
        };
    }

    pub(crate) fn measure(&self, diagnostics: &mut Diagnostics) {
        if self.peers == 0 {
            return;
        }
        diagnostics.add_measurement(&ROUND_TRIP, || self.round_trip.as_secs_f64() * 1e3);
        diagnostics.add_measurement(&LOSS_IN, || self.loss_in * 100.0);
        diagnostics.add_measurement(&LOSS_OUT, || self.loss_out * 100.0);
        diagnostics.add_measurement(&SHOWN_OFFSET, || self.shown_offset * 100.0);
    }
}

pub(crate) fn register(app: &mut App) {
    for (path, suffix) in [
        (ROUND_TRIP, " ms"),
        (LOSS_IN, " %"),
        (LOSS_OUT, " %"),
        (RATE_IN, " kbit/s"),
        (RATE_OUT, " kbit/s"),
        (NACKS, " /s"),
        (RECOVERED, " /s"),
        (SHOWN_OFFSET, " %"),
    ] {
        app.register_diagnostic(Diagnostic::new(path).with_suffix(suffix));
    }
}
