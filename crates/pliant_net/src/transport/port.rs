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

use std::collections::{BTreeMap, VecDeque};
use std::ops::Bound::{Excluded, Unbounded};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use bevy::platform::time::Instant;
use bevy::prelude::Resource;
use bytes::{Buf, BufMut, Bytes, BytesMut};
use pliant_stream::{Channel, DisconnectReason, PeerId, Role};
use tracing::debug;

use super::carrier::{CALLED, Carrier, Event, MeshCarrier, SendError};
use super::config::Limits;
use super::congestion::Bucket;
use super::connections::{Connections, GRACE, MESSAGE_PART, PeerConnection};
use super::endpoint::TransportError;
use super::identity::Fingerprint;
use super::invite::Invite;
use super::queue::{Next, lock};
use super::stats::PeerStats;
use super::wire::reason_with_code;

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
/// not counted, and a queue on the path is only seen where the netcode tells the round trip
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

impl Opens {
    fn take(&mut self, now: Instant) -> bool {
        let passed = now.saturating_duration_since(self.at).as_secs_f64();
        *self = Self { left: (self.left + passed * OPENS_PER_S).min(OPENS), at: now };
        let is_left = self.left >= 1.0;
        if is_left {
            self.left -= 1.0;
        }
        is_left
    }
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

/// Returns a message of the port.
fn message(kind: u8, number: u16, content: &[u8]) -> Bytes {
    let mut bytes = BytesMut::with_capacity(3 + content.len());
    bytes.put_u8(kind);
    bytes.put_u16_le(number);
    bytes.put_slice(content);
    bytes.freeze()
}

/// Takes the number of a connection from the front.
fn take_number(bytes: &mut Bytes) -> Option<u16> {
    bytes.try_get_u16_le().ok()
}

impl Connection {
    fn new(
        number: u16,
        id: PeerId,
        hello: Bytes,
        remote: &RemotePath,
        connections: &Arc<Connections>,
    ) -> Self {
        let peer = Arc::<PeerConnection>::default();
        peer.max_datagram.store(remote.max_datagram.saturating_sub(DATAGRAM_HEADER), Ordering::Relaxed);
        let since = Instant::now();
        Self {
            number,
            id,
            since,
            hello: Some(hello),
            admitted: false,
            peer,
            connections: Arc::clone(connections),
            limits: connections.limits.clone(),
            bucket: Bucket::new(connections.limits.rate, since),
            closing: None,
            rest: None,
            parts: BytesMut::new(),
        }
    }

    fn admit(&mut self, remote: &Remote, role: Role) {
        self.admitted = true;
        *lock(&self.peer.stats) = remote.measured(PeerStats::default());
        let (peer, fingerprint) = (self.id, remote.path.key);
        let connected = Event::Connected { peer, fingerprint, address: None, role };
        self.connections.open(self.id, Arc::clone(&self.peer), connected);
    }

    fn end(self, reason: DisconnectReason) {
        debug!(peer = self.id.0, %reason, "connection closed");
        self.connections.ended(self.id, reason);
    }

    /// Returns what is to be sent next within the cap on the rate, and the reason if that is the
    /// end.
    fn next(&mut self, now: Instant) -> Option<(Channel, Bytes, Option<DisconnectReason>)> {
        self.drop_late(now);
        if let Some(hello) = self.hello.take() {
            return Some((Channel::Message, hello, None));
        }
        let outbox = &self.peer.outbox;
        if let Some(len) = outbox.datagram_len().filter(|_| self.admitted)
            && self.bucket.take_datagram(len, now).is_ok()
            && let Some(datagram) = outbox.pop_datagram()
        {
            let mut bytes = BytesMut::with_capacity(DATAGRAM_HEADER + datagram.len());
            bytes.put_u16_le(self.number);
            bytes.put_slice(&datagram);
            return Some((Channel::Datagram, bytes.freeze(), None));
        }
        let len = self.rest.as_ref().map(Bytes::len).or_else(|| outbox.next_len())?;
        self.bucket.take_message(len.min(MESSAGE_PART), now).ok()?;
        let next = match self.rest.take() {
            Some(rest) => Next::Message(rest),
            None => outbox.next()?,
        };
        let (bytes, over) = match next {
            Next::Message(mut rest) if rest.len() > MESSAGE_PART => {
                let part = rest.split_to(MESSAGE_PART);
                self.rest = Some(rest);
                (message(PART, self.number, &part), None)
            }
            Next::Message(last) => (message(MESSAGE, self.number, &last), None),
            Next::Close(reason) => (message(GOODBYE, self.number, &[reason.code()]), Some(reason)),
        };
        Some((Channel::Message, bytes, over))
    }

