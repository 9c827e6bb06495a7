//! Obstacles that stand still, as plain data, so that all machines of a session have the same.

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::{Capsule, Cuboid, Moving, ObstacleShape, Plane, Sphere, SurfacePoint};
use crate::StepError;

/// Largest number in an obstacle, m.
const MOST: f64 = 1e6;

/// The shape of a [`FixedObstacle`] in its own axes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum FixedShape {
    /// Everything below the origin, along the y axis.
    Plane,
    /// A ball around the origin.
    Ball {
        /// Radius, m, 0 or more.
        radius: f64,
    },
    /// A box around the origin.
    Box {
        /// Half the lengths of the edges, m, 0 or more, without the rounding.
        half: [f64; 3],
        /// Radius by which the box is grown, m, 0 or more.
        round: f64,
    },
    /// A cylinder with round ends along the y axis.
    Capsule {
        /// Radius, m, 0 or more.
        radius: f64,
        /// Half the distance of the centers of the two round ends, m, 0 or more.
        half_length: f64,
    },
}

/// An obstacle that stands still, as plain data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FixedObstacle {
    /// The shape in its own axes.
    pub shape: FixedShape,
    /// Position of its origin, m, world axes.
    pub position: [f64; 3],
    /// Rotation from its own to world axes: a quaternion x, y, z, w of unit length.
    pub rotation: [f64; 4],
}

impl FixedObstacle {
    /// The ground `y = 0`.
    pub const GROUND: Self =
        Self { shape: FixedShape::Plane, position: [0.0; 3], rotation: [0.0, 0.0, 0.0, 1.0] };

    /// A shape whose own axes lie at `position`, with the y axis turned to `up`.
    pub(super) fn upright(shape: FixedShape, position: [f64; 3], up: [f64; 3]) -> Self {
        let up = Vector3::from(up);
        // The opposite direction has many rotations.
        let turn = UnitQuaternion::rotation_between(&Vector3::y(), &up);
        let turn =
            turn.unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
        Self { shape, position, rotation: [turn.i, turn.j, turn.k, turn.w] }
    }

    fn placed<O>(&self, shape: O) -> Moving<O> {
        let (velocity, angular_velocity) = ([0.0; 3], [0.0; 3]);
        Moving { shape, position: self.position, rotation: self.rotation, velocity, angular_velocity }
    }

    fn visit<T>(&self, with: impl FnOnce(&dyn ObstacleShape) -> T) -> T {
        let center = [0.0; 3];
        match self.shape {
            FixedShape::Plane => with(&self.placed(Plane::GROUND)),
            FixedShape::Ball { radius } => with(&self.placed(Sphere { center, radius })),
            FixedShape::Box { half, round } => {
                with(&self.placed(Cuboid { center, rotation: [0.0, 0.0, 0.0, 1.0], half, round }))
            }
            FixedShape::Capsule { radius, half_length } => {
                let ends = [[0.0, -half_length, 0.0], [0.0, half_length, 0.0]];
                with(&self.placed(Capsule { ends, radius }))
            }
        }
    }
}

impl ObstacleShape for FixedObstacle {
    fn at(&self, point: &Vector3<f64>) -> SurfacePoint {
        self.visit(|obstacle| obstacle.at(point))
    }

    fn curvature(&self) -> f64 {
        self.visit(|obstacle| obstacle.curvature())
    }

    /// Refuses numbers beyond 1e6 too, and rotations whose length is not 1 within 1e-3.
    fn check(&self) -> Result<(), StepError> {
        self.visit(|obstacle| obstacle.check())?;
        let (lengths, one) = match self.shape {
            FixedShape::Plane => ([0.0; 3], 0.0),
            FixedShape::Ball { radius } => ([0.0; 3], radius),
            FixedShape::Box { half, round } => (half, round),
            FixedShape::Capsule { radius, half_length } => ([0.0, half_length, 0.0], radius),
        };
        let most = self.position.iter().chain(&lengths).fold(one, |most, x| x.abs().max(most));
        StepError::check("obstacle", "numbers of at most 1e6 m", most <= MOST && lengths[1] >= 0.0, most)?;
        let length = self.rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
        StepError::check("obstacle", "a rotation of length 1", (length - 1.0).abs() <= 1e-3, length)
    }

    fn fixed(&self) -> Option<FixedObstacle> {
        Some(*self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The description of an obstacle has its distances.
    #[test]
    fn an_obstacle_that_is_told_is_the_same_obstacle() {
        let turned = [0.1, 0.3, -0.2, (1.0f64 - 0.14).sqrt()];
        let still = |shape| Moving {
            shape,
            position: [0.3, 0.1, 0.0],
            rotation: turned,
            velocity: [0.0; 3],
            angular_velocity: [0.0; 3],
        };
        let capsule = Capsule { ends: [[0.0, 0.1, 0.0], [0.4, 0.5, -0.1]], radius: 0.2 };
        let all: [&dyn ObstacleShape; 7] = [
            &Plane { point: [0.0, 0.1, 0.0], normal: [1.0, 2.0, -0.5] },
            &Plane { point: [0.0, 0.1, 0.0], normal: [0.0, -3.0, 0.0] },
            &Sphere { center: [0.1, -0.2, 0.3], radius: 0.4 },
            &Cuboid { center: [0.1, 0.2, 0.3], rotation: turned, half: [0.5, 0.2, 0.4], round: 0.05 },
            &capsule,
            &still(capsule),
            &FixedObstacle { position: [0.0, 2.0, 0.0], ..FixedObstacle::GROUND },
        ];
        for obstacle in all {
            let told = obstacle.fixed().unwrap();
            told.check().unwrap();
            for i in 1..200 {
                let at = |k: f64| 1.2 * (f64::from(i) * k).sin();
                let point = Vector3::new(at(0.7), at(1.3), at(2.1));
                let (own, other) = (obstacle.at(&point), told.at(&point));
                assert!((own.distance - other.distance).abs() < 1e-12, "{obstacle:?} {point}");
                assert!((own.normal - other.normal).norm() < 1e-9, "{obstacle:?} {point}");
            }
        }
        let moves = Moving { velocity: [0.0, 1e-3, 0.0], ..still(capsule) };
        assert_eq!(moves.fixed(), None, "what moves does not stand still");
    }

    #[test]
    fn numbers_that_are_none_are_refused() {
        let with = |shape| FixedObstacle { shape, ..FixedObstacle::GROUND };
        for bad in [
            FixedObstacle { position: [f64::NAN, 0.0, 0.0], ..FixedObstacle::GROUND },
            FixedObstacle { position: [0.0, 2e6, 0.0], ..FixedObstacle::GROUND },
            FixedObstacle { rotation: [0.0; 4], ..FixedObstacle::GROUND },
            FixedObstacle { rotation: [0.0, 0.0, 0.0, 1.1], ..FixedObstacle::GROUND },
            with(FixedShape::Ball { radius: -1.0 }),
            with(FixedShape::Ball { radius: f64::INFINITY }),
            with(FixedShape::Box { half: [1.0, f64::NAN, 1.0], round: 0.0 }),
            with(FixedShape::Capsule { radius: 0.1, half_length: -1.0 }),
            with(FixedShape::Capsule { radius: 0.1, half_length: 1e300 }),
        ] {
            assert!(bad.check().is_err(), "{bad:?}");
        }
    }
}
