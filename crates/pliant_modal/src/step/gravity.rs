//! Gravity and the motion of the anchors, as forces on the deformed shape of an anchored body.

use nalgebra::{Matrix3, Vector3};

use crate::warp::coefficients_of;
use crate::{
    ModalModel, StepError,
    error::finite,
    simd::{Doubles, Kernel, Lanes, with_registers},
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

/// Displacement (x, y, z) and rotation (x, y, z) of each part, or the conjugate forces. The parts
/// are stored side by side, so that one instruction handles several. No register crosses the edge
/// of a cache line.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
struct Sixes([Each; 6]);

impl Sixes {
    const ZERO: Self = Self([[0.0; SITES]; 6]);
}

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
    /// Displacement and rotation of the parts per mode.
    modes: Vec<Sixes>,
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
        let mut modes = vec![Sixes::ZERO; model.mode_count()];
        for (vertex, (&(_, site), area)) in nearest.iter().zip(&areas).enumerate() {
            let weight = area / share[site];
            if mass[site] <= 0.0 {
                continue;
            }
            for (place, x) in places.iter_mut().zip(positions[vertex].iter()) {
                place[site] += weight * x;
            }
            for (mode, Sixes(rows)) in modes.iter_mut().enumerate() {
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
    pub(crate) fn work(&self, by: &MassForce, q: &[f64]) -> f64 {
        with_registers(Gain { sites: self, by, q, force: &mut [] })
    }

    /// Returns the same work as [`MassSites::work`] and adds its gradient, the modal force, to
    /// `force`.
    pub(crate) fn add(&self, by: &MassForce, q: &[f64], force: &mut [f64]) -> f64 {
        with_registers(Gain { sites: self, by, q, force })
    }

    /// A force on each part (x, y, z), N.
    #[inline(always)]
    fn forces(&self, by: &MassForce) -> [Each; 3] {
        let mut forces = [[0.0; SITES]; 3];
        for (axis, forces) in forces.iter_mut().enumerate() {
            let [x, y, z] = [by.gradient[(axis, 0)], by.gradient[(axis, 1)], by.gradient[(axis, 2)]];
            for (i, force) in forces.iter_mut().enumerate() {
                let change = x * self.places[0][i] + y * self.places[1][i] + z * self.places[2][i];
                *force = self.mass[i] * (by.uniform[axis] + change);
            }
        }
        forces
    }

    /// Returns the work of forces on the parts at `q` and adds its gradient to `force`.
    ///
    /// # Safety
    /// That of [`Doubles`].
    #[inline(always)]
    unsafe fn gain<D: Doubles>(&self, forces: &[Each; 3], q: &[f64], force: &mut [f64]) -> f64 {
        // SAFETY: The caller has the instruction set.
        unsafe {
            let mut six = self.reduce::<D>(q);
            let work = bend(forces, &mut six);
            self.spread::<D>(&six, force);
            work
        }
    }

    /// Linear displacement (m) and rotation (rad) of each part.
    ///
    /// # Safety
    /// That of [`Doubles`].
    #[inline(always)]
    unsafe fn reduce<D: Doubles>(&self, q: &[f64]) -> Sixes {
        let mut six = Sixes::ZERO;
        // The sums of three rows fit into the registers.
        for (half, six) in six.0.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            // SAFETY: The caller has the instruction set.
            unsafe {
                let mut sums = [[D::splat(0.0); 2]; 3];
                for (q, Sixes(rows)) in q.iter().zip(&self.modes) {
                    let q = D::splat(*q);
                    for (sums, row) in sums.iter_mut().zip(&rows[3 * half..]) {
                        for (sum, row) in sums.iter_mut().zip(row.as_chunks().0) {
                            *sum = sum.add(q.mul(D::load(row)));
                        }
                    }
                }
                for (sums, six) in sums.iter().zip(six) {
                    for (sum, six) in sums.iter().zip(six.as_chunks_mut().0) {
                        sum.store(six);
                    }
                }
            }
        }
        six
    }

    /// Adds the modal forces of forces on the six numbers of the parts.
    ///
    /// # Safety
    /// That of [`Doubles`].
    #[inline(always)]
    unsafe fn spread<D: Doubles>(&self, six: &Sixes, force: &mut [f64]) {
        /// Modes that share the loads of the forces.
        const TOGETHER: usize = 4;
        let (rows, last_rows) = self.modes[..force.len()].as_chunks::<TOGETHER>();
        let (forces, last_forces) = force.as_chunks_mut::<TOGETHER>();
        // SAFETY: The caller has the instruction set.
        unsafe {
            for (force, rows) in forces.iter_mut().zip(rows) {
                add_sums::<D, TOGETHER>(rows, six, force);
            }
            for (force, rows) in last_forces.iter_mut().zip(last_rows) {
                add_sums::<D, 1>(std::array::from_ref(rows), six, std::array::from_mut(force));
            }
        }
    }
}

/// Adds the products of the rows of some modes with forces on the parts, summed over the parts.
///
/// # Safety
/// That of [`Doubles`].
#[inline(always)]
unsafe fn add_sums<D: Doubles, const N: usize>(rows: &[Sixes; N], six: &Sixes, force: &mut [f64; N]) {
    let mut partial = [[0.0; 8]; N];
    // SAFETY: The caller has the instruction set.
    unsafe {
        let mut sums = [D::splat(0.0); N];
        for k in 0..6 {
            for at in 0..SITES / 8 {
                let part = D::load(&six.0[k].as_chunks().0[at]);
                for (sum, rows) in sums.iter_mut().zip(rows) {
                    *sum = sum.add(part.mul(D::load(&rows.0[k].as_chunks().0[at])));
                }
            }
        }
        for (sum, partial) in sums.iter().zip(&mut partial) {
            sum.store(partial);
        }
    }
    for (force, s) in force.iter_mut().zip(&partial) {
        *force += ((s[0] + s[4]) + (s[2] + s[6])) + ((s[1] + s[5]) + (s[3] + s[7]));
    }
}

/// Returns the work for the six numbers of each part, on which `forces` act (N), and replaces
/// these numbers by the derivatives of the work.
///
/// The nonlinear part of a part's displacement is `A w x u + B w x (w x u)` (Choi and Ko 2005), so
/// the work is `m (A g.(w x u) + B ((g.w)(w.u) - (w.w)(g.u)))`.
#[inline(always)]
fn bend(forces: &[Each; 3], Sixes(six): &mut Sixes) -> f64 {
    let mut s = [0.0; SITES];
    for i in 0..SITES {
        s[i] = six[3][i] * six[3][i] + six[4][i] * six[4][i] + six[5][i] * six[5][i];
    }
    let [a, b, da, db] = coefficients_of(&s);
    let mut work = [0.0; SITES];
    for i in 0..SITES {
        let (u, w) = ([six[0][i], six[1][i], six[2][i]], [six[3][i], six[4][i], six[5][i]]);
        let g = [forces[0][i], forces[1][i], forces[2][i]];
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

/// The work of `by` on the bend, and its gradient where `force` asks for it.
struct Gain<'a> {
    sites: &'a MassSites,
    by: &'a MassForce,
    q: &'a [f64],
    force: &'a mut [f64],
}

impl Kernel for Gain<'_> {
    type Out = f64;
    #[inline(always)]
    unsafe fn run<D: Doubles, L: Lanes>(self) -> f64 {
        // SAFETY: The caller has the instruction set.
        unsafe { self.sites.gain::<D>(&self.sites.forces(self.by), self.q, self.force) }
    }
}

/// Scratch of [`BendStep`], one entry per mode.
#[derive(Debug, Clone, Default)]
pub(crate) struct BendScratch {
    /// Forces at the beginning and at the end of the step.
    start: Vec<f64>,
    end: Vec<f64>,
    /// Force over the step, as the round computes it.
    now: Vec<f64>,
    /// Error of the force in the previous round, and the force which that round computed.
    last_off: Vec<f64>,
    last_now: Vec<f64>,
}

impl BendScratch {
    pub(crate) fn new(modes: usize) -> Self {
        let zero = vec![0.0; modes];
        let [start, end, now, last_off, last_now] = std::array::from_fn(|_| zero.clone());
        Self { start, end, now, last_off, last_now }
    }
}

/// The force of `by` on the bend over one step, and the coordinates that it leads to.
///
/// The force is the discrete gradient of Gonzalez (J. Nonlinear Sci. 6, 1996) around the mean of
/// the forces at both ends: its product with the way of the step is the work between both ends. A
/// force taken at the beginning of the step would add energy to a swinging body in every step.
pub(crate) struct BendStep<'a> {
    pub(crate) sites: &'a MassSites,
    pub(crate) by: &'a MassForce,
    /// Change of each coordinate per unit modal force in the step.
    pub(crate) response: &'a [f64],
    /// Largest of them.
    pub(crate) softest: f64,
    /// Coordinates at the beginning of the step.
    pub(crate) from: &'a [f64],
    /// Coordinates at the end of the step: on entry without the force, on return with it.
    pub(crate) to: &'a mut [f64],
    /// Largest other force, kg^1/2 m/s^2.
    pub(crate) largest: f64,
    /// On return the force over the step, kg^1/2 m/s^2.
    pub(crate) force: &'a mut [f64],
    pub(crate) scratch: &'a mut BendScratch,
}

