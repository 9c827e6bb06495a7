//! The nonlinear part of a step: Newton's method in all coordinates at once.
//!
//! The linear part of the elasticity is stepped as a recurrence per coordinate, which has no period
//! error (see [`Coefficients::reduced`](crate::Coefficients::reduced)). The force `F` of everything
//! else is constant over the step:
//!
//! ```text
//! q1 = q* + r F,   F = sum rows^T pull - (1 - t) g(q0) - t g(q1),   g(q) = dU/dq - omega^2 q
//! ```
//!
//! `q*` is the step without that force, and `r` the response of each coordinate. With `t` = 1/2 the
//! step is of second order and nearly keeps the energy. Where the body has become so stiff that it
//! turns by more than a radian within a step, `t` goes to 1 and the coordinates are stepped by
//! backward Euler, which is calm at any stiffness. What energy a step would still add, beyond the
//! work of hands and loads, is taken from the velocities.
//!
//! Where the material relaxes ([`Relaxation`]), the force is `F - ratio y` with `F = dU/dq` and
//! `time y' = F - y`: the standard linear solid for the force of each coordinate (J. C. Simo, *On a
//! fully three-dimensional finite-strain viscoelastic damage model*, Comput. Methods Appl. Mech.
//! Eng. 60, 1987, has it for the stress). With `F` linear in time over a step, `y1` is a weighted
//! sum of `y0`, `F0` and `F1`, so that the end of the step has a share of `F1` and a constant. For
//! linear elasticity this is passive at any step. The state's `z` is `y / omega^2`.
//!
//! The columns of held patches ([`HeldShapes`]) come before the modal coordinates in all arrays
//! here. They have no mass: their response is that of their stiffness at rest.

mod columns;

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use super::{HeldPatch, State, modes::Modes, patch::Six};
use crate::{
    HeldShapes, ModalModel, Relaxation,
    nonlinear::{Cholesky, ElasticEnergy},
    simd::dot,
};

/// Workspace of the nonlinear part of a step.
#[derive(Debug, Clone)]
pub(crate) struct ElasticStep {
    energy: ElasticEnergy,
    shapes: Option<Arc<HeldShapes>>,
    /// Number of columns of held patches.
    columns: usize,
    h: f64,
    omega2: Vec<f64>,
    damping: Vec<f64>,
    /// Change of `q`, `v`, `a` of each coordinate per unit force within this step.
    response: Vec<[f64; 3]>,
    /// The share `t` of the force at the end of this step.
    share: f64,
    /// What does not change with the end of the step: the remainder `g` at its beginning times its
    /// share, and what an earlier force leaves at the end, kg^1/2 m/s^2.
    start: Vec<f64>,
    relaxing: Option<Relaxing>,
    cholesky: Cholesky,
    /// Coordinates at which the energy is linearized, kg^1/2 m.
    q: Vec<f64>,
    /// Coordinates at the beginning of the step.
    begun: Vec<f64>,
    /// Coordinates after the step without the force of this module.
    unforced: Vec<f64>,
    /// Coordinates after this round without hands.
    free: Vec<f64>,
    /// The three rows of each hand under the inverse of the factor.
    rows: Vec<f64>,
    /// Scratch: the increment of a round.
    increment: Vec<f64>,
    /// Elastic energy of an increment beyond which a round is far, J.
    far: f64,
    /// Elastic energy of the increment of the round before, J.
    last: f64,
}

/// What a step of a relaxing material needs.
#[derive(Debug, Clone)]
struct Relaxing {
    ratio: f64,
    /// Weights of `y0`, `F0` and `F1` in `y1`.
    weights: [f64; 3],
    /// The relaxed force `y` and the elastic force `F` at the beginning of the step.
    relaxed: Vec<f64>,
    begun: Vec<f64>,
}

/// Elastic energy of an increment that counts as far, as a share of Young's modulus times the
/// volume: a mean change of the strain by a twentieth. Tangents change little over smaller ones.
const FAR: f64 = 1.25e-3;

/// Share of the energy of the increment before above which rounds converge too slowly.
const SLOW: f64 = 0.1;

/// Share of a far increment's energy below which one needs no further round.
const NOTHING: f64 = 1e-9;

/// Number of halvings of a far increment that does not lower the potential.
const HALVINGS: usize = 8;

