//! The receiver's modal step: the same recurrence as the host's body, driven by reactions instead of targets.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use pliant_modal::{Coefficients, Integrator, ModalModel, Patch, warp_jacobian};

use crate::StreamError;
use crate::state::{GrabState, ModalState};
use crate::wire::FrameGrab;

/// Share of a patch's static compliance by which the receiver lets it give way. Without any, a held place under an implicit
/// step flips its force every tick; a few per cent end that and cost nothing, since the streamed reaction already carries
/// the load.
const GIVE: f64 = 0.03;

/// Patches remembered at a time; a new one beyond that empties the table.
const PATCHES: usize = 64;

/// How the host steps a body: what a receiver needs to know to do the same.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BodySetup {
    /// The host's integrator. Default: exact.
    pub integrator: Integrator,
    /// Modal warping. Default: on.
    pub warp: bool,
    /// Factor on all damping coefficients. Default: 1.
    pub damping_scale: f64,
}

impl Default for BodySetup {
    fn default() -> Self {
        Self { integrator: Integrator::default(), warp: true, damping_scale: 1.0 }
    }
}

/// Rows of one patch: weighted mean displacement and rotation by mode.
#[derive(Debug, Clone)]
struct PatchModes {
    displacement: Vec<Vector3<f64>>,
    rotation: Vec<Vector3<f64>>,
    /// Derivative of the patch's position by each coordinate at the last linearisation.
    rows: Vec<Vector3<f64>>,
    /// How far the held patch may give way to its measured place, m/N.
    compliance: Matrix3<f64>,
}

impl PatchModes {
    fn new(model: &ModalModel, vertex: u32, radius: f64, modes: usize) -> Result<Self, StreamError> {
        let patch =
            Patch::around(model.surface(), vertex, radius).map_err(|e| StreamError::Model(e.to_string()))?;
        let mut displacement = vec![Vector3::zeros(); modes];
        let mut rotation = vec![Vector3::zeros(); modes];
        for &(v, weight) in patch.entries() {
            for mode in 0..modes {
                for axis in 0..3 {
                    displacement[mode][axis] += weight * f64::from(model.displacement_row(v, axis, mode));
                    rotation[mode][axis] += weight * f64::from(model.rotation_row(v, axis, mode));
                }
            }
        }
        let residual = model.residual_flexibility(&patch, modes);
        let fixed = displacement
            .iter()
            .zip(model.omega())
            .map(|(row, omega)| row.norm_squared() / omega.powi(2).max(1e-12))
            .sum::<f64>();
        let compliance = Matrix3::from_fn(|i, j| 0.5 * (residual[i][j] + residual[j][i]))
            + Matrix3::identity() * (GIVE * fixed / 3.0 + f64::MIN_POSITIVE);
        Ok(Self { rows: displacement.clone(), displacement, rotation, compliance })
    }

    /// Takes the rows at `q`; returns the patch's displacement there.
    fn linearise(&mut self, q: &[f64], warp: bool) -> Vector3<f64> {
        let sum = |columns: &[Vector3<f64>]| {
            columns.iter().zip(q).fold(Vector3::<f64>::zeros(), |s, (c, q)| s + c * *q)
        };
        let d = sum(&self.displacement);
        if !warp {
            return d;
        }
        let w = sum(&self.rotation);
        let (u, by_d, by_w) = warp_jacobian(w.into(), d.into());
        let (by_d, by_w) = (Matrix3::from_fn(|i, j| by_d[i][j]), Matrix3::from_fn(|i, j| by_w[i][j]));
        for ((row, phi), psi) in self.rows.iter_mut().zip(&self.displacement).zip(&self.rotation) {
            *row = by_d * phi + by_w * psi;
        }
        u.into()
    }
}

