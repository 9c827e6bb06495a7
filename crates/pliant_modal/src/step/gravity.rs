//! Gravity and the motion of the anchors, as forces on the deformed shape of an anchored body.

use nalgebra::{Matrix3, Vector3};

use crate::warp::coefficients_of;
use crate::{
    ModalModel, StepError,
    error::finite,
    simd::{Work, widest},
};

/// Motion of the anchors of a body through the world at one moment. The anchors move as one rigid
/// frame.
///
/// The mass of the body feels it as a force. At rest at `r` (m, body axes) it is, per unit mass,
///
/// ```text
/// -(a + alpha x r + omega x (omega x r))
/// ```
///
/// The forces that depend on the deformation itself are left out: `alpha x u`,
/// `omega x (omega x u)` and Coriolis' `2 omega x u'`. Beside those of the rest shape they are as
/// small as the displacement `u` beside the distance `r` from the origin. Coriolis' force is beside
/// the elastic force of a mode of angular frequency `w` as `2 omega / w`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FrameMotion {
    /// Acceleration `a` of the model's origin, m/s^2, body axes.
    pub acceleration: [f64; 3],
    /// Angular velocity `omega`, rad/s, body axes.
    pub angular_velocity: [f64; 3],
    /// Angular acceleration `alpha`, rad/s^2, body axes.
    pub angular_acceleration: [f64; 3],
}

impl FrameMotion {
    /// Checks that all numbers are finite.
    pub(crate) fn check(&self) -> Result<(), StepError> {
        finite("acceleration of the anchors", &self.acceleration)?;
        finite("angular velocity of the anchors", &self.angular_velocity)?;
        finite("angular acceleration of the anchors", &self.angular_acceleration)
    }

    /// The inertial force per unit mass that this motion brings. Where it is above `limit` (m/s^2)
    /// within `reach` (m) of the origin, all of it is scaled down to that.
    pub(crate) fn force(&self, reach: f64, limit: f64) -> MassForce {
        let acceleration = Vector3::from(self.acceleration);
        let spin = Vector3::from(self.angular_velocity).cross_matrix();
        let turn = Vector3::from(self.angular_acceleration).cross_matrix();
        let gradient = -(turn + spin * spin);
        let most = acceleration.norm() + gradient.norm() * reach;
        let scale = if most > limit { limit / most } else { 1.0 };
        MassForce { uniform: -scale * acceleration, gradient: scale * gradient }
    }
}

/// A force per unit mass that depends linearly on the place at rest, m/s^2, body axes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct MassForce {
    /// Value at the model's origin, m/s^2.
    pub(crate) uniform: Vector3<f64>,
    /// Change with the place, 1/s^2.
    pub(crate) gradient: Matrix3<f64>,
}

impl MassForce {
    /// A force that is the same everywhere.
    pub(crate) fn of_gravity(gravity: Vector3<f64>) -> Self {
        Self { uniform: gravity, ..Self::default() }
    }
}

/// Number of parts into which the mass of a body is divided.
const SITES: usize = 16;

/// One number per part.
type Each = [f64; SITES];

/// The mass of a body, divided into parts around sites on the surface.
///
/// The participations give the modal force of gravity on the undeformed shape up to rounding. On a
/// bent shape this force is `sum m J(q)^T g`, where `J` is the derivative of the position of each
/// part. The parts supply only the difference, `sum m (J(q) - J(0))^T g`. The force thus stays the
/// gradient of a potential, and the position of a part needs only the accuracy of a bend.
#[derive(Debug)]
pub(crate) struct MassSites {
    /// Mass of each part, kg. Zero for unused parts.
    mass: Each,
    /// Place of each part at rest (x, y, z), m.
    places: [Each; 3],
    /// Displacement (x, y, z) and rotation (x, y, z) of each part per mode. The parts are stored
    /// side by side, so that one instruction handles several.
    modes: Vec<[Each; 6]>,
}

