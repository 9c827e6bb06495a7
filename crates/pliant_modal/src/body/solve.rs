//! The Schur system of the grabs: `(A + C) lambda = gap`, 3 rows a grab.

use nalgebra::{Matrix3, Vector3};

use super::{frame::RigidMotion, grab::Grab};
use crate::Coefficients;

/// Workspace of the solve; grows when a grab is added, never in a step.
#[derive(Debug, Clone, Default)]
pub(crate) struct Schur {
    /// Lower triangle, row-major, `3c x 3c`.
    matrix: Vec<f64>,
    right: Vec<f64>,
}

impl Schur {
    pub(crate) fn reserve(&mut self, grabs: usize) {
        let n = 3 * grabs;
        if self.matrix.len() < n * n {
            self.matrix.resize(n * n, 0.0);
            self.right.resize(n, 0.0);
        }
    }

    /// Sets every grab's pull (body axes, N). Returns in how many directions the system had lost its rank and was regularised.
    pub(crate) fn solve(
        &mut self,
        grabs: &mut [Grab],
        coefficients: &[Coefficients],
        step: f64,
        rigid: Option<&RigidMotion>,
    ) -> usize {
        let n = 3 * grabs.len();
        self.reserve(grabs.len());
        for (g, a) in grabs.iter().enumerate() {
            for (h, b) in grabs.iter().enumerate().take(g + 1) {
                let mut block = Matrix3::zeros();
                // A damper sees the velocity response too; the larger relaxation keeps the matrix symmetric.
                let relaxation = a.config.relaxation.max(b.config.relaxation);
                for ((ra, rb), c) in a.rows().iter().zip(b.rows()).zip(coefficients) {
                    block += (c.response[0] + relaxation * c.response[1].max(c.response[0] / step))
                        * (ra * rb.transpose());
                }
                if let Some(rigid) = rigid {
                    block += rigid.response(&a.arm, &b.arm, relaxation);
                }
                if g == h {
                    block += a.compliance;
                }
                for i in 0..3 {
                    for j in 0..3 {
                        self.matrix[(3 * g + i) * n + 3 * h + j] = block[(i, j)];
                    }
                }
            }
            for i in 0..3 {
                self.right[3 * g + i] = a.gap[i];
            }
        }
        let regularised = cholesky_in_place(&mut self.matrix, n);
        substitute(&self.matrix, n, &mut self.right);
        for (g, grab) in grabs.iter_mut().enumerate() {
            grab.pull = Vector3::from_fn(|i, _| self.right[3 * g + i]);
        }
        regularised
    }
}

/// `L L^T` of the lower triangle. A pivot that rounding has eaten (two hands on one spot, more rows than modes) is replaced by a large one, which
/// gives that direction no share of the force. Returns how many there were.
fn cholesky_in_place(m: &mut [f64], n: usize) -> usize {
    let mut lost = 0;
    for j in 0..n {
        let diagonal = m[j * n + j];
        let mut pivot = diagonal;
        for k in 0..j {
            pivot -= m[j * n + k] * m[j * n + k];
        }
        let sound = pivot > 1e-13 * diagonal.abs();
        if !sound {
            lost += 1;
            // The direction is a combination of earlier ones: dropping it leaves their solution standing.
            pivot = f64::MAX.sqrt();
            for i in j + 1..n {
                m[i * n + j] = 0.0;
            }
            m[j * n + j] = pivot;
            continue;
        }
        let root = pivot.sqrt();
        m[j * n + j] = root;
        for i in j + 1..n {
            let mut sum = m[i * n + j];
            for k in 0..j {
                sum -= m[i * n + k] * m[j * n + k];
            }
            m[i * n + j] = sum / root;
        }
    }
    lost
}

fn substitute(m: &[f64], n: usize, x: &mut [f64]) {
    for i in 0..n {
        let mut sum = x[i];
        for k in 0..i {
            sum -= m[i * n + k] * x[k];
        }
        x[i] = sum / m[i * n + i];
    }
    for i in (0..n).rev() {
        let mut sum = x[i];
        for k in i + 1..n {
            sum -= m[k * n + i] * x[k];
        }
        x[i] = sum / m[i * n + i];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_and_survives_lost_rank() {
        // Rows 0 and 2 are the same row: the pair shares one right-hand side, and the sum of their shares must still solve it.
        let full = [[4.0, 1.0, 4.0], [1.0, 3.0, 1.0], [4.0, 1.0, 4.0]];
        let mut m: Vec<f64> = full.as_flattened().to_vec();
        let mut x = vec![1.0, 2.0, 1.0];
        assert_eq!(cholesky_in_place(&mut m, 3), 1);
        substitute(&m, 3, &mut x);
        for (row, want) in full.iter().zip([1.0, 2.0, 1.0]) {
            let got: f64 = row.iter().zip(&x).map(|(a, b)| a * b).sum();
            assert!((got - want).abs() < 1e-12, "{got} and {want}");
        }
    }
}
