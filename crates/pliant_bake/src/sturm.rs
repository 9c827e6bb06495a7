//! Counts the eigenvalues of `K x = lambda M x` below a shift.
//!
//! Their number is the number of negative pivots of `K - shift M` (Sylvester's law of inertia). An
//! eigensolver that has found as many has missed none.
//!
//! The fronts are those of the Cholesky factorization, and most are positive definite here as well:
//! nested dissection first eliminates small parts that their neighbors hold and whose lowest
//! eigenvalues are far above those of the body. A diagonal block that is not positive definite is
//! factored with the Bunch-Kaufman pivots of one and two columns. Rows stay in their block, so
//! pivots may be small and the subtracted terms large.
//!
//! The size of these terms is known afterwards. Row i of the factors has the square
//! `A_ii + 2 (its part in negative pivots)`, and rounding changes the matrix by this square times
//! the machine precision. [`Count::blur`] is the resulting error of an eigenvalue. A count whose
//! blur is too large is not used.

use faer::diag::Diag;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::{lblt::factor as dense_lblt, llt::factor as dense_llt};
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_unit_lower_triangular_in_place};
use faer::prelude::{IntoConst, ReborrowMut};
use faer::{Mat, MatMut, MatRef, Par};
use rayon::prelude::*;

use crate::factor::{STRIP, assemble_front, subtract_product};
use crate::sparse::BlockCsr;
use crate::symbolic::{ROOT, Supernode, Symbolic};

/// Factor for the several rounding errors in sums of many terms.
///
/// Wrong counts were not observed farther from an eigenvalue than this factor allows.
const ROUNDINGS: f64 = 32.0;

/// Number of eigenvalues below a shift, with the data for its error estimate.
#[derive(Clone, Debug)]
pub(crate) struct Count {
    pub(crate) below: usize,
    /// Squares of the rows of the factors.
    squares: Vec<f64>,
}

/// Error for a pivot that is zero or not finite: the shift is an eigenvalue of a leading part.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Singular;

/// Sums that the fronts accumulate.
#[derive(Debug, Default)]
struct InertiaTally {
    negative: usize,
    /// Row and twice the square of its part in negative pivots.
    grown: Vec<(usize, f64)>,
}

impl Count {
    pub(crate) fn new(symbolic: &Symbolic, matrix: &BlockCsr, shift: f64) -> Result<Self, Singular> {
        let mut updates: Vec<Vec<f64>> = vec![Vec::new(); symbolic.supernodes.len()];
        let tops: Result<Vec<(usize, Vec<f64>, InertiaTally)>, Singular> = symbolic
            .tasks
            .par_iter()
            .map(|task| {
                let mut local: Vec<Vec<f64>> = vec![Vec::new(); task.len()];
                let (mut spare, mut tally) = (Vec::new(), InertiaTally::default());
                for s in task.clone() {
                    let take = |child: usize| std::mem::take(&mut local[child - task.start]);
                    let update = front(symbolic, s, matrix, shift, take, &mut spare, &mut tally)?;
                    local[s - task.start] = update;
                }
                Ok((task.end - 1, local.pop().unwrap_or_default(), tally))
            })
            .collect();
        let mut out = Self { below: 0, squares: diagonal(matrix, shift) };
        for (root, update, tally) in tops? {
            updates[root] = update;
            out.add(tally);
        }
        let (mut spare, mut tally) = (Vec::new(), InertiaTally::default());
        for &s in &symbolic.top {
            let take = |child: usize| std::mem::take(&mut updates[child]);
            let update = front(symbolic, s, matrix, shift, take, &mut spare, &mut tally)?;
            updates[s] = update;
        }
        out.add(tally);
        Ok(out)
    }

    fn add(&mut self, tally: InertiaTally) {
        self.below += tally.negative;
        for (row, square) in tally.grown {
            self.squares[row] += square;
        }
    }

    /// Returns how far rounding may have moved the eigenvalues, as a fraction of `shift`.
    ///
    /// To first order an eigenvalue moves by `phi^T E phi` of an M-normalized mode. The entries of
    /// E are `sqrt(squares_i squares_j)` times the precision. `modes` holds `width` modes, and the
    /// largest value counts.
    pub(crate) fn blur(&self, modes: &[f64], width: usize, shift: f64) -> f64 {
        let mut sums = vec![0.0; width];
        for (row, square) in modes.chunks_exact(width).zip(&self.squares) {
            for (sum, x) in sums.iter_mut().zip(row) {
                *sum += square * x * x;
            }
        }
        // This fold keeps a NaN.
        let largest = sums.into_iter().fold(0.0, |a: f64, b| if a > b { a } else { b });
        ROUNDINGS * f64::EPSILON * largest / shift
    }
}

/// Returns the sum of the absolute diagonals of K and `shift M`.
fn diagonal(matrix: &BlockCsr, shift: f64) -> Vec<f64> {
    let mut out = Vec::with_capacity(matrix.dofs());
    for node in 0..matrix.nodes() {
        let at = matrix.position(node as u32, node as u32);
        let mass = shift * matrix.mass[at];
        out.extend([0, 4, 8].map(|entry| matrix.stiffness[9 * at + entry].abs() + mass.abs()));
    }
    out
}

