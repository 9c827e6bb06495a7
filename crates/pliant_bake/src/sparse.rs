//! Symmetric block-sparse stiffness and mass, and their products with blocks of vectors.
//!
//! A block of vectors is stored row by row: entry (dof, column) is at `dof * width + column`, where
//! dof = 3 node + axis.

use rayon::prelude::*;

use crate::fem::Lists;

/// Stiffness (3x3 blocks, N/m) and mass (kg) on one symmetric sparsity pattern, with both triangles
/// stored.
///
/// The mass is one number per node pair, because it acts on each axis alike.
#[derive(Clone, Debug)]
pub(crate) struct BlockCsr {
    pub(crate) offsets: Vec<usize>,
    pub(crate) columns: Vec<u32>,
    /// Stiffness values, nine per stored block, row by row.
    pub(crate) stiffness: Vec<f64>,
    pub(crate) mass: Vec<f64>,
}

/// Number of nodes per parallel task of a product.
const CHUNK: usize = 256;

impl BlockCsr {
    pub(crate) fn zeros(graph: &Lists) -> Self {
        Self {
            offsets: graph.offsets.clone(),
            columns: graph.items.clone(),
            stiffness: vec![0.0; 9 * graph.items.len()],
            mass: vec![0.0; graph.items.len()],
        }
    }

    /// Returns the number of nodes.
    pub(crate) fn nodes(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Returns the number of degrees of freedom.
    pub(crate) fn dofs(&self) -> usize {
        3 * self.nodes()
    }

    /// Returns the storage index of the block (row, column). The pair must be in the pattern.
    pub(crate) fn position(&self, row: u32, column: u32) -> usize {
        let start = self.offsets[row as usize];
        let columns = &self.columns[start..self.offsets[row as usize + 1]];
        start + columns.partition_point(|&c| c < column)
    }

    /// Computes `out = K x` for blocks of `width` vectors.
    pub(crate) fn stiffness_times(&self, x: &[f64], width: usize, out: &mut [f64]) {
        self.rows(width, out, |at, column, y| {
            let k = &self.stiffness[9 * at..][..9];
            let x = &x[3 * column * width..][..3 * width];
            let (x0, rest) = x.split_at(width);
            let (x1, x2) = rest.split_at(width);
            for (row, y) in y.chunks_exact_mut(width).enumerate() {
                let (a, b, c) = (k[3 * row], k[3 * row + 1], k[3 * row + 2]);
                for (((y, x0), x1), x2) in y.iter_mut().zip(x0).zip(x1).zip(x2) {
                    *y += a * x0 + b * x1 + c * x2;
                }
            }
        });
    }

    /// Computes `out = M x` for blocks of `width` vectors.
    pub(crate) fn mass_times(&self, x: &[f64], width: usize, out: &mut [f64]) {
        // Eight sums at a time stay in registers during the loop over the row's neighbors.
        const LANES: usize = 8;
        out.par_chunks_mut(3 * width * CHUNK).enumerate().for_each(|(chunk, out)| {
            for (local, y) in out.chunks_exact_mut(3 * width).enumerate() {
                let row = chunk * CHUNK + local;
                let range = self.offsets[row]..self.offsets[row + 1];
                let (columns, mass) = (&self.columns[range.clone()], &self.mass[range]);
                let mut lanes = y.chunks_exact_mut(LANES);
                let mut start = 0;
                for y in &mut lanes {
                    let mut sum = [0.0; LANES];
                    for (&column, &m) in columns.iter().zip(mass) {
                        let x = &x[3 * column as usize * width + start..][..LANES];
                        for (sum, x) in sum.iter_mut().zip(x) {
                            *sum += m * x;
                        }
                    }
                    y.copy_from_slice(&sum);
                    start += LANES;
                }
                for y in lanes.into_remainder() {
                    *y = 0.0;
                    for (&column, &m) in columns.iter().zip(mass) {
                        *y += m * x[3 * column as usize * width + start];
                    }
                    start += 1;
                }
            }
        });
    }

    fn rows(&self, width: usize, out: &mut [f64], add: impl Fn(usize, usize, &mut [f64]) + Sync) {
        out.par_chunks_mut(3 * width * CHUNK).enumerate().for_each(|(chunk, out)| {
            for (local, y) in out.chunks_exact_mut(3 * width).enumerate() {
                let row = chunk * CHUNK + local;
                y.fill(0.0);
                for at in self.offsets[row]..self.offsets[row + 1] {
                    add(at, self.columns[at] as usize, y);
                }
            }
        });
    }
}
