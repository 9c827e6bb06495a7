//! The host's side in Bevy: guests' grabs become [`Grab`] entities, steps of [`SharedBody`]s become frames.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bevy::math::DVec3;
use bevy::prelude::*;
use bytes::Bytes;
use pliant_body::{BodyState, Driven, Grab, GrabForce, GrabOf, Grabs, PliantTick};
use pliant_modal::{GrabConfig, ModalModel};
use pliant_stream::{
    BodyId, BodySetup, Channel, EndReason, GrabKey, GrabState, HostEvent, HostSession, LinkStats, PeerId,
    Pose, TickState, UserId,
};

use crate::figures::NetStats;
use crate::place::Place;
use crate::scene::{self, Placement, Reliable, SharedBody};
use crate::transport::{Endpoint, Event, HostOptions, Invite, PeerStats, SendError};
use crate::user::{HandOf, User, UserJoined, UserLeft, UserLink, Yourself};

/// Whose hands may be on a body at the same time.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
pub enum Holding {
    /// Anybody's: the paper's cooperative mode. Default.
    #[default]
    Together,
    /// One user's at a time; another's grab is refused until the first lets go: the paper's collaborative mode.
    OneAtATime,
}

/// How to host a session.
#[derive(Debug)]
pub struct HostConfig {
    /// What the user at the host is called, at most 64 bytes. Default: `host`.
    pub name: String,
    /// Socket, key, who may join, limits, emulated link.
    pub transport: HostOptions,
    /// The session's settings. The step is always that of `Time<Fixed>`.
    pub session: pliant_stream::HostConfig,
    /// Whose hands may be on a body at the same time.
    pub holding: Holding,
    /// How far at most a guest's hand is kept behind its targets, s, to move smoothly between them: they come late, unevenly and with gaps,
    /// and a stiff hold would turn that into force. It is half the guest's round trip, at least a step and at most this. Zero: not at all.
    /// Default: 0.1.
    pub smoothing: f64,
    /// How far from a body's middle a guest's target may be, in sizes of the body; a target beyond is drawn in to that distance. Default: 4.
    pub reach: f64,
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
        }
    }
}

/// The session that this app hosts.
#[derive(Resource)]
pub struct NetHost {
    endpoint: Endpoint,
    invite: Invite,
    began: Instant,
    session: HostSession,
    holding: Holding,
    smoothing: f64,
    reach: f64,
    bodies: BTreeMap<Entity, HostedBody>,
    next_body: u16,
    users: BTreeMap<PeerId, Entity>,
    numbers: BTreeMap<UserId, Entity>,
    grabs: BTreeMap<GrabKey, Entity>,
    own_grabs: BTreeMap<Entity, u16>,
    next_own_grab: u16,
    scratch: Vec<GrabState>,
}

struct HostedBody {
    id: BodyId,
    model: Arc<ModalModel>,
    setup: BodySetup,
    placed: GlobalTransform,
    /// A refusal to publish was logged; once is enough.
    faulted: bool,
}

/// A guest's grab on the host.
#[derive(Component, Debug, Clone, Copy)]
pub(crate) struct GuestGrab {
    key: GrabKey,
    /// Where the guest has its hand, as last heard; m, world.
    heard: DVec3,
    /// Of the hand here, m/s.
    velocity: DVec3,
}

impl NetHost {
    pub(crate) fn start(
        world: &mut World,
        endpoint: Endpoint,
        config: &HostConfig,
    ) -> Result<(), pliant_stream::StreamError> {
        let mut settings = config.session;
        if let Some(fixed) = world.get_resource::<Time<Fixed>>() {
            settings.newmark.h = fixed.timestep().as_secs_f64();
        }
        let session = HostSession::new(settings)?;
        let invite = endpoint.invite();
        info!("hosting at {}:{} with key {}", invite.host, invite.port, invite.fingerprint);
        let you = world.spawn((User::new(UserId::HOST, &config.name), Yourself)).id();
        let reach = if config.reach.is_finite() { config.reach.clamp(0.0, 1e3) } else { 4.0 };
        world.insert_resource(Self {
            endpoint,
            invite,
            began: Instant::now(),
            session,
            holding: config.holding,
            smoothing: config.smoothing.max(0.0),
            reach,
            bodies: BTreeMap::new(),
            next_body: 1,
            users: BTreeMap::new(),
            numbers: BTreeMap::from([(UserId::HOST, you)]),
            grabs: BTreeMap::new(),
            own_grabs: BTreeMap::new(),
            next_own_grab: 0,
            scratch: Vec::new(),
        });
        Ok(())
    }

