//! The users of a session as entities, alike on a host, a guest and a peer.

use std::collections::BTreeMap;

use bevy::prelude::*;
use pliant_stream::{DisconnectReason, Role, UserId};

use crate::session::{SessionEvent, queue_event};
use crate::user::{User, UserJoined, UserLeft, UserLink, Yourself};

/// The entities of the users in the session.
#[derive(Debug, Default)]
pub(crate) struct Roster(BTreeMap<UserId, Entity>);

impl Roster {
    /// Spawns the entity of a user without reporting it. An older entity of the same number is
    /// despawned.
    pub(crate) fn meet(&mut self, world: &mut World, id: UserId, name: &str, role: Role) -> Entity {
        let entity = world.spawn((User::new(id, name, role), UserLink::default())).id();
        if let Some(old) = self.0.insert(id, entity) {
            world.try_despawn(old).ok();
        }
        entity
    }

    /// Spawns the entity of this app's own user.
    pub(crate) fn meet_yourself(&mut self, world: &mut World, id: UserId, name: &str, role: Role) -> Entity {
        let entity = self.meet(world, id, name, role);
        world.entity_mut(entity).insert(Yourself);
        entity
    }

    /// Spawns the entity of a user who has joined, and reports it. `back`: the same user was there
    /// before.
    pub(crate) fn join(
        &mut self,
        world: &mut World,
        id: UserId,
        name: &str,
        role: Role,
        back: bool,
    ) -> Entity {
        let entity = self.meet(world, id, name, role);
        let name = name_of(world, entity);
        info!("{name} {}", if back { "is back" } else { "has joined" });
        queue_event(world, SessionEvent::UserJoined(UserJoined { entity, id, name, back }));
        entity
    }

    /// Despawns the entity of a user who has left, and reports it. Returns false for an unknown
    /// user.
    pub(crate) fn leave(&mut self, world: &mut World, id: UserId, reason: DisconnectReason) -> bool {
        let Some(entity) = self.0.remove(&id) else { return false };
        let name = name_of(world, entity);
        info!("{name} has left: {reason}");
        world.try_despawn(entity).ok();
        queue_event(world, SessionEvent::UserLeft(UserLeft { id, name, reason }));
        true
    }

    /// Despawns all users without reporting it.
    pub(crate) fn clear(&mut self, world: &mut World) {
        for (_, entity) in std::mem::take(&mut self.0) {
            world.try_despawn(entity).ok();
        }
    }

    pub(crate) fn get(&self, id: UserId) -> Option<Entity> {
        self.0.get(&id).copied()
    }

    pub(crate) fn len(&self) -> usize {
        self.0.len()
    }
}

fn name_of(world: &World, entity: Entity) -> String {
    world.get::<User>(entity).map(|user| user.name.clone()).unwrap_or_default()
}
