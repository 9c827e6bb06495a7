//! One step of a body: the modes without hands, then the hands, all at once and implicitly.

use nalgebra::{Matrix3, Vector3};

use super::{Body, Frame, RigidMotion, StepReport, grab::Grab};
use crate::{ModalModel, StepError};

impl Body {
    /// One step of the configured length.
    ///
    /// Grabs are compliant and implicit: with `x = x* + A lambda` the patch's position after the step, the pull `lambda` (N) solves
    /// `(A + C) lambda = target - x*`, `C` the grab's compliance; the reaction is `-lambda`. Under warp the rows are corrected
    /// `corrections` times (Newton), and so is the place of a free body's frame.
    ///
    /// # Errors
    /// [`StepError::Diverged`] when the result would not be finite; the body is then in the state it had before, unless that is one that nothing can be
    /// stepped from (with a number beyond 1e100 in it): then it is at rest where its frame is.
    pub fn step(&mut self) -> Result<StepReport, StepError> {
        self.before.clone_from(&self.state);
        let report = self.advance();
        self.pushes.fill(0.0);
        self.push_force = Vector3::zeros();
        self.push_torque = Vector3::zeros();
        match self.first_non_finite() {
            None => Ok(report),
            Some(what) => {
                self.state.clone_from(&self.before);
                if !self.state.is_moderate() {
                    self.state.stop();
                }
                for grab in &mut self.grabs {
                    grab.pull = Vector3::zeros();
                    grab.flow = Vector3::zeros();
                }
                Err(StepError::Diverged { what })
            }
        }
    }

    fn first_non_finite(&self) -> Option<&'static str> {
        let bad = |slice: &[f64]| slice.iter().any(|x| !x.is_finite());
        if bad(&self.state.q) {
            Some("modal coordinates")
        } else if bad(&self.state.v) {
            Some("modal velocities")
        } else if bad(&self.state.a) {
            Some("modal accelerations")
        } else if bad(&self.state.z) {
            Some("modal flows")
        } else if self.state.frame.check().is_err() {
            Some("the frame")
        } else if self.grabs.iter().any(|g| !g.pull.iter().chain(&g.flow).all(|x| x.is_finite())) {
            Some("a reaction")
        } else {
            None
        }
    }

    fn advance(&mut self) -> StepReport {
        let h = self.config.step;
        let gravity = Vector3::from(self.config.gravity);
        let gravity_local = self.state.frame.rotation().inverse() * gravity;
        let participation = self.model.participation();
        for (i, f) in self.force.iter_mut().enumerate() {
            *f = self.pushes[i]
                + if self.model.is_free() {
                    0.0
                } else {
                    gravity_local.dot(&Vector3::from(participation[i]))
                };
        }
        // The step without hands.
        self.linear.copy_from_slice(&self.state.q); // rows are first taken where the body is
        for (i, c) in self.coefficients.iter().enumerate() {
            let old = [self.state.q[i], self.state.v[i], self.state.a[i]];
            let [q, v, a] = c.step(old, self.state.f[i], self.force[i]);
            (self.state.q[i], self.state.v[i], self.state.a[i]) = (q, v, a);
        }
        for (i, flow) in self.flows.iter().enumerate() {
            let old = [self.before.q[i], self.before.v[i], self.before.a[i]];
            let z = self.before.z[i];
            self.state.q[i] += flow.onto[0] * z;
            self.state.v[i] += flow.onto[1] * z;
            self.state.a[i] += flow.onto[2] * z;
            self.state.z[i] = flow.step(old, z, self.state.f[i], self.force[i]);
        }
        let rigid = if self.model.is_free() {
            Some(RigidMotion::predict(
                &mut self.state.frame,
                &self.model,
                h,
                gravity,
                self.push_force,
                self.push_torque,
            ))
        } else {
            None
        };
        let mut report = StepReport::default();
        if !self.grabs.is_empty() {
            report = self.hold(rigid);
        }
        self.state.f.copy_from_slice(&self.force);
        report
    }

    /// Solves for the pulls of all grabs and adds what they do to the state.
    fn hold(&mut self, mut rigid: Option<RigidMotion>) -> StepReport {
        let h = self.config.step;
        let corrections = if self.config.warp { self.config.corrections.clamp(1, 8) } else { 1 };
        let reach = self.model.size();
        let mut report = StepReport::default();
        let mut place = Place::unheld(self.state.frame);
        for round in 0..corrections {
            for grab in &mut self.grabs {
                // Linearise where the last round ended.
                grab.linearise(&self.linear, self.config.warp);
                grab.arm = grab.at() - Vector3::from(self.model.center_of_mass());
                // The pulls of the round before, at first those of the step before, which are in world axes.
                grab.pull = place.axes * grab.pull;
            }
            if let Some(rigid) = &mut rigid {
                rigid.tighten(&self.model, self.grabs.iter().map(|grab| (grab.arm, grab.pull)));
            }
            for grab in &mut self.grabs {
                // Project the unheld step onto that plane.
                let ahead = grab.ahead(&self.linear, &self.state.q);
                let free_position = place.unheld_position(&self.model, rigid.as_ref(), ahead);
                let mut gap = grab.target - free_position - place.turn * grab.crept();
                if grab.config.relaxation > 0.0 {
                    let speed = place.turn
                        * grab.speed(&self.coefficients, &self.before.q, &self.state.q, &self.state.v, h)
                        + rigid.as_ref().map_or_else(Vector3::zeros, |_| {
                            self.state.frame.velocity_at(&self.model, ahead)
                        });
                    gap += grab.config.relaxation * (grab.target_velocity(h) - speed);
                }
                // A hand that is a body's length away pulls no harder than from there: targets may teleport.
                let distance = gap.norm();
                if distance > reach {
                    gap *= reach / distance;
                }
                grab.gap = place.back * gap;
            }
            report.regularised = self.schur.solve(&mut self.grabs, &self.coefficients, h, rigid.as_ref());
            if round + 1 < corrections {
                for (i, q) in self.linear.iter_mut().enumerate() {
                    let pull: f64 = self.grabs.iter().map(|g| g.row(i).dot(&g.pull)).sum();
                    *q = self.state.q[i] + self.coefficients[i].response[0] * pull;
                }
                if let Some(rigid) = &rigid {
                    place = place.moved(&self.state.frame, &self.model, rigid, &self.grabs);
                }
            }
        }
        for (i, c) in self.coefficients.iter().enumerate() {
            let pull: f64 = self.grabs.iter().map(|g| g.row(i).dot(&g.pull)).sum();
            self.force[i] += pull;
            self.state.q[i] += c.response[0] * pull;
            self.state.v[i] += c.response[1] * pull;
            self.state.a[i] += c.response[2] * pull;
            if let Some(flow) = self.flows.get(i) {
                self.state.z[i] += flow.response * pull;
            }
        }
        let [force, torque] = place.load(&self.grabs);
        if let Some(rigid) = &rigid {
            rigid.apply(&mut self.state.frame, &self.model, force, torque + place.slack(rigid));
        }
        for grab in &mut self.grabs {
            grab.relax();
            // Solved in body axes; hands live in the world's.
            grab.pull = place.turn * grab.pull;
            grab.last_target = grab.target;
        }
        report
    }
}