/// Assembles and eliminates one front. Returns the update matrix for the parent.
fn front(
    symbolic: &Symbolic,
    s: usize,
    matrix: &BlockCsr,
    shift: f64,
    mut take: impl FnMut(usize) -> Vec<f64>,
    spare: &mut Vec<Vec<f64>>,
    tally: &mut InertiaTally,
) -> Result<Vec<f64>, Singular> {
    let supernode = &symbolic.supernodes[s];
    let children = supernode.children.iter().map(|&child| (child, take(child))).collect();
    let mut block = vec![0.0; supernode.values()];
    let mut update = assemble_front(symbolic, s, &mut block, matrix, shift, &[], children, spare);
    eliminate(supernode, &mut block, &mut update, tally)?;
    Ok(if supernode.parent == ROOT { Vec::new() } else { update })
}

/// Eliminates a front as `factor_front` does, with columns of `L |D|^1/2` in place of those of L.
///
/// The products include the signs of D.
fn eliminate(
    supernode: &Supernode,
    block: &mut [f64],
    update: &mut [f64],
    tally: &mut InertiaTally,
) -> Result<(), Singular> {
    let (width, below) = (supernode.width(), supernode.below());
    let height = width + below;
    let mut negative = vec![false; width];
    for start in (0..width).step_by(STRIP) {
        let end = (start + STRIP).min(width);
        let size = end - start;
        let (panel, rest) = block[start * height..].split_at_mut(size * height);
        let panel_matrix = MatMut::from_column_major_slice_mut(panel, height, size);
        let (_, lower) = panel_matrix.split_at_row_mut(start);
        let (mut diagonal, mut under) = lower.split_at_row_mut(size);
        let rows = under.nrows();
        let kept = diagonal.to_owned();
        let mut buffer =
            MemBuffer::new(dense_llt::cholesky_in_place_scratch::<f64>(size, Par::Seq, Default::default()));
        let positive = dense_llt::cholesky_in_place(
            diagonal.rb_mut(),
            Default::default(),
            Par::Seq,
            MemStack::new(&mut buffer),
            Default::default(),
        );
        if positive.is_ok() {
            let triangle = diagonal.into_const();
            under.rb_mut().par_row_chunks_mut(2 * STRIP).for_each(|chunk| {
                solve_lower_triangular_in_place(triangle, chunk.transpose_mut(), Par::Seq);
            });
        } else {
            diagonal.copy_from(&kept);
            let pivots = Pivots::new(diagonal.rb_mut())?;
            let triangle = diagonal.into_const();
            under.rb_mut().par_row_chunks_mut(2 * STRIP).for_each(|chunk| pivots.apply(triangle, chunk));
            let own = pivots.squares(triangle).into_iter().enumerate();
            tally.grown.extend(own.map(|(i, square)| (row_of(supernode, start + i), square)));
            for i in 0..rows {
                let square = pivots.negative().map(|j| under[(i, j)] * under[(i, j)]).sum::<f64>();
                tally.grown.push((row_of(supernode, end + i), 2.0 * square));
            }
            for j in pivots.negative() {
                negative[start + j] = true;
                tally.negative += 1;
            }
        }
        if rows == 0 {
            continue;
        }
        let under = under.into_const();
        let signed = signed(under, &negative[start..end]);
        let right = signed.as_ref().map_or(under, |signed| signed.as_ref());
        // These are the columns of this front that are not eliminated yet.
        rest[..(width - end) * height].par_chunks_mut(STRIP * height).enumerate().for_each(
            |(index, strip)| {
                let first = index * STRIP;
                let columns = strip.len() / height;
                let strip = MatMut::from_column_major_slice_mut(strip, height, columns);
                subtract_product(
                    strip.split_at_row_mut(end + first).1,
                    under.subrows(first, rows - first),
                    right.subrows(first, columns),
                );
            },
        );
    }
    if below > 0 {
        let bottom = MatRef::from_column_major_slice(&*block, height, width).subrows(width, below);
        let signed = signed(bottom, &negative);
        let right = signed.as_ref().map_or(bottom, |signed| signed.as_ref());
        update.par_chunks_mut(STRIP * below).enumerate().for_each(|(index, strip)| {
            let first = index * STRIP;
            let columns = strip.len() / below;
            let strip = MatMut::from_column_major_slice_mut(strip, below, columns);
            subtract_product(
                strip.split_at_row_mut(first).1,
                bottom.subrows(first, below - first),
                right.subrows(first, columns),
            );
        });
    }
    Ok(())
}

/// Returns the matrix row of a front's row.
fn row_of(supernode: &Supernode, local: usize) -> usize {
    match local.checked_sub(supernode.width()) {
        None => 3 * supernode.first + local,
        Some(below) => 3 * supernode.rows[below / 3] as usize + below % 3,
    }
}

