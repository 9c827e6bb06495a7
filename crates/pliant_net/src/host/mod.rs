//! The host's side in Bevy: guests' grabs become [`Grab`](pliant_body::Grab) entities, steps of [`SharedBody`](crate::SharedBody)s become frames.

mod guests;
mod hands;
mod playout;
mod publish;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bevy::prelude::*;
use bevy::tasks::Task;
use bytes::Bytes;
use pliant_modal::ModalModel;
use pliant_stream::{Channel, DisconnectReason, GrabKey, GrabState, HostSession, LinkStats, PeerId, UserId};

use crate::metrics::{Ledger, NetStats};
use crate::scene::{self, Placement};
use crate::transport::{
    Access, Emulation, Endpoint, Fingerprint, HostOptions, Invite, PeerStats, Role, SendError,
};
use crate::user::{User, Yourself};
use guests::Guest;
use publish::HostedBody;

pub(crate) use guests::receive;
pub use hands::Holding;
pub(crate) use hands::move_hands;
pub(crate) use publish::{finish, publish};

/// How to host a session.
#[derive(Debug)]
pub struct HostConfig {
    /// What the user at the host is called, at most 64 bytes; guests see it. Default: `host`.
    pub name: String,
    /// Socket, key, who may join, limits, emulated link.
    pub transport: HostOptions,
    /// The session's settings. The step is always that of `Time<Fixed>`, and who asks is let in: who may is [`HostOptions::access`].
    pub session: pliant_stream::HostConfig,
    /// Whose hands may be on a body at the same time, where the body has no [`Holding`] of its own.
    pub holding: Holding,
    /// How long at most a guest's hand is held back, s, so that its targets, which come late, unevenly and with gaps, are played one a tick: a
    /// stiff hold would turn every unevenness into force. It is a tick, one more over a distance, and twice the way's jitter. Default: 0.1.
    pub smoothing: f64,
    /// How far from a body's middle a guest's target may be, in sizes of the body; a target beyond is drawn in to that distance. Default: 4.
    pub reach: f64,
    /// Who had which number when this host ran before ([`NetHost::known`]): the same key gets the same number, and nobody else does. At most
    /// 4,096; the host's own number is nobody's. Default: none, and numbers begin at 1.
    pub known: Vec<(Fingerprint, UserId)>,
}

impl Default for HostConfig {
    fn default() -> Self {
        Self {
            name: "host".into(),
            transport: HostOptions::default(),
            session: pliant_stream::HostConfig::default(),
            holding: Holding::default(),
            smoothing: 0.1,
            reach: 4.0,
            known: Vec::new(),
        }
    }
}

/// The session that this app hosts.
#[derive(Resource)]
pub struct NetHost {
    endpoint: Endpoint,
    ended: bool,
    began: Instant,
    session: HostSession,
    holding: Holding,
    smoothing: f64,
    reach: f64,
    you: Entity,
    bodies: BTreeMap<Entity, HostedBody>,
    next_body: u16,
    /// Connections, whether they have said hello or not.
    guests: BTreeMap<PeerId, Guest>,
    /// Who has which key: somebody who comes back is who they were.
    known: BTreeMap<Fingerprint, Known>,
    numbers: BTreeMap<UserId, Entity>,
    /// The number that was given last.
    next_user: u16,
    grabs: BTreeMap<GrabKey, Entity>,
    own_grabs: BTreeMap<Entity, u16>,
    next_own_grab: u16,
    reaches_said: Duration,
    scratch: Vec<GrabState>,
    ledger: Ledger,
    /// Messages that no guest has to say.
    rejected: u64,
    /// Bodies that come, and their models' files, which are being made.
    files: BTreeMap<Entity, (Arc<ModalModel>, Task<Arc<[u8]>>)>,
}

/// Somebody who was here, or is.
#[derive(Debug, Clone, Copy)]
struct Known {
    user: UserId,
    seen: Duration,
}

impl NetHost {
    pub(crate) fn start(
        world: &mut World,
        endpoint: Endpoint,
        config: &HostConfig,
    ) -> Result<(), pliant_stream::StreamError> {
        // The key that came with a connection says which number it gets.
        let mut settings = pliant_stream::HostConfig { open: false, ..config.session };
        if let Some(fixed) = world.get_resource::<Time<Fixed>>() {
            settings.newmark.h = fixed.timestep().as_secs_f64();
        }
        let session = HostSession::new(settings)?;
        let invite = endpoint.invite();
        info!("hosting at {}:{} with key {}", invite.host, invite.port, invite.fingerprint);
        let name = scene::shortened(&config.name);
        let you = world.spawn((User::new(UserId::HOST, name, Role::Hold), Yourself)).id();
        let reach = if config.reach.is_finite() { config.reach.clamp(0.0, 1e3) } else { 4.0 };
        world.insert_resource(Self {
            endpoint,
            ended: false,
            began: Instant::now(),
            session,
            holding: config.holding,
            smoothing: config.smoothing.max(0.0),
            reach,
            you,
            bodies: BTreeMap::new(),
            next_body: 1,
            guests: BTreeMap::new(),
            known: guests::known_before(&config.known),
            next_user: 0,
            numbers: BTreeMap::from([(UserId::HOST, you)]),
            grabs: BTreeMap::new(),
            own_grabs: BTreeMap::new(),
            next_own_grab: 0,
            reaches_said: Duration::ZERO,
            scratch: Vec::new(),
            ledger: Ledger::default(),
            rejected: 0,
            files: BTreeMap::new(),
        });
        Ok(())
    }

