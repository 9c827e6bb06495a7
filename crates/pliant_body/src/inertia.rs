//! Anchored bodies feel how their entities move.
//!
//! The motion comes from the way of the entity between two looks at it, one in every tick. A
//! transform is written in the fixed loop, so that its ways belong to ticks, or once per frame, so
//! that they belong to frames. A way is divided by the time that belongs to it: constant velocity
//! is then constant at every frame rate, whatever the ticks are.

use bevy::{
    math::{Affine3A, DVec3},
    prelude::*,
};
use pliant_modal::FrameMotion;

use crate::{BodyError, BodyState, Driven, ModalBody, Pose, step::Refusals};

/// How strongly an anchored body feels that its entity moves. Default: 1, as it is in nature.
///
/// Acceleration and turning of the entity, through all its parents, act on the mass of the body: a
/// character's ears wobble as it walks. The number multiplies these forces. With 0, and with a
/// number that is negative or not finite, the anchors move without inertia. [`ModalBody`] brings
/// the component along. Free bodies, whose motion is their own, do not use it, nor do bodies that
/// this app does not step ([`Driven::Remote`]): those of guests and of peers.
///
/// Transforms may be written in the fixed loop or once per frame. A velocity that does not change
/// gives no force, at any frame rate. A change of velocity is passed on within the longer of a tick
/// and a frame. The sum of the forces over time is always that of the motion. In the fixed loop,
/// whatever moves the entity is best ordered before
/// [`PliantSystems::Input`](crate::PliantSystems::Input), otherwise the body feels it one tick
/// later. If the bodies are not stepped in the fixed loop, it must be.
///
/// A way faster than 100 m/s, or a turn faster than 100 rad/s, is a teleport and has no effect.
/// [`Teleport`] announces a shorter one. What the entity does while time is paused has none either.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
#[require(Ride)]
pub struct Inertia(pub f32);

impl Default for Inertia {
    fn default() -> Self {
        Self(1.0)
    }
}

impl Inertia {
    /// Factor of the forces, 0 or more.
    fn factor(self) -> f64 {
        if self.0.is_finite() { f64::from(self.0).max(0.0) } else { 0.0 }
    }
}

/// Announces that an entity has been set to another place, so that the bodies on it and below it do
/// not feel its way there.
///
/// Write the message when you write the transform, in the same frame or tick. Ways that no body
/// could follow are known as teleports without it, see [`Inertia`].
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_body::Teleport;
/// # #[derive(Component)]
/// # struct Player;
/// fn respawn(mut players: Query<(Entity, &mut Transform), With<Player>>, mut teleports: MessageWriter<Teleport>) {
///     for (player, mut transform) in &mut players {
///         transform.translation = Vec3::ZERO;
///         teleports.write(Teleport(player));
///     }
/// }
/// ```
#[derive(Message, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct Teleport(pub Entity);

impl Pose {
    /// Speed (m/s) and turning speed (rad/s) above which a way is a teleport.
    pub const TELEPORT: f64 = 100.0;

    /// Velocity (m/s) and angular velocity (rad/s), world axes, of the way from `before` to here in
    /// `seconds`. `None` for a teleport: a way faster than [`Pose::TELEPORT`].
    pub fn velocity_since(&self, before: &Self, seconds: f64) -> Option<[DVec3; 2]> {
        let turn = (self.orientation * before.orientation.inverse()).normalize();
        // Of the two quaternions of a turn this is the one of the shorter way.
        let turn = if turn.w < 0.0 { -turn } else { turn };
        let ways = [self.origin - before.origin, turn.to_scaled_axis()].map(|way| way / seconds);
        ways.iter().all(|way| way.length() <= Self::TELEPORT).then_some(ways)
    }
}

/// A look at an entity.
#[derive(Debug, Clone, Copy)]
struct Look {
    affine: Affine3A,
    pose: Pose,
    /// Time of the tick, and of the end of the frame before, s.
    tick: f64,
    frame: f64,
}

/// What a body knows of the motion of its entity.
#[derive(Component, Debug, Default)]
pub(crate) struct Ride {
    /// The last look.
    last: Option<Look>,
    /// Place at the end of the last tick. `None`: nothing that is known.
    left: Option<Affine3A>,
    /// Whether the entity has moved outside of the fixed loop since the last look.
    outside: bool,
    /// Whether the entity is moved once per frame.
    by_frame: bool,
    /// Velocity and angular velocity on the last way, and their time, world axes, m/s and rad/s.
    measured: Option<([DVec3; 2], f64)>,
    /// The same, as far as the body has felt them.
    felt: [DVec3; 2],
}

