//! Where a correction of a step takes a free body's frame to be.

use nalgebra::{Matrix3, Vector3};

use super::{Frame, RigidMotion};
use crate::ModalModel;

/// Where a correction takes the frame to be: at first where it goes without hands, then where the
/// pulls of the correction before brought it. Tension turns a body within a step, and the pulls with
/// it: taken along a step late they would drive the modes that it bends.
pub(crate) struct PredictedFrame {
    frame: Frame,
    /// From body to world axes, and back.
    pub(crate) turn: Matrix3<f64>,
    pub(crate) back: Matrix3<f64>,
    /// From the axes that the pulls are still told in to these body axes.
    pub(crate) axes: Matrix3<f64>,
    /// By what the pulls have moved it, m, world axes, and all of the turn since the unheld one, rad, body axes.
    way: Vector3<f64>,
    turned: Vector3<f64>,
}

impl PredictedFrame {
    /// Turns of a step beyond this (rad; a hand that leaps) are not to be taken for their tangent:
    /// such a step keeps to the unheld place.
    const FARTHEST: f64 = 0.25;

    fn at(frame: Frame, pulls: &Matrix3<f64>, way: Vector3<f64>, turned: Vector3<f64>) -> Self {
        let turn: Matrix3<f64> = *frame.rotation().to_rotation_matrix().matrix();
        let back = turn.transpose();
        Self { frame, turn, back, axes: back * pulls, way, turned }
    }

    /// Where the frame goes without hands.
    pub(crate) fn unheld(frame: Frame) -> Self {
        Self::at(frame, &Matrix3::identity(), Vector3::zeros(), Vector3::zeros())
    }

    /// Where force (N) and torque (N m, world axes) of the hands bring the unheld frame.
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

    /// What is to be added to a torque (N m, world axes) that is told for this place already, where
    /// the rigid motion takes it for that of the unheld one.
    pub(crate) fn slack(&self, rigid: &RigidMotion) -> Vector3<f64> {
        self.turn * rigid.slack(&self.turned)
    }

    /// Where a point (m, body axes) is, to first order about this place, when nobody pulls: m, world axes.
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
