//! Colliders and rigid bodies of avian, with forces both ways.
//!
//! Bodies are stepped before avian. A dynamic rigid body gives way within that step: the solver
//! knows its inverse mass and what it stands on. The forces are then applied by avian's own step,
//! spread over its substeps so that the rigid body goes as far as the solver took it to go.

use std::{
    collections::{BTreeMap, BTreeSet, VecDeque},
    sync::Arc,
};

use avian3d::{
    collision::contact_types::ContactId,
    dynamics::{
        integrator::VelocityIntegrationData,
        solver::{islands::WakeBody, schedule::SubstepCount},
    },
    parry::shape::SharedShape,
    prelude::{
        AngularVelocity, Collider, ColliderDisabled, ColliderOf, ColliderTransform, Collisions,
        ComputedAngularInertia, ComputedCenterOfMass, ComputedMass, ContactGraph, Friction, Gravity,
        GravityScale, LinearVelocity, LockedAxes, Physics, PhysicsTime, Position, RigidBody,
        RigidBodyColliders, RigidBodyDisabled, Rotation, Sensor, Sleeping,
    },
};
use bevy::{
    ecs::{query::QueryData, schedule::InternedScheduleLabel},
    math::{DMat3, DQuat, DVec3},
    prelude::*,
};
use nalgebra::Vector3;
use pliant_body::{BodyError, BodyRefused, BodyState, ModalBody, PliantSystems, Pose, RigidBodies};
use pliant_modal::{Contacts, ObstacleShape, Rigid, StepError, Support, SurfacePoint};

use crate::{
    contacts::{BodyContacts, Nearby, place_obstacles, publish, touch_bodies},
    obstacle::{Motion, Obstacle, keep, move_obstacles},
};

mod attachment;
mod shape;

pub use attachment::{Attachment, AttachmentForce};

/// Farthest place of a collider, m. Avian marks a place that it does not know yet by the largest
/// number.
const FARTHEST: f32 = 1e30;

/// Number of rigid bodies in a step up to which those give way that only touch others. Those near
/// soft bodies always do. What is farther moves as it does.
const MOST: usize = 64;

/// Acceleration that wakes a sleeping rigid body, as a share of gravity's and at least, m/s^2: what
/// remains where soft bodies alone hold it up, and the change by their contacts elsewhere.
const UNBALANCED: f64 = 0.005;
const STIRRED: f64 = 0.1;

/// What is no obstacle any more, neither by itself nor by avian.
pub(crate) type Gone = (With<Motion>, Without<Obstacle>, Or<(Without<Collider>, With<ModalBody>)>);

/// Name of a rigid body in the worlds of bodies on entities of this uniform scale.
pub(crate) fn key(rigid: Entity, scale: f64) -> [u64; 2] {
    [rigid.to_bits(), scale.to_bits()]
}

/// An obstacle that gives way with a rigid body.
#[derive(Debug)]
pub(crate) struct Owned<O> {
    pub(crate) shape: O,
    pub(crate) key: [u64; 2],
}

impl<O: ObstacleShape> ObstacleShape for Owned<O> {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        self.shape.at(point)
    }

    fn velocity(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.shape.velocity(point)
    }

    fn curvature(&self) -> f64 {
        self.shape.curvature()
    }

    fn friction(&self) -> Option<f64> {
        self.shape.friction()
    }

    fn check(&self) -> Result<(), StepError> {
        self.shape.check()
    }

    fn rigid(&self) -> Option<[u64; 2]> {
        Some(self.key)
    }
}

/// The obstacle of a shape, or why it has none, and the shape, which is kept so that no other has
/// its address.
type Form = (SharedShape, Result<Arc<dyn ObstacleShape>, StepError>, bool);

/// The obstacles of all shapes, by their address.
#[derive(Resource, Default)]
pub(crate) struct Forms(BTreeMap<usize, Form>);

impl Forms {
    fn tidy(&mut self) {
        self.0.retain(|_, (.., used)| std::mem::take(used));
    }

    fn get(&mut self, shape: &SharedShape) -> Result<Arc<dyn ObstacleShape>, StepError> {
        let address = Arc::as_ptr(&shape.0).cast::<()>() as usize;
        let make = || (shape.clone(), shape::form(shape), true);
        let (_, made, used) = self.0.entry(address).or_insert_with(make);
        *used = true;
        made.clone()
    }
}

/// Whether avian knows this place. One with a coordinate that is no number is none.
fn is_place(at: Vec3) -> bool {
    at.abs().cmplt(Vec3::splat(FARTHEST)).all()
}

