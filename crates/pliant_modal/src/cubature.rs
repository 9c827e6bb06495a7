//! Cubature: few points with positive weights whose energy stands for that of a whole body.
//!
//! The points are chosen so that the forces agree with those of all points in given shapes, and in
//! all small ones: greedy selection with non-negative least squares (S. S. An, T. Kim and D. L.
//! James, *Optimizing Cubature for Efficient Integration of Subspace Deformations*, ACM Trans.
//! Graph. 27(5), 2008). A bake makes the rule of a model, and taking hold of a patch the rule that
//! includes the patch's own shapes.

use nalgebra::{Matrix3, SMatrix, Vector3};

use crate::{ElasticEnergy, Hyperelastic, nonlinear::Cholesky};

/// Number of points that are added before the weights are computed anew, as a share of the largest
/// number of points.
const BATCH: f64 = 1.0 / 72.0;

/// A point of an element.
#[derive(Debug, Clone)]
pub struct Point {
    /// Weight, m^3.
    pub weight: f64,
    /// Displacement gradients of the coordinates, `[3 c + r][coordinate]` with the derivative of
    /// component `r` along axis `c`.
    pub gradients: Vec<f64>,
}

impl Point {
    fn gradient(&self, q: &[f64]) -> Matrix3<f64> {
        let mut h = Matrix3::zeros();
        for (h, row) in h.iter_mut().zip(self.gradients.chunks_exact(q.len().max(1))) {
            *h = row.iter().zip(q).map(|(g, q)| g * q).sum();
        }
        h
    }

    /// Adds the elastic force of the point at the coordinates `q`, its weight times `B^T stress`.
    pub fn add_force(&self, law: Hyperelastic, q: &[f64], out: &mut [f64]) {
        let stress = law.stress(&self.gradient(q));
        for (stress, row) in stress.iter().zip(self.gradients.chunks_exact(out.len().max(1))) {
            let factor = self.weight * stress;
            out.iter_mut().zip(row).for_each(|(out, g)| *out += factor * g);
        }
    }

    /// Adds the stiffness of the point for `m` coordinates, its weight times `B^T tangent B`, to
    /// `m x m` entries.
    pub fn add_tangent(&self, m: usize, tangent: &SMatrix<f64, 9, 9>, out: &mut [f64]) {
        let m = m.max(1);
        let mut half = vec![0.0; 9 * m];
        for (a, half) in half.chunks_exact_mut(m).enumerate() {
            for (b, row) in self.gradients.chunks_exact(m).enumerate() {
                let factor = self.weight * tangent[(a, b)];
                half.iter_mut().zip(row).for_each(|(half, g)| *half += factor * g);
            }
        }
        for (row, half) in self.gradients.chunks_exact(m).zip(half.chunks_exact(m)) {
            for (g, out) in row.iter().zip(out.chunks_exact_mut(m)) {
                out.iter_mut().zip(half).for_each(|(out, half)| *out += g * half);
            }
        }
    }
}

/// Mean displacement of a patch by the coordinates, `[axis][coordinate]`.
pub type Rows = [Vec<f64>; 3];

/// Finds shapes in which a patch is led from rest along `direction` in the given `ways` (m), until
/// the energy exceeds `most` (J).
pub fn guided_shapes(
    energy: &mut ElasticEnergy,
    omega: &[f64],
    patch: &Rows,
    direction: &Vector3<f64>,
    ways: &[f64],
    most: f64,
) -> Vec<GuidedShape> {
    let mut q = vec![0.0; omega.len()];
    let mut out = Vec::new();
    for way in ways {
        let Some(next) = hold(energy, omega, patch, &(*way * direction), &q) else { break };
        let reached = energy.energy(&next.q);
        if reached.is_nan() || reached > most {
            break;
        }
        q.clone_from(&next.q);
        out.push(next);
    }
    out
}

/// A shape in which a patch is held.
#[derive(Debug, Clone)]
pub struct GuidedShape {
    /// Coordinates.
    pub q: Vec<f64>,
    /// Force that holds the patch there, N.
    pub force: Vector3<f64>,
}

