//! The stiffness of a region at rest, and static solutions with it.
//!
//! Eight columns go in the lanes of one field of displacements or forces.

use nalgebra::{Matrix3, SMatrix};

use crate::{
    Element, Hyperelastic,
    nonlinear::{LANES, Lane},
    simd::{Work, widest},
    tetrahedron::{self, Affine, MAX_NODES},
};

/// Maximum number of iterations of a solution on a region.
pub(super) const MAX_ITERATIONS: usize = 100;

/// A vector at each node of a region, of eight columns.
pub(super) type Field = Vec<[Lane; 3]>;

/// A field of zeros.
pub(super) fn zeros(nodes: usize) -> Field {
    vec![[Lane::splat(0.0); 3]; nodes]
}

/// The columns from `first` on of `width` columns, `[node][axis][column]`, as a field.
pub(super) fn field(values: &[f64], width: usize, first: usize) -> Field {
    let rows = values.chunks_exact(3 * width);
    let lanes = |row: &[f64]| {
        let mut out = Lane::splat(0.0);
        out.0.iter_mut().zip(row.iter().skip(first)).for_each(|(out, x)| *out = *x);
        out
    };
    rows.map(|rows| std::array::from_fn(|axis| lanes(&rows[axis * width..][..width]))).collect()
}

/// Writes a field to the columns from `first` on.
pub(super) fn write(field: &[[Lane; 3]], width: usize, first: usize, values: &mut [f64]) {
    for (lanes, rows) in field.iter().zip(values.chunks_exact_mut(3 * width)) {
        for (lane, row) in lanes.iter().zip(rows.chunks_exact_mut(width)) {
            row.iter_mut().skip(first).zip(lane.0).for_each(|(out, x)| *out = x);
        }
    }
}

/// Stiffness of the elements of a region at rest, in rows of 3x3 blocks.
pub(super) struct Stiffness {
    offsets: Vec<usize>,
    columns: Vec<u32>,
    blocks: Vec<Matrix3<f64>>,
}

impl Stiffness {
    pub(super) fn new(
        kind: Element,
        law: Hyperelastic,
        count: usize,
        elements: &[[u32; MAX_NODES]],
        affine: &[Affine],
    ) -> Self {
        let per = kind.node_count();
        // The elements at each node, and from them the neighbors of each node.
        let mut starts = vec![0usize; count + 1];
        elements.iter().flat_map(|nodes| &nodes[..per]).for_each(|&node| starts[node as usize + 1] += 1);
        (0..count).for_each(|node| starts[node + 1] += starts[node]);
        let (mut next, mut at) = (starts.clone(), vec![0u32; per * elements.len()]);
        for (e, nodes) in elements.iter().enumerate() {
            for &node in &nodes[..per] {
                at[next[node as usize]] = e as u32;
                next[node as usize] += 1;
            }
        }
        let (mut offsets, mut columns, mut row) = (vec![0], Vec::new(), Vec::new());
        for node in 0..count {
            row.clear();
            for &e in &at[starts[node]..starts[node + 1]] {
                row.extend_from_slice(&elements[e as usize][..per]);
            }
            row.sort_unstable();
            row.dedup();
            columns.extend_from_slice(&row);
            offsets.push(columns.len());
        }
        let blocks = vec![Matrix3::zeros(); columns.len()];
        let mut out = Self { offsets, columns, blocks };
        let tangent = law.tangent(&Matrix3::zeros());
        let (points, share) = tetrahedron::stiffness_points(kind);
        for (nodes, affine) in elements.iter().zip(affine) {
            // All points have the same tangent: it meets the sum over the points of the products of
            // the gradients of two nodes.
            let mut products = [[[[0.0; 3]; 3]; MAX_NODES]; MAX_NODES];
            for &point in points {
                let g = affine.shape_gradients(kind, point);
                for (a, row) in products[..per].iter_mut().enumerate() {
                    for (b, product) in row[..=a].iter_mut().enumerate() {
                        for (c, product) in product.iter_mut().enumerate() {
                            product.iter_mut().zip(&g[b]).for_each(|(p, gb)| *p += g[a][c] * gb);
                        }
                    }
                }
            }
            for (a, row) in products[..per].iter().enumerate() {
                for (b, product) in row[..=a].iter().enumerate() {
                    let mut block = Matrix3::zeros();
                    for (c, product) in product.iter().enumerate() {
                        for (d, product) in product.iter().enumerate() {
                            let part = tangent.fixed_view::<3, 3>(3 * c, 3 * d);
                            block += share * affine.volume * product * part;
                        }
                    }
                    out.add(nodes[a], nodes[b], block);
                }
            }
        }
        out
    }

