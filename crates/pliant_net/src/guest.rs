//! A guest's side in Bevy: bodies arrive and follow the host's, own hands are sent, what they feel is written.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use bevy::math::{DQuat, DVec3};
use bevy::prelude::*;
use bytes::Bytes;
use pliant_body::{BodyState, Driven, Grab, GrabForce, GrabOf, ModalAsset, ModalBody, ShownState};
use pliant_modal::{GrabConfig, ModalModel};
use pliant_stream::{
    BodyId, BodyView, Channel, GrabKey, GuestEvent, GuestSession, PeerId, Pose, RecoveryConfig, StreamError,
    UserId,
};

use crate::felt::PatchPoint;
use crate::figures::NetStats;
use crate::phase::Phase;
use crate::place::Place;
use crate::scene::{self, Placement, Reliable, SharedBody};
use crate::seen::{BodyArrived, BodyLeft, GrabRefused, RemoteBody, SeenHand, SeenHands, SessionClosed};
use crate::transport::{Endpoint, Event, JoinOptions};
use crate::user::{User, UserJoined, UserLeft, UserLink, Yourself};

/// How to join a session.
#[derive(Debug)]
pub struct JoinConfig {
    /// What this user is called, at most 64 bytes. Default: `guest`.
    pub name: String,
    /// Key, limits, emulated link.
    pub transport: JoinOptions,
    /// How loss is repaired. Default: [`RecoveryConfig::default`].
    pub recovery: RecoveryConfig,
    /// Take at most so many modes of each body: for weak machines and thin links. Default: all.
    pub modes: Option<u16>,
    /// Models that need not be sent, beside those that are in `Assets<ModalAsset>` when the connection opens. Default: none.
    pub models: Vec<Arc<ModalModel>>,
}

impl Default for JoinConfig {
    fn default() -> Self {
        Self {
            name: "guest".into(),
            transport: JoinOptions::default(),
            recovery: RecoveryConfig::default(),
            modes: None,
            models: Vec::new(),
        }
    }
}

/// Where a guest stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GuestState {
    /// The host has not let us in yet.
    Joining,
    /// In the session.
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

/// The session that this app has joined.
#[derive(Resource)]
pub struct NetGuest {
    endpoint: Endpoint,
    config: JoinConfig,
    began: Instant,
    state: GuestState,
    /// A session may be sent between threads but not shared by them; a lock that is never waited for makes it a resource.
    session: Option<Mutex<GuestSession>>,
    bodies: BTreeMap<BodyId, FollowedBody>,
    placements: BTreeMap<BodyId, Transform>,
    users: BTreeMap<UserId, Entity>,
    grabs: BTreeMap<Entity, SentGrab>,
    targets_said: Duration,
    scratch: Vec<f64>,
}

struct FollowedBody {
    entity: Entity,
    /// Made here, not by the app: goes when the body goes, and is where the host has it.
    made_here: bool,
    name: String,
    phase: Phase,
    tick: u64,
    previous: (Vec<f64>, Option<Pose>),
    current: (Vec<f64>, Option<Pose>),
    /// The newest state is on screen and nothing has come since.
    settled: bool,
    /// Largest size of the state so far, the scale of the shown offset.
    peak: f64,
}

/// A grab of ours as the host was told of it.
struct SentGrab {
    body: BodyId,
    vertex: u32,
    radius: f64,
    /// As last sent, in session coordinates.
    target: [f64; 3],
    /// The session's number; `None`: refused.
    number: Option<u16>,
    point: Option<PatchPoint>,
}

impl NetGuest {
    pub(crate) fn new(config: JoinConfig, endpoint: Endpoint) -> Self {
        Self {
            endpoint,
            config,
            began: Instant::now(),
            state: GuestState::Joining,
            session: None,
            bodies: BTreeMap::new(),
            placements: BTreeMap::new(),
            users: BTreeMap::new(),
            grabs: BTreeMap::new(),
            targets_said: Duration::ZERO,
            scratch: Vec::new(),
        }
    }

    /// Where we stand.
    pub fn state(&self) -> &GuestState {
        &self.state
    }

    /// Reads the session, for those who want to know more: ticks, repairs, hidden states, playout delay. `None` before the connection is
    /// open.
    pub fn read_session<R>(&self, read: impl FnOnce(&GuestSession) -> R) -> Option<R> {
        let session = self.session.as_ref()?.lock().unwrap_or_else(PoisonError::into_inner);
        Some(read(&session))
    }

