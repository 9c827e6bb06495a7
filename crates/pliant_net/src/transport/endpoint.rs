//! The application's side of an endpoint.

use std::collections::BTreeMap;
use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bytes::Bytes;
use pliant_stream::{DisconnectReason, PeerId, Role};
use thiserror::Error;
use tokio::sync::Notify;

use super::Emulation;
use super::config::{Access, HostOptions, JoinOptions, Limits};
use super::driver::{self, Side};
use super::emulated::Emulator;
use super::identity::{Fingerprint, Identity, IdentityError};
use super::invite::{Invite, Token};
use super::places::Places;
use super::queue::{Inbox, Outbox, lock};
use super::stats::{DropCounts, PeerStats};

/// A network event. For each peer the order is `Connected`, its datagrams and messages, `Closed`.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum Event {
    /// A peer has presented its key and its token, and can receive data.
    Connected {
        /// The new peer.
        peer: PeerId,
        /// The peer's key. The same user has the same key after a reconnect.
        fingerprint: Fingerprint,
        /// The peer's address. It may change later (QUIC migration): [`Endpoint::address`].
        address: SocketAddr,
        /// What the peer's token permits. On a guest: what this guest may do.
        role: Role,
    },
    /// An unreliable, unordered datagram.
    Datagram {
        /// The sender.
        peer: PeerId,
        /// When the network thread read the datagram.
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
    /// The datagram is larger than the path carries at present: [`Endpoint::max_datagram_size`].
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
    #[error("a message of {len} bytes, at most {} are possible", u32::MAX)]
    TooLong {
        /// The message's length, bytes.
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
        /// Error of the operating system.
        source: io::Error,
    },
    /// The socket or the network thread cannot be set up.
    #[error("cannot set up the network's thread: {0}")]
    Thread(#[from] io::Error),
    /// The key cannot be made.
    #[error(transparent)]
    Identity(#[from] IdentityError),
    /// TLS does not accept the keys.
    #[error("cannot set up TLS: {0}")]
    Tls(String),
    /// The idle timeout does not fit QUIC's counter of milliseconds.
    #[error("an idle timeout of {given:?} is too long")]
    IdleTimeout {
        /// The given timeout.
        given: Duration,
    },
}

impl TransportError {
    pub(super) fn tls(error: impl std::fmt::Display) -> Self {
        Self::Tls(error.to_string())
    }
}

/// One peer, shared by both threads.
#[derive(Debug, Default)]
pub(super) struct PeerConnection {
    pub(super) outbox: Outbox,
    pub(super) stats: Mutex<PeerStats>,
    pub(super) dropped: Mutex<DropCounts>,
    pub(super) max_datagram: AtomicUsize,
    pub(super) address: Mutex<Option<SocketAddr>>,
}

/// State that the application and the network thread share.
#[derive(Debug)]
pub(super) struct EndpointShared {
    pub(super) inbox: Inbox,
    pub(super) peers: Mutex<BTreeMap<PeerId, Arc<PeerConnection>>>,
    pub(super) limits: Limits,
    pub(super) next_peer: AtomicU64,
    pub(super) stopping: AtomicBool,
    pub(super) stop: Notify,
    /// Notified when a guest is to reconnect.
    pub(super) reconnect: Notify,
    pub(super) access: Mutex<Arc<Access>>,
    pub(super) places: Arc<Mutex<Places>>,
    pub(super) emulator: Arc<Emulator>,
}

impl EndpointShared {
    fn new(limits: Limits, first_peer: PeerId, access: Access) -> Arc<Self> {
        Arc::new(Self {
            inbox: Inbox::default(),
            peers: Mutex::default(),
            limits,
            next_peer: AtomicU64::new(first_peer.0),
            stopping: AtomicBool::new(false),
            stop: Notify::new(),
            reconnect: Notify::new(),
            access: Mutex::new(Arc::new(access)),
            places: Arc::default(),
            emulator: Arc::default(),
        })
    }

    pub(super) fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Acquire)
    }
}