/// A rigid body of avian.
#[derive(QueryData)]
pub(crate) struct Body {
    entity: Entity,
    kind: &'static RigidBody,
    position: &'static Position,
    rotation: &'static Rotation,
    velocity: &'static LinearVelocity,
    spin: &'static AngularVelocity,
    mass: &'static ComputedMass,
    inertia: &'static ComputedAngularInertia,
    center: &'static ComputedCenterOfMass,
    gravity: Option<&'static GravityScale>,
    locked: Option<&'static LockedAxes>,
    friction: Option<&'static Friction>,
    colliders: Option<&'static RigidBodyColliders>,
    sleeps: Has<Sleeping>,
    disabled: Has<RigidBodyDisabled>,
}

impl BodyItem<'_, '_> {
    /// Whether avian knows where it is.
    fn is_placed(&self) -> bool {
        is_place(self.position.0) && self.rotation.0.is_finite()
    }

    /// Whether forces move it.
    fn gives_way(&self) -> bool {
        let numbers = self.is_placed() && self.velocity.0.is_finite() && self.spin.0.is_finite();
        self.kind.is_dynamic() && !self.disabled && numbers && self.mass.inverse() > 0.0
    }

    /// Whether accelerations (m/s^2 and rad/s^2) would move it from its sleep.
    fn stirs(&self, [pushed, turned]: [DVec3; 2], most: f64) -> bool {
        let inertia = self.inverse_inertia();
        let trace = inertia.x_axis.x + inertia.y_axis.y + inertia.z_axis.z;
        // A turn counts by the way of what is as far out as most of the mass.
        let radius = (3.0 * f64::from(self.mass.inverse()) / trace.max(f64::MIN_POSITIVE)).sqrt();
        pushed.length().max(radius * turned.length()) > most
    }

    fn turn(&self) -> DQuat {
        self.rotation.0.as_dquat().normalize()
    }

    /// Center of mass, m.
    fn center(&self) -> DVec3 {
        self.position.0.as_dvec3() + self.turn() * self.center.0.as_dvec3()
    }

    /// Velocity of the center of mass (m/s) and angular velocity (rad/s).
    fn motion(&self) -> [DVec3; 2] {
        let moves = !self.kind.is_static() && !self.sleeps;
        if moves { [self.velocity.0.as_dvec3(), self.spin.0.as_dvec3()] } else { [DVec3::ZERO; 2] }
    }

    /// Bits of the locked axes: three for the way, three for the turn, x first.
    fn free(&self) -> [DVec3; 2] {
        let bits = self.locked.map_or(0, LockedAxes::to_bits);
        let free = |bit: u8| if bits & bit == 0 { 1.0 } else { 0.0 };
        [[0b100_000, 0b010_000, 0b001_000], [0b100, 0b010, 0b001]].map(|bits| DVec3::from(bits.map(free)))
    }

    fn inverse_mass(&self) -> DVec3 {
        f64::from(self.mass.inverse()) * self.free()[0]
    }

    /// Inverse inertia about the center of mass, world axes.
    fn inverse_inertia(&self) -> DMat3 {
        let own = Mat3::from(self.inertia.inverse()).as_dmat3();
        let turn = DMat3::from_quat(self.turn());
        let free = DMat3::from_diagonal(self.free()[1]);
        free * turn * own * turn.transpose() * free
    }

    fn acceleration(&self, gravity: &Gravity) -> DVec3 {
        f64::from(self.gravity.map_or(1.0, |scale| scale.0)) * gravity.0.as_dvec3() * self.free()[0]
    }

    /// The rigid body in the world of soft bodies on entities of this uniform scale.
    fn rigid(&self, gravity: &Gravity, scale: f64) -> Rigid {
        let [velocity, spin] = self.motion();
        let inertia = self.inverse_inertia() * (scale * scale);
        Rigid {
            key: key(self.entity, scale),
            center: (self.center() / scale).into(),
            rotation: self.turn().into(),
            velocity: (velocity / scale).into(),
            angular_velocity: spin.into(),
            acceleration: (self.acceleration(gravity) / scale).into(),
            inverse_mass: self.inverse_mass().into(),
            inverse_inertia: inertia.to_cols_array_2d(),
            rests: self.sleeps,
            ..Rigid::default()
        }
    }
}

type Colliders<'w, 's> = Query<
    'w,
    's,
    (
        Entity,
        &'static Collider,
        &'static Position,
        &'static Rotation,
        Option<&'static ColliderOf>,
        Option<&'static ColliderTransform>,
        Has<Sensor>,
        Has<ColliderDisabled>,
        Option<&'static Friction>,
        Option<&'static mut Motion>,
    ),
    (Without<Obstacle>, Without<ModalBody>),