    /// What guests paste to join, token included.
    pub fn invite(&self) -> &Invite {
        &self.invite
    }

    /// The entities of the guests that are in.
    pub fn guests(&self) -> impl Iterator<Item = Entity> + '_ {
        self.users.values().copied()
    }

    /// Sends a guest away. False for an entity that is no guest.
    pub fn expel(&mut self, guest: Entity) -> bool {
        let Some(peer) = self.users.iter().find(|(_, user)| **user == guest).map(|(&peer, _)| peer) else {
            return false;
        };
        self.session.expel(peer, EndReason::Refused);
        true
    }

    fn now(&self) -> Duration {
        self.began.elapsed()
    }

    fn flush(&mut self) {
        let now = self.now();
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
            self.session.disconnect(peer, EndReason::Lost);
            self.endpoint.close(peer, "messages are not read");
        }
    }

    /// Tells guests where a body is: all of them, or one that has come.
    fn tell_place(&mut self, placement: Placement, to: Option<PeerId>) {
        let guests: Vec<PeerId> = to.map_or_else(|| self.users.keys().copied().collect(), |peer| vec![peer]);
        for peer in guests {
            self.send_message(peer, placement.to_message());
        }
    }
}

/// `PreUpdate`: what came from the guests.
pub(crate) fn receive(world: &mut World) {
    world.try_resource_scope(|world, mut host: Mut<NetHost>| {
        let host = &mut *host;
        while let Some(event) = host.endpoint.poll() {
            let now = host.now();
            match event {
                Event::Connected { peer, address, fingerprint } => {
                    debug!("guest {peer} from {address} with key {fingerprint}");
                    let most = host.endpoint.max_datagram_size(peer).unwrap_or(0);
                    if let Err(error) = host.session.connect(now, peer, most) {
                        host.endpoint.close(peer, &error.to_string());
                    }
                }
                Event::Datagram { peer, at, bytes } => {
                    let at = at.saturating_duration_since(host.began);
                    host.session.on_datagram(at, peer, &bytes);
                }
                Event::Message { peer, bytes } => match scene::read(&bytes) {
                    Some(Reliable::Session(bytes)) => host.session.on_message(now, peer, bytes),
                    // A guest places nothing.
                    Some(Reliable::Placement(_)) | None => host.session.expel(peer, EndReason::Protocol),
                },
                Event::Closed { peer, reason } => {
                    debug!("guest {peer} is gone: {reason}");
                    host.session.disconnect(peer, crate::end_of(&reason));
                }
            }
        }
        for peer in host.endpoint.peers() {
            if let Some(most) = host.endpoint.max_datagram_size(peer) {
                host.session.set_max_datagram(peer, most);
            }
        }
        while let Some(event) = host.session.poll_event() {
            host.apply(world, event);
        }
    });
}

