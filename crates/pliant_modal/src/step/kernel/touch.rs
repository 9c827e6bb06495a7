//! The step of a body that touches obstacles.
//!
//! Contact forces act like loads that are constant over the step, so a step with contacts is a step
//! with these loads. The step is computed under the contact forces of the step before, the laws of
//! contact are solved on its linearized responses, and it is computed again under the new forces.
//! Where the body bends or turns within the step, this is repeated. A body at rest computes one
//! step.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use super::Kernel;
use crate::{
    ModalModel, StepError,
    contact::{
        Contact, ContactReport, ContactSites, Contacts, Obstacle, Point, Site, SurfacePoint, Touching,
    },
    simd::dot,
    step::{Frame, Hand, Load, State, StepReport, Tangent, tangent},
};

/// Largest number of times that a step is computed again with new forces, without hands and with
/// them.
const ROUNDS: [usize; 2] = [3, 6];

/// Distance below which sites count as candidates, as a share of the body's size.
const BAND: f64 = 2e-3;

/// Tolerances of the laws, as shares of the body's size: that with which forces of the step before
/// are taken as they are, and that with which a step is not computed again.
const STILL: f64 = 1e-12;
const ENOUGH: f64 = 1e-6;

/// Share of a penetration that a step takes back, and the fastest way back, body sizes per second.
const RECOVERED: f64 = 0.2;
const RECOVERY_SPEED: f64 = 0.5;

/// Farthest distance of a site's surface from its anchor, as a share of the body's size. Beyond it
/// the body was moved from elsewhere.
const SNAPPED: f64 = 0.02;

/// Share of the kinetic and elastic energy that a step may gain of what contacts have lost before.
const GIVEN_BACK: f64 = 1e-2;

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
struct Located {
    /// Derivative of the position, world axes.
    tangent: Tangent,
    toward: Vector3<f64>,
    /// Displaced center of the site, m, body axes.
    center: Vector3<f64>,
    point: Vector3<f64>,
    found: SurfacePoint,
}

fn look(obstacle: &dyn Obstacle, point: &Vector3<f64>) -> Result<SurfacePoint, StepError> {
    let far = SurfacePoint { distance: f64::INFINITY, normal: Vector3::y() };
    // A state that has diverged is found by the step.
    if !point.iter().all(|x| x.is_finite()) {
        return Ok(far);
    }
    let found = obstacle.at(point);
    let length = found.normal.norm();
    let sound = !found.distance.is_nan() && (length - 1.0).abs() < 1e-6;
    let got = if found.distance.is_nan() { found.distance } else { length };
    StepError::check("obstacle", "a distance and a normal of length 1", sound, got)?;
    Ok(found)
}

fn carried(obstacle: &dyn Obstacle, point: &Vector3<f64>, h: f64) -> Result<Vector3<f64>, StepError> {
    let velocity = obstacle.velocity(point);
    crate::error::finite("velocity of an obstacle", velocity.as_slice())?;
    Ok(h * velocity)
}

