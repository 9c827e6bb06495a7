//! Sessions as state machines: one host, many guests.
//!
//! Neither side owns a socket, a clock or a thread. The caller hands in what arrived with the time at which it did, asks
//! for what is to be sent, and calls again at [`HostSession::next_wakeup`] / [`GuestSession::next_wakeup`] at the latest.
//! Times are durations since any fixed moment of the caller's own; the two sides' clocks need not agree.
//!
//! | caller | host | guest |
//! | --- | --- | --- |
//! | connection opens | [`HostSession::connect`] | [`GuestSession::new`], [`GuestSession::connect`] |
//! | datagram, reliable message arrives | `on_datagram`, `on_message` | the same |
//! | after a step of the simulation | [`HostSession::publish`] for each body | |
//! | once a frame, and at `next_wakeup` | [`HostSession::update`] | [`GuestSession::update`] |
//! | then, until `None` | `poll_output`, `poll_event` | the same |
//!
//! Messages are whole: the transport keeps their borders and their order (for QUIC: one stream each way, each message
//! preceded by its length as four bytes, little-endian; at most [`MAX_MESSAGE`] bytes).

mod download;
mod guest;
mod guest_body;
mod guest_config;
mod guest_hands;
mod host;
mod host_bodies;
mod host_config;
mod host_peer;
mod outbox;
mod own_hand;
mod publish;
mod regulator;
mod upload;

pub(crate) use outbox::{Budget, Tally};

pub use guest::GuestSession;
pub use guest_body::BodyView;
pub use guest_config::{GuestConfig, GuestEvent};
pub use host::HostSession;
pub use host_config::{HostConfig, HostEvent};
pub use own_hand::OwnHand;

use std::time::Duration;

use crate::state::PeerId;

/// No reliable message is longer than this, bytes.
pub const MAX_MESSAGE: usize = 256 * 1024;

/// A path must carry datagrams of at least this many bytes.
pub const MIN_DATAGRAM: usize = 256;

/// How something is to be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Channel {
    /// Unreliable and unordered; late is worse than never.
    Datagram,
    /// Reliable and in order.
    Message,
}

/// Something to be sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Output {
    /// To whom. For a guest always [`PeerId::HOST`].
    pub peer: PeerId,
    /// How.
    pub channel: Channel,
    /// What. Shared: one frame goes to many peers without a copy.
    pub bytes: std::sync::Arc<[u8]>,
}

/// Why a session ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize, thiserror::Error)]
#[non_exhaustive]
pub enum EndReason {
    /// The other side said goodbye.
    #[error("left")]
    Left,
    /// Nothing arrived for the idle timeout.
    #[error("nothing arrived for too long")]
    Silent,
    /// The transport lost the connection.
    #[error("connection lost")]
    Lost,
    /// The other side broke the protocol.
    #[error("protocol broken")]
    Protocol,
    /// The two sides speak different versions.
    #[error("other protocol version")]
    Version,
    /// The host refused the guest.
    #[error("refused")]
    Refused,
    /// The host has no place left.
    #[error("full")]
    Full,
    /// The path's datagrams are too small, see [`MIN_DATAGRAM`].
    #[error("datagrams too small")]
    Path,
    /// The two sides have other bodies, or step them in other ways.
    #[error("other bodies or settings")]
    Scene,
}

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
    /// [`HostConfig::guest_rate`].
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
