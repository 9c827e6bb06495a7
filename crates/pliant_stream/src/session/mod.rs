//! Sessions as state machines: one host and many guests.
//!
//! Neither side owns a socket, a clock or a thread. The caller passes in what arrived and the time
//! of its arrival, fetches what is to be sent, and calls again at [`HostSession::next_wakeup`] or
//! [`GuestSession::next_wakeup`] at the latest. Times are durations since any fixed moment of the
//! caller's choice. The clocks of the two sides need not agree.
//!
//! | caller | host | guest |
//! | --- | --- | --- |
//! | connection opens | [`HostSession::connect`] | [`GuestSession::new`], [`GuestSession::connect`] |
//! | datagram, reliable message arrives | `on_datagram`, `on_message` | the same |
//! | after a step of the simulation | [`HostSession::publish`] for each body, [`HostSession::publish_rigids`] | |
//! | once a frame, and at `next_wakeup` | [`HostSession::update`] | [`GuestSession::update`] |
//! | then, until `None` | `poll_output`, `poll_event` | the same |
//!
//! Messages are whole: the transport keeps their boundaries and their order. For QUIC this is one
//! stream in each direction, with the length of each message before the message as four bytes,
//! little-endian. A message has at most [`MAX_MESSAGE`] bytes.

mod budgets;
mod disconnect_reason;
mod download;
mod guest;
mod guest_body;
mod guest_config;
mod guest_hands;
mod guest_rigids;
mod host;
mod host_bodies;
mod host_config;
mod host_peer;
mod host_rigids;
mod publish;
mod regulator;
mod upload;

pub use crate::link::LinkStats;
pub use crate::prediction::PredictedHand;
pub use disconnect_reason::DisconnectReason;
pub use guest::GuestSession;
pub use guest_body::StreamedBody;
pub use guest_config::{GuestEvent, GuestSessionConfig};
pub use guest_rigids::StreamedRigid;
pub use host::HostSession;
pub use host_config::{HostEvent, HostSessionConfig};

use crate::state::PeerId;

/// Largest size of a reliable message, bytes.
pub const MAX_MESSAGE: usize = 256 * 1024;

/// Smallest datagram size that a path must carry, bytes.
pub const MIN_DATAGRAM: usize = 256;

/// Delivery of an output.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Channel {
    /// Unreliable and unordered. A late datagram is worse than a lost one.
    Datagram,
    /// Reliable and in order.
    Message,
}

/// A datagram or message to be sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Output {
    /// The receiver. For a guest this is always [`PeerId::HOST`].
    pub peer: PeerId,
    /// The channel to use.
    pub channel: Channel,
    /// The content. It is shared, so that one frame goes to many peers without a copy.
    pub bytes: std::sync::Arc<[u8]>,
}
