//! Equal peers in Bevy: every app steps every body, and the peers only exchange their hands
//! ([`pliant_stream::peer`]).
//!
//! Each peer both listens and connects. A peer that joins with the invite of any other peer
//! receives the invites of all others, and connects to them too. When a peer leaves, the others
//! stay connected.

mod mesh;
mod play;
mod reconnect;
mod tokens;

use std::collections::BTreeMap;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bevy::prelude::*;
use pliant_body::{BodyState, Driven, ModalBody};
use pliant_stream::peer::{LateInputRepair, PeerSession, PeerSessionConfig};
use pliant_stream::{BodyId, DisconnectReason, LinkStats, PeerId, UserId};

use crate::known_users::KnownUsers;
use crate::metrics::{Ledger, NetStats};
use crate::own_grab::OwnGrab;
use crate::remote::SessionJoined;
use crate::roster::Roster;
use crate::shared_body::SharedBody;
use crate::transport::{
    Access, Emulation, Endpoint, Fingerprint, HostOptions, Identity, Invite, JoinOptions, Limits, PeerStats,
    Role, Token, TransportError,
};
use crate::user::shortened;
use mesh::ConnectedPeer;
use play::PlayedBody;
use reconnect::Missed;

pub(crate) use mesh::receive;
pub(crate) use play::{send_hands, show};

/// How to play among peers.
#[derive(Debug)]
pub struct PeerConfig {
    /// Name of this user, at most 64 bytes. Default: `peer`.
    pub name: String,
    /// The invite of a peer in the session. Default `None`: this is the first peer, and it starts
    /// the session.
    pub join: Option<Invite>,
    /// Where this peer listens, its key, who may join through it, limits, and the emulated link on
    /// all its connections.
    pub transport: HostOptions,
    /// How the session corrects for late hands. Default: [`LateInputRepair::Rollback`].
    pub repair: LateInputRepair,
    /// How long this peer tries to reconnect to a peer that was lost without a goodbye, at the
    /// address where that peer last listened. Of the two peers, the one with the higher number
    /// connects and takes over the other's state. Zero: it does not try. Default: 60 s.
    pub rejoin: Duration,
}

impl Default for PeerConfig {
    fn default() -> Self {
        Self {
            name: "peer".into(),
            join: None,
            transport: HostOptions::default(),
            repair: LateInputRepair::default(),
            rejoin: Duration::from_secs(60),
        }
    }
}

/// Connection state of a peer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PeerState {
    /// Models are being loaded, or the first peer has not answered yet.
    Joining,
    /// The peer is in the session.
    In {
        /// The peer's user number.
        user: UserId,
    },
    /// The session is over, or never began. Bodies keep their last displayed state.
    Closed {
        /// The reason.
        reason: DisconnectReason,
    },
}

/// The session of this app among peers.
///
/// The session's bodies are all [`SharedBody`] entities with a model that exist when the session
/// begins. All peers must have the same bodies, by name and model. The bodies are
/// [`Driven::Remote`]: this resource steps them, at the rate of `Time<Fixed>`. A free body begins
/// in its model's pose, with its weight. An anchored body stays where each app has placed it.
#[derive(Resource)]
pub struct NetPeer {
    listening: Endpoint,
    /// Connections that this peer has opened.
    opened: BTreeMap<PeerId, Endpoint>,
    /// Threads of closed connections that are still sending their goodbye. No frame waits for them.
    ending: Vec<JoinHandle<()>>,
    /// The private key in PKCS #8 form, which the opened connections use too.
    key: Vec<u8>,
    config: PeerConfig,
    limits: Limits,
    emulation: Option<Emulation>,
    began: Instant,
    /// When this peer was given its number, measured from `began`.
    began_at: Duration,
    state: PeerState,
    session: Option<PeerSession>,
    /// Length of a step.
    step: Duration,
    bodies: BTreeMap<BodyId, PlayedBody>,
    others: BTreeMap<PeerId, ConnectedPeer>,
    /// Numbers and invites of the peers that this peer is connecting to, as the first peer sent
    /// them.
    introduced: BTreeMap<PeerId, (UserId, Invite)>,
    /// Lost peers that this peer tries to reach.
    missed: Vec<Missed>,
    known: KnownUsers,
    /// Who may join by a token of the application's.
    access: Access,
    /// The tokens with which other peers come back, and which they give to those that they let in.
    /// Each peer has one of its own, so that none is known to all.
    tokens: BTreeMap<Fingerprint, Token>,
    users: Roster,
    grabs: BTreeMap<Entity, OwnGrab>,
    scratch: Vec<f64>,
    ledger: Ledger,
    next_opened: u64,
}

