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
mod predicted_hand;
mod publish;
mod regulator;
mod upload;

pub use crate::link::LinkStats;
pub use guest::GuestSession;
pub use guest_body::BodyView;
pub use guest_config::{GuestConfig, GuestEvent};
pub use host::HostSession;
pub use host_config::{HostConfig, HostEvent};
pub use predicted_hand::PredictedHand;

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
pub enum DisconnectReason {
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

impl DisconnectReason {
    /// All of them, each at the place of its number on the wire.
    const ALL: [Self; 9] = [
        Self::Left,
        Self::Silent,
        Self::Lost,
        Self::Protocol,
        Self::Version,
        Self::Refused,
        Self::Full,
        Self::Path,
        Self::Scene,
    ];

    /// Its number on the wire.
    pub fn code(self) -> u8 {
        self as u8
    }

    /// The reason of this number; `None` for one that this version does not know.
    pub fn from_code(code: u8) -> Option<Self> {
        Self::ALL.get(usize::from(code)).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_end_has_the_same_number_in_messages_and_as_a_code() {
        for (code, reason) in (0..).zip(DisconnectReason::ALL) {
            assert_eq!(postcard::to_allocvec(&reason).unwrap(), [code]);
            assert_eq!((reason.code(), DisconnectReason::from_code(code)), (code, Some(reason)));
        }
        assert_eq!(DisconnectReason::from_code(9), None);
    }
}