impl Ride {
    /// Takes a look, and returns the motion over the step that comes, in world lengths.
    fn look(&mut self, now: Look, step: f64, teleported: bool) -> FrameMotion {
        let moved = std::mem::take(&mut self.outside);
        let Some(last) = self.last.replace(now) else { return FrameMotion::default() };
        if moved || !is_same(&now.affine, &last.affine) {
            self.by_frame = moved;
        }
        let seconds = if self.by_frame { now.frame - last.frame } else { now.tick - last.tick };
        // Without a frame since the last look, the entity goes on as it did.
        if seconds > 0.0 || teleported {
            match now.pose.velocity_since(&last.pose, seconds).filter(|_| !teleported) {
                Some(ways) => {
                    if self.measured.is_none() {
                        // A body that begins on a moving entity moves with it.
                        self.felt = ways;
                    }
                    self.measured = Some((ways, seconds));
                }
                None => {
                    // What moves ahead goes on ahead after it was turned.
                    let turn = now.pose.orientation * last.pose.orientation.inverse();
                    let turned = |ways: [DVec3; 2]| ways.map(|way| turn * way);
                    self.measured = self.measured.map(|(ways, seconds)| (turned(ways), seconds));
                    self.felt = turned(self.felt);
                }
            }
        }
        let Some((ways, seconds)) = self.measured else { return FrameMotion::default() };
        // Single precision does not know velocities better than this.
        let ulp = f64::from(f32::EPSILON);
        let far = now.pose.origin.abs().max_element().max(last.pose.origin.abs().max_element());
        let unsure = [8.0 * ulp * far / seconds, 16.0 * ulp / seconds];
        let share = (step / seconds).min(1.0);
        let mut accelerations = [DVec3::ZERO; 2];
        for (k, acceleration) in accelerations.iter_mut().enumerate() {
            let change = ways[k] - self.felt[k];
            if change.length() > unsure[k] + 1e-6 * ways[k].length() {
                self.felt[k] += share * change;
                *acceleration = share * change / step;
            }
        }
        // A change between two ways belongs to the moment between them.
        let [acceleration, turning] = accelerations.map(|change| last.pose.orientation.inverse() * change);
        let spin = now.pose.orientation.inverse() * self.felt[1];
        FrameMotion {
            acceleration: acceleration.into(),
            angular_velocity: spin.into(),
            angular_acceleration: turning.into(),
        }
    }
}

fn is_same(a: &Affine3A, b: &Affine3A) -> bool {
    a.to_cols_array().map(f32::to_bits) == b.to_cols_array().map(f32::to_bits)
}

/// Notes which entities have moved since the last tick: outside of the fixed loop.
pub(crate) fn begin_tick(
    transforms: TransformHelper,
    mut rides: Query<(Entity, &mut Ride), With<BodyState>>,
) {
    for (entity, mut ride) in &mut rides {
        let Ok(now) = transforms.compute_global_transform(entity) else { continue };
        ride.outside |= ride.left.is_some_and(|left| !is_same(&left, &now.affine()));
    }
}

/// Notes where the entities are at the end of a tick.
pub(crate) fn end_tick(transforms: TransformHelper, mut rides: Query<(Entity, &mut Ride), With<BodyState>>) {
    for (entity, mut ride) in &mut rides {
        ride.left = transforms.compute_global_transform(entity).ok().map(|now| now.affine());
    }
}

/// Forgets the way of a paused frame.
pub(crate) fn forget_paused(time: Res<Time<Virtual>>, mut rides: Query<&mut Ride>) {
    if time.delta().is_zero() {
        rides.iter_mut().for_each(|mut ride| ride.last = None);
    }
}

/// Passes the motion of the entities to the solver.
pub(crate) fn ride(
    time: Res<Time>,
    frames: Res<Time<Virtual>>,
    transforms: TransformHelper,
    parents: Query<&ChildOf>,
    mut teleports: MessageReader<Teleport>,
    mut refusals: Refusals,
    mut bodies: Query<(NameOrEntity, &Inertia, &Driven, &mut Ride, &mut BodyState), With<ModalBody>>,
) {
    let teleports: Vec<Entity> = teleports.read().map(|teleport| teleport.0).collect();
    let step = time.delta_secs_f64();
    let tick = time.elapsed_secs_f64();
    let frame = frames.elapsed_secs_f64() - frames.delta_secs_f64();
    for (name, inertia, driven, mut ride, mut state) in &mut bodies {
        let factor = inertia.factor();
        let global = transforms.compute_global_transform(name.entity).ok();
        let global = global.filter(|global| global.affine().is_finite());
        let felt = *driven == Driven::Local && !state.model().is_free() && factor > 0.0;
        let Some(global) = global.filter(|_| felt) else {
            *ride = Ride::default();
            continue;
        };
        let (_, rotation, translation) = global.to_scale_rotation_translation();
        let pose = Pose { origin: translation.as_dvec3(), orientation: rotation.as_dquat().normalize() };
        let on_it = |of: Entity| teleports.contains(&of);
        let teleported =
            !teleports.is_empty() && (on_it(name.entity) || parents.iter_ancestors(name.entity).any(on_it));
        let look = Look { affine: global.affine(), pose, tick, frame };
        let FrameMotion { acceleration, angular_velocity, angular_acceleration } =
            ride.look(look, step, teleported);
        let times = |vector: [f64; 3], factor: f64| vector.map(|x| factor * x);
        let motion = FrameMotion {
            acceleration: times(acceleration, factor / state.scale),
            // The force of a spin grows with its square.
            angular_velocity: times(angular_velocity, factor.sqrt()),
            angular_acceleration: times(angular_acceleration, factor),
        };
        if motion != FrameMotion::default()
            && let Err(error) = state.body_mut().set_frame_motion(motion)
        {
            refusals.report(&name, name.entity, BodyError::Step(error));
        }
    }
}
