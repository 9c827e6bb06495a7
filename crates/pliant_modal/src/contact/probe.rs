//! Probes: tools that a hand holds by a spring, and that press and stroke bodies.

use std::sync::Arc;

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

use super::{ObstacleShape, Place, Touched};
use crate::{Contacts, StepError, error::finite};

/// Speed of a target above which it was moved from elsewhere, m/s, and rad/s where it turns.
const TELEPORT: f64 = 100.0;

/// Largest number of places at which a probe is searched, corners and those between them, and the
/// largest number between two corners.
const MAX_SEEDS: usize = 64;
const MAX_BETWEEN: usize = 8;

/// Distance of two places of a probe below which they are one, as a share of the radius.
const SAME: f64 = 0.25;

/// Steps of the search for the place of a probe that is nearest to a surface.
const SLIDES: usize = 4;

/// Settings of a [`Probe`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProbeConfig {
    /// Radius of the ball, or by which the shape is rounded, m, above 0.
    pub radius: f64,
    /// Stiffness of the spring to the target, N/m, above 0. That against a turn is this times the
    /// square of [`Probe::lever`], N m.
    pub stiffness: f64,
    /// Relaxation time of the damper beside the spring, its damping over the stiffness, s, 0 or
    /// more.
    pub relaxation: f64,
    /// Coefficient of friction, 0 to [`Contacts::MAX_FRICTION`]. At a body, and at an
    /// obstacle that has one of its own, the geometric mean of both counts.
    pub friction: f64,
}

impl Default for ProbeConfig {
    /// A ball of 1 cm on a spring of 500 N/m without a damper, with the friction of a body.
    fn default() -> Self {
        Self { radius: 0.01, stiffness: 500.0, relaxation: 0.0, friction: Contacts::FRICTION }
    }
}

impl ProbeConfig {
    fn check(&self) -> Result<(), StepError> {
        let above = |what, x: f64| StepError::check(what, "above 0", x > 0.0 && x.is_finite(), x);
        above("radius of a probe", self.radius)?;
        above("stiffness of a probe", self.stiffness)?;
        let (relaxation, friction) = (self.relaxation, self.friction);
        let sound = relaxation.is_finite() && relaxation >= 0.0;
        StepError::check("relaxation of a probe", "0 or more", sound, relaxation)?;
        let sound = (0.0..=Contacts::MAX_FRICTION).contains(&friction);
        StepError::check("friction of a probe", "0 to 10", sound, friction)
    }
}

/// Something that a probe touches, or that is less than a radius away from it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProbeContact {
    /// The obstacle at this index of the probe's list, or the body.
    pub other: Touched,
    /// The nearest point of the surface at the end of the step, m, world axes. The dent which the
    /// modes leave out is not in it.
    pub point: [f64; 3],
    /// Outward normal of what is touched, world axes.
    pub normal: [f64; 3],
    /// Velocity of the surface over the step, m/s, world axes.
    pub velocity: [f64; 3],
    /// Compliance of the surface that is not in its motion, m/N, world axes: the dent.
    pub compliance: [[f64; 3]; 3],
    /// Coefficient of friction.
    pub friction: f64,
    /// Place of the probe that is nearest to the surface: the center of the sphere there, m from
    /// the tool point, axes of the probe.
    pub spot: [f64; 3],
    /// Force on the probe over the step, N, world axes. Zero where nothing touches.
    pub force: [f64; 3],
    /// Whether the contact slides.
    pub sliding: bool,
}

/// A place of a probe: the center of the sphere that touches there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Spot {
    /// Position from the tool point, m, axes of the probe.
    pub(crate) at: Vector3<f64>,
    /// Which of the places that stay it is: a corner, or one between two. `None` for a place that
    /// slides over the probe.
    pub(crate) fixed: Option<usize>,
}

