//! Obstacles as components, and their motion from tick to tick.

use std::{collections::BTreeSet, sync::Arc};

use bevy::{
    math::{DQuat, DVec3},
    prelude::*,
};
use nalgebra::Vector3;
use pliant_body::{BodyError, BodyRefused, Pose};
use pliant_modal as modal;

#[cfg(feature = "mesh")]
use crate::mesh::Solids;
use crate::{BodyFriction, DistanceField};

/// A rigid shape that bodies touch, at the entity's `Transform`.
///
/// The scale of the entity multiplies the shape. A ball, a capsule and a field take the largest of
/// the three scales. A scale that is not finite takes the obstacle out of the scene until it is.
///
/// An obstacle may move. Its velocity is its way since the last tick, so that it carries and pushes
/// what it touches. Bodies do not push it back. A way faster than 100 m/s or 100 rad/s is a
/// teleport without velocity.
#[derive(Component, FromTemplate, Reflect, Debug, Default, Clone, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
#[require(Transform)]
pub enum Obstacle {
    /// Everything below the entity's origin, along its own y axis. Default.
    #[default]
    Floor,
    /// A ball around the entity's origin.
    Ball {
        /// Radius, m.
        radius: f32,
    },
    /// A box around the entity's origin along its own axes.
    Box {
        /// Half the lengths of the edges, m.
        half: Vec3,
    },
    /// A cylinder with round ends along the entity's own y axis.
    Capsule {
        /// Radius, m.
        radius: f32,
        /// Half the distance of the centers of the two round ends, m.
        half_length: f32,
    },
    /// The convex hull of a mesh. It touches nothing until the mesh is loaded, and a mesh that is
    /// only in the render world is refused.
    #[cfg(feature = "mesh")]
    Hull(Handle<Mesh>),
    /// The triangles of a mesh, solid on the side from which they are not seen. A closed mesh that
    /// is inside out is turned. An open one, like a terrain, is solid below without end. It touches
    /// nothing until the mesh is loaded, and a mesh that is only in the render world is refused.
    #[cfg(feature = "mesh")]
    Mesh(Handle<Mesh>),
    /// A signed distance field, which an entity with a negative scale does not mirror. It touches
    /// nothing until the asset is there.
    Field(Handle<DistanceField>),
}

/// Selects what touches what: a body and an obstacle, or a probe and either, touch if each one's
/// filters have a bit of the other's memberships.
///
/// An entity without this component is a member of all layers and touches all layers.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Default, Debug, Clone, PartialEq)]
pub struct ContactLayers {
    /// Layers to which the entity belongs, one bit each. Default: all.
    pub memberships: u32,
    /// Layers that the entity touches, one bit each. Default: all.
    pub filters: u32,
}

impl Default for ContactLayers {
    fn default() -> Self {
        Self { memberships: u32::MAX, filters: u32::MAX }
    }
}

impl ContactLayers {
    pub(crate) fn touch(self, other: Self) -> bool {
        self.memberships & other.filters != 0 && other.memberships & self.filters != 0
    }
}

/// The shape of an obstacle.
#[derive(Debug, Clone)]
enum Shape {
    /// As its component describes it.
    Plain(Obstacle),
    /// Made from an asset, or from another engine's collider.
    Made {
        shape: Arc<dyn modal::ObstacleShape>,
        /// Length in the app's world of the shape's unit, m.
        unit: f64,
    },
}

impl PartialEq for Shape {
    fn eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Plain(a), Self::Plain(b)) => a == b,
            (Self::Made { shape: a, unit: x }, Self::Made { shape: b, unit: y }) => {
                Arc::ptr_eq(a, b) && x == y
            }
            _ => false,
        }
    }
}

/// Pose and motion of an obstacle at this tick, world axes.
#[derive(Component, Debug, Clone, PartialEq)]
pub(crate) struct Motion {
    shape: Shape,
    /// Scale of the entity, negative where it mirrors.
    scale: DVec3,
    position: DVec3,
    rotation: DQuat,
    velocity: DVec3,
    spin: DVec3,
    /// The rigid body of another engine to which it belongs.
    of: Option<Entity>,
    /// The same if it gives way to soft bodies.
    #[cfg(feature = "avian")]
    pub(crate) rigid: Option<Entity>,
    /// Its own coefficient of friction.
    friction: Option<f64>,
    /// Whether shape, pose or motion changed in this tick.
    pub(crate) changed: bool,
    /// Whether the shape's numbers are valid.
    pub(crate) sound: bool,
}

