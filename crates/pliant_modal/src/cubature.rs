//! Cubature: few points with positive weights whose energy stands for that of a whole body.
//!
//! The points are chosen so that the forces agree with those of all points in given shapes, and in
//! all small ones: greedy selection with non-negative least squares (S. S. An, T. Kim and D. L.
//! James, *Optimizing Cubature for Efficient Integration of Subspace Deformations*, ACM Trans.
//! Graph. 27(5), 2008). A bake makes the rule of a model, and taking hold of a patch the rule that
//! includes the patch's own shapes.

use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, Vector3};

use crate::{
    ElasticEnergy, Hyperelastic,
    nonlinear::{Cholesky, LANES, Lane},
    simd::{Work, widest},
};

/// Number of points that are added before the weights are computed anew, as a share of the largest
/// number of points.
const BATCH: f64 = 1.0 / 36.0;

/// Number of points whose gains are compared exactly, for each that is added.
const COMPARED: usize = 12;

/// Number of small shapes that measure the stiffness at rest.
const SMALL: usize = 32;

/// Number of sums by which a block of equations is sketched.
const SKETCH: usize = 8;

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
    let patches = std::slice::from_ref(patch);
    let mut q = vec![0.0; omega.len()];
    let mut out = Vec::new();
    for way in ways {
        let Some(next) = hold(energy, omega, patches, &[*way * direction], &q, ROUNDS) else { break };
        let reached = energy.energy(&next.q);
        if reached.is_nan() || reached > most {
            break;
        }
        q.clone_from(&next.q);
        out.push(next);
    }
    out
}

/// Compliance of the hold of several patches, as a share of the largest of their own.
const RIDGE: f64 = 1e-4;

/// Number of Newton rounds that find a shape.
pub(crate) const ROUNDS: usize = 5;

/// A shape in which patches are held.
#[derive(Debug, Clone)]
pub struct GuidedShape {
    /// Coordinates.
    pub q: Vec<f64>,
    /// Displacement of each held patch, m.
    pub there: Vec<Vector3<f64>>,
    /// Force that holds each of them there, N.
    pub forces: Vec<Vector3<f64>>,
}

