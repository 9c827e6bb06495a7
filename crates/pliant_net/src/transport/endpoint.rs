//! The application's side of an endpoint.

use std::collections::BTreeMap;
use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bytes::Bytes;
use pliant_stream::PeerId;
use thiserror::Error;
use tokio::sync::Notify;

use super::config::{HostOptions, JoinOptions, Limits};
use super::driver::{self, Role};
use super::identity::{Fingerprint, Identity, IdentityError};
use super::invite::{Invite, Token};
use super::queue::{Inbox, Outbox, lock};
use super::stats::{DropCounts, PeerStats};

/// What happened, in order for each peer: `Connected`, then its datagrams and messages, then `Closed`.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Event {
    /// A peer has shown its key and its token, and may be talked to.
    Connected {
        /// The new peer.
        peer: PeerId,
        /// Its key: the same user has the same one after a reconnect.
        fingerprint: Fingerprint,
        /// Where it is; may change later (QUIC migration).
        address: SocketAddr,
    },
    /// An unreliable, unordered datagram.
    Datagram {
        /// From whom.
        peer: PeerId,
        /// When the network's thread read it.
        at: Instant,
        /// What.
        bytes: Bytes,
    },
    /// A reliable, ordered message.
    Message {
        /// From whom.
        peer: PeerId,
        /// What.
        bytes: Bytes,
    },
    /// A peer is gone, or a host could not be reached. Nothing more comes from it.
    Closed {
        /// Who.
        peer: PeerId,
        /// Why.
        reason: CloseReason,
    },
}

/// Why a connection ended.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum CloseReason {
    /// This end closed it.
    #[error("closed by this end")]
    ByUs,
    /// The other end closed it.
    #[error("the other end left: {words}")]
    ByPeer {
        /// Its words, shortened and without control characters.
        words: String,
    },
    /// Nothing came for the idle timeout, or for the time that a handshake may take.
    #[error("nothing was heard from the other end in time")]
    TimedOut,
    /// The host has another key than the invite says: another host, or someone between.
    #[error("the host shows the key {found}, the invite says {expected}")]
    WrongFingerprint {
        /// In the invite.
        expected: Fingerprint,
        /// Shown.
        found: Fingerprint,
    },
    /// The host does not let this guest in.
    #[error("refused by the host: {words}")]
    Refused {
        /// Its words, shortened and without control characters.
        words: String,
    },
    /// The peer broke the rules of the stream.
    #[error("the other end broke the protocol: {words}")]
    Protocol {
        /// How.
        words: String,
    },
    /// The name does not resolve, the versions differ, the peer restarted, the handshake failed.
    #[error("the connection failed: {words}")]
    Failed {
        /// How.
        words: String,
    },
}

/// Why something was not taken for sending.
#[derive(Debug, Error, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum SendError {
    /// No such peer, or not any more.
    #[error("the peer is not connected")]
    NotConnected,
    /// The datagram does not fit the path now: [`Endpoint::max_datagram_size`].
    #[error("a datagram of {len} bytes where the path carries {most}")]
    TooLarge {
        /// Its length, bytes.
        len: usize,
        /// What the path carries, bytes.
        most: usize,
    },
    /// The peer does not read as fast as messages are sent. Try again later, or close the connection.
    #[error("{len} bytes do not fit the peer's message queue")]
    QueueFull {
        /// The message's length, bytes.
        len: usize,
    },
    /// A message cannot be that long.
    #[error("a message of {len} bytes, at most {} are possible", u32::MAX)]
    TooLong {
        /// Its length, bytes.
        len: usize,
    },
}

