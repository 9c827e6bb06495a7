//! One step of a body: the modes without hands, then the hands, all at once and implicitly.

use nalgebra::{Matrix3, Vector3};

use super::{Body, RigidMotion, StepReport, grab::Grab};
use crate::StepError;

impl Body {
    /// One step of the configured length.
    ///
    /// Grabs are compliant and implicit: with `x = x* + A lambda` the patch's position after the step, the pull `lambda` (N) solves
    /// `(A + C) lambda = target - x*`, `C` the grab's compliance; the reaction is `-lambda`. Under warp the rows are corrected
    /// `corrections` times (Newton).
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
        let turn: Matrix3<f64> = *self.state.frame.rotation().to_rotation_matrix().matrix();
        let back = turn.transpose();
        let mut report = StepReport::default();
        for round in 0..corrections {
            for grab in &mut self.grabs {
                // Linearise where the last round ended; project the unheld step onto that plane.
                grab.linearise(&self.linear, self.config.warp);
                let ahead = grab.ahead(&self.linear, &self.state.q);
                let free_position = self.state.frame.to_world(ahead);
                let mut gap = grab.target - free_position - turn * grab.crept();
                if grab.config.relaxation > 0.0 {
                    let speed = turn
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
                grab.gap = back * gap;
                grab.arm = grab.at() - Vector3::from(self.model.center_of_mass());
            }
            if let Some(rigid) = &mut rigid {
                // The pulls of the round before, at first those of the step before, which are in world axes.
                let pull = |grab: &Grab| if round == 0 { back * grab.pull } else { grab.pull };
                rigid.tighten(&self.model, self.grabs.iter().map(|grab| (grab.arm, pull(grab))));
            }
            report.regularised = self.schur.solve(&mut self.grabs, &self.coefficients, h, rigid.as_ref());
            if round + 1 < corrections {
                for (i, q) in self.linear.iter_mut().enumerate() {
                    let pull: f64 = self.grabs.iter().map(|g| g.row(i).dot(&g.pull)).sum();
                    *q = self.state.q[i] + self.coefficients[i].response[0] * pull;
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
        let (mut force, mut torque) = (Vector3::zeros(), Vector3::zeros());
        for grab in &mut self.grabs {
            grab.relax();
            // Solved in body axes; hands live in the world's.
            grab.pull = turn * grab.pull;
            force += grab.pull;
            torque += (turn * grab.arm).cross(&grab.pull);
            grab.last_target = grab.target;
        }
        if let Some(rigid) = &rigid {
            rigid.apply(&mut self.state.frame, &self.model, force, torque);
        }
        report
    }
}
