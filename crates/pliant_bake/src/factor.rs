//! Sparse Cholesky factorization by the multifrontal method (Duff and Reid 1983). faer's kernels do
//! the dense work.
//!
//! The subtrees of the elimination tree are factored in parallel. The fronts above them are split
//! into strips. Every number is computed by the same operations in the same order for any number of
//! threads, so the results are equal to the bit.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor as dense_llt;
use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::prelude::{IntoConst, Reborrow, ReborrowMut};
use faer::{Accum, Mat, MatMut, MatRef, Par};
use rayon::prelude::*;

use crate::sparse::BlockCsr;
use crate::symbolic::{ROOT, Supernode, Symbolic};

/// Number of columns per strip and per panel of dense work.
pub(crate) const STRIP: usize = 128;

/// Number of rows per strip of a tall product.
const TALL_STRIP: usize = 512;

/// Cholesky factor `A = L L^T` of a symmetric positive definite `A` in elimination order.
#[derive(Clone, Debug)]
pub(crate) struct Factor {
    pub(crate) symbolic: Symbolic,
    pub(crate) values: Vec<f64>,
}

/// Error for a pivot that is not positive, with its node in elimination order.
#[derive(Clone, Copy, Debug)]
pub(crate) struct NotPositive {
    pub(crate) node: usize,
}

impl Factor {
    /// Factors the stiffness of `matrix` with `springs` (dof, N/m) added to its diagonal.
    pub(crate) fn new(
        symbolic: Symbolic,
        matrix: &BlockCsr,
        springs: &[(usize, f64)],
    ) -> Result<Self, NotPositive> {
        let mut values = vec![0.0; symbolic.values];
        let mut updates: Vec<Vec<f64>> = vec![Vec::new(); symbolic.supernodes.len()];
        // Each task owns the values of its supernodes, which are contiguous.
        let mut slices = Vec::with_capacity(symbolic.tasks.len());
        let mut rest: &mut [f64] = &mut values;
        let mut offset = 0;
        for task in &symbolic.tasks {
            let (start, end) = value_range(&symbolic, task);
            let (_, tail) = std::mem::take(&mut rest).split_at_mut(start - offset);
            let (own, tail) = tail.split_at_mut(end - start);
            slices.push((task.clone(), start, own));
            rest = tail;
            offset = end;
        }
        let tops: Result<Vec<(usize, Vec<f64>)>, NotPositive> = slices
            .into_par_iter()
            .map(|(task, start, own)| {
                let mut local: Vec<Vec<f64>> = vec![Vec::new(); task.len()];
                let mut spare = Vec::new();
                for s in task.clone() {
                    let supernode = &symbolic.supernodes[s];
                    let children: Vec<(usize, Vec<f64>)> = supernode
                        .children
                        .iter()
                        .map(|&child| (child, std::mem::take(&mut local[child - task.start])))
                        .collect();
                    let at = supernode.at - start;
                    let block = &mut own[at..at + supernode.values()];
                    local[s - task.start] =
                        front(&symbolic, s, block, matrix, springs, children, &mut spare)?;
                }
                Ok((task.end - 1, local.pop().unwrap_or_default()))
            })
            .collect();
        for (root, update) in tops? {
            updates[root] = update;
        }
        let mut spare = Vec::new();
        for &s in &symbolic.top {
            let supernode = &symbolic.supernodes[s];
            let children: Vec<(usize, Vec<f64>)> = supernode
                .children
                .iter()
                .map(|&child| (child, std::mem::take(&mut updates[child])))
                .collect();
            let block = &mut values[supernode.at..supernode.at + supernode.values()];
            updates[s] = front(&symbolic, s, block, matrix, springs, children, &mut spare)?;
        }
        Ok(Self { symbolic, values })
    }

