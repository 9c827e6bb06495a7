//! Computes the static compliance `W^T A^-1 W = |L^-1 W|^2` of many overlapping patches at once.
//!
//! Patches around neighboring vertices load the same nodes. Instead of three columns per patch,
//! each node that any patch touches therefore gets its three unit loads once, and a patch is a sum
//! of such columns. A unit load is zero below the node's own position in the elimination tree. A
//! front therefore sees only the columns of its own subtree, and these columns are contiguous. The
//! forward substitution goes up the tree in the same way as the factorization (the multifrontal
//! method, Duff and Reid 1983), with dense blocks of right-hand sides.

use std::ops::Range;

use faer::linalg::matmul::matmul;
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::prelude::{IntoConst, ReborrowMut};
use faer::traits::ComplexField;
use faer::traits::pulp::{Arch, NullaryFnOnce};
use faer::{Accum, Mat, MatMut, Par};
use rayon::prelude::*;

use crate::factor::Factor;
use crate::symbolic::{Supernode, Symbolic};

/// Number of right-hand side columns that one task processes together.
const STRIP: usize = 192;

/// Number of loads whose squares are computed together. `PIECE` is the number of rows per pass.
const TOGETHER: usize = 48;
const PIECE: usize = 128;

/// Unit force on a patch, equal along each axis: node rows in ascending order with their shares.
pub(crate) type Load = Vec<(usize, f64)>;

/// Upper triangle of a symmetric 3 x 3 matrix: xx, xy, xz, yy, yz, zz.
pub(crate) type Six = [f64; 6];

/// Floating-point precision of the right-hand sides.
trait Number: ComplexField + Copy + Default + std::ops::AddAssign + std::ops::Mul<Output = Self> {
    fn of(x: f64) -> Self;
    fn wide(self) -> f64;
}

impl Number for f64 {
    fn of(x: f64) -> Self {
        x
    }
    fn wide(self) -> f64 {
        self
    }
}

impl Number for f32 {
    fn of(x: f64) -> Self {
        x as f32
    }
    fn wide(self) -> f64 {
        f64::from(self)
    }
}

/// Contribution of a subtree to its parent.
struct Update<T> {
    /// Array of `3 rows` by columns, stored column by column. The columns are those of the
    /// subtree's range of needed nodes.
    values: Vec<T>,
    /// Loads that touch the subtree, in ascending order.
    loads: Vec<u32>,
}

/// Nodes that the loads touch, and the range of these nodes in each subtree.
pub(crate) struct Plan<'a> {
    factor: &'a Factor,
    loads: &'a [Load],
    /// Nodes (in elimination order) that some load touches, in ascending order.
    needed: Vec<usize>,
    /// For each supernode, the range of its subtree in `needed`.
    columns: Vec<Range<usize>>,
}

impl<'a> Plan<'a> {
    pub(crate) fn new(factor: &'a Factor, loads: &'a [Load]) -> Self {
        let mut needed: Vec<usize> = loads.iter().flatten().map(|&(row, _)| row).collect();
        needed.sort_unstable();
        needed.dedup();
        let supernodes = &factor.symbolic.supernodes;
        let mut columns: Vec<Range<usize>> = Vec::with_capacity(supernodes.len());
        for s in supernodes {
            // The elimination order is a postorder, so the nodes of a subtree are contiguous and
            // the ranges of its children are adjacent.
            let start = s.children.iter().map(|&child| columns[child].start).min();
            let start = start.unwrap_or_else(|| needed.partition_point(|&row| row < s.first));
            let end = needed.partition_point(|&row| row < s.first + s.columns);
            columns.push(start.min(end)..end);
        }
        Self { factor, loads, needed, columns }
    }

    /// Estimates the total number of multiplications.
    pub(crate) fn cost(&self) -> f64 {
        let front = |(s, columns): (&Supernode, &Range<usize>)| {
            let (w, b) = (s.width() as f64, s.below() as f64);
            3.0 * columns.len() as f64 * (0.5 * w * w + w * b)
        };
        self.factor.symbolic.supernodes.iter().zip(&self.columns).map(front).sum()
    }

    /// Returns the largest count of numbers in the right-hand sides of one front.
    pub(crate) fn largest_block(&self) -> usize {
        let front = |(s, columns): (&Supernode, &Range<usize>)| (s.width() + s.below()) * 3 * columns.len();
        self.factor.symbolic.supernodes.iter().zip(&self.columns).map(front).max().unwrap_or(0)
    }