    /// What guests paste to join, with the first token if there are any.
    pub fn invite(&self) -> Invite {
        self.endpoint.invite()
    }

    /// Changes who may join from now on; who is in stays in, and in the same role.
    pub fn set_access(&self, access: Access) {
        self.endpoint.set_access(access);
    }

    /// Ends the session: everybody is told and sent away, and nobody is let in any more. Bodies go on here.
    pub fn end(&mut self) {
        self.ended = true;
        self.endpoint.set_access(Access::Tokens(Vec::new()));
        let peers: Vec<PeerId> = self.guests.keys().copied().collect();
        for peer in peers {
            self.session.kick(peer, DisconnectReason::Left);
        }
        self.flush();
    }

    /// Whether [`end`](Self::end) was called.
    pub fn has_ended(&self) -> bool {
        self.ended
    }

    /// The emulated link under the session, if there is one.
    pub fn emulation(&self) -> Option<Emulation> {
        self.endpoint.emulation()
    }

    /// Puts an emulated link under the session, another one, or none, at any time.
    pub fn set_emulation(&self, emulation: Option<Emulation>) {
        self.endpoint.set_emulation(emulation);
    }

    /// The transport below.
    pub fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// The session, for those who want to know more.
    pub fn session(&self) -> &HostSession {
        &self.session
    }

    /// The entities of the guests that are in.
    pub fn guests(&self) -> impl Iterator<Item = Entity> + '_ {
        self.guests.values().filter_map(|guest| guest.entity)
    }

    /// The key of a guest: its lasting name. `None` for an entity that is no guest.
    pub fn key_of(&self, guest: Entity) -> Option<Fingerprint> {
        self.guests.values().find(|one| one.entity == Some(guest)).map(|one| one.key)
    }

    /// Who has, or had, which number, by key. Kept in a file and given to the next run ([`HostConfig::known`]), guests are who they were also after
    /// the host was started anew; without that a number is as good as the run of its host, and only the key says who somebody is.
    pub fn known(&self) -> impl Iterator<Item = (Fingerprint, UserId)> + '_ {
        self.known.iter().map(|(&key, known)| (key, known.user))
    }

    /// Sends a guest away. False for an entity that is no guest.
    pub fn kick(&mut self, guest: Entity) -> bool {
        let found = self.guests.iter().find(|(_, one)| one.entity == Some(guest));
        let Some(peer) = found.map(|(&peer, _)| peer) else { return false };
        self.session.kick(peer, DisconnectReason::Refused);
        true
    }

    fn now(&self) -> Duration {
        self.began.elapsed()
    }

    fn flush(&mut self) {
        let now = self.now();
        // A model is handed over no faster than the line takes it.
        let fetching: Vec<PeerId> = self.session.fetching().collect();
        for peer in fetching {
            self.session.set_unsent(peer, self.endpoint.unsent(peer));
        }
        self.session.update(now);
        while let Some(output) = self.session.poll_output() {
            match output.channel {
                // A datagram that is not taken is a datagram lost: counted by the transport, repaired by the session.
                Channel::Datagram => {
                    let _ = self.endpoint.send_datagram(output.peer, Bytes::from_owner(output.bytes));
                }
                Channel::Message => self.send_message(output.peer, scene::session_message(&output.bytes)),
            }
        }
    }

    /// A guest that does not read its messages is sent away: without them it cannot follow.
    fn send_message(&mut self, peer: PeerId, message: Bytes) {
        if let Err(error @ SendError::QueueFull { .. }) = self.endpoint.send_message(peer, message) {
            debug!("guest {peer} is sent away: {error}");
            self.session.disconnect(peer, DisconnectReason::Lost);
            self.endpoint.close(peer, DisconnectReason::Lost, "messages are not read");
        }
    }

    /// Tells all guests that are in.
    fn tell_all(&mut self, message: &Bytes) {
        let inside: Vec<PeerId> =
            self.guests.iter().filter(|(_, guest)| guest.entity.is_some()).map(|(&peer, _)| peer).collect();
        for peer in inside {
            self.send_message(peer, message.clone());
        }
    }

    /// Tells guests where a body is: all of them, or one that has come.
    fn tell_place(&mut self, placement: Placement, to: Option<PeerId>) {
        match to {
            None => self.tell_all(&placement.to_message()),
            Some(peer) => self.send_message(peer, placement.to_message()),
        }
    }

    fn link(&self, peer: PeerId) -> Option<(LinkStats, PeerStats)> {
        let (mut link, transport) = (self.session.stats(peer)?, self.endpoint.stats(peer)?);
        // The session measures the round trip on the guest's side; QUIC does on both.
        if link.round_trip.is_zero() {
            link.round_trip = transport.round_trip;
        }
        Some((link, transport))
    }

    pub(crate) fn metrics(&mut self) -> NetStats {
        let mut sum = NetStats::default();
        let inside = self.guests.iter().filter(|(_, guest)| guest.entity.is_some());
        for (link, transport) in inside.filter_map(|(&peer, _)| self.link(peer)) {
            sum.add(&link, &transport);
        }
        let open = self.guests.keys().filter_map(|&peer| Some((peer, self.endpoint.stats(peer)?)));
        let mut totals = self.session.totals();
        totals.rejected += self.rejected;
        sum.count(&totals, &self.ledger.sum(open));
        sum
    }
}
