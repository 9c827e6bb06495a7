//! The shapes of avian's colliders as obstacles.
//!
//! Distances are computed in f64 and are exact for all shapes but those that parry alone knows.

use std::sync::Arc;

use avian3d::parry::{
    math::Vector,
    shape::{ConvexPolyhedron, Cuboid, SharedShape, TypedShape},
};
use bevy::math::DVec3;
use nalgebra::Vector3;
use pliant_modal::{self as modal, ObstacleShape, StepError, SurfacePoint};

use crate::{
    mesh::{Solid, Source},
    obstacle::FAR,
};

type Made = Result<Arc<dyn ObstacleShape>, StepError>;

/// Makes the obstacle of a collider's shape.
pub(super) fn form(shape: &SharedShape) -> Made {
    let (center, rotation) = ([0.0; 3], [0.0, 0.0, 0.0, 1.0]);
    let cuboid = |cuboid: &Cuboid, round: f32| modal::Cuboid {
        center,
        rotation,
        half: wide(cuboid.half_extents),
        round: round.into(),
    };
    Ok(match shape.as_typed_shape() {
        TypedShape::Ball(ball) => Arc::new(modal::Sphere { center, radius: ball.radius.into() }),
        TypedShape::Cuboid(of) => Arc::new(cuboid(of, 0.0)),
        TypedShape::RoundCuboid(of) => Arc::new(cuboid(&of.inner_shape, of.border_radius)),
        TypedShape::Capsule(of) => {
            let ends = [wide(of.segment.a), wide(of.segment.b)];
            Arc::new(modal::Capsule { ends, radius: of.radius.into() })
        }
        TypedShape::HalfSpace(of) => Arc::new(modal::Plane { point: center, normal: wide(of.normal) }),
        TypedShape::Cylinder(of) => Arc::new(Lathe::cylinder(of.radius, of.half_height)),
        TypedShape::Cone(of) => Arc::new(Lathe::cone(of.radius, of.half_height)),
        TypedShape::RoundCylinder(of) => {
            let inner = Arc::new(Lathe::cylinder(of.inner_shape.radius, of.inner_shape.half_height));
            Arc::new(Grown { inner, by: of.border_radius.into() })
        }
        TypedShape::RoundCone(of) => {
            let inner = Arc::new(Lathe::cone(of.inner_shape.radius, of.inner_shape.half_height));
            Arc::new(Grown { inner, by: of.border_radius.into() })
        }
        TypedShape::ConvexPolyhedron(of) => hull(of)?,
        TypedShape::RoundConvexPolyhedron(of) => {
            Arc::new(Grown { inner: hull(&of.inner_shape)?, by: of.border_radius.into() })
        }
        TypedShape::TriMesh(of) => solid(of.vertices(), of.indices().to_vec(), false)?,
        TypedShape::HeightField(of) => {
            let (points, triangles) = of.to_trimesh();
            solid(&points, triangles, false)?
        }
        TypedShape::Compound(of) => {
            let part = |(pose, shape): &(avian3d::parry::math::Pose, SharedShape)| {
                let [x, y, z, w] = pose.rotation.to_array().map(f64::from);
                Ok(modal::Moving {
                    shape: Part(form(shape)?),
                    position: wide(pose.translation),
                    rotation: [x, y, z, w],
                    velocity: [0.0; 3],
                    angular_velocity: [0.0; 3],
                })
            };
            Arc::new(Union(of.shapes().iter().map(part).collect::<Result<_, StepError>>()?))
        }
        TypedShape::RoundTriangle(of) => {
            let inner = Arc::new(Other(SharedShape::new(of.inner_shape)));
            Arc::new(Grown { inner, by: of.border_radius.into() })
        }
        TypedShape::Segment(_)
        | TypedShape::Triangle(_)
        | TypedShape::Voxels(_)
        | TypedShape::Polyline(_)
        | TypedShape::Custom(_) => Arc::new(Other(shape.clone())),
    })
}

fn wide(v: Vector) -> [f64; 3] {
    v.to_array().map(f64::from)
}

fn solid(points: &[Vector], triangles: Vec<[u32; 3]>, hull: bool) -> Made {
    let positions = points.iter().map(|p| p.to_array()).collect();
    let solid = Solid::new(&Source { positions, triangles, hull }, DVec3::ONE)?;
    Ok(Arc::new(solid))
}

fn hull(of: &ConvexPolyhedron) -> Made {
    let (points, triangles) = of.to_trimesh();
    solid(&points, triangles, true)
}

