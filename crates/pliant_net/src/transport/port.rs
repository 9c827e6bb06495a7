//! A carrier over whatever an app sends its own data with.
//!
//! Both ends of a session's connection stay connected outside of it: a game's guest that leaves a
//! session is still in the game. Messages therefore begin with a byte that says what they are, and
//! with the connection's number, u16, little-endian. The end that opens a connection chooses the
//! number.
//!
//! | Byte | Message | After the number |
//! | --- | --- | --- |
//! | 0 | opens a connection | |
//! | 1 | admits it | the role of the other end, a byte |
//! | 2 | one of the session, or the last part of one | its bytes |
//! | 3 | goodbye | the number of the reason, a byte |
//! | 4 | a part of one of the session, of which more follows | its bytes |
//!
//! A datagram is the number and the session's bytes, so that late ones of an earlier connection are
//! known.

mod carrier;
mod connection;
mod state;

use std::collections::{BTreeMap, VecDeque};
use std::ops::Bound::{Excluded, Unbounded};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use bevy::platform::time::Instant;
use bevy::prelude::Resource;
use bytes::{Bytes, BytesMut};
use pliant_stream::{Channel, DisconnectReason, PeerId, Role};

use super::carrier::{Carrier, MeshCarrier};
use super::config::Limits;
use super::congestion::Bucket;
use super::connections::{Connections, PeerConnection};
use super::identity::Fingerprint;
use super::invite::Invite;
use super::queue::lock;

const OPEN: u8 = 0;
const ADMIT: u8 = 1;
const MESSAGE: u8 = 2;
const GOODBYE: u8 = 3;
const PART: u8 = 4;
/// Most answers that wait to be sent to one end.
const MAX_ANSWERS: usize = 16;
/// How many connections one end may open at once, and from then on each second.
const OPENS: f64 = 8.0;
const OPENS_PER_S: f64 = 1.0;
/// Bytes before those of a session in a datagram.
const DATAGRAM_HEADER: usize = 2;

/// Where an app's own netcode and a session meet.
///
/// The app keeps the port as long as its netcode, in a resource for example. Its systems tell the
/// port who is there ([`connected`](Self::connected), [`disconnected`](Self::disconnected)), bring
/// what arrives ([`receive`](Self::receive)) and take what is to be sent ([`poll`](Self::poll)).
/// Sessions ride on the carriers that [`host`](Self::host) and [`join`](Self::join) make, any
/// number of them one after the other. All clones are the same port, and no call waits.
///
/// The netcode answers for what it carries: who may connect, who is who, encryption, and repeats
/// of lost messages. Of what QUIC does for a session, the port keeps the bounded queues, the turns
/// of the peers, the cap on the rate ([`Limits::rate`]) with its room for datagrams beside long
/// messages, and reasons that arrive before the end. Nothing here knows what the path carries: the
/// cap is the only bound, where QUIC also stops while nothing arrives at all. Losses of packets are
/// not counted, and a queue on the path is only seen where the netcode reports the round trip
/// ([`set_round_trip`](Self::set_round_trip)).
///
/// ```
/// use pliant_net::transport::{Carrier, CarrierPort, Event, Fingerprint, Limits, PeerId, RemotePath, Role};
///
/// let (server, client) = (Fingerprint::of_name(b"server"), Fingerprint::of_name(b"Ann"));
/// let (there, here) = (CarrierPort::new(server), CarrierPort::new(client));
/// // The netcode knows the server as 0 on the client, and the client as 7 on the server.
/// here.connected(0, RemotePath { key: server, role: Role::Hold, max_datagram: 1200 });
/// there.connected(7, RemotePath { key: client, role: Role::Hold, max_datagram: 1200 });
/// let (host, guest) = (there.host(Limits::host()), here.join(0, Limits::guest()));
///
/// // In the systems of both apps.
/// let mut carry = || {
///     while let Some(out) = here.poll() {
///         there.receive(7, out.channel, out.bytes);
///     }
///     while let Some(out) = there.poll() {
///         here.receive(0, out.channel, out.bytes);
///     }
/// };
/// carry();
/// assert!(matches!(host.poll(), Some(Event::Connected { fingerprint, .. }) if fingerprint == client));
/// guest.send_message(PeerId::HOST, b"hello".as_slice().into())?;
/// carry();
/// assert!(matches!(host.poll(), Some(Event::Message { bytes, .. }) if bytes == "hello"));
/// # Ok::<(), pliant_net::transport::SendError>(())
/// ```
#[derive(Resource, Clone, Debug)]
pub struct CarrierPort {
    state: Arc<Mutex<PortState>>,
}