impl MassSites {
    pub(crate) fn new(model: &ModalModel) -> Self {
        let surface = model.surface();
        let positions: Vec<Vector3<f64>> =
            surface.positions().iter().map(|p| Vector3::from(p.map(f64::from))).collect();
        // Each next site is the vertex farthest from all sites so far.
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
        let mut share = [0.0; SITES];
        let areas: Vec<f64> = (0..positions.len()).map(|v| surface.area_around(v as u32)).collect();
        for (&(_, site), area) in nearest.iter().zip(&areas) {
            share[site] += area;
        }
        let whole: f64 = share.iter().sum();
        let mass = share.map(|share| {
            let mass = model.mass() * share / whole;
            if mass.is_finite() { mass } else { 0.0 }
        });
        let mut places = [[0.0; SITES]; 3];
        let mut modes = vec![[[0.0; SITES]; 6]; model.mode_count()];
        for (vertex, (&(_, site), area)) in nearest.iter().zip(&areas).enumerate() {
            let weight = area / share[site];
            if mass[site] <= 0.0 {
                continue;
            }
            for (place, x) in places.iter_mut().zip(positions[vertex].iter()) {
                place[site] += weight * x;
            }
            for (mode, rows) in modes.iter_mut().enumerate() {
                for axis in 0..3 {
                    let moved = f64::from(model.displacement_row(vertex as u32, axis, mode));
                    let turned = f64::from(model.rotation_row(vertex as u32, axis, mode));
                    rows[axis][site] += weight * moved;
                    rows[3 + axis][site] += weight * turned;
                }
            }
        }
        Self { mass, places, modes }
    }

    /// Work of a force beyond that on the undeformed shape, from rest to the shape `q`, J.
    pub(crate) fn work(&self, force: &MassForce, q: &[f64]) -> f64 {
        let mut six = self.reduce(q);
        self.work_and_forces(force, &mut six)
    }

    /// Returns the same work as [`MassSites::work`] and adds its gradient, the modal force, to
    /// `force`.
    pub(crate) fn add(&self, by: &MassForce, q: &[f64], force: &mut [f64]) -> f64 {
        let mut six = self.reduce(q);
        let work = self.work_and_forces(by, &mut six);
        widest(Spread { modes: &self.modes, six: &six, force });
        work
    }

    /// Linear displacement (m) and rotation (rad) of each part.
    fn reduce(&self, q: &[f64]) -> [Each; 6] {
        widest(Reduce { modes: &self.modes, q })
    }

    /// Returns the work for the six numbers of each part and replaces these numbers by the
    /// derivatives of the work.
    fn work_and_forces(&self, force: &MassForce, six: &mut [Each; 6]) -> f64 {
        widest(Bend { sites: self, force, six })
    }
}

/// The work on all parts, side by side.
///
/// The nonlinear part of a part's displacement is `A w x u + B w x (w x u)` (Choi and Ko 2005), so
/// the work is `m (A g.(w x u) + B ((g.w)(w.u) - (w.w)(g.u)))`.
struct Bend<'a> {
    sites: &'a MassSites,
    force: &'a MassForce,
    six: &'a mut [Each; 6],
}

impl Work for Bend<'_> {
    type Out = f64;
    #[inline(always)]
    fn run(self) -> f64 {
        let Self { sites: MassSites { mass, places, .. }, force, six } = self;
        let mut weights = [[0.0; SITES]; 3];
        for (axis, weights) in weights.iter_mut().enumerate() {
            let [x, y, z] = [0, 1, 2].map(|of| force.gradient[(axis, of)]);
            for i in 0..SITES {
                let change = x * places[0][i] + y * places[1][i] + z * places[2][i];
                weights[i] = mass[i] * (force.uniform[axis] + change);
            }
        }
        let mut s = [0.0; SITES];
        for i in 0..SITES {
            s[i] = six[3][i] * six[3][i] + six[4][i] * six[4][i] + six[5][i] * six[5][i];
        }
        let [a, b, da, db] = coefficients_of(&s);
        let mut work = [0.0; SITES];
        for i in 0..SITES {
            let [u, w] = [0, 3].map(|at| [six[at][i], six[at + 1][i], six[at + 2][i]]);
            let g = [weights[0][i], weights[1][i], weights[2][i]];
            let dot = |x: &[f64; 3], y: &[f64; 3]| x[0] * y[0] + x[1] * y[1] + x[2] * y[2];
            let cross = |x: &[f64; 3], y: &[f64; 3]| {
                [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]
            };
            let (across, turned) = (cross(&u, &g), cross(&g, &w));
            let (gw, wu, gu) = (dot(&g, &w), dot(&w, &u), dot(&g, &u));
            let (once, twice) = (dot(&w, &across), gw * wu - s[i] * gu);
            work[i] = a[i] * once + b[i] * twice;
            let both = 2.0 * (da[i] * once + db[i] * twice);
            for axis in 0..3 {
                six[axis][i] = a[i] * turned[axis] + b[i] * (gw * w[axis] - s[i] * g[axis]);
                six[3 + axis][i] = a[i] * across[axis]
                    + b[i] * (wu * g[axis] + gw * u[axis] - 2.0 * gu * w[axis])
                    + both * w[axis];
            }
        }
        work.iter().sum()
    }
}

