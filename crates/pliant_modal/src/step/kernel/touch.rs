//! What contacts need of the step of one body: forces, places and responses.
//!
//! Contact forces act like loads that are constant over the step, so a step with contacts is a step
//! with these loads.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use super::Kernel;
use crate::{
    HeldPatch, ModalModel, StepError,
    contact::{
        Carriers, Cloud, ContactSites, Contacts, Indent, ObstacleShape, Shape, Site, Sixes, SurfacePoint,
    },
    simd::dot,
    step::{Frame, Hand, Six, State, Tangent, tangent},
};

/// Smallest and largest curvature of both surfaces together, as a multiple of that of the ball: in
/// a hollow that fits the contact is as wide as the ball, and a needle is no point.
const CURVED: [f64; 2] = [0.1, 100.0];

/// Radius of the contact of a ball without force, as a multiple of the spacing of the sites.
const SMALLEST: f64 = 0.02;

/// Contact forces on a body over a step.
#[derive(Debug, Clone, Default)]
pub(super) struct ContactPush {
    pub(super) is_on: bool,
    /// Modal force, kg^1/2 m/s^2.
    pub(super) modal: Vec<f64>,
    /// Force and torque about the center of mass on the frame of a free body, N and N m, world
    /// axes.
    pub(super) force: Vector3<f64>,
    pub(super) torque: Vector3<f64>,
    /// Way of the frame under a contact force as a share of `h^2` times the acceleration. At 1/2
    /// the way is exact and keeps the energy, but a stiff contact rings. At 1 it is that of the
    /// hands, which lose energy.
    pub(super) theta: f64,
}

impl ContactPush {
    /// Adds the force and the torque that act from the beginning of the step.
    pub(super) fn at_once(&self, force: Vector3<f64>, torque: Vector3<f64>) -> [Vector3<f64>; 2] {
        if self.is_on { [force + self.force, torque + self.theta * self.torque] } else { [force, torque] }
    }

    /// Corrects the way of the frame to the weight `theta`, and adds the rest of the spin.
    ///
    /// `force` is the sum of all constant forces without gravity. The weight is that of gravity
    /// too: at rest both cancel, and the velocity is zero.
    pub(super) fn add_rest(
        &self,
        frame: &mut Frame,
        model: &ModalModel,
        h: f64,
        force: Vector3<f64>,
        gravity: Vector3<f64>,
    ) {
        if self.is_on {
            let way = (self.theta - 0.5) * h * h * (force / model.mass() + gravity);
            frame.shift(way, (1.0 - self.theta) * h * self.torque);
        }
    }
}

/// A place of a site at some state.
pub(super) struct Located {
    /// Derivative of the position, world axes.
    pub(super) tangent: Tangent,
    pub(super) toward: Vector3<f64>,
    /// Direction from the center to the obstacle, body axes. Zero for a site that is not round.
    pub(super) wanted: Vector3<f64>,
    /// Displaced center of the site, m, body axes.
    pub(super) center: Vector3<f64>,
    pub(super) point: Vector3<f64>,
    pub(super) found: SurfacePoint,
}

pub(super) fn look(obstacle: &dyn ObstacleShape, point: &Vector3<f64>) -> Result<SurfacePoint, StepError> {
    let far = SurfacePoint { distance: f64::INFINITY, normal: Vector3::y() };
    // A state that has diverged is found by the step.
    if !point.iter().all(|x| x.is_finite()) {
        return Ok(far);
    }
    let found = obstacle.at(point);
    let length = found.normal.norm();
    let near = found.distance > f64::NEG_INFINITY;
    let sound = near && (length - 1.0).abs() < 1e-6;
    let got = if near { length } else { found.distance };
    StepError::check("obstacle", "a distance and a normal of length 1", sound, got)?;
    Ok(found)
}

