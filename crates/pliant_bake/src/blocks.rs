//! Products of tall blocks of vectors, stored row by row: entry (dof, column) is at
//! `dof * stride + column`.
//!
//! The rows are split into chunks of fixed size, and the partial sums are added in order. The
//! result is therefore the same to the bit for any number of threads.

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatMut, MatRef, Par};
use rayon::prelude::*;

/// Rows per parallel task.
const CHUNK: usize = 768;

/// A read-only view of some columns of a tall block.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tall<'a> {
    pub(crate) data: &'a [f64],
    pub(crate) stride: usize,
    /// Index of the first column of the view.
    pub(crate) from: usize,
    pub(crate) columns: usize,
}

impl<'a> Tall<'a> {
    /// Views a block whose rows are contiguous.
    pub(crate) fn new(data: &'a [f64], columns: usize) -> Self {
        Self { data, stride: columns, from: 0, columns }
    }

    fn chunk(&self, index: usize) -> MatRef<'a, f64> {
        let rows = self.data.len() / self.stride;
        let (start, end) = (index * CHUNK, rows.min((index + 1) * CHUNK));
        let data = &self.data[start * self.stride..end * self.stride];
        MatRef::from_row_major_slice(data, end - start, self.stride).subcols(self.from, self.columns)
    }
}

/// Returns `a^T b`.
pub(crate) fn gram(a: Tall<'_>, b: Tall<'_>) -> Mat<f64> {
    let rows = a.data.len() / a.stride.max(1);
    let parts: Vec<Mat<f64>> = (0..rows.div_ceil(CHUNK))
        .into_par_iter()
        .map(|index| {
            let mut part = Mat::zeros(a.columns, b.columns);
            matmul(&mut part, Accum::Replace, a.chunk(index).transpose(), b.chunk(index), 1.0, Par::Seq);
            part
        })
        .collect();
    let mut sum = Mat::zeros(a.columns, b.columns);
    for part in parts {
        sum += part;
    }
    sum
}

/// Computes `out += alpha a c`. `out` has `c.ncols()` columns.
pub(crate) fn add_product(out: &mut [f64], a: Tall<'_>, c: MatRef<'_, f64>, alpha: f64) {
    let columns = c.ncols();
    if columns == 0 || a.columns == 0 {
        return;
    }
    out.par_chunks_mut(CHUNK * columns).enumerate().for_each(|(index, out)| {
        let rows = out.len() / columns;
        let out = MatMut::from_row_major_slice_mut(out, rows, columns);
        matmul(out, Accum::Add, a.chunk(index), c, alpha, Par::Seq);
    });
}

/// Returns `a c` as a new block.
pub(crate) fn product(a: Tall<'_>, c: MatRef<'_, f64>) -> Vec<f64> {
    let mut out = vec![0.0; a.data.len() / a.stride.max(1) * c.ncols()];
    add_product(&mut out, a, c, 1.0);
    out
}

/// Copies a block into the columns `at..` of a wider one.
pub(crate) fn put(wide: &mut [f64], stride: usize, at: usize, block: &[f64], columns: usize) {
    wide.par_chunks_mut(stride * CHUNK).zip(block.par_chunks(columns * CHUNK)).for_each(|(wide, block)| {
        for (to, from) in wide.chunks_exact_mut(stride).zip(block.chunks_exact(columns)) {
            to[at..at + columns].copy_from_slice(from);
        }
    });
}

/// Returns the eigenvalues (ascending) and the eigenvectors (columns) of a small symmetric matrix.
///
/// Returns `None` when the iteration fails.
///
/// The matrix is scaled to entries of about one first: the vectors that faer returns for large
/// entries are wrong (`eigenvectors_do_not_depend_on_the_scale`).
pub(crate) fn symmetric_eigen(a: MatRef<'_, f64>) -> Option<(Vec<f64>, Mat<f64>)> {
    use faer::diag::Diag;
    use faer::dyn_stack::{MemBuffer, MemStack};
    use faer::linalg::evd;
    let n = a.nrows();
    let largest = a.norm_max();
    // A power of two changes no digit.
    let scale = if largest.is_normal() { largest.log2().floor().exp2() } else { 1.0 };
    let a = faer::Scale(1.0 / scale) * a;
    let mut values = Diag::<f64>::zeros(n);
    let mut vectors = Mat::zeros(n, n);
    let scratch =
        evd::self_adjoint_evd_scratch::<f64>(n, evd::ComputeEigenvectors::Yes, Par::Seq, Default::default());
    let mut buffer = MemBuffer::new(scratch);
    evd::self_adjoint_evd(
        a.as_ref(),
        values.as_mut(),
        Some(vectors.as_mut()),
        Par::Seq,
        MemStack::new(&mut buffer),
        Default::default(),
    )
    .ok()?;
    let values: Vec<f64> = (0..n).map(|i| scale * values[i]).collect();
    values.iter().all(|v| v.is_finite()).then_some((values, vectors))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eigenvectors_do_not_depend_on_the_scale() {
        let n = 150;
        let unit = Mat::from_fn(n, n, |i, j| {
            let apart = i.abs_diff(j) as f64;
            (1.0 + (i.min(j) as f64 * 0.7).sin()) * (-0.3 * apart).exp()
        });
        for scale in [1e-12, 1.0, 1e6, 1e10, 1e15] {
            let a = faer::Scale(scale) * &unit;
            let (values, vectors) = symmetric_eigen(a.as_ref()).expect("a symmetric matrix");
            let image = &a * &vectors;
            let left = Mat::from_fn(n, n, |i, j| image[(i, j)] - values[j] * vectors[(i, j)]);
            assert!(
                left.norm_max() < 1e-13 * a.norm_max(),
                "{scale:e}: {:e}",
                left.norm_max() / a.norm_max()
            );
        }
    }
}
