//! Publishes the steps of the bodies to the guests.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use bevy::prelude::*;
use bevy::tasks::{AsyncComputeTaskPool, block_on, poll_once};
use pliant_body::{BodyState, Driven, Grab, GrabForce, Grabs, PliantTick};
use pliant_modal::ModalModel;
use pliant_stream::{
    BodyId, GrabKey, GrabState, RigidState, StepSettings, TickState, UserId, UserLinkInfo, next_free,
};

use super::NetHost;
use super::hands::GuestGrab;
use super::surroundings::KnownSurroundings;
use crate::own_grab::hold_of;
use crate::session_transform::{SessionTransform, placement_of};
use crate::shared_body::SharedBody;
use crate::user::{User, UserLink};

pub(super) struct HostedBody {
    pub(super) id: BodyId,
    model: Arc<ModalModel>,
    settings: StepSettings,
    /// When the settings were last sent to the guests.
    settings_sent: Duration,
    pub(super) placed: GlobalTransform,
    around: KnownSurroundings,
    /// Whether the current fault was logged, so that it is logged only once.
    faulted: bool,
}

/// Shortest interval between two changes of a body's settings that are sent to the guests. Dragging
/// a slider changes the settings every frame, and each change restarts the streams.
const SETTINGS_EVERY: Duration = Duration::from_millis(250);

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