impl Kernel {
    /// Makes the sites of a body's contacts and reserves memory, so that the steps allocate
    /// nothing. A step does this where it is needed.
    ///
    /// # Errors
    /// Returns [`StepError::Vertex`] for a model whose sites are not on its surface.
    pub fn prepare_contacts(&mut self, contacts: &mut Contacts) -> Result<(), StepError> {
        let modes = self.modes.count();
        self.push.modal.resize(modes, 0.0);
        let sites = if modes == self.model.mode_count() {
            self.model.contact_sites()?
        } else {
            Arc::new(ContactSites::new(&self.model, modes)?)
        };
        contacts.adopt(sites, modes);
        Ok(())
    }

    /// Displacement of a site, or of the place of a ball that it leads, m, and its derivative by
    /// the six numbers, body axes.
    fn moved(
        &self,
        sites: &ContactSites,
        site: &Site,
        leads: Option<&Carriers>,
        q: &[f64],
    ) -> (Vector3<f64>, Tangent) {
        let warp = self.warps();
        let six = match leads {
            Some(carriers) => carriers
                .iter()
                .filter_map(|(site, weight)| Some((sites.sites.get(site)?, weight)))
                .map(|(site, weight)| weight * site.patch.rows().reduce(q, warp))
                .sum(),
            None => site.patch.rows().reduce(q, warp),
        };
        tangent(&six, warp)
    }

    /// Finds the place where a site is nearest to an obstacle. The contact point of one that leads
    /// its ball slides over all that is nearest to it.
    pub(super) fn locate(
        &self,
        (sites, site): (&ContactSites, &Site),
        obstacle: &dyn ObstacleShape,
        frame: &Frame,
        q: &[f64],
        leads: Option<&Carriers>,
    ) -> Result<Located, StepError> {
        let (moved, tangent) = self.moved(sites, site, leads, q);
        let turn: Matrix3<f64> = *frame.rotation().to_rotation_matrix().matrix();
        let tangent = turn * tangent;
        let center = site.center + moved;
        let mut point = frame.to_world(center);
        let mut found = look(obstacle, &point)?;
        let (mut toward, mut wanted) = (Vector3::zeros(), Vector3::zeros());
        if site.radius > 0.0 {
            wanted = -(frame.rotation().inverse() * found.normal);
            toward = if leads.is_some() { site.leading(&wanted) } else { site.toward(&wanted) };
            point = frame.to_world(center + site.radius * toward);
            found = look(obstacle, &point)?;
        }
        Ok(Located { tangent, toward, wanted, center, point, found })
    }

    /// Position of a site's material point in the direction `toward`, m, and its derivative, world
    /// axes.
    pub(super) fn material(
        &self,
        (sites, site): (&ContactSites, &Site),
        toward: &Vector3<f64>,
        frame: &Frame,
        q: &[f64],
        leads: Option<&Carriers>,
    ) -> (Vector3<f64>, Tangent) {
        let (moved, tangent) = self.moved(sites, site, leads, q);
        let turn: Matrix3<f64> = *frame.rotation().to_rotation_matrix().matrix();
        (frame.to_world(site.rest(toward) + moved), turn * tangent)
    }

    /// Compliance of a site, m/N, world axes.
    pub(super) fn site_compliance(&self, site: &Site, frame: &Frame, q: &[f64]) -> Matrix3<f64> {
        self.patch_compliance(&site.patch, frame, q)
    }

    /// Residual compliance of a patch, m/N, world axes.
    pub(super) fn patch_compliance(&self, patch: &HeldPatch, frame: &Frame, q: &[f64]) -> Matrix3<f64> {
        let mut turn: Matrix3<f64> = *frame.rotation().to_rotation_matrix().matrix();
        if self.elastic.is_some() {
            turn *= patch.rotation(q);
        }
        turn * (patch.residual() / self.settings.stiffness_scale) * turn.transpose()
    }