    /// Reads the session's view of the body that an entity follows.
    pub fn read_body<R>(&self, body: RemoteBody, read: impl FnOnce(&BodyView) -> R) -> Option<R> {
        self.read_session(|session| session.body(body.0).map(read))?
    }

    fn now(&self) -> Duration {
        self.began.elapsed()
    }

    fn flush(&mut self) {
        let Some(session) = exclusive(&mut self.session) else { return };
        while let Some(output) = session.poll_output() {
            // A host that does not read our few messages is as good as gone; the idle timeout will say so.
            let sent = match output.channel {
                Channel::Datagram => {
                    self.endpoint.send_datagram(PeerId::HOST, Bytes::from_owner(output.bytes))
                }
                Channel::Message => {
                    self.endpoint.send_message(PeerId::HOST, scene::session_message(&output.bytes))
                }
            };
            if let Err(error) = sent {
                debug!("not sent to the host: {error}");
            }
        }
    }

    pub(crate) fn figures(&self) -> NetStats {
        self.read_session(|session| self.figures_of(session)).unwrap_or_default()
    }

    fn figures_of(&self, session: &GuestSession) -> NetStats {
        let mut stats = NetStats::default();
        let Some(transport) = self.endpoint.stats(PeerId::HOST) else { return stats };
        stats.add(&session.stats(), &transport);
        for view in session.bodies() {
            let counts = view.counts();
            stats.shown += counts.stepped;
            stats.guessed += counts.guessed;
            stats.recovered += counts.repaired;
            stats.snapshots += counts.snapshots;
            let followed = self.bodies.get(&view.id());
            if let (Some(shown), Some(hidden), Some(followed)) = (view.shown(), view.hidden(), followed)
                && followed.peak > 0.0
            {
                let off = shown.q.iter().zip(&hidden.q).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
                stats.shown_offset = stats.shown_offset.max(off / followed.peak);
            }
        }
        stats
    }
}

/// The session, without locking: whoever may change the resource is alone with it.
fn exclusive(session: &mut Option<Mutex<GuestSession>>) -> Option<&mut GuestSession> {
    session.as_mut().map(|session| session.get_mut().unwrap_or_else(PoisonError::into_inner))
}

/// `PreUpdate`: what came from the host.
pub(crate) fn receive(world: &mut World) {
    world.try_resource_scope(|world, mut guest: Mut<NetGuest>| {
        let guest = &mut *guest;
        while let Some(event) = guest.endpoint.poll() {
            let now = guest.now();
            match event {
                Event::Connected { .. } => {
                    if let Err(error) = guest.greet(world, now) {
                        guest.close(world, error.to_string());
                    }
                }
                Event::Datagram { at, bytes, .. } => {
                    let at = at.saturating_duration_since(guest.began);
                    if let Some(session) = exclusive(&mut guest.session) {
                        session.on_datagram(at, &bytes);
                    }
                }
                Event::Message { bytes, .. } => match (scene::read(&bytes), exclusive(&mut guest.session)) {
                    (Some(Reliable::Session(bytes)), Some(session)) => session.on_message(now, bytes),
                    (Some(Reliable::Placement(placement)), _) => guest.place(world, placement),
                    // A later host may have more to say.
                    _ => debug!("a message of no known kind from the host"),
                },
                Event::Closed { reason, .. } => {
                    // A goodbye of the session came before this and says more.
                    guest.take_events(world);
                    guest.close(world, reason.to_string());
                }
            }
        }
        guest.take_events(world);
        guest.flush();
    });
}

impl NetGuest {
    /// The connection is open: says hello.
    fn greet(&mut self, world: &World, now: Duration) -> Result<(), StreamError> {
        let most = self.endpoint.max_datagram_size(PeerId::HOST).unwrap_or(0);
        let config = pliant_stream::GuestConfig {
            name: self.config.name.clone(),
            recovery: self.config.recovery,
            modes: self.config.modes,
            idle_timeout: self.config.transport.limits.idle_timeout,
            ..pliant_stream::GuestConfig::default()
        };
        let mut session = GuestSession::new(config, most)?;
        let loaded = world.get_resource::<Assets<ModalAsset>>();
        let loaded = loaded.into_iter().flat_map(|assets| assets.iter().map(|(_, asset)| &asset.0));
        for model in self.config.models.iter().chain(loaded) {
            session.add_cached_model(Arc::clone(model));
        }
        session.connect(now)?;
        self.session = Some(Mutex::new(session));
        Ok(())
    }