/// Steps a modal state with given reactions.
#[derive(Debug)]
pub struct ForceStepper {
    model: Arc<ModalModel>,
    coefficients: Vec<Coefficients>,
    warp: bool,
    patches: BTreeMap<(u32, u64), PatchModes>,
    /// Modal force of the last step.
    old: Vec<f64>,
    force: Vec<f64>,
    trial: Vec<f64>,
}

impl ForceStepper {
    /// For the first `modes` of a model at step `h` (s).
    ///
    /// # Errors
    /// [`StreamError::Model`] when the integrator cannot be set up.
    pub fn new(model: Arc<ModalModel>, setup: &BodySetup, modes: usize, h: f64) -> Result<Self, StreamError> {
        let modes = modes.min(model.mode_count());
        let coefficients = model.omega()[..modes]
            .iter()
            .zip(model.damping())
            .map(|(&omega, &c)| Coefficients::new(setup.integrator, omega, c * setup.damping_scale, h))
            .collect::<Result<Vec<_>, _>>()
            .map_err(|e| StreamError::Model(e.to_string()))?;
        Ok(Self {
            model,
            coefficients,
            warp: setup.warp,
            patches: BTreeMap::new(),
            old: vec![0.0; modes],
            force: vec![0.0; modes],
            trial: vec![0.0; modes],
        })
    }

    /// Angular frequency of a mode, rad/s.
    pub(crate) fn omega(&self, mode: usize) -> f64 {
        self.model.omega().get(mode).copied().unwrap_or(1.0)
    }

    /// Number of modes stepped.
    pub fn modes(&self) -> usize {
        self.coefficients.len()
    }

    /// Forgets the force of the last step: after a state was taken over.
    pub fn restart(&mut self) {
        self.old.fill(0.0);
    }

    /// The modal force of the last step, which generalized-alpha carries on.
    pub(crate) fn last_force(&self) -> &[f64] {
        &self.old
    }

    pub(crate) fn set_last_force(&mut self, force: &[f64]) {
        if force.len() == self.old.len() {
            self.old.copy_from_slice(force);
        }
    }

    fn patch(&mut self, vertex: u32, radius: f64) -> Option<&mut PatchModes> {
        let key = (vertex, radius.to_bits());
        if !self.patches.contains_key(&key) {
            let made = PatchModes::new(&self.model, vertex, radius, self.modes()).ok()?;
            if self.patches.len() >= PATCHES {
                self.patches.clear();
            }
            self.patches.insert(key, made);
        }
        self.patches.get_mut(&key)
    }

    /// One step with the reactions, drawn to where the host's patches were.
    ///
    /// ```text
    /// f = load - sum rows^T R^T reaction + sum rows^T correction
    /// (A + C) correction = displacement - (displacement that the step would reach without it)
    /// ```
    ///
    /// The reactions alone are a dead load: a bent body under a load that pushes is unstable (it buckles), although the
    /// same body held in place is not, and a small error would grow. The correction makes the receiver an observer: it is
    /// zero when the state is right, and otherwise draws the patches to their places as a compliant grab does, so errors
    /// die as they would in the held body. The rows are taken where the body's own two Newton rounds take them. A grab
    /// whose vertex the model has not got pulls nothing.
    pub fn step(&mut self, state: &mut ModalState, grabs: &[FrameGrab], rotation: [f64; 4], load: &[f64]) {
        let back = inverse_rotation(rotation);
        let extra = |f: &mut [f64]| {
            for (f, extra) in f.iter_mut().zip(load) {
                *f += extra;
            }
        };
        if grabs.is_empty() {
            self.force.fill(0.0);
            extra(&mut self.force);
        } else {
            let states = || grabs.iter().map(|g| &g.state);
            self.gather(&state.q, states(), &back);
            extra(&mut self.force);
            for round in 0..2 {
                let mut trial = std::mem::take(&mut self.trial);
                for (k, c) in self.coefficients.iter().enumerate() {
                    let old = [state.q[k], state.v[k], state.a[k]];
                    trial[k] = c.step(old, self.old[k], self.force[k])[0];
                }
                if round == 0 && self.warp {
                    self.gather(&trial, states(), &back);
                    extra(&mut self.force);
                    for (k, c) in self.coefficients.iter().enumerate() {
                        let old = [state.q[k], state.v[k], state.a[k]];
                        trial[k] = c.step(old, self.old[k], self.force[k])[0];
                    }
                }
                self.correct(&trial, grabs);
                self.trial = trial;
            }
        }
        for (k, c) in self.coefficients.iter().enumerate() {
            let old = [state.q[k], state.v[k], state.a[k]];
            [state.q[k], state.v[k], state.a[k]] = c.step(old, self.old[k], self.force[k]);
        }
        self.old.copy_from_slice(&self.force);
    }