    pub(crate) fn block(&self, s: &Supernode) -> MatRef<'_, f64> {
        let values = &self.values[s.at..s.at + s.values()];
        MatRef::from_column_major_slice(values, s.width() + s.below(), s.width())
    }

    /// Computes `x := A^-1 x` for a block of `width` vectors stored row by row.
    pub(crate) fn solve(&self, x: &mut [f64], width: usize) {
        self.forward(x, width);
        self.backward(x, width);
    }

    /// Computes `x := L^-1 x`.
    pub(crate) fn forward(&self, x: &mut [f64], width: usize) {
        let outsides: Vec<(usize, Vec<f64>)> = self
            .task_slices(x, width)
            .into_par_iter()
            .map(|(task, first, own)| {
                let root = task.end - 1;
                let mut outside = vec![0.0; self.symbolic.supernodes[root].below() * width];
                let mut scratch = Vec::new();
                for s in &self.symbolic.supernodes[task] {
                    let at = 3 * (s.first - first) * width;
                    let top = &mut own[at..at + s.width() * width];
                    // A load on a few nodes leaves most subtrees at zero.
                    if top.iter().all(|&x| x == 0.0) {
                        continue;
                    }
                    scratch.resize(s.below() * width, 0.0);
                    self.forward_front(s, top, &mut scratch, width);
                    for (index, &row) in s.rows[..s.inside].iter().enumerate() {
                        add_from_columns(own, row as usize - first, &scratch, index, s.below(), width);
                    }
                    for (index, &place) in s.outside.iter().enumerate() {
                        add_from_columns(
                            &mut outside,
                            place as usize,
                            &scratch,
                            s.inside + index,
                            s.below(),
                            width,
                        );
                    }
                }
                (root, outside)
            })
            .collect();
        for (root, outside) in outsides {
            for (index, &row) in self.symbolic.supernodes[root].rows.iter().enumerate() {
                add_rows(x, row as usize, &outside, index, width);
            }
        }
        let mut scratch = Vec::new();
        for &s in &self.symbolic.top {
            let s = &self.symbolic.supernodes[s];
            scratch.resize(s.below() * width, 0.0);
            let at = 3 * s.first * width;
            self.forward_front(s, &mut x[at..at + s.width() * width], &mut scratch, width);
            for (index, &row) in s.rows.iter().enumerate() {
                add_from_columns(x, row as usize, &scratch, index, s.below(), width);
            }
        }
    }

    /// Computes `x := L^-T x`.
    pub(crate) fn backward(&self, x: &mut [f64], width: usize) {
        let mut scratch = Vec::new();
        for &s in self.symbolic.top.iter().rev() {
            let s = &self.symbolic.supernodes[s];
            scratch.resize(s.below() * width, 0.0);
            for (index, &row) in s.rows.iter().enumerate() {
                copy_rows(&mut scratch, index, x, row as usize, width);
            }
            let at = 3 * s.first * width;
            self.backward_front(s, &mut x[at..at + s.width() * width], &scratch, width);
        }
        let outsides: Vec<Vec<f64>> = self
            .symbolic
            .tasks
            .iter()
            .map(|task| {
                let root = &self.symbolic.supernodes[task.end - 1];
                let mut outside = vec![0.0; root.below() * width];
                for (index, &row) in root.rows.iter().enumerate() {
                    copy_rows(&mut outside, index, x, row as usize, width);
                }
                outside
            })
            .collect();
        self.task_slices(x, width).into_par_iter().zip(outsides).for_each(|((task, first, own), outside)| {
            let mut scratch = Vec::new();
            for s in self.symbolic.supernodes[task].iter().rev() {
                scratch.resize(s.below() * width, 0.0);
                for (index, &row) in s.rows[..s.inside].iter().enumerate() {
                    copy_rows(&mut scratch, index, own, row as usize - first, width);
                }
                for (index, &place) in s.outside.iter().enumerate() {
                    copy_rows(&mut scratch, s.inside + index, &outside, place as usize, width);
                }
                let at = 3 * (s.first - first) * width;
                self.backward_front(s, &mut own[at..at + s.width() * width], &scratch, width);
            }
        });
    }

    /// Returns the part of `x` that each task owns, with the first node of that part.
    fn task_slices<'x>(&self, x: &'x mut [f64], width: usize) -> Vec<TaskSlice<'x>> {
        let mut out = Vec::with_capacity(self.symbolic.tasks.len());
        let mut rest = x;
        let mut offset = 0;
        for task in &self.symbolic.tasks {
            let first = self.symbolic.supernodes[task.start].first;
            let last = &self.symbolic.supernodes[task.end - 1];
            let end = last.first + last.columns;
            let (_, tail) = std::mem::take(&mut rest).split_at_mut(3 * (first - offset) * width);
            let (own, tail) = tail.split_at_mut(3 * (end - first) * width);
            out.push((task.clone(), first, own));
            rest = tail;
            offset = end;
        }
        out
    }

    /// Solves with the front's triangle and stores the negative product of the remaining rows in
    /// `below`.
    ///
    /// `below` is stored column by column, because dense products are fastest in this layout.
    fn forward_front(&self, s: &Supernode, top: &mut [f64], below: &mut [f64], width: usize) {
        let block = self.block(s);
        let columns = s.width();
        let mut solved = Mat::zeros(STRIP.min(columns), width);
        for start in (0..columns).step_by(STRIP) {
            let size = STRIP.min(columns - start);
            let end = start + size;
            let (head, rest) = top[start * width..].split_at_mut(size * width);
            let panel = block.subcols(start, size);
            let mut head = MatMut::from_row_major_slice_mut(head, size, width);
            let mut solved = solved.as_mut().subrows_mut(0, size);
            solved.copy_from(head.rb());
            solve_lower_triangular_in_place(panel.subrows(start, size), solved.rb_mut(), Par::Seq);
            head.copy_from(solved.rb());
            let solved = solved.into_const();
            if !rest.is_empty() {
                strips(rest, width).for_each(|(index, out)| {
                    let rows = out.len() / width;
                    let panel = panel.subrows(end + index * STRIP, rows);
                    let out = MatMut::from_row_major_slice_mut(out, rows, width);
                    matmul(out, Accum::Add, panel, solved, -1.0, Par::Seq);
                });
            }
            let accum = if start == 0 { Accum::Replace } else { Accum::Add };
            if !below.is_empty() {
                let out = MatMut::from_column_major_slice_mut(below, s.below(), width);
                out.par_row_chunks_mut(TALL_STRIP).enumerate().for_each(|(index, out)| {
                    let panel = panel.subrows(columns + index * TALL_STRIP, out.nrows());
                    matmul(out, accum, panel, solved, -1.0, Par::Seq);
                });
            }
        }
    }

    /// Subtracts the product with the rows below and solves with the front's transposed triangle.
    fn backward_front(&self, s: &Supernode, top: &mut [f64], below: &[f64], width: usize) {
        let block = self.block(s);
        let columns = s.width();
        if !below.is_empty() {
            let below = MatRef::from_row_major_slice(below, s.below(), width);
            strips(top, width).for_each(|(index, out)| {
                let rows = out.len() / width;
                let panel = block.subcols(index * STRIP, rows).subrows(columns, s.below());
                let out = MatMut::from_row_major_slice_mut(out, rows, width);
                matmul(out, Accum::Add, panel.transpose(), below, -1.0, Par::Seq);
            });
        }
        for start in (0..columns).step_by(STRIP).rev() {
            let end = (start + STRIP).min(columns);
            let (head, solved) = top[..end * width].split_at_mut(start * width);
            let triangle = block.subrows(start, end - start);
            let mut solved = MatMut::from_row_major_slice_mut(solved, end - start, width);
            faer::linalg::triangular_solve::solve_upper_triangular_in_place(
                triangle.subcols(start, end - start).transpose(),
                solved.rb_mut(),
                Par::Seq,
            );
            let solved = solved.into_const();
            if !head.is_empty() {
                strips(head, width).for_each(|(index, out)| {
                    let rows = out.len() / width;
                    let panel = triangle.subcols(index * STRIP, rows);
                    let out = MatMut::from_row_major_slice_mut(out, rows, width);
                    matmul(out, Accum::Add, panel.transpose(), solved, -1.0, Par::Seq);
                });
            }
        }
    }
}