impl Spot {
    /// Whether a contact at one is a contact at the other too.
    pub(crate) fn is_same(&self, other: &Self, radius: f64) -> bool {
        match (self.fixed, other.fixed) {
            (Some(one), Some(other)) => one == other,
            _ => (self.at - other.at).norm() < SAME * radius,
        }
    }
}

/// A contact of the last step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ProbeMemory {
    pub(crate) other: Touched,
    /// Force on the body, or on the probe at an obstacle, N, world axes.
    pub(crate) force: Vector3<f64>,
    /// Where it sticks, m, world axes: the material of the place relative to the sphere's center at
    /// a body, the sphere's center at an obstacle.
    pub(crate) anchor: Vector3<f64>,
    /// The place of the probe.
    pub(crate) spot: Spot,
    /// The place of the body.
    pub(crate) place: Option<Place>,
    /// A point and the normal of the surface, m, world axes.
    pub(crate) plane: [Vector3<f64>; 2],
}

/// A tool that a hand holds by a spring, and that touches bodies and obstacles without gripping.
///
/// The tool is a ball, or the convex hull of some points, rounded by a radius
/// ([`Probe::set_corners`]): two make a capsule, eight a box. The spring ties the tool to its
/// target, as the virtual coupling of a haptic device does. The tool has no mass: under the force
/// `f` of what it touches, its point is at
///
/// ```text
/// y = x* + f h / (k (h + r))        x* = target + (y_before - target_before) r / (r + h)
/// ```
///
/// with the stiffness `k`, the relaxation time `r` and the step `h`. In the same way the torque
/// about that point turns it against `k l^2`, with the distance `l` of the farthest corner
/// ([`Probe::lever`]): a force on that corner moves it by the turn as far as by the way. A ball
/// does not turn. [`Islands::step_with`](crate::Islands::step_with) solves this with all contacts
/// of the step, so the forces on a body and on the probe are equal and opposite, and the probe
/// stays on the surface while the target goes in. It touches each body and each obstacle with the
/// corners that are near, and with the place between them that is nearest; each body also with
/// places between the corners, one for each of its sites. In a groove of a body the corners and the
/// places between them touch both sides: a body has at most two contacts with each of up to 64
/// places that stay.
#[derive(Debug, Clone)]
pub struct Probe {
    config: ProbeConfig,
    obstacles: Vec<Arc<dyn ObstacleShape>>,
    /// The corners, and then the places between them at which the search begins, m, own axes.
    seeds: Vec<Vector3<f64>>,
    corners: usize,
    /// The corners as they were given, m, own axes.
    shape: Vec<[f64; 3]>,
    /// Distance of the farthest corner from the tool point, m. Zero of a ball.
    farthest: f64,
    target: Vector3<f64>,
    last_target: Option<Vector3<f64>>,
    pub(crate) position: Vector3<f64>,
    /// Rotation from own to world axes: of the target, of the last one, and of the probe at the
    /// beginning of the step, at its end without contact, and at its end.
    turned: UnitQuaternion<f64>,
    last_turned: UnitQuaternion<f64>,
    start_rotation: UnitQuaternion<f64>,
    free_rotation: UnitQuaternion<f64>,
    rotation: UnitQuaternion<f64>,
    torque: Vector3<f64>,
    pub(crate) contacts: Vec<ProbeContact>,
    pub(crate) memory: Vec<ProbeMemory>,
    /// Position at the beginning of the step and at its end without contact, m, and displacement
    /// for a force, m/N.
    pub(crate) start: Vector3<f64>,
    free: Vector3<f64>,
    pub(crate) compliance: f64,
    /// The bodies near the probe in this step, by index.
    pub(crate) near: Vec<usize>,
}

impl Probe {
    /// Largest number of corners.
    pub const MAX_CORNERS: usize = 16;

