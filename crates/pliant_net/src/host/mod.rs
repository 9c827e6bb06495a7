//! The host's side in Bevy: guests' grabs become [`Grab`](pliant_body::Grab) entities, and steps of
//! [`SharedBody`](crate::SharedBody)s become frames.

mod guests;
mod hands;
mod publish;
mod rigids;
mod surroundings;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use bevy::platform::time::Instant;
use bevy::prelude::*;
use bevy::tasks::Task;
use bytes::Bytes;
use pliant_modal::ModalModel;
use pliant_stream::{Channel, DisconnectReason, GrabKey, GrabState, HostSession, LinkStats, PeerId, UserId};

use crate::known_users::KnownUsers;
use crate::metrics::{Ledger, NetStats};
use crate::roster::Roster;
use crate::session::{SessionEvent, queue_event};
use crate::transport::{
    Access, Carrier, Emulation, Endpoint, Fingerprint, HostOptions, Invite, PeerStats, Role, SendError, quic,
};
use crate::user::shortened;
use guests::Guest;
use publish::HostedBody;

pub(crate) use guests::receive;
pub use hands::Holding;
pub(crate) use hands::move_hands;
pub(crate) use publish::{finish, publish};
pub(crate) use rigids::publish_rigids;

/// How to host a session.
#[derive(Debug)]
pub struct HostConfig {
    /// Name of the user at the host, at most 64 bytes. Guests see it. Default: `host`.
    pub name: String,
    /// Socket, key, who may join, limits, emulated link. Not used over a carrier of the app's own.
    pub transport: HostOptions,
    /// The session's settings. The step is always that of `Time<Fixed>`. [`HostOptions::access`]
    /// determines who may join.
    pub session: pliant_stream::HostSessionConfig,
    /// Whose hands may be on a body at the same time, for bodies without their own [`Holding`].
    pub holding: Holding,
    /// Longest playout delay of a guest's hand, s. Default: 0.1.
    ///
    /// A guest's targets arrive late, unevenly and with gaps. The host delays them to play one per
    /// tick, because a stiff grab would turn every unevenness into force. The delay is one tick,
    /// one more tick if the round trip is longer than a tick, and twice the link's jitter.
    pub smoothing: f64,
    /// Largest distance of a guest's target from a body's center, in sizes of the body. A target
    /// beyond is moved in to that distance. Default: 4.
    pub reach: f64,
    /// User numbers by key from an earlier run of this host ([`NetHost::known`]), in the order in
    /// which the users were last seen. The same key gets the same number again, and no other key
    /// gets it. The last 4,096 entries are used, and the host's own number is ignored. Default:
    /// none, and numbers begin at 1.
    pub known: Vec<(Fingerprint, UserId)>,
}