    /// The law of the dent of a ball that touches an obstacle at one place.
    pub(super) fn indent(
        &self,
        (sites, index): (&ContactSites, usize),
        carriers: Carriers,
        obstacle: &dyn ObstacleShape,
    ) -> Option<Indent> {
        let site = sites.sites.get(index)?;
        let soft = sites.softness(site.ball.as_ref()?, &carriers);
        let [least, most] = CURVED.map(|times| times / site.radius);
        let radius = 1.0 / (1.0 / site.radius + obstacle.curvature()).max(least).min(most);
        let (scale, smallest) = (self.settings.stiffness_scale, SMALLEST * sites.spacing);
        Some(Indent::new(carriers, &soft, scale, radius, smallest))
    }

    /// A root of the inverse inertia of the frame, world axes.
    pub(super) fn spin_root(&self, frame: &Frame) -> Matrix3<f64> {
        let turn: Matrix3<f64> = *frame.rotation().to_rotation_matrix().matrix();
        let inertia = self.model.inertia();
        let inverse = Matrix3::from_fn(|i, j| inertia[i][j]).try_inverse().unwrap_or_else(Matrix3::zeros);
        turn * inverse.cholesky().map_or_else(Matrix3::zeros, |factor| factor.l())
    }

    /// Replaces a row by its product with a root of the response of the coordinates.
    fn half_response(&self, modal: &mut [f64]) {
        match &self.elastic {
            Some(elastic) => elastic.half_response(modal),
            None => {
                for (x, response) in modal.iter_mut().zip(&self.modes.response[0]) {
                    *x *= response.max(0.0).sqrt();
                }
            }
        }
    }