/// The path to another end, as the app's netcode knows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RemotePath {
    /// The other end's key: who has the same key later is the same user. Of a name or number that
    /// the netcode has for users, [`Fingerprint::of_name`] makes one.
    pub key: Fingerprint,
    /// What the other end may do where this one hosts. Otherwise it is not looked at.
    pub role: Role,
    /// Largest datagram that the netcode carries unreliably, bytes. The session may use two bytes
    /// less, and needs [`MIN_DATAGRAM`](pliant_stream::MIN_DATAGRAM) of them.
    pub max_datagram: usize,
}

/// What the app's netcode has to send.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PortOutput {
    /// The netcode's number of the other end.
    pub remote: u64,
    /// [`Channel::Message`]: reliable and in order, and no longer than 2,051 bytes.
    /// [`Channel::Datagram`]: unreliable, and no longer than [`RemotePath::max_datagram`].
    pub channel: Channel,
    /// What to bring to [`CarrierPort::receive`] at the other end.
    pub bytes: Bytes,
}

#[derive(Debug)]
struct PortState {
    key: Fingerprint,
    remotes: BTreeMap<u64, Remote>,
    /// Who admits the connections that others open.
    host: Option<Arc<Connections>>,
    /// Who waits for a connection to another end.
    joining: Option<Joining>,
    numbers: u16,
    peers: u64,
    called: u64,
    /// The end that was served last.
    served: u64,
}

#[derive(Debug)]
struct Joining {
    remote: u64,
    since: Instant,
    connections: Arc<Connections>,
}

#[derive(Debug)]
struct Remote {
    path: RemotePath,
    round_trip: Duration,
    /// Answers to connections that this end does not have.
    answers: VecDeque<Bytes>,
    /// Connections that are over here, with what is still to be sent. The first is sent first.
    closing: VecDeque<Connection>,
    open: Option<Connection>,
    opens: Opens,
    /// The connection that was denied last.
    denied: Option<u16>,
}

/// How many more connections an end may open at a time, so that it cannot have the app admit and
/// end connections without end.
#[derive(Debug)]
struct Opens {
    left: f64,
    at: Instant,
}

#[derive(Debug)]
struct Connection {
    number: u16,
    id: PeerId,
    since: Instant,
    /// The first message, until it is sent.
    hello: Option<Bytes>,
    admitted: bool,
    peer: Arc<PeerConnection>,
    connections: Arc<Connections>,
    limits: Limits,
    bucket: Bucket,
    /// Since when it is known to be closing.
    closing: Option<Instant>,
    /// What is still to be sent of a message.
    rest: Option<Bytes>,
    /// What has arrived of a message.
    parts: BytesMut,
}

impl CarrierPort {
    /// Creates a port. `key` is this end's own, as the others know it ([`RemotePath::key`]).
    pub fn new(key: Fingerprint) -> Self {
        // Both ends choose numbers, which should not meet.
        let numbers = u16::from_le_bytes([key.0[0], key.0[1]]);
        let state = PortState {
            key,
            remotes: BTreeMap::new(),
            host: None,
            joining: None,
            numbers,
            peers: 0,
            called: 0,
            served: 0,
        };
        Self { state: Arc::new(Mutex::new(state)) }
    }