impl Default for HostConfig {
    fn default() -> Self {
        Self {
            name: "host".into(),
            transport: HostOptions::default(),
            session: pliant_stream::HostSessionConfig::default(),
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
    carrier: Box<dyn Carrier>,
    began: Instant,
    session: HostSession,
    holding: Holding,
    smoothing: f64,
    reach: f64,
    bodies: BTreeMap<Entity, HostedBody>,
    rigids: rigids::HostedRigids,
    next_body: u16,
    /// Open connections, with or without a completed join.
    guests: BTreeMap<PeerId, Guest>,
    known: KnownUsers,
    users: Roster,
    grabs: BTreeMap<GrabKey, Entity>,
    own_grabs: BTreeMap<Entity, u16>,
    next_own_grab: u16,
    links_sent: Duration,
    scratch: Vec<GrabState>,
    ledger: Ledger,
    /// New bodies, with their models and the tasks that encode the models' files.
    files: BTreeMap<Entity, (Arc<ModalModel>, Task<Arc<[u8]>>)>,
    #[cfg(feature = "watch")]
    watch: Option<crate::watch::HostWatch>,
}

impl NetHost {
    pub(crate) fn start(
        world: &mut World,
        carrier: Box<dyn Carrier>,
        config: &HostConfig,
    ) -> Result<(), pliant_stream::StreamError> {
        // The host app admits each guest itself, because the key of the connection determines the
        // user number.
        let mut settings = pliant_stream::HostSessionConfig { open: false, ..config.session };
        if let Some(fixed) = world.get_resource::<Time<Fixed>>() {
            settings.newmark.h = fixed.timestep().as_secs_f64();
        }
        let mut session = HostSession::new(settings)?;
        match quic(&*carrier).map(Endpoint::invite) {
            Some(invite) => {
                info!("hosting at {}:{} with key {}", invite.host, invite.port, invite.fingerprint);
            }
            None => info!("hosting over the app's own carrier"),
        }
        let name = shortened(&config.name);
        session.set_host_user(name)?;
        let mut users = Roster::default();
        users.meet_yourself(world, UserId::HOST, name, Role::Hold);
        let reach = if config.reach.is_finite() { config.reach.clamp(0.0, 1e3) } else { 4.0 };
        world.insert_resource(Self {
            carrier,
            began: Instant::now(),
            session,
            holding: config.holding,
            smoothing: config.smoothing.max(0.0),
            reach,
            bodies: BTreeMap::new(),
            rigids: rigids::HostedRigids::default(),
            next_body: 1,
            guests: BTreeMap::new(),
            known: KnownUsers::restored(&config.known),
            users,
            grabs: BTreeMap::new(),
            own_grabs: BTreeMap::new(),
            next_own_grab: 0,
            links_sent: Duration::ZERO,
            scratch: Vec::new(),
            ledger: Ledger::default(),
            files: BTreeMap::new(),
            #[cfg(feature = "watch")]
            watch: None,
        });
        Ok(())
    }

    /// Returns the invite for guests, with the first token if there is one. `None` over a carrier
    /// of the app's own, which knows itself how to join.
    pub fn invite(&self) -> Option<Invite> {
        self.endpoint().map(Endpoint::invite)
    }

    /// Changes who may join from this call on. Connected guests stay connected and keep their
    /// roles. Changes nothing over a carrier of the app's own.
    pub fn set_access(&self, access: Access) {
        if let Some(endpoint) = self.endpoint() {
            endpoint.set_access(access);
        }
    }

    /// Ends the session as the app has asked. All guests receive a goodbye and are disconnected,
    /// the host admits no more guests, and its port is free. The bodies go on in this app.
    pub(crate) fn end(&mut self, world: &mut World) {
        info!("the session is over");
        let peers: Vec<PeerId> = self.guests.keys().copied().collect();
        for peer in peers {
            self.session.kick(peer, DisconnectReason::Left);
            self.take_events(world);
        }
        self.flush();
        self.carrier.end();
        self.users.clear(world);
        queue_event(world, SessionEvent::over(true, DisconnectReason::Left));
    }

    /// Whether there is a link that [`set_emulation`](Self::set_emulation) changes: not over a
    /// carrier of the app's own.
    pub fn may_emulate(&self) -> bool {
        self.endpoint().is_some()
    }

    /// Returns the emulated link under the session, if there is one.
    pub fn emulation(&self) -> Option<Emulation> {
        self.endpoint().and_then(Endpoint::emulation)
    }

    /// Sets, replaces or removes the emulated link under the session, at any time. Changes nothing
    /// over a carrier of the app's own.
    pub fn set_emulation(&self, emulation: Option<Emulation>) {
        if let Some(endpoint) = self.endpoint() {
            endpoint.set_emulation(emulation);
        }
    }

    /// Returns the QUIC endpoint. `None` over a carrier of the app's own.
    pub fn endpoint(&self) -> Option<&Endpoint> {
        quic(&*self.carrier)
    }

    /// Returns the session, with more details.
    pub fn session(&self) -> &HostSession {
        &self.session
    }

    /// Returns the entities of the guests in the session.
    pub fn guests(&self) -> impl Iterator<Item = Entity> + '_ {
        self.guests.values().filter_map(|guest| guest.entity)
    }

    /// Returns the key of a guest, which identifies the guest permanently. `None` for an entity
    /// that is not a guest.
    pub fn key_of(&self, guest: Entity) -> Option<Fingerprint> {
        self.guests.values().find(|one| one.entity == Some(guest)).map(|one| one.key)
    }

    /// Returns the present and earlier users' numbers by key, in the order in which the users were
    /// last seen. An app can keep them in a file and
    /// give them to the next run ([`HostConfig::known`]), so that guests keep their numbers after a
    /// restart of the host. Otherwise a number is only valid during one run of the host, and only
    /// the key identifies a user.
    pub fn known(&self) -> impl Iterator<Item = (Fingerprint, UserId)> + '_ {
        self.known.in_order().into_iter()
    }