    /// Returns `W^T A^-1 W` of each load, in double precision or, with `fast`, in single precision.
    ///
    /// Single precision takes half the time and has a relative error of about 1e-6. The result is
    /// the same to the bit for any number of threads.
    pub(crate) fn compliances(&self, fast: bool, report: &mut dyn FnMut(f64)) -> Vec<Six> {
        if fast { self.compliances_in::<f32>(report) } else { self.compliances_in::<f64>(report) }
    }

    fn compliances_in<T: Number>(&self, report: &mut dyn FnMut(f64)) -> Vec<Six> {
        let symbolic = &self.factor.symbolic;
        let touching = self.touching();
        let tasks: Vec<(Option<Update<T>>, Vec<(u32, Six)>)> = symbolic
            .tasks
            .par_iter()
            .map(|task| {
                let mut updates: Vec<Option<Update<T>>> = (0..task.len()).map(|_| None).collect();
                let mut sums = Vec::new();
                for s in task.clone() {
                    let children = children(symbolic, s, &mut |child| updates[child - task.start].take());
                    let (update, more) = self.front(s, children, &touching);
                    updates[s - task.start] = update;
                    sums.extend(more);
                }
                (updates.pop().flatten(), sums)
            })
            .collect();
        let mut out = vec![[0.0; 6]; self.loads.len()];
        let mut add = |sums: Vec<(u32, Six)>| {
            for (load, sum) in sums {
                (0..6).for_each(|k| out[load as usize][k] += sum[k]);
            }
        };
        let mut updates: Vec<Option<Update<T>>> = (0..symbolic.supernodes.len()).map(|_| None).collect();
        for (task, (update, sums)) in symbolic.tasks.iter().zip(tasks) {
            updates[task.end - 1] = update;
            add(sums);
        }
        for (index, &s) in symbolic.top.iter().enumerate() {
            report((index + 1) as f64 / (symbolic.top.len() + 1) as f64);
            let children = children(symbolic, s, &mut |child| updates[child].take());
            let (update, sums) = self.front(s, children, &touching);
            updates[s] = update;
            add(sums);
        }
        out
    }

    /// Returns for each needed node the loads that touch the node.
    fn touching(&self) -> Vec<Vec<u32>> {
        let mut out = vec![Vec::new(); self.needed.len()];
        for (index, load) in self.loads.iter().enumerate() {
            for (row, _) in load {
                out[self.needed.partition_point(|n| n < row)].push(index as u32);
            }
        }
        out
    }

    /// Processes one front. Returns the update for the parent and the contribution of the front's
    /// part of the solution to the square of each load.
    fn front<T: Number>(
        &self,
        s: usize,
        children: Vec<(usize, Update<T>)>,
        touching: &[Vec<u32>],
    ) -> (Option<Update<T>>, Vec<(u32, Six)>) {
        let range = self.columns[s].clone();
        if range.is_empty() {
            return (None, Vec::new());
        }
        let node = &self.factor.symbolic.supernodes[s];
        let (w, b) = (node.width(), node.below());
        let (height, count) = (w + b, 3 * range.len());
        let mut x = vec![T::default(); height * count];
        let mut loads: Vec<u32> = Vec::new();
        let place = |row: u32| {
            let row = row as usize;
            if row < node.first + node.columns {
                row - node.first
            } else {
                node.columns + node.rows.partition_point(|&r| (r as usize) < row)
            }
        };
        for (child, update) in children {
            let from = &self.factor.symbolic.supernodes[child];
            let places: Vec<usize> = from.rows.iter().map(|&row| 3 * place(row)).collect();
            let first = 3 * (self.columns[child].start - range.start);
            let height_below = from.below();
            for (column, values) in update.values.chunks_exact(height_below.max(1)).enumerate() {
                let column = &mut x[(first + column) * height..][..height];
                for (values, &at) in values.chunks_exact(3).zip(&places) {
                    column[at..at + 3].iter_mut().zip(values).for_each(|(to, from)| *to += *from);
                }
            }
            loads.extend(update.loads);
        }
        let own = self.needed[range.clone()].partition_point(|&row| row < node.first);
        for (index, &row) in self.needed[range.clone()].iter().enumerate().skip(own) {
            for axis in 0..3 {
                x[(3 * index + axis) * height + 3 * (row - node.first) + axis] = T::of(1.0);
            }
            loads.extend(&touching[range.start + index]);
        }
        loads.sort_unstable();
        loads.dedup();

        let block = self.factor.block(node);
        let block = Mat::from_fn(height, w, |i, j| T::of(block[(i, j)]));
        x.par_chunks_mut(height * STRIP).for_each(|strip| {
            let columns = strip.len() / height;
            let all = MatMut::from_column_major_slice_mut(strip, height, columns);
            let (mut top, below) = all.split_at_row_mut(w);
            solve_lower_triangular_in_place(block.as_ref().subrows(0, w), top.rb_mut(), Par::Seq);
            if b > 0 {
                matmul(
                    below,
                    Accum::Add,
                    block.as_ref().subrows(w, b),
                    top.into_const(),
                    T::of(-1.0),
                    Par::Seq,
                );
            }
        });

        let solved = Solved { x: &x, height, width: w, nodes: &self.needed[range.clone()] };
        let sums = loads
            .par_chunks(TOGETHER)
            .flat_map_iter(|loads| loads.iter().copied().zip(solved.squares(self.loads, loads)))
            .collect();
        if b == 0 {
            return (None, sums);
        }
        let mut values = vec![T::default(); b * count];
        for (to, from) in values.chunks_exact_mut(b).zip(x.chunks_exact(height)) {
            to.copy_from_slice(&from[w..]);
        }
        (Some(Update { values, loads }), sums)
    }
}

