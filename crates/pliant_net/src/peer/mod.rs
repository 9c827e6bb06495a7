//! Equal peers in Bevy: every app steps every body, and only the hands cross ([`pliant_stream::peer`]).
//!
//! Each peer listens and each connects: who comes with the invite of any of them is told of all the others, and joins them too. One that goes
//! leaves the others connected.

mod mesh;
mod message;
mod play;
mod reconnect;

use std::collections::BTreeMap;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bevy::prelude::*;
use pliant_body::{BodyState, Driven, ModalBody};
use pliant_stream::peer::{PeerConfig as SessionConfig, PeerSession, Repair};
use pliant_stream::{BodyId, LinkStats, PeerId, UserId};

use crate::metrics::{Ledger, NetStats};
use crate::scene::{self, SharedBody};
use crate::transport::{
    Emulation, Endpoint, Fingerprint, HostOptions, Identity, Invite, JoinOptions, Limits, PeerStats, Role,
    TransportError,
};
use crate::user::{User, UserLink, Yourself};
use mesh::Other;
use message::Scene;
use play::{PlayedBody, SentGrab};
use reconnect::Missed;

pub(crate) use mesh::receive;
pub(crate) use play::{show, tell_hands};

/// How to play among equals.
#[derive(Debug)]
pub struct PeerConfig {
    /// What this user is called, at most 64 bytes. Default: `peer`.
    pub name: String,
    /// The invite of a peer that is there already. Default `None`: this is the first, and begins.
    pub join: Option<Invite>,
    /// Where this peer listens, its key, who may join through it, limits, emulated link (on all its connections).
    pub transport: HostOptions,
    /// How a late hand is put right. Default: [`Repair::Rollback`].
    pub repair: Repair,
    /// A peer that cannot be heard any more, without having said goodbye, is looked for again for so long, where it last listened; of the two the
    /// one with the higher number calls, and takes over the other's state. Zero: never. Default: 60 s.
    pub rejoin: Duration,
}

impl Default for PeerConfig {
    fn default() -> Self {
        Self {
            name: "peer".into(),
            join: None,
            transport: HostOptions::default(),
            repair: Repair::default(),
            rejoin: Duration::from_secs(60),
        }
    }
}

/// Where a peer stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PeerState {
    /// Models are being loaded, or the first peer has not answered yet.
    Joining,
    /// Among the peers.
    In {
        /// Our number.
        user: UserId,
    },
    /// It is over, or never began; bodies stay as they were last seen.
    Closed {
        /// Why, in words.
        reason: String,
    },
}

/// The peers' session of this app.
///
/// The bodies are all [`SharedBody`] entities with a model that are there when the session begins; all peers must have the same ones, by name and
/// model. They are [`Driven::Remote`]: their steps are this resource's, at the rate of `Time<Fixed>`. A free body begins where its model
/// has it, with its weight; an anchored one is where each app has placed it.
#[derive(Resource)]
pub struct NetPeer {
    listening: Endpoint,
    /// Connections that this peer has opened.
    opened: BTreeMap<PeerId, Endpoint>,
    /// Threads of connections that are over and still say goodbye: no frame waits for them.
    ending: Vec<JoinHandle<()>>,
    /// The key, to show it on those too.
    key: Vec<u8>,
    config: PeerConfig,
    limits: Limits,
    emulation: Option<Emulation>,
    began: Instant,
    /// When the session began, on the clock of `began`.
    began_at: Duration,
    state: PeerState,
    session: Option<PeerSession>,
    scene: Scene,
    bodies: BTreeMap<BodyId, PlayedBody>,
    others: BTreeMap<PeerId, Other>,
    /// Whom we are on the way to, as the first peer has told.
    introduced: BTreeMap<PeerId, (UserId, Invite)>,
    /// Who was lost, and is looked for.
    missed: Vec<Missed>,
    /// Who has which key, to be the same again.
    numbers: BTreeMap<Fingerprint, UserId>,
    users: BTreeMap<UserId, Entity>,
    grabs: BTreeMap<Entity, SentGrab>,
    scratch: Vec<f64>,
    ledger: Ledger,
    /// Messages that no peer has to say.
    rejected: u64,
    next_opened: u64,
}

/// Numbers of connections that this peer has opened begin here; those of its listening socket never come so far.
const OPENED: u64 = 1 << 48;

