//! A dense Cholesky factorization whose loops vectorize, without allocation after its creation.

use crate::simd::{Work, dot, widest};

/// Factor `U^T U` of a symmetric positive definite matrix.
#[derive(Debug, Clone, Default)]
pub(crate) struct Cholesky {
    n: usize,
    /// Upper triangle in row-major order, `n x n`.
    upper: Vec<f64>,
}

impl Cholesky {
    pub(crate) fn new(n: usize) -> Self {
        Self { n, upper: vec![0.0; n * n] }
    }

    /// The matrix to factor: its upper triangle in row-major order, `n x n`.
    pub(crate) fn matrix(&mut self) -> &mut [f64] {
        &mut self.upper
    }

    /// Factors the matrix in place. A pivot that is not positive is replaced by a huge one, which
    /// gives its direction no share, so that a matrix with rounding errors or NaN is no panic.
    pub(crate) fn factor(&mut self) {
        widest(Factor(self));
    }

    #[inline(always)]
    fn factor_with(&mut self) {
        let n = self.n;
        for j in 0..n {
            let (above, below) = self.upper.split_at_mut((j + 1) * n);
            let row = &mut above[j * n + j..];
            let pivot = row[0];
            // Rounding alone can make a pivot vanish.
            let root = if pivot > 0.0 { pivot.sqrt() } else { f64::MAX.sqrt() };
            let inverse = 1.0 / root;
            row[0] = root;
            row[1..].iter_mut().for_each(|x| *x *= inverse);
            for (step, next) in below.chunks_exact_mut(n).enumerate() {
                let i = step + 1;
                let factor = row[i];
                if factor != 0.0 {
                    for (to, from) in next[j + i..].iter_mut().zip(&row[i..]) {
                        *to -= factor * from;
                    }
                }
            }
        }
    }

    /// Replaces `x` by `U^-T x`.
    pub(crate) fn forward(&self, x: &mut [f64]) {
        self.forward_from(0, x);
    }

    /// Replaces `x` by `U^-T (0, x)` without its `first` zeros.
    pub(crate) fn forward_from(&self, first: usize, x: &mut [f64]) {
        let n = self.n;
        for j in first..n {
            let row = &self.upper[j * n + j..(j + 1) * n];
            let (head, tail) = x[j - first..n - first].split_at_mut(1);
            head[0] /= row[0];
            for (to, from) in tail.iter_mut().zip(&row[1..]) {
                *to -= head[0] * from;
            }
        }
    }

    /// Replaces `x` by `U^-1 x`.
    pub(crate) fn backward(&self, x: &mut [f64]) {
        let n = self.n;
        for j in (0..n).rev() {
            let row = &self.upper[j * n + j..(j + 1) * n];
            x[j] = (x[j] - dot(&row[1..], &x[j + 1..n])) / row[0];
        }
    }

    /// Writes the product of the factored matrix with `x`.
    pub(crate) fn multiply(&self, x: &[f64], out: &mut [f64]) {
        let n = self.n;
        out[..n].fill(0.0);
        for j in 0..n {
            let row = &self.upper[j * n + j..(j + 1) * n];
            let factor = dot(row, &x[j..n]);
            for (out, row) in out[j..n].iter_mut().zip(row) {
                *out += factor * row;
            }
        }
    }

    /// Replaces `x` by the solution of the system with the right side `x`.
    pub(crate) fn solve(&self, x: &mut [f64]) {
        self.forward(x);
        self.backward(x);
    }
}

struct Factor<'a>(&'a mut Cholesky);

impl Work for Factor<'_> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        self.0.factor_with();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_solves_and_survives_lost_rank() {
        let n = 13;
        let noise = |i: usize| ((i * 7919 + 13) % 101) as f64 / 101.0 - 0.5;
        let root: Vec<f64> = (0..n * n).map(noise).collect();
        let entry = |i: usize, j: usize| {
            let own = if i == j { 0.1 } else { 0.0 };
            own + (0..n).map(|k| root[k * n + i] * root[k * n + j]).sum::<f64>()
        };
        let mut cholesky = Cholesky::new(n);
        for i in 0..n {
            for j in i..n {
                cholesky.matrix()[i * n + j] = entry(i, j);
            }
        }
        cholesky.factor();
        let want: Vec<f64> = (0..n).map(|i| noise(3 * i + 1)).collect();
        let mut x: Vec<f64> = (0..n).map(|i| (0..n).map(|j| entry(i, j) * want[j]).sum()).collect();
        cholesky.solve(&mut x);
        for (x, want) in x.iter().zip(&want) {
            assert!((x - want).abs() < 1e-10, "{x} and {want}");
        }
        let mut back = vec![0.0; n];
        cholesky.multiply(&want, &mut back);
        for (i, back) in back.iter().enumerate() {
            let full: f64 = (0..n).map(|j| entry(i, j) * want[j]).sum();
            assert!((back - full).abs() < 1e-12, "{back} and {full}");
        }
        for bad in [0.0, -1.0] {
            let mut cholesky = Cholesky::new(2);
            cholesky.matrix().copy_from_slice(&[bad, 0.0, 0.0, 4.0]);
            cholesky.factor();
            let mut x = [1.0, 8.0];
            cholesky.solve(&mut x);
            assert!(x[0].abs() < 1e-100 && (x[1] - 2.0).abs() < 1e-12, "{x:?}");
        }
    }
}
