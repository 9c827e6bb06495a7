//! Obstacles: rigid shapes that bodies touch.

use nalgebra::{UnitQuaternion, Vector3};

use super::{FixedObstacle, FixedShape};
use crate::{StepError, error::finite};

/// Distance and direction from a point to the surface of an obstacle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfacePoint {
    /// Signed distance of the point to the surface, m. It is negative inside the obstacle.
    pub distance: f64,
    /// Gradient of the distance: the outward normal at the closest point of the surface. Unit
    /// length, world axes.
    pub normal: Vector3<f64>,
}

/// A rigid shape that bodies touch.
///
/// The distance must be exact or smaller than the exact distance, both inside and outside.
pub trait ObstacleShape: std::fmt::Debug + Send + Sync {
    /// Signed distance and normal at a point (m, world axes).
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint;

    /// Velocity of the obstacle's material at a point (m, world axes) over the step, m/s. Default:
    /// zero.
    ///
    /// An obstacle that moves is given at its pose at the end of the step.
    fn velocity(&self, point: &Vector3<f64>) -> Vector3<f64> {
        let _ = point;
        Vector3::zeros()
    }

    /// Mean curvature of the surface, 1/m, positive for a ball. It decides how wide a contact with
    /// a part of a body that is a part of a sphere is. Default: 0, for a shape that is flat where
    /// it is touched.
    fn curvature(&self) -> f64 {
        0.0
    }

    /// Coefficient of friction of the surface, 0 to
    /// [`Contacts::MAX_FRICTION`](crate::Contacts::MAX_FRICTION). A contact has the geometric mean
    /// of it and of that of the body or the probe. Default: `None`, a contact has theirs.
    fn friction(&self) -> Option<f64> {
        None
    }

    /// Checks the numbers of the obstacle.
    ///
    /// # Errors
    /// Returns [`StepError::Input`] for a number that is not finite or out of range.
    fn check(&self) -> Result<(), StepError> {
        Ok(())
    }

    /// The obstacle as plain data, which other machines can have. Default: `None`, for a shape that
    /// has no such form. An obstacle that moves or has a friction of its own has none.
    fn fixed(&self) -> Option<FixedObstacle> {
        None
    }

    /// Key of the [`Rigid`](crate::Rigid) to which the obstacle belongs, and which contacts push.
    /// Default: `None`, for an obstacle that moves as it does whatever touches it.
    ///
    /// An obstacle of a rigid body is given at the pose that it has at the end of the step without
    /// forces: the center of mass has gone by `h` times its velocity.
    fn rigid(&self) -> Option<[u64; 2]> {
        None
    }
}

/// Returns the vector's length and its direction. A vector without direction returns `otherwise`.
pub(super) fn direction(v: Vector3<f64>, otherwise: Vector3<f64>) -> (f64, Vector3<f64>) {
    let length = v.norm();
    if length > f64::MIN_POSITIVE { (length, v / length) } else { (0.0, otherwise) }
}

fn not_negative(what: &'static str, length: f64) -> Result<(), StepError> {
    StepError::check(what, "finite meters, 0 or more", length.is_finite() && length >= 0.0, length)
}

/// A half-space: everything below a plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// A point of the plane, m, world axes.
    pub point: [f64; 3],
    /// Outward normal. Its length does not matter, but must be at least 1e-9.
    pub normal: [f64; 3],
}

impl Plane {
    /// The ground `y = 0`.
    pub const GROUND: Self = Self { point: [0.0; 3], normal: [0.0, 1.0, 0.0] };
}

impl ObstacleShape for Plane {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let (_, normal) = direction(Vector3::from(self.normal), Vector3::y());
        SurfacePoint { distance: normal.dot(&(point - Vector3::from(self.point))), normal }
    }

    fn check(&self) -> Result<(), StepError> {
        finite("point of a plane", &self.point)?;
        finite("normal of a plane", &self.normal)?;
        let length = Vector3::from(self.normal).norm();
        let sound = length >= 1e-9 && length.is_finite();
        StepError::check("normal of a plane", "a length of 1e-9 or more", sound, length)
    }

    fn fixed(&self) -> Option<FixedObstacle> {
        Some(FixedObstacle::upright(FixedShape::Plane, self.point, self.normal))
    }
}

/// A ball.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sphere {
    /// Center, m, world axes.
    pub center: [f64; 3],
    /// Radius, m, 0 or more.
    pub radius: f64,
}