>;

/// Takes the pose of every collider at the end of this tick, as its velocity predicts it.
fn move_colliders(
    time: Res<Time>,
    physics: Res<Time<Physics>>,
    mut commands: Commands,
    mut forms: ResMut<Forms>,
    mut refused: Local<BTreeSet<Entity>>,
    bodies: Query<Body>,
    mut colliders: Colliders,
) {
    let stands = physics.is_paused() || physics.relative_speed_f64() == 0.0;
    let step = if stands { 0.0 } else { time.delta_secs_f64() };
    forms.tidy();
    refused.retain(|entity| colliders.contains(*entity));
    for (entity, collider, position, rotation, of, local, sensor, disabled, friction, motion) in
        &mut colliders
    {
        let body = of.and_then(|of| bodies.get(of.body).ok());
        let (position, rotation) = match (&body, local) {
            // The place of a collider on a child is a tick old.
            (Some(body), Some(local)) if body.entity != entity => {
                let turn = body.rotation.0;
                (body.position.0 + turn * local.translation, turn * local.rotation.0)
            }
            _ => (position.0, rotation.0),
        };
        let known = is_place(position) && rotation.is_finite();
        let off = sensor || disabled || !known || body.as_ref().is_some_and(|body| body.disabled);
        let form = if off { None } else { Some(forms.get(collider.shape_scaled())) };
        let form = match form {
            None => None,
            Some(Ok(form)) => {
                refused.remove(&entity);
                Some(form)
            }
            Some(Err(error)) => {
                if refused.insert(entity) {
                    warn!("{entity}: {error}");
                    commands.trigger(BodyRefused { entity, error: BodyError::Obstacle(error) });
                }
                None
            }
        };
        let now = form.map(|form| {
            let mut pose = Pose { origin: position.as_dvec3(), orientation: rotation.as_dquat().normalize() };
            let mut ways = [DVec3::ZERO; 2];
            if let Some(body) = body.as_ref().filter(|_| step > 0.0) {
                let [velocity, spin] = body.motion();
                let (center, turn) = (body.center(), DQuat::from_scaled_axis(step * spin));
                let arm = turn * (pose.origin - center);
                pose.origin = center + step * velocity + arm;
                pose.orientation = turn * pose.orientation;
                ways = [velocity + spin.cross(arm), spin];
            }
            let gives_way = body.as_ref().filter(|body| body.gives_way() && step > 0.0);
            let rigid = gives_way.map(|body| body.entity);
            let awake = gives_way.is_some_and(|body| !body.sleeps);
            let of = [body.as_ref().map(|body| body.entity), rigid];
            let on_body = body.as_ref().and_then(|body| body.friction);
            let friction = friction
                .or(on_body)
                .map(|friction| f64::from(friction.dynamic_coefficient).clamp(0.0, Contacts::MAX_FRICTION));
            Motion::of_collider(form, pose, ways, of, friction, awake, motion.as_deref())
        });
        keep(&mut commands, entity, motion, now);
    }
}

/// Adds the systems.
pub(crate) fn build(app: &mut App, schedule: InternedScheduleLabel) {
    let running = |time: Res<Time>| !time.delta().is_zero();
    app.register_type::<Attachment>().register_type::<AttachmentForce>().add_observer(attachment::detach);
    app.init_resource::<Forms>().init_resource::<RigidBodies>();
    app.init_resource::<Places>().init_resource::<Asleep>().add_systems(
        schedule,
        (
            move_colliders
                .after(PliantSystems::Input)
                .after(move_obstacles)
                .before(place_obstacles)
                .run_if(running),
            attachment::attach.after(move_colliders).before(place_obstacles).run_if(running),
            gather.after(place_obstacles).after(touch_bodies).before(PliantSystems::Step).run_if(running),
            push.after(PliantSystems::Step).before(PliantSystems::Publish).run_if(running),
            wake.after(publish).run_if(running),
            attachment::write_forces.in_set(PliantSystems::Publish),
        )
            .run_if(present),
    );
}

/// Whether avian is in the app.
fn present(
    gravity: Option<Res<Gravity>>,
    physics: Option<Res<Time<Physics>>>,
    substeps: Option<Res<SubstepCount>>,
    contacts: Option<Res<ContactGraph>>,
) -> bool {
    gravity.is_some() && physics.is_some() && substeps.is_some() && contacts.is_some()
}

