//! The application's side of an endpoint.

use std::collections::BTreeMap;
use std::io;
use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bytes::Bytes;
use pliant_stream::{DisconnectReason, PeerId};
use thiserror::Error;
use tokio::sync::Notify;

use super::Emulation;
use super::config::{Access, HostOptions, JoinOptions, Limits, Role};
use super::driver::{self, Side};
use super::emulated::Emulator;
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
        /// Where it is; may change later (QUIC migration): [`Endpoint::address`].
        address: SocketAddr,
        /// What its token lets it do; at a guest: what this guest may do.
        role: Role,
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
        /// Why, by the code that came.
        reason: DisconnectReason,
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
    /// The host has no room for this guest now.
    #[error("the host has no room")]
    NoRoom,
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
    pub(super) address: Mutex<Option<SocketAddr>>,
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
    /// A guest is to join once more.
    pub(super) again: Notify,
    pub(super) access: Mutex<Arc<Access>>,
    /// Connections and handshakes by where they come from.
    pub(super) addresses: Mutex<BTreeMap<IpAddr, usize>>,
    pub(super) emulator: Arc<Emulator>,
}

impl Shared {
    fn new(limits: Limits, first_peer: PeerId, access: Access) -> Arc<Self> {
        Arc::new(Self {
            inbox: Inbox::default(),
            peers: Mutex::default(),
            limits,
            next_peer: AtomicU64::new(first_peer.0),
            stopping: AtomicBool::new(false),
            stop: Notify::new(),
            again: Notify::new(),
            access: Mutex::new(Arc::new(access)),
            addresses: Mutex::default(),
            emulator: Arc::default(),
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
    runtime: tokio::runtime::Handle,
    quic: quinn::Endpoint,
    fingerprint: Fingerprint,
}

impl Endpoint {
    /// Listens for guests. Returns when the socket is bound.
    ///
    /// # Errors
    /// [`TransportError`] when the socket, the thread or the keys cannot be set up.
    pub fn host(options: HostOptions) -> Result<Self, TransportError> {
        let HostOptions { bind, identity, access, limits, emulation } = options;
        let identity = identity.map_or_else(Identity::generate, Ok)?;
        let server = super::config::server(&identity, &limits)?;
        let shared = Shared::new(limits, PeerId(1), access);
        Self::start(bind, identity.fingerprint(), shared, emulation, Side::Host { server })
    }

    /// Joins the host of an invite. Returns at once: the first event is [`Event::Connected`], or [`Event::Closed`] with the reason why not.
    ///
    /// # Errors
    /// As [`Endpoint::host`].
    pub fn join(invite: &Invite, options: JoinOptions) -> Result<Self, TransportError> {
        let JoinOptions { identity, limits, emulation, bind } = options;
        let identity = identity.map_or_else(Identity::generate, Ok)?;
        let mut verifier = None;
        let client = super::config::client(&identity, &limits, |provider| {
            let made = Arc::new(super::identity::PinnedHost::new(invite.fingerprint, provider));
            verifier = Some(Arc::clone(&made.refused));
            made
        })?;
        let refused = verifier.unwrap_or_default();
        let side = Side::Guest { client, invite: invite.clone(), refused };
        let bind = bind.unwrap_or_else(|| driver::address_for_joining(invite));
        let shared = Shared::new(limits, PeerId::HOST, Access::Anyone);
        Self::start(bind, identity.fingerprint(), shared, emulation, side)
    }

    fn start(
        bind: SocketAddr,
        fingerprint: Fingerprint,
        shared: Arc<Shared>,
        emulation: Option<Emulation>,
        side: Side,
    ) -> Result<Self, TransportError> {
        let bound = |source| TransportError::Bind { address: bind, source };
        let socket = UdpSocket::bind(bind).map_err(bound)?;
        shared.emulator.set(emulation);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let handle = runtime.handle().clone();
        let (ready, is_ready) = mpsc::sync_channel(1);
        let for_thread = Arc::clone(&shared);
        let thread = std::thread::Builder::new().name("pliant-net".into()).spawn(move || {
            runtime.block_on(driver::run(for_thread, socket, side, ready));
            // A name that is still being looked up, on a thread of the runtime's own, holds up nobody.
            runtime.shutdown_background();
        })?;
        let ended =
            |_| TransportError::Thread(io::Error::other("the network's thread ended before it began"));
        let quic = is_ready.recv().map_err(ended)??;
        Ok(Self { shared, thread: Some(thread), runtime: handle, quic, fingerprint })
    }

    /// The socket's own address.
    pub fn local_address(&self) -> SocketAddr {
        // The socket is bound: a system that cannot say where has said it before.
        self.quic.local_addr().unwrap_or_else(|_| SocketAddr::from(([0, 0, 0, 0], 0)))
    }

    /// This end's key.
    pub fn fingerprint(&self) -> Fingerprint {
        self.fingerprint
    }

    /// The invite to this host. When it listens on every address, the one that the system would use to go out is named; behind a router
    /// replace [`Invite::host`] with what others see. Its token is the first of [`Access::Tokens`].
    pub fn invite(&self) -> Invite {
        let mut address = self.local_address();
        if address.ip().is_unspecified() {
            address.set_ip(address_going_out(address));
        }
        let token: Option<Token> = lock(&self.shared.access).first_token();
        let invite = Invite::new(address, self.fingerprint);
        match token {
            Some(token) => invite.with_token(token),
            None => invite,
        }
    }

    /// Changes who may join from now on. Who is in stays in.
    pub fn set_access(&self, access: Access) {
        *lock(&self.shared.access) = Arc::new(access);
    }

    /// The lossy link under the socket, if there is one.
    pub fn emulation(&self) -> Option<Emulation> {
        self.shared.emulator.get()
    }

    /// Puts a lossy link under the socket, another one, or none: at any time, under any session. What is on its way on the old one is lost,
    /// unless the new one has the same seed: then it is the same link under other settings, and what is on its way arrives.
    pub fn set_emulation(&self, emulation: Option<Emulation>) {
        self.shared.emulator.set(emulation);
    }

    /// A guest whose connection has ended joins once more, with the same key and from the same socket; told as an event like the first time. Does
    /// nothing while the connection is open, and for a host.
    pub fn rejoin(&self) {
        if self.peers().is_empty() {
            self.shared.again.notify_one();
        }
    }

    /// Goes on from another address of this machine: connections stay open (QUIC migration). A host's guests do not learn of it by themselves.
    ///
    /// # Errors
    /// [`TransportError::Bind`]: the old socket is still in use.
    pub fn rebind(&self, address: SocketAddr) -> Result<(), TransportError> {
        let bound = |source| TransportError::Bind { address, source };
        let socket = UdpSocket::bind(address).map_err(bound)?;
        let _on_runtime = self.runtime.enter();
        driver::move_to(&self.shared, &self.quic, socket).map_err(bound)
    }

    /// Where a peer is now. `None`: not connected.
    pub fn address(&self, peer: PeerId) -> Option<SocketAddr> {
        *lock(&self.peer(peer)?.address)
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

    /// Bytes of messages to a peer that wait to be sent, without what QUIC has taken (at most 1 MiB). 0 where it is not connected.
    pub fn unsent(&self, peer: PeerId) -> usize {
        self.peer(peer).map_or(0, |peer| peer.outbox.message_bytes())
    }

    /// Closes a connection once its queued messages are out (it waits at most a second for that).
    /// `reason` reaches the peer as a code, `words` as they are, for people.
    pub fn close(&self, peer: PeerId, reason: DisconnectReason, words: &str) {
        if let Some(peer) = self.peer(peer) {
            peer.outbox.close(driver::code_of(reason), words.to_owned());
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

impl Endpoint {
    /// Tells the network's thread to say goodbye and end; does not wait for it.
    pub(crate) fn signal(&self) {
        self.shared.stopping.store(true, Ordering::Release);
        self.shared.stop.notify_one();
    }

    /// Says goodbye without waiting until it is said. The thread has ended when the handle says so.
    pub(crate) fn close_detached(mut self) -> Option<JoinHandle<()>> {
        self.signal();
        self.thread.take()
    }
}

impl Drop for Endpoint {
    fn drop(&mut self) {
        self.signal();
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