impl ElasticStep {
    /// Makes the workspace. Returns `None` for a model without reduced elasticity.
    ///
    /// Shapes of held patches are used where all coordinates of the model are stepped.
    pub(crate) fn new(
        model: &ModalModel,
        modes: &Modes,
        scale: f64,
        relaxation: Option<Relaxation>,
        h: f64,
        shapes: Option<Arc<HeldShapes>>,
    ) -> Option<Self> {
        let shapes = shapes.filter(|_| modes.count() == model.mode_count());
        let energy = match &shapes {
            Some(shapes) => ElasticEnergy::of_shapes(model, shapes, scale)?,
            None => ElasticEnergy::of_model(model, modes.count(), scale)?,
        };
        let columns = shapes.as_ref().map_or(0, |shapes| shapes.columns());
        let count = columns + modes.count();
        let omega2 = modes.omega.iter().map(|omega| omega * omega);
        let omega2: Vec<f64> = std::iter::repeat_n(scale, columns).chain(omega2).collect();
        let zero = vec![0.0; count];
        let cholesky = Cholesky::new(count);
        let (q, begun, unforced, free, increment) =
            (zero.clone(), zero.clone(), zero.clone(), zero.clone(), zero);
        let far = FAR * scale * model.info().young * energy.volume();
        let (start, damping, rows) = (increment.clone(), modes.damping.clone(), Vec::new());
        let mut response = vec![[0.0; 3]; count];
        response[..columns].fill([1.0 / scale, 0.0, 0.0]);
        let share = 0.5;
        let relaxing = relaxation.map(|relaxation| Relaxing {
            ratio: relaxation.ratio,
            weights: relaxation.linear_weights(h),
            relaxed: increment.clone(),
            begun: increment.clone(),
        });
        Some(Self {
            energy,
            shapes,
            columns,
            h,
            omega2,
            damping,
            response,
            share,
            start,
            relaxing,
            cholesky,
            q,
            begun,
            unforced,
            free,
            rows,
            increment,
            far,
            last: 0.0,
        })
    }

    /// Elastic energy, J.
    pub(crate) fn energy(&self, state: &State) -> f64 {
        if self.columns == 0 { self.energy.energy(&state.q) } else { self.energy.energy(&self.joined(state)) }
    }

    /// Writes the elastic force `dU/dq` on the modal coordinates, kg^1/2 m/s^2.
    pub(crate) fn force_at(&self, state: &State, out: &mut [f64]) {
        if self.columns == 0 {
            self.energy.force_at(&state.q, out);
            return;
        }
        let mut all = vec![0.0; self.q.len()];
        self.energy.force_at(&self.joined(state), &mut all);
        out.iter_mut().zip(&all[self.columns..]).for_each(|(out, force)| *out = *force);
    }

    /// Columns and coordinates of a state.
    fn joined(&self, state: &State) -> Vec<f64> {
        let mut out = vec![0.0; self.q.len()];
        join(self.columns, state, &mut out);
        out
    }

    /// Shapes of held patches that the step uses.
    pub(crate) fn shapes(&self) -> Option<&Arc<HeldShapes>> {
        self.shapes.as_ref()
    }

    /// Number of cubature points whose tangent had negative eigenvalues in the last round.
    pub(crate) fn raised(&self) -> usize {
        self.energy.raised()
    }

    /// Reserves memory for this number of hands.
    pub(crate) fn reserve(&mut self, hands: usize) {
        let n = 3 * hands * self.q.len();
        self.rows.reserve(n.saturating_sub(self.rows.len()));
    }

    /// Number of columns of held patches.
    pub(crate) fn columns(&self) -> usize {
        self.columns
    }

