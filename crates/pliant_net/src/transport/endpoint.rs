//! The application's side of an endpoint.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;

use bytes::Bytes;
use pliant_stream::{DisconnectReason, PeerId};
use thiserror::Error;
use tokio::sync::{Notify, watch};

use super::Emulation;
use super::carrier::{Carrier, Event, SendError};
use super::config::{Access, HostOptions, JoinOptions, Limits};
use super::connections::Connections;
use super::driver::{self, Side};
use super::identity::{Fingerprint, Identity, IdentityError};
use super::invite::{Invite, Token};
use super::queue::lock;
use super::slots::Slots;
use super::socket::Socket;
use super::stats::PeerStats;

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

/// State that the application and the network thread share.
#[derive(Debug)]
pub(super) struct EndpointShared {
    pub(super) connections: Connections,
    pub(super) next_peer: AtomicU64,
    /// Whether the endpoint is over: its connections get a goodbye, and no more are accepted.
    pub(super) stop: watch::Sender<bool>,
    /// Notified when a guest is to reconnect.
    pub(super) reconnect: Notify,
    pub(super) access: Mutex<Arc<Access>>,
    pub(super) slots: Arc<Mutex<Slots>>,
}

impl EndpointShared {
    fn new(limits: Limits, first_peer: PeerId, access: Access) -> Arc<Self> {
        Arc::new(Self {
            connections: Connections::new(limits),
            next_peer: AtomicU64::new(first_peer.0),
            stop: watch::Sender::new(false),
            reconnect: Notify::new(),
            access: Mutex::new(Arc::new(access)),
            slots: Arc::default(),
        })
    }

    /// Waits until the endpoint is over.
    pub(super) async fn stopped(&self) {
        // This value holds the sender, so that there is always one.
        let _ = self.stop.subscribe().wait_for(|stop| *stop).await;
    }
}

/// A host with its guests, or a guest with its host, on a UDP socket with QUIC.
///
/// Dropping it sends the queued messages and a goodbye to every peer, which takes a few round trips
/// and at most two seconds. The next endpoint of this process at the same address need not wait for
/// that: it begins on the same socket.
#[derive(Debug)]
pub struct Endpoint {
    shared: Arc<EndpointShared>,
    socket: Arc<Socket>,
    /// Disconnected when the last connection has ended.
    over: Mutex<mpsc::Receiver<()>>,
    fingerprint: Fingerprint,
}

impl Endpoint {
    /// Listens for guests. Returns when the socket is bound.
    ///
    /// # Errors
    /// [`TransportError`] when the socket, the thread or the keys cannot be set up. An address that
    /// another endpoint has is refused until that one is dropped.
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
        let server = match &side {
            Side::Host { server } => Some(server.clone()),
            Side::Guest { .. } => None,
        };
        let (socket, lease) = Socket::at(bind, server)?;
        socket.emulator.set(emulation);
        let (ended, over) = mpsc::channel();
        let for_task = Arc::clone(&shared);
        socket.spawn(async move {
            // Dropped after the lease.
            let _ended = ended;
            driver::run(&for_task, &lease.quic, side).await;
            drop(lease);
        });
        Ok(Self { shared, socket, over: Mutex::new(over), fingerprint })
    }

    /// Returns the address of the socket.
    pub fn local_address(&self) -> SocketAddr {
        // The socket is bound, and a system that cannot give its address would have failed earlier.
        self.socket.local_address().unwrap_or_else(|| SocketAddr::from(([0, 0, 0, 0], 0)))
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
        self.socket.emulator.get()
    }

    /// Sets, replaces or removes an emulated lossy link under the socket, at any time and under any
    /// session. Packets on the old link are lost. If the new link has the same seed, the old link
    /// continues with the new settings instead, and its packets arrive.
    pub fn set_emulation(&self, emulation: Option<Emulation>) {
        self.socket.emulator.set(emulation);
    }

    /// Moves to another address of this machine, with open connections (QUIC migration). A host's
    /// guests do not learn the new address by themselves.
    ///
    /// # Errors
    /// [`TransportError::Bind`] when the new address cannot be used. The old socket then stays in
    /// use.
    pub fn rebind(&self, address: SocketAddr) -> Result<(), TransportError> {
        self.socket.rebind(address)
    }

    /// Returns the present address of a peer. `None`: not connected.
    pub fn address(&self, peer: PeerId) -> Option<SocketAddr> {
        *lock(&self.shared.connections.peer(peer)?.address)
    }

    /// Returns whether dropping the endpoint would not wait.
    pub(crate) fn is_over(&self) -> bool {
        let ended = matches!(lock(&self.over).try_recv(), Err(mpsc::TryRecvError::Disconnected));
        ended && self.socket.is_settled()
    }
}

/// The connections over QUIC. A connection is closed once its queued messages and the reason have
/// arrived, or after at most a second.
impl Carrier for Endpoint {
    fn fingerprint(&self) -> Fingerprint {
        self.fingerprint
    }

    fn poll(&self) -> Option<Event> {
        self.shared.connections.inbox.pop()
    }

    fn begin_frame(&self) {
        self.shared.connections.inbox.begin_frame();
    }

    fn poll_in_frame(&self) -> Option<Event> {
        self.shared.connections.inbox.pop_in_frame()
    }

    fn charge(&self, work: usize) {
        self.shared.connections.inbox.charge(work);
    }

    fn peers(&self) -> Vec<PeerId> {
        self.shared.connections.peers()
    }

    fn send_datagram(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        self.shared.connections.send_datagram(peer, bytes)
    }

    fn send_message(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        self.shared.connections.send_message(peer, bytes)
    }

    fn unsent(&self, peer: PeerId) -> usize {
        self.shared.connections.unsent(peer)
    }

    fn max_datagram_size(&self, peer: PeerId) -> Option<usize> {
        self.shared.connections.max_datagram_size(peer)
    }

    fn close(&self, peer: PeerId, reason: DisconnectReason) {
        self.shared.connections.close(peer, reason);
    }

    /// With the same key and from the same socket.
    fn rejoin(&self) {
        if self.peers().is_empty() {
            self.shared.reconnect.notify_one();
        }
    }

    /// The address is free for the next endpoint at once.
    fn end(&self) {
        if !self.shared.stop.send_replace(true) {
            self.socket.release();
        }
    }

    fn stats(&self, peer: PeerId) -> Option<PeerStats> {
        self.shared.connections.stats(peer)
    }
}

impl Drop for Endpoint {
    fn drop(&mut self) {
        self.end();
        // Nothing is ever sent: this waits for the end of the task.
        let _ = lock(&self.over).recv();
        self.socket.wait_settled();
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
