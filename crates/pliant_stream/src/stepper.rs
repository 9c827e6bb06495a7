//! The receiver's modal step: the same recurrence as the host's body, driven by reactions instead of targets.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use pliant_modal::{Coefficients, Integrator, ModalModel};

use crate::StreamError;
use crate::patch_rows::{PatchRows, Rows, dot, spread};
use crate::state::{GrabState, ModalState};
use crate::wire::FrameGrab;

/// Patches remembered at a time; a new one beyond that empties the table.
const PATCHES: usize = 256;

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

/// How a patch is held in one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Hold {
    pub(crate) vertex: u32,
    pub(crate) radius: f64,
    /// Force on the body: known, or where to begin looking; body axes, N.
    pub(crate) pull: Vector3<f64>,
    /// Where the patch is to be, as displacement from rest in body axes, m.
    pub(crate) place: Vector3<f64>,
    /// `place` is a hand's target and the pull follows from the grab's compliance; else `place` was measured, and `pull`
    /// with it.
    pub(crate) target: bool,
    /// Compliance of the hand's own spring, in series with the patch's, m/N.
    pub(crate) hand: f64,
}

/// Steps a modal state with given reactions.
#[derive(Debug)]
pub struct ForceStepper {
    model: Arc<ModalModel>,
    coefficients: Vec<Coefficients>,
    warp: bool,
    patches: BTreeMap<(u32, u64), PatchRows>,
    holds: Vec<Hold>,
    /// Modal force of the last step.
    old: Vec<f64>,
    force: Vec<f64>,
    free: [Vec<f64>; 3],
    trial: Vec<f64>,
    ahead: Vec<f64>,
    gap: Vec<f64>,
    matrix: Vec<f64>,
    scaled: Rows,
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
            holds: Vec::new(),
            old: vec![0.0; modes],
            force: vec![0.0; modes],
            free: std::array::from_fn(|_| vec![0.0; modes]),
            trial: vec![0.0; modes],
            ahead: Vec::new(),
            gap: Vec::new(),
            matrix: Vec::new(),
            scaled: std::array::from_fn(|_| vec![0.0; modes]),
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

    fn patch(&mut self, vertex: u32, radius: f64) -> Option<&mut PatchRows> {
        let (modes, model) = (self.modes(), self.model.clone());
        self.patch_of(&model, vertex, radius, modes)
    }

    fn patch_of(
        &mut self,
        model: &Arc<ModalModel>,
        vertex: u32,
        radius: f64,
        modes: usize,
    ) -> Option<&mut PatchRows> {
        let key = key(vertex, radius);
        if !self.patches.contains_key(&key) {
            let made = PatchRows::new(model, vertex, radius, modes).ok()?;
            if self.patches.len() >= PATCHES {
                self.patches.clear();
            }
            self.patches.insert(key, made);
        }
        self.patches.get_mut(&key)
    }

    /// Where a patch is at rest, body axes, m.
    pub(crate) fn rest(&mut self, vertex: u32, radius: f64) -> Option<Vector3<f64>> {
        self.patch(vertex, radius).map(|p| p.rest)
    }

    /// One step with the reactions, drawn to where the host's patches were.
    ///
    /// Reaction and place together say where the hand must have been, `place + C pull` with `C` the grab's compliance and
    /// `pull = -R^T reaction`; the step is then the body's own, with its two Newton rounds:
    ///
    /// ```text
    /// f = load + sum rows^T pull,   (A + C) correction = place + C pull_0 - (place that pull reaches) - C pull
    /// ```
    ///
    /// The reactions alone would be a dead load: a bent body under a load that pushes is unstable (it buckles), although
    /// the same body held in place is not, and a small error would grow. This way the receiver is an observer: the
    /// correction is zero when the state is right, and otherwise draws the patches to their places as the grab does, so
    /// errors die as they would in the held body. A grab whose vertex the model has not got pulls nothing.
    pub fn step(&mut self, state: &mut ModalState, grabs: &[FrameGrab], rotation: [f64; 4], load: &[f64]) {
        let back = inverse_rotation(rotation);
        let mut holds = std::mem::take(&mut self.holds);
        holds.clear();
        holds.extend(grabs.iter().map(|g| Hold::measured(g, &back)));
        self.step_held(state, &mut holds, load);
        self.holds = holds;
    }

