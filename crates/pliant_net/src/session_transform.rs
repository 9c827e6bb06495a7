//! Session coordinates, in which points and forces of a body are sent over the network.
//!
//! An anchored body is streamed in its own axes. Each app may therefore place and scale it freely,
//! and hands still meet on the same spot of the surface. A free body is streamed in world axes,
//! together with its pose.

use bevy::math::{DQuat, DVec3};
use bevy::prelude::*;
use pliant_body::BodyState;
use pliant_stream::{Placement, RigidState};

/// The map between an app's world and session coordinates for one body:
///
/// `world = rotation * session * scale + origin`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SessionTransform {
    origin: DVec3,
    rotation: DQuat,
    scale: f64,
}

/// The placement of a body at a transform, whose scale is uniform.
pub(crate) fn placement_of(transform: &GlobalTransform) -> Placement {
    let (scale, rotation, translation) = transform.to_scale_rotation_translation();
    Placement { position: translation.into(), orientation: rotation.into(), scale: scale.x }
}

/// The transform of a body with a placement.
pub(crate) fn transform_of(placement: Placement) -> Transform {
    Transform {
        translation: placement.position.into(),
        rotation: Quat::from_array(placement.orientation).normalize(),
        scale: Vec3::splat(placement.scale),
    }
}

impl SessionTransform {
    /// Returns the session transform of an entity's body. Returns `None` while the entity's
    /// transform cannot place a body, in which case `pliant_body` has refused and reported it.
    pub(crate) fn of(transform: &GlobalTransform, free: bool) -> Option<Self> {
        let (scale, rotation, origin) = transform.to_scale_rotation_translation();
        if !(scale.x > 0.0 && scale.is_finite() && rotation.is_finite() && origin.is_finite()) {
            return None;
        }
        let scale = f64::from(scale.x);
        Some(match free {
            true => Self { origin: DVec3::ZERO, rotation: DQuat::IDENTITY, scale },
            false => Self { origin: origin.as_dvec3(), rotation: rotation.as_dquat().normalize(), scale },
        })
    }

    /// Returns the session transform of a body that has a local simulation state.
    pub(crate) fn of_body(transform: &GlobalTransform, state: &BodyState) -> Option<Self> {
        Self::of(transform, state.model().is_free())
    }

    pub(crate) fn point_to_session(&self, world: DVec3) -> [f64; 3] {
        (self.rotation.inverse() * (world - self.origin) / self.scale).into()
    }

    pub(crate) fn point_to_world(&self, session: [f64; 3]) -> DVec3 {
        self.rotation * (DVec3::from(session) * self.scale) + self.origin
    }

    /// Converts a point in body axes to this app's world. `pose` is the pose of a free body.
    pub(crate) fn body_point_to_world(&self, pose: Option<RigidState>, point: DVec3) -> DVec3 {
        let session = match pose {
            None => point,
            Some(pose) => DQuat::from_array(pose.rotation) * point + DVec3::from(pose.position),
        };
        self.point_to_world(session.into())
    }

    /// Forces scale like lengths, because the stiffness (N/m) stays as baked.
    pub(crate) fn force_to_session(&self, world: DVec3) -> [f64; 3] {
        (self.rotation.inverse() * world / self.scale).into()
    }

    pub(crate) fn force_to_world(&self, session: [f64; 3]) -> DVec3 {
        self.rotation * DVec3::from(session) * self.scale
    }
}

/// Places a free body between two session poses.
pub(crate) fn set_pose(
    transform: &mut Transform,
    from: &RigidState,
    to: &RigidState,
    fraction: f64,
    scale: f64,
) {
    let origin = DVec3::from(from.position).lerp(DVec3::from(to.position), fraction) * scale;
    let [from, to] = [from, to].map(|pose| DQuat::from_array(pose.rotation).normalize());
    let rotation = from.slerp(to, fraction).normalize();
    if origin.is_finite() && rotation.is_finite() {
        transform.translation = origin.as_vec3();
        transform.rotation = rotation.as_quat();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_and_forces_come_back_from_the_session() {
        let transform = Transform {
            translation: Vec3::new(1.0, -2.0, 3.0),
            rotation: Quat::from_euler(EulerRot::XYZ, 0.3, -1.1, 2.0),
            scale: Vec3::splat(2.5),
        };
        let place = SessionTransform::of(&GlobalTransform::from(transform), false).unwrap();
        let point = DVec3::new(0.4, 5.0, -0.6);
        // Transforms are in `f32`, which has seven digits.
        assert!(place.point_to_world(place.point_to_session(point)).distance(point) < 1e-6);
        assert!(place.force_to_world(place.force_to_session(point)).distance(point) < 1e-6);
        // The body's own origin is at the entity's position.
        assert!(place.point_to_world([0.0; 3]).distance(DVec3::new(1.0, -2.0, 3.0)) < 1e-6);
        // A force on a body twice as large is twice as large, because the stiffness in N/m stays
        // the same.
        assert!((place.force_to_world([0.0, 3.0, 0.0]).length() - 7.5).abs() < 1e-6);
        let free = SessionTransform::of(&GlobalTransform::from(transform), true).unwrap();
        assert!(DVec3::from(free.point_to_session(point)).distance(point / 2.5) < 1e-6);
    }

    #[test]
    fn no_place_for_what_cannot_be_placed() {
        for bad in [
            Transform::from_scale(Vec3::ZERO),
            Transform::from_xyz(f32::NAN, 0.0, 0.0),
            // A mirrored scale is neither a rotation nor a scale.
            Transform::from_scale(Vec3::splat(-1.0)),
        ] {
            for free in [false, true] {
                assert_eq!(SessionTransform::of(&GlobalTransform::from(bad), free), None, "{bad:?}");
            }
        }
    }
}