impl NetHost {
    fn apply(&mut self, world: &mut World, event: HostEvent) {
        match event {
            HostEvent::Joined { peer, user, name, .. } => {
                let user = User::new(user, &name);
                let (id, name) = (user.id, user.name.clone());
                info!("{name} has joined");
                let entity = world.spawn((user, UserLink::default())).id();
                self.users.insert(peer, entity);
                self.numbers.insert(id, entity);
                world.write_message(UserJoined { entity, id, name });
                let places: Vec<_> = self.bodies.values().map(|b| Placement::new(b.id, &b.placed)).collect();
                for placement in places {
                    self.tell_place(placement, Some(peer));
                }
            }
            HostEvent::Left { peer, user, reason } => {
                self.endpoint.close(peer, &reason.to_string());
                let entity = self.users.remove(&peer);
                if let (Some(entity), Some(id)) = (entity, user) {
                    self.numbers.remove(&id);
                    let name = world.get::<User>(entity).map(|user| user.name.clone()).unwrap_or_default();
                    info!("{name} is gone: {reason}");
                    world.despawn(entity);
                    world.write_message(UserLeft { id, name, reason: reason.to_string() });
                }
            }
            HostEvent::GrabBegan { key, body, vertex, radius, target, hold } => {
                if let Err(why) = self.begin_grab(world, key, body, vertex, radius, target, hold) {
                    debug!("grab {} of user {} is refused: {why}", key.grab, key.user.0);
                    self.session.refuse_grab(key);
                }
            }
            HostEvent::GrabMoved { key, body, target, .. } => {
                let Some(target) = self.target_in_world(world, body, target) else { return };
                let hand = self.grabs.get(&key).and_then(|&entity| world.get_mut::<GuestGrab>(entity));
                if let Some(mut hand) = hand {
                    hand.heard = target;
                }
            }
            HostEvent::GrabEnded { key, .. } => {
                if let Some(entity) = self.grabs.remove(&key) {
                    // It may have gone with its body or its user.
                    world.try_despawn(entity).ok();
                }
            }
            // The session is open: nobody knocks. The transport's token has been asked for before.
            _ => {}
        }
    }

    fn entity_of(&self, body: BodyId) -> Option<Entity> {
        self.bodies.iter().find(|(_, hosted)| hosted.id == body).map(|(&entity, _)| entity)
    }

    /// A guest's target in this app's world, within reach of the body.
    fn target_in_world(&self, world: &World, body: BodyId, target: [f64; 3]) -> Option<DVec3> {
        let entity = self.entity_of(body)?;
        let state = world.get::<BodyState>(entity)?;
        let place = Place::of_body(world.get::<GlobalTransform>(entity)?, state)?;
        let model = state.model();
        let middle = if model.is_free() {
            DVec3::from(state.body().frame().center())
        } else {
            let [low, high] = model.surface().bounds();
            (Vec3::from(low).as_dvec3() + Vec3::from(high).as_dvec3()) / 2.0
        };
        let away = (DVec3::from(target) - middle).clamp_length_max(self.reach * model.size());
        away.is_finite().then(|| place.point_to_world((middle + away).into()))
    }

    fn begin_grab(
        &mut self,
        world: &mut World,
        key: GrabKey,
        body: BodyId,
        vertex: u32,
        radius: f64,
        target: [f64; 3],
        hold: GrabConfig,
    ) -> Result<(), &'static str> {
        let entity = self.entity_of(body).ok_or("no such body")?;
        let user = *self.numbers.get(&key.user).ok_or("no such user")?;
        let target = self.target_in_world(world, body, target).ok_or("no place for its target")?;
        let model = world.get::<BodyState>(entity).ok_or("the body is not ready")?.model().clone();
        if !(0.0..=model.size()).contains(&radius) {
            return Err("its radius is larger than the body");
        }
        if self.holding == Holding::OneAtATime {
            let held: Vec<Entity> =
                world.get::<Grabs>(entity).map(|g| g.iter().collect()).unwrap_or_default();
            if held.iter().any(|&other| world.get::<HandOf>(other).is_none_or(|hand| hand.0 != user)) {
                return Err("somebody else holds the body");
            }
        }
        let GrabConfig { stiffness, relaxation } = hold;
        let grab = Grab { stiffness, relaxation, ..Grab::new(vertex, radius, target) };
        let spawned = world
            .spawn((
                grab,
                GrabOf(entity),
                HandOf(user),
                GuestGrab { key, heard: target, velocity: DVec3::ZERO },
            ))
            .id();
        self.grabs.insert(key, spawned);
        Ok(())
    }
}