    /// Begins a step from `before`, with the step under the loads alone in `after`, and linearizes
    /// at its beginning. `load` is the modal force of the loads, and `relaxed` has the forces (N,
    /// body axes) to which the columns of the hands' patches have relaxed.
    pub(crate) fn begin<'a>(
        &mut self,
        before: &State,
        modes: &Modes,
        load: &[f64],
        relaxed: impl Iterator<Item = (&'a HeldPatch, Vector3<f64>)>,
        after: &mut State,
    ) {
        join(self.columns, before, &mut self.q);
        self.begun.copy_from_slice(&self.q);
        self.energy.linearize(&self.q);
        let (h, columns, mut stiffest) = (self.h, self.columns, 0.0f64);
        for (start, ((force, omega2), q)) in
            self.start.iter_mut().zip(self.energy.force().iter().zip(&self.omega2).zip(&self.q))
        {
            *start = force - omega2 * q;
        }
        for (i, omega2) in self.omega2[columns..].iter().enumerate() {
            let stiffness = self.energy.stiffness(columns + i);
            self.response[columns + i] = [modes.response[0][i], modes.response[1][i], modes.response[2][i]];
            if h * h * stiffness > 1.0 {
                // Backward Euler, as `Coefficients::reduced` has it for the stiffness at rest.
                let r = 1.0 / (1.0 / (h * h) + self.damping[i] / h + omega2);
                self.response[columns + i] = [r, r / h, r / (h * h)];
                let (q, v) = (before.q[i], before.v[i]);
                after.q[i] = r * (q / (h * h) + (self.damping[i] * q + v) / h + load[i]);
                after.v[i] = (after.q[i] - q) / h;
                after.a[i] = (after.v[i] - v) / h;
            }
        }
        for (i, (omega2, response)) in self.omega2.iter().zip(&self.response).enumerate() {
            stiffest = stiffest.max((self.energy.stiffness(i) - omega2) * response[0]);
        }
        self.share = 0.5 + 0.5 * stiffest.clamp(0.0, 1.0);
        self.unforced[columns..].copy_from_slice(&after.q);
        self.last = f64::INFINITY;
        let t = self.share;
        self.start.iter_mut().for_each(|start| *start *= 1.0 - t);
        let Some(relaxing) = &mut self.relaxing else { return };
        relaxing.begun.copy_from_slice(self.energy.force());
        let (own, modal) = relaxing.relaxed.split_at_mut(columns);
        own.fill(0.0);
        for (patch, force) in relaxed {
            let Some(rows) = self.shapes.as_ref().and_then(|shapes| shapes.rows(patch)) else { continue };
            for (row, force) in rows.iter().zip(force.iter()) {
                own.iter_mut().zip(row).for_each(|(own, row)| *own += force * row);
            }
        }
        for ((y, z), omega2) in modal.iter_mut().zip(&before.z).zip(&self.omega2[columns..]) {
            *y = omega2 * z;
        }
        let (ratio, [keep, old, _]) = (relaxing.ratio, relaxing.weights);
        for ((start, y), force) in self.start.iter_mut().zip(&relaxing.relaxed).zip(&relaxing.begun) {
            *start -= ratio * ((1.0 - t) * y + t * (keep * y + old * force));
        }
    }

    /// Share of the elastic force at the end of a step that has not relaxed within it.
    fn left(&self) -> f64 {
        self.relaxing.as_ref().map_or(1.0, |relaxing| 1.0 - relaxing.ratio * relaxing.weights[2])
    }

    /// Solves the next round without hands. `First`: with the tangent of [`ElasticStep::begin`].
    pub(crate) fn linearize(&mut self, tangent: RoundTangent) {
        match tangent {
            RoundTangent::First => {}
            RoundTangent::New => self.energy.linearize(&self.q),
            RoundTangent::Kept => self.energy.compute_force(&self.q),
        }
        if tangent != RoundTangent::Kept {
            self.factor();
            self.rows.clear();
        }
        let (t, left) = (self.share, self.left());
        for (i, out) in self.free.iter_mut().enumerate() {
            let remainder = left * self.energy.force()[i] - self.omega2[i] * self.q[i];
            *out = (self.q[i] - self.unforced[i]) / self.response[i][0] + t * remainder + self.start[i];
        }
        self.cholesky.solve(&mut self.free);
        for (out, q) in self.free.iter_mut().zip(&self.q) {
            *out = q - *out;
        }
    }

    fn factor(&mut self) {
        let (n, t, left) = (self.q.len(), self.share, self.left());
        let matrix = self.cholesky.matrix();
        for (i, (omega2, response)) in self.omega2.iter().zip(&self.response).enumerate() {
            let row = &mut matrix[i * n + i..(i + 1) * n];
            self.energy.tangent_row(i, row);
            row.iter_mut().for_each(|x| *x *= t * left);
            row[0] += 1.0 / response[0] - t * omega2;
        }
        self.cholesky.factor();
    }

    /// The six numbers of a patch after this round without hands.
    pub(crate) fn without_hands(&self, patch: &HeldPatch) -> Six {
        self.reduce(patch, &self.free)
    }

    /// The six numbers of a patch at the beginning of the step.
    pub(crate) fn at_beginning(&self, patch: &HeldPatch) -> Six {
        self.reduce(patch, &self.begun)
    }

    /// Displacement of a patch over the step so far, m, body axes.
    pub(crate) fn patch_displacement(&self, patch: &HeldPatch) -> Vector3<f64> {
        let six = self.reduce(patch, &self.q) - self.reduce(patch, &self.begun);
        Vector3::new(six[0], six[1], six[2])
    }