    fn state(&self) -> MutexGuard<'_, PortState> {
        lock(&self.state)
    }

    /// Makes a carrier for hosting: it admits the connections that others open, from this call on
    /// and not from when a session takes it up.
    ///
    /// A session that is hosted on this port keeps its guests until it is left, which
    /// [`host_session_over`](crate::SessionCommands::host_session_over) does when it is taken up.
    /// It admits no more from this call on, even if the new carrier is dropped.
    pub fn host(&self, limits: Limits) -> impl Carrier {
        let connections = Arc::new(Connections::new(limits));
        self.state().host = Some(Arc::clone(&connections));
        PortCarrier { port: self.clone(), connections, remote: None }
    }

    /// Makes a carrier for playing among peers: it admits the connections that others open, and
    /// opens some itself. It does so from this call on, with the same consequences for a session on
    /// this port as for [`host`](Self::host).
    ///
    /// A peer finds another one by its key, so that a key must be the same at all of them, and the
    /// netcode must connect each with each. Two peers have one connection: a call of one who is
    /// there ends as [`DisconnectReason::Full`], and so does one of two calls at the same moment.
    pub fn mesh(&self, limits: Limits) -> impl MeshCarrier {
        // Whichever end has opened a connection, a state may come on it. The netcode has delivered
        // all of it at once where QUIC would hold it back.
        let connections = Arc::new(Connections::new(limits.of_a_call()));
        self.state().host = Some(Arc::clone(&connections));
        PortCarrier { port: self.clone(), connections, remote: None }
    }

    /// Returns the invite of a peer on ports like this one, for
    /// [`PeerConfig::join`](crate::PeerConfig::join). It only names the key.
    pub fn invite_of(key: Fingerprint) -> Invite {
        Invite { host: "port".into(), port: 1, fingerprint: key, token: None }
    }

    /// Makes a carrier for joining the session that another end hosts. The first event is
    /// [`Event::Connected`](super::Event::Connected), or [`Event::Closed`](super::Event::Closed) if
    /// the other end has not admitted this one within [`Limits::handshake`].
    ///
    /// The attempt begins with this call, or when the other end is there, and not when a session
    /// takes the carrier up: make it when the session is to begin. A connection of a session on
    /// this port with the same end is closed as [`DisconnectReason::Replaced`] when the attempt
    /// begins, and so is an attempt that still waits for its other end. Connections with other ends
    /// stay until their session is left.
    pub fn join(&self, remote: u64, limits: Limits) -> impl Carrier {
        let connections = Arc::new(Connections::new(limits));
        let carrier = PortCarrier { port: self.clone(), connections, remote: Some(remote) };
        carrier.rejoin();
        carrier
    }

    /// Reports that the netcode has another end. `remote` is the netcode's number of it, which the
    /// other methods take. For a remote that is known already, the path replaces the one for later
    /// connections.
    pub fn connected(&self, remote: u64, path: RemotePath) {
        let mut state = self.state();
        let remote = state.remotes.entry(remote).or_insert_with(|| Remote {
            path,
            round_trip: Duration::ZERO,
            answers: VecDeque::new(),
            closing: VecDeque::new(),
            open: None,
            opens: Opens { left: OPENS, at: Instant::now() },
            denied: None,
        });
        remote.path = path;
        state.open_awaited();
    }

    /// Tells that another end is gone. Its connections end, and what was to be sent is dropped.
    pub fn disconnected(&self, remote: u64, reason: DisconnectReason) {
        let Some(remote) = self.state().remotes.remove(&remote) else { return };
        remote.closing.into_iter().chain(remote.open).for_each(|connection| connection.end(reason));
    }

    /// Returns the ends that are there, by the netcode's numbers.
    pub fn remotes(&self) -> Vec<u64> {
        self.state().remotes.keys().copied().collect()
    }

    /// Tells the round trip to another end as the netcode measures it. Without it, the hands of a
    /// guest are smoothed as if there was none.
    pub fn set_round_trip(&self, remote: u64, round_trip: Duration) {
        let mut state = self.state();
        let Some(remote) = state.remotes.get_mut(&remote) else { return };
        remote.round_trip = round_trip;
        if let Some(open) = &remote.open {
            let mut stats = lock(&open.peer.stats);
            *stats = remote.measured(*stats);
        }
    }

    /// Takes what has arrived from another end. What no port has sent is dropped.
    pub fn receive(&self, remote: u64, channel: Channel, bytes: Bytes) {
        let mut state = self.state();
        match channel {
            Channel::Datagram => state.take_datagram(remote, bytes),
            Channel::Message => state.take_message(remote, bytes),
        }
    }

    /// Returns what the netcode is to send next. `None`: nothing for now. The other ends have
    /// turns.
    pub fn poll(&self) -> Option<PortOutput> {
        let mut state = self.state();
        let now = Instant::now();
        let PortState { remotes, served, .. } = &mut *state;
        let next = |(&remote, other): (&u64, &mut Remote)| Some((remote, other.next(now)?));
        let after = remotes.range_mut((Excluded(*served), Unbounded)).find_map(next);
        let (remote, (channel, bytes)) = after.or_else(|| remotes.range_mut(..=*served).find_map(next))?;
        *served = remote;
        Some(PortOutput { remote, channel, bytes })
    }
}

/// A carrier on a port.
struct PortCarrier {
    port: CarrierPort,
    connections: Arc<Connections>,
    /// The end that a guest joins.
    remote: Option<u64>,
}
