//! Metrics of a connection.

use std::time::Duration;

use bevy::prelude::*;

/// Counts of datagrams that this end dropped, by reason. They do not include packets that the
/// network lost ([`PeerStats::lost_packets`]).
#[derive(Reflect, Clone, Copy, Debug, Default, PartialEq, Eq)]
#[reflect(Debug, Default, Clone, PartialEq)]
#[non_exhaustive]
pub struct DropCounts {
    /// To the peer: the queue was full (because of the rate cap, or a link slower than the
    /// application), so the oldest was dropped.
    pub send_queue_full: u64,
    /// To the peer: larger than the path carries.
    pub too_large: u64,
    /// To the peer: the peer accepts no datagrams or is gone.
    pub not_connected: u64,
    /// From the peer: the application did not read in time, so the oldest was dropped.
    pub receive_queue_full: u64,
}

impl DropCounts {
    /// Returns the sum of all counts.
    pub fn all(&self) -> u64 {
        self.send_queue_full + self.too_large + self.not_connected + self.receive_queue_full
    }
}

/// Metrics of a connection, refreshed ten times a second.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct PeerStats {
    /// Smoothed round trip of packets.
    pub round_trip: Duration,
    /// Smallest round trip seen.
    pub min_round_trip: Duration,
    /// UDP packets sent.
    pub sent_packets: u64,
    /// UDP packets received.
    pub received_packets: u64,
    /// Packets sent and declared lost.
    pub lost_packets: u64,
    /// UDP payload sent, bytes.
    pub sent_bytes: u64,
    /// UDP payload received, bytes.
    pub received_bytes: u64,
    /// Datagrams of the application sent.
    pub sent_datagrams: u64,
    /// Datagrams of the application received.
    pub received_datagrams: u64,
    /// Congestion window, bytes that may be in flight.
    pub window: u64,
    /// Datagrams that this end dropped.
    pub dropped: DropCounts,
}

impl PeerStats {
    /// Returns the share of the sent packets that were lost, 0 to 1, over the whole connection. 0
    /// before anything was sent.
    pub fn loss(&self) -> f64 {
        if self.sent_packets == 0 { 0.0 } else { self.lost_packets as f64 / self.sent_packets as f64 }
    }

    /// Returns whether the round trip is more than 50 ms above its smallest value. Packets then
    /// wait in a queue on the path, and the application should send less.
    pub fn queueing(&self) -> bool {
        self.round_trip > self.min_round_trip + Duration::from_millis(50)
    }
}