    fn reduce(&self, patch: &HeldPatch, x: &[f64]) -> Six {
        let (columns, modal) = x.split_at(self.columns);
        let mut six = patch.rows().reduce(modal, false);
        if let Some(shapes) = &self.shapes {
            let own = shapes.displacement(patch, columns);
            (0..3).for_each(|axis| six[axis] += own[axis]);
        }
        six
    }

    /// Modal coordinates at which the energy is linearized, kg^1/2 m.
    pub(crate) fn coordinates(&self) -> &[f64] {
        &self.q[self.columns..]
    }

    /// Adds a hand to a new tangent. Hands are added in order.
    pub(crate) fn add_hand(&mut self, patch: &HeldPatch) {
        let n = self.q.len();
        for axis in 0..3 {
            let start = self.rows.len();
            let own = self.shapes.as_ref().and_then(|shapes| shapes.rows(patch));
            match own {
                Some(own) => self.rows.extend_from_slice(&own[axis]),
                None => self.rows.extend(std::iter::repeat_n(0.0, self.columns)),
            }
            self.rows.extend_from_slice(patch.rows().displacement(axis));
            self.cholesky.forward(&mut self.rows[start..start + n]);
        }
    }

    /// Displacement of hand `i` per unit force of hand `j`, m/N.
    pub(crate) fn response(&self, i: usize, j: usize) -> Matrix3<f64> {
        let n = self.q.len();
        let row = |hand: usize, axis: usize| &self.rows[(3 * hand + axis) * n..][..n];
        Matrix3::from_fn(|a, b| dot(row(i, a), row(j, b)))
    }

    /// Solves with the lower factor of the step's tangent. The response of one row of forces to
    /// another is the product of both solutions. The rows have no columns of held patches.
    pub(crate) fn half_response(&self, row: &mut [f64]) {
        self.cholesky.forward_from(self.columns, row);
    }

    /// Ends the round with the hands' forces (N) on their patches, in order. Returns whether the
    /// step has to go on with a new tangent: the round went far, or hardly less far than the one
    /// before.
    ///
    /// A far increment is halved until it lowers the potential whose minimum the step seeks, with
    /// the forces of this round.
    pub(crate) fn finish_round<'a>(
        &mut self,
        pulls: impl Iterator<Item = (&'a HeldPatch, Vector3<f64>)> + Clone,
    ) -> bool {
        let n = self.q.len();
        self.increment.fill(0.0);
        for ((_, pull), rows) in pulls.clone().zip(self.rows.chunks_exact(3 * n)) {
            for (force, row) in pull.iter().zip(rows.chunks_exact(n)) {
                self.increment.iter_mut().zip(row).for_each(|(out, row)| *out += force * row);
            }
        }
        self.cholesky.backward(&mut self.increment);
        for ((increment, free), q) in self.increment.iter_mut().zip(&self.free).zip(&self.q) {
            *increment += free - q;
        }
        let size: f64 = self
            .increment
            .iter()
            .zip(&self.omega2)
            .map(|(increment, k)| 0.5 * k * increment * increment)
            .sum();
        let far = size.is_nan() || size > self.far;
        let share = if far { self.share(pulls) } else { 1.0 };
        self.q.iter_mut().zip(&self.increment).for_each(|(q, increment)| *q += share * increment);
        let slow = size > SLOW * self.last && size > NOTHING * self.far;
        self.last = size;
        far || slow
    }

