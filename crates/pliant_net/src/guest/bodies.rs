//! The host's bodies, and the entities that track them.

use std::sync::Arc;

use bevy::prelude::*;
use pliant_body::{Driven, ModalAsset, ModalBody};
use pliant_modal::ModalModel;
use pliant_stream::{BodyId, Placement, StepSettings};

use super::{Interest, NetGuest};
use crate::remote::{BodyArrived, BodyLeft, RemoteBody, RemoteHands};
use crate::session::{SessionEvent, give_back, queue_event};
use crate::session_transform::transform_of;
use crate::shared_body::SharedBody;
use crate::view::BodyDisplay;

/// A body of the host and its last displayed states.
pub(super) struct FollowedBody {
    pub(super) entity: Entity,
    /// Whether this plugin spawned the entity. Such an entity is despawned with the body and gets
    /// the host's transform.
    made_here: bool,
    /// The body that an entity of the app had before the session.
    before: Option<ModalBody>,
    pub(super) name: String,
    pub(super) display: BodyDisplay,
    /// Largest size of the state so far, the scale of the visual state's offset.
    pub(super) peak: f64,
}

impl NetGuest {
    /// Moves the entity that this plugin spawned for a body to where the host has placed it.
    pub(super) fn place(&mut self, world: &mut World, body: BodyId, placement: Placement) {
        if let Some(followed) = self.bodies.get(&body)
            && followed.made_here
            && let Some(mut transform) = world.get_mut::<Transform>(followed.entity)
        {
            *transform = transform_of(placement);
        }
    }

    /// Gives a body its entity, when its model and its state have arrived.
    pub(super) fn body_ready(&mut self, world: &mut World, id: BodyId, model: Arc<ModalModel>) {
        let Some(view) = self.session.as_ref().and_then(|session| session.body(id)) else { return };
        let info = view.info();
        let name = info.name.clone();
        let settings = info.settings;
        let placement = view.placement();
        // The stream's number of modes may change. The display has room for all modes that this
        // guest accepts.
        let modes = self.config.modes.map(usize::from).filter(|&modes| modes < model.mode_count());
        let now = self.now();
        self.source.keep_model(now, &model);
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
        let (entity, made_here, before) = match followed {
            Some(followed) => (followed.entity, followed.made_here, followed.before.clone()),
            None => {
                let mut waiting = world.query_filtered::<(Entity, &SharedBody), Without<RemoteBody>>();
                let waiting =
                    waiting.iter(world).find(|(_, shared)| shared.name == name).map(|(entity, _)| entity);
                match waiting {
                    Some(entity) => match self.known(world, entity) {
                        Some(known) => (entity, known.made_here, known.before),
                        None => (entity, false, world.get::<ModalBody>(entity).cloned()),
                    },
                    None => {
                        let transform = transform_of(placement.unwrap_or_default());
                        (world.spawn((SharedBody::named(name.clone()), transform)).id(), true, None)
                    }
                }
            }
        };
        let mut target = world.entity_mut(entity);
        match target.get_mut::<ModalBody>() {
            Some(mut body) => {
                let model = handle;
                let settings = stepped_as(&settings, &body);
                let new = ModalBody { model, modes, settings, ..body.clone() };
                body.set_if_neq(new);
            }
            None => {
                let new = ModalBody::new(handle);
                let settings = stepped_as(&settings, &new);
                target.insert(ModalBody { modes, settings, ..new });
            }
        }
        target.insert((Driven::Remote, RemoteBody(id), RemoteHands::default()));
        target.entry::<Interest>().or_default();
        self.bodies.insert(
            id,
            FollowedBody {
                entity,
                made_here,
                before,
                name: name.clone(),
                display: BodyDisplay::default(),
                peak: 0.0,
            },
        );
        queue_event(world, SessionEvent::BodyArrived(BodyArrived { entity, name }));
    }

    /// Takes what is known of an entity that has tracked a body of the lost session, or one that
    /// the host has removed.
    fn known(&mut self, world: &World, entity: Entity) -> Option<FollowedBody> {
        self.forget_what_the_app_has(world);
        [&mut self.orphans, &mut self.removed].into_iter().find_map(|bodies| {
            let at = bodies.iter().position(|followed| followed.entity == entity)?;
            Some(bodies.swap_remove(at))
        })
    }

    /// Forgets the entities of removed bodies that are gone, or that the app steps itself.
    fn forget_what_the_app_has(&mut self, world: &World) {
        self.removed.retain(|followed| world.get(followed.entity) == Some(&Driven::Remote));
    }

    /// Takes over changed settings from the host, because the energy and the knobs that are
    /// displayed here use the same settings.
    pub(super) fn body_changed(&mut self, world: &mut World, id: BodyId) {
        let Some(view) = self.session.as_ref().and_then(|session| session.body(id)) else { return };
        let settings = view.info().settings;
        let Some(followed) = self.bodies.get(&id) else { return };
        if let Some(mut body) = world.get_mut::<ModalBody>(followed.entity) {
            let new = ModalBody { settings: stepped_as(&settings, &body), ..body.clone() };
            body.set_if_neq(new);
        }
    }

    pub(super) fn body_gone(&mut self, world: &mut World, id: BodyId) {
        self.less_since.remove(&id);
        let Some(followed) = self.bodies.remove(&id) else { return };
        self.grabs.retain(|_, sent| sent.own.body != id);
        self.take_leave(world, followed);
    }

    /// Stops all bodies when the session is lost.
    pub(super) fn orphan_bodies(&mut self, world: &mut World) {
        self.less_since.clear();
        for (_, followed) in std::mem::take(&mut self.bodies) {
            if let Ok(mut entity) = world.get_entity_mut(followed.entity) {
                entity.remove::<(RemoteBody, RemoteHands)>();
            }
            self.orphans.push(followed);
        }
    }

    /// Removes the bodies that the session does not have after a reconnect.
    pub(super) fn forget_orphans(&mut self, world: &mut World) {
        for followed in std::mem::take(&mut self.orphans) {
            self.take_leave(world, followed);
        }
    }

    /// Gives all bodies back to the app, which leaves the session. Entities that this plugin has
    /// spawned are despawned.
    pub(super) fn give_back_bodies(&mut self, world: &mut World) {
        self.forget_what_the_app_has(world);
        self.orphan_bodies(world);
        self.forget_orphans(world);
        for followed in std::mem::take(&mut self.removed) {
            let Ok(mut entity) = world.get_entity_mut(followed.entity) else { continue };
            match followed.before {
                Some(before) => {
                    entity.insert(before);
                    give_back(world, followed.entity);
                }
                None => {
                    entity.remove::<(ModalBody, Driven)>();
                }
            }
        }
    }

    /// Ends the tracking of a body. An entity of the app shows its last state until the app leaves
    /// the session, and has then what it had before.
    fn take_leave(&mut self, world: &mut World, followed: FollowedBody) {
        let (entity, name) = (followed.entity, followed.name.clone());
        if followed.made_here {
            world.try_despawn(entity).ok();
        } else if let Ok(mut there) = world.get_entity_mut(entity) {
            there.remove::<(RemoteBody, RemoteHands)>();
            self.removed.push(followed);
        }
        queue_event(world, SessionEvent::BodyLeft(BodyLeft { entity, name }));
    }
}

/// Returns the host's settings for a guest's copy of a body. Gravity stays the copy's own, because
/// the network carries states in the axes of the stream.
fn stepped_as(settings: &StepSettings, body: &ModalBody) -> StepSettings {
    StepSettings { gravity: body.settings.gravity, ..*settings }
}