    fn close(&mut self, world: &mut World, reason: String) {
        if matches!(self.state, GuestState::Closed { .. }) {
            return;
        }
        info!("the session is over: {reason}");
        self.flush();
        self.endpoint.close(PeerId::HOST, "goodbye");
        self.state = GuestState::Closed { reason: reason.clone() };
        self.grabs.clear();
        for (_, entity) in std::mem::take(&mut self.users) {
            world.try_despawn(entity).ok();
        }
        world.write_message(SessionClosed { reason });
    }

    fn take_events(&mut self, world: &mut World) {
        while let Some(event) = exclusive(&mut self.session).and_then(GuestSession::poll_event) {
            match event {
                GuestEvent::Welcomed { user } => self.welcomed(world, user),
                GuestEvent::BodyReady { body, model } => self.body_ready(world, body, model),
                GuestEvent::BodyGone { body } => self.body_gone(world, body),
                GuestEvent::Stalled { body } => {
                    debug!("body {body} stands still: nothing comes from the host")
                }
                GuestEvent::UserJoined { user, name } => {
                    let (entity, name) = self.meet(world, user, &name);
                    world.write_message(UserJoined { entity, id: user, name });
                }
                GuestEvent::UserLeft { user } => {
                    if let Some(entity) = self.users.remove(&user) {
                        let name =
                            world.get::<User>(entity).map(|user| user.name.clone()).unwrap_or_default();
                        world.try_despawn(entity).ok();
                        world.write_message(UserLeft { id: user, name, reason: "left".into() });
                    }
                }
                GuestEvent::GrabRefused { grab } => {
                    let refused = self.grabs.iter_mut().find(|(_, sent)| sent.number == Some(grab));
                    if let Some((&entity, sent)) = refused {
                        sent.number = None;
                        world.write_message(GrabRefused { entity });
                    }
                }
                GuestEvent::Closed { reason } => self.close(world, reason.to_string()),
                _ => {}
            }
        }
    }

    fn meet(&mut self, world: &mut World, id: UserId, name: &str) -> (Entity, String) {
        let user = User::new(id, name);
        let name = user.name.clone();
        let entity = world.spawn(user).id();
        if let Some(old) = self.users.insert(id, entity) {
            world.try_despawn(old).ok();
        }
        (entity, name)
    }

    fn welcomed(&mut self, world: &mut World, user: UserId) {
        self.state = GuestState::In { user };
        let own = self.config.name.clone();
        let (entity, name) = self.meet(world, user, &own);
        world.entity_mut(entity).insert((Yourself, UserLink::default()));
        info!("in the session as {name}, user {}", user.0);
        let here = |session: &GuestSession| {
            let others = session.users().filter(|(id, _)| *id != user);
            others.map(|(id, name)| (id, name.to_owned())).collect::<Vec<_>>()
        };
        let others = self.read_session(here).unwrap_or_default();
        for (id, name) in others {
            self.meet(world, id, &name);
        }
        if !self.users.contains_key(&UserId::HOST) {
            self.meet(world, UserId::HOST, "host");
        }
    }

    fn place(&mut self, world: &mut World, placement: Placement) {
        // As many as the session may have bodies.
        if self.placements.len() >= 1024 && !self.placements.contains_key(&placement.body) {
            return;
        }
        self.placements.insert(placement.body, placement.transform);
        if let Some(followed) = self.bodies.get(&placement.body)
            && followed.made_here
            && let Some(mut transform) = world.get_mut::<Transform>(followed.entity)
        {
            *transform = placement.transform;
        }
    }

    /// Model and state of a body are here: it gets its entity.
    fn body_ready(&mut self, world: &mut World, id: BodyId, model: Arc<ModalModel>) {
        let Some(view) = exclusive(&mut self.session).and_then(|session| session.body(id)) else { return };
        let (name, warp) = (view.info().name.clone(), view.info().warp);
        let modes = view.shown().map_or(0, |state| state.modes());
        let modes = (modes < model.mode_count()).then_some(modes);
        let handle = world.get_resource_mut::<Assets<ModalAsset>>().map(|mut assets| {
            let known = assets.iter().find(|(_, asset)| asset.0.hash() == model.hash()).map(|(id, _)| id);
            let known = known.and_then(|id| assets.get_strong_handle(id));
            known.unwrap_or_else(|| assets.add(ModalAsset::from(model)))
        });
        let Some(handle) = handle else {
            error_once!("a body has arrived, but the app has no PliantBodyPlugin");
            return;
        };
        let followed = self.bodies.get(&id).filter(|followed| world.get_entity(followed.entity).is_ok());
        let (entity, made_here) = match followed {
            Some(followed) => (followed.entity, followed.made_here),
            None => {
                let mut waiting = world.query_filtered::<(Entity, &SharedBody), Without<RemoteBody>>();
                let waiting =
                    waiting.iter(world).find(|(_, shared)| shared.name == name).map(|(entity, _)| entity);
                match waiting {
                    Some(entity) => (entity, false),
                    None => {
                        let transform = self.placements.get(&id).copied().unwrap_or_default();
                        (world.spawn((SharedBody::named(name.clone()), transform)).id(), true)
                    }
                }
            }
        };
        let mut target = world.entity_mut(entity);
        match target.get_mut::<ModalBody>() {
            Some(mut body) => {
                let new = ModalBody { model: handle, modes, warp, ..body.clone() };
                body.set_if_neq(new);
            }
            None => {
                target.insert(ModalBody { modes, warp, ..ModalBody::new(handle) });
            }
        }
        target.insert((Driven::Remote, RemoteBody(id), SeenHands::default()));
        self.bodies.insert(
            id,
            FollowedBody {
                entity,
                made_here,
                name: name.clone(),
                phase: Phase::default(),
                tick: 0,
                previous: (Vec::new(), None),
                current: (Vec::new(), None),
                settled: false,
                peak: 0.0,
            },
        );
        world.write_message(BodyArrived { entity, name });
    }