    /// One step with patches held in any way; writes the pulls that acted (body axes, N).
    pub(crate) fn step_held(&mut self, state: &mut ModalState, holds: &mut Vec<Hold>, load: &[f64]) {
        let old = |k: usize| [state.q[k], state.v[k], state.a[k]];
        for (k, c) in self.coefficients.iter().enumerate() {
            let [q, v, a] = c.step(old(k), self.old[k], 0.0);
            (self.free[0][k], self.free[1][k], self.free[2][k]) = (q, v, a);
        }
        let (modes, model) = (self.modes(), self.model.clone());
        if self.patches.len() + holds.len() > PATCHES {
            self.patches.clear();
        }
        holds.retain(|h| self.patch_of(&model, h.vertex, h.radius, modes).is_some());
        for h in holds.iter_mut().filter(|h| !h.target) {
            // Where the hand must have been: a grab that pulls so from there leaves the patch where it was measured.
            if let Some(patch) = self.patches.get(&key(h.vertex, h.radius)) {
                h.place += patch.compliance * h.pull;
                h.target = true;
            }
        }
        self.press(&state.q, holds, load);
        if !holds.is_empty() {
            // Both of the body's rounds are implicit. Were the first one a dead load, a bent body would buckle under it,
            // and the rows of the second round would be taken at the wrong place: the error then grows without bound.
            self.correct(&state.q, holds);
            let mut trial = std::mem::take(&mut self.trial);
            self.reach(&mut trial);
            self.press(&trial, holds, load);
            self.correct(&trial, holds);
            self.trial = trial;
        }
        for (k, c) in self.coefficients.iter().enumerate() {
            let f = self.force[k];
            state.q[k] = self.free[0][k] + c.response[0] * f;
            state.v[k] = self.free[1][k] + c.response[1] * f;
            state.a[k] = self.free[2][k] + c.response[2] * f;
        }
        self.old.copy_from_slice(&self.force);
    }

    /// The coordinates that the step reaches with the present forces.
    fn reach(&self, q: &mut Vec<f64>) {
        q.clear();
        q.extend(
            self.free[0]
                .iter()
                .zip(&self.coefficients)
                .zip(&self.force)
                .map(|((free, c), f)| free + c.response[0] * f),
        );
    }

    /// Sets the modal forces: load and pulls, the rows taken at `q`.
    fn press(&mut self, q: &[f64], holds: &[Hold], load: &[f64]) {
        self.force.fill(0.0);
        for (f, load) in self.force.iter_mut().zip(load) {
            *f = *load;
        }
        for h in holds {
            let Some(patch) = self.patches.get_mut(&key(h.vertex, h.radius)) else { continue };
            patch.linearise(q, self.warp);
            spread(&patch.rows, &h.pull, &mut self.force);
        }
    }

    /// Adds to the modal forces what draws the patches to their places, on the tangent taken at `from`; see
    /// [`ForceStepper::step`]. `(A + C) correction = place - reached - C pull`.
    fn correct(&mut self, from: &[f64], holds: &mut [Hold]) {
        let n = 3 * holds.len();
        let mut ahead = std::mem::take(&mut self.ahead);
        ahead.clear();
        ahead.extend(
            self.free[0]
                .iter()
                .zip(&self.coefficients)
                .zip(&self.force)
                .zip(from)
                .map(|(((free, c), f), from)| free + c.response[0] * f - from),
        );
        let (mut gap, mut matrix) = (std::mem::take(&mut self.gap), std::mem::take(&mut self.matrix));
        gap.clear();
        gap.resize(n, 0.0);
        matrix.clear();
        matrix.resize(n * n, 0.0);
        for (i, h) in holds.iter().enumerate() {
            let Some(a) = self.patches.get(&key(h.vertex, h.radius)) else { continue };
            let reached = a.at + dot(&a.rows, &ahead);
            let softness = a.compliance + Matrix3::identity() * h.hand;
            let missing = h.place - reached - softness * h.pull;
            for (scaled, row) in self.scaled.iter_mut().zip(&a.rows) {
                for ((s, r), c) in scaled.iter_mut().zip(row).zip(&self.coefficients) {
                    *s = r * c.response[0];
                }
            }
            for (j, other) in holds.iter().enumerate().take(i + 1) {
                let Some(b) = self.patches.get(&key(other.vertex, other.radius)) else { continue };
                let columns = [0, 1, 2].map(|y| dot(&self.scaled, &b.rows[y]));
                for (y, column) in columns.iter().enumerate() {
                    for x in 0..3 {
                        let soft = if i == j { softness[(x, y)] } else { 0.0 };
                        matrix[(3 * i + x) * n + 3 * j + y] = column[x] + soft;
                    }
                }
            }
            for x in 0..3 {
                gap[3 * i + x] = missing[x];
            }
        }
        self.ahead = ahead;
        // A patch without any compliance in some direction gets no correction there.
        let solved = solve_lower(&mut matrix, &mut gap);
        let pulls = &gap;
        let holds = if solved { holds } else { &mut [] };
        for (i, h) in holds.iter_mut().enumerate() {
            let more = Vector3::new(pulls[3 * i], pulls[3 * i + 1], pulls[3 * i + 2]);
            if let Some(patch) = self.patches.get(&key(h.vertex, h.radius)) {
                spread(&patch.rows, &more, &mut self.force);
                h.pull += more;
            }
        }
        self.gap = gap;
        self.matrix = matrix;
    }

