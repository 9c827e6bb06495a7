//! Equal peers in Bevy: every app steps every body, and the peers only exchange their hands
//! ([`pliant_stream::peer`]).
//!
//! Each peer both listens and connects. A peer that joins with the invite of any other peer
//! receives the invites of all others, and connects to them too. When a peer leaves, the others
//! stay connected.

mod mesh;
mod missed;
mod play;
mod reconnect;
mod tokens;

use std::any::Any;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use bevy::platform::time::Instant;
use bevy::prelude::*;
use pliant_body::{BodyRefused, BodyState, Driven, FixedObstacles, ModalBody};
use pliant_stream::peer::{LateInputRepair, PeerSession, PeerSessionConfig};
use pliant_stream::{BodyId, DisconnectReason, LinkStats, PeerId, UserId};

use crate::known_users::KnownUsers;
use crate::metrics::{Ledger, NetStats};
use crate::own_grab::OwnGrab;
use crate::remote::SessionJoined;
use crate::roster::Roster;
use crate::session::{SessionEvent, queue_event};
use crate::shared_body::SharedBody;
use crate::transport::{
    Access, Emulation, Fingerprint, HostOptions, Invite, Limits, MeshCarrier, PeerStats, QuicMesh, Role,
    Token, TransportError,
};
use crate::user::shortened;
use mesh::ConnectedPeer;
use missed::Missed;
use play::PlayedBody;

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
    /// all its connections. Over a carrier of the app's own, only the limits are used.
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
///
/// Free bodies touch the floors, balls, boxes and capsules that stand still when the session
/// begins, which must be the same for all peers, too. They touch them there even if they move
/// later: leave those out by contact layers. Bodies of peers touch neither meshes nor each other.
#[derive(Resource)]
pub struct NetPeer {
    carrier: Box<dyn MeshCarrier>,
    config: PeerConfig,
    limits: Limits,
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
    missed: Missed,
    /// Users with whom the session has ended for good: nobody's introduction leads back to them.
    refused: BTreeSet<UserId>,
    known: KnownUsers,
    /// Who may join by a token of the application's.
    access: Access,
    /// The tokens with which other peers come back, and which they give to those that they let in.
    /// Each peer has one of its own, so that none is known to all.
    tokens: BTreeMap<Fingerprint, Token>,
    users: Roster,
    grabs: BTreeMap<Entity, OwnGrab>,
    /// Impulses of this frame that the session did not take.
    pub(crate) refused_impulses: Vec<BodyRefused>,
    scratch: Vec<f64>,
    ledger: Ledger,
}

impl NetPeer {
    /// Opens the sockets.
    pub(crate) fn open(mut config: PeerConfig) -> Result<Self, TransportError> {
        let (limits, access) = (config.transport.limits.clone(), config.transport.access.clone());
        let carrier = Box::new(QuicMesh::open(std::mem::take(&mut config.transport))?);
        Self::over(carrier, config, limits, access)
    }

    /// Plays over a carrier of the app's own, which decides itself who is admitted.
    pub(crate) fn open_over(
        carrier: Box<dyn MeshCarrier>,
        config: PeerConfig,
    ) -> Result<Self, TransportError> {
        let limits = config.transport.limits.clone();
        Self::over(carrier, config, limits, Access::Anyone)
    }

    fn over(
        carrier: Box<dyn MeshCarrier>,
        config: PeerConfig,
        limits: Limits,
        access: Access,
    ) -> Result<Self, TransportError> {
        let missed = Missed::new(config.rejoin, carrier.fingerprint());
        let peer = Self {
            carrier,
            config,
            limits,
            began: Instant::now(),
            began_at: Duration::ZERO,
            state: PeerState::Joining,
            session: None,
            step: Duration::ZERO,
            bodies: BTreeMap::new(),
            others: BTreeMap::new(),
            introduced: BTreeMap::new(),
            missed,
            refused: BTreeSet::new(),
            known: KnownUsers::default(),
            access,
            tokens: BTreeMap::new(),
            users: Roster::default(),
            grabs: BTreeMap::new(),
            refused_impulses: Vec::new(),
            scratch: Vec::new(),
            ledger: Ledger::default(),
        };
        if let Some(invite) = peer.config.join.clone() {
            peer.carrier.call(&invite)?;
        }
        Ok(peer)
    }