    /// Publishes the session to watchers without number, at a relay ([`watch`](crate::watch)), in
    /// place of where it was published before. The relay is connected in the background, again and
    /// again if it is lost, and no tick waits for it.
    ///
    /// # Errors
    /// [`WatchError`](crate::watch::WatchError) for settings outside their ranges, an address that
    /// is no relay's, or where no thread can be started.
    #[cfg(feature = "watch")]
    pub fn publish_to_watchers(
        &mut self,
        options: crate::watch::PublishOptions,
    ) -> Result<(), crate::watch::WatchError> {
        let step = self.session.config().newmark.h;
        self.watch = Some(crate::watch::HostWatch::start(options, step)?);
        Ok(())
    }

    /// Publishes to watchers no longer. For them the session is over.
    #[cfg(feature = "watch")]
    pub fn stop_publishing(&mut self) {
        self.watch = None;
    }

    /// How and where the session is published to watchers. `None` if it is not.
    #[cfg(feature = "watch")]
    pub fn published(&self) -> Option<(&crate::watch::PublishOptions, crate::watch::PublishStats)> {
        self.watch.as_ref().map(|watch| (watch.options(), watch.stats()))
    }

    /// Kicks a guest. Returns false for an entity that is not a guest.
    pub fn kick(&mut self, guest: Entity) -> bool {
        let found = self.guests.iter().find(|(_, one)| one.entity == Some(guest));
        let Some(peer) = found.map(|(&peer, _)| peer) else { return false };
        self.session.kick(peer, DisconnectReason::Kicked);
        true
    }

    fn now(&self) -> Duration {
        self.began.elapsed()
    }

    fn flush(&mut self) {
        let now = self.now();
        // A model is handed over no faster than the connection sends it.
        let fetching: Vec<PeerId> = self.session.fetching().collect();
        for peer in fetching {
            self.session.set_unsent(peer, self.carrier.unsent(peer));
        }
        self.session.update(now);
        while let Some(output) = self.session.poll_output() {
            match output.channel {
                // The transport counts a dropped datagram, and the session repairs the loss.
                Channel::Datagram => {
                    let _ = self.carrier.send_datagram(output.peer, Bytes::from_owner(output.bytes));
                }
                Channel::Message => self.send_message(output.peer, Bytes::from_owner(output.bytes)),
            }
        }
    }

    /// Sends a message to a guest. A guest that does not read its messages is disconnected, because
    /// it cannot stay in the session without them.
    fn send_message(&mut self, peer: PeerId, message: Bytes) {
        if let Err(error @ SendError::QueueFull { .. }) = self.carrier.send_message(peer, message) {
            debug!("guest {peer} is sent away: {error}");
            self.session.disconnect(peer, DisconnectReason::Unread);
            self.carrier.close(peer, DisconnectReason::Unread);
        }
    }

    fn link(&self, peer: PeerId) -> Option<(LinkStats, PeerStats)> {
        let (mut link, transport) = (self.session.stats(peer)?, self.carrier.stats(peer)?);
        // The session measures the round trip on the guest's side only. QUIC measures it on both
        // sides.
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
        let open = self.guests.keys().filter_map(|&peer| Some((peer, self.carrier.stats(peer)?)));
        sum.count(&self.session.totals(), &self.ledger.sum(open));
        sum
    }
}
