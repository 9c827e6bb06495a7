//! Metrics of a connection.

use std::time::Duration;

/// Metrics of a connection and of its loss repair, as one side sees them. Counts start with the
/// session.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LinkStats {
    /// Smoothed round trip; zero before the first measurement.
    pub round_trip: Duration,
    /// Smoothed deviation of the round trip.
    pub jitter: Duration,
    /// Number of datagrams sent.
    pub datagrams_out: u64,
    /// Number of datagrams received and accepted.
    pub datagrams_in: u64,
    /// Bytes of datagrams sent, without the transport's overhead.
    pub bytes_out: u64,
    /// Bytes of datagrams received.
    pub bytes_in: u64,
    /// Bytes of reliable messages sent.
    pub message_bytes_out: u64,
    /// Bytes of reliable messages received.
    pub message_bytes_in: u64,
    /// Share of the other side's datagrams that did not arrive here, 0..1.
    pub loss_in: f64,
    /// Share of this side's datagrams that did not arrive at the other side, 0..1, as the other
    /// side reports.
    pub loss_out: f64,
    /// Number of NACKs sent (guest) or received (host).
    pub nacks: u64,
    /// Number of datagrams and messages that could not be decoded or were invalid.
    pub rejected: u64,
    /// Reduction level of this guest's stream, 0 (none) to 6. Host only; see
    /// [`HostSessionConfig::guest_rate`](crate::session::HostSessionConfig::guest_rate).
    pub level: u8,
}

impl LinkStats {
    /// Adds another connection's counts. Times, shares and the level stay unchanged.
    pub fn add_counts(&mut self, other: &Self) {
        self.datagrams_out += other.datagrams_out;
        self.datagrams_in += other.datagrams_in;
        self.bytes_out += other.bytes_out;
        self.bytes_in += other.bytes_in;
        self.message_bytes_out += other.message_bytes_out;
        self.message_bytes_in += other.message_bytes_in;
        self.nacks += other.nacks;
        self.rejected += other.rejected;
    }
}