    fn body_gone(&mut self, world: &mut World, id: BodyId) {
        self.placements.remove(&id);
        let Some(followed) = self.bodies.remove(&id) else { return };
        self.grabs.retain(|_, sent| sent.body != id);
        if followed.made_here {
            world.try_despawn(followed.entity).ok();
        } else if let Ok(mut entity) = world.get_entity_mut(followed.entity) {
            entity.remove::<(RemoteBody, SeenHands)>();
        }
        world.write_message(BodyLeft { entity: followed.entity, name: followed.name });
    }
}

/// `PostUpdate`: the app's own grabs on the session's bodies are told to the host.
pub(crate) fn send_hands(
    guest: Option<ResMut<NetGuest>>,
    bodies: Query<(&RemoteBody, &BodyState, &GlobalTransform)>,
    grabs: Query<(Entity, &Grab, &GrabOf)>,
) {
    let Some(mut guest) = guest else { return };
    let guest = &mut *guest;
    let now = guest.now();
    let Some(session) = exclusive(&mut guest.session).filter(|session| session.user().is_some()) else {
        return;
    };
    guest.grabs.retain(|&entity, sent| {
        let stays = grabs.get(entity).is_ok_and(|(_, grab, of)| {
            let same = grab.vertex == sent.vertex && grab.radius == sent.radius;
            same && bodies.get(of.0).is_ok_and(|(body, ..)| body.0 == sent.body)
        });
        if let (false, Some(number)) = (stays, sent.number) {
            session.end_grab(number);
        }
        stays
    });
    // Once a tick of the host is as often as it looks.
    let due = now.saturating_sub(guest.targets_said).as_secs_f64() >= 0.9 * session.step();
    if due {
        guest.targets_said = now;
    }
    for (entity, grab, of) in &grabs {
        let Ok((body, state, transform)) = bodies.get(of.0) else { continue };
        let Some(place) = Place::of_body(transform, state) else { continue };
        let target = place.point_to_session(grab.target);
        match guest.grabs.get_mut(&entity) {
            None => {
                let hold = GrabConfig { stiffness: grab.stiffness, relaxation: grab.relaxation };
                let begun = session.begin_grab(now, body.0, grab.vertex, grab.radius, target, hold);
                if let Err(error) = &begun {
                    debug!("a grab was not sent: {error}");
                }
                let point = PatchPoint::new(state.model(), grab.vertex, grab.radius).ok();
                let (vertex, radius, body) = (grab.vertex, grab.radius, body.0);
                guest
                    .grabs
                    .insert(entity, SentGrab { body, vertex, radius, target, number: begun.ok(), point });
            }
            Some(sent) if due && sent.target != target => {
                let Some(number) = sent.number else { continue };
                match session.set_target(number, target) {
                    Ok(()) => sent.target = target,
                    Err(error) => debug!("a target was not sent: {error}"),
                }
            }
            Some(_) => {}
        }
    }
}

type FollowedBodies<'w, 's> = Query<
    'w,
    's,
    (
        &'static BodyState,
        &'static mut ShownState,
        &'static mut SeenHands,
        &'static mut Transform,
        &'static GlobalTransform,
    ),
>;