    /// Adds the correction to the modal forces: what draws the patches from where `trial` has them to their places.
    fn correct(&mut self, trial: &[f64], grabs: &[FrameGrab]) {
        let n = 3 * grabs.len();
        let warp = self.warp;
        let mut gap = nalgebra::DVector::<f64>::zeros(n);
        let mut matrix = nalgebra::DMatrix::<f64>::zeros(n, n);
        let keys: Vec<(u32, u64)> =
            grabs.iter().map(|g| (g.state.vertex, g.state.radius.to_bits())).collect();
        for (i, g) in grabs.iter().enumerate() {
            let Some(patch) = self.patch(g.state.vertex, g.state.radius) else { continue };
            let u = patch.linearise(trial, warp);
            for x in 0..3 {
                gap[3 * i + x] = g.displacement[x] - u[x];
            }
        }
        for (i, key) in keys.iter().enumerate() {
            for (j, other) in keys.iter().enumerate().take(i + 1) {
                let mut block = Matrix3::zeros();
                if let (Some(a), Some(b)) = (self.patches.get(key), self.patches.get(other)) {
                    for ((a, b), c) in a.rows.iter().zip(&b.rows).zip(&self.coefficients) {
                        block += c.response[0] * (a * b.transpose());
                    }
                    if i == j {
                        block += a.compliance;
                    }
                } else if i == j {
                    block = Matrix3::identity();
                }
                for x in 0..3 {
                    for y in 0..3 {
                        matrix[(3 * i + x, 3 * j + y)] = block[(x, y)];
                        matrix[(3 * j + y, 3 * i + x)] = block[(x, y)];
                    }
                }
            }
        }
        let Some(cholesky) = matrix.cholesky() else { return };
        let pull = cholesky.solve(&gap);
        for (i, key) in keys.iter().enumerate() {
            let Some(patch) = self.patches.get(key) else { continue };
            let pull = Vector3::new(pull[3 * i], pull[3 * i + 1], pull[3 * i + 2]);
            for (f, row) in self.force.iter_mut().zip(&patch.rows) {
                *f += row.dot(&pull);
            }
        }
    }

    /// Where a patch is at `q`, as displacement from rest in body axes, m; zero for a vertex that the model has not got.
    pub fn displacement(&mut self, q: &[f64], vertex: u32, radius: f64) -> [f64; 3] {
        let warp = self.warp;
        self.patch(vertex, radius).map_or([0.0; 3], |p| p.linearise(q, warp).into())
    }