type TaskSlice<'x> = (std::ops::Range<usize>, usize, &'x mut [f64]);

/// Splits a block of vectors into numbered strips of `STRIP` rows.
fn strips(x: &mut [f64], width: usize) -> impl IndexedParallelIterator<Item = (usize, &mut [f64])> {
    x.par_chunks_mut(STRIP * width).enumerate()
}

fn add_rows(to: &mut [f64], node: usize, from: &[f64], from_node: usize, width: usize) {
    let to = &mut to[3 * node * width..][..3 * width];
    for (to, from) in to.iter_mut().zip(&from[3 * from_node * width..]) {
        *to += from;
    }
}

/// Adds rows as [`add_rows`] does, from a block of `height` rows stored column by column.
fn add_from_columns(
    to: &mut [f64],
    node: usize,
    from: &[f64],
    from_node: usize,
    height: usize,
    width: usize,
) {
    let to = &mut to[3 * node * width..][..3 * width];
    for column in 0..width {
        let from = &from[column * height + 3 * from_node..][..3];
        to[column] += from[0];
        to[width + column] += from[1];
        to[2 * width + column] += from[2];
    }
}

fn copy_rows(to: &mut [f64], node: usize, from: &[f64], from_node: usize, width: usize) {
    to[3 * node * width..][..3 * width].copy_from_slice(&from[3 * from_node * width..][..3 * width]);
}