/// Returns the columns with those of negative pivots negated, or `None` if no pivot is negative.
fn signed(columns: MatRef<'_, f64>, negative: &[bool]) -> Option<Mat<f64>> {
    negative.contains(&true).then(|| {
        Mat::from_fn(columns.nrows(), columns.ncols(), |i, j| {
            if negative[j] { -columns[(i, j)] } else { columns[(i, j)] }
        })
    })
}

/// Pivots of a diagonal block: `P A P^T = L D L^T` with `D = Q |D|^1/2 sign(D) |D|^1/2 Q^T`.
struct Pivots {
    /// Permutation of the rows. Row i of the permuted block is row `permutation[i]` of the block.
    permutation: Vec<usize>,
    /// Cosine and sine of Q for the first column of each two-column pivot, and `None` for all other
    /// columns.
    turn: Vec<Option<(f64, f64)>>,
    /// Eigenvalues of D.
    values: Vec<f64>,
}

impl Pivots {
    /// Factors the block and leaves L in it.
    fn new(mut block: MatMut<'_, f64>) -> Result<Self, Singular> {
        let n = block.nrows();
        let mut subdiagonal = Diag::<f64>::zeros(n);
        let (mut permutation, mut inverse) = (vec![0usize; n], vec![0usize; n]);
        let scratch = dense_lblt::cholesky_in_place_scratch::<usize, f64>(n, Par::Seq, Default::default());
        let mut buffer = MemBuffer::new(scratch);
        dense_lblt::cholesky_in_place(
            block.rb_mut(),
            subdiagonal.as_mut(),
            &mut permutation,
            &mut inverse,
            Par::Seq,
            MemStack::new(&mut buffer),
            Default::default(),
        );
        let (mut turn, mut values) = (vec![None; n], Vec::with_capacity(n));
        while values.len() < n {
            let j = values.len();
            let (a, b) = (block[(j, j)], subdiagonal[j]);
            if b == 0.0 {
                values.push(a);
                continue;
            }
            // The eigenvalue of larger magnitude comes first and the other follows from the
            // determinant, so that no digits are lost.
            let d = block[(j + 1, j + 1)];
            let (middle, half) = (0.5 * (a + d), 0.5 * (a - d));
            let radius = half.hypot(b);
            let far = if middle < 0.0 { middle - radius } else { middle + radius };
            let near = (a * d - b * b) / far;
            let angle = 0.5 * b.atan2(half);
            turn[j] = Some((angle.cos(), angle.sin()));
            // The rotated first column belongs to the upper eigenvalue.
            values.extend(if middle < 0.0 { [near, far] } else { [far, near] });
        }
        let sound = values.iter().all(|&value| value != 0.0 && value.is_finite());
        if sound { Ok(Self { permutation, turn, values }) } else { Err(Singular) }
    }

    /// Returns the columns of negative eigenvalues.
    fn negative(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.values.len()).filter(|&j| self.values[j] < 0.0)
    }

    /// Rotates the two columns of each two-column pivot in a row.
    fn turned(&self, row: &mut [f64]) {
        for (j, turn) in self.turn.iter().enumerate() {
            if let Some((cos, sin)) = turn {
                let (x, y) = (row[j], row[j + 1]);
                row[j] = cos * x + sin * y;
                row[j + 1] = cos * y - sin * x;
            }
        }
    }

    /// Computes `rows := rows P^T L^-T Q |D|^-1/2`, the columns of `L |D|^1/2` below the block.
    fn apply(&self, triangle: MatRef<'_, f64>, mut rows: MatMut<'_, f64>) {
        let n = self.values.len();
        let mut work = Mat::from_fn(rows.nrows(), n, |i, j| rows[(i, self.permutation[j])]);
        solve_unit_lower_triangular_in_place(triangle, work.as_mut().transpose_mut(), Par::Seq);
        let mut row = vec![0.0; n];
        for i in 0..rows.nrows() {
            row.iter_mut().enumerate().for_each(|(j, x)| *x = work[(i, j)]);
            self.turned(&mut row);
            for (j, (x, value)) in row.iter().zip(&self.values).enumerate() {
                rows[(i, j)] = x / value.abs().sqrt();
            }
        }
    }

    /// Returns twice the square of the part in negative pivots for each of the block's own rows.
    fn squares(&self, triangle: MatRef<'_, f64>) -> Vec<f64> {
        let n = self.values.len();
        let mut out = vec![0.0; n];
        let mut row = vec![0.0; n];
        for i in 0..n {
            row.fill(0.0);
            (0..i).for_each(|j| row[j] = triangle[(i, j)]);
            row[i] = 1.0;
            self.turned(&mut row);
            let square: f64 = self.negative().map(|j| row[j] * row[j] * self.values[j].abs()).sum();
            out[self.permutation[i]] = 2.0 * square;
        }
        out
    }
}

#[cfg(test)]
#[path = "sturm_tests.rs"]
mod tests;
