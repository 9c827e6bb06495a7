//! One contact in a step: a site of a body at an obstacle or at another body.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::{
    Indent, Spot, Touched,
    cone::{self, Status},
    surface_field::{Carriers, Place},
};
use crate::{saved::PlainMemory, step::Tangent};

/// A contact of the last step.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(from = "PlainMemory", into = "PlainMemory")]
pub(crate) struct Memory {
    pub(crate) other: Touched,
    pub(crate) site: usize,
    /// Force on the body, N, world axes.
    pub(crate) force: Vector3<f64>,
    /// Where the surface of the site sticks, m: in world axes at an obstacle, in the axes of the
    /// other body, at rest, at a body.
    pub(crate) anchor: Vector3<f64>,
    /// Direction from the site's center to its contact point, body axes.
    pub(crate) toward: Vector3<f64>,
    /// The place of the other body.
    pub(crate) place: Option<Place>,
    /// Energy in the dent, J, where the site leads a ball.
    pub(crate) leads: Option<f64>,
}

/// The side of a contact at another body.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Far {
    /// The other body, as an index into the group.
    pub(crate) member: usize,
    pub(crate) place: Place,
    /// Whether the place stays for this step, because the site has passed through it.
    pub(crate) passed: bool,
    /// The sites on which the force acts. They stay as the first computed step has them.
    pub(crate) carriers: Carriers,
    /// Position of the place's material at the beginning and at the end of the step, m, world axes.
    pub(crate) start: Vector3<f64>,
    pub(crate) end: Vector3<f64>,
    /// As for [`ContactPoint`].
    pub(crate) tangent: Tangent,
    pub(crate) mean: Option<Tangent>,
    /// Where the force acts, m, world axes: the middle of the contact over the step. Arms of both
    /// bodies lead to it, so that no angular momentum is lost.
    pub(crate) middle: Vector3<f64>,
    pub(crate) arm: Vector3<f64>,
    /// Compliance of the place, m/N, world axes.
    pub(crate) compliance: Matrix3<f64>,
    /// Where the surface sticks, at the beginning of the step, m, world axes.
    pub(crate) anchor: Vector3<f64>,
}

/// The side of a contact at a probe.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AtProbe {
    /// The probe, as an index into those of the group, and its span.
    pub(crate) probe: usize,
    pub(crate) span: usize,
    /// The material of the body that touches, and the sites on which the force acts. They stay as
    /// the step finds them. `None` at an obstacle.
    pub(crate) first: Option<(Place, Carriers)>,
    /// The place of the body that is nearest at the end of the step.
    pub(crate) last: Option<Place>,
    /// The place of the probe whose material touches, and the one that is nearest at the end of the
    /// step.
    pub(crate) spot: Spot,
    pub(crate) nearest: Spot,
    /// From the tool point to where the force acts, m, world axes.
    pub(crate) arm: Vector3<f64>,
    /// Where the center of the sphere would be at the end of the step if it had gone as the
    /// material that touches, m, world axes.
    pub(crate) carried: Vector3<f64>,
    /// A point and the normal of the surface at the end of the last computed step, m, world axes.
    pub(crate) plane: [Vector3<f64>; 2],
}

/// The side of a contact at a rigid body, on which the force acts in the opposite direction.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AtRigid {
    /// The rigid body, as an index into all, and its span.
    pub(crate) rigid: usize,
    pub(crate) span: usize,
    /// Where the force acts, m, world axes: arms of both bodies lead to it.
    pub(crate) middle: Vector3<f64>,
    pub(crate) arm: Vector3<f64>,
    /// Way of the surface in the step without forces, m, world axes.
    pub(crate) carried: Vector3<f64>,
    /// Where the surface sticks, at the beginning of the step, m, world axes.
    pub(crate) anchor: Vector3<f64>,
}

/// The first side of a contact of a rigid body with another of its engine, or with what stands
/// still. The member of the contact is the span of the rigid body.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AtSupport {
    pub(crate) rigid: usize,
    pub(crate) support: usize,
    pub(crate) arm: Vector3<f64>,
}

/// A patch at the point to which it is attached. The axes are those of the world.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AtAttachment {
    /// Index of the attachment in the body's list.
    pub(crate) index: usize,
    /// Position of the point at the beginning of the step, m, world axes.
    pub(crate) start: Vector3<f64>,
    /// From the point to the patch at the beginning of the step, and what may be left of it at the
    /// end, m, world axes.
    pub(crate) apart: Vector3<f64>,
    pub(crate) left: Vector3<f64>,
    /// Where the force acts on the body, m, world axes.
    pub(crate) middle: Vector3<f64>,
    /// Share of the torque that turns the body, and what it is attached to.
    pub(crate) turns: [f64; 2],
    /// Torque of the friction that calms what is attached, N m, world axes.
    pub(crate) rub: Vector3<f64>,
}

