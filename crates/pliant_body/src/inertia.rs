//! Anchored bodies feel how their entities move.
//!
//! The motion comes from the way of the entity between two looks at it, one in every tick. A
//! transform is written in the fixed loop, so that its ways belong to ticks, or once per frame, so
//! that they belong to frames. A way is divided by the time that belongs to it: a constant velocity
//! is then constant at every frame rate, whatever the ticks are.

use bevy::{
    math::{Affine3A, DQuat, DVec3},
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
/// gives no force, at any frame rate, and the sum of the forces over time is that of the motion. A
/// body feels what is written in the fixed loop in the same tick, if it is written before
/// [`PliantSystems::Input`](crate::PliantSystems::Input), and otherwise in the next. It feels what
/// is written once per frame one and a half frames and half a tick later. Bodies that are not
/// stepped in the fixed loop need the order before that set.
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

/// A way of an entity between two looks.
#[derive(Debug, Clone, Copy)]
struct Way {
    /// Time of its middle, and its duration, s.
    middle: f64,
    seconds: f64,
    /// Velocity (m/s) and angular velocity (rad/s), world axes.
    velocity: [DVec3; 2],
    /// Orientation in the middle.
    orientation: DQuat,
}

/// What a body knows of the motion of its entity.
#[derive(Component, Debug, Default)]
pub(crate) struct Ride {
    /// The last look.
    last: Option<Look>,
    /// Place at the end of the last tick.
    left: Option<Affine3A>,
    /// Whether the entity has moved outside of the fixed loop since the last look.
    outside: bool,
    /// Whether the entity is moved in ticks, and not once per frame.
    by_tick: bool,
    /// The last ways, oldest first.
    ways: Vec<Way>,
    /// Time by which the body feels the motion late, s.
    delay: f64,
    /// Velocities and time up to which the motion has acted on the body. `None` before the first
    /// way.
    applied: Option<[DVec3; 2]>,
    applied_until: f64,
    /// Whether all ways and what has acted are zero, so that nothing comes before the entity moves.
    stands: bool,
}

impl Ride {
    /// Number of ways that are kept, more than fit into the longest delay.
    const WAYS: usize = 6;

    /// Takes a look at an entity that stood and has not moved since. Returns whether it is one:
    /// [`Ride::look`] would then find no motion.
    fn still_stands(&mut self, affine: &Affine3A, [tick, frame]: [f64; 2], late: [f64; 2]) -> bool {
        let Some(last) = self.last.as_mut().filter(|last| self.stands && is_same(affine, &last.affine))
        else {
            return false;
        };
        if self.outside {
            return false;
        }
        let (before, now) = if self.by_tick { (last.tick, tick) } else { (last.frame, frame) };
        (last.tick, last.frame) = (tick, frame);
        // Of the ways without a motion only the newest one matters, as that from which a motion
        // begins.
        if let (Some(way), true) = (self.ways.last_mut(), now > before) {
            (way.seconds, way.middle) = (now - before, 0.5 * (now + before));
        }
        self.wait(tick, late);
        true
    }

    /// Moves the time up to which the motion acts to that of a tick, s. `late` is the delay that
    /// follows from the lengths of the last tick and of the last frame, for motion by ticks and by
    /// frames.
    fn wait(&mut self, tick: f64, late: [f64; 2]) {
        let late = late[usize::from(!self.by_tick)];
        // Frames differ in length.
        self.delay = if self.delay > 0.0 { 0.9 * self.delay + 0.1 * late } else { late };
        self.applied_until = (tick - self.delay).max(self.applied_until);
    }

    /// Takes a look, and returns the motion over the step that comes, in world lengths.
    ///
    /// Velocities belong to the middles of ways, and change evenly from middle to middle. Where
    /// frames and ticks differ, the body feels them some time late, so that there always is a next
    /// middle. The forces are then as smooth as the motion.
    fn look(&mut self, now: Look, step: f64, late: [f64; 2], teleported: bool) -> FrameMotion {
        let moved = std::mem::take(&mut self.outside);
        self.stands = false;
        let Some(last) = self.last.replace(now) else { return FrameMotion::default() };
        let is_still = !moved && is_same(&now.affine, &last.affine);
        if !is_still && self.by_tick == moved {
            self.by_tick = !moved;
            self.ways.clear();
            (self.applied_until, self.delay) = (0.0, 0.0);
        }
        let time = |look: &Look| if self.by_tick { look.tick } else { look.frame };
        let seconds = time(&now) - time(&last);
        // Without a frame since the last look, the entity goes on as it did.
        if seconds > 0.0 || teleported {
            let way = match is_still {
                true => Some([DVec3::ZERO; 2]),
                false => now.pose.velocity_since(&last.pose, seconds),
            };
            let way = way.filter(|_| !teleported);
            if way.is_none() {
                // What was turned goes on ahead.
                let turn = now.pose.orientation * last.pose.orientation.inverse();
                self.applied = self.applied.map(|applied| applied.map(|velocity| turn * velocity));
                for way in &mut self.ways {
                    way.velocity = way.velocity.map(|velocity| turn * velocity);
                    way.orientation = turn * way.orientation;
                }
            }
            let ahead = self.ways.last().map(|way| way.velocity).or(self.applied);
            let from = if way.is_some() { last.pose.orientation } else { now.pose.orientation };
            if let (Some(velocity), true) = (way.or(ahead), seconds > 0.0) {
                if self.ways.len() == Self::WAYS {
                    self.ways.remove(0);
                }
                let middle = time(&now) - 0.5 * seconds;
                let orientation = from.slerp(now.pose.orientation, 0.5);
                self.ways.push(Way { middle, seconds, velocity, orientation });
            }
        }
        let applied_until = self.applied_until;
        self.wait(now.tick, late);
        let until = self.applied_until;
        let middle = 0.5 * (until + applied_until.max(until - step));
        let (Some((velocity, orientation)), Some((_, axes))) = (self.at(until), self.at(middle)) else {
            return FrameMotion::default();
        };
        // Single precision does not know velocities better than this.
        let ulp = f64::from(f32::EPSILON);
        let shortest = self.ways.iter().map(|way| way.seconds).fold(f64::INFINITY, f64::min);
        let far = now.pose.origin.abs().max_element().max(last.pose.origin.abs().max_element());
        let unsure = [8.0 * ulp * far / shortest, 16.0 * ulp / shortest];
        let mut accelerations = [DVec3::ZERO; 2];
        // A body that begins on a moving entity moves with it.
        let applied = self.applied.get_or_insert(velocity);
        for (k, acceleration) in accelerations.iter_mut().enumerate() {
            let change = velocity[k] - applied[k];
            let stopped = velocity[k] == DVec3::ZERO && change != DVec3::ZERO;
            if stopped || change.length() > unsure[k] + 1e-6 * velocity[k].length() {
                applied[k] = velocity[k];
                *acceleration = axes.inverse() * (change / step);
            }
        }
        let none = [DVec3::ZERO; 2];
        let waits = self.ways.len() == Self::WAYS && self.ways.iter().all(|way| way.velocity == none);
        self.stands = waits && *applied == none;
        let [acceleration, angular_acceleration] = accelerations.map(Into::into);
        let angular_velocity = (orientation.inverse() * applied[1]).into();
        FrameMotion { acceleration, angular_velocity, angular_acceleration }
    }

    /// Velocities and orientation at a time, s, between the middles of the ways.
    fn at(&self, time: f64) -> Option<([DVec3; 2], DQuat)> {
        let after = self.ways.iter().position(|way| way.middle >= time);
        let next = after.map_or(self.ways.last(), |after| self.ways.get(after))?;
        let before = after.and_then(|after| self.ways.get(after.checked_sub(1)?));
        let Some(before) = before else { return Some((next.velocity, next.orientation)) };
        let share = (time - before.middle) / (next.middle - before.middle);
        let velocity = [0, 1].map(|k| before.velocity[k].lerp(next.velocity[k], share));
        Some((velocity, before.orientation.slerp(next.orientation, share)))
    }
}

fn is_same(a: &Affine3A, b: &Affine3A) -> bool {
    a.to_cols_array().map(f32::to_bits) == b.to_cols_array().map(f32::to_bits)
}

/// An entity whose motion is looked at.
type Rider = (Entity, &'static Transform, Has<ChildOf>);

/// Where an entity is by the transforms as they are now. Its `GlobalTransform` is that of the last
/// frame.
fn place((entity, local, is_child): (Entity, &Transform, bool), all: &TransformHelper) -> Option<Affine3A> {
    match is_child {
        true => all.compute_global_transform(entity).ok().map(|global| global.affine()),
        false => Some(local.compute_affine()),
    }
}

fn pose(affine: &Affine3A) -> Option<Pose> {
    let (_, rotation, translation) = affine.to_scale_rotation_translation();
    let pose = Pose { origin: translation.as_dvec3(), orientation: rotation.as_dquat().normalize() };
    (pose.origin.is_finite() && pose.orientation.is_finite()).then_some(pose)
}

/// Notes which entities have moved since the last tick: outside of the fixed loop.
pub(crate) fn begin_tick(transforms: TransformHelper, mut rides: Query<(Rider, &mut Ride), With<BodyState>>) {
    for (rider, mut ride) in &mut rides {
        // Bodies that feel no motion are not looked at.
        let Some(left) = ride.left.filter(|_| ride.last.is_some()) else { continue };
        if place(rider, &transforms).is_some_and(|now| !is_same(&left, &now)) {
            ride.outside = true;
        }
    }
}

/// Notes where the entities are at the end of a tick.
pub(crate) fn end_tick(transforms: TransformHelper, mut rides: Query<(Rider, &mut Ride), With<BodyState>>) {
    for (rider, mut ride) in rides.iter_mut().filter(|(_, ride)| ride.last.is_some()) {
        ride.left = place(rider, &transforms);
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
    mut bodies: Query<(NameOrEntity, Rider, &Inertia, &Driven, &mut Ride, &mut BodyState), With<ModalBody>>,
) {
    let teleports: Vec<Entity> = teleports.read().map(|teleport| teleport.0).collect();
    let step = time.delta_secs_f64();
    let tick = time.elapsed_secs_f64();
    let frame_length = frames.delta_secs_f64();
    let frame = frames.elapsed_secs_f64() - frame_length;
    // The middle of the last way is at most so old.
    let late = [0.5 * step, 1.5 * frame_length + 0.5 * step];
    for (name, rider, inertia, driven, mut ride, mut state) in &mut bodies {
        let factor = inertia.factor();
        if *driven != Driven::Local || state.model().is_free() || factor <= 0.0 {
            if ride.last.is_some() {
                *ride = Ride::default();
            }
            continue;
        }
        let affine = place(rider, &transforms);
        let stood = |affine: &Affine3A| ride.still_stands(affine, [tick, frame], late);
        if teleports.is_empty() && affine.as_ref().is_some_and(stood) {
            continue;
        }
        let Some((affine, pose)) = affine.and_then(|affine| Some((affine, pose(&affine)?))) else {
            *ride = Ride::default();
            continue;
        };
        let on_it = |of: Entity| teleports.contains(&of);
        let teleported =
            !teleports.is_empty() && (on_it(name.entity) || parents.iter_ancestors(name.entity).any(on_it));
        let look = Look { affine, pose, tick, frame };
        let FrameMotion { acceleration, angular_velocity, angular_acceleration } =
            ride.look(look, step, late, teleported);
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
