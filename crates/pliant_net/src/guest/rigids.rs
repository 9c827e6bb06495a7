//! The host's rigid bodies, and the entities that follow them.

use bevy::prelude::*;
use pliant_stream::{GuestSession, RigidId};

use super::NetGuest;
use crate::remote::{RigidArrived, RigidLeft};
use crate::session::{SessionEvent, queue_event};
use crate::session_transform::set_pose;
use crate::shared_body::{RemoteRigid, SharedRigid};
use crate::view::DisplayedBodies;

/// The entity that follows a rigid body of the host.
#[derive(Debug, Clone)]
pub(super) struct FollowedRigid {
    entity: Entity,
    /// Whether this plugin spawned the entity. Such an entity is despawned with the rigid body.
    made_here: bool,
    name: String,
}

impl NetGuest {
    /// Gives a rigid body its entity.
    pub(super) fn rigid_arrived(&mut self, world: &mut World, id: RigidId, name: String) {
        let mut waiting = world.query_filtered::<(Entity, &SharedRigid), Without<RemoteRigid>>();
        let waiting = waiting.iter(world).find(|(_, shared)| shared.name == name).map(|(entity, _)| entity);
        let known = self.orphan_rigids.iter().position(|one| waiting == Some(one.entity));
        let followed = match (waiting, known) {
            (_, Some(at)) => self.orphan_rigids.swap_remove(at),
            (Some(entity), None) => FollowedRigid { entity, made_here: false, name: name.clone() },
            (None, None) => {
                let mut transform = Transform::default();
                let session = self.session.as_ref();
                if let Some(shown) = session.and_then(|session| session.rigid(id)).map(|one| one.visual()) {
                    set_pose(&mut transform, &shown, &shown, 0.0, 1.0);
                }
                let shared = SharedRigid::named(name.clone());
                let entity = world.spawn((shared, transform, Visibility::default())).id();
                FollowedRigid { entity, made_here: true, name: name.clone() }
            }
        };
        let entity = followed.entity;
        world.entity_mut(entity).insert(RemoteRigid(id));
        self.rigids.insert(id, followed);
        queue_event(world, SessionEvent::RigidArrived(RigidArrived { entity, name }));
    }

    pub(super) fn rigid_gone(&mut self, world: &mut World, id: RigidId) {
        if let Some(followed) = self.rigids.remove(&id) {
            take_leave(world, followed);
        }
    }

    /// Stops all rigid bodies when the session is lost. The next session may have them again.
    pub(super) fn orphan_rigids(&mut self, world: &mut World) {
        for (_, followed) in std::mem::take(&mut self.rigids) {
            if let Ok(mut there) = world.get_entity_mut(followed.entity) {
                there.remove::<RemoteRigid>();
            }
            self.orphan_rigids.push(followed);
        }
    }

    /// Removes the rigid bodies that the session does not have after a reconnect.
    pub(super) fn forget_orphan_rigids(&mut self, world: &mut World) {
        for followed in std::mem::take(&mut self.orphan_rigids) {
            take_leave(world, followed);
        }
    }
}

/// Ends the tracking of a rigid body. An entity of the app stays where it was last shown.
fn take_leave(world: &mut World, followed: FollowedRigid) {
    let FollowedRigid { entity, made_here, name } = followed;
    if made_here {
        world.try_despawn(entity).ok();
    } else if let Ok(mut there) = world.get_entity_mut(entity) {
        there.remove::<RemoteRigid>();
    }
    queue_event(world, SessionEvent::RigidLeft(RigidLeft { entity, name }));
}

/// Puts the entities where the session shows their rigid bodies.
pub(super) fn show_rigids(
    session: &GuestSession,
    rigids: &Query<(Entity, &RemoteRigid, Option<&ChildOf>)>,
    places: &mut ParamSet<(DisplayedBodies, TransformHelper, Query<&mut Transform>)>,
) {
    for (entity, id, child) in rigids {
        let Some(shown) = session.rigid(id.0).map(|rigid| rigid.visual()) else { continue };
        let parent = child.map(|child| places.p1().compute_global_transform(child.parent()));
        let mut all = places.p2();
        let Ok(mut transform) = all.get_mut(entity) else { continue };
        let mut place = *transform;
        set_pose(&mut place, &shown, &shown, 0.0, 1.0);
        if let Some(parent) = parent.and_then(Result::ok) {
            let (_, rotation, _) = parent.to_scale_rotation_translation();
            place.translation = parent.affine().inverse().transform_point3(place.translation);
            place.rotation = rotation.inverse() * place.rotation;
        }
        if place.is_finite() {
            transform.set_if_neq(place);
        }
    }
}
