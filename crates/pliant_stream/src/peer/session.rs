//! The session of one peer with all other peers.

mod introductions;
mod states;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{GrabConfig, ModalModel, StepSettings};

use introductions::Introductions;

use super::body::PeerBody;
use super::config::{PeerEvent, PeerSessionConfig};
use super::inputs::{InputLog, WINDOW};
use super::other::{Hello, RemotePeer};
use crate::link::Events;
use crate::session::{DisconnectReason, LinkStats, MIN_DATAGRAM, Output};
use crate::state::{BodyId, PeerId, Tick, UserId, in_range, next_free};
use crate::wire::{
    Datagram, HeldAt, ImpulseAt, InputTick, Inputs, MAX_ADDRESS, MAX_BODIES, MAX_HELD, MAX_IMPULSES,
    MAX_NACK_RUN, MAX_NACK_RUNS, MAX_NAME, MAX_PEERS, MAX_TICKS, NackRun, PROTOCOL_VERSION, PeerMessage,
    StateCheck, check_hold,
};
use crate::{StreamError, Surroundings};

/// Largest number of outputs that wait to be fetched before new datagrams are dropped, as a path
/// would drop them.
const MAX_OUT: usize = 16_384;
/// Largest number of coordinates of all bodies. A state of them, which a peer collects from each
/// other one, then has 21 MB, besides hands and contacts.
const MAX_COORDINATES: usize = 1 << 19;
/// What a tick that is stepped again with contacts costs more than one without, see [`RemotePeer`].
const CONTACT_COST: u64 = 4;
/// Number of ticks between checks.
const CHECK_EVERY: u64 = 16;
/// Tolerance of checks as a share of the state's magnitude. Machines of different peers round
/// differently.
const CHECK_TOLERANCE: f64 = 1e-3;
/// Largest share by which a peer's step is stretched or shortened to match the other peers' ticks.
const SLEW: f64 = 0.01;
/// Number of ticks behind all others from which on a peer catches up by steps of its own.
const BEHIND: u64 = 8;
/// Largest number of missed ticks that a peer catches up on at once.
const MAX_MISSED: u64 = 1024;
/// Largest number of steps in an update.
const STEPS: u64 = 8;
/// Pause between requests for the same tick.
const REQUEST_AGAIN: Duration = Duration::from_millis(150);

/// One of several equal peers: a state machine without sockets or clock.
#[derive(Debug)]
pub struct PeerSession {
    config: PeerSessionConfig,
    others: BTreeMap<PeerId, RemotePeer>,
    /// What peers are told of where this one is reached, if not the address of the settings.
    addresses: BTreeMap<PeerId, String>,
    introductions: Introductions,
    bodies: BTreeMap<BodyId, PeerBody>,
    inputs: InputLog,
    own: BTreeMap<u16, HeldAt>,
    /// Own impulses that the next step applies.
    impulses: Vec<ImpulseAt>,
    next_grab: u16,
    tick: Tick,
    started: bool,
    next_step: Option<Duration>,
    /// This peer was behind all others and steps until it is not.
    catches_up: bool,
    /// Ticks that a stall has cost, or a jump of the own clock. The others may hurry this peer by
    /// no more than these.
    missed: u64,
    /// Ticks by which the others have hurried this peer of late. If they turn out to be behind, it
    /// waits as many.
    hurried: u64,
    rollback_from: Option<Tick>,
    /// The tick of the last state taken. Rollback never goes to an earlier tick.
    taken: Tick,
    out: VecDeque<Output>,
    events: Events<PeerEvent>,
    requested: Option<Duration>,
    last_check: Option<StateCheck>,
    /// Counts of the connections that have ended.
    gone: LinkStats,
}

impl PeerSession {
    /// Creates a peer without connections.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a setting out of range, and for a founding peer without
    /// a number.
    pub fn new(config: PeerSessionConfig) -> Result<Self, StreamError> {
        let fail = |what, found: String, expected| Err(StreamError::Config { what, found, expected });
        if config.user == UserId::HOST && config.founds {
            return fail("user", "0".into(), "1 or more");
        }
        if !(1e-5..=1.0).contains(&config.step) {
            return fail("step", config.step.to_string(), "1e-5 to 1 s");
        }
        if config.name.len() > MAX_NAME {
            return fail("name", config.name, "at most 64 bytes");
        }
        if config.address.len() > MAX_ADDRESS {
            return fail("address", config.address, "at most 512 bytes");
        }
        if config.repeats >= MAX_TICKS {
            return fail("repeats", config.repeats.to_string(), "at most 15");
        }
        let started = config.founds;
        let mut inputs = InputLog::default();
        if config.user != UserId::HOST {
            inputs.expect(config.user, 1);
        }
        Ok(Self {
            config,
            others: BTreeMap::new(),
            addresses: BTreeMap::new(),
            introductions: Introductions::default(),
            bodies: BTreeMap::new(),
            inputs,
            own: BTreeMap::new(),
            impulses: Vec::new(),
            next_grab: 0,
            tick: 0,
            started,
            next_step: None,
            catches_up: false,
            missed: 0,
            hurried: 0,
            rollback_from: None,
            taken: 0,
            out: VecDeque::new(),
            events: Events::default(),
            requested: None,
            last_check: None,
            gone: LinkStats::default(),
        })
    }