impl ObstacleShape for Sphere {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let (length, normal) = direction(point - Vector3::from(self.center), Vector3::y());
        SurfacePoint { distance: length - self.radius, normal }
    }

    fn curvature(&self) -> f64 {
        1.0 / self.radius
    }

    fn check(&self) -> Result<(), StepError> {
        finite("center of a sphere", &self.center)?;
        not_negative("radius of a sphere", self.radius)
    }

    fn fixed(&self) -> Option<FixedObstacle> {
        let shape = FixedShape::Ball { radius: self.radius };
        Some(FixedObstacle { shape, position: self.center, ..FixedObstacle::GROUND })
    }
}

/// A cylinder with round ends: all points within `radius` of the line between two points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Capsule {
    /// Centers of the two round ends, m, world axes.
    pub ends: [[f64; 3]; 2],
    /// Radius, m, 0 or more.
    pub radius: f64,
}

impl ObstacleShape for Capsule {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let [a, b] = self.ends.map(Vector3::from);
        let along = b - a;
        let t = ((point - a).dot(&along) / along.norm_squared().max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        // On the axis any direction across it will do.
        let across = along.cross(&Vector3::x());
        let across = if across.norm() > 0.1 * along.norm() { across } else { along.cross(&Vector3::y()) };
        let (_, across) = direction(across, Vector3::y());
        let (length, normal) = direction(point - (a + t * along), across);
        SurfacePoint { distance: length - self.radius, normal }
    }

    /// That of its side.
    fn curvature(&self) -> f64 {
        0.5 / self.radius
    }

    fn check(&self) -> Result<(), StepError> {
        finite("end of a capsule", self.ends.as_flattened())?;
        not_negative("radius of a capsule", self.radius)
    }

    fn fixed(&self) -> Option<FixedObstacle> {
        let [a, b] = self.ends.map(Vector3::from);
        let shape = FixedShape::Capsule { radius: self.radius, half_length: 0.5 * (b - a).norm() };
        Some(FixedObstacle::upright(shape, (0.5 * (a + b)).into(), (b - a).into()))
    }
}

/// A box with edges along its own axes, which may be turned and rounded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cuboid {
    /// Center, m, world axes.
    pub center: [f64; 3],
    /// Rotation from the box's to world axes: a quaternion x, y, z, w of non-zero length.
    pub rotation: [f64; 4],
    /// Half the lengths of the edges, m, 0 or more, without the rounding.
    pub half: [f64; 3],
    /// Radius by which the box is grown, and its edges are rounded, m, 0 or more.
    pub round: f64,
}

impl Cuboid {
    fn turn(&self) -> UnitQuaternion<f64> {
        let [x, y, z, w] = self.rotation;
        UnitQuaternion::try_new(nalgebra::Quaternion::new(w, x, y, z), 1e-9).unwrap_or_default()
    }
}

impl ObstacleShape for Cuboid {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let turn = self.turn();
        let local = turn.inverse() * (point - Vector3::from(self.center));
        let over = local.abs() - Vector3::from(self.half);
        let outside = over.map(|x| x.max(0.0));
        let signs = local.map(|x| if x < 0.0 { -1.0 } else { 1.0 });
        let (distance, normal) = if outside.amax() > 0.0 {
            let (length, normal) = direction(outside, Vector3::y());
            (length, normal.component_mul(&signs))
        } else {
            // Inside, the closest face counts.
            let axis = over.imax();
            (over[axis], Vector3::ith(axis, signs[axis]))
        };
        SurfacePoint { distance: distance - self.round, normal: turn * normal }
    }

    fn check(&self) -> Result<(), StepError> {
        finite("center of a box", &self.center)?;
        finite("rotation of a box", &self.rotation)?;
        let length = self.rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
        let sound = length > 1e-9 && length.is_finite();
        StepError::check("rotation of a box", "a quaternion of non-zero length", sound, length)?;
        self.half.iter().try_for_each(|half| not_negative("half an edge of a box", *half))?;
        not_negative("rounding of a box", self.round)
    }

    fn fixed(&self) -> Option<FixedObstacle> {
        let turn = self.turn();
        let shape = FixedShape::Box { half: self.half, round: self.round };
        Some(FixedObstacle { shape, position: self.center, rotation: [turn.i, turn.j, turn.k, turn.w] })
    }
}

/// An obstacle that is described in its own axes, with a pose and a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moving<O> {
    /// The obstacle in its own axes.
    pub shape: O,
    /// Position of its origin at the end of the step, m, world axes.
    pub position: [f64; 3],
    /// Rotation from its own to world axes at the end of the step: a quaternion x, y, z, w of
    /// non-zero length.
    pub rotation: [f64; 4],
    /// Velocity of its origin, m/s, world axes.
    pub velocity: [f64; 3],
    /// Angular velocity, rad/s, world axes.
    pub angular_velocity: [f64; 3],
}