    /// Drops what a closing connection has not sent in time. Its goodbye is next.
    fn drop_late(&mut self, now: Instant) {
        if self.peer.outbox.is_closing()
            && now.saturating_duration_since(*self.closing.get_or_insert(now)) > GRACE
        {
            self.rest = None;
            self.peer.outbox.drop_messages();
        }
    }

    /// Takes a part of a message. Memory grows with the bytes that have arrived.
    fn take_part(&mut self, bytes: Bytes, is_last: bool) {
        if self.parts.len() + bytes.len() > self.limits.message {
            self.parts = BytesMut::new();
            return self.peer.outbox.close(DisconnectReason::Protocol);
        }
        let whole = if self.parts.is_empty() && is_last {
            bytes
        } else {
            self.parts.put_slice(&bytes);
            if !is_last {
                return;
            }
            std::mem::take(&mut self.parts).freeze()
        };
        if self.connections.inbox.push_message(self.id, whole, self.limits.unread_messages()).is_err() {
            // The netcode has delivered it, so that it cannot wait there.
            self.peer.outbox.close(DisconnectReason::Unread);
        }
    }

    fn sent(&self, channel: Channel, bytes: usize) {
        let mut stats = lock(&self.peer.stats);
        stats.sent_packets += 1;
        stats.sent_bytes += bytes as u64;
        stats.sent_datagrams += u64::from(channel == Channel::Datagram);
    }

    fn received(&self, channel: Channel, bytes: usize) {
        let mut stats = lock(&self.peer.stats);
        stats.received_packets += 1;
        stats.received_bytes += bytes as u64;
        stats.received_datagrams += u64::from(channel == Channel::Datagram);
    }
}

impl Remote {
    fn measured(&self, stats: PeerStats) -> PeerStats {
        let before = if stats.min_round_trip.is_zero() { self.round_trip } else { stats.min_round_trip };
        PeerStats { round_trip: self.round_trip, min_round_trip: before.min(self.round_trip), ..stats }
    }

    /// Returns what is to be sent next to this end.
    fn next(&mut self, now: Instant) -> Option<(Channel, Bytes)> {
        if let Some(answer) = self.answers.pop_front() {
            return Some((Channel::Message, answer));
        }
        self.closing.iter_mut().for_each(|closing| closing.drop_late(now));
        // The goodbye of a connection comes before the first message of the next one.
        if let Some(closing) = self.closing.front_mut() {
            // The rest waits for the cap on the rate.
            let (channel, bytes, over) = closing.next(now)?;
            closing.sent(channel, bytes.len());
            if let Some(reason) = over
                && let Some(closed) = self.closing.pop_front()
            {
                closed.end(reason);
            }
            return Some((channel, bytes));
        }
        let open = self.open.as_mut()?;
        let (channel, bytes, over) = open.next(now)?;
        open.sent(channel, bytes.len());
        if let Some(reason) = over
            && let Some(closed) = self.open.take()
        {
            closed.end(reason);
        }
        Some((channel, bytes))
    }

    /// Says goodbye to a connection that this end does not have.
    fn refuse(&mut self, number: u16, reason: DisconnectReason) {
        // Who asks so often without reading does not need every answer.
        if self.answers.len() < MAX_ANSWERS {
            self.answers.push_back(message(GOODBYE, number, &[reason.code()]));
        }
    }