/// First number of the connections that this peer opens. Connection numbers of the listening socket
/// never get this large.
const OPENED: u64 = 1 << 48;

impl NetPeer {
    /// Opens the sockets.
    pub(crate) fn open(mut config: PeerConfig) -> Result<Self, TransportError> {
        let identity = config.transport.identity.take().map_or_else(Identity::generate, Ok)?;
        let key = identity.to_pkcs8();
        let (limits, emulation) = (config.transport.limits.clone(), config.transport.emulation.clone());
        let access = config.transport.access.clone();
        let options = HostOptions { identity: Some(identity), ..std::mem::take(&mut config.transport) };
        let listening = Endpoint::host(options)?;
        let mut peer = Self {
            listening,
            opened: BTreeMap::new(),
            ending: Vec::new(),
            key,
            config,
            limits,
            emulation,
            began: Instant::now(),
            began_at: Duration::ZERO,
            state: PeerState::Joining,
            session: None,
            step: Duration::ZERO,
            bodies: BTreeMap::new(),
            others: BTreeMap::new(),
            introduced: BTreeMap::new(),
            missed: Vec::new(),
            known: KnownUsers::default(),
            access,
            tokens: BTreeMap::new(),
            users: Roster::default(),
            grabs: BTreeMap::new(),
            scratch: Vec::new(),
            ledger: Ledger::default(),
            next_opened: OPENED,
        };
        if let Some(invite) = peer.config.join.clone() {
            peer.connect_to(&invite)?;
        }
        Ok(peer)
    }

    /// Opens a connection to another peer.
    fn connect_to(&mut self, invite: &Invite) -> Result<PeerId, TransportError> {
        let options = JoinOptions {
            identity: Some(Identity::from_pkcs8(&self.key)?),
            limits: Limits { message: Limits::guest().message, ..self.limits.clone() },
            emulation: self.emulation.clone(),
            bind: None,
        };
        let endpoint = Endpoint::join(invite, options)?;
        let peer = PeerId(self.next_opened);
        self.next_opened += 1;
        self.opened.insert(peer, endpoint);
        Ok(peer)
    }

    /// Returns the connection state.
    pub fn state(&self) -> &PeerState {
        &self.state
    }

    /// Returns the invite with which others join through this peer.
    pub fn invite(&self) -> Invite {
        self.listening.invite()
    }

    /// Returns the session, with more details. `None` until the models are loaded.
    pub fn session(&self) -> Option<&PeerSession> {
        self.session.as_ref()
    }

    /// Returns the number of lost peers that this peer tries to reach ([`PeerConfig::rejoin`]).
    pub fn looked_for(&self) -> usize {
        self.missed.len()
    }

    /// Returns the session's number of an entity's body.
    pub fn body_of(&self, entity: Entity) -> Option<BodyId> {
        self.bodies.iter().find(|(_, played)| played.entity == entity).map(|(&id, _)| id)
    }

    /// Returns the emulated link under every connection of this peer, if there is one.
    pub fn emulation(&self) -> Option<&Emulation> {
        self.emulation.as_ref()
    }

    /// Sets, replaces or removes the emulated link under every connection of this peer, at any
    /// time.
    pub fn set_emulation(&mut self, emulation: Option<Emulation>) {
        self.listening.set_emulation(emulation.clone());
        self.opened.values().for_each(|endpoint| endpoint.set_emulation(emulation.clone()));
        self.emulation = emulation;
    }

    fn now(&self) -> Duration {
        self.began.elapsed()
    }

    /// Returns the endpoint of a connection, and the connection's number in that endpoint.
    fn way(&self, peer: PeerId) -> (&Endpoint, PeerId) {
        match self.opened.get(&peer) {
            Some(endpoint) => (endpoint, PeerId::HOST),
            None => (&self.listening, peer),
        }
    }

