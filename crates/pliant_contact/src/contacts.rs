//! What bodies touch: the obstacles near each body, other bodies, and the contacts of its last
//! step.

use std::sync::Arc;

use bevy::{ecs::entity::MapEntities, math::DVec3, prelude::*};
use nalgebra::Vector3;
use pliant_body::{BodyError, BodyRefused, BodyState, Driven, FixedObstacles, ProbeState, TouchProbe};
use pliant_modal::{self as modal, StepError};

use crate::obstacle::{ContactLayers, Motion, Nothing};

/// Coefficient of Coulomb friction of a body, 0 to 10, with all obstacles that have none of their
/// own. Between two bodies the coefficient is the geometric mean of both.
///
/// A body without this component has the friction of [`BodyFriction::default`]. On an
/// [`Obstacle`](crate::Obstacle) it is that of ice or rubber: the coefficient with a body or a
/// probe is then the geometric mean of both. Guests do not step contacts with such an obstacle
/// themselves, and among peers bodies do not touch it. Of avian's colliders its `Friction` counts
/// likewise, where they have one.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct BodyFriction(pub f64);

impl Default for BodyFriction {
    /// A coefficient of 0.5.
    fn default() -> Self {
        Self(modal::Contacts::FRICTION)
    }
}

/// Lets a body touch other bodies that have this component.
///
/// [`ContactLayers`] decide which of them. The entities of two bodies that touch must have the same
/// scale. Bodies that other sources move ([`Driven::Remote`]) touch no bodies.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq, Eq, Default)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct TouchBodies;

/// A place where a body touches an obstacle or another body.
#[derive(Reflect, MapEntities, Debug, Clone, Copy, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct ContactPoint {
    /// The entity of the [`Obstacle`](crate::Obstacle) or of the other body.
    #[entities]
    pub other: Entity,
    /// Surface vertex of the body at the center of the touching patch.
    pub vertex: u32,
    /// Position of the contact, m, world axes.
    pub point: DVec3,
    /// Outward normal of the obstacle or of the other body, world axes.
    pub normal: DVec3,
    /// Mean force on the body over the last step, N, world axes.
    pub force: DVec3,
    /// Depth of the body's surface inside the other, m.
    pub penetration: f64,
    /// Whether the contact slides.
    pub sliding: bool,
}

/// The contacts of a body in its last step. The plugin adds this component to every body.
#[derive(Component, Reflect, Debug, Clone, PartialEq, Default)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct BodyContacts(#[entities] pub Vec<ContactPoint>);

impl BodyContacts {
    /// Sum of the forces on the body over the last step, N, world axes.
    pub fn force(&self) -> DVec3 {
        self.0.iter().map(|contact| contact.force).sum()
    }

    /// Whether the body touches this obstacle or body.
    pub fn touches(&self, other: Entity) -> bool {
        self.0.iter().any(|contact| contact.other == other)
    }

    /// What the body touches, each once.
    fn others(&self) -> impl Iterator<Item = Entity> {
        let seen = |index: usize, other| self.0[..index].iter().any(|c| c.other == other);
        let all = self.0.iter().enumerate();
        all.filter(move |(index, c)| !seen(*index, c.other)).map(|(_, contact)| contact.other)
    }
}

/// A body began to touch an obstacle or another body. Of two bodies each has such an event. Observe
/// it on the body's entity or on all.
#[derive(EntityEvent, Reflect, Debug, Clone, Copy, PartialEq)]
pub struct ContactStarted {
    /// The entity of the body.
    pub entity: Entity,
    /// The entity of the [`Obstacle`](crate::Obstacle) or of the other body.
    pub other: Entity,
    /// Position of the contact with the largest force, m, world axes.
    pub point: DVec3,
    /// Outward normal of the other there, world axes.
    pub normal: DVec3,
    /// Impulse on the body in the first step, N s, world axes, summed over all places.
    pub impulse: DVec3,
}

/// A body ceased to touch an obstacle or another body. Observe it on the body's entity or on all.
#[derive(EntityEvent, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
pub struct ContactEnded {
    /// The entity of the body.
    pub entity: Entity,
    /// The entity of the [`Obstacle`](crate::Obstacle) or of the other body.
    pub other: Entity,
}