impl NetPeer {
    /// Opens the sockets.
    pub(crate) fn open(mut config: PeerConfig) -> Result<Self, TransportError> {
        let identity = config.transport.identity.take().map_or_else(Identity::generate, Ok)?;
        let key = identity.to_pkcs8();
        let (limits, emulation) = (config.transport.limits.clone(), config.transport.emulation.clone());
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
            scene: Scene { step_ns: 0, bodies: Vec::new() },
            bodies: BTreeMap::new(),
            others: BTreeMap::new(),
            introduced: BTreeMap::new(),
            missed: Vec::new(),
            numbers: BTreeMap::new(),
            users: BTreeMap::new(),
            grabs: BTreeMap::new(),
            scratch: Vec::new(),
            ledger: Ledger::default(),
            rejected: 0,
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

    /// Where we stand.
    pub fn state(&self) -> &PeerState {
        &self.state
    }

    /// What others paste to join through this peer.
    pub fn invite(&self) -> Invite {
        self.listening.invite()
    }

    /// The session below, for those who want to know more. `None` until the models are here and a number is given.
    pub fn session(&self) -> Option<&PeerSession> {
        self.session.as_ref()
    }

    /// Peers that were lost and that this one calls ([`PeerConfig::rejoin`]).
    pub fn looked_for(&self) -> usize {
        self.missed.len()
    }

    /// The session's number of the body of a name.
    pub fn body_of(&self, entity: Entity) -> Option<BodyId> {
        self.bodies.iter().find(|(_, played)| played.entity == entity).map(|(&id, _)| id)
    }

    /// The emulated link under every connection of this peer, if there is one.
    pub fn emulation(&self) -> Option<&Emulation> {
        self.emulation.as_ref()
    }

    /// Puts an emulated link under every connection of this peer, another one, or none, at any time.
    pub fn set_emulation(&mut self, emulation: Option<Emulation>) {
        self.listening.set_emulation(emulation.clone());
        self.opened.values().for_each(|endpoint| endpoint.set_emulation(emulation.clone()));
        self.emulation = emulation;
    }

    fn now(&self) -> Duration {
        self.began.elapsed()
    }

    /// The endpoint that a connection belongs to, and the connection's number there.
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
            // Both ways' times and the way there are QUIC's to tell.
            let (round_trip, loss_out) = (transport.round_trip, transport.loss());
            stats.add(&LinkStats { round_trip, loss_out, ..link }, transport);
        }
        let mut totals = self.session.as_ref().map(PeerSession::totals).unwrap_or_default();
        totals.rejected += self.rejected;
        stats.count(&totals, &self.ledger.sum(lines.into_iter()));
        if let Some(session) = &self.session {
            stats.shown = session.tick();
            stats.recovered = self
                .bodies
                .keys()
                .filter_map(|&id| session.body(id))
                .map(pliant_stream::peer::PeerBody::restepped)
                .sum();
        }
        stats
    }

    /// Makes the session, when the scene's bodies are here. `founds`: it begins with this peer.
    fn begin(&mut self, world: &mut World, user: UserId, founds: bool) -> bool {
        let step = Duration::from_nanos(self.scene.step_ns).as_secs_f64();
        let config = SessionConfig {
            user,
            name: scene::shortened(&self.config.name).to_owned(),
            step,
            repair: self.config.repair,
            idle_timeout: self.limits.idle_timeout,
            founds,
            ..SessionConfig::default()
        };
        let made = PeerSession::new(config).and_then(|mut session| {
            for (&id, played) in &self.bodies {
                session.add_body(id, played.model.clone(), &played.settings)?;
            }
            Ok(session)
        });
        match made {
            Ok(session) => (self.session, self.began_at) = (Some(session), self.now()),
            Err(error) => {
                self.close(world, format!("the session cannot begin: {error}"));
                return false;
            }
        }
        self.remember(self.listening.fingerprint(), user);
        self.state = PeerState::In { user };
        let you = User::new(user, scene::shortened(&self.config.name), Role::Hold);
        info!("among the peers as {}, user {}", you.name, user.0);
        let you = world.spawn((you, UserLink::default(), Yourself)).id();
        self.users.insert(user, you);
        true
    }

    /// Finds the scene's bodies; false while one of them is not loaded yet.
    fn gather(&mut self, world: &mut World) -> bool {
        let step =
            world.get_resource::<Time<Fixed>>().map_or(Duration::from_millis(25), Time::<Fixed>::timestep);
        let mut found = BTreeMap::new();
        let mut shared = world.query::<(Entity, &SharedBody, &ModalBody, Option<&BodyState>)>();
        for (entity, name, _, state) in shared.iter(world) {
            let Some(state) = state.filter(|state| state.has_place()) else { return false };
            let settings = play::agreed_settings(state.body());
            let id = number_of(&name.name);
            if found.contains_key(&id) || found.len() >= message::MOST_BODIES {
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
        self.scene = Scene {
            step_ns: u64::try_from(step.as_nanos()).unwrap_or(0),
            bodies: found.iter().map(|(&id, played)| (id, played.digest())).collect(),
        };
        self.bodies = found;
        true
    }
}

impl Drop for NetPeer {
    /// Says goodbye to all at once, which takes a second at most however many there are.
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

/// All peers find the same number for a name: FNV-1a of its bytes, folded to 16 bits.
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