/// Why an endpoint could not start.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TransportError {
    /// The address cannot be bound.
    #[error("cannot listen on {address}: {source}")]
    Bind {
        /// The address asked for.
        address: SocketAddr,
        /// What the system says.
        source: io::Error,
    },
    /// The socket or the network's thread cannot be set up.
    #[error("cannot set up the network's thread: {0}")]
    Thread(#[from] io::Error),
    /// No key.
    #[error(transparent)]
    Identity(#[from] IdentityError),
    /// The keys are not accepted by TLS.
    #[error("cannot set up TLS: {0}")]
    Tls(String),
    /// The idle timeout does not fit QUIC's counter of milliseconds.
    #[error("an idle timeout of {given:?} is too long")]
    IdleTimeout {
        /// As given.
        given: Duration,
    },
}

impl TransportError {
    pub(super) fn tls(error: impl std::fmt::Display) -> Self {
        Self::Tls(error.to_string())
    }
}

/// One peer, as both threads see it.
#[derive(Debug, Default)]
pub(super) struct Peer {
    pub(super) outbox: Outbox,
    pub(super) stats: Mutex<PeerStats>,
    pub(super) dropped: Mutex<DropCounts>,
    pub(super) max_datagram: AtomicUsize,
}

/// What the application and the network's thread share.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) inbox: Inbox,
    pub(super) peers: Mutex<BTreeMap<PeerId, Arc<Peer>>>,
    pub(super) limits: Limits,
    pub(super) next_peer: AtomicU64,
    pub(super) stopping: AtomicBool,
    pub(super) stop: Notify,
}

impl Shared {
    fn new(limits: Limits, first_peer: PeerId) -> Arc<Self> {
        Arc::new(Self {
            inbox: Inbox::default(),
            peers: Mutex::default(),
            limits,
            next_peer: AtomicU64::new(first_peer.0),
            stopping: AtomicBool::new(false),
            stop: Notify::new(),
        })
    }

    pub(super) fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Acquire)
    }
}

/// A UDP socket with QUIC on it, on a thread of its own: a host with its guests, or a guest with its host.
///
/// Dropping it says goodbye to every peer, which takes a few round trips and at most a second.
#[derive(Debug)]
pub struct Endpoint {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    local: SocketAddr,
    fingerprint: Fingerprint,
    token: Option<Token>,
}

impl Endpoint {
    /// Listens for guests. Returns when the socket is bound.
    pub fn host(options: HostOptions) -> Result<Self, TransportError> {
        let HostOptions { bind, identity, access, limits, emulation } = options;
        let identity = identity.map_or_else(Identity::generate, Ok)?;
        let server = super::config::server(&identity, &limits)?;
        let token = match &access {
            super::Access::Anyone => None,
            super::Access::Token { token, .. } => Some(*token),
        };
        Self::start(
            bind,
            identity.fingerprint(),
            token,
            limits,
            emulation,
            PeerId(1),
            Role::Host { server, access },
        )
    }

    /// Joins the host of an invite. Returns at once: the first event is [`Event::Connected`], or [`Event::Closed`] with the reason why not.
    pub fn join(invite: &Invite, options: JoinOptions) -> Result<Self, TransportError> {
        let JoinOptions { identity, limits, emulation } = options;
        let identity = identity.map_or_else(Identity::generate, Ok)?;
        let mut verifier = None;
        let client = super::config::client(&identity, &limits, |provider| {
            let made = Arc::new(super::identity::PinnedHost::new(invite.fingerprint, provider));
            verifier = Some(Arc::clone(&made.refused));
            made
        })?;
        let refused = verifier.unwrap_or_default();
        let role = Role::Guest { client, invite: invite.clone(), refused };
        let bind = driver::address_for_joining(invite);
        Self::start(bind, identity.fingerprint(), None, limits, emulation, PeerId::HOST, role)
    }

    fn start(
        bind: SocketAddr,
        fingerprint: Fingerprint,
        token: Option<Token>,
        limits: Limits,
        emulation: Option<super::Emulation>,
        first_peer: PeerId,
        role: Role,
    ) -> Result<Self, TransportError> {
        let bound = |source| TransportError::Bind { address: bind, source };
        let socket = UdpSocket::bind(bind).map_err(bound)?;
        let local = socket.local_addr().map_err(bound)?;
        let shared = Shared::new(limits, first_peer);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let (ready, is_ready) = mpsc::sync_channel(1);
        let for_thread = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("pliant-net".into())
            .spawn(move || runtime.block_on(driver::run(for_thread, socket, emulation, role, ready)))?;
        let endpoint = Self { shared, thread: Some(thread), local, fingerprint, token };
        match is_ready.recv() {
            Ok(started) => started?,
            Err(_) => {
                return Err(TransportError::Thread(io::Error::other(
                    "the network's thread ended before it began",
                )));
            }
        }
        Ok(endpoint)
    }

    /// The socket's own address.
    pub fn local_address(&self) -> SocketAddr {
        self.local
    }