/// Before the bodies' step: guests' hands move on towards where they were last heard to be, without a jump in position or velocity.
pub(crate) fn move_hands(
    host: Option<Res<NetHost>>,
    time: Res<Time>,
    mut grabs: Query<(&mut Grab, &mut GuestGrab, &HandOf)>,
    links: Query<&UserLink>,
) {
    let Some(host) = host else { return };
    let step = time.delta_secs_f64();
    for (mut grab, mut guest, user) in &mut grabs {
        let round_trip = links.get(user.0).map_or(0.0, |link| link.round_trip.as_secs_f64());
        let smoothing = (0.5 * round_trip).max(step).min(host.smoothing);
        let target = guest.follow(grab.target, step, smoothing);
        if target != grab.target {
            grab.target = target;
        }
    }
}

impl GuestGrab {
    /// One step of a critically damped follower, `x" = w^2 (heard - x) - 2 w x'` with `w = 2 / smoothing`, in closed form: it lags behind a
    /// steady motion by `smoothing`, and never overshoots a standing target from rest.
    fn follow(&mut self, at: DVec3, step: f64, smoothing: f64) -> DVec3 {
        if smoothing <= 0.0 {
            self.velocity = DVec3::ZERO;
            return self.heard;
        }
        let w = 2.0 / smoothing;
        let off = at - self.heard;
        let slope = self.velocity + off * w;
        let decay = (-w * step).exp();
        self.velocity = (self.velocity - slope * (w * step)) * decay;
        self.heard + (off + slope * step) * decay
    }
}

type SharedBodies<'w, 's> = Query<
    'w,
    's,
    (
        Entity,
        &'static SharedBody,
        &'static BodyState,
        &'static Driven,
        &'static GlobalTransform,
        Option<&'static Grabs>,
    ),
>;

/// After the bodies' step: new bodies are announced, gone ones taken out, and the step of each is sent.
pub(crate) fn publish(
    host: Option<ResMut<NetHost>>,
    tick: Res<PliantTick>,
    bodies: SharedBodies,
    grabs: Query<(&Grab, &GrabForce, Option<&GuestGrab>)>,
) {
    let Some(mut host) = host else { return };
    let host = &mut *host;
    let now = host.now();
    let present =
        |entity: &Entity| bodies.get(*entity).is_ok_and(|(.., driven, _, _)| *driven == Driven::Local);
    let gone: Vec<Entity> = host.bodies.keys().copied().filter(|entity| !present(entity)).collect();
    for entity in gone {
        if let Some(body) = host.bodies.remove(&entity) {
            host.session.remove_body(body.id);
        }
    }
    let mut held = BTreeSet::new();
    for (entity, shared, state, driven, transform, list) in &bodies {
        if *driven == Driven::Remote {
            continue;
        }
        let Some(place) = Place::of_body(transform, state) else { continue };
        let Some(id) = host.announced(entity, shared, state, transform) else { continue };
        let mut streamed = std::mem::take(&mut host.scratch);
        streamed.clear();
        for grab_entity in list.into_iter().flat_map(|list| list.iter()) {
            let Ok((grab, force, guest)) = grabs.get(grab_entity) else { continue };
            let key = guest.map_or_else(|| host.own_key(grab_entity), |guest| guest.key);
            held.insert(grab_entity);
            let grab = GrabState {
                key,
                vertex: grab.vertex,
                radius: grab.radius,
                target: place.point_to_session(grab.target),
                reaction: place.force_to_session(force.force),
            };
            if grab.is_valid() && streamed.len() < pliant_stream::MAX_GRABS {
                streamed.push(grab);
            }
        }
        let body = state.body();
        let pose = body.model().is_free().then(|| Pose::of(body));
        let step = TickState {
            tick: tick.0,
            q: body.q(),
            v: body.v(),
            a: body.a(),
            z: body.z(),
            pose,
            grabs: &streamed,
            resting: state.is_resting(),
        };
        let published = host.session.publish(now, id, &step);
        host.scratch = streamed;
        if let Some(hosted) = host.bodies.get_mut(&entity) {
            match published {
                Ok(()) => hosted.faulted = false,
                Err(error) if !hosted.faulted => {
                    warn!("a step of {} was not sent: {error}", shared.name);
                    hosted.faulted = true;
                }
                Err(_) => {}
            }
        }
    }
    host.own_grabs.retain(|entity, _| held.contains(entity));
    host.flush();
}