impl Motion {
    /// `made` gives the shape of an asset at a scale, when it is known. `last` is the motion until
    /// now.
    fn new(
        shape: &Obstacle,
        global: &GlobalTransform,
        last: Option<&Self>,
        made: impl FnOnce(DVec3) -> Option<Shape>,
    ) -> Option<Self> {
        let (scale, rotation, position) = global.to_scale_rotation_translation();
        let sound = scale.is_finite() && rotation.is_finite() && position.is_finite();
        let (scale, position) = (scale.as_dvec3(), position.as_dvec3());
        // The scale comes out of a matrix, and changes by rounding where the entity turns.
        let same = |last: &&Self| (scale - last.scale).abs().cmple(1e-5 * scale.abs()).all();
        let scale = last.filter(same).map_or(scale, |last| last.scale);
        let shape = match shape {
            _ if !sound => return None,
            #[cfg(feature = "mesh")]
            Obstacle::Hull(_) | Obstacle::Mesh(_) => made(scale)?,
            Obstacle::Field(_) => made(scale)?,
            plain => Shape::Plain(plain.clone()),
        };
        Some(Self {
            shape,
            scale,
            position,
            rotation: rotation.as_dquat().normalize(),
            velocity: DVec3::ZERO,
            spin: DVec3::ZERO,
            of: None,
            friction: None,
            #[cfg(feature = "avian")]
            rigid: None,
            changed: true,
            sound: true,
        })
    }

    /// The motion of another engine's collider, at its pose at the end of the step.
    #[cfg(feature = "avian")]
    pub(crate) fn of_collider(
        shape: Arc<dyn modal::ObstacleShape>,
        pose: Pose,
        [velocity, spin]: [DVec3; 2],
        [of, rigid]: [Option<Entity>; 2],
        friction: Option<f64>,
        awake: bool,
        last: Option<&Self>,
    ) -> Self {
        let (position, rotation) = (pose.origin, pose.orientation);
        let (shape, scale) = (Shape::Made { shape, unit: 1.0 }, DVec3::ONE);
        let now = Self {
            shape,
            scale,
            position,
            rotation,
            velocity,
            spin,
            of,
            rigid,
            friction,
            changed: true,
            sound: true,
        };
        // What moves is passed on anew at each step, so that the bodies near it stay awake with it.
        let same =
            |last: &Self| Self { changed: last.changed, sound: last.sound, ..now.clone() } == *last && !awake;
        let changed = last.is_none_or(|last| !same(last));
        Self { changed, sound: last.is_none_or(|last| last.sound), ..now }
    }

    /// Whether it belongs to one of these rigid bodies.
    pub(crate) fn belongs(&self, rigids: &[Entity]) -> bool {
        self.of.is_some_and(|of| rigids.contains(&of))
    }

    /// Continues the motion of `last` over a step (s).
    fn after(mut self, last: &Self, step: f64) -> Self {
        let [now, before] = [&self, last].map(|at| Pose { origin: at.position, orientation: at.rotation });
        if let Some(ways) = now.velocity_since(&before, step) {
            [self.velocity, self.spin] = ways;
        }
        self.changed = Self { changed: last.changed, sound: last.sound, ..self.clone() } != *last;
        self.sound = last.sound;
        self
    }

    /// A shape of the solver at this pose and motion, in the world of a body on an entity of
    /// uniform scale `scale`.
    fn moving<O>(&self, shape: O, scale: f64) -> modal::Moving<O> {
        modal::Moving {
            shape,
            position: (self.position / scale).into(),
            rotation: self.rotation.into(),
            velocity: (self.velocity / scale).into(),
            angular_velocity: self.spin.into(),
        }
    }

    /// Calls `visit` with the obstacle in the world of a body on an entity of uniform scale
    /// `scale`.
    fn visit<V: Visit>(&self, scale: f64, visit: V) -> V::Output {
        let whole = self.scale.abs().max_element() / scale;
        let center = [0.0; 3];
        let plain = match &self.shape {
            Shape::Plain(plain) => plain,
            Shape::Made { shape, unit } => {
                let shape = self.moving(InWorldOf { shape: shape.clone(), factor: scale / unit }, scale);
                #[cfg(feature = "avian")]
                if let Some(rigid) = self.rigid {
                    return visit.visit(crate::avian::Owned { shape, key: crate::avian::key(rigid, scale) });
                }
                return visit.visit(shape);
            }
        };
        match *plain {
            // These are made.
            #[cfg(feature = "mesh")]
            Obstacle::Hull(_) | Obstacle::Mesh(_) => visit.visit(Nothing),
            Obstacle::Field(_) => visit.visit(Nothing),
            Obstacle::Floor => visit.visit(self.moving(modal::Plane::GROUND, scale)),
            Obstacle::Ball { radius } => {
                let radius = f64::from(radius) * whole;
                visit.visit(self.moving(modal::Sphere { center, radius }, scale))
            }
            Obstacle::Box { half } => {
                let half = (half.as_dvec3() * self.scale.abs() / scale).into();
                let shape = modal::Cuboid { center, rotation: [0.0, 0.0, 0.0, 1.0], half, round: 0.0 };
                visit.visit(self.moving(shape, scale))
            }
            Obstacle::Capsule { radius, half_length } => {
                let end = f64::from(half_length) * whole;
                let ends = [[0.0, -end, 0.0], [0.0, end, 0.0]];
                visit.visit(self.moving(modal::Capsule { ends, radius: f64::from(radius) * whole }, scale))
            }
        }
    }