/// Where a round of the solution takes the frame to be: at first where it goes without hands, then where the pulls of the round before brought it.
/// Tension turns a body within a step, and the pulls with it: taken along a step late they would drive the modes that it bends.
struct Place {
    frame: Frame,
    /// From body to world axes, and back.
    turn: Matrix3<f64>,
    back: Matrix3<f64>,
    /// From the axes that the pulls are still told in to these body axes.
    axes: Matrix3<f64>,
    /// By what the pulls have moved it, m, world axes, and all of the turn since the unheld one, rad, body axes.
    way: Vector3<f64>,
    turned: Vector3<f64>,
}

impl Place {
    /// Turns of a step beyond this (rad; a hand that leaps) are not to be taken for their tangent: such a step keeps to the unheld place.
    const FARTHEST: f64 = 0.25;

    fn at(frame: Frame, pulls: &Matrix3<f64>, way: Vector3<f64>, turned: Vector3<f64>) -> Self {
        let turn: Matrix3<f64> = *frame.rotation().to_rotation_matrix().matrix();
        let back = turn.transpose();
        Self { frame, turn, back, axes: back * pulls, way, turned }
    }

    fn unheld(frame: Frame) -> Self {
        Self::at(frame, &Matrix3::identity(), Vector3::zeros(), Vector3::zeros())
    }

    fn moved(&self, unheld: &Frame, model: &ModalModel, rigid: &RigidMotion, grabs: &[Grab]) -> Self {
        let [force, torque] = self.load(grabs);
        let mut frame = *unheld;
        rigid.apply(&mut frame, model, force, torque + self.slack(rigid));
        let turned = (unheld.rotation().inverse() * frame.rotation()).scaled_axis();
        if turned.norm() < Self::FARTHEST {
            Self::at(frame, &self.turn, rigid.way(force), turned)
        } else {
            Self::at(*unheld, &self.turn, Vector3::zeros(), Vector3::zeros())
        }
    }

    /// Force (N) and torque about the centre of mass (N m) of the pulls, world axes.
    fn load(&self, grabs: &[Grab]) -> [Vector3<f64>; 2] {
        grabs.iter().fold([Vector3::zeros(); 2], |[force, torque], grab| {
            let pull = self.turn * grab.pull;
            [force + pull, torque + (self.turn * grab.arm).cross(&pull)]
        })
    }

    /// What is to be added to a torque (N m, world axes) that is told for this place already, where the rigid motion takes it for that of the unheld one.
    fn slack(&self, rigid: &RigidMotion) -> Vector3<f64> {
        self.turn * rigid.slack(&self.turned)
    }

    /// Where a point (m, body axes) is, to first order about this place, when nobody pulls: m, world axes.
    fn unheld_position(
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
