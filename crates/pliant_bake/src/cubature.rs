//! Cubature: few points with positive weights whose energy stands for that of the whole body.
//!
//! The points are chosen so that the forces agree with those of all elements in shapes that a body
//! takes when it is pulled, pressed and bent, and in all small ones: greedy selection with
//! non-negative least squares (S. S. An, T. Kim and D. L. James 2008). The rule is complete: it
//! integrates the whole energy, not what is left beside the linear part, whose integrals a rule of
//! few points may make negative.

use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, Vector3};
use pliant_modal::{ElasticEnergy, Material, ModelError, ReducedElasticity};
use rayon::prelude::*;

use crate::continuum::Continuum;
use crate::lanczos::Eigenpairs;

/// Largest number of points whose forces are the reference.
const REFERENCE: usize = 24_000;

/// Largest number of points to choose from.
const CANDIDATES: usize = 3_000;

/// Number of points that find the training shapes.
const COARSE: usize = 1_000;

/// Most points of a rule, by coordinate.
const POINTS_PER_COORDINATE: usize = 4;

/// Error of the forces over the training shapes at which no more points are added.
const TOLERANCE: f64 = 3e-3;

/// Number of points that are added before the weights are computed anew.
const BATCH: usize = 2;

/// Largest energy density of a training shape, as a share of Young's modulus: a mean strain of
/// about a fifth.
const ENERGY: f64 = 0.02;

/// Ways of a hand in the training shapes, as shares of the body's size.
const WAYS: [f64; 4] = [0.04, 0.12, 0.25, 0.5];

/// A patch that is held in the training shapes: the mean displacement by the coordinates, `[axis]
/// [coordinate]`.
pub(crate) type Rows = [Vec<f64>; 3];

/// What a rule is made for.
pub(crate) struct Training<'a> {
    pub(crate) continuum: Continuum<'a>,
    pub(crate) coordinates: &'a Eigenpairs,
    pub(crate) material: Material,
    pub(crate) young: f64,
    /// Patches of the surface that are pulled.
    pub(crate) patches: &'a [Rows],
    /// Largest extent of the body, m.
    pub(crate) size: f64,
}

/// A point of an element with its weight (m^3) and the gradients of all coordinates, nine rows.
#[derive(Clone)]
struct Point {
    weight: f64,
    gradients: Vec<f64>,
}

/// Chooses the points and their weights.
///
/// # Errors
/// Returns an error if a gradient is not finite.
pub(crate) fn train(
    training: &Training<'_>,
    report: &mut dyn FnMut(f64),
) -> Result<ReducedElasticity, ModelError> {
    let lambda = &training.coordinates.lambda;
    let m = lambda.len();
    let reference = points(training, REFERENCE);
    report(0.1);
    let candidates = subset(&reference, CANDIDATES);
    let coarse = subset(&reference, COARSE);
    let rule = ReducedElasticity {
        material: training.material,
        weights: coarse.iter().map(|point| point.weight).collect(),
        gradients: coarse.iter().flat_map(|point| point.gradients.iter().map(|&x| x as f32)).collect(),
    };
    let omega: Vec<f64> = lambda.iter().map(|lambda| lambda.sqrt()).collect();
    let energy = ElasticEnergy::new(&rule, training.continuum.law, &omega)?;
    let shapes: Vec<Vec<f64>> =
        training.patches.par_iter().flat_map(|patch| pulled(&mut energy.clone(), patch, training)).collect();
    report(0.4);
    let (matrix, target) = equations(training, &reference, &candidates, &shapes);
    report(0.7);
    let weights = select(&matrix, &target, POINTS_PER_COORDINATE * m);
    report(0.95);
    let chosen: Vec<(usize, f64)> = weights.into_iter().filter(|&(_, weight)| weight > 0.0).collect();
    let gradients: Vec<f32> =
        chosen.iter().flat_map(|&(c, _)| candidates[c].gradients.iter().map(|&x| x as f32)).collect();
    let weights: Vec<f64> = chosen.iter().map(|&(c, weight)| weight * candidates[c].weight).collect();
    Ok(ReducedElasticity { material: training.material, weights, gradients })
}

