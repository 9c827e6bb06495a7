//! Entities that ride on a named part of another: bodies on the bones of a skinned mesh.

use std::collections::VecDeque;

use bevy::prelude::*;

use crate::Teleport;

/// Makes the entity a child of the entity with this name at or below `root`, as soon as there is
/// one.
///
/// The joints of a glTF scene are entities with names, which appear when the scene is loaded. A
/// body on a joint follows it, and feels it ([`Inertia`](crate::Inertia)). The entity's `Transform`
/// counts from the joint. Of several entities of that name the one nearest to the root is taken.
/// The component goes when the entity has found its place. A root at or below the entity itself has
/// no effect.
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_body::{ModalBody, RideOn};
/// fn add_ear(mut commands: Commands, assets: Res<AssetServer>, character: Single<Entity, With<WorldAssetRoot>>) {
///     commands.spawn((
///         ModalBody::new(assets.load("ear.modal")),
///         RideOn { root: *character, name: "Head".into() },
///         Transform::from_xyz(0.1, 0.2, 0.0),
///     ));
/// }
/// # #[derive(Component)] struct WorldAssetRoot;
/// ```
#[derive(Component, FromTemplate, Reflect, Debug, Clone, PartialEq, Eq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
#[require(Transform)]
pub struct RideOn {
    /// Entity at or below which the named one is looked for.
    #[entities]
    pub root: Entity,
    /// Name of the entity to ride on.
    pub name: String,
}

impl Default for RideOn {
    /// Waits for no entity.
    fn default() -> Self {
        Self { root: Entity::PLACEHOLDER, name: String::new() }
    }
}

/// Gives the entities that wait their parents. To be put there is no motion that a body feels.
pub(crate) fn find_parents(
    mut commands: Commands,
    mut teleports: MessageWriter<Teleport>,
    parents: Query<&ChildOf>,
    waiting: Query<(Entity, &RideOn)>,
    names: Query<&Name>,
    children: Query<&Children>,
) {
    for (entity, ride) in &waiting {
        // Nothing rides on what rides on it.
        if ride.root == entity || parents.iter_ancestors(ride.root).any(|above| above == entity) {
            continue;
        }
        let mut next = VecDeque::from([ride.root]);
        while let Some(at) = next.pop_front() {
            if names.get(at).is_ok_and(|name| name.as_str() == ride.name) {
                commands.entity(entity).try_insert(ChildOf(at)).try_remove::<RideOn>();
                teleports.write(Teleport(entity));
                break;
            }
            next.extend(children.get(at).into_iter().flatten().filter(|&&child| child != entity));
        }
    }
}