fn value_range(symbolic: &Symbolic, task: &std::ops::Range<usize>) -> (usize, usize) {
    let last = &symbolic.supernodes[task.end - 1];
    (symbolic.supernodes[task.start].at, last.at + last.values())
}

/// Assembles and factors one front. Returns the update matrix for the parent (column-major, lower
/// triangle).
///
/// `spare` keeps the memory of used update matrices for reuse.
fn front(
    symbolic: &Symbolic,
    s: usize,
    block: &mut [f64],
    matrix: &BlockCsr,
    springs: &[(usize, f64)],
    children: Vec<(usize, Vec<f64>)>,
    spare: &mut Vec<Vec<f64>>,
) -> Result<Vec<f64>, NotPositive> {
    let supernode = &symbolic.supernodes[s];
    let mut update = assemble_front(symbolic, s, block, matrix, 0.0, springs, children, spare);
    factor_front(block, &mut update, supernode.width(), supernode.below())
        .map_err(|dof| NotPositive { node: supernode.first + dof / 3 })?;
    Ok(if supernode.parent == ROOT { Vec::new() } else { update })
}

/// Assembles one front of `K - shift M` with the updates of its children.
///
/// Writes the eliminated columns into `block` and returns the update matrix.
pub(crate) fn assemble_front(
    symbolic: &Symbolic,
    s: usize,
    block: &mut [f64],
    matrix: &BlockCsr,
    shift: f64,
    springs: &[(usize, f64)],
    children: Vec<(usize, Vec<f64>)>,
    spare: &mut Vec<Vec<f64>>,
) -> Vec<f64> {
    let supernode = &symbolic.supernodes[s];
    let (width, below) = (supernode.width(), supernode.below());
    let height = width + below;
    let end = supernode.first + supernode.columns;
    // The original entries are the lower triangle of the columns that this front eliminates.
    for node in supernode.first..end {
        let column = 3 * (node - supernode.first);
        let mut place = 0;
        for at in matrix.offsets[node]..matrix.offsets[node + 1] {
            let other = matrix.columns[at] as usize;
            if other < node {
                continue;
            }
            let row = if other < end {
                3 * (other - supernode.first)
            } else {
                while (supernode.rows[place] as usize) < other {
                    place += 1;
                }
                width + 3 * place
            };
            // The stored block couples (node, other), so its transpose belongs at (other, node).
            let k = &matrix.stiffness[9 * at..][..9];
            for l in 0..3 {
                for m in 0..3 {
                    block[(column + l) * height + row + m] += k[3 * l + m];
                }
            }
            if shift != 0.0 {
                let mass = shift * matrix.mass[at];
                for l in 0..3 {
                    block[(column + l) * height + row + l] -= mass;
                }
            }
        }
    }
    for &(dof, spring) in springs {
        if (3 * supernode.first..3 * end).contains(&dof) {
            let local = dof - 3 * supernode.first;
            block[local * height + local] += spring;
        }
    }
    let mut update = spare.pop().unwrap_or_default();
    update.clear();
    update.resize(below * below, 0.0);
    for (child, child_update) in children {
        extend_add(supernode, &symbolic.supernodes[child], &child_update, block, &mut update);
        spare.push(child_update);
    }
    // The next front takes the buffer with the largest capacity first.
    spare.sort_by_key(Vec::capacity);
    update
}