/// Returns at most about `most` points of the elements, spread over the body, with weights whose
/// sum is its volume.
fn points(training: &Training<'_>, most: usize) -> Vec<Point> {
    let (continuum, m) = (&training.continuum, training.coordinates.lambda.len());
    let elements = continuum.fe.affine.len();
    let per = pliant_modal::tetrahedron::stiffness_points(continuum.fe.element).0.len();
    let stride = (elements * per).div_ceil(most).max(1);
    // Elements in the order of a coarse grid lie beside each other, so that each stretch of the
    // list is a place of the body.
    let mut order: Vec<usize> = (0..elements).collect();
    let center = |index: usize| -> Vector3<f64> {
        let nodes = &continuum.nodes(index)[..4];
        nodes.iter().map(|&n| Vector3::from(continuum.fe.nodes[n as usize])).sum::<Vector3<f64>>() / 4.0
    };
    let cell = training.size / 16.0;
    let key = |index: usize| {
        let at = center(index);
        let place: [i64; 3] = std::array::from_fn(|k| (at[k] / cell).floor() as i64);
        (place, index)
    };
    order.sort_by_cached_key(|&index| key(index));
    let groups: Vec<&[usize]> = order.chunks(stride).collect();
    groups
        .par_iter()
        .enumerate()
        .flat_map_iter(|(group, members)| {
            // All points of one element of each group, for the volume of the group.
            let volume: f64 = members.iter().map(|&e| continuum.fe.affine[e].volume).sum();
            let index = members[(group * 7919) % members.len()];
            let share = volume / continuum.fe.affine[index].volume;
            let mut found = Vec::with_capacity(per);
            let mut gradients = vec![Matrix3::zeros(); m];
            let phi = &training.coordinates.phi;
            continuum.gradients_of_columns(index, phi, m, &mut gradients, |weight, _, gradients| {
                let mut rows = vec![0.0; 9 * m];
                for (column, h) in gradients.iter().enumerate() {
                    h.iter().enumerate().for_each(|(row, x)| rows[row * m + column] = *x);
                }
                found.push(Point { weight: share * weight, gradients: rows });
            });
            found
        })
        .collect()
}

/// Returns about `most` of the points, evenly from the list, with weights whose sum stays.
fn subset(points: &[Point], most: usize) -> Vec<Point> {
    let stride = points.len().div_ceil(most).max(1);
    let groups = points.chunks(stride).enumerate();
    groups
        .map(|(group, members)| {
            let mut point = members[(group * 7919) % members.len()].clone();
            point.weight = members.iter().map(|point| point.weight).sum();
            point
        })
        .collect()
}

fn gradient(rows: &[f64], q: &[f64]) -> Matrix3<f64> {
    let mut h = Matrix3::zeros();
    for (h, row) in h.iter_mut().zip(rows.chunks_exact(q.len())) {
        *h = row.iter().zip(q).map(|(g, q)| g * q).sum();
    }
    h
}

/// Adds the force of a point, `weight B^T stress`.
fn add_force(rows: &[f64], weight: f64, stress: &Matrix3<f64>, out: &mut [f64]) {
    for (stress, row) in stress.iter().zip(rows.chunks_exact(out.len())) {
        let factor = weight * stress;
        out.iter_mut().zip(row).for_each(|(out, g)| *out += factor * g);
    }
}

/// Adds the stiffness of a point, `weight B^T tangent B`.
fn add_tangent(rows: &[f64], m: usize, weight: f64, tangent: &SMatrix<f64, 9, 9>, out: &mut [f64]) {
    let mut half = vec![0.0; 9 * m];
    for (a, half) in half.chunks_exact_mut(m).enumerate() {
        for (b, row) in rows.chunks_exact(m).enumerate() {
            let factor = weight * tangent[(a, b)];
            half.iter_mut().zip(row).for_each(|(half, g)| *half += factor * g);
        }
    }
    for (row, half) in rows.chunks_exact(m).zip(half.chunks_exact(m)) {
        for (g, out) in row.iter().zip(out.chunks_exact_mut(m)) {
            out.iter_mut().zip(half).for_each(|(out, half)| *out += g * half);
        }
    }
}