/// The obstacles that a body was given, at the indices that its solver knows.
#[derive(Component, Reflect, Debug, Default)]
#[reflect(Component, Default)]
pub(crate) struct Nearby {
    #[entities]
    pub(crate) slots: Vec<Option<Entity>>,
    /// The rigid bodies to which the body is attached, which it does not touch. Found at each tick.
    #[reflect(ignore)]
    pub(crate) attached: Vec<Entity>,
    /// The friction that was refused, so that it is reported once.
    refused: Option<f64>,
}

/// Adds what a new body needs for its contacts. A loaded body has it already.
pub(crate) fn prepare_body(added: On<Add, BodyState>, mut commands: Commands) {
    commands.entity(added.entity).try_insert_if_new((Nearby::default(), BodyContacts::default()));
}

/// Removes the contacts of a body that is removed, and wakes those that touched it.
pub(crate) fn forget_body(
    removed: On<Remove, BodyState>,
    mut commands: Commands,
    mut bodies: Query<(&mut BodyState, &BodyContacts)>,
) {
    if let Ok(mut entity) = commands.get_entity(removed.entity) {
        entity.try_remove::<(Nearby, BodyContacts)>();
    }
    for (mut state, contacts) in &mut bodies {
        if state.is_resting() && contacts.touches(removed.entity) {
            state.wake();
        }
    }
}

/// Fills in the obstacles that stand still, for a copy of the body that is stepped elsewhere.
pub(crate) fn fill_fixed(
    added: On<Insert, FixedObstacles>,
    obstacles: Query<(&Motion, Option<&ContactLayers>)>,
    mut bodies: Query<(&mut FixedObstacles, &BodyState, Option<&ContactLayers>, Option<&BodyFriction>)>,
) {
    let Ok((mut fixed, state, layers, friction)) = bodies.get_mut(added.entity) else { return };
    let layers = layers.copied().unwrap_or_default();
    let touches = |other: Option<&ContactLayers>| layers.touch(other.copied().unwrap_or_default());
    let near = obstacles.iter().filter(|(motion, other)| motion.sound && touches(*other));
    fixed.obstacles = near.filter_map(|(motion, _)| motion.obstacle(state.scale()).fixed()).collect();
    fixed.friction = friction.copied().unwrap_or_default().0;
}

type Bodies<'w, 's> = Query<
    'w,
    's,
    (
        Entity,
        &'static mut BodyState,
        &'static mut Nearby,
        &'static Driven,
        Option<Ref<'static, ContactLayers>>,
        Option<Ref<'static, BodyFriction>>,
    ),
>;