    /// Modal forces of the reactions, rows taken at `q`.
    fn gather<'a>(&mut self, q: &[f64], grabs: impl Iterator<Item = &'a GrabState>, back: &Matrix3<f64>) {
        let warp = self.warp;
        let mut force = std::mem::take(&mut self.force);
        force.fill(0.0);
        for g in grabs {
            let Some(patch) = self.patch(g.vertex, g.radius) else { continue };
            patch.linearise(q, warp);
            let pull = -(back * Vector3::from(g.reaction));
            for (f, row) in force.iter_mut().zip(&patch.rows) {
                *f += row.dot(&pull);
            }
        }
        self.force = force;
    }

    /// The modal force per mode that a step from the true state `from` lacks to reach the true state `to`: by least
    /// squares over displacement and velocity, in units of the mode's own amplitude. Steps `from`.
    pub(crate) fn lacking(
        &mut self,
        from: &mut ModalState,
        to: [&[f64]; 2],
        grabs: &[FrameGrab],
        rotation: [f64; 4],
        load: &[f64],
        out: &mut Vec<f64>,
    ) {
        let old = self.old.clone();
        self.step(from, grabs, rotation, load);
        self.old = old;
        out.clear();
        for (k, c) in self.coefficients.iter().enumerate() {
            let weight = 1.0 / self.model.omega()[k].powi(2).max(1e-12);
            let at = |slice: &[f64]| slice.get(k).copied().unwrap_or(0.0);
            let (rq, rv) = (at(to[0]) - from.q[k], at(to[1]) - from.v[k]);
            let (bq, bv) = (c.response[0], c.response[1]);
            let scale = bq * bq + bv * bv * weight;
            out.push(if scale > 0.0 { (bq * rq + bv * rv * weight) / scale } else { 0.0 });
        }
    }

    /// The receiver-side reaction (equation (10) of Tang et al. 2013): the modal force that the shown state implies,
    /// `f = a + c v + omega^2 q`, laid on the grabs' patches by least squares:
    /// `min |f + sum rows^T R^T reaction|^2`. Writes the reactions into `grabs`; those whose rows are dependent share.
    pub fn reactions(&mut self, state: &ModalState, grabs: &mut [GrabState], rotation: [f64; 4]) {
        let n = 3 * grabs.len();
        if n == 0 {
            return;
        }
        let turn = inverse_rotation(rotation).transpose();
        for (k, f) in self.force.iter_mut().enumerate() {
            *f = state.a[k]
                + self.model.damping()[k] * state.v[k]
                + self.model.omega()[k].powi(2) * state.q[k];
        }
        // Modes are weighed by their compliance: stiff ones, whose force is least certain, would drown the others.
        let weight = |model: &ModalModel, k: usize| 1.0 / model.omega()[k].powi(2).max(1e-12);
        let mut columns: Vec<Vec<Vector3<f64>>> = Vec::with_capacity(grabs.len());
        let modes = self.modes();
        let warp = self.warp;
        for g in grabs.iter() {
            match self.patch(g.vertex, g.radius) {
                Some(p) => {
                    p.linearise(&state.q, warp);
                    columns.push(p.rows.clone());
                }
                None => columns.push(vec![Vector3::zeros(); modes]),
            }
        }
        let mut matrix = nalgebra::DMatrix::<f64>::zeros(n, n);
        let mut right = nalgebra::DVector::<f64>::zeros(n);
        for (i, a) in columns.iter().enumerate() {
            for (k, row) in a.iter().enumerate() {
                let w = weight(&self.model, k);
                for x in 0..3 {
                    right[3 * i + x] -= w * row[x] * self.force[k];
                    for (j, b) in columns.iter().enumerate() {
                        for y in 0..3 {
                            matrix[(3 * i + x, 3 * j + y)] += w * row[x] * b[k][y];
                        }
                    }
                }
            }
        }
        let ridge = 1e-9 * matrix.trace() / n as f64 + f64::MIN_POSITIVE;
        for i in 0..n {
            matrix[(i, i)] += ridge;
        }
        let Some(cholesky) = matrix.cholesky() else { return };
        let solved = cholesky.solve(&right);
        for (i, g) in grabs.iter_mut().enumerate() {
            let local = Vector3::new(solved[3 * i], solved[3 * i + 1], solved[3 * i + 2]);
            let world = turn * local;
            if world.iter().all(|x| x.is_finite()) {
                g.reaction = world.into();
            }
        }
    }
}

/// World to body.
fn inverse_rotation([x, y, z, w]: [f64; 4]) -> Matrix3<f64> {
    UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-12)
        .map_or_else(Matrix3::identity, |q| *q.inverse().to_rotation_matrix().matrix())
}