    /// The stiffness of the same elements where `tangent` gives that of the material in a point of
    /// an element.
    pub(super) fn with_tangents(
        &self,
        kind: Element,
        elements: &[[u32; MAX_NODES]],
        affine: &[Affine],
        mut tangent: impl FnMut(usize, usize) -> SMatrix<f64, 9, 9>,
    ) -> Self {
        let blocks = vec![Matrix3::zeros(); self.columns.len()];
        let mut out = Self { offsets: self.offsets.clone(), columns: self.columns.clone(), blocks };
        let per = kind.node_count();
        let (points, share) = tetrahedron::stiffness_points(kind);
        for (element, (nodes, affine)) in elements.iter().zip(affine).enumerate() {
            let mut sums = [[Matrix3::zeros(); MAX_NODES]; MAX_NODES];
            for (number, &point) in points.iter().enumerate() {
                let g = affine.shape_gradients(kind, point);
                let tangent = tangent(element, number) * (share * affine.volume);
                for (a, sums) in sums[..per].iter_mut().enumerate() {
                    // The force on the node of this row by each entry of a displacement gradient.
                    let rows = tangent.fixed_rows::<3>(0) * g[a][0]
                        + tangent.fixed_rows::<3>(3) * g[a][1]
                        + tangent.fixed_rows::<3>(6) * g[a][2];
                    for (sum, g) in sums[..=a].iter_mut().zip(&g) {
                        for (d, g) in g.iter().enumerate() {
                            *sum += rows.fixed_columns::<3>(3 * d) * *g;
                        }
                    }
                }
            }
            for (a, row) in sums[..per].iter().enumerate() {
                row[..=a].iter().enumerate().for_each(|(b, &block)| out.add(nodes[a], nodes[b], block));
            }
        }
        out
    }

    /// Adds the block of two nodes, and its transpose on the other side of the diagonal.
    fn add(&mut self, a: u32, b: u32, block: Matrix3<f64>) {
        let mut add = |a: u32, b: u32, block: Matrix3<f64>| {
            let start = self.offsets[a as usize];
            let row = &self.columns[start..self.offsets[a as usize + 1]];
            self.blocks[start + row.partition_point(|c| *c < b)] += block;
        };
        add(a, b, block);
        if a != b {
            add(b, a, block.transpose());
        }
    }

    /// Computes `out = K x` for columns stored as `[node][axis][column]`.
    pub(super) fn times(&self, x: &[f64], width: usize, out: &mut [f64]) {
        let nodes = self.offsets.len() - 1;
        for first in (0..width).step_by(LANES) {
            let (x, mut forces) = (field(x, width, first), zeros(nodes));
            widest(Times { stiffness: self, x: &x, out: &mut forces });
            write(&forces, width, first, out);
        }
    }

    /// Replaces forces by displacements of the free nodes, for eight columns, until the residual in
    /// the norm of the energy falls below a share `enough` of what it was, in at most `most`
    /// iterations.
    pub(super) fn solve(&self, free: &[bool], f: &mut [[Lane; 3]], enough: f64, most: usize) {
        let inverses: Vec<Matrix3<f64>> = (0..free.len())
            .map(|row| {
                let range = self.offsets[row]..self.offsets[row + 1];
                let at = range.start + self.columns[range].partition_point(|&c| (c as usize) < row);
                let diagonal = self.blocks.get(at).and_then(|block| block.try_inverse());
                diagonal.filter(|_| free[row]).unwrap_or_default()
            })
            .collect();
        widest(Solve { stiffness: self, inverses: &inverses, f, enough, most });
    }