    /// Adds a body. All peers add the same bodies under the same numbers before they start.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a number in use, [`StreamError::Full`] beyond 1,024
    /// bodies or 524,288 coordinates of all bodies, and [`StreamError::Model`] for a model or
    /// settings that cannot be stepped.
    pub fn add_body(
        &mut self,
        id: BodyId,
        model: Arc<ModalModel>,
        settings: &StepSettings,
    ) -> Result<(), StreamError> {
        if self.bodies.contains_key(&id) {
            let found = id.to_string();
            return Err(StreamError::Config { what: "body", found, expected: "a number that is not in use" });
        }
        if self.bodies.len() >= MAX_BODIES {
            return Err(StreamError::Full { what: "bodies", limit: MAX_BODIES });
        }
        let before: usize = self.bodies.values().map(|body| body.model().mode_count()).sum();
        if before + model.mode_count() > MAX_COORDINATES {
            return Err(StreamError::Full { what: "coordinates of all bodies", limit: MAX_COORDINATES });
        }
        let c = &self.config;
        let body = PeerBody::new(id, model, settings, c.step, c.repair, c.blend_ticks)?;
        self.bodies.insert(id, body);
        Ok(())
    }

    /// Lets a free body touch what stands still around it. All peers set the same before they
    /// connect.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownBody`] for an unknown body, and the errors of
    /// [`Surroundings::check`]. The old surroundings then stay.
    pub fn set_surroundings(&mut self, id: BodyId, around: Surroundings) -> Result<(), StreamError> {
        self.bodies.get_mut(&id).ok_or(StreamError::UnknownBody(id))?.set_surroundings(around)
    }

