//! The linear system of all hands, `(A + r B + C) pull = gap`, with three rows per hand.

/// Workspace of the solve. It grows when hands are added.
#[derive(Debug, Clone, Default)]
pub(crate) struct System {
    /// Matrix in row-major order, `n x n`. Of a symmetric one, the upper triangle, which is set as
    /// the lower one.
    matrix: Vec<f64>,
    right: Vec<f64>,
    /// Workspace: a sum for each column.
    sums: Vec<f64>,
    pivots: Vec<usize>,
    symmetric: bool,
}

impl System {
    /// A pivot below this share of its diagonal consists of rounding errors. This happens with two
    /// hands at one place, or with more rows than modes.
    const LOST: f64 = 1e-13;

    /// Reserves memory for this number of hands, so that a step allocates nothing.
    pub(crate) fn reserve(&mut self, hands: usize) {
        let n = 3 * hands;
        self.matrix.reserve((n * n).saturating_sub(self.matrix.len()));
        self.right.reserve(n.saturating_sub(self.right.len()));
        self.sums.reserve(n.saturating_sub(self.sums.len()));
        self.pivots.reserve(n.saturating_sub(self.pivots.len()));
    }

    /// Sets the system to `n` rows of zeros. A `symmetric` system uses only the lower triangle.
    pub(crate) fn clear(&mut self, n: usize, symmetric: bool) {
        self.matrix.clear();
        self.matrix.resize(n * n, 0.0);
        self.right.clear();
        self.right.resize(n, 0.0);
        self.symmetric = symmetric;
    }

    pub(crate) fn set(&mut self, row: usize, column: usize, value: f64) {
        let n = self.right.len();
        if !self.symmetric {
            self.matrix[row * n + column] = value;
        } else if column <= row {
            self.matrix[column * n + row] = value;
        }
    }

    pub(crate) fn right(&mut self) -> &mut [f64] {
        &mut self.right
    }

    /// Replaces the right side by the solution and returns the number of directions without rank.
    ///
    /// These directions get no share of the solution and do not change that of the others.
    pub(crate) fn solve(&mut self) -> usize {
        if self.symmetric { self.cholesky() } else { self.eliminate() }
    }

    /// Factors the matrix in place as `U^T U` and solves.
    ///
    /// Each entry is a sum over the rows above, in their order. All sums of a row go on together,
    /// so that none waits for itself.
    fn cholesky(&mut self) -> usize {
        let n = self.right.len();
        let (m, x, sums) = (&mut self.matrix, &mut self.right, &mut self.sums);
        let mut lost = 0;
        for j in 0..n {
            sums.clear();
            sums.resize(n - j, 0.0);
            let (above, rest) = m.split_at_mut(j * n);
            add_rows(above, n, j, sums);
            let row = &mut rest[j..n];
            let diagonal = row[0];
            let pivot = diagonal - sums[0];
            if pivot <= Self::LOST * diagonal.abs() {
                lost += 1;
                // The direction is a combination of earlier ones. A huge pivot gives it no share.
                row.fill(0.0);
                row[0] = f64::MAX.sqrt();
                continue;
            }
            let root = pivot.sqrt();
            row[0] = root;
            for (a, sum) in row[1..].iter_mut().zip(&sums[1..]) {
                *a = (*a - sum) / root;
            }
        }
        sums.clear();
        sums.resize(n, 0.0);
        for (j, row) in m.chunks_exact(n.max(1)).enumerate() {
            x[j] = (x[j] - sums[j]) / row[j];
            sums[j + 1..].iter_mut().zip(&row[j + 1..]).for_each(|(sum, a)| *sum += a * x[j]);
        }
        for (j, row) in m.chunks_exact(n.max(1)).enumerate().rev() {
            let sum: f64 = row[j + 1..].iter().zip(&x[j + 1..]).map(|(a, b)| a * b).sum();
            x[j] = (x[j] - sum) / row[j];
        }
        lost
    }

    /// Solves by Gaussian elimination with row exchange, in place. The unknown of a column without
    /// a pivot is zero.
    fn eliminate(&mut self) -> usize {
        let n = self.right.len();
        let (m, x) = (&mut self.matrix, &mut self.right);
        self.pivots.clear();
        for j in 0..n {
            let row = self.pivots.len();
            // The pivot is compared with the largest entry of the column.
            let scale = (0..n).fold(0.0f64, |scale, i| scale.max(m[i * n + j].abs()));
            let mut best = row;
            for i in row + 1..n {
                if m[i * n + j].abs() > m[best * n + j].abs() {
                    best = i;
                }
            }
            if m[best * n + j].abs() <= Self::LOST * scale {
                continue;
            }
            if best != row {
                for k in j..n {
                    m.swap(row * n + k, best * n + k);
                }
                x.swap(row, best);
            }
            for i in row + 1..n {
                let factor = m[i * n + j] / m[row * n + j];
                if factor != 0.0 {
                    let (above, below) = m.split_at_mut(i * n);
                    let pivot = &above[row * n + j..(row + 1) * n];
                    for (a, b) in below[j..n].iter_mut().zip(pivot) {
                        *a -= factor * b;
                    }
                    x[i] -= factor * x[row];
                }
            }
            self.pivots.push(j);
        }
        // Back substitution starts at the last pivot. Each solution is stored at the index of its
        // column, which is never above its row, so no right side is overwritten before its use.
        let lost = n - self.pivots.len();
        x[self.pivots.len()..].fill(0.0);
        for (row, &j) in self.pivots.iter().enumerate().rev() {
            let sum: f64 = (j + 1..n).map(|k| m[row * n + k] * x[k]).sum();
            let solution = (x[row] - sum) / m[row * n + j];
            x[row] = 0.0;
            x[j] = solution;
        }
        lost
    }
}