/// A convex shape that is round about its y axis. The profile has points (distance from the axis,
/// height) from the axis below to the axis above, m.
#[derive(Debug)]
struct Lathe(Vec<[f64; 2]>);

impl Lathe {
    fn cylinder(radius: f32, half: f32) -> Self {
        let (r, y) = (f64::from(radius), f64::from(half));
        Self(vec![[0.0, -y], [r, -y], [r, y], [0.0, y]])
    }

    fn cone(radius: f32, half: f32) -> Self {
        let (r, y) = (f64::from(radius), f64::from(half));
        Self(vec![[0.0, -y], [r, -y], [0.0, y]])
    }
}

impl ObstacleShape for Lathe {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let (r, y) = (point.x.hypot(point.z), point.y);
        let around = if r > f64::MIN_POSITIVE { [point.x / r, point.z / r] } else { [1.0, 0.0] };
        let (mut inside, mut nearest) = (true, f64::INFINITY);
        let (mut facing, mut way) = ([0.0, 1.0], [0.0, 1.0]);
        for pair in self.0.windows(2) {
            let [[ar, ay], [br, by]] = [pair[0], pair[1]];
            let (er, ey) = (br - ar, by - ay);
            let length = er.hypot(ey);
            if length.is_nan() || length <= f64::MIN_POSITIVE {
                continue;
            }
            let outward = [ey / length, -er / length];
            let across = (r - ar) * outward[0] + (y - ay) * outward[1];
            inside &= across <= 0.0;
            let t = (((r - ar) * er + (y - ay) * ey) / (length * length)).clamp(0.0, 1.0);
            let (wr, wy) = (r - (ar + t * er), y - (ay + t * ey));
            let distance = wr.hypot(wy);
            if distance < nearest {
                (nearest, facing, way) = (distance, outward, [wr, wy]);
            }
        }
        // On the surface itself the edge gives the direction.
        let tiny = nearest <= 1e-12 * (r + y.abs());
        let normal = if tiny || inside { facing } else { way.map(|x| x / nearest) };
        let distance = if inside { -nearest } else { nearest };
        let normal = Vector3::new(normal[0] * around[0], normal[1], normal[0] * around[1]);
        SurfacePoint { distance, normal }
    }

    fn check(&self) -> Result<(), StepError> {
        let bad = self.0.iter().flatten().find(|x| !x.is_finite());
        bad.map_or(Ok(()), |bad| {
            Err(StepError::Input { what: "size of a collider", expected: "a finite number", got: *bad })
        })
    }
}

/// All points within a distance of a shape.
#[derive(Debug)]
struct Grown {
    inner: Arc<dyn ObstacleShape>,
    by: f64,
}

impl ObstacleShape for Grown {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let found = self.inner.at(point);
        SurfacePoint { distance: found.distance - self.by, ..found }
    }

    fn check(&self) -> Result<(), StepError> {
        self.inner.check()
    }
}

/// A part of a compound.
#[derive(Debug)]
struct Part(Arc<dyn ObstacleShape>);

impl ObstacleShape for Part {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        self.0.at(point)
    }

    fn check(&self) -> Result<(), StepError> {
        self.0.check()
    }
}

/// Some shapes as one. Where they overlap, the depth inside is that of the deepest.
#[derive(Debug)]
struct Union(Vec<modal::Moving<Part>>);

impl ObstacleShape for Union {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let all = self.0.iter().map(|part| part.at(point));
        let nearest = all.min_by(|a, b| a.distance.total_cmp(&b.distance));
        nearest.unwrap_or(SurfacePoint { distance: FAR, normal: Vector3::y() })
    }

    fn check(&self) -> Result<(), StepError> {
        self.0.iter().try_for_each(ObstacleShape::check)
    }
}

/// A shape whose points parry finds, in f32.
struct Other(SharedShape);

impl std::fmt::Debug for Other {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Other").field(&self.0.shape_type()).finish()
    }
}

impl ObstacleShape for Other {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let far = SurfacePoint { distance: FAR, normal: Vector3::y() };
        let p = Vector::new(point.x as f32, point.y as f32, point.z as f32);
        if !p.is_finite() {
            return far;
        }
        let found = self.0.project_local_point(p, false);
        let way = point - Vector3::from(wide(found.point));
        let length = way.norm();
        if !length.is_finite() {
            return far;
        }
        let sign = if found.is_inside { -1.0 } else { 1.0 };
        let normal = if length > 1e-9 { way * (sign / length) } else { Vector3::y() };
        SurfacePoint { distance: sign * length, normal }
    }
}