    /// Digest of the bodies, their models, step settings and surroundings, and the step length.
    pub fn scene(&self) -> u64 {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&self.config.step.to_bits().to_le_bytes());
        for (id, body) in &self.bodies {
            hasher.update(&id.0.to_le_bytes());
            hasher.update(&body.model().hash().0);
            hasher.update(&body.settings().to_bytes());
            hasher.update(&body.surroundings().to_bytes());
        }
        let mut first = [0; 8];
        first.copy_from_slice(&hasher.finalize().as_bytes()[..8]);
        u64::from_le_bytes(first)
    }

    /// Sets where the peer at a connection, and those to whom it passes it on, reach this peer,
    /// instead of [`PeerSessionConfig::address`]. Call this before [`PeerSession::connect`] or
    /// [`PeerSession::accept`]. An address of more than 512 bytes has no effect.
    pub fn set_address_for(&mut self, peer: PeerId, address: String) {
        if address.len() <= MAX_ADDRESS {
            self.addresses.insert(peer, address);
        }
    }

    /// Adds a connection that this side has opened, and sends a hello.
    ///
    /// `user` is the number that the other peer was given. A peer with another number is not
    /// accepted, because the lowest number is trusted. `None`: its hello tells the number.
    ///
    /// # Errors
    /// Returns [`StreamError::Full`] beyond 64 peers and [`StreamError::Config`] for the number 0,
    /// which no peer has, this peer's own number, or datagrams of less than [`MIN_DATAGRAM`].
    pub fn connect(
        &mut self,
        now: Duration,
        peer: PeerId,
        user: impl Into<Option<UserId>>,
        max_datagram: usize,
    ) -> Result<(), StreamError> {
        let user = user.into();
        if let Some(user) = user.filter(|&user| user == UserId::HOST || user == self.config.user) {
            let found = user.0.to_string();
            return Err(StreamError::Config { what: "user", found, expected: "a number of another peer" });
        }
        self.add(now, peer, user, max_datagram)?;
        self.greet(peer);
        Ok(())
    }

    /// Adds a connection that the other side has opened. The answer to its hello follows when this
    /// peer has a number.
    ///
    /// When there is no room, the oldest such connection without a hello is removed to make room.
    ///
    /// # Errors
    /// Returns [`StreamError::Full`] beyond 64 peers and [`StreamError::Config`] for datagrams of
    /// less than [`MIN_DATAGRAM`].
    pub fn accept(&mut self, now: Duration, peer: PeerId, max_datagram: usize) -> Result<(), StreamError> {
        self.add(now, peer, None, max_datagram)
    }

    fn add(
        &mut self,
        now: Duration,
        peer: PeerId,
        user: Option<UserId>,
        max_datagram: usize,
    ) -> Result<(), StreamError> {
        if max_datagram < MIN_DATAGRAM {
            let found = max_datagram.to_string();
            return Err(StreamError::Config { what: "datagram size", found, expected: "at least 256 bytes" });
        }
        if self.others.len() >= MAX_PEERS
            && let Some(silent) = self.others.iter().find(|(_, o)| o.is_silent()).map(|(p, _)| *p)
        {
            self.turn_away(silent, DisconnectReason::Silent);
        }
        if self.others.len() >= MAX_PEERS {
            return Err(StreamError::Full { what: "peers", limit: MAX_PEERS });
        }
        self.others.insert(peer, RemotePeer::new(peer, now, user, max_datagram, self.config.step));
        Ok(())
    }

    /// Sets a new datagram size of the path to a peer. A peer whose path carries less than
    /// [`MIN_DATAGRAM`] is disconnected.
    pub fn set_max_datagram(&mut self, peer: PeerId, bytes: usize) {
        let Some(other) = self.others.get_mut(&peer) else { return };
        other.link.max_datagram = bytes;
        if bytes < MIN_DATAGRAM {
            self.turn_away(peer, DisconnectReason::SmallDatagrams);
        }
    }

    /// Sends a hello, once for each connection.
    fn greet(&mut self, peer: PeerId) {
        let hello = PeerMessage::Hello {
            version: PROTOCOL_VERSION,
            user: self.config.user.0,
            name: self.config.name.clone(),
            address: self.addresses.get(&peer).unwrap_or(&self.config.address).clone(),
            joining: !self.started,
            scene: self.scene(),
        };
        if let Some(other) = self.others.get_mut(&peer).filter(|other| !other.greeted) {
            other.greeted = true;
            self.message(peer, &hello);
        }
    }

    /// Gives a peer the number that it has requested ([`PeerEvent::JoinRequest`]), and tells it the
    /// numbers and addresses of the others.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownPeer`] for a connection that has not requested a number, and
    /// [`StreamError::Config`] for a number in use or an address of more than 512 bytes.
    pub fn welcome(
        &mut self,
        peer: PeerId,
        user: UserId,
        others: &[(UserId, String)],
    ) -> Result<(), StreamError> {
        let asking = |hello: &&Hello| hello.user == UserId::HOST;
        let asks = self.others.get(&peer).and_then(|other| other.hello.as_ref()).filter(asking).cloned();
        let hello = asks.ok_or(StreamError::UnknownPeer(peer))?;
        if user == UserId::HOST || self.is_taken(user) {
            let found = user.0.to_string();
            return Err(StreamError::Config { what: "user", found, expected: "a number that is free" });
        }
        if let Some((_, address)) = others.iter().find(|(_, address)| address.len() > MAX_ADDRESS) {
            let found = address.len().to_string();
            return Err(StreamError::Config { what: "address", found, expected: "at most 512 bytes" });
        }
        let others = others.iter().take(MAX_PEERS).map(|(user, address)| (user.0, address.clone())).collect();
        self.greet(peer);
        self.message(peer, &PeerMessage::Welcome { user: user.0, others });
        self.join(peer, Hello { user, ..hello });
        Ok(())
    }

    fn is_taken(&self, user: UserId) -> bool {
        user == self.config.user || self.inputs.users.get(&user).is_some_and(|u| !u.gone)
    }

    /// Takes a peer's hello, once this peer has a number.
    fn take_hello(&mut self, peer: PeerId) {
        let Some(hello) = self.others.get(&peer).and_then(|other| other.hello.clone()) else { return };
        if self.config.user == UserId::HOST {
            return;
        }
        if hello.user == UserId::HOST {
            return self.event(PeerEvent::JoinRequest { peer });
        }
        if self.is_taken(hello.user) {
            return self.turn_away(peer, DisconnectReason::NumberTaken);
        }
        self.greet(peer);
        self.join(peer, hello);
    }

    /// Lets a peer into the session.
    fn join(&mut self, peer: PeerId, hello: Hello) {
        let Hello { user, name, address, joining } = hello;
        let Some(other) = self.others.get_mut(&peer) else { return };
        (other.user, other.hello) = (Some(user), None);
        other.wants_state = joining && self.started;
        // Founding peers start together and expect each other from the start. The hands of a
        // joining peer come later. The first state that can be given to it is that of tick 1.
        let first =
            if joining { self.tick.max(1) + 1 } else { 1.max(self.tick.saturating_sub(WINDOW as u64 / 2)) };
        self.inputs.expect(user, first);
        self.event(PeerEvent::Joined { peer, user, name, address });
    }

    /// Ends a connection with a goodbye.
    fn turn_away(&mut self, peer: PeerId, reason: DisconnectReason) {
        self.message(peer, &PeerMessage::Goodbye { reason });
        self.disconnect(peer, reason);
    }

    /// Removes a connection.
    pub fn disconnect(&mut self, peer: PeerId, reason: DisconnectReason) {
        self.addresses.remove(&peer);
        let Some(other) = self.others.remove(&peer) else { return };
        self.gone.add_counts(&other.link.stats);
        let Some(user) = other.user else { return self.event(PeerEvent::TurnedAway { peer, reason }) };
        if let Some(inputs) = self.inputs.users.get_mut(&user) {
            // All peers received the same last input, or extrapolate the same hands a little
            // further. After that the hands are released.
            inputs.gone = true;
            self.rollback_from =
                Some(self.rollback_from.map_or(inputs.highest + 1, |d| d.min(inputs.highest + 1)));
            self.inputs.forget_gone(self.tick);
        }
        self.event(PeerEvent::Left { user, reason });
    }

    /// Grabs a body at the next tick and returns the number of the grab.
    ///
    /// `hold` gives the hand's own spring and damper, capped at what devices have, or a grab as
    /// stiff as the patch allows ([`GrabConfig::default`]).
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownBody`] for an unknown body, [`StreamError::NotFinite`] for a
    /// target or radius out of range, [`StreamError::Config`] for a spring or damper out of range,
    /// [`StreamError::Model`] for a vertex that the model lacks or a radius larger than the body,
    /// and [`StreamError::Full`] beyond 16 grabs.
    pub fn begin_grab(
        &mut self,
        body: BodyId,
        vertex: u32,
        radius: f64,
        target: [f64; 3],
        hold: GrabConfig,
    ) -> Result<u16, StreamError> {
        let b = self.bodies.get(&body).ok_or(StreamError::UnknownBody(body))?;
        if !in_range(&target) || !(0.0..=1e9).contains(&radius) {
            return Err(StreamError::NotFinite { what: "grab" });
        }
        let hold = check_hold(hold)?;
        if vertex as usize >= b.model().surface().positions().len() {
            return Err(StreamError::Model(format!("vertex {vertex} is not on the surface")));
        }
        // The comparison uses the radius as the wire format rounds it.
        if f64::from(radius as f32) > b.model().size() {
            return Err(StreamError::Model(format!("a radius of {radius} m is larger than the body")));
        }
        if self.own.len() >= MAX_HELD {
            return Err(StreamError::Full { what: "grabs", limit: MAX_HELD });
        }
        let grab = next_free(&mut self.next_grab, |grab| !self.own.contains_key(&grab));
        self.own.insert(grab, HeldAt { body, grab, vertex, radius, target, hold }.rounded());
        Ok(grab)
    }

    /// Moves a hand. The body receives the new target at the next tick.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownGrab`] for an unknown grab and [`StreamError::NotFinite`] for
    /// a target out of range.
    pub fn set_target(&mut self, grab: u16, target: [f64; 3]) -> Result<(), StreamError> {
        if !in_range(&target) {
            return Err(StreamError::NotFinite { what: "target" });
        }
        let own = self.own.get_mut(&grab).ok_or(StreamError::UnknownGrab(grab))?;
        *own = HeldAt { target, ..*own }.rounded();
        Ok(())
    }

    /// Ends a grab at the next tick.
    pub fn end_grab(&mut self, grab: u16) {
        self.own.remove(&grab);
    }

    /// Applies an impulse (N s, world axes) to a surface vertex of a body at the next tick, at all
    /// peers. It brings the body at most
    /// [`MAX_IMPULSE_SPEED`](crate::MAX_IMPULSE_SPEED) and is rounded to single precision.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownBody`] for an unknown body, [`StreamError::NotFinite`] for an
    /// impulse out of range, [`StreamError::Model`] for a vertex that the model lacks,
    /// [`StreamError::State`] before this peer steps, and [`StreamError::Full`] beyond 8 impulses a
    /// tick.
    pub fn apply_impulse(&mut self, body: BodyId, vertex: u32, impulse: [f64; 3]) -> Result<(), StreamError> {
        let b = self.bodies.get(&body).ok_or(StreamError::UnknownBody(body))?;
        if !in_range(&impulse) {
            return Err(StreamError::NotFinite { what: "impulse" });
        }
        if vertex as usize >= b.model().surface().positions().len() {
            return Err(StreamError::Model(format!("vertex {vertex} is not on the surface")));
        }
        if !self.started {
            let (what, state) = ("apply_impulse", "not started");
            return Err(StreamError::State { what, state, needed: "a state from the others" });
        }
        if self.impulses.len() >= MAX_IMPULSES {
            return Err(StreamError::Full { what: "impulses", limit: MAX_IMPULSES });
        }
        self.impulses.push(ImpulseAt { body, vertex, impulse }.rounded());
        Ok(())
    }

    /// Metrics of a connection; `None` for an unknown connection.
    ///
    /// They are the traffic in both directions, the share of datagrams lost on the path to this
    /// peer, the jitter of that path (`jitter`), the requests for inputs (`nacks`) and the rejected
    /// datagrams. Only the transport knows the round trip and the loss on the path to the other
    /// peer.
    pub fn stats(&self, peer: PeerId) -> Option<LinkStats> {
        self.others.get(&peer).map(|other| other.link.stats())
    }

    /// Counts of all connections, including those that have ended, so they never decrease.
    pub fn totals(&self) -> LinkStats {
        let mut sum = self.gone;
        self.others.values().for_each(|other| sum.add_counts(&other.link.stats));
        sum
    }

    /// The user number of a connection's peer; `None` before its hello, and for an unknown
    /// connection.
    pub fn user_of(&self, peer: PeerId) -> Option<UserId> {
        self.others.get(&peer)?.user
    }

    /// Returns a body of the session.
    pub fn body(&self, id: BodyId) -> Option<&PeerBody> {
        self.bodies.get(&id)
    }

    /// The tick reached; 0 before the start.
    pub fn tick(&self) -> Tick {
        self.tick
    }

    /// The newest tick for which all inputs are known. Its state is final.
    pub fn confirmed(&self) -> Tick {
        self.inputs.complete().min(self.tick)
    }

    /// The state of a body after one of the last 128 ticks.
    pub fn state_at(&self, body: BodyId, tick: Tick) -> Option<&crate::State> {
        self.bodies.get(&body)?.past(tick)
    }

    /// Reactions (N) of the hands on a body at one of the last 128 ticks, with their users.
    pub fn reactions_at(&self, body: BodyId, tick: Tick) -> Option<Vec<(UserId, [f64; 3])>> {
        self.bodies.get(&body)?.reactions_at(tick)
    }

    /// The rigid frame of a free body after one of the last 128 ticks.
    pub fn pose_at(&self, body: BodyId, tick: Tick) -> Option<crate::RigidState> {
        self.bodies.get(&body)?.past_pose(tick)
    }

    /// Processes a received datagram. Any bytes are allowed.
    pub fn on_datagram(&mut self, now: Duration, peer: PeerId, bytes: &[u8]) {
        let Some(other) = self.others.get_mut(&peer) else { return };
        let (Some(user), Ok((sequence, datagram))) = (other.user, Datagram::decode(bytes)) else {
            other.link.reject();
            return;
        };
        if !other.link.receive_datagram(now, sequence, bytes.len()) {
            return;
        }
        match datagram {
            Datagram::Inputs(Inputs { now: theirs, ahead: seen, ticks, check }) => {
                other.theirs = seen.or(other.theirs);
                other.newest = theirs;
                other.came(now, theirs as f64 * self.config.step);
                let sample = self.tick as f64 - theirs as f64;
                if sample.abs() < WINDOW as f64 {
                    let ahead = other.ahead.get_or_insert(sample);
                    *ahead += 0.05 * (sample - *ahead);
                }
                for input in ticks {
                    let tick = input.tick;
                    let planned = self.rollback_from.unwrap_or(self.tick + 1);
                    // A tick in the far future is not stored, since it would displace ticks that
                    // are needed.
                    if tick > self.tick + WINDOW as u64 / 2 {
                        continue;
                    }
                    // What costs too much counts as lost. It is requested again, and when it has
                    // been missing for too long, a state repairs all.
                    if !self.inputs.lacks(user, tick) || !affords(now, other, &self.bodies, &input, planned) {
                        continue;
                    }
                    if self.inputs.put(user, input) && tick <= self.tick {
                        self.rollback_from = Some(self.rollback_from.map_or(tick, |d| d.min(tick)));
                    }
                }
                if let Some(check) = check {
                    self.compare(peer, user, check);
                }
            }
            Datagram::InputRequest(runs) => self.answer(now, peer, &runs),
            _ => other.link.reject(),
        }
    }

    /// Processes a received message. A message that breaks the protocol ends the connection.
    pub fn on_message(&mut self, now: Duration, peer: PeerId, bytes: &[u8]) {
        let message = PeerMessage::decode(bytes);
        // The digest takes a while to compute, and only a hello needs it.
        let own = matches!(message, Ok(PeerMessage::Hello { .. })).then(|| self.scene());
        let Some(other) = self.others.get_mut(&peer) else { return };
        other.link.receive_message(now, bytes.len());
        match message {
            Ok(PeerMessage::Hello { version, user, name, address, joining, scene }) => {
                let user = UserId(user);
                let twice = other.user.is_some() || other.hello.is_some();
                let refused = if version != PROTOCOL_VERSION {
                    Some(DisconnectReason::VersionMismatch)
                } else if twice || other.expected.is_some_and(|expected| user != expected) {
                    Some(DisconnectReason::Protocol)
                } else {
                    (Some(scene) != own).then_some(DisconnectReason::SceneMismatch)
                };
                if let Some(reason) = refused {
                    return self.turn_away(peer, reason);
                }
                other.hello = Some(Hello { user, name, address, joining });
                self.take_hello(peer);
            }
            Ok(PeerMessage::Welcome { user, others }) => {
                let user = UserId(user);
                // Only a peer that this one has asked gives a number, and it has another one
                // itself.
                let from = other.hello.as_ref().filter(|_| other.greeted).map(|hello| hello.user);
                let asked = self.config.user == UserId::HOST && from.is_some();
                if !asked || from == Some(UserId::HOST) || from == Some(user) {
                    return self.turn_away(peer, DisconnectReason::Protocol);
                }
                self.config.user = user;
                self.inputs.expect(user, 1);
                let others = others.into_iter().map(|(user, address)| (UserId(user), address)).collect();
                self.event(PeerEvent::Welcomed { user, others });
                let waiting: Vec<PeerId> = self.others.keys().copied().collect();
                waiting.into_iter().for_each(|peer| self.take_hello(peer));
            }
            Ok(PeerMessage::StateRequest) => other.wants_state = true,
            Ok(PeerMessage::State { tick, now: theirs, more, bodies }) => {
                self.take_part(now, peer, [tick, theirs], more, bodies);
            }
            Ok(PeerMessage::Goodbye { reason }) => self.disconnect(peer, reason),
            Ok(PeerMessage::Others { others }) => self.take_others(now, peer, others),
            Err(_) => {
                other.link.reject();
                self.turn_away(peer, DisconnectReason::Protocol);
            }
        }
    }

    /// Steps to the current time and sends what is due. Returns the number of ticks.
    pub fn update(&mut self, now: Duration) -> u64 {
        let silent: Vec<PeerId> = self
            .others
            .iter()
            .filter(|(_, o)| o.link.is_silent(now, self.config.idle_timeout))
            .map(|(p, _)| *p)
            .collect();
        for peer in silent {
            self.turn_away(peer, DisconnectReason::Silent);
        }
        if !self.started {
            return 0;
        }
        self.tell_others(now);
        self.roll_back();
        let mut stepped = 0;
        let due = *self.next_step.get_or_insert(now + Duration::from_secs_f64(self.config.step));
        let mut due = due;
        while due <= now && stepped < STEPS {
            if self.hurried > 0 && self.lead().1 > BEHIND {
                self.hurried -= 1;
                due += Duration::from_secs_f64(self.config.step);
                continue;
            }
            self.step();
            stepped += 1;
            self.hurried = self.hurried.saturating_sub(1);
            due += Duration::from_secs_f64(self.config.step * (1.0 + self.drift()));
            if stepped == STEPS && due <= now {
                // The clock does not tell a stall from a jump of its own. What the others tell of
                // says how many ticks were missed.
                let missed = ((now - due).as_secs_f64() / self.config.step) as u64;
                self.missed = self.missed.saturating_add(missed).min(MAX_MISSED);
                due = now + Duration::from_secs_f64(self.config.step);
            }
        }
        stepped += self.catch_up(STEPS - stepped);
        self.next_step = Some(due);
        self.ask(now);
        self.give_states(now);
        stepped
    }

    /// Latest time at which to call [`PeerSession::update`]. `None` when there is nothing to wait
    /// for.
    pub fn next_wakeup(&self) -> Option<Duration> {
        let silent = self.others.values().map(|other| other.link.silent_at(self.config.idle_timeout));
        self.next_step.filter(|_| self.started).into_iter().chain(silent).min()
    }

    /// Returns the next datagram or message to send.
    ///
    /// Once 16,384 outputs wait here, new datagrams are dropped. Messages are never dropped.
    /// Besides the first and the last message of each connection, messages are requests for a
    /// state, at most one a second, and states. Each peer gets at most 16 states at once and two a
    /// second, and none while the queue is full.
    pub fn poll_output(&mut self) -> Option<Output> {
        self.out.pop_front()
    }

    /// Returns the next event.
    pub fn poll_event(&mut self) -> Option<PeerEvent> {
        self.events.pop()
    }

    /// Rolls back to the earliest tick for which a new input is known.
    fn roll_back(&mut self) {
        let Some(from) = self.rollback_from.take() else { return };
        // The peer that gave a state knew all inputs up to its tick, so the state contains late
        // inputs.
        let from = from.max(self.taken + 1);
        let mut too_late = false;
        for body in self.bodies.values_mut() {
            too_late |= !body.correct(from, &self.inputs);
        }
        if too_late {
            // Only a state can help. It is requested together with the missing inputs.
            self.others.values_mut().for_each(|o| o.lost = true);
        }
    }

    fn step(&mut self) {
        self.tick += 1;
        let held = self.own.values().copied().collect();
        let impulses = std::mem::take(&mut self.impulses);
        self.inputs.put(self.config.user, InputTick { tick: self.tick, held, impulses });
        for body in self.bodies.values_mut() {
            body.advance(&self.inputs);
        }
        self.inputs.forget_gone(self.tick);
        let confirmed = self.confirmed();
        let due = confirmed - confirmed % CHECK_EVERY;
        let mut check = None;
        if self.last_check.is_none_or(|c| c.tick < due) && due > 0 {
            // Each check covers one body, in turn.
            let index = (due / CHECK_EVERY) as usize % self.bodies.len().max(1);
            check =
                self.bodies.values().nth(index).and_then(|b| {
                    Some(StateCheck { body: b.id(), tick: due, value: b.check(due)?.0 as f32 })
                });
            self.last_check = check.or(self.last_check);
        }
        let known = |o: &RemotePeer| o.user.is_some() || o.expected.is_some();
        let peers: Vec<PeerId> = self.others.iter().filter(|(_, o)| known(o)).map(|(p, _)| *p).collect();
        for peer in peers {
            self.send_inputs(peer, check);
        }
    }

    fn send_inputs(&mut self, peer: PeerId, check: Option<StateCheck>) {
        let Some(own) = self.inputs.users.get(&self.config.user) else { return };
        let Some(other) = self.others.get(&peer) else { return };
        let mut ticks: Vec<InputTick> = (0..=self.config.repeats as u64)
            .map_while(|back| self.tick.checked_sub(back))
            .filter_map(|t| own.at(t).cloned())
            .collect();
        while ticks.len() > 1 && Inputs::bytes(&ticks) > other.link.max_datagram {
            ticks.pop();
        }
        let (now, ahead) = (self.tick, other.ahead);
        self.datagram(peer, &Datagram::Inputs(Inputs { now, ahead, ticks, check }));
    }

    fn answer(&mut self, now: Duration, peer: PeerId, runs: &[NackRun]) {
        let Some(own) = self.inputs.users.get(&self.config.user) else { return };
        let Some(other) = self.others.get_mut(&peer) else { return };
        let wanted = runs.iter().flat_map(|run| run.first..run.first + u64::from(run.count));
        let known = wanted.filter_map(|t| own.at(t)).take(WINDOW);
        let mut ticks: Vec<InputTick> =
            known.take_while(|_| other.link.repeats.spend(now, 1.0)).cloned().collect();
        let limit = other.link.max_datagram;
        while !ticks.is_empty() {
            let mut count = ticks.len().min(MAX_TICKS);
            while count > 1 && Inputs::bytes(&ticks[..count]) > limit {
                count -= 1;
            }
            let rest = ticks.split_off(count);
            let (now, ahead) = (self.tick, self.others.get(&peer).and_then(|o| o.ahead));
            self.datagram(peer, &Datagram::Inputs(Inputs { now, ahead, ticks, check: None }));
            ticks = rest;
        }
    }

    /// Requests from each peer the inputs that are missing and that no repeat will bring.
    fn ask(&mut self, now: Duration) {
        let mut questions = Vec::new();
        for (peer, other) in &mut self.others {
            let Some(inputs) = other.user.and_then(|u| self.inputs.users.get(&u)) else { continue };
            let to = inputs.highest.saturating_sub(self.config.repeats as u64);
            let from = (inputs.complete + 1).max(inputs.first);
            let mut runs: Vec<NackRun> = Vec::new();
            for tick in from..to {
                let again =
                    other.requested.get(&tick).is_some_and(|at| now.saturating_sub(*at) < REQUEST_AGAIN);
                if inputs.at(tick).is_some() || again {
                    continue;
                }
                other.requested.insert(tick, now);
                match runs.last_mut() {
                    Some(run) if run.first + u64::from(run.count) == tick && run.count < MAX_NACK_RUN => {
                        run.count += 1;
                    }
                    _ => runs.push(NackRun { first: tick, count: 1 }),
                }
            }
            other.requested.retain(|t, _| *t >= from);
            runs.truncate(MAX_NACK_RUNS);
            if !runs.is_empty() {
                other.link.stats.nacks += 1;
                questions.push((*peer, Datagram::InputRequest(runs)));
            }
            if inputs.complete + (WINDOW as u64) / 2 < inputs.highest {
                other.lost = true;
            }
        }
        for (peer, question) in questions {
            self.datagram(peer, &question);
        }
        if self.others.values().any(RemotePeer::is_apart) {
            self.request_state(now);
        }
    }

    /// By how many ticks every other peer is ahead of this one, and by how many behind, as far as
    /// they have told.
    fn lead(&self) -> (u64, u64) {
        let others = self.others.values().filter(|o| o.user.is_some() && o.newest > 0);
        let both = others.map(|o| (o.newest.saturating_sub(self.tick), self.tick.saturating_sub(o.newest)));
        both.reduce(|a, b| (a.0.min(b.0), a.1.min(b.1))).unwrap_or_default()
    }

    /// Steps up to `most` of the ticks that this peer has missed, if every other one is well ahead.
    /// Then it was a stall. Returns the number of ticks.
    fn catch_up(&mut self, most: u64) -> u64 {
        let (ahead, _) = self.lead();
        self.catches_up = ahead > if self.catches_up { 0 } else { BEHIND };
        if !self.catches_up {
            return 0;
        }
        let ticks = most.min(ahead).min(self.missed);
        (0..ticks).for_each(|_| self.step());
        self.missed -= ticks;
        self.hurried += ticks;
        for ahead in self.others.values_mut().filter_map(|o| o.ahead.as_mut()) {
            *ahead += ticks as f64;
        }
        ticks
    }

    /// Share by which a step is longer than `step`, to stay with the other peers; positive when
    /// this peer is ahead.
    ///
    /// Each side sees the other late by the one-way delay. With `d` the true lead and `w` the
    /// one-way delay in ticks, this side sees `d + w` and the other `w - d`, so half the difference
    /// is `d`.
    fn drift(&self) -> f64 {
        let leads: Vec<f64> =
            self.others.values().filter_map(|o| Some(0.5 * (o.ahead? - o.theirs?))).collect();
        if leads.is_empty() {
            return 0.0;
        }
        let mean = leads.iter().sum::<f64>() / leads.len() as f64;
        (0.01 * mean).clamp(-SLEW, SLEW)
    }

    fn datagram(&mut self, peer: PeerId, datagram: &Datagram) {
        let Some(other) = self.others.get_mut(&peer) else { return };
        if self.out.len() >= MAX_OUT {
            return other.link.drop_datagram();
        }
        other.link.send_datagram(|sequence| datagram.encode(sequence), &mut self.out);
    }

    fn message(&mut self, peer: PeerId, message: &PeerMessage) {
        if let Some(other) = self.others.get_mut(&peer) {
            other.link.send_message(message.encode(), &mut self.out);
        }
    }

    fn event(&mut self, event: PeerEvent) {
        self.events.push(event);
    }
}

/// Pays for an input from the budgets of its sender, and returns whether they allow it: the ticks
/// before `planned` that are stepped again for it, and the patches that no body has yet.
fn affords(
    now: Duration,
    other: &mut RemotePeer,
    bodies: &BTreeMap<BodyId, PeerBody>,
    input: &InputTick,
    planned: Tick,
) -> bool {
    let again = planned.saturating_sub(input.tick);
    // A step with contacts takes as long as several without.
    let held = input.held.iter().map(|held| held.body);
    let mut touched = held.chain(input.impulses.iter().map(|impulse| impulse.body));
    let touches = touched.any(|body| bodies.get(&body).is_some_and(PeerBody::touches));
    let done = input.held.len() + input.impulses.len();
    let cost = again * (1 + done as u64 + if touches { CONTACT_COST } else { 0 });
    let patch = |held: &HeldAt| match bodies.get(&held.body) {
        Some(body) if !body.has_patch(held.vertex, held.radius) => {
            other.link.patches.spend(now, body.model(), held.vertex, held.radius)
        }
        _ => true,
    };
    (cost == 0 || other.late_budget.spend(now, cost as f64)) && input.held.iter().all(patch)
}
