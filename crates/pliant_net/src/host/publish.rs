//! From the bodies' steps to the guests.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use bevy::prelude::*;
use bevy::tasks::{AsyncComputeTaskPool, block_on, poll_once};
use pliant_body::{BodyState, Driven, Grab, GrabForce, Grabs, PliantTick};
use pliant_modal::ModalModel;
use pliant_stream::{BodyId, GrabKey, GrabState, Pose, StepSettings, TickState, UserId};

use super::NetHost;
use super::hands::GuestGrab;
use crate::scene::{self, Placement, Reach, SharedBody};
use crate::session_transform::SessionTransform;
use crate::user::{User, UserLink};

pub(super) struct HostedBody {
    pub(super) id: BodyId,
    model: Arc<ModalModel>,
    settings: StepSettings,
    /// When the guests were told of the settings.
    told: Duration,
    pub(super) placed: GlobalTransform,
    /// A refusal to publish was logged; once is enough.
    faulted: bool,
}

/// A body's settings are told to the guests at most so often: a slider that is dragged changes them every frame, and each change begins the streams anew.
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
    host.files.retain(|entity, _| present(entity));
    let gone: Vec<Entity> = host.bodies.keys().copied().filter(|entity| !present(entity)).collect();
    for entity in gone {
        if let Some(body) = host.bodies.remove(&entity) {
            host.session.remove_body(body.id);
        }
    }
    // A guest's hand whose grab the app has despawned is off: its guest is told.
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
    /// The body's number in the session; it is announced, announced anew with another model, and its settings are told, when there is need.
    fn announced(
        &mut self,
        entity: Entity,
        shared: &SharedBody,
        state: &BodyState,
        transform: &GlobalTransform,
    ) -> Option<BodyId> {
        let config = state.body().config();
        // An anchored body's weight turns with its entity: the stream learns it.
        let gravity = if state.model().is_free() { config.settings.gravity } else { [0.0; 3] };
        let settings = StepSettings { gravity, ..config.settings };
        let model = state.model();
        let now = self.now();
        if let Some(hosted) = self.bodies.get_mut(&entity) {
            if Arc::ptr_eq(&hosted.model, model) {
                let id = hosted.id;
                // Until they are told the stream learns of it from the state, as of any force that is not known.
                if hosted.settings != settings && now.saturating_sub(hosted.told) >= SETTINGS_EVERY {
                    (hosted.settings, hosted.told) = (settings, now);
                    if let Err(error) = self.session.set_settings(id, settings) {
                        warn_once!("a body's settings are not shared: {error}");
                    }
                }
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
        let bytes = self.file_of(entity, model)?;
        // Numbers go round; one that is in use is refused, and the next tick tries the next.
        let id = BodyId(self.next_body);
        self.next_body = self.next_body.wrapping_add(1);
        match self.session.add_body_as(id, &shared.name, Arc::clone(model), bytes, settings) {
            Ok(()) => {
                let model = Arc::clone(model);
                self.bodies.insert(
                    entity,
                    HostedBody { id, model, settings, told: now, placed: *transform, faulted: false },
                );
                self.tell_place(Placement::new(id, transform), None);
                Some(id)
            }
            Err(error) => {
                warn_once!("a body is not shared: {error}");
                None
            }
        }
    }

    /// The file of a body's model, for guests that have it not; `None` while it is being made, since that takes long for a step.
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
    // The more there are to tell of and to, the less often: a guest gets at most 256 bytes of this a second.
    let now = host.now();
    let pause = Duration::from_secs(1).mul_f64((host.numbers.len() as f64 / 32.0).max(1.0));
    if now.saturating_sub(host.reaches_said) >= pause && host.numbers.len() > 2 {
        host.reaches_said = now;
        let reaches: Vec<Reach> = inside()
            .filter_map(|(_, entity)| links.get(entity).ok())
            .map(|(user, link)| Reach::new(user.id, link))
            .collect();
        host.tell_all(&scene::reaches_message(&reaches));
    }
}
