//! Carriers of datagrams and messages between a host and its guests. Nothing here depends on bodies
//! or on the systems of an app.
//!
//! A session rides on a [`Carrier`]. The default is QUIC, whose [`Endpoint`] has a UDP socket with
//! its own thread. The application exchanges data with it through bounded queues and never waits
//! for it. A [`CarrierPort`] has the same queues, and an app's own netcode in the place of QUIC:
//!
//! * **Datagrams** are unreliable and unordered. A full queue drops its *oldest* datagram and
//!   counts the loss, because a new state is worth more than an old one.
//! * **Messages** are reliable and ordered, over QUIC on one bidirectional stream, each with a
//!   length prefix. They are never dropped. A full queue is an error for the sender
//!   ([`SendError::QueueFull`]) or, on the receiving side over QUIC, flow control that reaches the
//!   sender.
//! * **Events** ([`Event`]) report connections, received data, and closed connections with their
//!   reasons.
//!
//! Over QUIC, both ends have an Ed25519 [`Identity`]. A guest pins the host's key by the
//! [`Fingerprint`] in its [`Invite`], and every handshake signature is verified. A guest presents
//! its [`Token`] on the first stream, and the host ignores everything else from the guest until it
//! has accepted the token.

mod carrier;
mod config;
mod congestion;
mod connections;
mod driver;
mod emulated;
mod endpoint;
mod identity;
mod invite;
mod mesh;
mod port;
mod queue;
#[cfg(test)]
mod queue_tests;
mod slots;
mod socket;
mod stats;
mod wire;

/// What threads share. Tests put loom's in its place.
mod sync {
    pub(super) use std::sync::{Arc, Mutex, MutexGuard};
    pub(super) use tokio::sync::Notify;
}

pub use carrier::{Carrier, Event, MeshCarrier, SendError};
pub(crate) use carrier::{has_called, quic};
pub use config::{ALPN, Access, Grant, HostOptions, JoinOptions, Limits};
pub use congestion::RateCap;
pub use emulated::Emulation;
pub use endpoint::{Endpoint, TransportError};
pub use identity::{Fingerprint, Identity, IdentityError};
pub use invite::{Invite, InviteError, Token};
pub(crate) use mesh::QuicMesh;
pub use pliant_stream::{Channel, DisconnectReason, PeerId, Role};
pub use port::{CarrierPort, PortOutput, RemotePath};
pub use stats::{DropCounts, PeerStats};