/// Returns roughly the shape of least energy in which patches are displaced by `there` (m), from
/// the shape `start`. Returns `None` if it is not finite.
pub(crate) fn hold(
    energy: &mut ElasticEnergy,
    omega: &[f64],
    patches: &[Rows],
    there: &[Vector3<f64>],
    start: &[f64],
    rounds: usize,
) -> Option<GuidedShape> {
    let (m, rows) = (start.len(), 3 * patches.len());
    let row = |k: usize| &patches[k / 3][k % 3][..];
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut q = start.to_vec();
    let mut forces = DVector::zeros(rows);
    let mut factor = Cholesky::new(m);
    for _ in 0..rounds {
        energy.linearize(&q);
        for (i, row) in factor.matrix().chunks_exact_mut(m).enumerate() {
            energy.tangent_row(i, &mut row[i..]);
        }
        factor.factor();
        let mut free = energy.force().to_vec();
        factor.solve(&mut free);
        let solved = |k: usize| {
            let mut out = row(k).to_vec();
            factor.solve(&mut out);
            out
        };
        let soft: Vec<Vec<f64>> = (0..rows).map(solved).collect();
        let gap = DVector::from_fn(rows, |k, _| there[k / 3][k % 3] - dot(row(k), &q) + dot(row(k), &free));
        let mut inner = DMatrix::from_fn(rows, rows, |a, b| dot(row(a), &soft[b]));
        if patches.len() > 1 {
            // Patches that cannot move, or that lie in each other, are held nearly there.
            let ridge = RIDGE * inner.diagonal().amax();
            (0..rows).for_each(|k| inner[(k, k)] += ridge);
        }
        forces = inner.lu().solve(&gap)?;
        let (mut way, mut length) = (0.0, 0.0);
        for (i, q) in q.iter_mut().enumerate() {
            let step = forces.iter().zip(&soft).map(|(force, soft)| force * soft[i]).sum::<f64>() - free[i];
            *q += step;
            way += (omega[i] * step).powi(2);
            length += (omega[i] * *q).powi(2);
        }
        if way < 1e-6 * length {
            break;
        }
    }
    let sound = q.iter().chain(forces.iter()).all(|x| x.is_finite());
    let forces = forces.as_slice().as_chunks::<3>().0.iter().map(|&force| force.into()).collect();
    sound.then_some(GuidedShape { q, there: there.to_vec(), forces })
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
/// relative to the whole force. The stiffness at rest is measured by its forces in a few small
/// shapes in which all coordinates have the same energy and signs at random: their mean square is
/// that of all its entries.
pub fn choose(candidates: &[Point], fit: &Fit<'_>) -> Vec<(usize, f64)> {
    let equations = Equations::new(fit);
    let mut columns: Vec<Option<Vec<f64>>> = vec![None; candidates.len()];
    let (mut lengths, mut sketches) = (Vec::with_capacity(candidates.len()), Vec::new());
    let mut column = vec![0.0; equations.rows()];
    for point in candidates {
        widest(Column { equations: &equations, point, out: &mut column });
        lengths.push(widest(Dot(&column, &column)).sqrt().max(f64::MIN_POSITIVE));
        equations.sketch(&column, &mut sketches);
    }
    let size = widest(Dot(&equations.target, &equations.target)).sqrt();
    let batch = ((BATCH * fit.most as f64).ceil() as usize).max(1);
    let mut residual = equations.target.clone();
    let mut active: Vec<usize> = Vec::new();
    let mut factors: Vec<f64> = Vec::new();
    let mut gram: Vec<Vec<f64>> = Vec::new();
    let mut right: Vec<f64> = Vec::new();
    let mut best: Vec<(usize, f64)> = Vec::new();
    let mut wanted = Vec::new();
    // Columns that leave may come back, so that the number of rounds is limited.
    for _ in 0..4 * fit.most.div_ceil(batch) {
        if active.len() >= fit.most || widest(Dot(&residual, &residual)).sqrt() <= fit.tolerance * size {
            break;
        }
        wanted.clear();
        equations.sketch(&residual, &mut wanted);
        let mut gains = vec![0.0f32; candidates.len()];
        widest(Gains { sketches: &sketches, wanted: &wanted, out: &mut gains });
        let mut order: Vec<(f64, usize)> = (0..candidates.len())
            .filter(|c| !active.contains(c))
            .map(|c| (f64::from(gains[c]) / lengths[c], c))
            .collect();
        let by_gain = |a: &(f64, usize), b: &(f64, usize)| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1));
        order.sort_by(by_gain);
        // The best by their sketches are compared exactly, and all where none of those helps.
        let compared = (COMPARED * batch).min(order.len());
        let mut exact = |order: &mut [(f64, usize)]| {
            for (gain, c) in order {
                let point = &candidates[*c];
                let column = columns[*c].get_or_insert_with(|| {
                    let mut out = vec![0.0; equations.rows()];
                    widest(Column { equations: &equations, point, out: &mut out });
                    out
                });
                *gain = widest(Dot(column, &residual)) / lengths[*c];
            }
        };
        let (first, others) = order.split_at_mut(compared);
        exact(first);
        if first.iter().any(|(gain, _)| *gain > 0.0) {
            order.truncate(compared);
        } else {
            exact(others);
        }
        order.retain(|(gain, _)| *gain > 0.0);
        order.sort_by(by_gain);
        order.truncate(batch.min(fit.most - active.len()));
        if order.is_empty() {
            break;
        }
        let of = |c: usize| columns[c].as_deref().unwrap_or_default();
        for (_, new) in order {
            let mut row: Vec<f64> = active.iter().map(|&c| widest(Dot(of(c), of(new)))).collect();
            row.push(widest(Dot(of(new), of(new))));
            for (gram, entry) in gram.iter_mut().zip(&row) {
                gram.push(*entry);
            }
            gram.push(row);
            right.push(widest(Dot(of(new), &equations.target)));
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
        residual.copy_from_slice(&equations.target);
        for (&c, factor) in active.iter().zip(&factors) {
            widest(Less { column: of(c), factor: *factor, out: &mut residual });
        }
        best = active.iter().copied().zip(factors.iter().copied()).collect();
    }
    best
}