    /// The body at a state, as something that other bodies touch.
    pub(crate) fn shape<'a>(
        &'a self,
        sites: &'a ContactSites,
        state: &'a State,
        sixes: Option<&'a Sixes>,
        cloud: Option<(&'a Cloud, f64)>,
    ) -> Shape<'a> {
        Shape {
            sixes,
            cloud,
            sites,
            field: sites.field(&self.model),
            warps: self.warps(),
            frame: &state.frame,
            q: &state.q,
            size: self.model.size(),
            bound: sites.bound(&state.q),
        }
    }

    /// The center of mass about which a contact force turns the frame in this step, m, world axes:
    /// the angular momentum that it adds is `h (point - center) x force` about any point.
    pub(super) fn pivot(&self, theta: f64) -> Vector3<f64> {
        let before = &self.before.frame;
        Vector3::from(before.center()) + (1.0 - theta) * self.h * Vector3::from(before.velocity())
    }

    /// Begins to sum the contact forces of a step.
    pub(super) fn begin_push(&mut self, theta: f64, is_on: bool) {
        self.push.modal.clear();
        self.push.modal.resize(self.modes.count(), 0.0);
        (self.push.force, self.push.torque) = (Vector3::zeros(), Vector3::zeros());
        (self.push.theta, self.push.is_on) = (theta, is_on);
    }

    /// Adds a contact force (N, world axes) that acts on patches with these weights. `tangent` is
    /// the derivative of the place by the six numbers, and `arm` that about the center of mass.
    pub(super) fn add_push<'a>(
        &mut self,
        carriers: impl Iterator<Item = (&'a HeldPatch, f64)>,
        tangent: &Tangent,
        arm: &Vector3<f64>,
        force: &Vector3<f64>,
    ) {
        let (six, warp): (Six, bool) = (tangent.tr_mul(force), self.warps());
        for (patch, weight) in carriers {
            patch.rows().spread(&(weight * six), warp, &mut self.push.modal);
        }
        self.push.force += force;
        self.push.torque += arm.cross(force);
    }

    /// Writes the three rows of one side of a contact: the response to a unit force along an axis
    /// is a row times another. The parts of the frame are for a weight `theta` of 1.
    pub(super) fn fill_rows<'a>(
        &self,
        carriers: impl Iterator<Item = (&'a HeldPatch, f64)> + Clone,
        side: &RowsOfSide<'_>,
        rows: &mut [f64],
    ) {
        let modes = self.modes.count();
        let along = side.axes * side.tangent;
        for (axis, row) in rows.chunks_exact_mut(modes + 6).enumerate() {
            let (modal, rigid) = row.split_at_mut(modes);
            let six: Six = along.row(axis).transpose();
            for (patch, weight) in carriers.clone() {
                patch.rows().spread(&(weight * six), self.warps(), modal);
            }
            self.half_response(modal);
            if let Some(spin) = side.spin {
                let direction = side.axes.row(axis).transpose();
                let torque = spin.tr_mul(&side.arm.cross(&direction));
                for k in 0..3 {
                    rigid[k] = self.h / self.model.mass().sqrt() * direction[k];
                    rigid[3 + k] = self.h * torque[k];
                }
            }
        }
    }

    /// Computes what the hands hold back of the responses, one row for each of their directions.
    ///
    /// A row `g` of a hand with the compliance `c` leaves of the response `S S^T` the part
    /// `S (I - w w^T) S^T`, with `r = S^T g` and `w = r / sqrt(r.r + c)`. Its root is
    /// `I - b w w^T` with `b = 1 / (1 + sqrt(1 - w.w))` (Potter's form of the Kalman filter).
    /// [`take`] takes such a row from another.
    pub(super) fn held_rows(
        &self,
        state: &State,
        hands: &[Hand],
        spin: Option<&Matrix3<f64>>,
        held: &mut Vec<f64>,
    ) {
        let modes = self.modes.count();
        let width = modes + 6;
        let turn: Matrix3<f64> = *state.frame.rotation().to_rotation_matrix().matrix();
        held.clear();
        for (hand, solving) in hands.iter().zip(&self.solving) {
            let soft = ((1.0 + solving.beyond) * solving.compliance).symmetric_eigen();
            // A damper holds as if the body were as much stiffer.
            let scale = (1.0 + solving.relaxation / self.h).sqrt();
            for (axis, soft) in soft.eigenvectors.column_iter().zip(&soft.eigenvalues) {
                let start = held.len();
                held.resize(start + width, 0.0);
                let (before, row) = held.split_at_mut(start);
                let (modal, rigid) = row.split_at_mut(modes);
                hand.patch.rows().spread(&solving.tangent.tr_mul(&axis), self.warps(), modal);
                self.half_response(modal);
                if let Some(spin) = spin {
                    let direction = turn * axis;
                    let torque = spin.tr_mul(&(turn * solving.arm).cross(&direction));
                    for k in 0..3 {
                        rigid[k] = self.h / self.model.mass().sqrt() * direction[k];
                        rigid[3 + k] = self.h * torque[k];
                    }
                }
                row.iter_mut().for_each(|x| *x *= scale);
                before.chunks_exact(width).for_each(|w| take(w, row));
                let length = 1.0 / (dot(row, row) + soft.max(0.0)).sqrt();
                let length = if length.is_finite() { length } else { 0.0 };
                row.iter_mut().for_each(|x| *x *= length);
            }
        }
    }
}

/// What the rows of one side of a contact are made of.
pub(super) struct RowsOfSide<'a> {
    /// Normal and tangents, with the sign of the force on the body.
    pub(super) axes: Matrix3<f64>,
    pub(super) tangent: Tangent,
    pub(super) arm: Vector3<f64>,
    /// A root of the inverse inertia, world axes. `None` for a frame that does not move.
    pub(super) spin: Option<&'a Matrix3<f64>>,
}

/// Computes `row -= b (row . w) w` with `b = 1 / (1 + sqrt(1 - w . w))`.
pub(super) fn take(w: &[f64], row: &mut [f64]) {
    let share = dot(row, w) / (1.0 + (1.0 - dot(w, w)).max(0.0).sqrt());
    row.iter_mut().zip(w).for_each(|(x, w)| *x -= share * w);
}