/// Where avian has the supports of each rigid body of the list: contact, manifold and point.
#[derive(Resource, Default)]
struct Places(Vec<Vec<(ContactId, usize, usize)>>);

/// Lists the rigid bodies that give way in this step: those near soft bodies, and those that touch
/// them, up to [`MOST`].
fn gather(
    gravity: Res<Gravity>,
    (time, substeps): (Res<Time>, Res<SubstepCount>),
    collisions: Collisions,
    bodies: Query<Body>,
    motions: Query<&Motion>,
    soft: Query<(&BodyState, &Nearby)>,
    mut list: ResMut<RigidBodies>,
    mut places: ResMut<Places>,
) {
    list.0.clear();
    places.0.clear();
    let mut all: Vec<(Rigid, Vec<(ContactId, usize, usize)>)> = Vec::new();
    // Avian has the impulses of its last substep.
    let substep = time.delta_secs_f64() / f64::from(substeps.0.max(1));
    let mut found: BTreeSet<(u64, Entity)> = BTreeSet::new();
    for (state, nearby) in soft.iter().filter(|(state, _)| !state.is_resting()) {
        let near = nearby.slots.iter().flatten().filter_map(|entity| motions.get(*entity).ok()?.rigid);
        let near = near.chain(attachment::giving_way(nearby, &bodies));
        found.extend(near.map(|rigid| (state.scale().to_bits(), rigid)));
    }
    // The nearest come first.
    let mut open: VecDeque<_> = found.iter().copied().collect();
    while let Some((bits, entity)) = open.pop_front() {
        let Ok(body) = bodies.get(entity) else { continue };
        let scale = f64::from_bits(bits);
        let (mut rigid, mut own) = (body.rigid(&gravity, scale), Vec::new());
        for pair in
            body.colliders.iter().flat_map(|all| all.iter()).flat_map(|c| collisions.collisions_with(c))
        {
            let (first, second) = (pair.body1, pair.body2);
            let (sign, other) = if first == Some(entity) { (-1.0, second) } else { (1.0, first) };
            let Some(other) = other.filter(|_| pair.generates_constraints() && pair.is_touching()) else {
                continue;
            };
            let Ok(other) = bodies.get(other) else { continue };
            let one = (bits, other.entity);
            let mut gives_way = found.contains(&one);
            if !gives_way && found.len() < MOST && other.gives_way() {
                gives_way = true;
                found.insert(one);
                open.push_back(one);
            }
            // Of two that give way, one has the contact.
            if gives_way && other.entity < entity {
                continue;
            }
            let [velocity, spin] = other.motion();
            for (m, manifold) in pair.manifolds.iter().enumerate() {
                let normal = sign * manifold.normal.as_dvec3();
                if !normal.is_finite() || (normal.length() - 1.0).abs() > 1e-3 {
                    continue;
                }
                for (p, point) in manifold.points.iter().enumerate() {
                    own.push((pair.contact_id, m, p));
                    let anchor = if sign < 0.0 { point.anchor1 } else { point.anchor2 };
                    let place = body.center() + anchor.as_dvec3();
                    let moved = velocity + spin.cross(place - other.center());
                    rigid.supports.push(Support {
                        other: gives_way.then(|| key(other.entity, scale)),
                        point: (place / scale).into(),
                        normal: normal.normalize().into(),
                        gap: f64::from(-point.penetration).max(0.0) / scale,
                        friction: manifold.friction.into(),
                        velocity: (moved / scale).into(),
                        force: f64::from(point.warm_start_normal_impulse) / substep / scale,
                    });
                }
            }
        }
        all.push((rigid, own));
    }
    // In the order of entities, so that the order of archetypes makes no difference.
    all.sort_by_key(|(rigid, _)| rigid.key);
    (list.0, places.0) = all.into_iter().unzip();
}