/// The equations of a fit. Eight shapes go in the lanes of a block, which has one row per
/// coordinate.
struct Equations {
    law: Hyperelastic,
    at_rest: SMatrix<f64, 9, 9>,
    roots: Vec<f64>,
    blocks: Vec<CandidateBlock>,
    /// `[block][coordinate][lane]`.
    target: Vec<f64>,
}

struct CandidateBlock {
    at: Vec<Lane>,
    scale: Lane,
    is_small: bool,
}

impl Equations {
    fn new(fit: &Fit<'_>) -> Self {
        let m = fit.omega.len();
        let roots: Vec<f64> = fit.omega.iter().map(|omega| 1.0 / omega).collect();
        let weighed =
            |f: &[f64]| f.iter().zip(&roots).map(|(f, root)| (f * root).powi(2)).sum::<f64>().sqrt();
        let (mut blocks, mut target) = (Vec::new(), Vec::new());
        let mut add = |shapes: &[Vec<f64>], forces: &[Vec<f64>], scales: &[f64], is_small: bool| {
            let (mut at, mut scale) = (vec![Lane::splat(0.0); m], Lane::splat(0.0));
            let mut totals = vec![Lane::splat(0.0); m];
            for (lane, ((shape, force), own)) in shapes.iter().zip(forces).zip(scales).enumerate() {
                scale.0[lane] = *own;
                for k in 0..m {
                    at[k].0[lane] = shape[k];
                    totals[k].0[lane] = own * roots[k] * force[k];
                }
            }
            target.extend(totals.iter().flat_map(|total| total.0));
            blocks.push(CandidateBlock { at, scale, is_small });
        };
        for (shapes, forces) in fit.shapes.chunks(LANES).zip(fit.forces.chunks(LANES)) {
            let scales: Vec<f64> = forces.iter().map(|total| 1.0 / weighed(total).max(1e-300)).collect();
            add(shapes, forces, &scales, false);
        }
        // The shapes at rest together count as much as the others.
        let small = (fit.shapes.len() as f64 / m as f64).max(0.1).sqrt();
        let scale = small / (SMALL as f64).sqrt();
        for first in (0..SMALL).step_by(LANES) {
            let shapes: Vec<Vec<f64>> = (first..first + LANES)
                .map(|shape| roots.iter().enumerate().map(|(k, root)| sign(shape * m + k) * root).collect())
                .collect();
            let forces: Vec<Vec<f64>> = shapes
                .iter()
                .map(|shape| fit.stiffness.chunks_exact(m).map(|row| dot(row, shape)).collect())
                .collect();
            add(&shapes, &forces, &[scale; LANES], true);
        }
        let at_rest = fit.law.tangent(&Matrix3::zeros());
        Self { law: fit.law, at_rest, roots, blocks, target }
    }

    fn rows(&self) -> usize {
        self.target.len()
    }

    /// Adds the sketch of a column: sums of its coordinates' rows with signs at random (M.
    /// Charikar, K. Chen and M. Farach-Colton, *Finding Frequent Items in Data Streams*, 2002).
    fn sketch(&self, column: &[f64], out: &mut Vec<f32>) {
        let m = self.roots.len();
        for block in column.chunks_exact(m * LANES) {
            let mut sums = [[0.0f32; LANES]; SKETCH];
            for (k, rows) in block.chunks_exact(LANES).enumerate() {
                let sign = sign(7919 * k) as f32;
                sums[k % SKETCH].iter_mut().zip(rows).for_each(|(sum, x)| *sum += sign * *x as f32);
            }
            out.extend(sums.iter().flatten());
        }
    }
}