/// A UDP socket with QUIC on its own thread: a host with its guests, or a guest with its host.
///
/// Dropping it sends a goodbye to every peer, which takes a few round trips and at most a second.
#[derive(Debug)]
pub struct Endpoint {
    shared: Arc<EndpointShared>,
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
        let shared = EndpointShared::new(limits, PeerId(1), access);
        Self::start(bind, identity.fingerprint(), shared, emulation, Side::Host { server })
    }

    /// Joins the host of an invite. Returns at once. The first event is [`Event::Connected`], or
    /// [`Event::Closed`] with the reason for the failure.
    ///
    /// # Errors
    /// The same as for [`Endpoint::host`].
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
        let shared = EndpointShared::new(limits, PeerId::HOST, Access::Anyone);
        Self::start(bind, identity.fingerprint(), shared, emulation, side)
    }

    fn start(
        bind: SocketAddr,
        fingerprint: Fingerprint,
        shared: Arc<EndpointShared>,
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
            // A name lookup that still runs, on a thread of the runtime, must not delay the end.
            runtime.shutdown_background();
        })?;
        let ended =
            |_| TransportError::Thread(io::Error::other("the network's thread ended before it began"));
        let quic = is_ready.recv().map_err(ended)??;
        Ok(Self { shared, thread: Some(thread), runtime: handle, quic, fingerprint })
    }

    /// Returns the address of the socket.
    pub fn local_address(&self) -> SocketAddr {
        // The socket is bound, and a system that cannot give its address would have failed earlier.
        self.quic.local_addr().unwrap_or_else(|_| SocketAddr::from(([0, 0, 0, 0], 0)))
    }

    /// Returns the fingerprint of this end's key.
    pub fn fingerprint(&self) -> Fingerprint {
        self.fingerprint
    }

    /// Returns the invite to this host. If the host listens on every address, the invite names the
    /// address from which the system would send. Behind a router, replace [`Invite::host`] with the
    /// public address. The token is the first one of [`Access::Tokens`].
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

    /// Changes who may join from this call on. Connected guests stay connected.
    pub fn set_access(&self, access: Access) {
        *lock(&self.shared.access) = Arc::new(access);
    }

    /// Returns the emulated lossy link under the socket, if there is one.
    pub fn emulation(&self) -> Option<Emulation> {
        self.shared.emulator.get()
    }

    /// Sets, replaces or removes an emulated lossy link under the socket, at any time and under any
    /// session. Packets on the old link are lost. If the new link has the same seed, the old link
    /// continues with the new settings instead, and its packets arrive.
    pub fn set_emulation(&self, emulation: Option<Emulation>) {
        self.shared.emulator.set(emulation);
    }

    /// Joins again with a guest whose connection has ended, with the same key and from the same
    /// socket. Events report the result as for the first attempt. Does nothing while the connection
    /// is open, and for a host.
    pub fn rejoin(&self) {
        if self.peers().is_empty() {
            self.shared.reconnect.notify_one();
        }
    }

    /// Moves to another address of this machine, with open connections (QUIC migration). A host's
    /// guests do not learn the new address by themselves.
    ///
    /// # Errors
    /// [`TransportError::Bind`] when the new address cannot be used. The old socket then stays in
    /// use.
    pub fn rebind(&self, address: SocketAddr) -> Result<(), TransportError> {
        let bound = |source| TransportError::Bind { address, source };
        let socket = UdpSocket::bind(address).map_err(bound)?;
        let _on_runtime = self.runtime.enter();
        driver::move_to(&self.shared, &self.quic, socket).map_err(bound)
    }

    /// Returns the present address of a peer. `None`: not connected.
    pub fn address(&self, peer: PeerId) -> Option<SocketAddr> {
        *lock(&self.peer(peer)?.address)
    }

    /// Returns the next event, if there is one. Never waits. The peers are read in turn.
    pub fn poll(&self) -> Option<Event> {
        self.shared.inbox.pop()
    }

    /// Iterates over the events that fit the budget of one frame, and of each peer in it. The
    /// others wait for the next frame.
    pub(crate) fn frame(&self) -> impl Iterator<Item = Event> + '_ {
        self.shared.inbox.begin_frame();
        std::iter::from_fn(|| self.shared.inbox.pop_in_frame())
    }

    /// Returns the connected peers, in the order in which they connected.
    pub fn peers(&self) -> Vec<PeerId> {
        lock(&self.shared.peers).keys().copied().collect()
    }

    fn peer(&self, peer: PeerId) -> Option<Arc<PeerConnection>> {
        lock(&self.shared.peers).get(&peer).cloned()
    }

    /// Queues a datagram. A full queue drops its oldest datagram and counts it. Never waits.
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

    /// Queues a message. Never waits, and never drops a message that it has accepted.
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

    /// Returns the bytes of messages to a peer that wait to be sent, without those that QUIC has
    /// taken (at most 1 MiB). 0 if the peer is not connected.
    pub fn unsent(&self, peer: PeerId) -> usize {
        self.peer(peer).map_or(0, |peer| peer.outbox.message_bytes())
    }

    /// Closes a connection once its queued messages are sent, or after at most a second. The peer
    /// receives the code of `reason`.
    pub fn close(&self, peer: PeerId, reason: DisconnectReason) {
        if let Some(peer) = self.peer(peer) {
            peer.outbox.close(reason);
        }
    }

    /// Returns the largest datagram that the path to a peer carries at present, bytes. It may
    /// shrink. `None`: not connected.
    pub fn max_datagram_size(&self, peer: PeerId) -> Option<usize> {
        self.peer(peer).map(|peer| peer.max_datagram.load(Ordering::Relaxed))
    }

    /// Returns the metrics of a connection. `None`: not connected.
    pub fn stats(&self, peer: PeerId) -> Option<PeerStats> {
        let peer = self.peer(peer)?;
        let dropped = *lock(&peer.dropped);
        let stats = PeerStats { dropped, ..*lock(&peer.stats) };
        Some(stats)
    }
}

impl Endpoint {
    /// Asks the network thread to say goodbye and end, and does not wait for it.
    pub(crate) fn signal(&self) {
        self.shared.stopping.store(true, Ordering::Release);
        self.shared.stop.notify_one();
    }

    /// Says goodbye without waiting for it. The returned handle tells when the thread has ended.
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

/// Returns the address from which the system would send. Connecting a UDP socket only looks up the
/// route, so no packet is sent.
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