/// A place that touches, or may touch, in this step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ContactPoint {
    /// The body of the site, as an index into the group.
    pub(crate) member: usize,
    pub(crate) site: usize,
    pub(crate) other: Touched,
    /// The side at another body. `None` at an obstacle.
    pub(crate) far: Option<Far>,
    /// The side at a probe. The force is on the body, and at an obstacle on the probe, whose span
    /// then is the member. The anchor is relative to the center of the sphere at a body.
    pub(crate) probe: Option<AtProbe>,
    /// The side at a rigid body to which the obstacle belongs.
    pub(crate) rigid: Option<AtRigid>,
    pub(crate) support: Option<AtSupport>,
    pub(crate) attached: Option<AtAttachment>,
    /// The law of the dent where the site leads a ball. The compliance is its tangent, and the
    /// offset has its shift.
    pub(crate) indent: Option<Indent>,
    pub(crate) friction: f64,
    /// Directions from the site's center to the contact point at the beginning and at the end of
    /// the step, body axes.
    pub(crate) first: Vector3<f64>,
    pub(crate) last: Vector3<f64>,
    /// Position of the first contact point's material at the beginning and at the end, m, world
    /// axes. The position of the last contact point at the end.
    pub(crate) start: Vector3<f64>,
    pub(crate) end: Vector3<f64>,
    pub(crate) place: Vector3<f64>,
    /// Way of the other surface in the step, m, world axes.
    pub(crate) carried: Vector3<f64>,
    pub(crate) anchor: Vector3<f64>,
    /// Force at the end of the step before, N, world axes, and the energy in the compliance then,
    /// J.
    pub(crate) before: Vector3<f64>,
    pub(crate) stored_before: f64,
    /// Gap at the beginning of the step and the smallest gap allowed at its end, m.
    pub(crate) gap: f64,
    pub(crate) floor: f64,
    /// Whether the site has passed through an obstacle.
    pub(crate) passed: bool,
    /// Rows: normal and two tangents, world axes.
    pub(crate) axes: Matrix3<f64>,
    /// Compliance of the site and of what it touches, m/N, world axes.
    pub(crate) compliance: Matrix3<f64>,
    /// Compliance in contact axes, and with the response to its own force.
    pub(super) local: Matrix3<f64>,
    pub(super) block: Matrix3<f64>,
    /// Inverse of the compliance in the direct solve, N/m.
    pub(super) stiffness: Matrix3<f64>,
    /// Gap and tangential offset at the end of the last computed step without the compliance, m,
    /// contact axes.
    pub(crate) off: Vector3<f64>,
    /// Force of the last computed step, and of the solve, N, contact axes.
    pub(crate) pushed: Vector3<f64>,
    pub(crate) force: Vector3<f64>,
    pub(super) status: Status,
    /// How far the surface slides, m.
    pub(super) slid: f64,
    /// Derivative of the site's position by the six numbers of its patch, world axes: at the
    /// beginning of the step, and its mean over the step, by which forces act on the modes. The
    /// mean stays as the first computed step has it.
    pub(crate) tangent: Tangent,
    pub(crate) mean: Option<Tangent>,
    /// Arm of the contact about the center of mass, m, world axes.
    pub(crate) arm: Vector3<f64>,
}

impl ContactPoint {
    pub(crate) fn new(member: usize, site: usize, other: Touched, friction: f64) -> Self {
        let zero = Vector3::zeros();
        Self {
            member,
            site,
            other,
            far: None,
            probe: None,
            rigid: None,
            support: None,
            attached: None,
            indent: None,
            friction,
            first: zero,
            last: zero,
            start: zero,
            end: zero,
            place: zero,
            carried: zero,
            anchor: zero,
            before: zero,
            stored_before: 0.0,
            gap: 0.0,
            floor: 0.0,
            passed: false,
            axes: Matrix3::identity(),
            compliance: Matrix3::zeros(),
            local: Matrix3::zeros(),
            block: Matrix3::zeros(),
            stiffness: Matrix3::zeros(),
            off: zero,
            pushed: zero,
            force: zero,
            status: Status::Open,
            slid: 0.0,
            tangent: Tangent::zeros(),
            mean: None,
            arm: zero,
        }
    }

    /// Whether the point has a force in the last computed step.
    pub(crate) fn acts(&self) -> bool {
        self.admits(&self.pushed) && self.pushed != Vector3::zeros()
    }

    /// Whether the point may have a force (N, contact axes): a contact does not pull.
    pub(super) fn admits(&self, force: &Vector3<f64>) -> bool {
        self.attached.is_some() || force[0] > 0.0
    }

    /// Force (N) for a response and a gap without the force (m), contact axes.
    pub(super) fn law(&self, response: &Matrix3<f64>, free: &Vector3<f64>) -> (Vector3<f64>, Status) {
        if self.attached.is_none() {
            return cone::solve(response, free, self.friction, &self.force);
        }
        match response.cholesky() {
            Some(factor) => (-factor.solve(free), Status::Stick),
            None => (Vector3::zeros(), Status::Open),
        }
    }

    /// Work that the step may do to take back what is amiss at its beginning, J.
    pub(crate) fn recovery(&self) -> f64 {
        match &self.attached {
            Some(at) => self.pushed.dot(&(at.left - at.apart)).max(0.0),
            // With a normal that has turned, a force may come to point into the surface.
            None => self.pushed[0] * (self.floor - self.gap).max(0.0),
        }
    }