    /// This end's key.
    pub fn fingerprint(&self) -> Fingerprint {
        self.fingerprint
    }

    /// The invite to this host. When it listens on every address, the one that the system would use to go out is named; behind a router
    /// replace [`Invite::host`] with what others see.
    pub fn invite(&self) -> Invite {
        let mut address = self.local;
        if address.ip().is_unspecified() {
            address.set_ip(address_going_out(address));
        }
        let invite = Invite::new(address, self.fingerprint);
        match self.token {
            Some(token) => invite.with_token(token),
            None => invite,
        }
    }

    /// The next thing that happened, if any. Never waits.
    pub fn poll(&self) -> Option<Event> {
        self.shared.inbox.pop()
    }

    /// The peers that are connected, in the order in which they came.
    pub fn peers(&self) -> Vec<PeerId> {
        lock(&self.shared.peers).keys().copied().collect()
    }

    fn peer(&self, peer: PeerId) -> Option<Arc<Peer>> {
        lock(&self.shared.peers).get(&peer).cloned()
    }

    /// Queues a datagram. When the queue is full its oldest datagram goes, and is counted. Never waits.
    pub fn send_datagram(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        let peer = self.peer(peer).ok_or(SendError::NotConnected)?;
        let most = peer.max_datagram.load(Ordering::Relaxed);
        if bytes.len() > most {
            lock(&peer.dropped).too_large += 1;
            return Err(SendError::TooLarge { len: bytes.len(), most });
        }
        let dropped = peer.outbox.push_datagram(bytes, self.shared.limits.queued_datagrams);
        if dropped > 0 {
            lock(&peer.dropped).send_queue_full += dropped;
        }
        Ok(())
    }

    /// Queues a message. Never waits, and never drops one that was taken.
    pub fn send_message(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        let len = bytes.len();
        if u32::try_from(len).is_err() {
            return Err(SendError::TooLong { len });
        }
        let peer = self.peer(peer).ok_or(SendError::NotConnected)?;
        if peer.outbox.push_message(bytes, self.shared.limits.queued_messages) {
            Ok(())
        } else {
            Err(SendError::QueueFull { len })
        }
    }

    /// Closes a connection once its queued messages are out (it waits at most a second for that). `words` reach the peer.
    pub fn close(&self, peer: PeerId, words: &str) {
        if let Some(peer) = self.peer(peer) {
            peer.outbox.close(driver::GOODBYE, words.to_owned());
        }
    }

    /// The largest datagram that the path to a peer carries now, bytes; may shrink. `None`: not connected.
    pub fn max_datagram_size(&self, peer: PeerId) -> Option<usize> {
        self.peer(peer).map(|peer| peer.max_datagram.load(Ordering::Relaxed))
    }

    /// A connection's figures. `None`: not connected.
    pub fn stats(&self, peer: PeerId) -> Option<PeerStats> {
        let peer = self.peer(peer)?;
        let dropped = *lock(&peer.dropped);
        let stats = PeerStats { dropped, ..*lock(&peer.stats) };
        Some(stats)
    }
}

impl Drop for Endpoint {
    fn drop(&mut self) {
        self.shared.stopping.store(true, Ordering::Release);
        self.shared.stop.notify_one();
        if let Some(thread) = self.thread.take() {
            // A panic of that thread has been reported there.
            let _ = thread.join();
        }
    }
}

/// The address that the system would send from. No packet is sent: connecting a UDP socket only looks up the route.
fn address_going_out(local: SocketAddr) -> std::net::IpAddr {
    let (any, anywhere, loopback): (SocketAddr, SocketAddr, std::net::IpAddr) = if local.is_ipv6() {
        let documentation = std::net::Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 1);
        (
            (std::net::Ipv6Addr::UNSPECIFIED, 0).into(),
            (documentation, 9).into(),
            std::net::Ipv6Addr::LOCALHOST.into(),
        )
    } else {
        let documentation = std::net::Ipv4Addr::new(192, 0, 2, 1);
        (
            (std::net::Ipv4Addr::UNSPECIFIED, 0).into(),
            (documentation, 9).into(),
            std::net::Ipv4Addr::LOCALHOST.into(),
        )
    };
    UdpSocket::bind(any)
        .and_then(|socket| socket.connect(anywhere).and_then(|()| socket.local_addr()))
        .map_or(loopback, |address| address.ip())
}