/// Runs after the bodies' step. Announces new bodies, removes bodies that are gone, and sends the
/// step of each body.
pub(crate) fn publish(
    host: Option<ResMut<NetHost>>,
    tick: Res<PliantTick>,
    bodies: SharedBodies,
    grabs: Query<(&Grab, &GrabForce, Option<&GuestGrab>)>,
    #[cfg(feature = "watch")] views: Query<&crate::watch::WatchView>,
) {
    let Some(mut host) = host else { return };
    let host = &mut *host;
    let now = host.now();
    let present =
        |entity: &Entity| bodies.get(*entity).is_ok_and(|(.., driven, _, _)| *driven == Driven::Local);
    host.files.retain(|entity, _| present(entity));
    let gone: Vec<Entity> = host.bodies.keys().copied().filter(|entity| !present(entity)).collect();
    for entity in gone {
        if let Some(body) = host.bodies.remove(&entity) {
            host.session.remove_body(body.id);
        }
    }
    // The app has despawned these guests' grabs, so their guests are notified.
    let off: Vec<GrabKey> =
        host.grabs.iter().filter(|(_, grab)| !grabs.contains(**grab)).map(|(&key, _)| key).collect();
    for key in off {
        host.grabs.remove(&key);
        host.session.refuse_grab(key);
    }
    let mut held = BTreeSet::new();
    for (entity, shared, state, driven, transform, list) in &bodies {
        if *driven == Driven::Remote {
            continue;
        }
        let Some(place) = SessionTransform::of_body(transform, state) else { continue };
        let Some(id) = host.announced(entity, shared, state, transform) else { continue };
        let mut streamed = std::mem::take(&mut host.scratch);
        streamed.clear();
        for grab_entity in list.into_iter().flat_map(|list| list.iter()) {
            let Ok((grab, force, guest)) = grabs.get(grab_entity) else { continue };
            let key = guest.map_or_else(|| host.own_key(grab_entity), |guest| guest.key);
            held.insert(grab_entity);
            #[cfg(feature = "watch")]
            host.show_hand(id, key, grab, force, views.get(entity).ok());
            let grab = GrabState {
                key,
                vertex: grab.vertex,
                radius: grab.radius,
                target: place.point_to_session(grab.target),
                reaction: place.force_to_session(force.force),
                hold: hold_of(grab),
            };
            if grab.is_valid() && streamed.len() < pliant_stream::MAX_GRABS {
                streamed.push(grab);
            }
        }
        let body = state.body();
        if let Some(hosted) = host.bodies.get_mut(&entity)
            && let Some(around) = hosted.around.look(now, body)
            && let Err(error) = host.session.set_surroundings(id, around.clone())
        {
            warn_once!("the surroundings of a body are not shared: {error}");
        }
        let pose = body.model().is_free().then(|| RigidState::of(body));
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
        #[cfg(feature = "watch")]
        if let Some(watch) = &mut host.watch {
            watch.body(&crate::watch::Seen {
                id,
                name: &shared.name,
                model: state.model(),
                warps: state.warps(),
                placement: placement_of(transform),
                view: views.get(entity).ok(),
                state: &step,
            });
        }
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
    #[cfg(feature = "watch")]
    host.finish_watch(tick.0);
    host.flush();
}

impl NetHost {
    /// Returns the body's number in the session. Announces the body if it is new or has another
    /// model, and sends changed settings.
    fn announced(
        &mut self,
        entity: Entity,
        shared: &SharedBody,
        state: &BodyState,
        transform: &GlobalTransform,
    ) -> Option<BodyId> {
        let config = state.body().config();
        // The gravity of an anchored body turns with its entity, so the stream learns it from the
        // states instead.
        let gravity = if state.model().is_free() { config.settings.gravity } else { [0.0; 3] };
        let settings = StepSettings { gravity, ..config.settings };
        let model = state.model();
        let now = self.now();
        if let Some(hosted) = self.bodies.get_mut(&entity) {
            if Arc::ptr_eq(&hosted.model, model) {
                let id = hosted.id;
                // Until the settings are sent, the stream learns the change from the states, like
                // any unknown force.
                if hosted.settings != settings && now.saturating_sub(hosted.settings_sent) >= SETTINGS_EVERY {
                    (hosted.settings, hosted.settings_sent) = (settings, now);
                    if let Err(error) = self.session.set_settings(id, settings) {
                        warn_once!("a body's settings are not shared: {error}");
                    }
                }
                // The frames of a free body contain its pose.
                if hosted.placed != *transform && !model.is_free() {
                    hosted.placed = *transform;
                    self.place(id, transform);
                }
                return Some(id);
            }
            self.session.remove_body(hosted.id);
            self.bodies.remove(&entity);
        }
        let bytes = self.file_of(entity, model)?;
        // Numbers wrap around. A number in use is refused, and the next tick tries the next number.
        let id = BodyId(self.next_body);
        self.next_body = self.next_body.wrapping_add(1);
        match self.session.add_body_as(id, &shared.name, Arc::clone(model), bytes, settings) {
            Ok(()) => {
                let model = Arc::clone(model);
                self.bodies.insert(
                    entity,
                    HostedBody {
                        id,
                        model,
                        settings,
                        settings_sent: now,
                        placed: *transform,
                        around: KnownSurroundings::default(),
                        faulted: false,
                    },
                );
                self.place(id, transform);
                Some(id)
            }
            Err(error) => {
                warn_once!("a body is not shared: {error}");
                None
            }
        }
    }

    /// Shows a hand to watchers who see its body.
    #[cfg(feature = "watch")]
    fn show_hand(
        &mut self,
        body: BodyId,
        key: GrabKey,
        grab: &Grab,
        force: &GrabForce,
        view: Option<&crate::watch::WatchView>,
    ) {
        if let Some(watch) = &mut self.watch
            && !view.is_some_and(|view| view.hidden)
        {
            let (target, reaction) = (grab.target.into(), force.force.into());
            watch.hand(crate::watch::WatchHand { body, key, target, reaction });
        }
    }

    /// Tells watchers the numbers of the session, after all bodies of a tick.
    #[cfg(feature = "watch")]
    fn finish_watch(&mut self, tick: pliant_stream::Tick) {
        let Some(mut watch) = self.watch.take() else { return };
        let inside = self.guests.iter().filter(|(_, guest)| guest.entity.is_some());
        let links: Vec<_> = inside.filter_map(|(&peer, _)| self.link(peer)).map(|(link, _)| link).collect();
        let mean = |of: &dyn Fn(&pliant_stream::LinkStats) -> f64| {
            links.iter().map(of).sum::<f64>() / (links.len() as f64).max(1.0)
        };
        let numbers = crate::watch::WatchNumbers {
            people: self.users.len().min(usize::from(u16::MAX)) as u16,
            loss: (!links.is_empty()).then(|| mean(&|link| link.loss_out)),
            round_trip: mean(&|link| link.round_trip.as_secs_f64()),
            dropped: 0,
        };
        watch.finish(tick, numbers);
        self.watch = Some(watch);
    }

    /// Sends a body's transform to the guests.
    fn place(&mut self, body: BodyId, transform: &GlobalTransform) {
        if let Err(error) = self.session.set_placement(body, placement_of(transform)) {
            debug!("the place of body {body} was not sent: {error}");
        }
    }

    /// Returns the file of a body's model, for guests that do not have the model. Returns `None`
    /// while the file is being encoded, which takes too long for a step.
    fn file_of(&mut self, entity: Entity, model: &Arc<ModalModel>) -> Option<Arc<[u8]>> {
        let Some(pool) = AsyncComputeTaskPool::try_get() else { return Some(model.to_bytes().into()) };
        let begin = || {
            let model = Arc::clone(model);
            (Arc::clone(&model), pool.spawn(async move { Arc::from(model.to_bytes()) }))
        };
        let (of, task) = self.files.entry(entity).or_insert_with(begin);
        if !Arc::ptr_eq(of, model) {
            (*of, *task) = begin();
        }
        let bytes = block_on(poll_once(task))?;
        self.files.remove(&entity);
        Some(bytes)
    }

    /// Returns the session's key for a grab made at the host.
    fn own_key(&mut self, entity: Entity) -> GrabKey {
        let grab = self.own_grabs.get(&entity).copied().unwrap_or_else(|| {
            // A grab may be held until the numbers wrap around.
            let used: BTreeSet<u16> = self.own_grabs.values().copied().collect();
            let grab = next_free(&mut self.next_own_grab, |number| !used.contains(&number));
            self.own_grabs.insert(entity, grab);
            grab
        });
        GrabKey { user: UserId::HOST, grab }
    }
}

/// Runs at the end of a frame. Sends what is due and writes the state of each guest's link.
pub(crate) fn finish(host: Option<ResMut<NetHost>>, mut links: Query<(&User, &mut UserLink)>) {
    let Some(mut host) = host else { return };
    let host = &mut *host;
    host.flush();
    let inside = || host.guests.iter().filter_map(|(&peer, guest)| Some((peer, guest.entity?)));
    for (peer, entity) in inside() {
        let Some((link, _)) = host.link(peer) else { continue };
        if let Ok((_, mut shown)) = links.get_mut(entity) {
            let new =
                UserLink { round_trip: link.round_trip, loss_in: link.loss_in, loss_out: link.loss_out };
            shown.set_if_neq(new);
        }
    }
    // The interval grows with the number of users, so that a guest receives at most 256 bytes of
    // this per second.
    let now = host.now();
    let pause = Duration::from_secs(1).mul_f64((host.users.len() as f64 / 32.0).max(1.0));
    if now.saturating_sub(host.links_sent) >= pause && host.users.len() > 2 {
        host.links_sent = now;
        let all = inside().filter_map(|(_, entity)| links.get(entity).ok());
        let all = all
            .map(|(user, link)| UserLinkInfo::new(user.id, link.round_trip, link.loss_in, link.loss_out))
            .collect();
        host.session.send_links(all);
    }
}