/// Returns shapes in which a patch is pulled out, pressed in and pulled to both sides.
fn pulled(energy: &mut ElasticEnergy, patch: &Rows, training: &Training<'_>) -> Vec<Vec<f64>> {
    let lambda = &training.coordinates.lambda;
    let m = lambda.len();
    let most = ENERGY * training.young * training.continuum.fe.volume();
    // The softest and the stiffest direction of the patch, both ways, and the one between.
    let soft = Matrix3::from_fn(|a, b| (0..m).map(|i| patch[a][i] * patch[b][i] / lambda[i]).sum::<f64>());
    let eigen = soft.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let axes = order.map(|k| eigen.eigenvectors.column(k).into_owned());
    let mut out = Vec::new();
    for (axis, sign) in [(0, 1.0), (0, -1.0), (1, 1.0), (2, 1.0), (2, -1.0)] {
        let direction: Vector3<f64> = sign * axes[axis];
        let mut q = vec![0.0; m];
        for way in WAYS {
            let there = way * training.size * direction;
            let Some(next) = hold(energy, lambda, patch, &there, &q) else { break };
            if energy.energy(&next) > most {
                break;
            }
            q = next;
            out.push(q.clone());
        }
    }
    out
}

/// Returns the shape of least energy in which a patch is displaced by `there`, roughly, from the
/// shape `start`.
fn hold(
    energy: &mut ElasticEnergy,
    lambda: &[f64],
    patch: &Rows,
    there: &Vector3<f64>,
    start: &[f64],
) -> Option<Vec<f64>> {
    const ROUNDS: usize = 5;
    let m = start.len();
    let mut q = start.to_vec();
    let rows = DMatrix::from_fn(m, 3, |i, axis| patch[axis][i]);
    for _ in 0..ROUNDS {
        energy.linearize(&q);
        let mut stiffness = DMatrix::zeros(m, m);
        let mut row = vec![0.0; m];
        for i in 0..m {
            energy.tangent_row(i, &mut row[i..]);
            for (j, &x) in row.iter().enumerate().skip(i) {
                stiffness[(j, i)] = x;
            }
        }
        let factor = nalgebra::Cholesky::new(stiffness)?;
        let free = -factor.solve(&DVector::from_column_slice(energy.force()));
        let soft = factor.solve(&rows);
        let gap = there - rows.tr_mul(&(DVector::from_column_slice(&q) + &free)).fixed_rows::<3>(0);
        let inner = (rows.transpose() * &soft).fixed_view::<3, 3>(0, 0).into_owned();
        let pull = inner.try_inverse()? * gap;
        let way = free + soft * pull;
        let length = |x: &[f64]| x.iter().zip(lambda).map(|(x, l)| x * x * l).sum::<f64>();
        q.iter_mut().zip(way.iter()).for_each(|(q, way)| *q += way);
        if length(way.as_slice()) < 1e-6 * length(&q) {
            break;
        }
    }
    q.iter().all(|x| x.is_finite()).then_some(q)
}

