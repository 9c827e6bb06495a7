//! A patch of a body as used in a step.
//!
//! The position of a patch depends on only six sums over the modes: its mean displacement and its
//! mean rotation. A step works with these six numbers per patch. It visits the modes once for the
//! step without hands and once for the effect of the hands, regardless of the number of
//! corrections.

use std::sync::Arc;

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use super::Hand;
use crate::{
    ModalModel, Patch, StepError,
    held::{self, PatchKey},
    simd::{LANES, dot},
    warp::warp_with_jacobian,
};

/// Displacement (0..3) and rotation (3..6) of a patch, or the conjugate forces.
pub(crate) type Six = SVector<f64, 6>;
/// Derivative of a patch's position with respect to its six numbers.
pub(crate) type Tangent = SMatrix<f64, 3, 6>;
/// Response of one patch's six numbers to forces on the six numbers of another patch.
type PairGram = SMatrix<f64, 6, 6>;

/// Computes three dot products at once. They share the loads of `x` and do not wait for each other.
fn dot3(rows: [&[f64]; 3], x: &[f64]) -> [f64; 3] {
    let n = x.len().min(rows[0].len());
    let rows = rows.map(|r| r[..n].as_chunks::<LANES>());
    let (x, tail) = x[..n].as_chunks::<LANES>();
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

/// Rows of the mean displacement and mean rotation of some vertices, with one entry per mode.
#[derive(Debug, Clone)]
pub(crate) struct MeanRows([Vec<f64>; 6]);

/// A patch of a model with the data for its steps: the weighted means of its vertices' modes and
/// its residual flexibility.
///
/// A held patch is made once and shared by all copies of the body.
#[derive(Debug, Clone)]
pub struct HeldPatch {
    key: PatchKey,
    rows: MeanRows,
    rest: Vector3<f64>,
    /// Residual flexibility at the baked stiffness, m/N.
    residual: Matrix3<f64>,
}

impl HeldPatch {
    /// Makes the patch for the first `modes` modes of a model.
    ///
    /// # Errors
    /// Returns [`StepError::Vertex`] if the patch belongs to another surface.
    pub fn new(model: &ModalModel, patch: &Patch, modes: usize) -> Result<Self, StepError> {
        let modes = modes.min(model.mode_count());
        let residual = residual(model, patch, modes)?;
        let positions = model.surface().positions();
        let at = |vertex: u32| Vector3::from(positions[vertex as usize].map(f64::from));
        let rest = patch.entries().iter().map(|&(vertex, weight)| weight * at(vertex)).sum();
        let rows = MeanRows::new(model, patch.entries(), modes);
        Ok(Self { key: held::key(patch), rows, rest, residual })
    }

    /// What identifies the patch on its model.
    pub(crate) fn key(&self) -> PatchKey {
        self.key
    }

    /// Center vertex and radius (m) of the patch.
    pub fn center_and_radius(&self) -> (u32, f64) {
        (self.key.0, f64::from_bits(self.key.1))
    }

    /// Position of the patch at rest, m, body axes.
    pub fn rest(&self) -> Vector3<f64> {
        self.rest
    }

    /// Residual flexibility at the baked stiffness, which the modes leave out: 3x3, m/N, body axes.
    pub fn residual(&self) -> Matrix3<f64> {
        self.residual
    }

    /// Number of modes.
    pub fn modes(&self) -> usize {
        self.rows.0[0].len()
    }

    /// Displacement of the patch from rest at the coordinates `q`, m, body axes.
    pub fn displacement(&self, q: &[f64], warped: bool) -> Vector3<f64> {
        displacement(&self.rows.reduce(q, warped), warped)
    }

    /// Rotation of the patch at the coordinates `q`, from the curl of the displacement. It is exact
    /// for a turn by less than a quarter.
    pub(crate) fn rotation(&self, q: &[f64]) -> Matrix3<f64> {
        Self::rotation_of(&self.rows.reduce(q, true))
    }

    /// The rotation of a patch with these six numbers.
    pub(crate) fn rotation_of(six: &Six) -> Matrix3<f64> {
        // Half the curl of a rotation is its axis times the sine of its angle.
        let sine = Vector3::new(six[3], six[4], six[5]);
        let length = sine.norm();
        if length.is_nan() || length < f64::MIN_POSITIVE {
            return Matrix3::identity();
        }
        let angle = length.min(1.0).asin();
        *nalgebra::Rotation3::from_scaled_axis(sine * (angle / length)).matrix()
    }

    pub(crate) fn rows(&self) -> &MeanRows {
        &self.rows
    }
}

impl MeanRows {
    /// Computes the rows for surface vertices with weights whose sum is 1.
    pub(crate) fn new(model: &ModalModel, entries: &[(u32, f64)], modes: usize) -> Self {
        let mut rows: [Vec<f64>; 6] = std::array::from_fn(|_| vec![0.0; modes]);
        for &(vertex, weight) in entries {
            for axis in 0..3 {
                for (mode, row) in rows[axis].iter_mut().enumerate() {
                    *row += weight * f64::from(model.displacement_row(vertex, axis, mode));
                }
                for (mode, row) in rows[3 + axis].iter_mut().enumerate() {
                    *row += weight * f64::from(model.rotation_row(vertex, axis, mode));
                }
            }
        }
        Self(rows)
    }

    /// The row of one of the six numbers.
    pub(crate) fn of(&self, number: usize) -> &[f64] {
        &self.0[number]
    }

    /// The row of the mean displacement along an axis, one entry per mode.
    pub(crate) fn displacement(&self, axis: usize) -> &[f64] {
        &self.0[axis]
    }

    /// Returns the six sums `B x`. Without warp the rotation has no effect and stays zero.
    pub(crate) fn reduce(&self, x: &[f64], warped: bool) -> Six {
        let [a, b, c, d, e, f] = &self.0;
        let u = dot3([a, b, c], x);
        let w = if warped { dot3([d, e, f], x) } else { [0.0; 3] };
        Six::new(u[0], u[1], u[2], w[0], w[1], w[2])
    }

    /// Computes `out += B^T forces`.
    pub(crate) fn spread(&self, forces: &Six, warped: bool, out: &mut [f64]) {
        let n = out.len();
        let [a, b, c, d, e, f] = self.0.each_ref().map(|r| &r[..n]);
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

    /// Returns `B_self diag(weight) B_other^T`.
    fn gram(&self, other: &Self, weight: &[f64], scratch: &mut Vec<f64>) -> PairGram {
        let mut block = PairGram::zeros();
        for (i, mine) in self.0.iter().enumerate() {
            scratch.clear();
            scratch.extend(mine.iter().zip(weight).map(|(r, w)| r * w));
            for (j, theirs) in other.0.iter().enumerate() {
                block[(i, j)] = dot(scratch, theirs);
            }
        }
        block
    }
}

/// Instantaneous residual flexibility of a patch at the baked stiffness, m/N, body axes.
pub(crate) fn residual(model: &ModalModel, patch: &Patch, modes: usize) -> Result<Matrix3<f64>, StepError> {
    let count = model.surface().positions().len();
    if let Some(&(vertex, _)) = patch.entries().iter().find(|&&(v, _)| v as usize >= count) {
        return Err(StepError::Vertex { vertex, count });
    }
    let residual = model.flexibility_of(patch, modes);
    let residual = Matrix3::from_fn(|i, j| residual[i][j]);
    let floor = Matrix3::identity() * contact_floor(model, patch);
    Ok(0.5 * (residual + residual.transpose()) + floor)
}

/// Compliance of skin and fingertip on a patch: a hundredth of the patch's own contact compliance,
/// m/N. A patch on an anchor has no flexibility, so the force of a hand on it would be infinite.
pub(crate) fn contact_floor(model: &ModalModel, patch: &Patch) -> f64 {
    let info = model.info();
    let radius = patch.radius().max(1e-2 * model.size());
    let contact = 1e-2 * (1.0 - info.poisson * info.poisson) / (2.0 * info.young * radius);
    contact.max(f64::MIN_POSITIVE)
}

/// Returns the displacement of a patch for its six numbers, m, body axes.
pub(crate) fn displacement(six: &Six, warped: bool) -> Vector3<f64> {
    let d = Vector3::new(six[0], six[1], six[2]);
    if warped { crate::warp([six[3], six[4], six[5]], d.into()).into() } else { d }
}

/// Returns the displacement (m) and its derivative with respect to the six numbers.
pub(crate) fn tangent(six: &Six, warped: bool) -> (Vector3<f64>, Tangent) {
    let d = Vector3::new(six[0], six[1], six[2]);
    let mut tangent = Tangent::zeros();
    if !warped {
        tangent.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
        return (d, tangent);
    }
    let (u, by_d, by_w) = warp_with_jacobian(Vector3::new(six[3], six[4], six[5]), d);
    tangent.fixed_view_mut::<3, 3>(0, 0).copy_from(&by_d);
    tangent.fixed_view_mut::<3, 3>(0, 3).copy_from(&by_w);
    (u, tangent)
}

/// [`MeanRows::gram`] of all pairs of held patches (lower triangle), cached while the patches stay.
#[derive(Debug, Clone, Default)]
pub(crate) struct Grams {
    patches: Vec<Arc<HeldPatch>>,
    blocks: Vec<PairGram>,
    scratch: Vec<f64>,
}

impl Grams {
    /// Computes the blocks for the hands' patches unless the cache holds them.
    pub(crate) fn prepare(&mut self, hands: &[Hand], weight: &[f64]) {
        let same = self.patches.len() == hands.len();
        if same && hands.iter().zip(&self.patches).all(|(hand, patch)| Arc::ptr_eq(&hand.patch, patch)) {
            return;
        }
        // The block of two patches does not change if other patches are added or removed.
        let known = |hand: &Hand| self.patches.iter().position(|patch| Arc::ptr_eq(&hand.patch, patch));
        let old: Vec<Option<usize>> = hands.iter().map(known).collect();
        let mut blocks = Vec::with_capacity(hands.len() * (hands.len() + 1) / 2);
        for (i, a) in hands.iter().enumerate() {
            for (j, b) in hands[..=i].iter().enumerate() {
                blocks.push(match (old[i], old[j]) {
                    (Some(x), Some(y)) if x >= y => *self.at(x, y),
                    (Some(x), Some(y)) => self.at(y, x).transpose(),
                    _ => a.patch.rows.gram(&b.patch.rows, weight, &mut self.scratch),
                });
            }
        }
        self.blocks = blocks;
        self.patches.clear();
        self.patches.extend(hands.iter().map(|hand| hand.patch.clone()));
    }

    /// Replaces the displacements' part of the block of two hands. `j` must be at most `i`.
    pub(crate) fn set(&mut self, i: usize, j: usize, block: &Matrix3<f64>) {
        self.blocks[i * (i + 1) / 2 + j].fixed_view_mut::<3, 3>(0, 0).copy_from(block);
    }

    /// Drops all blocks because their weights have changed.
    pub(crate) fn forget(&mut self) {
        self.patches.clear();
        self.blocks.clear();
    }

    /// Returns the block of two hands. `j` must be at most `i`.
    pub(crate) fn at(&self, i: usize, j: usize) -> &PairGram {
        &self.blocks[i * (i + 1) / 2 + j]
    }

    /// Returns `sum over j of block(i, j) forces[j]`.
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