/// Gives each body and each probe the obstacles near it. What has not changed is not touched, so
/// that bodies rest.
pub(crate) fn place_obstacles(
    time: Res<Time>,
    mut commands: Commands,
    obstacles: Query<(Entity, &Motion, Option<Ref<ContactLayers>>)>,
    mut last: Local<Vec<Entity>>,
    mut bodies: Bodies,
    mut probes: Query<(Entity, &TouchProbe, &mut ProbeState, Option<&ContactLayers>)>,
) {
    let step = time.delta_secs_f64();
    // In the order of entities, so that the order of archetypes makes no difference.
    let mut all: Vec<_> = obstacles.iter().filter(|(_, motion, _)| motion.sound).collect();
    all.sort_by_key(|(entity, ..)| *entity);
    let changed = |layers: &Option<Ref<ContactLayers>>| layers.as_ref().is_some_and(Ref::is_changed);
    let listed = !last.iter().eq(all.iter().map(|(entity, ..)| entity));
    if listed {
        last.clear();
        last.extend(all.iter().map(|(entity, ..)| *entity));
    }
    let stirred: Vec<_> =
        all.iter().filter(|(_, motion, layers)| motion.changed || changed(layers)).collect();
    for (entity, probe, mut state, layers) in &mut probes {
        if let Err(error) = give_probe(&all, probe, &mut state, layers.copied().unwrap_or_default()) {
            commands.trigger(BodyRefused { entity, error: BodyError::Obstacle(error) });
        }
    }
    for (entity, mut state, mut nearby, driven, layers, friction) in &mut bodies {
        let touched = changed(&layers) || friction.as_ref().is_some_and(Ref::is_changed);
        let look = !state.is_resting() || touched || listed;
        if !look && stirred.is_empty() {
            continue;
        }
        let nearby = &mut *nearby;
        let layers = layers.as_deref().copied().unwrap_or_default();
        let local = *driven == Driven::Local;
        let (body, scale) = (state.body(), state.scale());
        let center = Vector3::from(body.frame().to_world(Vector3::from(body.model().center_of_mass())));
        let size = body.model().size();
        let reach = 2.0 * size + 2.0 * step * Vector3::from(body.frame().velocity()).norm();
        let known = |entity: &Entity| nearby.slots.contains(&Some(*entity));
        let stirs = |(entity, motion, _): &&(Entity, &Motion, Option<Ref<ContactLayers>>)| {
            known(entity) || motion.distance(scale, &center) <= reach
        };
        if !look && !stirred.iter().any(stirs) {
            continue;
        }
        let near: Vec<(Entity, &Motion)> = all
            .iter()
            .filter(|(_, motion, other)| {
                local
                    && layers.touch(other.as_deref().copied().unwrap_or_default())
                    && motion.distance(scale, &center) <= reach
                    && !motion.belongs(&nearby.attached)
            })
            .map(|(entity, motion, _)| (*entity, *motion))
            .collect();
        let find = |entity: Entity| near.binary_search_by_key(&entity, |(entity, _)| *entity).ok();
        let mut changed = body.contacts().obstacles().len() != nearby.slots.len();
        // What has changed, and how near it wakes a resting body.
        let mut moved: Vec<(usize, f64)> = Vec::new();
        for (index, slot) in nearby.slots.iter_mut().enumerate() {
            if slot.is_some_and(|entity| find(entity).is_none()) {
                (*slot, changed) = (None, true);
                moved.push((index, 0.0));
            }
        }
        for (entity, motion) in &near {
            let known = nearby.slots.iter().position(|slot| *slot == Some(*entity));
            if known.is_some() && !motion.changed {
                continue;
            }
            changed = true;
            let free = || nearby.slots.iter().position(Option::is_none);
            let index = known.or_else(free).unwrap_or(nearby.slots.len());
            if index == nearby.slots.len() {
                nearby.slots.push(None);
            }
            nearby.slots[index] = Some(*entity);
            moved.push((index, step * motion.speed(scale, &center) + MARGIN * size));
        }
        if near.is_empty() {
            nearby.slots.clear();
        }
        if changed {
            let list = nearby.slots.iter().map(|slot| match slot.and_then(find) {
                Some(index) => near[index].1.obstacle(scale),
                None => Arc::new(Nothing),
            });
            let given = state.bypass_change_detection().set_obstacles(list.collect(), &moved);
            if !state.is_resting() {
                state.set_changed();
            }
            if let Err(error) = given {
                commands.trigger(BodyRefused { entity, error: BodyError::Obstacle(error) });
            }
        }
        let wanted = friction.as_deref().copied().unwrap_or_default().0;
        let current = state.body().contacts().friction();
        if wanted.to_bits() != current.to_bits() && nearby.refused.map(f64::to_bits) != Some(wanted.to_bits())
        {
            let set = state.body_mut().set_friction(wanted);
            nearby.refused = set.is_err().then_some(wanted);
            if let Err(error) = set {
                warn!("{entity}: {error}");
                commands.trigger(BodyRefused { entity, error: BodyError::Friction(error) });
            }
        }
    }
}

/// Distance within which an obstacle that moves wakes a resting body, as a share of its size,
/// besides the obstacle's way in a step.
const MARGIN: f64 = 0.01;

/// Farthest distance of an obstacle that a probe is given, m, besides its way in a step.
const NEAR: f64 = 0.1;