    #[inline(always)]
    fn multiply(&self, x: &[[Lane; 3]], out: &mut [[Lane; 3]]) {
        for (row, out) in out.iter_mut().enumerate() {
            let mut sum = [Lane::splat(0.0); 3];
            let range = self.offsets[row]..self.offsets[row + 1];
            for (&column, block) in self.columns[range.clone()].iter().zip(&self.blocks[range]) {
                add(block, &x[column as usize], &mut sum);
            }
            *out = sum;
        }
    }
}

/// Adds the product of a block with a vector.
#[inline(always)]
fn add(block: &Matrix3<f64>, x: &[Lane; 3], out: &mut [Lane; 3]) {
    let mut sum = *out;
    for (j, x) in x.iter().enumerate() {
        for (i, sum) in sum.iter_mut().enumerate() {
            *sum = sum.plus(block[3 * j + i], *x);
        }
    }
    *out = sum;
}

#[inline(always)]
fn dots(a: &[[Lane; 3]], b: &[[Lane; 3]]) -> Lane {
    let mut sum = Lane::splat(0.0);
    for (a, b) in a.iter().zip(b) {
        sum = sum + a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    }
    sum
}

#[inline(always)]
fn precondition(inverses: &[Matrix3<f64>], residual: &[[Lane; 3]], z: &mut [[Lane; 3]]) {
    for ((z, r), inverse) in z.iter_mut().zip(residual).zip(inverses) {
        let mut sum = [Lane::splat(0.0); 3];
        add(inverse, r, &mut sum);
        *z = sum;
    }
}

struct Times<'a> {
    stiffness: &'a Stiffness,
    x: &'a [[Lane; 3]],
    out: &'a mut [[Lane; 3]],
}

impl Work for Times<'_> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        self.stiffness.multiply(self.x, self.out);
    }
}

/// Conjugate gradients with the inverses of the diagonal blocks (M. R. Hestenes and E. Stiefel,
/// *Methods of Conjugate Gradients for Solving Linear Systems*, 1952).
struct Solve<'a> {
    stiffness: &'a Stiffness,
    inverses: &'a [Matrix3<f64>],
    f: &'a mut [[Lane; 3]],
    enough: f64,
    most: usize,
}

impl Work for Solve<'_> {
    type Out = ();
    #[inline(always)]
    fn run(self) {
        let Self { stiffness, inverses, f, enough, most } = self;
        let zero = Lane::splat(0.0);
        let ratio = |a: Lane, b: Lane| zero.if_less(b, a / b.max(f64::MIN_POSITIVE), zero);
        let mut residual = f.to_vec();
        let (mut z, mut forces) = (zeros(f.len()), zeros(f.len()));
        precondition(inverses, &residual, &mut z);
        let mut direction = z.clone();
        let mut left = dots(&residual, &z);
        let goal = Lane::splat(enough * enough) * left;
        f.fill([zero; 3]);
        for _ in 0..most {
            stiffness.multiply(&direction, &mut forces);
            // Nodes that are not free have no direction, and their forces count for nothing.
            let step = ratio(left, dots(&direction, &forces));
            for ((f, residual), (direction, forces)) in
                f.iter_mut().zip(&mut residual).zip(direction.iter().zip(&forces))
            {
                for axis in 0..3 {
                    f[axis] = f[axis] + step * direction[axis];
                    residual[axis] = residual[axis] - step * forces[axis];
                }
            }
            precondition(inverses, &residual, &mut z);
            let now = dots(&residual, &z);
            if now.0.iter().zip(&goal.0).all(|(now, goal)| now <= goal) {
                break;
            }
            let keep = ratio(now, left);
            for (direction, z) in direction.iter_mut().zip(&z) {
                for axis in 0..3 {
                    direction[axis] = z[axis] + keep * direction[axis];
                }
            }
            left = now;
        }
    }
}
