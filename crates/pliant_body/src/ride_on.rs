//! Entities that ride on a named part of another: bodies on the bones of a skinned mesh.

use std::collections::VecDeque;

use bevy::prelude::*;

/// Makes the entity a child of the entity with this name at or below `root`, as soon as there is
/// one.
///
/// The joints of a glTF scene are entities with names, which appear when the scene is loaded. A
/// body on a joint follows it, and feels it ([`Inertia`](crate::Inertia)). The entity's `Transform`
/// counts from the joint. Of several entities of that name the one nearest to the root is taken.
/// The component goes when the entity has found its place.
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
#[derive(Component, Reflect, Debug, Clone, PartialEq, Eq)]
#[reflect(Component, Debug, Clone, PartialEq)]
#[require(Transform)]
pub struct RideOn {
    /// Entity at or below which the named one is looked for.
    #[entities]
    pub root: Entity,
    /// Name of the entity to ride on.
    pub name: String,
}

/// Gives the entities that wait their parents.
pub(crate) fn find_parents(
    mut commands: Commands,
    waiting: Query<(Entity, &RideOn)>,
    names: Query<&Name>,
    children: Query<&Children>,
) {
    for (entity, ride) in &waiting {
        let mut next = VecDeque::from([ride.root]);
        while let Some(at) = next.pop_front() {
            if at != entity && names.get(at).is_ok_and(|name| name.as_str() == ride.name) {
                commands.entity(entity).try_insert(ChildOf(at)).try_remove::<RideOn>();
                break;
            }
            next.extend(children.get(at).into_iter().flatten().filter(|&&child| child != entity));
        }
    }
}