    /// The obstacle in the world of a body on an entity of uniform scale `scale`.
    pub(crate) fn obstacle(&self, scale: f64) -> Arc<dyn modal::ObstacleShape> {
        let shape = self.visit(scale, Share);
        match self.friction {
            Some(friction) => Arc::new(Rough { shape, friction }),
            None => shape,
        }
    }

    /// Speed of the obstacle's material at a point, m/s, in the same world.
    pub(crate) fn speed(&self, scale: f64, point: &Vector3<f64>) -> f64 {
        let arm = scale * DVec3::from_array((*point).into()) - self.position;
        (self.velocity + self.spin.cross(arm)).length() / scale
    }

    /// Distance of a point to the obstacle, m, in the same world.
    pub(crate) fn distance(&self, scale: f64, point: &Vector3<f64>) -> f64 {
        self.visit(scale, Distance(point))
    }
}

/// What is done with an obstacle of any shape.
trait Visit {
    type Output;
    fn visit(self, obstacle: impl modal::ObstacleShape + 'static) -> Self::Output;
}

/// Makes an obstacle that bodies can share.
struct Share;

impl Visit for Share {
    type Output = Arc<dyn modal::ObstacleShape>;

    fn visit(self, obstacle: impl modal::ObstacleShape + 'static) -> Self::Output {
        Arc::new(obstacle)
    }
}

/// Computes the distance of a point.
struct Distance<'a>(&'a Vector3<f64>);

impl Visit for Distance<'_> {
    type Output = f64;

    fn visit(self, obstacle: impl modal::ObstacleShape + 'static) -> f64 {
        obstacle.at(self.0).distance
    }
}

/// Distance that is no distance at all, m: of an obstacle that is not there, and of a point that is
/// too far away for numbers.
pub(crate) const FAR: f64 = 1e30;

/// Stands for an obstacle that is not there.
#[derive(Debug)]
pub(crate) struct Nothing;

impl modal::ObstacleShape for Nothing {
    fn at(&self, _: &Vector3<f64>) -> modal::SurfacePoint {
        modal::SurfacePoint { distance: FAR, normal: Vector3::y() }
    }
}

/// A shape with a friction of its own.
#[derive(Debug)]
struct Rough {
    shape: Arc<dyn modal::ObstacleShape>,
    friction: f64,
}

impl modal::ObstacleShape for Rough {
    fn at(&self, point: &Vector3<f64>) -> modal::SurfacePoint {
        self.shape.at(point)
    }

    fn velocity(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.shape.velocity(point)
    }

    fn curvature(&self) -> f64 {
        self.shape.curvature()
    }

    fn friction(&self) -> Option<f64> {
        Some(self.friction)
    }

    fn check(&self) -> Result<(), modal::StepError> {
        // The same range as that of a body.
        modal::Contacts::default().set_friction(self.friction)?;
        self.shape.check()
    }

    fn rigid(&self) -> Option<[u64; 2]> {
        self.shape.rigid()
    }
}

/// A shape in the world of a body: lengths there are those of the shape's axes divided by `factor`.
#[derive(Debug)]
pub(crate) struct InWorldOf {
    pub(crate) shape: Arc<dyn modal::ObstacleShape>,
    pub(crate) factor: f64,
}

impl modal::ObstacleShape for InWorldOf {
    fn at(&self, point: &Vector3<f64>) -> modal::SurfacePoint {
        let found = self.shape.at(&(point * self.factor));
        modal::SurfacePoint { distance: found.distance / self.factor, ..found }
    }

    fn curvature(&self) -> f64 {
        self.factor * self.shape.curvature()
    }

    fn check(&self) -> Result<(), modal::StepError> {
        let sound = self.factor > 0.0 && self.factor.is_finite();
        let (what, expected) = ("scale of an obstacle", "three numbers of which one is not 0");
        if !sound {
            return Err(modal::StepError::Input { what, expected, got: 1.0 / self.factor });
        }
        self.shape.check()
    }

    fn fixed(&self) -> Option<modal::FixedObstacle> {
        self.shape.fixed().filter(|_| self.factor == 1.0)
    }
}