/// Adds to each sum, of column `j` and the ones after it, the products of its column with column
/// `j` over the given rows of length `n`.
fn add_rows(rows: &[f64], n: usize, j: usize, sums: &mut [f64]) {
    let count = sums.len();
    let mut four = rows.chunks_exact(4 * n.max(1));
    for rows in &mut four {
        let row = |k: usize| &rows[k * n + j..][..count];
        let [a, b, c, d] = [row(0), row(1), row(2), row(3)];
        let by = [a[0], b[0], c[0], d[0]];
        for (i, sum) in sums.iter_mut().enumerate() {
            *sum = (((*sum + by[0] * a[i]) + by[1] * b[i]) + by[2] * c[i]) + by[3] * d[i];
        }
    }
    for row in four.remainder().chunks_exact(n.max(1)) {
        let row = &row[j..];
        sums.iter_mut().zip(row).for_each(|(sum, a)| *sum += row[0] * a);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn system(full: &[f64], right: &[f64], symmetric: bool) -> System {
        let mut system = System::default();
        let n = right.len();
        system.clear(n, symmetric);
        for i in 0..n {
            for j in 0..if symmetric { i + 1 } else { n } {
                system.set(i, j, full[i * n + j]);
            }
        }
        system.right().copy_from_slice(right);
        system
    }

    /// Solves the system and compares `full x` with the right side.
    fn solved(full: &[f64], right: &[f64], symmetric: bool) -> usize {
        let mut system = system(full, right, symmetric);
        let lost = system.solve();
        for (row, want) in full.chunks_exact(right.len()).zip(right) {
            let got: f64 = row.iter().zip(system.right().iter()).map(|(a, b)| a * b).sum();
            assert!((got - want).abs() < 1e-11, "{got} and {want}");
        }
        lost
    }

    #[test]
    fn both_solve_a_positive_definite_system() {
        let full = [4.0, 2.0, 0.0, 2.0, 5.0, 3.0, 0.0, 3.0, 6.0];
        for symmetric in [true, false] {
            assert_eq!(solved(&full, &[0.0, 1.0, 12.0], symmetric), 0);
        }
    }

    /// Steps of all copies of a body agree to the bit only as long as the sums keep their order.
    #[test]
    fn each_entry_of_the_factors_is_summed_in_the_order_of_the_rows() {
        for n in [1, 2, 7, 30] {
            let value = |i: usize, j: usize| ((3 * i + 5 * j) as f64).sin() / (1 + i + j) as f64;
            let entry = |i: usize, j: usize| {
                (0..n).map(|k| value(i, k) * value(j, k)).sum::<f64>() + if i == j { 1.0 } else { 0.0 }
            };
            let full: Vec<f64> = (0..n * n).map(|at| entry(at / n, at % n)).collect();
            let right: Vec<f64> = (0..n).map(|i| (i as f64).cos()).collect();
            let mut system = system(&full, &right, true);
            assert_eq!(system.solve(), 0);
            let mut l = vec![vec![0.0; n]; n];
            for i in 0..n {
                for j in 0..=i {
                    let sum: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
                    let rest = full[i * n + j] - sum;
                    l[i][j] = if i == j { rest.sqrt() } else { rest / l[j][j] };
                }
            }
            let mut x = right.clone();
            for i in 0..n {
                let sum: f64 = (0..i).map(|k| l[i][k] * x[k]).sum();
                x[i] = (x[i] - sum) / l[i][i];
            }
            for i in (0..n).rev() {
                let sum: f64 = (i + 1..n).map(|k| l[k][i] * x[k]).sum();
                x[i] = (x[i] - sum) / l[i][i];
            }
            assert_eq!(system.right().to_vec(), x, "{n} rows");
        }
    }

    #[test]
    fn elimination_solves_what_is_not_symmetric_and_needs_rows_exchanged() {
        let full = [0.0, 2.0, 1.0, 1.0, -5.0, 3.0, 4.0, 3.0, 0.5];
        assert_eq!(solved(&full, &[1.0, -2.0, 3.0], false), 0);
    }

    #[test]
    fn lost_rank_leaves_a_solution_standing() {
        // Rows 0 and 2 are equal. The solution must still satisfy both.
        let full = [4.0, 1.0, 4.0, 1.0, 3.0, 1.0, 4.0, 1.0, 4.0];
        for symmetric in [true, false] {
            assert_eq!(solved(&full, &[1.0, 2.0, 1.0], symmetric), 1);
        }
    }

    #[test]
    fn a_column_without_a_pivot_does_not_cost_an_equation() {
        // The first two unknowns only occur as their sum, and all three equations are consistent.
        let full = [1.0, 1.0, 2.0, 1.0, 1.0, 3.0, 2.0, 2.0, 5.0];
        assert_eq!(solved(&full, &[1.0, 2.0, 3.0], false), 1);
    }

    #[test]
    fn nothing_and_no_number_are_no_panic() {
        for symmetric in [true, false] {
            assert_eq!(system(&[], &[], symmetric).solve(), 0);
            let mut system = system(&[f64::NAN], &[1.0], symmetric);
            system.solve();
            assert!(!system.right()[0].is_finite());
        }
    }
}
