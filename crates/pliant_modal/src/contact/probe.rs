//! Probes: balls that a hand holds by a spring, and that press and stroke bodies.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use super::{ObstacleShape, Place, Touched};
use crate::{Contacts, StepError, error::finite};

/// Speed of a target above which it was moved from elsewhere, m/s.
const TELEPORT: f64 = 100.0;

/// Settings of a [`Probe`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProbeConfig {
    /// Radius of the ball, m, above 0.
    pub radius: f64,
    /// Stiffness of the spring to the target, N/m, above 0.
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
    /// Force on the probe over the step, N, world axes. Zero where nothing touches.
    pub force: [f64; 3],
    /// Whether the contact slides.
    pub sliding: bool,
}

/// A contact of the last step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ProbeMemory {
    pub(crate) other: Touched,
    /// Force on the body, or on the probe at an obstacle, N, world axes.
    pub(crate) force: Vector3<f64>,
    /// Where it sticks, m, world axes: the material of the place relative to the ball's center at a
    /// body, the ball's center at an obstacle.
    pub(crate) anchor: Vector3<f64>,
    /// The place of the body.
    pub(crate) place: Option<Place>,
}

/// A ball that a hand holds by a spring, and that touches bodies and obstacles without gripping.
///
/// The spring ties the ball to its target, as the virtual coupling of a haptic device does. The
/// ball has no mass: under the force `f` of what it touches, its center is at
///
/// ```text
/// y = x* + f h / (k (h + r))        x* = target + (y_before - target_before) r / (r + h)
/// ```
///
/// with the stiffness `k`, the relaxation time `r` and the step `h`.
/// [`Islands::step_with`](crate::Islands::step_with) solves this with all contacts of the step, so
/// the forces on a body and on the probe are equal and opposite, and the ball stays on the surface
/// while the target goes in. The ball touches each body at the place nearest to it.
#[derive(Debug, Clone)]
pub struct Probe {
    config: ProbeConfig,
    obstacles: Vec<Arc<dyn ObstacleShape>>,
    target: Vector3<f64>,
    last_target: Option<Vector3<f64>>,
    pub(crate) position: Vector3<f64>,
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
    /// Makes a probe at `target` (m, world axes).
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
            target,
            last_target: None,
            position: target,
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
        self.config = config;
        Ok(())
    }

    /// Moves the target of the spring (m, world axes). A target faster than 100 m/s is a teleport:
    /// the ball is then at the target, and its contacts begin anew.
    ///
    /// # Errors
    /// Returns [`StepError::Input`] for a target that is not finite. The old one then stays.
    pub fn set_target(&mut self, target: [f64; 3]) -> Result<(), StepError> {
        finite("target of a probe", &target)?;
        self.target = target.into();
        Ok(())
    }

    /// The target of the spring, m, world axes.
    pub fn target(&self) -> [f64; 3] {
        self.target.into()
    }

    /// Sets the rigid obstacles that the ball touches. Contacts with an obstacle go on with the one
    /// at the same index of the new list.
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

    /// Center of the ball, m, world axes.
    pub fn position(&self) -> [f64; 3] {
        self.position.into()
    }

    /// What the ball touches and what is near it, after a step.
    pub fn contacts(&self) -> &[ProbeContact] {
        &self.contacts
    }

    /// Sum of the forces on the ball over the last step, N, world axes. It is the force of the
    /// spring and its damper on the hand.
    pub fn force(&self) -> [f64; 3] {
        let sum = self.contacts.iter().fold(Vector3::zeros(), |sum, c| sum + Vector3::from(c.force));
        sum.into()
    }

    /// Places the ball at its target and forgets its contacts.
    pub fn forget(&mut self) {
        self.last_target = None;
        (self.position, self.start, self.free) = (self.target, self.target, self.target);
        self.memory.clear();
        self.contacts.clear();
    }

    /// Begins a step of `h` seconds. Returns how far the ball may go in it, m.
    pub(crate) fn begin_step(&mut self, h: f64) -> f64 {
        let last = self.last_target.unwrap_or(self.target);
        if self.last_target.is_none() || (self.target - last).norm() > TELEPORT * h {
            self.forget();
        }
        let stretch = self.position - self.last_target.unwrap_or(self.target);
        let ProbeConfig { stiffness, relaxation, .. } = self.config;
        self.start = self.position;
        self.free = self.target + stretch * (relaxation / (relaxation + h));
        self.compliance = h / (stiffness * (h + relaxation));
        self.last_target = Some(self.target);
        (self.free - self.start).norm()
    }

    /// Moves the ball to where a force on it (N, world axes) lets it be at the end of the step.
    pub(crate) fn respond(&mut self, force: &Vector3<f64>) {
        self.position = self.free + self.compliance * force;
    }

    /// The compliance of what is rigid: a small share of the spring's, so that no law is singular.
    pub(crate) fn rigid(&self) -> Matrix3<f64> {
        Matrix3::identity() * (1e-3 * self.compliance)
    }
}

/// An obstacle around which the ball's center moves.
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
