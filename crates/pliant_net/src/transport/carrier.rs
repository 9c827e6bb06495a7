//! What a session rides on.

use std::any::Any;
use std::net::SocketAddr;

use bevy::platform::time::Instant;
use bytes::Bytes;
use pliant_stream::{DisconnectReason, PeerId, Role};
use thiserror::Error;

use super::endpoint::{Endpoint, TransportError};
use super::identity::Fingerprint;
use super::invite::Invite;
use super::stats::PeerStats;
use super::wire::LONGEST;

/// What a session rides on: connections that carry reliable, ordered messages and unreliable
/// datagrams. No call waits.
///
/// [`Endpoint`] is the one over QUIC, which sessions have by default. A
/// [`CarrierPort`](super::CarrierPort) makes one of whatever a game sends its own data with.
///
/// On a guest there is one connection, [`PeerId::HOST`]. On a host, each has a number of its own,
/// and a connection that is made again has a new number.
pub trait Carrier: Any + Send + Sync {
    /// Returns the fingerprint of this end's key.
    fn fingerprint(&self) -> Fingerprint;

    /// Returns the next event, if there is one.
    fn poll(&self) -> Option<Event>;

    /// Begins a frame, for [`Carrier::poll_in_frame`].
    fn begin_frame(&self) {}

    /// Returns the next event that a host processes in this frame. A carrier that bounds what its
    /// guests can make the host process returns no more than that. The others wait for the next
    /// frame.
    fn poll_in_frame(&self) -> Option<Event> {
        self.poll()
    }

    /// Counts work that a message of this frame has made for the host, in vertices of new patches.
    /// Where [`Carrier::poll_in_frame`] bounds a frame, the messages wait for the next one once
    /// there is enough. Does nothing by default.
    fn charge(&self, _work: usize) {}

    /// Returns the connected peers, in the order in which they connected.
    fn peers(&self) -> Vec<PeerId>;

    /// Queues a datagram. A full queue drops its oldest datagram and counts it.
    ///
    /// # Errors
    /// [`SendError::NotConnected`], [`SendError::TooLarge`].
    fn send_datagram(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError>;

    /// Queues a message. A message that was accepted is never dropped while the peer is connected.
    ///
    /// # Errors
    /// [`SendError::NotConnected`], [`SendError::QueueFull`], [`SendError::TooLong`].
    fn send_message(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError>;

    /// Returns the bytes of messages to a peer that wait to be sent. Models are handed over no
    /// faster than this falls. 0 if the peer is not connected.
    fn unsent(&self, peer: PeerId) -> usize;

    /// Returns the largest datagram that the path to a peer carries at present, bytes. It may
    /// shrink. `None`: not connected.
    fn max_datagram_size(&self, peer: PeerId) -> Option<usize>;

    /// Closes a connection once its queued messages and the `reason` are sent. The reason crosses
    /// as [`DisconnectReason::code`].
    fn close(&self, peer: PeerId, reason: DisconnectReason);

    /// Connects again with a guest whose connection has ended. Events report the result as for the
    /// first attempt. Does nothing while the connection is open, and for a host.
    fn rejoin(&self);

    /// Closes all connections, for the reason that this end has left, and accepts no more. Their
    /// goodbyes are sent after this call.
    fn end(&self);

    /// Returns the metrics of a connection, with zeros for what the carrier does not measure.
    /// `None`: not connected.
    fn stats(&self, peer: PeerId) -> Option<PeerStats>;
}

/// First number of the connections that this end has opened, among peers. The numbers of those that
/// others have opened never get this large.
pub(crate) const CALLED: u64 = 1 << 48;

/// Returns whether this end has opened a connection among peers.
pub(crate) fn has_called(peer: PeerId) -> bool {
    peer.0 >= CALLED
}

/// A carrier among equal peers, which opens connections besides admitting those that others open.
/// Peers tell each other the invites of the others, so that all find each other.
///
/// The numbers of the connections that this end has opened are 2^48 and above, and no others.
pub trait MeshCarrier: Carrier {
    /// Returns the invite with which others reach this end.
    fn invite(&self) -> Invite;

    /// Opens a connection to another peer. Returns at once. The first event of that number is
    /// [`Event::Connected`], or [`Event::Closed`] with the reason for the failure.
    ///
    /// # Errors
    /// [`TransportError`] when this end cannot open a connection at all.
    fn call(&self, invite: &Invite) -> Result<PeerId, TransportError>;

    /// Ends a connection that this end has opened, or the attempt, without an event.
    fn forget(&self, peer: PeerId);
}

/// Returns the endpoint over QUIC that a carrier is, if it is one.
pub(crate) fn quic(carrier: &dyn Carrier) -> Option<&Endpoint> {
    (carrier as &dyn Any).downcast_ref()
}

/// A network event. For each peer the order is `Connected`, its datagrams and messages, `Closed`.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Event {
    /// A peer has been admitted, and can receive data.
    Connected {
        /// The new peer.
        peer: PeerId,
        /// The peer's key. The same user has the same key after a reconnect.
        fingerprint: Fingerprint,
        /// The peer's address, where the carrier knows one. It may change later (QUIC migration):
        /// [`Endpoint::address`](super::Endpoint::address).
        address: Option<SocketAddr>,
        /// What the peer may do. On a guest: what this guest may do.
        role: Role,
    },
    /// An unreliable, unordered datagram.
    Datagram {
        /// The sender.
        peer: PeerId,
        /// When the datagram was read from the network.
        at: Instant,
        /// The datagram's content.
        bytes: Bytes,
    },
    /// A reliable, ordered message.
    Message {
        /// The sender.
        peer: PeerId,
        /// The message's content.
        bytes: Bytes,
    },
    /// A peer is gone, or a host could not be reached. Nothing more arrives from the peer.
    Closed {
        /// The peer.
        peer: PeerId,
        /// The reason that this end or the other one gave, or that the connection shows.
        reason: DisconnectReason,
    },
}

/// Why data was not accepted for sending.
#[derive(Debug, Error, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum SendError {
    /// The peer is not connected, or no longer connected.
    #[error("the peer is not connected")]
    NotConnected,
    /// The datagram is larger than the path carries at present: [`Carrier::max_datagram_size`].
    #[error("a datagram of {len} bytes where the path carries {most}")]
    TooLarge {
        /// The datagram's length, bytes.
        len: usize,
        /// The largest datagram that the path carries, bytes.
        most: usize,
    },
    /// The peer's message queue is full, because the peer reads slower than messages are sent. Try
    /// again later, or close the connection.
    #[error("{len} bytes do not fit the peer's message queue")]
    QueueFull {
        /// The message's length, bytes.
        len: usize,
    },
    /// The message is longer than a message can be.
    #[error("a message of {len} bytes, at most {LONGEST} are possible")]
    TooLong {
        /// The message's length, bytes.
        len: usize,
    },
}