    /// Returns the connection state.
    pub fn state(&self) -> &PeerState {
        &self.state
    }

    /// Returns the invite with which others join through this peer.
    pub fn invite(&self) -> Invite {
        self.carrier.invite()
    }

    /// Returns the session, with more details. `None` until the models are loaded.
    pub fn session(&self) -> Option<&PeerSession> {
        self.session.as_ref()
    }

    /// Returns the number of lost peers that this peer tries to reach ([`PeerConfig::rejoin`]).
    pub fn looked_for(&self) -> usize {
        self.missed.count()
    }

    /// Returns the session's number of an entity's body.
    pub fn body_of(&self, entity: Entity) -> Option<BodyId> {
        self.bodies.iter().find(|(_, played)| played.entity == entity).map(|(&id, _)| id)
    }

    /// Whether there are links that [`set_emulation`](Self::set_emulation) changes: not over a
    /// carrier of the app's own.
    pub fn may_emulate(&self) -> bool {
        self.quic().is_some()
    }

    /// Returns the emulated link under every connection of this peer, if there is one.
    pub fn emulation(&self) -> Option<Emulation> {
        self.quic().and_then(QuicMesh::emulation)
    }

    /// Sets, replaces or removes the emulated link under every connection of this peer, at any
    /// time. Changes nothing over a carrier of the app's own.
    pub fn set_emulation(&self, emulation: Option<Emulation>) {
        if let Some(quic) = self.quic() {
            quic.set_emulation(emulation);
        }
    }

    fn quic(&self) -> Option<&QuicMesh> {
        (&*self.carrier as &dyn Any).downcast_ref()
    }

    fn now(&self) -> Duration {
        self.began.elapsed()
    }

    /// Ends all connections, without waiting for their goodbyes.
    pub(crate) fn end_connections(&self) {
        self.carrier.end();
    }

    pub(crate) fn metrics(&mut self) -> NetStats {
        let mut stats = NetStats::default();
        let line = |&peer: &PeerId| Some((peer, self.carrier.stats(peer)?));
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
            address: self.carrier.invite().to_string(),
            step: self.step.as_secs_f64(),
            repair: self.config.repair,
            idle_timeout: self.limits.idle_timeout,
            founds,
            ..PeerSessionConfig::default()
        };
        let made = PeerSession::new(config).and_then(|mut session| {
            for (&id, played) in &self.bodies {
                session.add_body(id, played.model.clone(), &played.settings)?;
                session.set_surroundings(id, played.around.clone())?;
                session.set_held_shapes(id, played.held_shapes)?;
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
            queue_event(world, SessionEvent::Joined(SessionJoined { user, reconnected: false }));
        }
    }

    /// Takes this peer's number.
    fn enter(&mut self, world: &mut World, user: UserId) {
        self.began_at = self.now();
        self.known.see(self.carrier.fingerprint(), user, |_| true);
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
        for (entity, name, wanted, state) in shared.iter(world) {
            let Some(state) = state.filter(|state| state.has_place()) else { return false };
            let settings = play::agreed_settings(state.body());
            let id = number_of(&name.name);
            if found.contains_key(&id) {
                warn_once!("{} is left out: another body has its number", name.name);
                continue;
            }
            let mut played = PlayedBody::new(entity, state.model().clone(), settings);
            played.held_shapes = wanted.held_shapes;
            found.insert(id, played);
        }
        if found.is_empty() {
            return false;
        }
        for played in found.values_mut() {
            // Who knows obstacles fills them in.
            let added = (Driven::Remote, crate::remote::RemoteHands::default(), FixedObstacles::default());
            world.entity_mut(played.entity).insert(added);
            if let Some(fixed) = world.get::<FixedObstacles>(played.entity) {
                played.around = play::agreed_surroundings(fixed);
            }
        }
        (self.step, self.bodies) = (step, found);
        true
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
