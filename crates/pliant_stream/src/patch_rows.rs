//! One patch of a body as the receiver's step needs it: rows over the modes, kept axis by axis so that loops vectorise.

use nalgebra::{Matrix3, Vector3};
use pliant_modal::{Body, BodyConfig, GrabConfig, ModalModel, Patch, warp, warp_jacobian};
use std::sync::Arc;

use crate::StreamError;

/// Three values a mode, axis by axis.
pub(crate) type Rows = [Vec<f64>; 3];

/// `sum over modes of rows[axis][mode] x[mode]`. Four running sums: fixed order, so equal on all machines, and wide.
pub(crate) fn dot(rows: &Rows, x: &[f64]) -> Vector3<f64> {
    let one = |row: &[f64]| {
        let mut sums = [0.0; 4];
        let (mut a, mut b) = (row.chunks_exact(4), x.chunks_exact(4));
        for (a, b) in a.by_ref().zip(b.by_ref()) {
            for k in 0..4 {
                sums[k] += a[k] * b[k];
            }
        }
        let rest: f64 = a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum();
        (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
    };
    Vector3::new(one(&rows[0]), one(&rows[1]), one(&rows[2]))
}

/// `out[mode] += sum over axes of rows[axis][mode] pull[axis]`.
pub(crate) fn spread(rows: &Rows, pull: &Vector3<f64>, out: &mut [f64]) {
    let [x, y, z] = rows;
    for (((f, x), y), z) in out.iter_mut().zip(x).zip(y).zip(z) {
        *f += x * pull.x + y * pull.y + z * pull.z;
    }
}

/// Weighted mean of a patch's modes.
#[derive(Debug, Clone)]
pub(crate) struct PatchRows {
    displacement: Rows,
    rotation: Rows,
    /// Derivative of the patch's place by each coordinate at the last linearisation.
    pub(crate) rows: Rows,
    /// The patch's displacement at the last linearisation, body axes, m.
    pub(crate) at: Vector3<f64>,
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
    ) -> Result<Self, StreamError> {
        let failed = |e: String| StreamError::Model(e);
        let patch = Patch::around(model.surface(), vertex, radius).map_err(|e| failed(e.to_string()))?;
        let zero = || [vec![0.0; modes], vec![0.0; modes], vec![0.0; modes]];
        let (mut displacement, mut rotation, mut rest) = (zero(), zero(), Vector3::zeros());
        for &(v, weight) in patch.entries() {
            let place = model.surface().positions().get(v as usize).copied().unwrap_or_default();
            rest += weight * Vector3::from(place.map(f64::from));
            for axis in 0..3 {
                for mode in 0..modes {
                    displacement[axis][mode] += weight * f64::from(model.displacement_row(v, axis, mode));
                    rotation[axis][mode] += weight * f64::from(model.rotation_row(v, axis, mode));
                }
            }
        }
        // What a grab of the body itself would have: asked of a body, so that the two never differ.
        let config = BodyConfig { modes: Some(modes), ..Default::default() };
        let mut body = Body::new(model.clone(), config).map_err(|e| failed(e.to_string()))?;
        let grab = body.grab(&patch, GrabConfig::default()).map_err(|e| failed(e.to_string()))?;
        let compliance = body.compliance(grab).map_err(|e| failed(e.to_string()))?;
        let compliance = Matrix3::from_fn(|i, j| compliance[i][j]);
        let rows = displacement.clone();
        Ok(Self { displacement, rotation, rows, at: Vector3::zeros(), rest, compliance })
    }

    /// The patch's displacement at `q`, body axes, m.
    pub(crate) fn displaced(&self, q: &[f64], warped: bool) -> Vector3<f64> {
        let d = dot(&self.displacement, q);
        if warped { warp(dot(&self.rotation, q).into(), d.into()).into() } else { d }
    }

    /// Takes displacement and rows at `q`.
    pub(crate) fn linearise(&mut self, q: &[f64], warped: bool) {
        let d = dot(&self.displacement, q);
        if !warped {
            self.at = d;
            return;
        }
        let w = dot(&self.rotation, q);
        let (u, by_d, by_w) = warp_jacobian(w.into(), d.into());
        self.at = u.into();
        let [px, py, pz] = &self.displacement;
        let [sx, sy, sz] = &self.rotation;
        for ((row, d), w) in self.rows.iter_mut().zip(by_d).zip(by_w) {
            for (k, r) in row.iter_mut().enumerate() {
                *r = d[0] * px[k] + d[1] * py[k] + d[2] * pz[k] + w[0] * sx[k] + w[1] * sy[k] + w[2] * sz[k];
            }
        }
    }
}
