//! QUIC endpoints that carry datagrams and messages between a host and its guests; nothing here knows of bodies or of Bevy.
//!
//! An [`Endpoint`] is one UDP socket on a thread of its own. The application talks to it through bounded queues and never waits for it:
//!
//! * **Datagrams** are unreliable and unordered. A full queue drops its *oldest* datagram and counts it: a new state is worth more than an
//!   old one.
//! * **Messages** are reliable and ordered, on one bidirectional stream, each with a length prefix. They are never dropped: a full queue
//!   is an error to the sender ([`SendError::QueueFull`]) or, on the receiving side, flow control that reaches the sender.
//! * **Events** ([`Event`]) say who came, what came and who left why.
//!
//! Both ends have an Ed25519 [`Identity`]; a guest pins the host's key by the [`Fingerprint`] in its [`Invite`], and every handshake
//! signature is verified. A guest presents its [`Token`] on the first stream, and nothing it sends counts before the host has accepted it.

mod config;
mod congestion;
mod driver;
mod emulated;
mod endpoint;
mod identity;
mod invite;
mod queue;
mod stats;
mod wire;

pub use config::{ALPN, Access, Grant, HostOptions, JoinOptions, Limits, Role};
pub use congestion::RateCap;
pub use emulated::Emulation;
pub use endpoint::{CloseReason, Endpoint, Event, SendError, TransportError};
pub use identity::{Fingerprint, Identity, IdentityError};
pub use invite::{Invite, InviteError, Token};
pub use pliant_stream::PeerId;
pub use stats::{DropCounts, PeerStats};