/// Solved right-hand sides of the nodes of one front.
struct Solved<'a, T> {
    x: &'a [T],
    height: usize,
    width: usize,
    nodes: &'a [usize],
}

impl<T: Number> Solved<'_, T> {
    /// Returns `|sum of shares x columns|^2` of each load.
    ///
    /// Neighboring loads share nodes. Their columns are read in pieces so that the pieces stay in
    /// the cache.
    fn squares(&self, all: &[Load], loads: &[u32]) -> Vec<Six> {
        // The code is compiled for every instruction set, and the dispatch selects one at run time.
        // Every variant does the same operations in the same order.
        Arch::new().dispatch(Squares { solved: self, all, loads })
    }

    #[inline(always)]
    fn squares_here(&self, all: &[Load], loads: &[u32]) -> Vec<Six> {
        let (Some(&low), Some(&high)) = (self.nodes.first(), self.nodes.last()) else { return Vec::new() };
        let parts: Vec<Vec<(usize, T)>> = loads
            .iter()
            .map(|&load| {
                let entries = &all[load as usize];
                let first = entries.partition_point(|&(row, _)| row < low);
                let part = entries[first..].iter().take_while(|&&(row, _)| row <= high);
                let column = |row: usize| 3 * self.nodes.partition_point(|&node| node < row) * self.height;
                part.map(|&(row, share)| (column(row), T::of(share))).collect()
            })
            .collect();
        let mut out = vec![[0.0; 6]; loads.len()];
        for start in (0..self.width).step_by(PIECE) {
            let size = PIECE.min(self.width - start);
            for (part, out) in parts.iter().zip(&mut out) {
                let mut sums = [[T::default(); PIECE]; 3];
                for &(column, share) in part {
                    for (axis, sum) in sums.iter_mut().enumerate() {
                        let from = &self.x[column + axis * self.height + start..][..size];
                        for (sum, from) in sum.iter_mut().zip(from) {
                            *sum += share * *from;
                        }
                    }
                }
                for (out, (i, j)) in out.iter_mut().zip([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]) {
                    *out += dot(&sums[i], &sums[j]);
                }
            }
        }
        out
    }
}

/// The call of [`Solved::squares_here`]. A closure would be called through a function of its own,
/// which is compiled for the oldest processors.
struct Squares<'a, T> {
    solved: &'a Solved<'a, T>,
    all: &'a [Load],
    loads: &'a [u32],
}

impl<T: Number> NullaryFnOnce for Squares<'_, T> {
    type Output = Vec<Six>;

    #[inline(always)]
    fn call(self) -> Vec<Six> {
        self.solved.squares_here(self.all, self.loads)
    }
}

/// Uses eight running sums, so that the additions do not wait for one another.
#[inline(always)]
fn dot<T: Number>(a: &[T; PIECE], b: &[T; PIECE]) -> f64 {
    let mut lanes = [0.0; 8];
    for (a, b) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
        for k in 0..8 {
            lanes[k] += a[k].wide() * b[k].wide();
        }
    }
    lanes.iter().sum()
}

/// Returns the updates of a front's children in order. Children without an update are left out.
fn children<T>(
    symbolic: &Symbolic,
    s: usize,
    take: &mut dyn FnMut(usize) -> Option<Update<T>>,
) -> Vec<(usize, Update<T>)> {
    symbolic.supernodes[s].children.iter().filter_map(|&child| Some((child, take(child)?))).collect()
}
