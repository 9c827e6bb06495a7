//! UDP sockets with QUIC, each on its own thread.
//!
//! An endpoint that is over keeps its socket until its connections have ended. The next endpoint at
//! the same address begins on that socket at once, because QUIC tells the connections apart.

use std::net::{SocketAddr, UdpSocket};
use std::sync::{Arc, Condvar, Mutex, PoisonError, Weak};
use std::time::Duration;

use quinn::{EndpointConfig, Runtime as _, ServerConfig, TokioRuntime};
use tokio::runtime::{Handle, Runtime};
use tokio::sync::Notify;
use tokio::time::timeout;

use super::emulated::{Emulated, Emulator};
use super::endpoint::TransportError;
use super::queue::lock;

/// The sockets of this process. One that is opened looks here for the address first.
static SOCKETS: Mutex<Vec<Weak<Socket>>> = Mutex::new(Vec::new());

/// Longest time for the last packets of closed connections. QUIC repeats close packets while the
/// other end still sends.
const LAST_PACKETS: Duration = Duration::from_secs(1);

/// A UDP socket with QUIC.
#[derive(Debug)]
pub(super) struct Socket {
    runtime: Handle,
    pub(super) emulator: Arc<Emulator>,
    state: Mutex<SocketState>,
    /// Notified when an endpoint has come or gone.
    changed: Notify,
    /// The same, and when the socket is closed.
    settled: Condvar,
}

#[derive(Debug)]
struct SocketState {
    /// `None`: the socket is being closed, or is closed.
    quic: Option<quinn::Endpoint>,
    /// Endpoints whose connections have not ended.
    users: usize,
    /// Whether one of them is not over.
    taken: bool,
    closed: bool,
}

/// One endpoint's use of a socket.
#[derive(Debug)]
pub(super) struct Lease {
    socket: Arc<Socket>,
    pub(super) quic: quinn::Endpoint,
}

impl Drop for Lease {
    fn drop(&mut self) {
        lock(&self.socket.state).users -= 1;
        self.socket.changed.notify_one();
        self.socket.settled.notify_all();
    }
}

impl Socket {
    /// Opens a socket at an address, or takes over the one that an endpoint of this process had
    /// there. `server` says how connections are accepted; an endpoint that accepts none has none.
    pub(super) fn at(
        address: SocketAddr,
        server: Option<ServerConfig>,
    ) -> Result<(Arc<Self>, Lease), TransportError> {
        let mut sockets = lock(&SOCKETS);
        sockets.retain(|socket| socket.strong_count() > 0);
        if address.port() != 0 {
            let mut all = sockets.iter().filter_map(Weak::upgrade);
            if let Some(taken) = all.find_map(|socket| socket.take_over(address, server.clone())) {
                return Ok(taken);
            }
        }
        let (socket, lease) = Self::open(address, server)?;
        sockets.push(Arc::downgrade(&socket));
        Ok((socket, lease))
    }

    fn take_over(
        self: Arc<Self>,
        address: SocketAddr,
        server: Option<ServerConfig>,
    ) -> Option<(Arc<Self>, Lease)> {
        let mut state = lock(&self.state);
        if state.quic.is_none() {
            // The address is free in a moment.
            let closing = self.settled.wait_while(state, |state| !state.closed);
            drop(closing.unwrap_or_else(PoisonError::into_inner));
            return None;
        }
        let quic = state.quic.clone().filter(|quic| quic.local_addr().is_ok_and(|own| own == address))?;
        if state.taken {
            return None;
        }
        quic.set_server_config(server);
        (state.taken, state.users) = (true, state.users + 1);
        drop(state);
        self.changed.notify_one();
        self.settled.notify_all();
        Some((Arc::clone(&self), Lease { socket: self, quic }))
    }

    fn open(address: SocketAddr, server: Option<ServerConfig>) -> Result<(Arc<Self>, Lease), TransportError> {
        let bound = |source| TransportError::Bind { address, source };
        let socket = UdpSocket::bind(address).map_err(bound)?;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let handle = runtime.handle().clone();
        let emulator = Arc::<Emulator>::default();
        let quic = {
            let _on_runtime = handle.enter();
            let tokio = Arc::new(TokioRuntime);
            let socket = Emulated::under(tokio.wrap_udp_socket(socket)?, &emulator);
            quinn::Endpoint::new_with_abstract_socket(EndpointConfig::default(), server, socket, tokio)?
        };
        let state = SocketState { quic: Some(quic.clone()), users: 1, taken: true, closed: false };
        let socket = Arc::new(Self {
            runtime: handle,
            emulator,
            state: Mutex::new(state),
            changed: Notify::new(),
            settled: Condvar::new(),
        });
        let closes = Closes(Arc::clone(&socket));
        std::thread::Builder::new().name("pliant-net".into()).spawn(move || closes.0.run(runtime))?;
        Ok((Arc::clone(&socket), Lease { socket, quic }))
    }

