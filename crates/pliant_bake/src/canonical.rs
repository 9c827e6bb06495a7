//! Makes the modes unique: chooses the basis of degenerate modes and the sign of every mode.

use faer::Mat;

use crate::blocks::{self, Tall};
use crate::fem::ANCHORED;
use crate::lanczos::Eigenpairs;
use crate::sparse::BlockCsr;

/// Relative difference up to which neighboring eigenvalues count as equal. Within a cluster this
/// tight, a rotation of the vectors changes the residuals only negligibly.
const CLUSTER: f64 = 1e-10;

/// Chooses one basis for each degenerate eigenvalue and one sign for each mode.
///
/// The modes of a degenerate eigenvalue are rotated so that they diagonalize the mass matrix
/// weighted by 1, 2, 3 along x, y, z. The bending modes of a round bar then lie in the axes.
/// Afterwards the largest entry of each mode becomes positive. Among entries within 1e-6 of the
/// largest, the first in node order decides.
pub(crate) fn canonicalize(modes: &mut Eigenpairs, matrix: &BlockCsr, number: &[u32]) {
    let count = modes.lambda.len();
    let mut start = 0;
    while start < count {
        let mut end = start + 1;
        while end < count && modes.lambda[end] - modes.lambda[end - 1] <= CLUSTER * modes.lambda[end] {
            end += 1;
        }
        if end - start > 1 {
            turn(modes, matrix, start, end);
        }
        start = end;
    }
    let mut largest = vec![0.0f64; count];
    for row in modes.phi.chunks_exact(count) {
        for (largest, x) in largest.iter_mut().zip(row) {
            *largest = largest.max(x.abs());
        }
    }
    let mut sign = vec![0.0; count];
    for &row in number.iter().filter(|&&row| row != ANCHORED) {
        for entries in modes.phi[3 * row as usize * count..][..3 * count].chunks_exact(count) {
            for j in 0..count {
                if sign[j] == 0.0 && entries[j].abs() >= (1.0 - 1e-6) * largest[j] {
                    sign[j] = entries[j].signum();
                }
            }
        }
    }
    for row in modes.phi.chunks_exact_mut(count) {
        for (x, sign) in row.iter_mut().zip(&sign) {
            *x *= sign;
        }
    }
}

fn turn(modes: &mut Eigenpairs, matrix: &BlockCsr, start: usize, end: usize) {
    let count = modes.lambda.len();
    let width = end - start;
    let block: Vec<f64> =
        modes.phi.chunks_exact(count).flat_map(|row| row[start..end].iter().copied()).collect();
    let mut weighted = vec![0.0; block.len()];
    matrix.mass_times(&block, width, &mut weighted);
    for (dof, row) in weighted.chunks_exact_mut(width).enumerate() {
        let weight = (dof % 3 + 1) as f64;
        row.iter_mut().for_each(|x| *x *= weight);
    }
    let gram = blocks::gram(Tall::new(&block, width), Tall::new(&weighted, width));
    let symmetric = Mat::from_fn(width, width, |i, j| 0.5 * (gram[(i, j)] + gram[(j, i)]));
    // Every basis of the cluster is valid, so the modes stay unchanged when the small problem
    // fails.
    if let Some((_, vectors)) = blocks::symmetric_eigen(symmetric.as_ref()) {
        let turned = blocks::product(Tall::new(&block, width), vectors.as_ref());
        blocks::put(&mut modes.phi, count, start, &turned, width);
    }
}
