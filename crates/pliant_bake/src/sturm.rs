//! How many eigenvalues of `K x = lambda M x` lie below a shift: as many as `K - shift M` has
//! negative pivots (Sylvester's law of inertia). An eigensolver that has found as many has missed
//! none.
//!
//! The fronts are those of the Cholesky factorisation, and most are positive definite here as well:
//! nested dissection eliminates small parts first, held by their neighbours, whose lowest
//! eigenvalues are far above the body's. A front's diagonal block that is not goes through Bunch
//! and Kaufman's pivots of one and two columns. Rows are not moved out of their block, so pivots
//! may be small and what is subtracted large. How large is known afterwards: row i of the factors
//! has the square `A_ii + 2 (its part in negative pivots)`, and rounding moves the matrix by so
//! much times the machine's precision. [`Count::blur`] is what that means for an eigenvalue. A
//! count whose blur is too large is not used.

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

/// Sums of many terms round more than once. Counts were seen to be wrong no farther from an
/// eigenvalue than this says.
const ROUNDINGS: f64 = 32.0;

/// The eigenvalues below a shift.
#[derive(Clone, Debug)]
pub(crate) struct Count {
    pub(crate) below: usize,
    /// Squares of the factors' rows.
    squares: Vec<f64>,
}

/// A pivot is zero, or so large that it is no number: the shift is an eigenvalue of a leading part.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Singular;

/// What the fronts have found.
#[derive(Debug, Default)]
struct Tally {
    negative: usize,
    /// Row, and twice its square in negative pivots.
    grown: Vec<(usize, f64)>,
}