    /// The thread: carries the packets until no endpoint uses the socket any more.
    fn run(&self, runtime: Runtime) {
        runtime.block_on(async {
            loop {
                let quic = match &*lock(&self.state) {
                    SocketState { users: 0, quic, .. } => quic.clone(),
                    _ => None,
                };
                let Some(quic) = quic else {
                    self.changed.notified().await;
                    continue;
                };
                tokio::select! {
                    _ = timeout(LAST_PACKETS, quic.wait_idle()) => {}
                    () = self.changed.notified() => continue,
                }
                let mut state = lock(&self.state);
                if state.users == 0 {
                    state.quic = None;
                    return;
                }
            }
        });
        // A name lookup that still runs, on a thread of the runtime, must not delay the end.
        runtime.shutdown_background();
    }

    /// Runs a task on the socket's thread.
    pub(super) fn spawn(&self, task: impl Future<Output = ()> + Send + 'static) {
        self.runtime.spawn(task);
    }

    /// Leaves the socket to the next endpoint. The connections of the one before go on.
    pub(super) fn release(&self) {
        lock(&self.state).taken = false;
    }

    pub(super) fn local_address(&self) -> Option<SocketAddr> {
        lock(&self.state).quic.as_ref()?.local_addr().ok()
    }

    /// Continues at another address, which a host sees as a migration of its guest.
    pub(super) fn rebind(&self, address: SocketAddr) -> Result<(), TransportError> {
        let bound = |source| TransportError::Bind { address, source };
        let socket = UdpSocket::bind(address).map_err(bound)?;
        let _on_runtime = self.runtime.enter();
        let socket = TokioRuntime.wrap_udp_socket(socket).map_err(bound)?;
        let Some(quic) = lock(&self.state).quic.clone() else { return Ok(()) };
        quic.rebind_abstract(Emulated::under(socket, &self.emulator)).map_err(bound)
    }

    /// Returns whether the socket is closed, or has another user.
    pub(super) fn is_settled(&self) -> bool {
        lock(&self.state).is_settled()
    }

    /// Waits until the socket is closed, or has another user.
    pub(super) fn wait_settled(&self) {
        let settled = self.settled.wait_while(lock(&self.state), |state| !state.is_settled());
        drop(settled.unwrap_or_else(PoisonError::into_inner));
    }
}

impl SocketState {
    fn is_settled(&self) -> bool {
        self.closed || self.users > 0
    }
}

/// Reports the end of a socket's thread, even if it has panicked.
struct Closes(Arc<Socket>);

impl Drop for Closes {
    fn drop(&mut self) {
        let mut state = lock(&self.0.state);
        (state.quic, state.closed) = (None, true);
        drop(state);
        self.0.settled.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::super::carrier::Carrier as _;
    use super::super::config::{self, JoinOptions, Limits};
    use super::super::endpoint::Endpoint;
    use super::super::identity::Identity;
    use super::super::invite::Invite;
    use super::*;

    #[test]
    fn a_guest_on_a_hosts_socket_admits_nobody() {
        let identity = Identity::generate().unwrap();
        let server = config::server(&identity, &Limits::host()).unwrap();
        let (socket, host) = Socket::at((Ipv4Addr::LOCALHOST, 0).into(), Some(server)).unwrap();
        let address = socket.local_address().unwrap();
        let invite = Invite::new(address, identity.fingerprint());
        let comes = |lease: &Lease, limit| {
            let newcomer = Endpoint::join(&invite, JoinOptions::default()).unwrap();
            let from = newcomer.local_address();
            let comes = async {
                while let Some(incoming) = lease.quic.accept().await {
                    // What is refused may be repeated.
                    if incoming.remote_address() == from {
                        return true;
                    }
                }
                false
            };
            let comes = socket.runtime.block_on(async { timeout(limit, comes).await });
            newcomer.end();
            comes.unwrap_or(false)
        };
        assert!(comes(&host, Duration::from_secs(300)), "nobody comes to the host");
        socket.release();
        let (same, guest) = Socket::at(address, None).unwrap();
        assert!(Arc::ptr_eq(&same, &socket));
        assert!(!comes(&guest, Duration::from_secs(1)), "somebody comes to the guest");
    }
}
