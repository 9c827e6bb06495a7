//! Gravity on the deformed shape of an anchored body.

use nalgebra::Vector3;

use super::patch::{MeanRows, displacement, tangent};
use crate::ModalModel;

/// Into so many parts a body's mass is divided.
const SITES: usize = 16;

/// A body's mass in parts, each where its bit of the surface is.
///
/// The modal force of gravity on the undeformed shape is known to rounding: the participations. On a
/// bent one it is `sum m J(q)^T g`, `J` the derivative of where each part is. The parts only tell what
/// that is more: `sum m (J(q) - J(0))^T g`. So the force stays the gradient of a potential, and a part's
/// place needs no more than the accuracy of a bend.
#[derive(Debug)]
pub(crate) struct MassSites(Vec<(f64, MeanRows)>);

impl MassSites {
    pub(crate) fn new(model: &ModalModel) -> Self {
        let surface = model.surface();
        let positions: Vec<Vector3<f64>> =
            surface.positions().iter().map(|p| Vector3::from(p.map(f64::from))).collect();
        // The farthest vertex from all sites so far is the next one.
        let mut nearest = vec![(f64::INFINITY, 0); positions.len()];
        let mut next = 0;
        for site in 0..SITES.min(positions.len()) {
            let center = positions[next];
            for (nearest, position) in nearest.iter_mut().zip(&positions) {
                let distance = (position - center).norm_squared();
                if distance < nearest.0 {
                    *nearest = (distance, site);
                }
            }
            next = (0..nearest.len()).max_by(|&a, &b| nearest[a].0.total_cmp(&nearest[b].0)).unwrap_or(0);
        }
        let area = |vertex: usize| surface.area_around(vertex as u32);
        let whole: f64 = (0..positions.len()).map(area).sum();
        let site = |site: usize| {
            let mut entries: Vec<(u32, f64)> = Vec::new();
            entries.extend((0..nearest.len()).filter(|&v| nearest[v].1 == site).map(|v| (v as u32, area(v))));
            let share: f64 = entries.iter().map(|(_, area)| area).sum();
            entries.iter_mut().for_each(|(_, weight)| *weight /= share);
            let sound = share > 0.0 && whole.is_finite();
            sound.then(|| (model.mass() * share / whole, MeanRows::new(model, &entries, model.mode_count())))
        };
        Self((0..SITES).filter_map(site).collect())
    }

    /// The work of that on the way from rest to the shape `q`, J.
    pub(crate) fn work(&self, gravity: &Vector3<f64>, q: &[f64]) -> f64 {
        let of = |(mass, rows): &(f64, MeanRows)| {
            let six = rows.reduce(q, true);
            let straight = Vector3::new(six[0], six[1], six[2]);
            *mass * gravity.dot(&(displacement(&six, true) - straight))
        };
        self.0.iter().map(of).sum()
    }

    /// The modal force of that over a step from `from` to `to`, as far as its work there goes: the
    /// discrete gradient of Gonzalez (J. Nonlinear Sci. 6, 1996), the force in the middle plus what makes
    /// `force . (to - from)` the work between them to rounding. A force that is constant over a step and
    /// taken at its beginning would feed a swinging body, step by step. `middle` is scratch.
    pub(crate) fn between(
        &self,
        gravity: &Vector3<f64>,
        [from, to]: [&[f64]; 2],
        middle: &mut [f64],
        force: &mut [f64],
    ) {
        force.fill(0.0);
        for (middle, (from, to)) in middle.iter_mut().zip(from.iter().zip(to)) {
            *middle = 0.5 * (from + to);
        }
        self.add(gravity, middle, force);
        let way = || from.iter().zip(to).map(|(from, to)| to - from);
        let square: f64 = way().map(|way| way * way).sum();
        let along: f64 = way().zip(&*force).map(|(way, force)| way * force).sum();
        let missing = self.work(gravity, to) - self.work(gravity, from) - along;
        let share = missing / square;
        // Of no way there is no work.
        if share.is_finite() {
            force.iter_mut().zip(way()).for_each(|(force, way)| *force += share * way);
        }
    }

    /// Adds to the modal force what gravity (m/s^2, body axes) does more on the shape `q` than at rest.
    pub(crate) fn add(&self, gravity: &Vector3<f64>, q: &[f64], force: &mut [f64]) {
        for (mass, rows) in &self.0 {
            let (_, tangent) = tangent(&rows.reduce(q, true), true);
            let weight = *mass * gravity;
            let mut six = tangent.tr_mul(&weight);
            for axis in 0..3 {
                six[axis] -= weight[axis];
            }
            rows.spread(&six, true, force);
        }
    }
}