/// The smallest gap that is allowed at the end of a step that begins with `gap`.
fn floor(gap: f64, most: f64, recovers: bool) -> f64 {
    if gap >= 0.0 {
        0.0
    } else if recovers {
        gap + (RECOVERED * -gap).min(most)
    } else {
        gap
    }
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
        if contacts.obstacles().is_empty() {
            return Ok(());
        }
        let sites = if modes == self.model.mode_count() {
            self.model.contact_sites()?
        } else {
            Arc::new(ContactSites::new(&self.model, modes)?)
        };
        contacts.adopt(sites, modes);
        Ok(())
    }

    fn locate(
        &self,
        site: &Site,
        obstacle: &dyn Obstacle,
        frame: &Frame,
        q: &[f64],
    ) -> Result<Located, StepError> {
        let warp = self.warps();
        let (moved, tangent) = tangent(&site.patch.rows().reduce(q, warp), warp);
        let turn: Matrix3<f64> = *frame.rotation().to_rotation_matrix().matrix();
        let tangent = turn * tangent;
        let center = site.center + moved;
        let mut point = frame.to_world(center);
        let mut found = look(obstacle, &point)?;
        let mut toward = Vector3::zeros();
        if site.radius > 0.0 {
            toward = site.toward(&-(frame.rotation().inverse() * found.normal));
            point = frame.to_world(center + site.radius * toward);
            found = look(obstacle, &point)?;
        }
        Ok(Located { tangent, toward, center, point, found })
    }

    /// Position of a site's material point in the direction `toward`, m, and its derivative, world
    /// axes.
    fn material(
        &self,
        site: &Site,
        toward: &Vector3<f64>,
        frame: &Frame,
        q: &[f64],
    ) -> (Vector3<f64>, Tangent) {
        let warp = self.warps();
        let (moved, tangent) = tangent(&site.patch.rows().reduce(q, warp), warp);
        let turn: Matrix3<f64> = *frame.rotation().to_rotation_matrix().matrix();
        (frame.to_world(site.rest(toward) + moved), turn * tangent)
    }

    /// Compliance of a site, m/N, world axes.
    fn site_compliance(&self, site: &Site, frame: &Frame, q: &[f64]) -> Matrix3<f64> {
        let mut turn: Matrix3<f64> = *frame.rotation().to_rotation_matrix().matrix();
        if self.elastic.is_some() {
            turn *= site.patch.rotation(q);
        }
        turn * (site.patch.residual() / self.settings.stiffness_scale) * turn.transpose()
    }

    /// Performs a step with contacts. `before` holds the state at its beginning.
    pub(super) fn touch(
        &mut self,
        state: &mut State,
        hands: &mut [Hand],
        load: &Load<'_>,
        contacts: &mut Contacts,
    ) -> Result<StepReport, StepError> {
        contacts.list.clear();
        contacts.report = ContactReport::default();
        if contacts.obstacles().is_empty() {
            return Ok(self.advance(state, hands, load));
        }
        if contacts.places.is_none() || contacts.modes != self.modes.count() {
            self.prepare_contacts(contacts)?;
        }
        let Some(sites) = contacts.places.clone() else { return Ok(self.advance(state, hands, load)) };
        contacts.touching.hands.clear();
        contacts.touching.hands.extend(hands.iter().map(|hand| [hand.pull, hand.mean, hand.flow]));
        contacts.touching.sweeps = 0;
        if contacts.memory.is_empty() {
            contacts.theta = 0.5;
        }
        self.begin_contacts(contacts, &sites)?;
        let known = contacts.touching.points.len();
        let mut report = self.attempt(state, hands, load, contacts, &sites, true)?;
        if !contacts.touching.points.is_empty() && self.gained(contacts, true) {
            // The forces of the step before, and no others, begin the step anew.
            contacts.touching.points.truncate(known);
            contacts.theta = 1.0;
            let rounds = contacts.report.rounds;
            self.begin_contacts(contacts, &sites)?;
            report = self.attempt(state, hands, load, contacts, &sites, false)?;
            contacts.report.rounds += rounds;
            contacts.report.guarded = true;
        }
        if hands.is_empty() && *load == (Load { modal: load.modal, ..Load::default() }) {
            self.cap_energy(state, load.modal, contacts);
        }
        self.end_contacts(state, contacts, &sites);
        Ok(report)
    }

    /// Sets up the contacts that the step before left.
    fn begin_contacts(&mut self, contacts: &mut Contacts, sites: &ContactSites) -> Result<(), StepError> {
        let size = self.model.size();
        let (frame, q) = (self.before.frame, &self.before.q);
        contacts.touching.points.clear();
        for i in 0..contacts.memory.len() {
            let memory = contacts.memory[i];
            let obstacle = contacts.obstacles()[memory.obstacle].clone();
            let Some(site) = sites.sites.get(memory.site) else { continue };
            let located = self.locate(site, &*obstacle, &frame, q)?;
            let mut point = Point::new(memory.obstacle, memory.site);
            (point.first, point.last) = (memory.toward, located.toward);
            (point.start, point.tangent) = self.material(site, &memory.toward, &frame, q);
            point.carried = carried(&*obstacle, &located.point, self.h)?;
            point.before = memory.force;
            point.compliance = self.site_compliance(site, &frame, q);
            point.turn(&located.found.normal);
            point.pushed = point.axes * memory.force;
            point.force = point.pushed;
            let dent = point.compliance * memory.force;
            point.gap = look(&*obstacle, &(located.point + point.carried))?.distance
                + located.found.normal.dot(&dent);
            point.anchor = memory.anchor + point.carried;
            let way = point.anchor - (point.start + dent + point.carried);
            let slipped = (way - located.found.normal * located.found.normal.dot(&way)).norm();
            if slipped.is_nan() || slipped > SNAPPED * size {
                point.anchor = point.start + dent + point.carried;
            }
            point.old = true;
            point.arm = located.point - Vector3::from(frame.center());
            contacts.touching.points.push(point);
        }
        Ok(())
    }

    /// Computes the step under the forces of the points, until the laws of contact hold.
    fn attempt(
        &mut self,
        state: &mut State,
        hands: &mut [Hand],
        load: &Load<'_>,
        contacts: &mut Contacts,
        sites: &ContactSites,
        recovers: bool,
    ) -> Result<StepReport, StepError> {
        let size = self.model.size();
        let rounds = ROUNDS[usize::from(!hands.is_empty())];
        let mut round = 0;
        loop {
            self.collect_push(contacts, sites);
            state.clone_from(&self.before);
            for (hand, [pull, mean, flow]) in hands.iter_mut().zip(&contacts.touching.hands) {
                (hand.pull, hand.mean, hand.flow) = (*pull, *mean, *flow);
            }
            self.push.theta = contacts.theta;
            self.push.is_on = !contacts.touching.points.is_empty();
            let report = self.advance(state, hands, load);
            self.push.is_on = false;
            round += 1;
            if !state.is_finite() {
                return Ok(report);
            }
            let new = self.detect(state, contacts, sites, if round == 1 { BAND * size } else { 0.0 })?;
            self.linearize_contacts(state, contacts, sites, recovers)?;
            let residual = contacts.touching.violation(contacts.friction());
            let enough = if round == 1 { STILL } else { ENOUGH } * size;
            contacts.report.rounds = round;
            contacts.report.residual = residual;
            if contacts.touching.points.is_empty() || (residual <= enough && !new) || round > rounds {
                return Ok(report);
            }
            let free = self.model.is_free() && !load.frame_is_given;
            self.fill_rows(state, contacts, sites, free, 1.0);
            let width = self.modes.count() + 6;
            if round == 1 && contacts.memory.is_empty() && recovers {
                contacts.theta = theta(contacts.touching.rigid_share(width));
            }
            let scale = contacts.theta.sqrt();
            for row in contacts.touching.rows.chunks_exact_mut(width) {
                row[width - 6..].iter_mut().for_each(|x| *x *= scale);
            }
            self.hold_rows(state, hands, &mut contacts.touching, free);
            contacts.touching.solve(width, contacts.friction(), (1e-3 * residual).max(1e-13 * size));
            for point in &mut contacts.touching.points {
                point.pushed = point.force;
            }
        }
    }

    /// Sums the forces of all points.
    fn collect_push(&mut self, contacts: &Contacts, sites: &ContactSites) {
        self.push.modal.clear();
        self.push.modal.resize(self.modes.count(), 0.0);
        (self.push.force, self.push.torque) = (Vector3::zeros(), Vector3::zeros());
        let warp = self.warps();
        for point in &contacts.touching.points {
            let force = point.world_force();
            if force == Vector3::zeros() {
                continue;
            }
            let six = point.mean.unwrap_or(point.tangent).tr_mul(&force);
            sites.sites[point.site].patch.rows().spread(&six, warp, &mut self.push.modal);
            self.push.force += force;
            self.push.torque += point.arm.cross(&force);
        }
    }

    /// Adds points for the sites that touch at the end of the step. Returns whether it found any
    /// that penetrate.
    fn detect(
        &self,
        state: &State,
        contacts: &mut Contacts,
        sites: &ContactSites,
        band: f64,
    ) -> Result<bool, StepError> {
        let (from, to) = (self.before.frame, state.frame);
        let center = Vector3::from(to.center());
        let turned = (from.rotation().inverse() * to.rotation()).angle();
        let (bound, before) = (sites.bound(&state.q), sites.bound(&self.before.q));
        let swing = 2.0 * (0.5 * turned.min(std::f64::consts::PI)).sin() * (sites.radius + bound.max(before));
        let bent = sites.bound_of_way(&self.before.q, &state.q);
        let travel = (center - Vector3::from(from.center())).norm() + swing + bent;
        let mut penetrates = false;
        for index in 0..contacts.obstacles().len() {
            let obstacle = contacts.obstacles()[index].clone();
            let away = look(&*obstacle, &center)?.distance;
            if away > sites.radius + bound + band + travel {
                continue;
            }
            contacts.touching.stamp = contacts.touching.stamp.wrapping_add(1);
            let stamp = contacts.touching.stamp;
            for point in contacts.touching.points.iter().filter(|point| point.obstacle == index) {
                contacts.touching.marks[point.site] = stamp;
            }
            for (number, site) in sites.sites.iter().enumerate() {
                if contacts.touching.marks[number] == stamp {
                    continue;
                }
                let rough = look(&*obstacle, &to.to_world(site.center))?.distance - site.radius;
                // Nearly all sites end here.
                let far = bound + band;
                if rough > far + travel {
                    continue;
                }
                // The warp never makes a displacement longer.
                let moved = site.patch.rows().reduce(&state.q, false).norm();
                if rough > moved + band + travel {
                    continue;
                }
                contacts.report.candidates += 1;
                let located = self.locate(site, &*obstacle, &to, &state.q)?;
                let (start, tangent) = self.material(site, &located.toward, &from, &self.before.q);
                let moved = located.point - start;
                let mut found = located.found;
                let mut hit = false;
                if found.distance >= band {
                    // A site that moves far may have passed through the obstacle.
                    let begin = look(&*obstacle, &start)?;
                    if begin.distance >= moved.norm() || begin.distance <= 0.0 {
                        continue;
                    }
                    let Some(passed) = march(&*obstacle, &start, &moved, begin)? else { continue };
                    found = passed;
                    hit = true;
                }
                let mut point = Point::new(index, number);
                (point.first, point.last, point.start) = (located.toward, located.toward, start);
                point.tangent = tangent;
                point.carried = carried(&*obstacle, &located.point, self.h)?;
                point.gap = look(&*obstacle, &(start + point.carried))?.distance;
                let way = located.point - start - point.carried;
                let share = if point.gap <= 0.0 {
                    0.0
                } else if found.distance < 0.0 {
                    point.gap / (point.gap - found.distance)
                } else {
                    1.0
                };
                point.anchor = start + point.carried + share * way;
                if hit {
                    // The plane at the place where the site went in.
                    point.turn(&found.normal);
                    point.off[0] = f64::NEG_INFINITY;
                }
                penetrates |= found.distance < 0.0 || hit;
                contacts.touching.points.push(point);
            }
        }
        Ok(penetrates)
    }

    /// Takes the gaps and responses of all points at the end of the computed step.
    fn linearize_contacts(
        &self,
        state: &State,
        contacts: &mut Contacts,
        sites: &ContactSites,
        recovers: bool,
    ) -> Result<(), StepError> {
        let most = RECOVERY_SPEED * self.model.size() * self.h;
        for i in 0..contacts.touching.points.len() {
            let point = contacts.touching.points[i];
            let obstacle = contacts.obstacles()[point.obstacle].clone();
            let site = &sites.sites[point.site];
            let located = self.locate(site, &*obstacle, &state.frame, &state.q)?;
            let point = &mut contacts.touching.points[i];
            let (mut distance, mut normal) = (located.found.distance, located.found.normal);
            if point.off[0] == f64::NEG_INFINITY {
                // The site passed through: it is as far behind the place where it went in as it
                // went on.
                normal = point.axes.row(0).transpose();
                let way = located.point - point.start;
                let through = march(&*obstacle, &point.start, &way, look(&*obstacle, &point.start)?)?;
                distance = through.map_or(distance, |found| found.distance);
            }
            point.compliance = self.site_compliance(site, &state.frame, &state.q);
            point.turn(&normal);
            point.floor = floor(point.gap, most, recovers);
            point.last = located.toward;
            point.place = located.point;
            point.end = state.frame.to_world(located.center + site.radius * point.first);
            let offset = point.axes * (point.end - point.anchor);
            point.off = Vector3::new(distance - point.floor, offset[1], offset[2]);
            // The middle of the step gives the work of a force on a shape that bends. With the mean
            // of every round the rounds of a soft body would not converge.
            let start = point.tangent;
            point.mean.get_or_insert_with(|| 0.5 * (start + located.tangent));
            point.arm = located.point - Vector3::from(state.frame.center());
        }
        Ok(())
    }

    /// Writes the rows of all points: the response to a unit force at one of them is a row times
    /// the others. The parts of the frame are for a weight `theta` of 1.
    fn fill_rows(
        &self,
        state: &State,
        contacts: &mut Contacts,
        sites: &ContactSites,
        free: bool,
        theta: f64,
    ) {
        let modes = self.modes.count();
        let width = modes + 6;
        let turn: Matrix3<f64> = *state.frame.rotation().to_rotation_matrix().matrix();
        let spin = self.spin_root(&turn);
        let by_force = theta.sqrt() * self.h / self.model.mass().sqrt();
        let by_torque = theta.sqrt() * self.h;
        let touching = &mut contacts.touching;
        touching.rows.clear();
        touching.rows.resize(3 * touching.points.len() * width, 0.0);
        for (point, rows) in touching.points.iter().zip(touching.rows.chunks_exact_mut(3 * width)) {
            let patch = sites.sites[point.site].patch.rows();
            let along = point.axes * point.mean.unwrap_or(point.tangent);
            for (axis, row) in rows.chunks_exact_mut(width).enumerate() {
                let (modal, rigid) = row.split_at_mut(modes);
                patch.spread(&along.row(axis).transpose(), self.warps(), modal);
                self.half_response(modal);
                if free {
                    let direction = point.axes.row(axis).transpose();
                    let torque = spin.tr_mul(&point.arm.cross(&direction));
                    for k in 0..3 {
                        rigid[k] = by_force * direction[k];
                        rigid[3 + k] = by_torque * torque[k];
                    }
                }
            }
        }
    }

    /// Takes from the rows of all points what the hands hold back, so that the responses are those
    /// of the held body.
    ///
    /// A row `g` of a hand with the compliance `c` leaves of the response `S S^T` the part
    /// `S (I - w w^T) S^T`, with `r = S^T g` and `w = r / sqrt(r.r + c)`. Its root is
    /// `I - b w w^T` with `b = 1 / (1 + sqrt(1 - w.w))` (Potter's form of the Kalman filter).
    fn hold_rows(&self, state: &State, hands: &[Hand], touching: &mut Touching, free: bool) {
        let modes = self.modes.count();
        let width = modes + 6;
        let turn: Matrix3<f64> = *state.frame.rotation().to_rotation_matrix().matrix();
        let spin = self.spin_root(&turn);
        let held = &mut touching.held;
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
                if free {
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
        for w in touching.held.chunks_exact(width) {
            touching.rows.chunks_exact_mut(width).for_each(|row| take(w, row));
        }
    }

    /// A root of the inverse inertia of the frame, world axes.
    fn spin_root(&self, turn: &Matrix3<f64>) -> Matrix3<f64> {
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

    /// Whether the contacts did more work on the body than they are allowed to.
    fn gained(&self, contacts: &Contacts, recovers: bool) -> bool {
        let (mut work, mut allowed, mut scale) = (0.0, 0.0, 0.0f64);
        for point in &contacts.touching.points {
            let force = point.world_force();
            let along = force.dot(&(point.end - point.start - point.carried));
            let stored = 0.5 * force.dot(&(point.compliance * force));
            let before = 0.5 * point.before.dot(&(point.compliance * point.before));
            work += along + stored - before;
            scale += along.abs() + stored + before;
            if recovers {
                allowed += point.pushed[0] * (point.floor - point.gap).max(0.0);
            }
        }
        work > 1.5 * allowed + 1e-9 * scale
    }

    /// Takes the energy that the step has gained from the velocities.
    ///
    /// The work of the contacts is right to second order in the way of a step. A body that turns or
    /// bends far within one step may still gain. Hands and loads do work of their own, and a
    /// material that relaxes stores energy that is not counted here: such steps are not checked.
    fn cap_energy(&self, state: &mut State, modal: &[f64], contacts: &mut Contacts) {
        let points = &contacts.touching.points;
        let loaded = modal.iter().any(|load| *load != 0.0);
        let touches = points.iter().any(|point| point.pushed[0] > 0.0);
        if loaded || !touches || self.modes.is_viscous() || !state.is_finite() {
            return;
        }
        let kinetic = |state: &State| {
            let frame = if self.model.is_free() { state.frame.kinetic_energy(&self.model) } else { 0.0 };
            frame + 0.5 * state.v.iter().map(|v| v * v).sum::<f64>()
        };
        let stored = |force: &Vector3<f64>, point: &Point| 0.5 * force.dot(&(point.compliance * force));
        let at_rest = |state: &State| self.elastic_energy(state) + self.potential_energy(state);
        let moving = kinetic(state);
        let mut gained = moving - kinetic(&self.before) + at_rest(state) - at_rest(&self.before);
        let mut scale = moving + kinetic(&self.before);
        scale += self.elastic_energy(state) + self.elastic_energy(&self.before);
        for point in points {
            let force = point.world_force();
            scale += stored(&force, point) + stored(&point.before, point);
            gained += stored(&force, point) - stored(&point.before, point);
            // What the obstacles supply, and what pushes a body out that was set into one.
            gained -= force.dot(&point.carried) + point.pushed[0] * (point.floor - point.gap).max(0.0);
        }
        // A step may take back a little of what the steps before have lost: a rolling ball loses
        // and gains in turn, and would slow down if only the gains were taken.
        let allowed = contacts.lost.min(GIVEN_BACK * scale);
        contacts.lost = (contacts.lost - gained.min(allowed)).min(scale);
        let gained = gained - allowed;
        if gained > moving && gained > 1e-3 * scale {
            // The velocities cannot pay for it. The body stops where the step began.
            state.clone_from(&self.before);
            state.v.fill(0.0);
            state.frame.slow(0.0);
            contacts.touching.points.clear();
            contacts.report.guarded = true;
        } else if gained > 1e-12 * scale {
            let left = (1.0 - gained / moving).max(0.0).sqrt();
            state.v.iter_mut().for_each(|v| *v *= left);
            state.frame.slow(left);
            contacts.report.guarded = true;
        }
    }

    /// Stores what the next step needs and what users read.
    fn end_contacts(&self, state: &State, contacts: &mut Contacts, sites: &ContactSites) {
        contacts.memory.clear();
        let friction = contacts.friction();
        let report = &mut contacts.report;
        report.sweeps = contacts.touching.sweeps;
        if !state.is_finite() {
            return;
        }
        contacts.touching.points.sort_unstable_by_key(|point| (point.obstacle, point.site));
        let mut total = Vector3::zeros();
        for point in &contacts.touching.points {
            let force = point.world_force();
            if point.pushed[0] <= 0.0 || !force.iter().all(|x| x.is_finite()) {
                continue;
            }
            let site = &sites.sites[point.site];
            let dent = point.compliance * force;
            let held = point.pushed[1].hypot(point.pushed[2]);
            let sliding = held >= friction * point.pushed[0] * (1.0 - 1e-9);
            let mut anchor = if sliding { point.end + dent } else { point.anchor };
            // The next step holds the material of the new contact point.
            anchor += point.place - point.end;
            let toward = if site.radius > 0.0 { point.last } else { point.first };
            contacts.memory.push(crate::contact::Memory {
                obstacle: point.obstacle,
                site: point.site,
                force,
                anchor,
                toward,
            });
            let normal = point.axes.row(0).transpose();
            let penetration = (-(point.off[0] + point.floor + normal.dot(&dent))).max(0.0);
            contacts.list.push(Contact {
                obstacle: point.obstacle,
                vertex: site.vertex,
                point: point.place.into(),
                normal: normal.into(),
                force: force.into(),
                penetration,
                sliding,
            });
            total += force;
            report.penetration = report.penetration.max(penetration);
            report.energy += 0.5 * force.dot(&dent);
        }
        report.contacts = contacts.list.len();
        report.force = total.into();
        contacts.theta = if contacts.memory.is_empty() { 0.5 } else { contacts.theta };
    }
}

/// Computes `row -= b (row . w) w` with `b = 1 / (1 + sqrt(1 - w . w))`.
fn take(w: &[f64], row: &mut [f64]) {
    let share = dot(row, w) / (1.0 + (1.0 - dot(w, w)).max(0.0).sqrt());
    row.iter_mut().zip(w).for_each(|(x, w)| *x -= share * w);
}

/// Weight of contact forces in the way of the frame for a ratio of its response to all compliance.
///
/// A soft contact is stepped nearly without loss. A stiff one would ring.
fn theta(ratio: f64) -> f64 {
    0.5 + 0.5 * ratio / (ratio + 16.0)
}

/// Follows a way from outside until it enters the obstacle. Returns the distance of its end to the
/// plane at that place, and the plane's normal.
fn march(
    obstacle: &dyn Obstacle,
    start: &Vector3<f64>,
    way: &Vector3<f64>,
    begin: SurfacePoint,
) -> Result<Option<SurfacePoint>, StepError> {
    const STEPS: usize = 32;
    let length = way.norm();
    if length.is_nan() || length <= 0.0 || begin.distance <= 0.0 {
        return Ok(None);
    }
    let mut gone = begin.distance;
    for _ in 0..STEPS {
        if gone >= length {
            return Ok(None);
        }
        let found = look(obstacle, &(start + way * (gone / length)))?;
        if found.distance <= 1e-3 * length {
            let rest = (length - gone) / length * found.normal.dot(way);
            return Ok((rest < 0.0).then_some(SurfacePoint { distance: found.distance + rest, ..found }));
        }
        gone += found.distance;
    }
    Ok(None)
}
