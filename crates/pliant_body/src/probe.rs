//! Probes: tools that press and stroke bodies without gripping.

use std::sync::Arc;

use bevy::{
    math::{DQuat, DVec3},
    prelude::*,
};
use pliant_modal::{Contacts, ObstacleShape, Probe, ProbeConfig, ProbeContact, StepError, Touched};

/// A tool that a hand holds by a spring, and that presses and strokes every body here
/// ([`Driven::Local`](crate::Driven::Local)) and, with the contact plugin, every obstacle. It is a
/// ball, or what its [`ProbeShape`] says.
///
/// The probe stays on the surface while its target goes in. It touches bodies of one scale at a
/// time: that of the body whose center is nearest. What it touches is in [`ProbeState`].
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
#[require(ProbeState, ProbeShape)]
pub struct TouchProbe {
    /// Radius of the ball, or by which the shape is rounded, m, above 0. Default: `0.01`.
    pub radius: f64,
    /// Where the spring pulls the tool point, the center of a ball, m, world axes.
    pub target: DVec3,
    /// To where the spring turns the probe, from own to world axes. Default: not turned.
    pub rotation: DQuat,
    /// Stiffness of the spring, N/m, above 0. Against a turn it is this times the square of the
    /// farthest corner's distance from the tool point, which counts as the radius at least.
    /// Default: `500`.
    pub stiffness: f64,
    /// Relaxation time of the damper beside the spring, s, 0 or more. Default: `0.001`.
    pub relaxation: f64,
    /// Coefficient of friction, 0 to 10. At a body, and at an obstacle that has one of its
    /// own, the geometric mean of both counts. Default: `0.5`.
    pub friction: f64,
    /// Whether the probe touches anything. Default: `true`.
    pub enabled: bool,
}

impl Default for TouchProbe {
    fn default() -> Self {
        Self {
            radius: 0.01,
            target: DVec3::ZERO,
            rotation: DQuat::IDENTITY,
            stiffness: 500.0,
            relaxation: 1e-3,
            friction: Contacts::FRICTION,
            enabled: true,
        }
    }
}

/// Shape of a [`TouchProbe`]: the convex hull of some points, rounded by the radius of the probe.
/// Default: one point, a ball.
#[derive(Component, Reflect, Debug, Clone, PartialEq)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct ProbeShape {
    /// The points, m from the tool point, axes of the probe, 1 to [`Probe::MAX_CORNERS`].
    pub corners: Vec<DVec3>,
}

impl Default for ProbeShape {
    fn default() -> Self {
        Self { corners: vec![DVec3::ZERO] }
    }
}

impl ProbeShape {
    /// A capsule between two points, m from the tool point, axes of the probe. Each may be a `Vec3`
    /// or a `DVec3`.
    pub fn capsule(from: impl Into<DVec3>, to: impl Into<DVec3>) -> Self {
        Self { corners: vec![from.into(), to.into()] }
    }

    /// A box around the tool point. `half` has half of its edges without the rounding, m, as a
    /// `Vec3` or a `DVec3`.
    pub fn cuboid(half: impl Into<DVec3>) -> Self {
        let half = half.into();
        let sign = |bit: usize, number: usize| if number >> bit & 1 == 0 { -1.0 } else { 1.0 };
        let corner = |number| half * DVec3::new(sign(0, number), sign(1, number), sign(2, number));
        Self { corners: (0..8).map(corner).collect() }
    }
}

/// Something that a probe touches, or that is less than a radius away from it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Touching {
    /// The body or the obstacle.
    pub other: Entity,
    /// The nearest point of the surface, m, world axes, without the dent which the modes leave out.
    pub point: DVec3,
    /// Outward normal of what is touched.
    pub normal: DVec3,
    /// Velocity of the surface, m/s, world axes.
    pub velocity: DVec3,
    /// Compliance of the dent, m/N, world axes.
    pub compliance: [[f64; 3]; 3],
    /// Coefficient of friction.
    pub friction: f64,
    /// The place of the probe: the center of the sphere that touches there, m from the tool point,
    /// axes of the probe. Zero of a ball.
    pub spot: DVec3,
    /// Mean force on the probe over the last step, N, world axes. Zero where nothing touches.
    pub force: DVec3,
    /// Whether the contact slides.
    pub sliding: bool,
}

/// State of a [`TouchProbe`] after the last step.
#[derive(Component, Debug)]
pub struct ProbeState {
    /// The solver's probe. `None` while it touches nothing, or was refused.
    probe: Option<Probe>,
    /// Scale of the bodies that it touches.
    scale: f64,
    obstacles: Vec<Entity>,
    layers: [u32; 2],
    /// Whether the settings were refused, so that it is reported once.
    refused: bool,
}

impl Default for ProbeState {
    fn default() -> Self {
        Self { probe: None, scale: 0.0, obstacles: Vec::new(), layers: [u32::MAX; 2], refused: false }
    }
}

impl ProbeState {
    /// Position of the tool point, the center of a ball, m, world axes. `None` while the probe is
    /// not enabled, or was refused.
    pub fn position(&self) -> Option<DVec3> {
        Some(DVec3::from(self.probe.as_ref()?.position()) * self.scale)
    }