/// Force along a way per unit of it that does the work `missing`, or none where that is rounding.
/// Without any motion there is no work, and the division yields no finite number.
#[inline(always)]
fn per_way(missing: f64, rounding: f64, square: f64) -> f64 {
    let share = missing / square;
    if missing.abs() > rounding && share.is_finite() { share } else { 0.0 }
}

/// Maximum number of rounds. The force changes the end of the step, which changes the force.
const MAX_ROUNDS: usize = 12;

/// Tolerance of the force over a step, as a share of the largest force.
const SHARE: f64 = 1e-6;

/// Part of a work below which it is rounding.
const ROUNDING: f64 = 8.0 * f64::EPSILON;

impl Kernel for BendStep<'_> {
    type Out = ();
    #[inline(always)]
    unsafe fn run<D: Doubles, L: Lanes>(self) {
        let Self { sites, by, response, softest, from, to, largest, force, scratch } = self;
        let n = force.len();
        let (response, from, to) = (&response[..n], &from[..n], &mut to[..n]);
        let BendScratch { start, end, now, last_off, last_now } = scratch;
        let (start, end, now) = (&mut start[..n], &mut end[..n], &mut now[..n]);
        let (last_off, last_now) = (&mut last_off[..n], &mut last_now[..n]);
        let forces = sites.forces(by);
        // The first round takes the force at the beginning as constant. What an earlier step has
        // left must not count: it may not be finite.
        start.fill(0.0);
        last_off.fill(0.0);
        last_now.fill(0.0);
        // SAFETY: The caller has the instruction set.
        let before = unsafe { sites.gain::<D>(&forces, from, start) };
        force.copy_from_slice(start);
        for k in 0..n {
            to[k] += response[k] * start[k];
        }
        let enough = SHARE * largest;
        let mut last_change = f64::INFINITY;
        for round in 0..MAX_ROUNDS {
            end.fill(0.0);
            // SAFETY: The caller has the instruction set.
            let after = unsafe { sites.gain::<D>(&forces, to, end) };
            let gained = after - before;
            let rounding = ROUNDING * (before.abs() + after.abs());
            let (mut square, mut along, mut stiff) = (0.0, 0.0, 0.0);
            for k in 0..n {
                let (way, turn) = (to[k] - from[k], end[k] - start[k]);
                now[k] = 0.5 * (start[k] + end[k]);
                (square, along, stiff) = (square + way * way, along + way * now[k], stiff + turn * turn);
            }
            let share = per_way(gained - along, rounding, square);
            let (mut change, mut on, mut turns) = (0.0f64, 0.0, 0.0);
            for k in 0..n {
                now[k] += share * (to[k] - from[k]);
                let off = now[k] - force[k];
                let turn = off - last_off[k];
                (on, turns) = (on + off * turn, turns + turn * turn);
                change = change.max(off.abs());
            }
            // The error shrinks from round to round along nearly the same line. This extrapolates
            // to the point of the line with zero error (Anderson 1965, of depth one).
            let back = if round > 0 && turns > 0.0 { (on / turns).clamp(-4.0, 4.0) } else { 0.0 };
            let (mut moved, mut pulled) = (0.0, 0.0);
            let mut square = 0.0;
            for k in 0..n {
                let next = now[k] - back * (now[k] - last_now[k]);
                let further = response[k] * (next - force[k]);
                (last_off[k], last_now[k]) = (now[k] - force[k], now[k]);
                force[k] = next;
                to[k] += further;
                let way = to[k] - from[k];
                moved += end[k] * further;
                pulled += next * way;
                square += way * way;
            }
            // What is left of the error is about the change times the rate at which it shrinks. The
            // first round knows it from the stiffness of the force along the way.
            let rate = if round > 0 { change / last_change } else { softest * (stiff / square).sqrt() };
            last_change = change;
            let done = change <= enough || change * rate.min(1.0) <= enough;
            if done || round + 1 == MAX_ROUNDS {
                // The force at the end knows the work up to the square of the last correction.
                let share = per_way(gained + moved - pulled, rounding, square);
                for k in 0..n {
                    let further = share * (to[k] - from[k]);
                    force[k] += further;
                    to[k] += response[k] * further;
                }
                break;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::with_arrays;

    #[test]
    fn the_work_is_that_of_the_warp_and_the_force_its_gradient() {
        let places = [[0.0; SITES]; 3];
        let mut sites = MassSites { mass: [0.0; SITES], places, modes: vec![Sixes::ZERO; 6] };
        // The second part is at x = 2 m, where the force is another.
        sites.places[0][5] = 2.0;
        let uniform = Vector3::new(1.0, -9.0, 2.0);
        let change = Vector3::new(0.5, 2.0, -1.0);
        let gradient = change * Vector3::x().transpose();
        let gravity = MassForce { uniform, gradient };
        (sites.mass[0], sites.mass[5]) = (0.5, 2.0);
        for mode in 0..6 {
            sites.modes[mode].0[mode][0] = 1.0;
            sites.modes[mode].0[mode][5] = -0.3;
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

    /// Parts whose numbers follow no rule.
    fn scattered(modes: usize) -> MassSites {
        let value = |seed: usize| ((seed * seed + 7 * seed) as f64).sin();
        let each = |seed: usize| std::array::from_fn(|i| value(31 * seed + i));
        let row = |mode: usize| Sixes(std::array::from_fn(|k| each(10 * mode + k + 5)));
        MassSites {
            mass: each(1).map(f64::abs),
            places: [each(2), each(3), each(4)],
            modes: (0..modes).map(row).collect(),
        }
    }

    const GRAVITY: MassForce = MassForce {
        uniform: Vector3::new(1.0, -9.0, 2.0),
        gradient: Matrix3::new(0.1, 0.2, -0.4, 0.3, 0.0, 0.1, -0.2, 0.3, 0.5),
    };

    /// The bits of a step's force and of the coordinates that it leads to.
    fn bits(modes: usize, size: f64, run: &dyn Fn(BendStep<'_>)) -> Vec<u64> {
        let sites = scattered(modes);
        let response = vec![1e-4; modes];
        let from: Vec<f64> = (0..modes).map(|k| size * (3.0 * k as f64 + 1.0).cos()).collect();
        let mut to: Vec<f64> = from.iter().map(|q| 1.1 * q + 0.02).collect();
        let mut force = vec![0.0; modes];
        run(BendStep {
            sites: &sites,
            by: &GRAVITY,
            response: &response,
            softest: 1e-4,
            from: &from,
            to: &mut to,
            largest: 1.0,
            force: &mut force,
            scratch: &mut BendScratch::new(modes),
        });
        force.iter().chain(&to).map(|x| x.to_bits()).collect()
    }

    /// Copies of a body on different processors agree to the bit only if their sums do.
    #[test]
    fn all_registers_have_the_same_bits() {
        for (modes, size) in [(1, 0.01), (4, 2.0), (7, 0.3), (20, 0.01), (20, 0.3), (20, 2.0)] {
            let plain = bits(modes, size, &|step| with_arrays(step));
            assert!(plain.iter().any(|&x| x != 0));
            assert!(bits(modes, size, &|step| with_registers(step)) == plain, "{modes} modes, {size}");
            #[cfg(target_arch = "x86_64")]
            {
                use crate::simd::x86::{kernel_avx2, kernel_avx512};
                let has_fma = std::arch::is_x86_feature_detected!("fma");
                if has_fma && std::arch::is_x86_feature_detected!("avx2") {
                    // SAFETY: The check above found AVX2 and FMA.
                    let wide = bits(modes, size, &|step| unsafe { kernel_avx2(step) });
                    assert!(wide == plain, "{modes} modes, {size}, AVX2");
                }
                if has_fma && std::arch::is_x86_feature_detected!("avx512f") {
                    // SAFETY: The check above found AVX-512F and FMA.
                    let wide = bits(modes, size, &|step| unsafe { kernel_avx512(step) });
                    assert!(wide == plain, "{modes} modes, {size}, AVX-512");
                }
            }
        }
    }

    #[test]
    fn the_force_of_a_step_is_the_discrete_gradient_and_does_the_work() {
        for (modes, soft) in [(3, 1e-3), (7, 1e-3), (20, 2e-4), (20, 1e-5)] {
            let sites = scattered(modes);
            let response: Vec<f64> = (0..modes).map(|k| soft / (1.0 + k as f64)).collect();
            let from: Vec<f64> = (0..modes).map(|k| 0.2 * (k as f64).cos() / (1.0 + k as f64)).collect();
            let free: Vec<f64> = from.iter().enumerate().map(|(k, q)| q + 0.05 * (k as f64).sin()).collect();
            let (mut to, mut force) = (free.clone(), vec![0.0; modes]);
            let largest = 100.0;
            with_registers(BendStep {
                sites: &sites,
                by: &GRAVITY,
                response: &response,
                softest: response[0],
                from: &from,
                to: &mut to,
                largest,
                force: &mut force,
                scratch: &mut BendScratch::new(modes),
            });
            let way: Vec<f64> = to.iter().zip(&from).map(|(to, from)| to - from).collect();
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let gained = sites.work(&GRAVITY, &to) - sites.work(&GRAVITY, &from);
            let done = dot(&force, &way);
            // The tolerance of the force is not one of the work.
            let most = 1e-3 * SHARE * largest * dot(&way, &way).sqrt();
            assert!((done - gained).abs() < most, "{done} and {gained} J, more than {most} J");
            let mut mean = vec![0.0; modes];
            sites.add(&GRAVITY, &from, &mut mean);
            sites.add(&GRAVITY, &to, &mut mean);
            mean.iter_mut().for_each(|force| *force *= 0.5);
            let share = (gained - dot(&mean, &way)) / dot(&way, &way);
            for k in 0..modes {
                let exact = mean[k] + share * way[k];
                assert!((force[k] - exact).abs() < 2.0 * SHARE * largest, "{} and {exact}", force[k]);
                assert!((to[k] - free[k] - response[k] * force[k]).abs() < 1e-12);
            }
        }
    }
}