    /// The sites that carry the point, with their weights.
    pub(crate) fn carriers(&self) -> impl Iterator<Item = (usize, f64)> + Clone + '_ {
        let alone = self.indent.is_none().then_some((self.site, 1.0));
        alone.into_iter().chain(self.indent.iter().flat_map(|indent| indent.carriers.iter()))
    }

    /// Force of the last computed step, N, world axes.
    pub(crate) fn world_force(&self) -> Vector3<f64> {
        self.axes.tr_mul(&self.pushed)
    }

    /// Energy in the compliance under a force, J.
    pub(crate) fn stored(&self, force: &Vector3<f64>) -> f64 {
        let linear = |force: &Vector3<f64>| 0.5 * force.dot(&(self.compliance * force));
        let Some(indent) = &self.indent else { return linear(force) };
        let normal = self.axes.row(0).transpose();
        let along = normal.dot(force);
        linear(force) - linear(&(along * normal)) + indent.energy(along)
    }

    /// Takes the tangent of the dent at a force along the normal (N).
    pub(crate) fn linearize(&mut self, force: f64) {
        let normal = self.axes.row(0).transpose();
        if let Some(indent) = &mut self.indent {
            let shift = indent.shift;
            self.compliance = indent.linearize(&normal, force);
            self.off[0] += indent.shift - shift;
            self.local = self.axes * self.compliance * self.axes.transpose();
        }
    }

    /// Distance by which the dent differs from its tangent at the force of the solve, m.
    pub(super) fn bends(&self) -> f64 {
        let dent = |indent: &Indent| indent.dent(self.force[0]).0 - indent.shift;
        self.indent.as_ref().map_or(0.0, |indent| (dent(indent) - self.local[(0, 0)] * self.force[0]).abs())
    }

    /// Work that a force (N, world axes) does on the contact point beyond that on the material of
    /// the first one, J. Where a ball rolls, its material leaves the other surface, and the contact
    /// point does not.
    pub(crate) fn rolled(&self, force: &Vector3<f64>) -> f64 {
        let Some(indent) = &self.indent else { return 0.0 };
        let normal = self.axes.row(0).transpose();
        let begun = self.gap - indent.dent(normal.dot(&self.before)).0;
        let ended = self.off[0] - indent.shift + self.floor;
        let material = normal.dot(&(self.end - self.start - self.carried));
        normal.dot(force) * (ended - begun - material)
    }

    /// Dent of the surface under a force, m, world axes.
    pub(crate) fn dent(&self, force: &Vector3<f64>) -> Vector3<f64> {
        let shift = self.indent.as_ref().map_or(0.0, |indent| indent.shift);
        self.compliance * force + shift * self.axes.row(0).transpose()
    }

    /// Takes the compliance (m/N, world axes) of a point whose axes stay.
    pub(crate) fn comply(&mut self, compliance: Matrix3<f64>) {
        self.compliance = compliance;
        self.local = self.axes * compliance * self.axes.transpose();
    }

    /// Turns the axes to a normal. The forces keep their direction in the world.
    pub(crate) fn turn(&mut self, normal: &Vector3<f64>) {
        let (pushed, force) = (self.axes.tr_mul(&self.pushed), self.axes.tr_mul(&self.force));
        let least = normal.iamin();
        let first = normal.cross(&Vector3::ith(least, 1.0)).normalize();
        let second = normal.cross(&first);
        self.axes = Matrix3::from_rows(&[normal.transpose(), first.transpose(), second.transpose()]);
        self.local = self.axes * self.compliance * self.axes.transpose();
        (self.pushed, self.force) = (self.axes * pushed, self.axes * force);
    }

    /// Gap and offset of the surface at the end of the last computed step, m, contact axes.
    fn surface(&self) -> Vector3<f64> {
        self.off + self.local * self.pushed
    }

    /// Violation of the laws at the end of the last computed step, m.
    pub(crate) fn violation(&self) -> f64 {
        let u = self.surface();
        if self.attached.is_some() {
            return u.norm();
        }
        let (n, t) = (self.pushed[0], self.pushed[1].hypot(self.pushed[2]));
        if n <= 0.0 {
            return (-u[0]).max(0.0);
        }
        let most = self.friction * n;
        let slid = if t < most * (1.0 - 1e-9) || t == 0.0 && most > 0.0 {
            u[1].hypot(u[2])
        } else if t > 0.0 {
            // Sliding may only be against the force.
            let along = (u[1] * self.pushed[1] + u[2] * self.pushed[2]) / t;
            let across = (u[1] * self.pushed[2] - u[2] * self.pushed[1]) / t;
            // A force beyond the cone is a violation too.
            let beyond = (t - most).max(0.0) * self.local[(1, 1)];
            let beyond = if t > most * (1.0 + 1e-9) { beyond } else { 0.0 };
            along.max(0.0).hypot(across) + beyond
        } else {
            0.0
        };
        u[0].abs().hypot(slid)
    }
}