/// Sums the displacements and rotations of the parts.
struct Reduce<'a> {
    modes: &'a [[Each; 6]],
    q: &'a [f64],
}

impl Work for Reduce<'_> {
    type Out = [Each; 6];
    #[inline(always)]
    fn run(self) -> [Each; 6] {
        let mut six = [[0.0; SITES]; 6];
        // The sums of one row fit into the registers.
        for (k, sums) in six.iter_mut().enumerate() {
            for (q, rows) in self.q.iter().zip(self.modes) {
                for (sum, row) in sums.iter_mut().zip(&rows[k]) {
                    *sum += q * row;
                }
            }
        }
        six
    }
}

/// Adds the modal forces of forces on the parts.
struct Spread<'a> {
    modes: &'a [[Each; 6]],
    six: &'a [Each; 6],
    force: &'a mut [f64],
}

impl Work for Spread<'_> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        for (force, rows) in self.force.iter_mut().zip(self.modes) {
            let mut sums = [0.0; SITES];
            for (row, part) in rows.iter().zip(self.six) {
                for ((sum, row), part) in sums.iter_mut().zip(row).zip(part) {
                    *sum += row * part;
                }
            }
            *force += sums.iter().sum::<f64>();
        }
    }
}

/// Computes the bend force of gravity over a step, kg^1/2 m/s^2.
///
/// This is the discrete gradient of Gonzalez (J. Nonlinear Sci. 6, 1996) around the mean of the
/// forces at both ends. `force . (to - from)` then equals the work between both ends up to
/// rounding. A force taken at the beginning of the step would add energy to a swinging body in
/// every step. On entry `force` is that mean, on return it is the result. `work` is the work
/// between both ends, J.
pub(crate) fn between(from: &[f64], to: &[f64], work: f64, force: &mut [f64]) {
    let way = || from.iter().zip(to).map(|(from, to)| to - from);
    let square: f64 = way().map(|way| way * way).sum();
    let along: f64 = way().zip(&*force).map(|(way, force)| way * force).sum();
    let share = (work - along) / square;
    // Without any motion there is no work, and the division yields no finite number.
    if share.is_finite() {
        force.iter_mut().zip(way()).for_each(|(force, way)| *force += share * way);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_work_is_that_of_the_warp_and_the_force_its_gradient() {
        let places = [[0.0; SITES]; 3];
        let mut sites = MassSites { mass: [0.0; SITES], places, modes: vec![[[0.0; SITES]; 6]; 6] };
        // The second part is at x = 2 m, where the force is another.
        sites.places[0][5] = 2.0;
        let uniform = Vector3::new(1.0, -9.0, 2.0);
        let change = Vector3::new(0.5, 2.0, -1.0);
        let gradient = change * Vector3::x().transpose();
        let gravity = MassForce { uniform, gradient };
        (sites.mass[0], sites.mass[5]) = (0.5, 2.0);
        for mode in 0..6 {
            sites.modes[mode][mode][0] = 1.0;
            sites.modes[mode][mode][5] = -0.3;
        }
        for turn in [1e-9, 0.1, 0.6, 2.0, 5.0, 9.0] {
            let q = [0.1, -0.2, 0.3, 0.8 * turn, -0.5 * turn, 0.3 * turn];
            let part = |scale: f64, force: Vector3<f64>| {
                let [d, w] = [0, 3].map(|at| [q[at], q[at + 1], q[at + 2]].map(|x| scale * x));
                force.dot(&(Vector3::from(crate::warp(w, d)) - Vector3::from(d)))
            };
            let want = part(1.0, 0.5 * uniform) + part(-0.3, 2.0 * (uniform + 2.0 * change));
            let mut force = [0.0; 6];
            let work = sites.add(&gravity, &q, &mut force);
            assert!((work - want).abs() < 1e-12, "{turn}: {work}, {want}");
            assert_eq!(sites.work(&gravity, &q), work);
            for mode in 0..6 {
                let at = |step: f64| {
                    let mut q = q;
                    q[mode] += step;
                    sites.work(&gravity, &q)
                };
                let slope = (at(1e-5) - at(-1e-5)) / 2e-5;
                assert!((force[mode] - slope).abs() < 1e-8, "{turn}, {mode}: {} {slope}", force[mode]);
            }
        }
    }
}
