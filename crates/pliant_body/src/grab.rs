//! Grabs, which tie a patch of a body's surface to a target in the world, and the force on the
//! hand.

use bevy::{math::DVec3, prelude::*};
use serde::{Deserialize, Serialize};

/// A grab of a patch of a body's surface.
///
/// Spawn the grab on a separate entity and relate it to the body by [`GrabOf`]:
///
/// ```
/// # use bevy::{math::DVec3, prelude::*};
/// # use pliant_body::{Grab, GrabOf};
/// # fn pull(mut commands: Commands, body: Entity) {
/// commands.spawn((Grab::new(17, 0.02, DVec3::new(0.1, 0.4, 0.0)), GrabOf(body)));
/// # }
/// ```
///
/// The hand is compliant and implicit. The patch tracks the target as closely as the body's
/// stiffness and the patch's own compliance allow, at any stiffness and step. Despawning the
/// entity, or removing [`GrabOf`], releases the patch. [`GrabForce`] holds the force.
///
/// This app does not act on a grab of a [`Driven::Remote`](crate::Driven::Remote) body. The source
/// that drives the body reads the grab and writes the force.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
#[require(GrabForce)]
pub struct Grab {
    /// Surface vertex at the middle of the patch: an index into the model's surface positions.
    pub vertex: u32,
    /// Radius of the patch around that vertex, measured on the rest shape, m (of the model, before
    /// the entity's scale). Zero selects the vertex alone. A patch with area is better, because the
    /// compliance of a point depends on the mesh.
    pub radius: f64,
    /// Target position of the patch, m, world axes. A value that is not finite is refused, and the
    /// last valid target stays.
    pub target: DVec3,
    /// Stiffness of the hand's own spring (a device's coupling), N/m, above 0, in series with the
    /// patch's compliance. Default: `None`, as stiff as the patch allows. Infinity makes the rigid
    /// constraint of [`GrabConfig::RIGID`](pliant_modal::GrabConfig::RIGID), which trembles.
    pub stiffness: Option<f64>,
    /// Relaxation time of the coupling's damper, s, 0 or more. Default: `0.0`.
    pub relaxation: f64,
}

impl Grab {
    /// Returns a grab of the patch within `radius` (m, model) of surface vertex `vertex`, pulled to
    /// `target` (m, world), which may be a `Vec3` or a `DVec3`.
    pub fn new(vertex: u32, radius: f64, target: impl Into<DVec3>) -> Self {
        Self { vertex, radius, target: target.into(), stiffness: None, relaxation: 0.0 }
    }

    /// Returns the solver's settings of the grab. A change of any of them makes a new grab in the
    /// solver.
    pub(crate) fn hold(&self) -> GrabHold {
        GrabHold {
            vertex: self.vertex,
            radius: self.radius,
            stiffness: self.stiffness,
            relaxation: self.relaxation,
        }
    }
}

/// A [`Grab`] without its target.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct GrabHold {
    pub vertex: u32,
    pub radius: f64,
    pub stiffness: Option<f64>,
    pub relaxation: f64,
}

impl GrabHold {
    /// Compares the bits, so that a refused NaN equals the same NaN in the next tick.
    pub fn is(&self, other: &Self) -> bool {
        let bits = |hold: &Self| {
            (hold.vertex, hold.radius.to_bits(), hold.stiffness.map(f64::to_bits), hold.relaxation.to_bits())
        };
        bits(self) == bits(other)
    }
}

/// The body that a grab holds.
#[derive(Component, FromTemplate, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
#[relationship(relationship_target = Grabs)]
pub struct GrabOf(#[entities] pub Entity);

impl Default for GrabOf {
    /// Holds no body.
    fn default() -> Self {
        Self(Entity::PLACEHOLDER)
    }
}

/// The grabs on a body, oldest first. Despawning the body also despawns its grabs.
#[derive(Component, Reflect, Debug, Default)]
#[reflect(Component, Debug, Default)]
#[relationship_target(relationship = GrabOf, linked_spawn)]
pub struct Grabs(Vec<Entity>);

impl Grabs {
    /// Returns the entities of the grabs, oldest first.
    pub fn entities(&self) -> &[Entity] {
        &self.0
    }
}

/// A grab took hold of a body that this app steps. Observe it on the body's entity or on all.
///
/// A change of a held [`Grab`] is no event, and neither is a grab of a body that was saved and
/// loaded. A grab that finds the body full takes hold when a place is free.
#[derive(EntityEvent, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct Grabbed {
    /// The entity of the body.
    pub entity: Entity,
    /// The entity of the [`Grab`].
    pub grab: Entity,
}

/// A grab let go of a body that this app steps, or the body is gone. Observe it on the body's
/// entity or on all.
#[derive(EntityEvent, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct Released {
    /// The entity of the body.
    pub entity: Entity,
    /// The entity of the [`Grab`], which may be gone.
    pub grab: Entity,
}

/// The force on the hand, published in every tick for every [`Grab`].
///
/// The values are zero while the body does not exist.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct GrabForce {
    /// The reaction: the force that the body exerts on the hand, N, world axes. Default: zero.
    pub force: DVec3,
    /// Current middle of the patch (the weighted mean of its vertices), m, world axes. Default: the
    /// origin.
    pub point: DVec3,
}