impl Count {
    pub(crate) fn new(symbolic: &Symbolic, matrix: &BlockCsr, shift: f64) -> Result<Self, Singular> {
        let mut updates: Vec<Vec<f64>> = vec![Vec::new(); symbolic.supernodes.len()];
        let tops: Result<Vec<(usize, Vec<f64>, Tally)>, Singular> = symbolic
            .tasks
            .par_iter()
            .map(|task| {
                let mut local: Vec<Vec<f64>> = vec![Vec::new(); task.len()];
                let (mut spare, mut tally) = (Vec::new(), Tally::default());
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
        let (mut spare, mut tally) = (Vec::new(), Tally::default());
        for &s in &symbolic.top {
            let take = |child: usize| std::mem::take(&mut updates[child]);
            let update = front(symbolic, s, matrix, shift, take, &mut spare, &mut tally)?;
            updates[s] = update;
        }
        out.add(tally);
        Ok(out)
    }

    fn add(&mut self, tally: Tally) {
        self.below += tally.negative;
        for (row, square) in tally.grown {
            self.squares[row] += square;
        }
    }

    /// How far, as a share of `shift`, rounding may have moved the eigenvalues: to first order by
    /// `phi^T E phi` of an M-normalised mode, and the entries of E are `sqrt(squares_i squares_j)`
    /// times the precision. `modes` are `width` of them; the largest counts.
    pub(crate) fn blur(&self, modes: &[f64], width: usize, shift: f64) -> f64 {
        let mut sums = vec![0.0; width];
        for (row, square) in modes.chunks_exact(width).zip(&self.squares) {
            for (sum, x) in sums.iter_mut().zip(row) {
                *sum += square * x * x;
            }
        }
        // NaN stays.
        let largest = sums.into_iter().fold(0.0, |a: f64, b| if a > b { a } else { b });
        ROUNDINGS * f64::EPSILON * largest / shift
    }
}

/// The diagonal of K and that of `shift M`, added.
fn diagonal(matrix: &BlockCsr, shift: f64) -> Vec<f64> {
    let mut out = Vec::with_capacity(matrix.dofs());
    for node in 0..matrix.nodes() {
        let at = matrix.position(node as u32, node as u32);
        let mass = shift * matrix.mass[at];
        out.extend([0, 4, 8].map(|entry| matrix.stiffness[9 * at + entry].abs() + mass.abs()));
    }
    out
}

/// Assembles and eliminates one front; returns the update matrix for its parent.
fn front(
    symbolic: &Symbolic,
    s: usize,
    matrix: &BlockCsr,
    shift: f64,
    mut take: impl FnMut(usize) -> Vec<f64>,
    spare: &mut Vec<Vec<f64>>,
    tally: &mut Tally,
) -> Result<Vec<f64>, Singular> {
    let supernode = &symbolic.supernodes[s];
    let children = supernode.children.iter().map(|&child| (child, take(child))).collect();
    let mut block = vec![0.0; supernode.values()];
    let mut update = assemble_front(symbolic, s, &mut block, matrix, shift, &[], children, spare);
    eliminate(supernode, &mut block, &mut update, tally)?;
    Ok(if supernode.parent == ROOT { Vec::new() } else { update })
}

/// As `factor_front`, with columns of `L |D|^1/2` in place of those of L, and the signs of D in the
/// products.
fn eliminate(
    supernode: &Supernode,
    block: &mut [f64],
    update: &mut [f64],
    tally: &mut Tally,
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
        // Columns of this front still to come.
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

/// The row of the matrix that a front's row stands for.
fn row_of(supernode: &Supernode, local: usize) -> usize {
    match local.checked_sub(supernode.width()) {
        None => 3 * supernode.first + local,
        Some(below) => 3 * supernode.rows[below / 3] as usize + below % 3,
    }
}

/// The columns, those of negative pivots with their sign; `None` if there are none.
fn signed(columns: MatRef<'_, f64>, negative: &[bool]) -> Option<Mat<f64>> {
    negative.contains(&true).then(|| {
        Mat::from_fn(columns.nrows(), columns.ncols(), |i, j| {
            if negative[j] { -columns[(i, j)] } else { columns[(i, j)] }
        })
    })
}

/// The pivots of a diagonal block: `P A P^T = L D L^T` with `D = Q |D|^1/2 sign(D) |D|^1/2 Q^T`.
struct Pivots {
    /// Row i of the permuted block is row `permutation[i]` of the block.
    permutation: Vec<usize>,
    /// Of the first column of each pivot: does the next one belong to it, and cosine and sine of
    /// its Q?
    turn: Vec<Option<(f64, f64)>>,
    /// Eigenvalues of D.
    values: Vec<f64>,
}

impl Pivots {
    /// Leaves L in the block.
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
            // The larger eigenvalue by its size first, the other from the determinant: no digits
            // are lost.
            let d = block[(j + 1, j + 1)];
            let (middle, half) = (0.5 * (a + d), 0.5 * (a - d));
            let radius = half.hypot(b);
            let far = if middle < 0.0 { middle - radius } else { middle + radius };
            let near = (a * d - b * b) / far;
            let angle = 0.5 * b.atan2(half);
            turn[j] = Some((angle.cos(), angle.sin()));
            // The turned first column belongs to the upper eigenvalue.
            values.extend(if middle < 0.0 { [near, far] } else { [far, near] });
        }
        let sound = values.iter().all(|&value| value != 0.0 && value.is_finite());
        if sound { Ok(Self { permutation, turn, values }) } else { Err(Singular) }
    }

    /// Columns of negative eigenvalues.
    fn negative(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.values.len()).filter(|&j| self.values[j] < 0.0)
    }

    /// Turns a row of two columns of each wide pivot.
    fn turned(&self, row: &mut [f64]) {
        for (j, turn) in self.turn.iter().enumerate() {
            if let Some((cos, sin)) = turn {
                let (x, y) = (row[j], row[j + 1]);
                row[j] = cos * x + sin * y;
                row[j + 1] = cos * y - sin * x;
            }
        }
    }

    /// `rows := rows P^T L^-T Q |D|^-1/2`, columns of `L |D|^1/2` below the block.
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

    /// Twice the square of each of the block's own rows in negative pivots.
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
