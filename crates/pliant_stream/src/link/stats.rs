//! Counts and times of a connection, for people.

use std::time::Duration;

/// How well the path and the repair are doing, as one side sees it. Counts are since the session began.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LinkStats {
    /// Smoothed round trip; zero before the first measurement.
    pub round_trip: Duration,
    /// Smoothed deviation of the round trip.
    pub jitter: Duration,
    /// Datagrams sent.
    pub datagrams_out: u64,
    /// Datagrams received and accepted.
    pub datagrams_in: u64,
    /// Bytes of datagrams sent, without the transport's own.
    pub bytes_out: u64,
    /// Bytes of datagrams received.
    pub bytes_in: u64,
    /// Bytes of reliable messages sent.
    pub message_bytes_out: u64,
    /// Bytes of reliable messages received.
    pub message_bytes_in: u64,
    /// Share of the other side's datagrams that did not arrive here, 0..1.
    pub loss_in: f64,
    /// Share of this side's datagrams that did not arrive there, 0..1, as the other side reports.
    pub loss_out: f64,
    /// NACKs sent (guest) or received (host).
    pub nacks: u64,
    /// Datagrams that could not be read or made no sense.
    pub rejected: u64,
    /// Host only: how far this guest's stream is cut down, 0 (not at all) to 6; see
    /// [`HostConfig::guest_rate`](crate::session::HostConfig::guest_rate).
    pub level: u8,
}

impl LinkStats {
    /// Adds another connection's counts; times, shares and the level stay.
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