    /// Where a patch is at `q`, as displacement from rest in body axes, m; zero for a vertex that the model has not got.
    pub fn displacement(&mut self, q: &[f64], vertex: u32, radius: f64) -> [f64; 3] {
        let warp = self.warp;
        self.patch(vertex, radius).map_or([0.0; 3], |p| p.displaced(q, warp).into())
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
        let weight: Vec<f64> =
            self.model.omega()[..self.modes()].iter().map(|w| 1.0 / w.powi(2).max(1e-12)).collect();
        let mut columns: Vec<Rows> = Vec::with_capacity(grabs.len());
        let (modes, warp) = (self.modes(), self.warp);
        for g in grabs.iter() {
            match self.patch(g.vertex, g.radius) {
                Some(p) => {
                    p.linearise(&state.q, warp);
                    columns.push(p.rows.clone());
                }
                None => columns.push(std::array::from_fn(|_| vec![0.0; modes])),
            }
        }
        let mut matrix = nalgebra::DMatrix::<f64>::zeros(n, n);
        let mut right = nalgebra::DVector::<f64>::zeros(n);
        for (i, a) in columns.iter().enumerate() {
            let weighed: Rows =
                std::array::from_fn(|x| a[x].iter().zip(&weight).map(|(r, w)| r * w).collect());
            let along = dot(&weighed, &self.force);
            for x in 0..3 {
                right[3 * i + x] = -along[x];
            }
            for (j, b) in columns.iter().enumerate() {
                for y in 0..3 {
                    let column = dot(&weighed, &b[y]);
                    for x in 0..3 {
                        matrix[(3 * i + x, 3 * j + y)] = column[x];
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

impl Hold {
    /// A grab as the stream tells of it.
    pub(crate) fn measured(g: &FrameGrab, back: &Matrix3<f64>) -> Self {
        Self {
            vertex: g.state.vertex,
            radius: g.state.radius,
            pull: -(back * Vector3::from(g.state.reaction)),
            place: g.displacement.into(),
            target: false,
            hand: 0.0,
        }
    }
}

/// Solves `M x = b` for a symmetric positive definite `M`, given by its lower triangle row by row, in place. False when it
/// is not positive definite.
fn solve_lower(m: &mut [f64], x: &mut [f64]) -> bool {
    let n = x.len();
    for j in 0..n {
        let (above, rest) = m.split_at_mut(j * n);
        let row = &mut rest[..n];
        for k in 0..j {
            let other = &above[k * n..k * n + k];
            let sum: f64 = row[..k].iter().zip(other).map(|(a, b)| a * b).sum();
            row[k] = (row[k] - sum) / above[k * n + k];
        }
        let square: f64 = row[..j].iter().map(|a| a * a).sum();
        let pivot = row[j] - square;
        if pivot.is_nan() || pivot <= 0.0 {
            return false;
        }
        row[j] = pivot.sqrt();
        let sum: f64 = row[..j].iter().zip(x.iter()).map(|(a, b)| a * b).sum();
        x[j] = (x[j] - sum) / row[j];
    }
    for j in (0..n).rev() {
        let sum: f64 = (j + 1..n).map(|k| m[k * n + j] * x[k]).sum();
        x[j] = (x[j] - sum) / m[j * n + j];
    }
    true
}

fn key(vertex: u32, radius: f64) -> (u32, u64) {
    (vertex, radius.to_bits())
}

/// World to body.
pub(crate) fn inverse_rotation([x, y, z, w]: [f64; 4]) -> Matrix3<f64> {
    UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-12)
        .map_or_else(Matrix3::identity, |q| *q.inverse().to_rotation_matrix().matrix())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solves_positive_definite_systems_and_says_when_not() {
        // M = [[4, 2, 0], [2, 5, 3], [0, 3, 6]], x = (1, -2, 3): M x = (0, 1, 12).
        let mut m = [4.0, 0.0, 0.0, 2.0, 5.0, 0.0, 0.0, 3.0, 6.0];
        let mut x = [0.0, 1.0, 12.0];
        assert!(solve_lower(&mut m, &mut x));
        for (got, want) in x.iter().zip([1.0, -2.0, 3.0]) {
            assert!((got - want).abs() < 1e-14, "{x:?}");
        }
        assert!(!solve_lower(&mut [1.0, 0.0, 2.0, 1.0], &mut [1.0, 1.0]), "indefinite");
        assert!(!solve_lower(&mut [f64::NAN], &mut [1.0]));
        assert!(solve_lower(&mut [], &mut []));
    }
}
