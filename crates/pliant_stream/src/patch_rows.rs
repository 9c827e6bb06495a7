//! One patch of a body as the receiver's step needs it.
//!
//! Where a patch is depends on six sums over the modes only: its mean displacement and its mean rotation. A step therefore
//! works in these six numbers a patch: the modes are gone through three times, however many Newton rounds there are.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use pliant_modal::{Body, ModalModel, Patch, warp, warp_jacobian};
use std::sync::Arc;

use crate::StreamError;

/// Displacement (0..3) and rotation (3..6) of a patch, or the forces that belong to them.
pub(crate) type Six = SVector<f64, 6>;
/// Derivative of a patch's place by its six numbers.
pub(crate) type Tangent = SMatrix<f64, 3, 6>;
/// How two patches' six numbers answer each other's forces.
pub(crate) type Block = SMatrix<f64, 6, 6>;

/// Names a patch: vertex, bits of the radius.
pub(crate) type Key = (u32, u64);

/// The key of a patch.
pub(crate) fn key(vertex: u32, radius: f64) -> Key {
    (vertex, radius.to_bits())
}

/// Sums run in so many lanes: a fixed order, so equal on all machines, and wide.
const LANES: usize = 4;

fn dot(row: &[f64], x: &[f64]) -> f64 {
    let mut sums = [0.0; LANES];
    let (mut a, mut b) = (row.chunks_exact(LANES), x.chunks_exact(LANES));
    for (a, b) in a.by_ref().zip(b.by_ref()) {
        for k in 0..LANES {
            sums[k] += a[k] * b[k];
        }
    }
    let rest: f64 = a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum();
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// Three rows at once: the loads of `x` are shared and the sums do not wait for each other.
fn dot3(rows: [&[f64]; 3], x: &[f64]) -> [f64; 3] {
    let n = x.len();
    let rows = rows.map(|r| r[..n].as_chunks::<LANES>());
    let (x, tail) = x.as_chunks::<LANES>();
    let mut sums = [[0.0; LANES]; 3];
    for (((a, b), c), x) in rows[0].0.iter().zip(rows[1].0).zip(rows[2].0).zip(x) {
        for k in 0..LANES {
            sums[0][k] += a[k] * x[k];
            sums[1][k] += b[k] * x[k];
            sums[2][k] += c[k] * x[k];
        }
    }
    let mut out = sums.map(|s| (s[0] + s[1]) + (s[2] + s[3]));
    for (o, (_, row)) in out.iter_mut().zip(rows) {
        *o += row.iter().zip(tail).map(|(a, b)| a * b).sum::<f64>();
    }
    out
}

/// Weighted mean of a patch's modes.
#[derive(Debug, Clone)]
pub(crate) struct PatchRows {
    pub(crate) key: Key,
    rows: [Vec<f64>; 6],
    /// Where the patch is at rest, body axes, m.
    pub(crate) rest: Vector3<f64>,
    /// Compliance of a grab here, m/N.
    pub(crate) compliance: Matrix3<f64>,
}

impl PatchRows {
    pub(crate) fn new(
        model: &Arc<ModalModel>,
        vertex: u32,
        radius: f64,
        modes: usize,
        stiffness_scale: f64,
    ) -> Result<Self, StreamError> {
        let failed = |e: String| StreamError::Model(e);
        let patch = Patch::around(model.surface(), vertex, radius).map_err(|e| failed(e.to_string()))?;
        let mut rows: [Vec<f64>; 6] = std::array::from_fn(|_| vec![0.0; modes]);
        let mut rest = Vector3::zeros();
        for &(v, weight) in patch.entries() {
            let place = model.surface().positions().get(v as usize).copied().unwrap_or_default();
            rest += weight * Vector3::from(place.map(f64::from));
            for axis in 0..3 {
                for (mode, r) in rows[axis].iter_mut().enumerate() {
                    *r += weight * f64::from(model.displacement_row(v, axis, mode));
                }
                for (mode, r) in rows[3 + axis].iter_mut().enumerate() {
                    *r += weight * f64::from(model.rotation_row(v, axis, mode));
                }
            }
        }
        // What a grab of the body itself would have.
        let compliance = Body::compliance_of(model, &patch, modes, stiffness_scale);
        let compliance = compliance.map_err(|e| failed(e.to_string()))?;
        let compliance = Matrix3::from_fn(|i, j| compliance[i][j]);
        Ok(Self { key: key(vertex, radius), rows, rest, compliance })
    }

    /// The six sums `B x`. Without warp the rotation plays no part and stays zero.
    pub(crate) fn reduce(&self, x: &[f64], warped: bool) -> Six {
        let [a, b, c, d, e, f] = &self.rows;
        let u = dot3([a, b, c], x);
        let w = if warped { dot3([d, e, f], x) } else { [0.0; 3] };
        Six::new(u[0], u[1], u[2], w[0], w[1], w[2])
    }

    /// `out += B^T forces`.
    pub(crate) fn spread(&self, forces: &Six, warped: bool, out: &mut [f64]) {
        let n = out.len();
        let [a, b, c, d, e, f] = self.rows.each_ref().map(|r| &r[..n]);
        let g = forces;
        if warped {
            for k in 0..n {
                let straight = a[k] * g[0] + b[k] * g[1] + c[k] * g[2];
                out[k] += straight + (d[k] * g[3] + e[k] * g[4] + f[k] * g[5]);
            }
        } else {
            for k in 0..n {
                out[k] += a[k] * g[0] + b[k] * g[1] + c[k] * g[2];
            }
        }
    }

    /// `B_self diag(weight) B_other^T`.
    pub(crate) fn gram(&self, other: &Self, weight: &[f64], scratch: &mut Vec<f64>) -> Block {
        let mut block = Block::zeros();
        for (i, mine) in self.rows.iter().enumerate() {
            scratch.clear();
            scratch.extend(mine.iter().zip(weight).map(|(r, w)| r * w));
            for (j, theirs) in other.rows.iter().enumerate() {
                block[(i, j)] = dot(scratch, theirs);
            }
        }
        block
    }
}

/// Displacement of a patch from its six numbers, body axes, m.
pub(crate) fn displaced(z: &Six, warped: bool) -> Vector3<f64> {
    let d = Vector3::new(z[0], z[1], z[2]);
    if warped { warp([z[3], z[4], z[5]], d.into()).into() } else { d }
}

/// Displacement and its derivative by the six numbers.
pub(crate) fn tangent(z: &Six, warped: bool) -> (Vector3<f64>, Tangent) {
    let mut tangent = Tangent::zeros();
    if !warped {
        tangent.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
        return (Vector3::new(z[0], z[1], z[2]), tangent);
    }
    let (u, by_d, by_w) = warp_jacobian([z[3], z[4], z[5]], [z[0], z[1], z[2]]);
    for i in 0..3 {
        for j in 0..3 {
            tangent[(i, j)] = by_d[i][j];
            tangent[(i, 3 + j)] = by_w[i][j];
        }
    }
    (u.into(), tangent)
}

/// [`PatchRows::gram`] of all pairs of the patches in use, lower triangle; kept while the patches stay the same.
#[derive(Debug, Default)]
pub(crate) struct Grams {
    keys: Vec<Key>,
    blocks: Vec<Block>,
    scratch: Vec<f64>,
}

impl Grams {
    /// Makes the blocks for these patches, unless they are there.
    pub(crate) fn prepare(&mut self, patches: &[PatchRows], used: &[usize], weight: &[f64]) {
        let same = self.keys.len() == used.len();
        if same && used.iter().zip(&self.keys).all(|(&i, key)| patches[i].key == *key) {
            return;
        }
        // What two patches are to each other does not change when others come or go.
        let old: Vec<Option<usize>> =
            used.iter().map(|&i| self.keys.iter().position(|key| *key == patches[i].key)).collect();
        let mut blocks = Vec::with_capacity(used.len() * (used.len() + 1) / 2);
        for (i, &a) in used.iter().enumerate() {
            for (j, &b) in used[..=i].iter().enumerate() {
                blocks.push(match (old[i], old[j]) {
                    (Some(x), Some(y)) if x >= y => *self.at(x, y),
                    (Some(x), Some(y)) => self.at(y, x).transpose(),
                    _ => patches[a].gram(&patches[b], weight, &mut self.scratch),
                });
            }
        }
        self.blocks = blocks;
        self.keys.clear();
        self.keys.extend(used.iter().map(|&i| patches[i].key));
    }

    /// The block of two patches in use, `j` at most `i`.
    pub(crate) fn at(&self, i: usize, j: usize) -> &Block {
        &self.blocks[i * (i + 1) / 2 + j]
    }

    /// `sum over j of block(i, j) forces[j]`.
    pub(crate) fn answer(&self, i: usize, forces: &[Six]) -> Six {
        let mut sum = Six::zeros();
        for (j, f) in forces.iter().enumerate() {
            if j <= i {
                sum += self.at(i, j) * f;
            } else {
                sum += self.at(j, i).tr_mul(f);
            }
        }
        sum
    }
}