/// Adds a child's update matrix to its parent's front.
fn extend_add(parent: &Supernode, child: &Supernode, from: &[f64], block: &mut [f64], update: &mut [f64]) {
    let (width, below) = (parent.width(), parent.below());
    let height = width + below;
    let end = parent.first + parent.columns;
    let mut place = 0;
    let places: Vec<usize> = child
        .rows
        .iter()
        .map(|&row| {
            if (row as usize) < end {
                3 * (row as usize - parent.first)
            } else {
                while parent.rows[place] < row {
                    place += 1;
                }
                width + 3 * place
            }
        })
        .collect();
    let size = child.below();
    for (j, &column) in places.iter().enumerate() {
        for l in 0..3 {
            let source = &from[(3 * j + l) * size..][..size];
            let target = if column < width {
                &mut block[(column + l) * height..][..height]
            } else {
                &mut update[(column - width + l) * below..][..below]
            };
            let shift = if column < width { 0 } else { width };
            for (i, &row) in places.iter().enumerate().skip(j) {
                let to = &mut target[row - shift..][..3];
                let from = &source[3 * i..][..3];
                to[0] += from[0];
                to[1] += from[1];
                to[2] += from[2];
            }
        }
    }
}

/// Computes the dense partial factorization of `width` columns of height `width + below` and the
/// update `-= L21 L21^T`.
///
/// On failure returns the local column.
fn factor_front(block: &mut [f64], update: &mut [f64], width: usize, below: usize) -> Result<(), usize> {
    let height = width + below;
    for start in (0..width).step_by(STRIP) {
        let end = (start + STRIP).min(width);
        let size = end - start;
        let (panel, rest) = block[start * height..].split_at_mut(size * height);
        let panel_matrix = MatMut::from_column_major_slice_mut(panel, height, size);
        let (_, lower) = panel_matrix.split_at_row_mut(start);
        let (mut diagonal, mut under) = lower.split_at_row_mut(size);
        let mut buffer =
            MemBuffer::new(dense_llt::cholesky_in_place_scratch::<f64>(size, Par::Seq, Default::default()));
        dense_llt::cholesky_in_place(
            diagonal.rb_mut(),
            Default::default(),
            Par::Seq,
            MemStack::new(&mut buffer),
            Default::default(),
        )
        .map_err(|dense_llt::LltError::NonPositivePivot { index }| start + index)?;
        let triangle = diagonal.into_const();
        let rows = under.nrows();
        under.rb_mut().par_row_chunks_mut(2 * STRIP).for_each(|chunk| {
            solve_lower_triangular_in_place(triangle, chunk.transpose_mut(), Par::Seq);
        });
        if rows == 0 {
            continue;
        }
        let under = under.into_const();
        // These are the columns of this front that are not factored yet.
        rest[..(width - end) * height].par_chunks_mut(STRIP * height).enumerate().for_each(
            |(index, strip)| {
                let first = index * STRIP;
                let columns = strip.len() / height;
                let strip = MatMut::from_column_major_slice_mut(strip, height, columns);
                let lower = under.subrows(first, rows - first);
                subtract_product(strip.split_at_row_mut(end + first).1, lower, lower.subrows(0, columns));
            },
        );
    }
    if below > 0 {
        let bottom = MatRef::from_column_major_slice(&*block, height, width).subrows(width, below);
        update.par_chunks_mut(STRIP * below).enumerate().for_each(|(index, strip)| {
            let first = index * STRIP;
            let columns = strip.len() / below;
            let strip = MatMut::from_column_major_slice_mut(strip, below, columns);
            let lower = bottom.subrows(first, below - first);
            subtract_product(strip.split_at_row_mut(first).1, lower, lower.subrows(0, columns));
        });
    }
    Ok(())
}

/// Computes `strip -= lower right^T` on and below the diagonal only.
///
/// The product is symmetric there: `right` is the head of `lower`, possibly with other signs of its
/// columns.
pub(crate) fn subtract_product(strip: MatMut<'_, f64>, lower: MatRef<'_, f64>, right: MatRef<'_, f64>) {
    let columns = strip.ncols();
    let (on, under) = strip.split_at_row_mut(columns);
    let (head, tail) = lower.split_at_row(columns);
    triangular::matmul(
        on,
        BlockStructure::TriangularLower,
        Accum::Add,
        head,
        BlockStructure::Rectangular,
        right.transpose(),
        BlockStructure::Rectangular,
        -1.0,
        Par::Seq,
    );
    matmul(under, Accum::Add, tail, right.transpose(), -1.0, Par::Seq);
}

#[cfg(test)]
#[path = "factor_tests.rs"]
pub(crate) mod tests;