/// Finds the shapes of obstacles that are made from assets.
#[derive(bevy::ecs::system::SystemParam)]
pub(crate) struct Made<'w, 's> {
    fields: Res<'w, Assets<DistanceField>>,
    #[cfg(feature = "mesh")]
    solids: ResMut<'w, Solids>,
    #[cfg(feature = "mesh")]
    meshes: Option<Res<'w, Assets<Mesh>>>,
    #[cfg(feature = "mesh")]
    changes: Option<MessageReader<'w, 's, AssetEvent<Mesh>>>,
    /// The obstacles whose assets were refused.
    refused: Local<'s, BTreeSet<Entity>>,
}

impl Made<'_, '_> {
    #[cfg(feature = "mesh")]
    fn tidy(&mut self) {
        let changed = self.changes.iter_mut().flat_map(MessageReader::read).filter_map(|event| match event {
            AssetEvent::Modified { id } | AssetEvent::Removed { id } => Some(*id),
            _ => None,
        });
        self.solids.tidy(changed);
    }

    /// Returns the shape of an obstacle at a scale, and the error of a mesh that cannot be one.
    fn find(&mut self, obstacle: &Obstacle, scale: DVec3) -> Option<Result<Shape, modal::StepError>> {
        #[cfg(feature = "mesh")]
        let mut solid = |mesh, hull| {
            let found = self.solids.get(self.meshes.as_deref()?, mesh, hull, scale)?;
            Some(found.map(|shape| Shape::Made { shape, unit: 1.0 }))
        };
        match obstacle {
            #[cfg(feature = "mesh")]
            Obstacle::Hull(mesh) => solid(mesh, true),
            #[cfg(feature = "mesh")]
            Obstacle::Mesh(mesh) => solid(mesh, false),
            Obstacle::Field(field) => {
                let shape = self.fields.get(field)?.shape();
                Some(Ok(Shape::Made { shape, unit: scale.abs().max_element() }))
            }
            _ => None,
        }
    }
}

/// Takes the pose of every obstacle at this tick, and its motion since the last one.
pub(crate) fn move_obstacles(
    time: Res<Time>,
    mut made: Made,
    mut commands: Commands,
    transforms: TransformHelper,
    mut obstacles: Query<(Entity, &Obstacle, Option<&BodyFriction>, Option<&mut Motion>)>,
    #[cfg(not(feature = "avian"))] gone: Query<Entity, (With<Motion>, Without<Obstacle>)>,
    #[cfg(feature = "avian")] gone: Query<Entity, crate::avian::Gone>,
) {
    for entity in &gone {
        commands.entity(entity).try_remove::<Motion>();
    }
    let step = time.delta_secs_f64();
    #[cfg(feature = "mesh")]
    made.tidy();
    made.refused.retain(|entity| obstacles.contains(*entity));
    for (entity, shape, friction, motion) in &mut obstacles {
        // `GlobalTransform` is that of the last frame.
        let global = transforms.compute_global_transform(entity).ok();
        let found = |scale| match made.find(shape, scale) {
            // What was there stays until the new one is made.
            None => {
                let last = motion.as_ref().map(|last| last.shape.clone());
                last.filter(|last| matches!(last, Shape::Made { .. }))
            }
            Some(Ok(found)) => {
                made.refused.remove(&entity);
                Some(found)
            }
            Some(Err(error)) => {
                if made.refused.insert(entity) {
                    warn!("{entity}: {error}");
                    commands.trigger(BodyRefused { entity, error: BodyError::Obstacle(error) });
                }
                None
            }
        };
        let mut now = global.and_then(|global| Motion::new(shape, &global, motion.as_deref(), found));
        if let Some(now) = &mut now {
            now.friction = friction.map(|friction| friction.0);
        }
        if let (Some(now), Some(last)) = (&mut now, &motion) {
            *now = now.clone().after(last, step);
        }
        keep(&mut commands, entity, motion, now);
    }
}

/// Checks the motion of an obstacle and stores it.
pub(crate) fn keep(
    commands: &mut Commands,
    entity: Entity,
    motion: Option<Mut<Motion>>,
    mut now: Option<Motion>,
) {
    if let Some(now) = now.as_mut().filter(|now| now.changed) {
        let before = motion.as_ref().is_none_or(|last| last.sound);
        let checked = now.obstacle(1.0).check();
        now.sound = checked.is_ok();
        if let (Err(error), true) = (checked, before) {
            warn!("{entity}: {error}");
            commands.trigger(BodyRefused { entity, error: BodyError::Obstacle(error) });
        }
    }
    match (motion, now) {
        (Some(mut motion), Some(now)) => *motion = now,
        (Some(_), None) => {
            commands.entity(entity).try_remove::<Motion>();
        }
        (None, Some(now)) => {
            commands.entity(entity).try_insert(now);
        }
        (None, None) => {}
    }
}