impl<O: ObstacleShape> ObstacleShape for Moving<O> {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        let [x, y, z, w] = self.rotation;
        let turn = UnitQuaternion::try_new(nalgebra::Quaternion::new(w, x, y, z), 1e-9).unwrap_or_default();
        let found = self.shape.at(&(turn.inverse() * (point - Vector3::from(self.position))));
        SurfacePoint { normal: turn * found.normal, ..found }
    }

    fn velocity(&self, point: &Vector3<f64>) -> Vector3<f64> {
        let arm = point - Vector3::from(self.position);
        Vector3::from(self.velocity) + Vector3::from(self.angular_velocity).cross(&arm)
    }

    fn curvature(&self) -> f64 {
        self.shape.curvature()
    }

    fn friction(&self) -> Option<f64> {
        self.shape.friction()
    }

    fn check(&self) -> Result<(), StepError> {
        finite("position of an obstacle", &self.position)?;
        finite("rotation of an obstacle", &self.rotation)?;
        finite("velocity of an obstacle", &self.velocity)?;
        finite("angular velocity of an obstacle", &self.angular_velocity)?;
        let length = self.rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
        let sound = length > 1e-9 && length.is_finite();
        StepError::check("rotation of an obstacle", "a quaternion of non-zero length", sound, length)?;
        self.shape.check()
    }

    fn fixed(&self) -> Option<FixedObstacle> {
        let still = self.velocity == [0.0; 3] && self.angular_velocity == [0.0; 3];
        let FixedObstacle { shape, position, rotation } = self.shape.fixed().filter(|_| still)?;
        let of = |[x, y, z, w]: [f64; 4]| {
            UnitQuaternion::try_new(nalgebra::Quaternion::new(w, x, y, z), 1e-9).unwrap_or_default()
        };
        let turn = of(self.rotation);
        let position = turn * Vector3::from(position) + Vector3::from(self.position);
        let turn = turn * of(rotation);
        Some(FixedObstacle { shape, position: position.into(), rotation: [turn.i, turn.j, turn.k, turn.w] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The distance must be the length of the way along the normal, everywhere.
    #[test]
    fn normals_lead_to_the_surface_and_are_the_gradients_of_the_distance() {
        let turned = [0.1, 0.3, -0.2, 0.9];
        let cuboid = Cuboid { center: [0.1, 0.2, 0.3], rotation: turned, half: [0.5, 0.2, 0.4], round: 0.05 };
        let plane = Plane { point: [0.0, 0.1, 0.0], normal: [1.0, 2.0, -0.5] };
        let capsule = Capsule { ends: [[0.0, 0.0, 0.0], [0.4, 0.5, -0.1]], radius: 0.2 };
        let sphere = Sphere { center: [0.1, -0.2, 0.3], radius: 0.4 };
        let (velocity, angular_velocity) = ([0.0; 3], [0.0; 3]);
        let moving = Moving {
            shape: capsule,
            position: [0.3, 0.1, 0.0],
            rotation: turned,
            velocity,
            angular_velocity,
        };
        let all: [&dyn ObstacleShape; 5] = [&cuboid, &plane, &capsule, &sphere, &moving];
        for obstacle in all {
            obstacle.check().unwrap();
            for i in 1..200 {
                let at = |k: f64| 1.2 * (f64::from(i) * k).sin();
                let point = Vector3::new(at(0.7), at(1.3), at(2.1));
                let found = obstacle.at(&point);
                assert!((found.normal.norm() - 1.0).abs() < 1e-12);
                let surface = obstacle.at(&(point - found.distance * found.normal));
                assert!(surface.distance.abs() < 1e-9, "{obstacle:?} {point}: {}", surface.distance);
                let slope = Vector3::from_fn(|axis, _| {
                    let step = Vector3::ith(axis, 1e-6);
                    (obstacle.at(&(point + step)).distance - obstacle.at(&(point - step)).distance) / 2e-6
                });
                assert!((slope - found.normal).norm() < 1e-4, "{obstacle:?} {point}: {slope}");
            }
        }
    }

    #[test]
    fn numbers_that_are_none_are_refused() {
        let nan = f64::NAN;
        let bad: [&dyn ObstacleShape; 5] = [
            &Plane { point: [nan, 0.0, 0.0], normal: [0.0, 1.0, 0.0] },
            &Plane { point: [0.0; 3], normal: [0.0; 3] },
            &Sphere { center: [0.0; 3], radius: nan },
            &Capsule { ends: [[0.0; 3], [f64::INFINITY, 0.0, 0.0]], radius: 0.1 },
            &Cuboid { center: [0.0; 3], rotation: [0.0; 4], half: [1.0; 3], round: 0.0 },
        ];
        assert!(bad.iter().all(|obstacle| obstacle.check().is_err()));
    }
}