    /// Says goodbye to a connection of which a message has come and that this end does not have:
    /// the port is a new one, and its netcode has not told the other end. Once is enough.
    fn deny(&mut self, number: u16) {
        let is_closing = self.closing.iter().chain(&self.open).any(|own| own.number == number);
        if !is_closing && self.denied.replace(number) != Some(number) {
            self.refuse(number, DisconnectReason::Lost);
        }
    }

    /// Returns whether a connection or attempt of a session is open and stays open.
    fn has_open(&self, connections: &Arc<Connections>) -> bool {
        let open = self.open.as_ref().filter(|open| !open.peer.outbox.is_closing());
        open.is_some_and(|open| Arc::ptr_eq(&open.connections, connections))
    }

    /// Ends the open connection, if it is one of a session's that are meant.
    fn end(&mut self, meant: impl Fn(PeerId) -> bool, of: &Arc<Connections>) {
        let own = |open: &mut Connection| Arc::ptr_eq(&open.connections, of) && meant(open.id);
        // One that the other end has not been told of is forgotten.
        if let Some(open) = self.open.take_if(own).filter(|open| open.admitted || open.hello.is_none()) {
            open.peer.outbox.close(DisconnectReason::Left);
            self.closing.push_back(open);
        }
    }

    /// Takes the connection with a number.
    fn take(&mut self, number: u16) -> Option<Connection> {
        let open = self.open.take_if(|open| open.number == number);
        open.or_else(|| {
            let at = self.closing.iter().position(|closing| closing.number == number)?;
            self.closing.remove(at)
        })
    }

    /// Returns the open connection with a number, once it is admitted and unless it is being
    /// closed.
    fn admitted(&mut self, number: u16) -> Option<&mut Connection> {
        let open = |open: &&mut Connection| open.number == number && open.admitted;
        self.open.as_mut().filter(open).filter(|open| !open.peer.outbox.is_closing())
    }
}

impl PortState {
    /// Opens the connection that somebody waits for, if the other end is there.
    fn open_awaited(&mut self) {
        let here = |joining: &mut Joining| self.remotes.contains_key(&joining.remote);
        if let Some(joining) = self.joining.take_if(here) {
            self.open(joining, PeerId::HOST);
        }
    }

    /// Opens a connection to another end that is there.
    fn open(&mut self, joining: Joining, id: PeerId) {
        let Some(remote) = self.remotes.get_mut(&joining.remote) else { return };
        self.numbers = self.numbers.wrapping_add(1);
        let hello = message(OPEN, self.numbers, &[]);
        let mut open = Connection::new(self.numbers, id, hello, &remote.path, &joining.connections);
        open.since = joining.since;
        if let Some(before) = remote.open.replace(open) {
            before.peer.outbox.close(DisconnectReason::Replaced);
            remote.closing.push_back(before);
        }
    }

    /// Opens a connection to the peer with a key, unless the session has one.
    fn call(&mut self, key: Fingerprint, connections: &Arc<Connections>) -> PeerId {
        let id = PeerId(CALLED + self.called);
        self.called += 1;
        let remote =
            self.remotes.iter().find(|(_, remote)| remote.path.key == key).map(|(&remote, _)| remote);
        let is_open = |remote: &Remote| remote.has_open(connections);
        match remote {
            // Of who is there, or is being called, somebody else may tell again, and falsely.
            Some(remote) if self.remotes.get(&remote).is_some_and(is_open) => {
                connections.ended(id, DisconnectReason::Full);
            }
            Some(remote) => {
                let (since, connections) = (Instant::now(), Arc::clone(connections));
                self.open(Joining { remote, since, connections }, id);
            }
            None => connections.ended(id, DisconnectReason::UnknownHost),
        }
        id
    }

