//! Prediction of a free body's frame for the corrections of a step.

use nalgebra::{Matrix3, Vector3};

use super::{Frame, RigidMotion};
use crate::ModalModel;

/// The predicted frame of a free body in one correction of a step.
///
/// In the first correction it is the frame without hands. In later corrections it is the frame to
/// which the forces of the previous correction moved the body. Tension turns a body within a step,
/// and the forces turn with the body. A frame that lags by one step would drive the modes that the
/// tension bends.
pub(crate) struct PredictedFrame {
    frame: Frame,
    /// Rotation from body to world axes. `back` is the inverse.
    pub(crate) turn: Matrix3<f64>,
    pub(crate) back: Matrix3<f64>,
    /// Rotation of the previous correction's forces to the body axes of this frame.
    pub(crate) axes: Matrix3<f64>,
    /// Translation due to the forces, m, world axes. `turned` is the whole turn relative to the
    /// frame without hands, rad, body axes.
    way: Vector3<f64>,
    turned: Vector3<f64>,
}

impl PredictedFrame {
    /// Largest turn of a step, rad, for which the tangent is valid. Beyond it (a target that jumps)
    /// the step keeps the frame without hands.
    const FARTHEST: f64 = 0.25;

    fn at(frame: Frame, pulls: &Matrix3<f64>, way: Vector3<f64>, turned: Vector3<f64>) -> Self {
        let turn: Matrix3<f64> = *frame.rotation().to_rotation_matrix().matrix();
        let back = turn.transpose();
        Self { frame, turn, back, axes: back * pulls, way, turned }
    }

    /// Makes the prediction without hands.
    pub(crate) fn unheld(frame: Frame) -> Self {
        Self::at(frame, &Matrix3::identity(), Vector3::zeros(), Vector3::zeros())
    }

    /// Predicts the frame from the force (N) and torque (N m, world axes) of the hands on the frame
    /// without hands.
    pub(crate) fn moved(
        &self,
        unheld: &Frame,
        model: &ModalModel,
        rigid: &RigidMotion,
        [force, torque]: [Vector3<f64>; 2],
    ) -> Self {
        let mut frame = *unheld;
        rigid.apply(&mut frame, model, force, torque + self.slack(rigid));
        let turned = (unheld.rotation().inverse() * frame.rotation()).scaled_axis();
        if turned.norm() < Self::FARTHEST {
            Self::at(frame, &self.turn, rigid.way(force), turned)
        } else {
            Self::at(*unheld, &self.turn, Vector3::zeros(), Vector3::zeros())
        }
    }

    /// Torque (N m, world axes) to add to a torque computed at this frame, because the rigid motion
    /// expects the torque at the frame without hands.
    pub(crate) fn slack(&self, rigid: &RigidMotion) -> Vector3<f64> {
        self.turn * rigid.slack(&self.turned)
    }

    /// World position (m) of a point (m, body axes) without hands, to first order about this frame.
    pub(crate) fn unheld_position(
        &self,
        model: &ModalModel,
        rigid: Option<&RigidMotion>,
        point: Vector3<f64>,
    ) -> Vector3<f64> {
        let arm = point - Vector3::from(model.center_of_mass());
        let turned = rigid.map_or_else(Vector3::zeros, |rigid| rigid.unpulled(&self.turned) - self.turned);
        self.frame.to_world(point) - self.way + self.turn * turned.cross(&arm)
    }
}