    /// Rotation from own to world axes. `None` as [`position`](Self::position).
    pub fn rotation(&self) -> Option<DQuat> {
        Some(DQuat::from_array(self.probe.as_ref()?.rotation()))
    }

    /// Force on the probe over the last step, N, world axes.
    pub fn force(&self) -> DVec3 {
        self.probe.as_ref().map_or(DVec3::ZERO, |probe| DVec3::from(probe.force()) * self.scale)
    }

    /// Torque of the force about the tool point, N m, world axes. Zero of a ball.
    pub fn torque(&self) -> DVec3 {
        let square = self.scale * self.scale;
        self.probe.as_ref().map_or(DVec3::ZERO, |probe| DVec3::from(probe.torque()) * square)
    }

    /// What the probe touches, and what is near it.
    pub fn contacts(&self) -> impl Iterator<Item = Touching> + '_ {
        let scale = self.scale;
        let contacts = self.probe.as_ref().map_or(&[][..], Probe::contacts);
        contacts.iter().filter_map(move |contact: &ProbeContact| {
            let other = match contact.other {
                Touched::Obstacle(index) => *self.obstacles.get(index)?,
                Touched::Body(bits) => Entity::try_from_bits(bits)?,
                Touched::Probe(_) | Touched::Attachment(_) => return None,
            };
            Some(Touching {
                other,
                point: DVec3::from(contact.point) * scale,
                normal: contact.normal.into(),
                velocity: DVec3::from(contact.velocity) * scale,
                // Lengths and forces have the same factor.
                compliance: contact.compliance,
                friction: contact.friction,
                spot: DVec3::from(contact.spot) * scale,
                force: DVec3::from(contact.force) * scale,
                sliding: contact.sliding,
            })
        })
    }

    /// Distance of the farthest point of the shape from the tool point, m.
    pub fn extent(&self) -> f64 {
        self.probe.as_ref().map_or(0.0, |probe| probe.extent() * self.scale)
    }

    /// The length whose square times the stiffness resists a turn, m: that of [`Probe::lever`].
    pub fn lever(&self) -> f64 {
        self.probe.as_ref().map_or(0.0, |probe| probe.lever() * self.scale)
    }

    /// Center (m, world axes) around which obstacles count, and the scale of their shapes.
    pub fn around(&self) -> Option<(DVec3, f64)> {
        Some((self.position()?, self.scale))
    }

    /// The obstacles that the probe was given.
    pub fn obstacles(&self) -> &[Entity] {
        &self.obstacles
    }

    /// Gives the probe its obstacles, in lengths of [`around`](Self::around)'s scale.
    ///
    /// # Errors
    /// Returns the error of [`Probe::set_obstacles`]. The old obstacles then stay.
    pub fn set_obstacles(&mut self, list: Vec<(Entity, Arc<dyn ObstacleShape>)>) -> Result<(), StepError> {
        let (entities, shapes) = list.into_iter().unzip();
        if let Some(probe) = &mut self.probe {
            probe.set_obstacles(shapes)?;
            self.obstacles = entities;
        }
        Ok(())
    }

    /// Sets the `[memberships, filters]` of the probe, which decide which bodies it touches
    /// ([`BodyState::set_probe_layers`](crate::BodyState::set_probe_layers)). Default: all bits.
    /// The contact plugin sets them at every tick.
    pub fn set_layers(&mut self, layers: [u32; 2]) {
        self.layers = layers;
    }

    /// The `[memberships, filters]` of the probe.
    pub fn layers(&self) -> [u32; 2] {
        self.layers
    }

    pub(crate) fn scale(&self) -> f64 {
        self.scale
    }

    /// Takes the probe for a step, led to its target.
    pub(crate) fn take(
        &mut self,
        wanted: &TouchProbe,
        shape: &ProbeShape,
        scale: f64,
    ) -> Result<Option<Probe>, StepError> {
        if !wanted.enabled {
            (self.probe, self.refused) = (None, false);
            self.obstacles.clear();
            return Ok(None);
        }
        let config = ProbeConfig {
            radius: wanted.radius / scale,
            stiffness: wanted.stiffness,
            relaxation: wanted.relaxation,
            friction: wanted.friction,
        };
        let target = (wanted.target / scale).into();
        let known = self.probe.take().filter(|_| self.scale == scale);
        if known.is_none() {
            self.obstacles.clear();
        }
        // One more than there may be, so that too many are refused.
        let mut corners = [[0.0; 3]; Probe::MAX_CORNERS + 1];
        let count = shape.corners.len().min(corners.len());
        for (to, from) in corners.iter_mut().zip(&shape.corners) {
            *to = (*from / scale).into();
        }
        let taken = known.map_or_else(|| Probe::new(config, target), Ok).and_then(|mut probe| {
            probe.configure(config)?;
            probe.set_target(target)?;
            probe.set_rotation(wanted.rotation.to_array())?;
            probe.set_corners(&corners[..count])?;
            Ok(probe)
        });
        self.scale = scale;
        let first = !std::mem::replace(&mut self.refused, taken.is_err());
        match taken {
            Ok(probe) => Ok(Some(probe)),
            Err(error) if first => Err(error),
            Err(_) => Ok(None),
        }
    }

    /// Gives the probe back after the step.
    pub(crate) fn give(&mut self, probe: Probe) {
        self.probe = Some(probe);
    }
}