type Velocities<'w, 's> = Query<
    'w,
    's,
    (&'static mut LinearVelocity, &'static mut AngularVelocity, &'static mut VelocityIntegrationData),
>;

/// Gives the rigid bodies what the contacts of the step did to them, and wakes those that sleep
/// when it is not what they went to sleep with.
fn push(
    substeps: Res<SubstepCount>,
    gravity: Res<Gravity>,
    time: Res<Time>,
    list: Res<RigidBodies>,
    places: Res<Places>,
    mut graph: ResMut<ContactGraph>,
    mut asleep: ResMut<Asleep>,
    mut commands: Commands,
    mut bodies: ParamSet<(Query<Body>, Velocities)>,
) {
    let step = time.delta_secs_f64();
    let parts = f64::from(substeps.0.max(1));
    // Share of `h^2` times an acceleration that avian's substeps go.
    let spread = 0.5 + 0.5 / parts;
    for rigid in &list.0 {
        let Some(entity) = Entity::try_from_bits(rigid.key[0]) else { continue };
        let all = bodies.p0();
        let Ok(body) = all.get(entity) else { continue };
        let scale = f64::from_bits(rigid.key[1]);
        let pushed = body.inverse_mass() * scale * DVec3::from(rigid.force);
        let turned = body.inverse_inertia() * (scale * scale * DVec3::from(rigid.torque));
        let gravity = body.acceleration(&gravity);
        if !(pushed.is_finite() && turned.is_finite()) {
            continue;
        }
        let sleeps = body.sleeps;
        if sleeps {
            let last = *asleep.0.entry(entity).or_insert([pushed, turned]);
            // What no soft body held up when it fell asleep needs none now.
            let alone = last != [DVec3::ZERO; 2] && !rigid.is_held;
            let most = gravity.length().max(1.0);
            let stirred = body.stirs([pushed - last[0], turned - last[1]], STIRRED * most)
                || alone && body.stirs([pushed + gravity, turned], UNBALANCED * most);
            if !stirred {
                continue;
            }
            asleep.0.remove(&entity);
            commands.queue_silenced(WakeBody(entity));
        }
        if [pushed, turned] == [DVec3::ZERO; 2] {
            continue;
        }
        let mut velocities = bodies.p1();
        let Ok((mut velocity, mut spin, mut increments)) = velocities.get_mut(entity) else { continue };
        // A share at once and the rest in the substeps go as far as the solver took it to go. What
        // holds a body up does so at every moment, so gravity is shared out in the same way.
        // Avian's contacts hold a force in the substeps better than an impulse.
        let by_parts = rigid.is_held || spread >= 1.0 || sleeps;
        let once = if by_parts { 0.0 } else { (rigid.weight - spread) / (1.0 - spread) };
        if once != 0.0 {
            velocity.0 += (once * step * (pushed + gravity)).as_vec3();
            spin.0 += (once * step * turned).as_vec3();
        }
        increments.linear_increment += ((1.0 - once) * pushed - once * gravity).as_vec3();
        increments.angular_increment += ((1.0 - once) * turned).as_vec3();
    }
    // Avian's solver begins with the forces that the step expects. From those of its last step it
    // would not find the way to ones that are a hundred times as large.
    for (rigid, places) in list.0.iter().zip(&places.0) {
        let touched = rigid.supports.iter().any(|support| support.force > 0.0);
        for (support, (id, manifold, point)) in rigid.supports.iter().zip(places).filter(|_| touched) {
            let point = graph
                .get_mut_by_id(*id)
                .and_then(|(_, pair)| pair.manifolds.get_mut(*manifold)?.points.get_mut(*point));
            if let Some(point) = point {
                let impulse = support.force * f64::from_bits(rigid.key[1]) * step / parts;
                point.warm_start_normal_impulse = impulse as f32;
            }
        }
    }
}

/// Accelerations by contacts (m/s^2 and rad/s^2) with which rigid bodies fell asleep.
#[derive(Resource, Default)]
struct Asleep(BTreeMap<Entity, [DVec3; 2]>);

/// Wakes rigid bodies that sleep when what they lay on is gone.
fn wake(
    mut commands: Commands,
    mut asleep: ResMut<Asleep>,
    list: Res<RigidBodies>,
    sleepers: Query<Body, With<Sleeping>>,
    colliders: Query<&ColliderOf>,
    contacts: Query<(&BodyContacts, &Nearby)>,
) {
    asleep.0.retain(|entity, _| sleepers.contains(*entity));
    if asleep.0.is_empty() {
        return;
    }
    let touched = contacts.iter().flat_map(|(contacts, _)| &contacts.0);
    let mut held: BTreeSet<Entity> =
        touched.filter_map(|contact| colliders.get(contact.other).ok()).map(|of| of.body).collect();
    held.extend(contacts.iter().flat_map(|(_, nearby)| &nearby.attached));
    held.extend(list.0.iter().filter_map(|rigid| Entity::try_from_bits(rigid.key[0])));
    asleep.0.retain(|entity, last| {
        let stays = *last == [DVec3::ZERO; 2] || held.contains(entity);
        if !stays {
            commands.queue_silenced(WakeBody(*entity));
        }
        stays
    });
}
