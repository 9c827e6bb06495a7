//! QUIC endpoints that carry datagrams and messages between a host and its guests. Nothing here
//! depends on bodies or on Bevy.
//!
//! An [`Endpoint`] is one UDP socket on its own thread. The application exchanges data with it
//! through bounded queues and never waits for it:
//!
//! * **Datagrams** are unreliable and unordered. A full queue drops its *oldest* datagram and
//!   counts the loss, because a new state is worth more than an old one.
//! * **Messages** are reliable and ordered, on one bidirectional stream, each with a length prefix.
//!   They are never dropped. A full queue is an error for the sender ([`SendError::QueueFull`]) or,
//!   on the receiving side, flow control that reaches the sender.
//! * **Events** ([`Event`]) report connections, received data, and closed connections with their
//!   reasons.
//!
//! Both ends have an Ed25519 [`Identity`]. A guest pins the host's key by the [`Fingerprint`] in
//! its [`Invite`], and every handshake signature is verified. A guest presents its [`Token`] on the
//! first stream, and the host ignores everything else from the guest until it has accepted the
//! token.

mod config;
mod congestion;
mod driver;
mod emulated;
mod endpoint;
mod identity;
mod invite;
mod places;
mod queue;
#[cfg(test)]
mod queue_tests;
mod stats;
mod wire;

/// What threads share. Tests put loom's in its place.
mod sync {
    pub(super) use std::sync::{Arc, Mutex, MutexGuard};
    pub(super) use tokio::sync::Notify;
}

pub use config::{ALPN, Access, Grant, HostOptions, JoinOptions, Limits};
pub use congestion::RateCap;
pub use emulated::Emulation;
pub use endpoint::{Endpoint, Event, SendError, TransportError};
pub use identity::{Fingerprint, Identity, IdentityError};
pub use invite::{Invite, InviteError, Token};
pub use pliant_stream::{DisconnectReason, PeerId, Role};
pub use stats::{DropCounts, PeerStats};