    /// Makes a ball at `target` (m, world axes).
    ///
    /// # Errors
    /// Returns [`StepError::Input`] for a number that is not finite or out of range.
    pub fn new(config: ProbeConfig, target: [f64; 3]) -> Result<Self, StepError> {
        config.check()?;
        finite("target of a probe", &target)?;
        let target = Vector3::from(target);
        Ok(Self {
            config,
            obstacles: Vec::new(),
            seeds: vec![Vector3::zeros()],
            corners: 1,
            shape: vec![[0.0; 3]],
            farthest: 0.0,
            target,
            last_target: None,
            position: target,
            turned: UnitQuaternion::identity(),
            last_turned: UnitQuaternion::identity(),
            start_rotation: UnitQuaternion::identity(),
            free_rotation: UnitQuaternion::identity(),
            rotation: UnitQuaternion::identity(),
            torque: Vector3::zeros(),
            contacts: Vec::with_capacity(8),
            memory: Vec::with_capacity(8),
            start: target,
            free: target,
            compliance: 1.0 / config.stiffness,
            near: Vec::with_capacity(8),
        })
    }

    /// The settings.
    pub fn config(&self) -> &ProbeConfig {
        &self.config
    }

    /// Changes the settings. The contacts go on.
    ///
    /// # Errors
    /// Returns the errors of [`Probe::new`]. The old settings then stay.
    pub fn configure(&mut self, config: ProbeConfig) -> Result<(), StepError> {
        config.check()?;
        let other = config.radius != self.config.radius;
        self.config = config;
        if other && self.shape.len() > 1 {
            self.plant();
        }
        Ok(())
    }

    /// Makes the probe the convex hull of these points (m from the tool point, own axes), rounded
    /// by the radius. One point at the origin, as at first, is a ball, and two points a capsule.
    /// Another shape begins its contacts anew.
    ///
    /// # Errors
    /// Returns [`StepError::Input`] for a number that is not finite, for no points and for more
    /// than [`Probe::MAX_CORNERS`]. The old shape then stays.
    pub fn set_corners(&mut self, corners: &[[f64; 3]]) -> Result<(), StepError> {
        corners.iter().try_for_each(|corner| finite("corner of a probe", corner))?;
        let count = corners.len();
        let some = (1..=Self::MAX_CORNERS).contains(&count);
        StepError::check("number of corners of a probe", "1 to 16", some, count as f64)?;
        if self.shape != corners {
            self.shape.clear();
            self.shape.extend_from_slice(corners);
            self.plant();
        }
        Ok(())
    }

    /// Finds the places that stay, and begins the contacts anew.
    fn plant(&mut self) {
        let apart = SAME * self.config.radius;
        self.seeds.clear();
        for corner in self.shape.iter().map(|corner| Vector3::from(*corner)) {
            // Corners in one place are one.
            if !self.seeds.iter().any(|other| (other - corner).norm() < apart) {
                self.seeds.push(corner);
            }
        }
        let count = self.seeds.len();
        self.corners = count;
        self.farthest = self.seeds.iter().map(Vector3::norm).fold(0.0, f64::max);
        let pairs = count * (count - 1) / 2;
        let most = (MAX_SEEDS - count).checked_div(pairs).map_or(0, |most| most.clamp(1, MAX_BETWEEN));
        for a in 0..count {
            for b in a + 1..count {
                let (from, way) = (self.seeds[a], self.seeds[b] - self.seeds[a]);
                let between = (way.norm() / (2.0 * self.config.radius)).ceil().max(1.0) as usize;
                let parts = between.min(most) + 1;
                for k in 1..parts {
                    let seed = from + way * (k as f64 / parts as f64);
                    // The middles of the diagonals of a box are one.
                    let near = |other: &Vector3<f64>| (other - seed).norm() < apart;
                    if self.seeds.len() < MAX_SEEDS && !self.seeds.iter().any(near) {
                        self.seeds.push(seed);
                    }
                }
            }
        }
        // Each place may touch both sides of a groove.
        let room = 2 * self.seeds.len() + 1;
        self.contacts.reserve(room);
        self.memory.reserve(room);
        self.forget();
    }