/// Returns roughly the shape of least energy in which a patch is displaced by `there` (m), from the
/// shape `start`. Returns `None` if it is not finite.
fn hold(
    energy: &mut ElasticEnergy,
    omega: &[f64],
    patch: &Rows,
    there: &Vector3<f64>,
    start: &[f64],
) -> Option<GuidedShape> {
    const ROUNDS: usize = 5;
    let m = start.len();
    let mut q = start.to_vec();
    let mut force = Vector3::zeros();
    let mut factor = Cholesky::new(m);
    for _ in 0..ROUNDS {
        energy.linearize(&q);
        for (i, row) in factor.matrix().chunks_exact_mut(m).enumerate() {
            energy.tangent_row(i, &mut row[i..]);
        }
        factor.factor();
        let mut free = energy.force().to_vec();
        factor.solve(&mut free);
        let soft: [Vec<f64>; 3] = std::array::from_fn(|axis| {
            let mut row = patch[axis].clone();
            factor.solve(&mut row);
            row
        });
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let gap = there - Vector3::from_fn(|axis, _| dot(&patch[axis], &q) - dot(&patch[axis], &free));
        let inner = Matrix3::from_fn(|a, b| dot(&patch[a], &soft[b]));
        force = inner.try_inverse()? * gap;
        let (mut way, mut length) = (0.0, 0.0);
        for (i, q) in q.iter_mut().enumerate() {
            let step = force[0] * soft[0][i] + force[1] * soft[1][i] + force[2] * soft[2][i] - free[i];
            *q += step;
            way += (omega[i] * step).powi(2);
            length += (omega[i] * *q).powi(2);
        }
        if way < 1e-6 * length {
            break;
        }
    }
    q.iter().chain(force.iter()).all(|x| x.is_finite()).then_some(GuidedShape { q, force })
}

/// What the weights of a rule are fitted to.
#[derive(Debug, Clone, Copy)]
pub struct Fit<'a> {
    /// Law of the material.
    pub law: Hyperelastic,
    /// Frequencies of the coordinates, rad/s. They weigh the equations.
    pub omega: &'a [f64],
    /// Shapes, each with one entry per coordinate.
    pub shapes: &'a [Vec<f64>],
    /// Elastic force of the whole body in each shape.
    pub forces: &'a [Vec<f64>],
    /// Stiffness of the whole body at rest, `m x m`.
    pub stiffness: &'a [f64],
    /// Error of the forces over all shapes, as a share of them, at which no more points are added.
    pub tolerance: f64,
    /// Largest number of points.
    pub most: usize,
}

/// Chooses points and returns their indices with the factors of their weights.
///
/// Each shape is a block of equations whose forces are measured in energies of the coordinates,
/// relative to the whole force. The stiffness at rest is one more such block.
pub fn choose(candidates: &[Point], fit: &Fit<'_>) -> Vec<(usize, f64)> {
    let m = fit.omega.len();
    let roots: Vec<f64> = fit.omega.iter().map(|omega| 1.0 / omega).collect();
    let weighed = |f: &[f64]| f.iter().zip(&roots).map(|(f, root)| (f * root).powi(2)).sum::<f64>().sqrt();
    let scales: Vec<f64> = fit.forces.iter().map(|total| 1.0 / weighed(total).max(1e-300)).collect();
    let at_rest = fit.law.tangent(&Matrix3::zeros());
    // The shapes at rest together count as much as the others.
    let small = (fit.shapes.len() as f64 / m as f64).max(0.1).sqrt();
    let rest = |stiffness: &[f64], column: &mut Vec<f64>| {
        for (row, a) in stiffness.chunks_exact(m).zip(&roots) {
            column.extend(row.iter().zip(&roots).map(|(x, b)| small * a * b * x));
        }
    };
    let rows = (fit.shapes.len() + m) * m;
    let (mut force, mut stiffness) = (vec![0.0; m], vec![0.0; m * m]);
    let mut column = |point: &Point| {
        let mut column = Vec::with_capacity(rows);
        for (q, scale) in fit.shapes.iter().zip(&scales) {
            force.fill(0.0);
            point.add_force(fit.law, q, &mut force);
            column.extend(force.iter().zip(&roots).map(|(f, root)| scale * root * f));
        }
        stiffness.fill(0.0);
        point.add_tangent(m, &at_rest, &mut stiffness);
        rest(&stiffness, &mut column);
        column
    };
    let columns: Vec<Vec<f64>> = candidates.iter().map(&mut column).collect();
    let mut target = Vec::with_capacity(rows);
    for (total, scale) in fit.forces.iter().zip(&scales) {
        target.extend(total.iter().zip(&roots).map(|(f, root)| scale * root * f));
    }
    rest(fit.stiffness, &mut target);
    select(&columns, &target, fit.most, fit.tolerance)
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 8];
    let ((a, tail_a), (b, tail_b)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    for (a, b) in a.iter().zip(b) {
        (0..8).for_each(|k| sums[k] += a[k] * b[k]);
    }
    sums.iter().sum::<f64>() + tail_a.iter().zip(tail_b).map(|(a, b)| a * b).sum::<f64>()
}