    /// Another end opens a connection.
    fn opened(&mut self, from: u64, number: u16) {
        let Some(remote) = self.remotes.get_mut(&from) else { return };
        // What is refused leaves the connection that this end has.
        let Some(host) = self.host.as_ref().filter(|_| remote.opens.take(Instant::now())) else {
            // As if nobody answered: it may be tried again.
            return remote.refuse(number, DisconnectReason::Silent);
        };
        let own = |open: &&Connection| Arc::ptr_eq(&open.connections, host);
        let own = remote.open.as_ref().filter(own);
        // Where two call each other at once, the call of the lower key counts, at both.
        if own.is_some_and(|open| !open.admitted) && self.key < remote.path.key {
            return remote.refuse(number, DisconnectReason::Full);
        }
        let own = usize::from(own.is_some_and(|open| open.admitted));
        let others = host.peers().len().saturating_sub(own);
        if others >= host.limits.peers || host.inbox.overloaded() {
            return remote.refuse(number, DisconnectReason::Full);
        }
        if let Some(before) = remote.open.take() {
            // An attempt of this end was in the way, and of a connection the other end knows
            // nothing any more.
            let is_attempt = !before.admitted;
            before.end(if is_attempt { DisconnectReason::Full } else { DisconnectReason::Replaced });
        }
        self.peers += 1;
        let role = remote.path.role;
        let hello = message(ADMIT, number, &[role.to_byte()]);
        let mut open = Connection::new(number, PeerId(self.peers), hello, &remote.path, host);
        open.admit(remote, role);
        remote.open = Some(open);
    }

    /// Ends the connections and attempts of a session.
    fn end(&mut self, connections: &Arc<Connections>) {
        self.host.take_if(|host| Arc::ptr_eq(host, connections));
        self.joining.take_if(|joining| Arc::ptr_eq(&joining.connections, connections));
        self.remotes.values_mut().for_each(|remote| remote.end(|_| true, connections));
    }

    /// Ends one connection of a session, or its attempt.
    fn forget(&mut self, peer: PeerId, connections: &Arc<Connections>) {
        connections.forget(peer);
        let nobody = Arc::new(Connections::new(connections.limits.clone()));
        for remote in self.remotes.values_mut() {
            remote.end(|id| id == peer, connections);
            // Of its end nobody is told.
            let own = |open: &&mut Connection| open.id == peer && Arc::ptr_eq(&open.connections, connections);
            remote.closing.iter_mut().filter(own).for_each(|open| open.connections = Arc::clone(&nobody));
        }
    }

    /// Ends attempts that have not been admitted in time.
    fn expire(&mut self, connections: &Arc<Connections>) {
        let late = |since: Instant| since.elapsed() > connections.limits.handshake;
        let waits = |joining: &mut Joining| Arc::ptr_eq(&joining.connections, connections);
        let unopened = self.joining.take_if(|joining| waits(joining) && late(joining.since)).is_some();
        if unopened {
            connections.ended(PeerId::HOST, DisconnectReason::Silent);
        }
        for remote in self.remotes.values_mut() {
            let unanswered = |open: &mut Connection| {
                Arc::ptr_eq(&open.connections, connections) && !open.admitted && late(open.since)
            };
            if let Some(open) = remote.open.take_if(unanswered) {
                open.end(DisconnectReason::Silent);
            }
        }
    }

    fn is_joining(&self, connections: &Arc<Connections>) -> bool {
        self.joining.as_ref().is_some_and(|joining| Arc::ptr_eq(&joining.connections, connections))
            || self.remotes.values().any(|remote| remote.has_open(connections))
    }
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
    /// [`Event::Connected`], or [`Event::Closed`] if the other end has not admitted this one within
    /// [`Limits::handshake`].
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

    /// Tells that another end is there. `remote` is the netcode's number of it, which other methods
    /// have again. Of one that is there already, the path is taken over for later connections.
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

impl PortState {
    fn take_datagram(&mut self, from: u64, mut bytes: Bytes) {
        let len = bytes.len();
        let Some(remote) = self.remotes.get_mut(&from) else { return };
        let Some(open) = take_number(&mut bytes).and_then(|number| remote.admitted(number)) else { return };
        open.received(Channel::Datagram, len);
        let (inbox, most) = (&open.connections.inbox, open.connections.limits.queued_datagrams);
        let dropped = inbox.push_datagram(open.id, Instant::now(), bytes, most);
        if dropped > 0 {
            lock(&open.peer.dropped).receive_queue_full += dropped;
        }
    }