impl NetHost {
    /// The body's number in the session; it is announced, or announced anew with another model or other settings, when there is need.
    fn announced(
        &mut self,
        entity: Entity,
        shared: &SharedBody,
        state: &BodyState,
        transform: &GlobalTransform,
    ) -> Option<BodyId> {
        let config = state.body().config();
        let setup = BodySetup {
            integrator: config.integrator,
            warp: config.warp,
            damping_scale: config.damping_scale,
            // An anchored body's weight turns with its entity: the stream learns it.
            gravity: if state.model().is_free() { config.gravity } else { [0.0; 3] },
            relaxation: config.relaxation,
        };
        let model = state.model();
        if let Some(hosted) = self.bodies.get_mut(&entity) {
            if Arc::ptr_eq(&hosted.model, model) && hosted.setup == setup {
                let id = hosted.id;
                // A free body's place is in its frames.
                if hosted.placed != *transform && !model.is_free() {
                    hosted.placed = *transform;
                    self.tell_place(Placement::new(id, transform), None);
                }
                return Some(id);
            }
            self.session.remove_body(hosted.id);
            self.bodies.remove(&entity);
        }
        // Numbers go round; one that is in use is refused, and the next tick tries the next.
        let id = BodyId(self.next_body);
        self.next_body = self.next_body.wrapping_add(1);
        match self.session.add_body(id, &shared.name, Arc::clone(model), setup) {
            Ok(()) => {
                let model = Arc::clone(model);
                self.bodies
                    .insert(entity, HostedBody { id, model, setup, placed: *transform, faulted: false });
                self.tell_place(Placement::new(id, transform), None);
                Some(id)
            }
            Err(error) => {
                warn_once!("a body is not shared: {error}");
                None
            }
        }
    }

    /// The session's name for a grab made at the host.
    fn own_key(&mut self, entity: Entity) -> GrabKey {
        let next = &mut self.next_own_grab;
        let grab = *self.own_grabs.entry(entity).or_insert_with(|| {
            *next = next.wrapping_add(1);
            *next
        });
        GrabKey { user: UserId::HOST, grab }
    }
}

/// The end of a frame: what is due is sent, and how each guest is reached is written.
pub(crate) fn finish(host: Option<ResMut<NetHost>>, mut links: Query<&mut UserLink>) {
    let Some(mut host) = host else { return };
    host.flush();
    for (&peer, &entity) in &host.users {
        let Some((link, _)) = host.link(peer) else { continue };
        if let Ok(mut shown) = links.get_mut(entity) {
            let new =
                UserLink { round_trip: link.round_trip, loss_in: link.loss_in, loss_out: link.loss_out };
            shown.set_if_neq(new);
        }
    }
}

impl NetHost {
    fn link(&self, peer: PeerId) -> Option<(LinkStats, PeerStats)> {
        let (mut link, transport) = (self.session.stats(peer)?, self.endpoint.stats(peer)?);
        // The session measures the round trip on the guest's side; QUIC does on both.
        if link.round_trip.is_zero() {
            link.round_trip = transport.round_trip;
        }
        Some((link, transport))
    }

    pub(crate) fn figures(&self) -> NetStats {
        let mut sum = NetStats::default();
        for (link, transport) in self.users.keys().filter_map(|&peer| self.link(peer)) {
            sum.add(&link, &transport);
        }
        sum
    }
}