/// Chooses at most `most` columns whose combination with positive factors comes closest to the
/// target, greedily. Returns columns with factors.
fn select(columns: &[Vec<f64>], target: &[f64], most: usize, tolerance: f64) -> Vec<(usize, f64)> {
    let size = dot(target, target).sqrt();
    let lengths: Vec<f64> = columns.iter().map(|c| dot(c, c).sqrt().max(f64::MIN_POSITIVE)).collect();
    let batch = ((BATCH * most as f64).ceil() as usize).max(1);
    let mut residual = target.to_vec();
    let mut active: Vec<usize> = Vec::new();
    let mut factors: Vec<f64> = Vec::new();
    let mut gram: Vec<Vec<f64>> = Vec::new();
    let mut right: Vec<f64> = Vec::new();
    let mut best: Vec<(usize, f64)> = Vec::new();
    // Columns that leave may come back, so that the number of rounds is limited.
    for _ in 0..4 * most.div_ceil(batch) {
        if active.len() >= most || dot(&residual, &residual).sqrt() <= tolerance * size {
            break;
        }
        let gains: Vec<f64> = columns.iter().map(|c| dot(c, &residual)).collect();
        let mut order: Vec<usize> =
            (0..columns.len()).filter(|c| gains[*c] > 0.0 && !active.contains(c)).collect();
        order.sort_by(|&a, &b| (gains[b] / lengths[b]).total_cmp(&(gains[a] / lengths[a])));
        order.truncate(batch.min(most - active.len()));
        if order.is_empty() {
            break;
        }
        for new in order {
            let mut row: Vec<f64> = active.iter().map(|&c| dot(&columns[c], &columns[new])).collect();
            row.push(dot(&columns[new], &columns[new]));
            for (gram, entry) in gram.iter_mut().zip(&row) {
                gram.push(*entry);
            }
            gram.push(row);
            right.push(dot(&columns[new], target));
            active.push(new);
            factors.push(0.0);
        }
        non_negative(&gram, &right, &mut factors);
        // What has no weight is dropped.
        let keep: Vec<bool> = factors.iter().map(|&x| x > 0.0).collect();
        let retain = |v: &mut Vec<f64>| {
            let mut keep = keep.iter();
            v.retain(|_| *keep.next().unwrap_or(&true));
        };
        gram.iter_mut().for_each(retain);
        let mut flags = keep.iter();
        gram.retain(|_| *flags.next().unwrap_or(&true));
        let mut flags = keep.iter();
        active.retain(|_| *flags.next().unwrap_or(&true));
        retain(&mut right);
        retain(&mut factors);
        residual.copy_from_slice(target);
        for (&c, factor) in active.iter().zip(&factors) {
            residual.iter_mut().zip(&columns[c]).for_each(|(r, x)| *r -= factor * x);
        }
        best = active.iter().copied().zip(factors.iter().copied()).collect();
    }
    best
}

/// Solves `min |A x - b|` for `x >= 0` from the normal equations (C. L. Lawson and R. J. Hanson,
/// *Solving Least Squares Problems*, 1974, ch. 23), from a feasible `x`.
fn non_negative(gram: &[Vec<f64>], right: &[f64], x: &mut [f64]) {
    let n = x.len();
    let mut free = vec![true; n];
    for _ in 0..3 * n {
        let index: Vec<usize> = (0..n).filter(|&i| free[i]).collect();
        let ridge = 1e-12 * index.iter().map(|&i| gram[i][i]).fold(0.0, f64::max);
        let mut factor = Cholesky::new(index.len());
        for (a, row) in factor.matrix().chunks_exact_mut(index.len().max(1)).enumerate() {
            for (b, entry) in row.iter_mut().enumerate().skip(a) {
                *entry = gram[index[a]][index[b]] + if a == b { ridge } else { 0.0 };
            }
        }
        factor.factor();
        let mut found: Vec<f64> = index.iter().map(|&i| right[i]).collect();
        factor.solve(&mut found);
        // The largest step toward the solution that keeps all weights.
        let mut step = 1.0f64;
        for (&i, &to) in index.iter().zip(found.iter()) {
            if to <= 0.0 {
                step = step.min(if x[i] > 0.0 { x[i] / (x[i] - to) } else { 0.0 });
            }
        }
        for (&i, &to) in index.iter().zip(found.iter()) {
            x[i] += step * (to - x[i]);
        }
        if step >= 1.0 {
            return;
        }
        for (&i, &to) in index.iter().zip(found.iter()) {
            if to <= 0.0 && x[i] <= 1e-14 {
                x[i] = 0.0;
                free[i] = false;
            }
        }
    }
}