/// `PostUpdate`: the session is brought to now, and what it shows is written.
pub(crate) fn show(
    guest: Option<ResMut<NetGuest>>,
    mut bodies: FollowedBodies,
    mut forces: Query<&mut GrabForce>,
    mut links: Query<&mut UserLink>,
) {
    let Some(mut guest) = guest else { return };
    let guest = &mut *guest;
    let now = guest.now();
    let Some(session) = exclusive(&mut guest.session) else { return };
    if let Some(most) = guest.endpoint.max_datagram_size(PeerId::HOST) {
        session.set_max_datagram(most);
    }
    session.update(now);
    let user = session.user();
    let step = session.step();
    for (&id, followed) in &mut guest.bodies {
        let Some(view) = session.body(id) else { continue };
        let Ok((state, mut shown, mut seen, mut transform, global)) = bodies.get_mut(followed.entity) else {
            continue;
        };
        followed.take(view);
        let fraction =
            if view.is_resting() { 1.0 } else { followed.phase.fraction(followed.tick, step, now) };
        if !followed.settled {
            followed.settled = fraction >= 1.0;
            followed.between(fraction, &mut guest.scratch);
            if let Err(error) = shown.snap(&guest.scratch) {
                debug!("a state of {} was not shown: {error}", followed.name);
            }
            if let (Some(from), Some(to)) = (followed.previous.1, followed.current.1) {
                set_pose(&mut transform, &from, &to, fraction, state.scale());
            }
        }
        let Some(place) = Place::of_body(global, state) else { continue };
        let hand = |grab: &pliant_stream::GrabState| SeenHand {
            user: grab.key.user,
            vertex: grab.vertex,
            target: place.point_to_world(grab.target),
            reaction: place.force_to_world(grab.reaction),
        };
        let others = view.grabs().iter().filter(|grab| Some(grab.key.user) != user).map(hand);
        seen.set_if_neq(SeenHands(others.collect()));
        for (&entity, sent) in guest.grabs.iter().filter(|(_, sent)| sent.body == id) {
            let Ok(mut force) = forces.get_mut(entity) else { continue };
            let felt = sent.number.zip(user).and_then(|(grab, user)| {
                let key = GrabKey { user, grab };
                let reaction = view.grabs().iter().find(|grab| grab.key == key)?.reaction;
                let body_point = sent.point.as_ref()?.at(shown.q(), state.warps());
                Some(GrabForce {
                    force: place.force_to_world(reaction),
                    point: of_body(&place, view, body_point),
                })
            });
            force.set_if_neq(felt.unwrap_or_default());
        }
    }
    let link = session.stats();
    let own = user.and_then(|user| guest.users.get(&user).copied());
    if let Some(mut shown) = own.and_then(|own| links.get_mut(own).ok()) {
        let new = UserLink { round_trip: link.round_trip, loss_in: link.loss_in, loss_out: link.loss_out };
        shown.set_if_neq(new);
    }
    guest.flush();
}

/// A point in body axes, in this app's world.
fn of_body(place: &Place, view: &BodyView, point: DVec3) -> DVec3 {
    let session = match view.pose() {
        None => point,
        Some(pose) => DQuat::from_array(pose.rotation) * point + DVec3::from(pose.position),
    };
    place.point_to_world(session.into())
}

fn set_pose(transform: &mut Transform, from: &Pose, to: &Pose, fraction: f64, scale: f64) {
    let origin = DVec3::from(from.position).lerp(DVec3::from(to.position), fraction) * scale;
    let [from, to] = [from, to].map(|pose| DQuat::from_array(pose.rotation).normalize());
    let rotation = from.slerp(to, fraction).normalize();
    if origin.is_finite() && rotation.is_finite() {
        transform.translation = origin.as_vec3();
        transform.rotation = rotation.as_quat();
    }
}

impl FollowedBody {
    /// Takes over what the session shows now.
    fn take(&mut self, view: &BodyView) {
        let Some(shown) = view.shown() else { return };
        let tick = view.tick();
        let first = self.current.0.len() != shown.modes();
        if tick == self.tick && !first {
            // A snapshot may have moved the state of a tick; its blend begins at what was shown.
            return;
        }
        self.tick = tick;
        self.settled = false;
        std::mem::swap(&mut self.previous, &mut self.current);
        self.current.0.clone_from(&shown.q);
        self.current.1 = view.pose();
        if first {
            self.previous = self.current.clone();
        }
        self.peak = self.peak.max(shown.q.iter().map(|q| q * q).sum::<f64>().sqrt());
    }

    fn between(&self, fraction: f64, out: &mut Vec<f64>) {
        out.clear();
        out.extend(
            self.previous.0.iter().zip(&self.current.0).map(|(from, to)| from + (to - from) * fraction),
        );
    }
}
