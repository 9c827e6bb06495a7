//! Forces on the mass of a body: gravity, and the motion of its anchors.

use nalgebra::{Matrix3, Vector3};

use super::Kernel;
use crate::{
    simd::with_registers,
    step::{
        Frame, FrameMotion, State,
        gravity::{BendStep, MassForce},
    },
};

impl Kernel {
    /// Prepares the data that gravity needs, so that the first step does not allocate them.
    pub(super) fn prepare_weight(&self) {
        if self.bends_under(&self.gravity(&Frame::default())) {
            self.model.mass_sites();
        }
    }

    /// Prepares the data that [`Load::motion`] needs, so that the steps do not allocate them.
    pub(crate) fn prepare_motion(&self) {
        if !self.model.is_free() {
            self.model.moments();
            self.model.mass_sites();
        }
    }

    /// Writes the modal force of gravity on an anchored body, kg^1/2 m/s^2, to `force`.
    pub(crate) fn weight(&self, frame: &Frame, q: &[f64], force: &mut [f64]) {
        let gravity = self.gravity(frame);
        self.force_at_rest(&gravity, force);
        if self.bends_under(&gravity) {
            self.model.mass_sites().add(&gravity, q, force);
        }
    }

    /// Gravity on the modes of an anchored body. That on a free body moves its frame.
    pub(super) fn gravity(&self, frame: &Frame) -> MassForce {
        if self.model.is_free() {
            return MassForce::default();
        }
        MassForce::of_gravity(frame.rotation().inverse() * Vector3::from(self.settings.gravity))
    }

    /// Gravity and the motion of the anchors as forces on the modes of an anchored body.
    ///
    /// The anchors leave no part of the body behind faster than it can follow: in one step its
    /// lowest mode gains at most the speed with which it swings by the size of the body, and moves
    /// by at most that size. A frame that jumps thus does not tear the body apart.
    pub(super) fn mass_force(&self, frame: &Frame, motion: &FrameMotion) -> MassForce {
        let gravity = self.gravity(frame);
        if self.model.is_free() || *motion == FrameMotion::default() {
            return gravity;
        }
        let Some(lowest) = self.modes.omega.first() else { return gravity };
        let limit = self.model.size() * lowest.min(1.0 / self.h) / self.h;
        let inertia = motion.force(self.model.moments().reach, limit);
        MassForce { uniform: gravity.uniform + inertia.uniform, ..inertia }
    }

    /// Whether the work of a force on the deformed shape differs from that on the rest shape.
    pub(super) fn bends_under(&self, force: &MassForce) -> bool {
        self.warps() && *force != MassForce::default()
    }

    /// Writes the modal force of `by` on the undeformed shape to `force`.
    pub(super) fn force_at_rest(&self, by: &MassForce, force: &mut [f64]) {
        force.fill(0.0);
        if *by == MassForce::default() {
            return;
        }
        for (f, participation) in force.iter_mut().zip(self.model.participation()) {
            *f = by.uniform.dot(&Vector3::from(*participation));
        }
        if by.gradient != Matrix3::zeros() {
            for (f, moment) in force.iter_mut().zip(&self.model.moments().first) {
                *f += by.gradient.dot(moment);
            }
        }
    }

    /// Adds the effect of `by` on the bend between both shapes of the step to the step without
    /// hands.
    pub(super) fn bend_under(&mut self, by: &MassForce, state: &mut State) {
        let (modes, sites) = (&self.modes, self.model.mass_sites());
        let largest = self.force.iter().fold(0.0f64, |most, f| most.max(f.abs()));
        let (response, softest) = (&modes.response[0][..], modes.softest);
        let (from, to) = (&self.before.q[..], &mut state.q[..]);
        let (force, scratch) = (&mut self.pulls[..], &mut self.bend);
        with_registers(BendStep { sites, by, response, softest, from, to, largest, force, scratch });
        self.modes.respond_beyond(&self.pulls, state);
        for (force, bend) in self.force.iter_mut().zip(&self.pulls) {
            *force += bend;
        }
    }

    /// Potential energy in gravity, J: of the deformation of an anchored body, of the position of a
    /// free body.
    pub fn potential_energy(&self, state: &State) -> f64 {
        let gravity = Vector3::from(self.settings.gravity);
        if gravity == Vector3::zeros() {
            return 0.0;
        }
        if self.model.is_free() {
            return -self.model.mass() * gravity.dot(&Vector3::from(state.frame.center()));
        }
        let local = self.gravity(&state.frame);
        let straight = state.q.iter().zip(self.model.participation());
        let straight: f64 = straight.map(|(q, p)| q * local.uniform.dot(&Vector3::from(*p))).sum();
        let bent = if self.warps() { self.model.mass_sites().work(&local, &state.q) } else { 0.0 };
        -(straight + bent)
    }
}
