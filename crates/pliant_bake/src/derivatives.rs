//! Modal derivatives: how the modes bend the shape to second order.
//!
//! A displacement along the modes `phi_i` is not an equilibrium for large amplitudes: the stresses
//! of second order displace the body further, `K psi_ij = -f2(phi_i, phi_j)`, where `f2` is the
//! part of the nodal forces of second order (S. R. Idelsohn and A. Cardona, *A reduction method for
//! nonlinear structural dynamic analysis*, CMAME 49, 1985; J. Barbic and D. L. James, *Real-time
//! subspace integration for St. Venant-Kirchhoff deformable models*, ACM Trans. Graph. 24(3),
//! 2005).

use faer::Mat;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::blocks::{self, Tall};
use crate::continuum::Continuum;
use crate::fem::ANCHORED;
use crate::lanczos::Eigenpairs;
use crate::solver::Solver;

/// Combinations of derivatives whose share in the mass is below this share of the largest are
/// rounding errors.
const LEAST: f64 = 1e-10;

/// Number of pure modes among `coordinates`: a third, at most 12, and as many as have enough
/// derivatives for the others.
pub(crate) fn pure_modes(coordinates: usize) -> usize {
    let enough = |k: &usize| k + k * (k + 1) / 2 >= coordinates;
    let least = (1..coordinates).find(enough).unwrap_or(coordinates);
    (coordinates / 3).min(12).max(least)
}

/// Extends the lowest modes to at most `count` coordinates by combinations of their derivatives.
///
/// The derivatives are weighted by `lambda_1^2 / (lambda_i lambda_j)`, made M-orthogonal to the
/// modes, and their principal combinations in the mass metric are kept. The result is orthonormal
/// in M and diagonal in K, as modes are. Returns `None` if a small eigenproblem fails.
pub(crate) fn extend(
    continuum: &Continuum<'_>,
    solver: &Solver<'_>,
    modes: &Eigenpairs,
    count: usize,
) -> Option<Eigenpairs> {
    let k = modes.lambda.len();
    if count <= k {
        return Some(modes.clone());
    }
    let pairs: Vec<(usize, usize)> = (0..k).flat_map(|i| (0..=i).map(move |j| (i, j))).collect();
    let width = pairs.len();
    let mut shapes = second_order_forces(continuum, modes, &pairs);
    solver.solve(&mut shapes, width);
    let weight: Vec<f64> =
        pairs.iter().map(|&(i, j)| modes.lambda[0].powi(2) / (modes.lambda[i] * modes.lambda[j])).collect();
    shapes.par_chunks_exact_mut(width).for_each(|row| {
        row.iter_mut().zip(&weight).for_each(|(x, weight)| *x *= -weight);
    });
    let mut mass = vec![0.0; modes.phi.len()];
    solver.matrix.mass_times(&modes.phi, k, &mut mass);
    // Twice, because the derivatives may lie nearly in the span of the modes.
    for _ in 0..2 {
        let along = blocks::gram(Tall::new(&mass, k), Tall::new(&shapes, width));
        blocks::add_product(&mut shapes, Tall::new(&modes.phi, k), along.as_ref(), -1.0);
    }
    let mut mass = vec![0.0; shapes.len()];
    solver.matrix.mass_times(&shapes, width, &mut mass);
    let gram = blocks::gram(Tall::new(&shapes, width), Tall::new(&mass, width));
    let (values, vectors) = blocks::symmetric_eigen(gram.as_ref())?;
    let most = values.last().copied().unwrap_or(0.0);
    let kept: Vec<usize> =
        (0..width).rev().take(count.saturating_sub(k)).filter(|&c| values[c] > LEAST * most).collect();
    if kept.is_empty() {
        return Some(modes.clone());
    }
    let principal = Mat::from_fn(width, kept.len(), |row, column| {
        vectors[(row, kept[column])] / values[kept[column]].sqrt()
    });
    let mut shapes = blocks::product(Tall::new(&shapes, width), principal.as_ref());
    let width = kept.len();
    // Small combinations have lost digits in their length.
    let mut mass = vec![0.0; shapes.len()];
    solver.matrix.mass_times(&shapes, width, &mut mass);
    let gram = blocks::gram(Tall::new(&shapes, width), Tall::new(&mass, width));
    let (values, vectors) = blocks::symmetric_eigen(gram.as_ref())?;
    let unit = Mat::from_fn(width, width, |row, column| vectors[(row, column)] / values[column].sqrt());
    shapes = blocks::product(Tall::new(&shapes, width), unit.as_ref());

    let mut stiff = vec![0.0; shapes.len()];
    solver.matrix.stiffness_times(&shapes, width, &mut stiff);
    let gram = blocks::gram(Tall::new(&shapes, width), Tall::new(&stiff, width));
    let (values, vectors) = blocks::symmetric_eigen(gram.as_ref())?;
    let shapes = blocks::product(Tall::new(&shapes, width), vectors.as_ref());
    // The modes are K-orthogonal to all that is M-orthogonal to them.
    let mut order: Vec<(f64, usize)> = modes.lambda.iter().copied().zip(0..).collect();
    order.extend(values.into_iter().zip(k..));
    order.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total = order.len();
    let mut phi = vec![0.0; modes.phi.len() / k * total];
    let rows = modes.phi.chunks_exact(k).zip(shapes.chunks_exact(width));
    for (out, (own, other)) in phi.chunks_exact_mut(total).zip(rows) {
        for (out, &(_, from)) in out.iter_mut().zip(&order) {
            *out = if from < k { own[from] } else { other[from - k] };
        }
    }
    Some(Eigenpairs { lambda: order.into_iter().map(|(lambda, _)| lambda).collect(), phi })
}