    pub(crate) fn metrics(&mut self) -> NetStats {
        let mut stats = NetStats::default();
        let line = |&peer: &PeerId| {
            let (endpoint, number) = self.way(peer);
            Some((peer, endpoint.stats(number)?))
        };
        let lines: Vec<(PeerId, PeerStats)> = self.others.keys().filter_map(line).collect();
        for (peer, transport) in &lines {
            let link = self.session.as_ref().and_then(|session| session.stats(*peer)).unwrap_or_default();
            // QUIC measures the round trip and the loss on the path to the other peer.
            let (round_trip, loss_out) = (transport.round_trip, transport.loss());
            stats.add(&LinkStats { round_trip, loss_out, ..link }, transport);
        }
        let totals = self.session.as_ref().map(PeerSession::totals).unwrap_or_default();
        stats.count(&totals, &self.ledger.sum(lines.into_iter()));
        if let Some(session) = &self.session {
            stats.displayed_ticks = session.tick();
            stats.recovered = self
                .bodies
                .keys()
                .filter_map(|&id| session.body(id))
                .map(pliant_stream::peer::PeerBody::restepped)
                .sum();
        }
        stats
    }

    /// Creates the session when the bodies are loaded. The first peer begins at once, and the
    /// others request a number.
    fn begin(&mut self, world: &mut World) {
        let founds = self.config.join.is_none();
        let user = if founds { UserId(1) } else { UserId::HOST };
        let config = PeerSessionConfig {
            user,
            name: shortened(&self.config.name).to_owned(),
            address: self.listening.invite().to_string(),
            step: self.step.as_secs_f64(),
            repair: self.config.repair,
            idle_timeout: self.limits.idle_timeout,
            founds,
            ..PeerSessionConfig::default()
        };
        let made = PeerSession::new(config).and_then(|mut session| {
            for (&id, played) in &self.bodies {
                session.add_body(id, played.model.clone(), &played.settings)?;
            }
            Ok(session)
        });
        match made {
            Ok(session) => self.session = Some(session),
            Err(error) => {
                error!("the session cannot begin: {error}");
                return self.close(world, DisconnectReason::InvalidSettings);
            }
        }
        if founds {
            self.enter(world, user);
            world.write_message(SessionJoined { user, reconnected: false });
        }
    }

    /// Takes this peer's number.
    fn enter(&mut self, world: &mut World, user: UserId) {
        self.began_at = self.now();
        self.known.see(self.listening.fingerprint(), user, |_| true);
        self.state = PeerState::In { user };
        let name = shortened(&self.config.name);
        info!("among the peers as {name}, user {}", user.0);
        self.users.meet_yourself(world, user, name, Role::Hold);
    }

    /// Finds the bodies of the session. Returns false while there are none, or one of them is not
    /// loaded yet.
    fn gather(&mut self, world: &mut World) -> bool {
        let step =
            world.get_resource::<Time<Fixed>>().map_or(Duration::from_millis(25), Time::<Fixed>::timestep);
        let mut found = BTreeMap::new();
        let mut shared = world.query::<(Entity, &SharedBody, &ModalBody, Option<&BodyState>)>();
        for (entity, name, _, state) in shared.iter(world) {
            let Some(state) = state.filter(|state| state.has_place()) else { return false };
            let settings = play::agreed_settings(state.body());
            let id = number_of(&name.name);
            if found.contains_key(&id) {
                warn_once!("{} is left out: another body has its number", name.name);
                continue;
            }
            found.insert(id, PlayedBody::new(entity, state.model().clone(), settings));
        }
        if found.is_empty() {
            return false;
        }
        for played in found.values() {
            world.entity_mut(played.entity).insert((Driven::Remote, crate::remote::RemoteHands::default()));
        }
        (self.step, self.bodies) = (step, found);
        true
    }
}

impl Drop for NetPeer {
    /// Says goodbye on all connections at the same time. This takes at most a second, whatever
    /// their number.
    fn drop(&mut self) {
        self.listening.signal();
        let opened = std::mem::take(&mut self.opened).into_values();
        self.ending.extend(opened.filter_map(Endpoint::close_detached));
        for thread in self.ending.drain(..) {
            // A panic of that thread has been reported there.
            let _ = thread.join();
        }
    }
}

/// Returns the number of a body name: FNV-1a of its bytes, folded to 16 bits. All peers therefore
/// find the same number.
fn number_of(name: &str) -> BodyId {
    let hash =
        name.bytes().fold(0x811c_9dc5_u32, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193));
    BodyId((hash >> 16) as u16 ^ hash as u16)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_have_one_number_everywhere() {
        // FNV-1a of "a" is e40c292c (the algorithm's published test vector).
        assert_eq!(number_of("a"), BodyId(0xe40c ^ 0x292c));
        assert_ne!(number_of("pip"), number_of("bar"));
    }
}