/// Makes the equations of the weights: one column for each candidate (with its own weight), and the
/// right side from the reference.
///
/// Each shape is a block of `m` rows whose forces are measured in energies of the coordinates,
/// relative to the whole force. The unit vectors of the stiffness at rest are such blocks too.
fn equations(
    training: &Training<'_>,
    reference: &[Point],
    candidates: &[Point],
    shapes: &[Vec<f64>],
) -> (Vec<Vec<f64>>, Vec<f64>) {
    let (law, lambda) = (training.continuum.law, &training.coordinates.lambda);
    let m = lambda.len();
    let totals: Vec<Vec<f64>> = shapes
        .par_iter()
        .map(|q| {
            let mut sum = vec![0.0; m];
            for point in reference {
                let stress = law.stress(&gradient(&point.gradients, q));
                add_force(&point.gradients, point.weight, &stress, &mut sum);
            }
            sum
        })
        .collect();
    let scales: Vec<f64> = totals
        .iter()
        .map(|total| 1.0 / total.iter().zip(lambda).map(|(f, l)| f * f / l).sum::<f64>().sqrt().max(1e-300))
        .collect();
    let roots: Vec<f64> = lambda.iter().map(|l| 1.0 / l.sqrt()).collect();
    let at_rest = law.tangent(&Matrix3::zeros());
    // The shapes at rest together count as much as the others.
    let small = (shapes.len() as f64 / m as f64).max(0.1).sqrt();
    let columns = candidates
        .par_iter()
        .map(|point| {
            let mut column = Vec::with_capacity((shapes.len() + m) * m);
            for (q, scale) in shapes.iter().zip(&scales) {
                let mut force = vec![0.0; m];
                let stress = law.stress(&gradient(&point.gradients, q));
                add_force(&point.gradients, point.weight, &stress, &mut force);
                column.extend(force.iter().zip(&roots).map(|(f, root)| scale * root * f));
            }
            let mut stiffness = vec![0.0; m * m];
            add_tangent(&point.gradients, m, point.weight, &at_rest, &mut stiffness);
            for (row, a) in stiffness.chunks_exact(m).zip(&roots) {
                column.extend(row.iter().zip(&roots).map(|(x, b)| small * a * b * x));
            }
            column
        })
        .collect();
    let mut target = Vec::with_capacity((shapes.len() + m) * m);
    for (total, scale) in totals.iter().zip(&scales) {
        target.extend(total.iter().zip(&roots).map(|(f, root)| scale * root * f));
    }
    for i in 0..m {
        target.extend((0..m).map(|j| if i == j { small } else { 0.0 }));
    }
    (columns, target)
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
fn select(columns: &[Vec<f64>], target: &[f64], most: usize) -> Vec<(usize, f64)> {
    let size = dot(target, target).sqrt();
    let lengths: Vec<f64> = columns.par_iter().map(|c| dot(c, c).sqrt().max(f64::MIN_POSITIVE)).collect();
    let mut residual = target.to_vec();
    let mut active: Vec<usize> = Vec::new();
    let mut factors: Vec<f64> = Vec::new();
    let mut gram: Vec<Vec<f64>> = Vec::new();
    let mut right: Vec<f64> = Vec::new();
    let mut best: Vec<(usize, f64)> = Vec::new();
    // Columns that leave may come back, so that the number of rounds is limited.
    for _ in 0..4 * most.div_ceil(BATCH) {
        if active.len() >= most || dot(&residual, &residual).sqrt() <= TOLERANCE * size {
            break;
        }
        let gains: Vec<f64> = columns.par_iter().map(|c| dot(c, &residual)).collect();
        let mut order: Vec<usize> =
            (0..columns.len()).filter(|c| gains[*c] > 0.0 && !active.contains(c)).collect();
        order.sort_by(|&a, &b| (gains[b] / lengths[b]).total_cmp(&(gains[a] / lengths[a])));
        order.truncate(BATCH.min(most - active.len()));
        if order.is_empty() {
            break;
        }
        for new in order {
            let mut row: Vec<f64> = active.par_iter().map(|&c| dot(&columns[c], &columns[new])).collect();
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
        let matrix = DMatrix::from_fn(index.len(), index.len(), |a, b| {
            gram[index[a]][index[b]] + if a == b { ridge } else { 0.0 }
        });
        let Some(factor) = nalgebra::Cholesky::new(matrix) else { return };
        let found = factor.solve(&DVector::from_iterator(index.len(), index.iter().map(|&i| right[i])));
        // The largest step towards the solution that keeps all weights.
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