/// A sign that looks random (the finalizer of S. Vigna's SplitMix64).
fn sign(seed: usize) -> f64 {
    let mut x = (seed as u64).wrapping_add(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    if (x ^ (x >> 31)) & 1 == 0 { 1.0 } else { -1.0 }
}

/// Writes the forces of a point in all equations.
struct Column<'a> {
    equations: &'a Equations,
    point: &'a Point,
    out: &'a mut [f64],
}

impl Work for Column<'_> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        let Self { equations, point, out } = self;
        let m = equations.roots.len();
        let rows: [&[f64]; 9] = std::array::from_fn(|e| &point.gradients[e * m..][..m]);
        for (block, out) in equations.blocks.iter().zip(out.chunks_exact_mut(m * LANES)) {
            let mut h = [Lane::splat(0.0); 9];
            for (k, q) in block.at.iter().enumerate() {
                for e in 0..9 {
                    h[e] = h[e].plus(rows[e][k], *q);
                }
            }
            let mut stress = [Lane::splat(0.0); 9];
            if block.is_small {
                for (e, stress) in stress.iter_mut().enumerate() {
                    for (d, h) in h.iter().enumerate() {
                        *stress = stress.plus(equations.at_rest[(e, d)], *h);
                    }
                }
            } else {
                stress = equations.law.stresses(&h);
            }
            for stress in &mut stress {
                *stress = point.weight * (block.scale * *stress);
            }
            for (k, out) in out.chunks_exact_mut(LANES).enumerate() {
                let mut sum = Lane::splat(0.0);
                for e in 0..9 {
                    sum = sum.plus(rows[e][k], stress[e]);
                }
                let root = equations.roots[k];
                out.iter_mut().zip(sum.0).for_each(|(out, x)| *out = root * x);
            }
        }
    }
}

/// Products of sketches with that of what is wanted.
struct Gains<'a> {
    sketches: &'a [f32],
    wanted: &'a [f32],
    out: &'a mut [f32],
}

impl Work for Gains<'_> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        const WIDTH: usize = 16;
        let wanted = self.wanted.as_chunks::<WIDTH>().0;
        for (sketch, out) in self.sketches.chunks_exact(self.wanted.len()).zip(self.out) {
            let mut sums = [0.0f32; WIDTH];
            for (a, b) in sketch.as_chunks::<WIDTH>().0.iter().zip(wanted) {
                (0..WIDTH).for_each(|k| sums[k] += a[k] * b[k]);
            }
            *out = sums.iter().sum();
        }
    }
}

/// Takes a multiple of a column away.
struct Less<'a> {
    column: &'a [f64],
    factor: f64,
    out: &'a mut [f64],
}

impl Work for Less<'_> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        self.out.iter_mut().zip(self.column).for_each(|(out, x)| *out -= self.factor * x);
    }
}

/// The product of two columns.
struct Dot<'a>(&'a [f64], &'a [f64]);

impl Work for Dot<'_> {
    type Out = f64;
    #[inline(always)]
    fn run(self) -> f64 {
        dot(self.0, self.1)
    }
}

#[inline(always)]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    const WIDTH: usize = 32;
    let mut sums = [0.0; WIDTH];
    let ((a, tail_a), (b, tail_b)) = (a.as_chunks::<WIDTH>(), b.as_chunks::<WIDTH>());
    for (a, b) in a.iter().zip(b) {
        (0..WIDTH).for_each(|k| sums[k] += a[k] * b[k]);
    }
    sums.iter().sum::<f64>() + tail_a.iter().zip(tail_b).map(|(a, b)| a * b).sum::<f64>()
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