/// Gives a probe the obstacles near it. `all` is in the order of entities.
fn give_probe(
    all: &[(Entity, &Motion, Option<Ref<ContactLayers>>)],
    probe: &TouchProbe,
    state: &mut ProbeState,
    layers: ContactLayers,
) -> Result<(), StepError> {
    state.set_layers([layers.memberships, layers.filters]);
    let Some((center, scale)) = state.around() else { return Ok(()) };
    let reach = NEAR + 2.0 * probe.radius + state.extent() + 2.0 * center.distance(probe.target);
    let local = Vector3::from((center / scale).to_array());
    let near: Vec<(Entity, &Motion)> = all
        .iter()
        .filter(|(_, motion, other)| {
            layers.touch(other.as_deref().copied().unwrap_or_default())
                && motion.distance(scale, &local) * scale <= reach
        })
        .map(|(entity, motion, _)| (*entity, *motion))
        .collect();
    let same = near.iter().map(|(entity, _)| *entity).eq(state.obstacles().iter().copied());
    if same && near.iter().all(|(_, motion)| !motion.changed) {
        return Ok(());
    }
    state.set_obstacles(near.into_iter().map(|(entity, motion)| (entity, motion.obstacle(scale))).collect())
}

/// Tells the bodies which others they touch, and wakes a body when another that it touches is moved
/// away from it.
pub(crate) fn touch_bodies(
    mut awake: Local<Vec<Entity>>,
    mut bodies: Query<(
        Entity,
        &mut BodyState,
        &Driven,
        &BodyContacts,
        Has<TouchBodies>,
        Option<&ContactLayers>,
    )>,
) {
    awake.clear();
    for (entity, mut state, driven, _, touches, layers) in &mut bodies {
        let ContactLayers { memberships, filters } = layers.copied().unwrap_or_default();
        if state.probe_layers() != [memberships, filters] {
            state.bypass_change_detection().set_probe_layers([memberships, filters]);
        }
        let wanted = (touches && *driven == Driven::Local).then_some([memberships, filters]);
        if state.body_layers() != wanted {
            state.touch_bodies(wanted);
        }
        if !state.is_resting() {
            awake.push(entity);
        }
    }
    awake.sort_unstable();
    for (_, mut state, _, contacts, ..) in &mut bodies {
        if state.is_resting() && contacts.others().any(|other| awake.binary_search(&other).is_ok()) {
            state.wake();
        }
    }
}

/// Writes the contacts of each body and triggers the events of what began and what ended.
pub(crate) fn publish(
    time: Res<Time>,
    mut commands: Commands,
    mut bodies: Query<(Entity, &BodyState, &Nearby, &mut BodyContacts)>,
) {
    let step = time.delta_secs_f64();
    for (entity, state, nearby, mut contacts) in &mut bodies {
        // A resting body goes on touching what it touches.
        if state.is_resting() {
            continue;
        }
        let scale = state.scale();
        let world = |point: [f64; 3]| scale * DVec3::from(point);
        let of = |contact: &modal::Contact| {
            let other = match contact.other {
                modal::Touched::Obstacle(index) => nearby.slots.get(index).copied().flatten()?,
                modal::Touched::Body(bits) => Entity::try_from_bits(bits)?,
                // The contacts of a hand's probe are reported there.
                modal::Touched::Probe(_) | modal::Touched::Attachment(_) => return None,
            };
            Some(ContactPoint {
                other,
                vertex: contact.vertex,
                point: world(contact.point),
                normal: contact.normal.into(),
                force: world(contact.force),
                penetration: scale * contact.penetration,
                sliding: contact.sliding,
            })
        };
        let now = BodyContacts(state.body().contacts().contacts().iter().filter_map(of).collect());
        if now == *contacts {
            continue;
        }
        for other in contacts.others().filter(|&other| !now.touches(other)) {
            commands.trigger(ContactEnded { entity, other });
        }
        for other in now.others().filter(|&other| !contacts.touches(other)) {
            let own = || now.0.iter().filter(|contact| contact.other == other);
            let largest = own().max_by(|a, b| a.force.length().total_cmp(&b.force.length()));
            let Some(&ContactPoint { point, normal, .. }) = largest else { continue };
            let impulse = step * own().map(|contact| contact.force).sum::<DVec3>();
            commands.trigger(ContactStarted { entity, other, point, normal, impulse });
        }
        *contacts = now;
    }
}