    /// The share of the increment that lowers the potential.
    fn share<'a>(&mut self, pulls: impl Iterator<Item = (&'a HeldPatch, Vector3<f64>)>) -> f64 {
        let work: f64 = pulls
            .map(|(patch, pull)| {
                let moved = self.reduce(patch, &self.increment);
                pull.dot(&Vector3::new(moved[0], moved[1], moved[2]))
            })
            .sum();
        let t = self.share;
        let (mut slope, mut bend) = (-work, 0.0);
        for (i, increment) in self.increment.iter().enumerate() {
            let inverse = 1.0 / self.response[i][0];
            let straight = inverse * (self.q[i] - self.unforced[i]) - t * self.omega2[i] * self.q[i];
            slope += (straight + self.start[i]) * increment;
            bend += 0.5 * (inverse - t * self.omega2[i]) * increment * increment;
        }
        let before = self.energy.energy(&self.q);
        let mut share = 1.0;
        for _ in 0..HALVINGS {
            for ((out, q), increment) in self.free.iter_mut().zip(&self.q).zip(&self.increment) {
                *out = q + share * increment;
            }
            let change = t * self.left() * (self.energy.energy(&self.free) - before);
            if change + share * (slope + share * bend) <= 0.0 {
                break;
            }
            share *= 0.5;
        }
        share
    }

    /// Writes the force that would have moved the end of the last step by `increment`, on its
    /// tangent.
    pub(crate) fn force_of_increment(&mut self, increment: impl Fn(usize) -> f64, out: &mut [f64]) {
        let (columns, modal) = self.increment.split_at_mut(self.columns);
        columns.fill(0.0);
        modal.iter_mut().enumerate().for_each(|(k, x)| *x = increment(k));
        self.cholesky.multiply(&self.increment, &mut self.free);
        out.iter_mut().zip(&self.free[self.columns..]).for_each(|(out, force)| *out = *force);
    }

    /// Ends the step: adds the effect of the force to the state without it, and the force itself to
    /// `force`, which holds the loads.
    ///
    /// The step may add no energy besides `supplied` (J), the work of the hands, and that of the
    /// loads. Where the elasticity softens within a long step, it would: the velocities then give
    /// it back.
    pub(crate) fn finish(&mut self, before: &State, supplied: f64, force: &mut [f64], state: &mut State) {
        let mut released = 0.0;
        if let Some(relaxing) = &mut self.relaxing {
            self.energy.compute_force(&self.q);
            let (ratio, [keep, old, new], t) = (relaxing.ratio, relaxing.weights, self.share);
            let ends = self.energy.force().iter().zip(&relaxing.begun);
            let moved = self.q.iter().zip(&self.begun).map(|(q, begun)| q - begun);
            for ((y, (force, begun)), moved) in relaxing.relaxed.iter_mut().zip(ends).zip(moved) {
                let end = keep * *y + old * begun + new * force;
                released += ratio * ((1.0 - t) * *y + t * end) * moved;
                *y = end;
            }
            let ends = relaxing.relaxed[self.columns..].iter().zip(&self.omega2[self.columns..]);
            for (z, (y, omega2)) in state.z.iter_mut().zip(ends) {
                *z = y / omega2.max(f64::MIN_POSITIVE);
            }
        }
        let (columns, modal) = self.q.split_at(self.columns);
        state.s.resize(columns.len(), 0.0);
        state.s.copy_from_slice(columns);
        let (mut stiff, mut work, mut kinetic) = (0.0, supplied + released, [0.0; 2]);
        for ((now, begun), omega2) in columns.iter().zip(&self.begun).zip(&self.omega2) {
            stiff += 0.5 * omega2 * (now - begun) * (now - begun);
        }
        for (i, force) in force.iter_mut().enumerate() {
            let at = columns.len() + i;
            let own = (modal[i] - self.unforced[at]) / self.response[at][0];
            let moved = modal[i] - before.q[i];
            work += *force * moved;
            stiff += 0.5 * self.omega2[at] * moved * moved;
            *force += own;
            state.q[i] = modal[i];
            state.v[i] += self.response[at][1] * own;
            state.a[i] += self.response[at][2] * own;
            kinetic[0] += 0.5 * before.v[i] * before.v[i];
            kinetic[1] += 0.5 * state.v[i] * state.v[i];
        }
        if stiff <= GUARDED * self.far {
            return;
        }
        let gained =
            self.energy.energy(&self.q) - self.energy.energy(&self.begun) + kinetic[1] - kinetic[0] - work;
        if gained > 0.0 && kinetic[1] > 0.0 {
            let left = (1.0 - gained / kinetic[1]).max(0.0).sqrt();
            state.v.iter_mut().for_each(|v| *v *= left);
        }
    }
}

/// Writes the columns' coordinates of a state and its modal ones. Columns that the state does not
/// have are at rest.
fn join(columns: usize, state: &State, out: &mut [f64]) {
    let (own, modal) = out.split_at_mut(columns);
    if state.s.len() == columns {
        own.copy_from_slice(&state.s);
    } else {
        own.fill(0.0);
    }
    modal.copy_from_slice(&state.q);
}

/// Share of a far increment's energy from which on a step's energy is checked: a mean change of the
/// strain by two thousandths.
const GUARDED: f64 = 1e-3;

/// The tangent that a round uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RoundTangent {
    /// That of the beginning of the step, computed by [`ElasticStep::begin`].
    First,
    /// Computed at the present coordinates.
    New,
    /// That of the round before.
    Kept,
}