    /// The corners, m from the tool point, own axes.
    pub(crate) fn corners(&self) -> &[Vector3<f64>] {
        &self.seeds[..self.corners]
    }

    /// The places that stay: the corners, and then those between them.
    pub(crate) fn spots(&self) -> impl Iterator<Item = Spot> + '_ {
        self.seeds.iter().enumerate().map(|(number, at)| Spot { at: *at, fixed: Some(number) })
    }

    /// Whether a place that stays lies between corners.
    pub(crate) fn is_between(&self, spot: &Spot) -> bool {
        spot.fixed.is_some_and(|number| number >= self.corners)
    }

    /// Moves the target of the spring (m, world axes). A target faster than 100 m/s is a teleport:
    /// the probe is then at the target, and its contacts begin anew.
    ///
    /// # Errors
    /// Returns [`StepError::Input`] for a target that is not finite. The old one then stays.
    pub fn set_target(&mut self, target: [f64; 3]) -> Result<(), StepError> {
        finite("target of a probe", &target)?;
        self.target = target.into();
        Ok(())
    }

    /// Turns the target (unit quaternion x, y, z, w from own to world axes). A target that turns
    /// faster than 100 rad/s is a teleport.
    ///
    /// # Errors
    /// Returns [`StepError::Input`] for numbers that are not finite or of no length. The old
    /// rotation then stays.
    pub fn set_rotation(&mut self, rotation: [f64; 4]) -> Result<(), StepError> {
        finite("rotation of a probe", &rotation)?;
        let [x, y, z, w] = rotation;
        let length = Vector3::new(x, y, z).norm().hypot(w);
        let turned = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-9);
        StepError::check("rotation of a probe", "of length 1", turned.is_some(), length)?;
        self.turned = turned.unwrap_or(self.turned);
        Ok(())
    }

    /// The target of the spring, m, world axes.
    pub fn target(&self) -> [f64; 3] {
        self.target.into()
    }

    /// Sets the rigid obstacles that the probe touches. Contacts with an obstacle go on with the
    /// one at the same index of the new list.
    ///
    /// # Errors
    /// Returns the error of [`ObstacleShape::check`]. The old obstacles then stay.
    pub fn set_obstacles(&mut self, obstacles: Vec<Arc<dyn ObstacleShape>>) -> Result<(), StepError> {
        obstacles.iter().try_for_each(|obstacle| obstacle.check())?;
        self.obstacles = obstacles;
        Ok(())
    }

    pub(crate) fn obstacles(&self) -> &[Arc<dyn ObstacleShape>] {
        &self.obstacles
    }

    /// Position of the tool point, the center of a ball, m, world axes.
    pub fn position(&self) -> [f64; 3] {
        self.position.into()
    }

    /// Rotation from own to world axes, unit quaternion x, y, z, w.
    pub fn rotation(&self) -> [f64; 4] {
        let q = self.rotation.quaternion();
        [q.i, q.j, q.k, q.w]
    }

    /// Distance of the farthest point of the shape from the tool point, m.
    pub fn extent(&self) -> f64 {
        self.farthest + self.config.radius
    }

    /// The length whose square times the stiffness resists a turn, m: the distance of the farthest
    /// corner from the tool point, or the radius if that is more. Zero of a ball, which does not
    /// turn.
    pub fn lever(&self) -> f64 {
        if self.turns() { self.farthest.max(self.config.radius) } else { 0.0 }
    }

    fn turns(&self) -> bool {
        self.farthest > 0.0
    }

    /// What the probe touches and what is near it, after a step.
    pub fn contacts(&self) -> &[ProbeContact] {
        &self.contacts
    }

    /// Sum of the forces on the probe over the last step, N, world axes. It is the force of the
    /// spring and its damper on the hand.
    pub fn force(&self) -> [f64; 3] {
        let sum = self.contacts.iter().fold(Vector3::zeros(), |sum, c| sum + Vector3::from(c.force));
        sum.into()
    }

    /// Torque of these forces about the tool point, N m, world axes: that of the spring against
    /// turning on the hand. Zero of a ball, which no force turns.
    pub fn torque(&self) -> [f64; 3] {
        self.torque.into()
    }

    /// Places the probe at its target and forgets its contacts.
    pub fn forget(&mut self) {
        self.last_target = None;
        (self.position, self.start, self.free) = (self.target, self.target, self.target);
        self.last_turned = self.turned;
        (self.rotation, self.start_rotation, self.free_rotation) = (self.turned, self.turned, self.turned);
        self.torque = Vector3::zeros();
        self.memory.clear();
        self.contacts.clear();
    }

    /// Begins a step of `h` seconds. Returns how far a point of the probe may go in it, m.
    pub(crate) fn begin_step(&mut self, h: f64) -> f64 {
        let last = self.last_target.unwrap_or(self.target);
        // No turn is by more than half of one.
        let turned = self.turns() && self.turned.angle_to(&self.last_turned) > (TELEPORT * h).min(3.0);
        if self.last_target.is_none() || turned || (self.target - last).norm() > TELEPORT * h {
            self.forget();
        }
        let stretch = self.position - self.last_target.unwrap_or(self.target);
        let ProbeConfig { stiffness, relaxation, .. } = self.config;
        let left = relaxation / (relaxation + h);
        self.start = self.position;
        self.free = self.target + stretch * left;
        self.compliance = h / (stiffness * (h + relaxation));
        self.last_target = Some(self.target);
        let way = (self.free - self.start).norm();
        self.start_rotation = self.rotation;
        if self.turns() {
            let stretch = (self.rotation * self.last_turned.inverse()).scaled_axis();
            self.free_rotation = UnitQuaternion::from_scaled_axis(stretch * left) * self.turned;
        } else {
            self.free_rotation = self.turned;
        }
        self.last_turned = self.turned;
        way + self.farthest * self.free_rotation.angle_to(&self.start_rotation)
    }

    /// Moves the probe to where a force on it (N, world axes) and its torque about the tool point
    /// (N m) let it be at the end of the step.
    pub(crate) fn respond(&mut self, force: &Vector3<f64>, torque: &Vector3<f64>) {
        self.position = self.free + self.compliance * force;
        let turn = self.turning() * torque;
        self.rotation = UnitQuaternion::from_scaled_axis(turn) * self.free_rotation;
    }

    /// Sets the torque of the step. A ball has none.
    pub(crate) fn set_torque(&mut self, torque: Vector3<f64>) {
        self.torque = if self.turns() { torque } else { Vector3::zeros() };
    }

    /// Number of the coordinates of the spring in a solve.
    pub(crate) fn width(&self) -> usize {
        if self.turns() { 6 } else { 3 }
    }

    /// Turn for a torque, rad/(N m).
    pub(crate) fn turning(&self) -> f64 {
        if self.turns() { self.compliance / self.lever().powi(2) } else { 0.0 }
    }

    /// Whether all numbers are finite.
    pub(crate) fn is_finite(&self) -> bool {
        self.position.iter().chain(self.rotation.coords.iter()).all(|x| x.is_finite())
    }

    /// Center of the sphere at a place, m, world axes, at the beginning of the step.
    pub(crate) fn begun(&self, spot: &Vector3<f64>) -> Vector3<f64> {
        if self.turns() { self.start + self.start_rotation * spot } else { self.start }
    }

    /// Center of the sphere at a place, m, world axes, at the end of the computed step.
    pub(crate) fn ended(&self, spot: &Vector3<f64>) -> Vector3<f64> {
        if self.turns() { self.position + self.rotation * spot } else { self.position }
    }

    /// From the tool point to where a surface with this outward normal touches the sphere at a
    /// place, m, world axes, at the beginning and at the end of the computed step.
    pub(crate) fn arms(&self, spot: &Vector3<f64>, normal: &Vector3<f64>) -> [Vector3<f64>; 2] {
        let below = self.config.radius * normal;
        [self.start_rotation * spot - below, self.rotation * spot - below]
    }

    /// Where the sphere's center would be at the end of the step if it had gone as the material of
    /// the probe that touches, m, world axes.
    pub(crate) fn carried(&self, spot: &Vector3<f64>, normal: &Vector3<f64>) -> Vector3<f64> {
        if !self.turns() {
            return self.position;
        }
        let [arm, _] = self.arms(spot, normal);
        let turn = self.rotation * self.start_rotation.inverse();
        self.begun(spot) + (self.position - self.start) + (turn * arm - arm)
    }

    /// The place of the probe that is nearest to a surface, from `spot` on and no farther than
    /// `most` (m), with the probe as it is at the beginning of the step or at its end. `look`
    /// returns the distance (m) and the outward normal of the surface that is nearest to a point
    /// (m, world axes), if any is near.
    ///
    /// A step leads towards the corner that lies lowest along the normal, to where the distance
    /// grows again. Where that corner is farther from the surface and the distance falls there, it
    /// is on the way to something else, and what is near is before it.
    pub(crate) fn slide(
        &self,
        spot: &Vector3<f64>,
        most: f64,
        is_ended: bool,
        mut look: impl FnMut(&Vector3<f64>) -> Result<Option<(f64, Vector3<f64>)>, StepError>,
    ) -> Result<Vector3<f64>, StepError> {
        let turn = if is_ended { self.rotation } else { self.start_rotation };
        let mut look = |spot: &Vector3<f64>| {
            let point = if is_ended { self.ended(spot) } else { self.begun(spot) };
            Ok::<_, StepError>(look(&point)?.map(|(distance, normal)| (distance, turn.inverse() * normal)))
        };
        let (mut at, mut left) = (*spot, most);
        let Some((mut distance, mut normal)) = look(&at)? else { return Ok(at) };
        for _ in 0..SLIDES {
            let lowest = self.corners().iter().min_by(|a, b| normal.dot(a).total_cmp(&normal.dot(b)));
            let Some(mut way) = lowest.map(|lowest| lowest - at) else { break };
            let slope = normal.dot(&way);
            // Comparisons with no number are false.
            let falls = slope < -1e-4 * self.config.radius;
            if !falls || left <= 0.0 {
                break;
            }
            way *= (left / way.norm()).min(1.0);
            let mut there = look(&(at + way))?;
            let is_beyond = |there: &Option<(f64, Vector3<f64>)>, way: &Vector3<f64>| {
                there.is_none_or(|(farther, next)| farther > distance && next.dot(way) <= 0.0)
            };
            while is_beyond(&there, &way) && way.norm() > SAME * self.config.radius {
                way *= 0.5;
                there = look(&(at + way))?;
            }
            let Some((mut least, mut next)) = there else { break };
            let (slope, rises) = (normal.dot(&way), next.dot(&way));
            if rises > 0.0 {
                way *= slope / (slope - rises);
                let Some(found) = look(&(at + way))? else { break };
                (least, next) = found;
            }
            at += way;
            left -= way.norm();
            (distance, normal) = (least, next);
        }
        Ok(at)
    }

    /// The compliance of what is rigid: a small share of the spring's, so that no law is singular.
    pub(crate) fn rigid(&self) -> Matrix3<f64> {
        Matrix3::identity() * (1e-3 * self.compliance)
    }
}

/// An obstacle around which the center of a sphere moves.
#[derive(Debug)]
pub(crate) struct Grown<'a> {
    pub(crate) shape: &'a dyn ObstacleShape,
    pub(crate) by: f64,
}

impl ObstacleShape for Grown<'_> {
    fn at(&self, point: &Vector3<f64>) -> super::SurfacePoint {
        let found = self.shape.at(point);
        super::SurfacePoint { distance: found.distance - self.by, ..found }
    }
}