/// Returns the nodal forces of second order of each pair of modes, as one column per pair.
fn second_order_forces(continuum: &Continuum<'_>, modes: &Eigenpairs, pairs: &[(usize, usize)]) -> Vec<f64> {
    const BATCH: usize = 256;
    let (k, width) = (modes.lambda.len(), pairs.len());
    let mut out = vec![0.0; modes.phi.len() / k * width];
    let elements: Vec<usize> = (0..continuum.fe.affine.len()).collect();
    for batch in elements.chunks(BATCH) {
        let forces: Vec<Vec<Vector3<f64>>> =
            batch.par_iter().map(|&index| element_forces(continuum, index, modes, pairs)).collect();
        for (&index, forces) in batch.iter().zip(&forces) {
            for (&node, forces) in continuum.nodes(index).iter().zip(forces.chunks_exact(width)) {
                let row = continuum.number[node as usize];
                if row == ANCHORED {
                    continue;
                }
                for axis in 0..3 {
                    let out = &mut out[(3 * row as usize + axis) * width..][..width];
                    out.iter_mut().zip(forces).for_each(|(out, force)| *out += force[axis]);
                }
            }
        }
    }
    out
}

/// Returns the forces of one element, `[node][pair]`.
fn element_forces(
    continuum: &Continuum<'_>,
    index: usize,
    modes: &Eigenpairs,
    pairs: &[(usize, usize)],
) -> Vec<Vector3<f64>> {
    let k = modes.lambda.len();
    let mut out = vec![Vector3::zeros(); continuum.nodes(index).len() * pairs.len()];
    let mut gradients = vec![Matrix3::zeros(); k];
    continuum.gradients_of_columns(index, &modes.phi, k, &mut gradients, |weight, shape, gradients| {
        let own: Vec<Matrix3<f64>> = gradients.iter().map(|h| continuum.law.second_order_stress(h)).collect();
        for (column, &(i, j)) in pairs.iter().enumerate() {
            // The symmetric bilinear form of the quadratic one, times two.
            let both = continuum.law.second_order_stress(&(gradients[i] + gradients[j]));
            let stress = weight * (both - own[i] - own[j]);
            for (g, out) in shape.iter().zip(out.chunks_exact_mut(pairs.len())) {
                out[column] += stress * g;
            }
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::pure_modes;

    #[test]
    fn there_are_derivatives_for_all_coordinates_that_are_no_modes() {
        for count in 1..200 {
            let k = pure_modes(count);
            assert!((1..=count).contains(&k) && k + k * (k + 1) / 2 >= count, "{count}: {k}");
        }
        assert_eq!([1, 2, 5, 30, 36, 60].map(pure_modes), [1, 1, 2, 10, 12, 12]);
    }
}