    fn take_message(&mut self, from: u64, mut bytes: Bytes) {
        let len = bytes.len();
        let kind = (!bytes.is_empty()).then(|| bytes.split_to(1)).map(|kind| kind[0]);
        let (Some(kind), Some(number)) = (kind, take_number(&mut bytes)) else { return };
        if kind == OPEN {
            return self.opened(from, number);
        }
        let Some(remote) = self.remotes.get_mut(&from) else { return };
        match kind {
            ADMIT => {
                let role = bytes.first().copied().and_then(Role::from_byte);
                let awaited = remote.open.take_if(|open| open.number == number && !open.admitted);
                match (awaited, role) {
                    (Some(mut open), Some(role)) => {
                        open.admit(remote, role);
                        remote.open = Some(open);
                    }
                    (Some(open), None) => open.end(DisconnectReason::Protocol),
                    // An attempt that was given up.
                    (None, _) => remote.refuse(number, DisconnectReason::Left),
                }
            }
            PART | MESSAGE => {
                let Some(open) = remote.admitted(number) else { return remote.deny(number) };
                open.received(Channel::Message, len);
                open.take_part(bytes, kind == MESSAGE);
            }
            GOODBYE => {
                if let (Some(connection), Some(&code)) = (remote.take(number), bytes.first()) {
                    connection.end(reason_with_code(code));
                }
            }
            _ => {}
        }
    }
}

/// A carrier on a port.
struct PortCarrier {
    port: CarrierPort,
    connections: Arc<Connections>,
    /// The end that a guest joins.
    remote: Option<u64>,
}

impl Carrier for PortCarrier {
    fn fingerprint(&self) -> Fingerprint {
        self.port.state().key
    }

    fn poll(&self) -> Option<Event> {
        self.port.state().expire(&self.connections);
        self.connections.inbox.pop()
    }

    fn begin_frame(&self) {
        self.port.state().expire(&self.connections);
        self.connections.inbox.begin_frame();
    }

    fn poll_in_frame(&self) -> Option<Event> {
        self.connections.inbox.pop_in_frame()
    }

    fn peers(&self) -> Vec<PeerId> {
        self.connections.peers()
    }

    fn send_datagram(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        self.connections.send_datagram(peer, bytes)
    }

    fn send_message(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        self.connections.send_message(peer, bytes)
    }

    fn unsent(&self, peer: PeerId) -> usize {
        self.connections.unsent(peer)
    }

    fn max_datagram_size(&self, peer: PeerId) -> Option<usize> {
        self.connections.max_datagram_size(peer)
    }

    fn close(&self, peer: PeerId, reason: DisconnectReason) {
        self.connections.close(peer, reason);
    }

    fn rejoin(&self) {
        let Some(remote) = self.remote else { return };
        let mut state = self.port.state();
        if !state.is_joining(&self.connections) {
            let connections = Arc::clone(&self.connections);
            let before = state.joining.replace(Joining { remote, since: Instant::now(), connections });
            if let Some(before) = before {
                before.connections.ended(PeerId::HOST, DisconnectReason::Replaced);
            }
            state.open_awaited();
        }
    }

    fn end(&self) {
        self.port.state().end(&self.connections);
    }

    fn stats(&self, peer: PeerId) -> Option<PeerStats> {
        self.connections.stats(peer)
    }
}

impl MeshCarrier for PortCarrier {
    fn invite(&self) -> Invite {
        CarrierPort::invite_of(self.fingerprint())
    }

    fn call(&self, invite: &Invite) -> Result<PeerId, TransportError> {
        Ok(self.port.state().call(invite.fingerprint, &self.connections))
    }

    fn forget(&self, peer: PeerId) {
        self.port.state().forget(peer, &self.connections);
    }
}

impl Drop for PortCarrier {
    fn drop(&mut self) {
        self.end();
    }
}
