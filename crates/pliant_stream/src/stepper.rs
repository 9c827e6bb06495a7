//! The receiver's modal step: the same recurrence as the host's body, driven by reactions or by targets.

mod hold;
#[cfg(test)]
mod side_by_side;

use std::sync::Arc;

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use pliant_modal::{Frame, Integrator, ModalModel, Relaxation, RigidMotion};

use crate::StreamError;
use crate::patch_rows::{Grams, PatchRows, Six, Tangent, displaced, key, tangent};
use crate::schur::solve_lower;
use crate::state::{GrabState, ModalState};
use crate::table::Table;
use crate::wire::FrameGrab;

pub(crate) use hold::{By, Hold};

use hold::Creeping;

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
    /// Factor on the material's stiffness; see [`pliant_modal::BodyConfig::stiffness_scale`]. Default: 1.
    pub stiffness_scale: f64,
    /// Uniform acceleration, m/s^2; world axes, for an anchored body its own. What the host's gravity has beyond this is
    /// learnt by the stream. Default: none.
    pub gravity: [f64; 3],
    /// A material that relaxes. Default: none, elastic.
    pub relaxation: Option<Relaxation>,
}

impl Default for BodySetup {
    fn default() -> Self {
        Self {
            integrator: Integrator::default(),
            warp: true,
            damping_scale: 1.0,
            stiffness_scale: 1.0,
            gravity: [0.0; 3],
            relaxation: None,
        }
    }
}

impl BodySetup {
    /// Angular frequencies (rad/s) and damping coefficients (1/s) of the first `modes` of a model, as they are stepped.
    pub(crate) fn modes(&self, model: &ModalModel, modes: usize) -> (Vec<f64>, Vec<f64>) {
        let one = |mode| {
            let (omega, c) = model.stiffened(mode, self.stiffness_scale);
            (omega, c * self.damping_scale)
        };
        (0..modes.min(model.mode_count())).map(one).unzip()
    }
}

/// The rigid frame of a free body in a step, and what pushes it besides gravity and hands (world axes, N and N m).
pub(crate) struct FrameStep<'a> {
    pub(crate) frame: &'a mut Frame,
    pub(crate) force: Vector3<f64>,
    pub(crate) torque: Vector3<f64>,
}

/// One patch in the step under way.
#[derive(Debug, Clone, Default)]
struct Held {
    /// Where the six numbers go without hands.
    free: Six,
    /// The same for their velocities; only where a hand has a damper.
    speed: Six,
    /// Where the tangent was taken.
    from: Six,
    at: Vector3<f64>,
    tangent: Tangent,
    compliance: Matrix3<f64>,
    relaxation: f64,
    /// Where the hand is, as displacement from rest, body axes, m.
    place: Vector3<f64>,
    /// How far the patch gives way in this step because it was pulled before, body axes, m.
    crept: Vector3<f64>,
    velocity: Vector3<f64>,
    /// From the centre of mass, body axes, m.
    arm: Vector3<f64>,
}

/// Steps a modal state with given reactions or targets.
///
/// All Newton rounds of a step work in six numbers a patch, see `patch_rows.rs`; the modes are gone through for the
/// step without hands, for where that brings the patches, and for what the pulls do.
#[derive(Debug)]
pub struct ForceStepper {
    model: Arc<ModalModel>,
    table: Table,
    h: f64,
    warp: bool,
    stiffness_scale: f64,
    /// Of the modes as they are stepped: rad/s, 1/s.
    omega: Vec<f64>,
    damping: Vec<f64>,
    gravity: Vector3<f64>,
    /// Modal force of gravity on an anchored body; empty for none.
    weight: Vec<f64>,
    /// `1 / omega^2`.
    softness: Vec<f64>,
    patches: Vec<PatchRows>,
    holds: Vec<Hold>,
    used: Vec<usize>,
    held: Vec<Held>,
    forces: Vec<Six>,
    by_place: Grams,
    by_speed: Grams,
    by_softness: Grams,
    /// Modal force of the last step.
    old: Vec<f64>,
    force: Vec<f64>,
    free: [Vec<f64>; 4],
    creeping: Creeping,
    more: Vec<f64>,
    gap: Vec<f64>,
    matrix: Vec<f64>,
}

impl ForceStepper {
    /// For the first `modes` of a model at step `h` (s).
    ///
    /// # Errors
    /// [`StreamError::Model`] when the integrator cannot be set up.
    pub fn new(model: Arc<ModalModel>, setup: &BodySetup, modes: usize, h: f64) -> Result<Self, StreamError> {
        let modes = modes.min(model.mode_count());
        let table = Table::new(&model, setup, modes, h)?;
        let gravity = Vector3::from(setup.gravity);
        let weight = if model.is_free() || gravity == Vector3::zeros() {
            Vec::new()
        } else {
            model.participation()[..modes].iter().map(|p| gravity.dot(&Vector3::from(*p))).collect()
        };
        let (omega, damping) = setup.modes(&model, modes);
        let softness = omega.iter().map(|w| 1.0 / w.powi(2).max(1e-12)).collect();
        Ok(Self {
            model,
            table,
            h,
            warp: setup.warp,
            stiffness_scale: setup.stiffness_scale,
            omega,
            damping,
            gravity,
            weight,
            softness,
            patches: Vec::new(),
            holds: Vec::new(),
            used: Vec::new(),
            held: Vec::new(),
            forces: Vec::new(),
            by_place: Grams::default(),
            by_speed: Grams::default(),
            by_softness: Grams::default(),
            old: vec![0.0; modes],
            force: vec![0.0; modes],
            free: std::array::from_fn(|i| if i < 3 { vec![0.0; modes] } else { Vec::new() }),
            creeping: setup.relaxation.map_or(Creeping::default(), |r| Creeping::new(r, h)),
            more: Vec::new(),
            gap: Vec::new(),
            matrix: Vec::new(),
        })
    }

    /// Angular frequency of a mode, rad/s.
    pub(crate) fn omega(&self, mode: usize) -> f64 {
        self.omega.get(mode).copied().unwrap_or(1.0)
    }

    /// Does the body have a rigid frame of its own?
    pub(crate) fn is_free(&self) -> bool {
        self.model.is_free()
    }

    /// Length of a step, s.
    pub(crate) fn h(&self) -> f64 {
        self.h
    }

    /// The body.
    pub(crate) fn model(&self) -> &Arc<ModalModel> {
        &self.model
    }

    /// A state of the body at rest.
    pub(crate) fn at_rest(&self) -> ModalState {
        self.table.rest()
    }

    /// Lets the flow under a hand go on by one step under a pull (body axes, N).
    pub(crate) fn relax(
        &mut self,
        vertex: u32,
        radius: f64,
        flow: Vector3<f64>,
        pull: Vector3<f64>,
    ) -> Vector3<f64> {
        self.make_room(1);
        match self.patch(vertex, radius) {
            Some(index) => self.creeping.step(flow, self.patches[index].compliance * pull),
            None => flow,
        }
    }

    /// Number of modes stepped.
    pub fn modes(&self) -> usize {
        self.table.modes()
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

    /// Index of a patch, made when it is new; `None` for a vertex that the model has not got.
    fn patch(&mut self, vertex: u32, radius: f64) -> Option<usize> {
        let wanted = key(vertex, radius);
        if let Some(index) = self.patches.iter().position(|p| p.key == wanted) {
            return Some(index);
        }
        let made = PatchRows::new(&self.model, vertex, radius, self.modes(), self.stiffness_scale).ok()?;
        self.patches.push(made);
        Some(self.patches.len() - 1)
    }

    /// Keeps the patches' table from growing without bound: called where no index is held.
    fn make_room(&mut self, more: usize) {
        if self.patches.len() + more > PATCHES {
            self.patches.clear();
        }
    }

    /// Is there such a patch on the body?
    pub(crate) fn knows(&mut self, vertex: u32, radius: f64) -> bool {
        self.make_room(1);
        self.patch(vertex, radius).is_some()
    }

    /// Where a patch is at rest, body axes, m.
    pub(crate) fn rest(&mut self, vertex: u32, radius: f64) -> Option<Vector3<f64>> {
        self.make_room(1);
        self.patch(vertex, radius).map(|index| self.patches[index].rest)
    }

    /// One step with the reactions, drawn to where the host's patches were.
    ///
    /// Reaction and place together say where the hand must have been, `place + C pull` with `C` the grab's compliance and
    /// `pull = -R^T reaction`; the step is then the body's own, with its two Newton rounds:
    ///
    /// ```text
    /// f = load + sum rows^T pull,   (A + C) pull = place + C measured pull - (place that the free step reaches)
    /// ```
    ///
    /// The reactions alone would be a dead load: a bent body under a load that pushes is unstable (it buckles), although
    /// the same body held in place is not, and a small error would grow. This way the receiver is an observer: the
    /// pull is the measured one when the state is right, and otherwise draws the patches to their places as the grab does,
    /// so errors die as they would in the held body. A grab whose vertex the model has not got pulls nothing.
    pub fn step(&mut self, state: &mut ModalState, grabs: &[FrameGrab], rotation: [f64; 4], load: &[f64]) {
        let back = inverse_rotation(rotation);
        let mut holds = std::mem::take(&mut self.holds);
        holds.clear();
        holds.extend(grabs.iter().map(|g| Hold::measured(g, &back)));
        self.step_held(state, &mut holds, load, None);
        self.holds = holds;
    }

    /// One step with patches held in any way, and of the frame where there is one; writes the pulls that acted. Holds of
    /// patches that the model has not got are dropped.
    pub(crate) fn step_held(
        &mut self,
        state: &mut ModalState,
        holds: &mut Vec<Hold>,
        load: &[f64],
        frame: Option<FrameStep<'_>>,
    ) {
        self.make_room(holds.len());
        let mut used = std::mem::take(&mut self.used);
        used.clear();
        holds.retain(|h| match self.patch(h.vertex, h.radius) {
            Some(index) => {
                used.push(index);
                true
            }
            None => false,
        });
        self.used = used;

        // The step without hands.
        self.table.step(state, &self.old, &mut self.free);
        self.force.fill(0.0);
        for given in [load, &self.weight] {
            for (f, given) in self.force.iter_mut().zip(given) {
                *f += given;
            }
        }
        if !self.weight.is_empty() || load.iter().any(|x| *x != 0.0) {
            self.table.press(&self.force, &mut self.free);
        }
        let mut frame = frame;
        let mut rigid = frame
            .as_mut()
            .map(|f| RigidMotion::predict(f.frame, &self.model, self.h, self.gravity, f.force, f.torque));
        if !holds.is_empty() {
            let placed = frame.as_ref().map(|f| &*f.frame);
            self.place(&state.q, holds, placed);
            let rounds = if self.warp { 2 } else { 1 };
            for round in 0..rounds {
                // Both of the body's rounds are implicit. Were the first one a dead load, a bent body would buckle under
                // it, and the rows of the second round would be taken at the wrong place: the error then grows.
                self.solve(holds, placed, rigid.as_mut());
                if round + 1 < rounds {
                    for (i, held) in self.held.iter_mut().enumerate() {
                        held.from = held.free + self.by_place.answer(i, &self.forces);
                    }
                }
            }
            self.pull();
            if self.creeping.ratio > 0.0 {
                for (h, &index) in holds.iter_mut().zip(&self.used) {
                    h.flow = self.creeping.step(h.flow, self.patches[index].compliance * h.pull);
                }
            }
            if let (Some(f), Some(rigid)) = (&mut frame, &rigid) {
                let turn = *f.frame.rotation().to_rotation_matrix().matrix();
                let (mut force, mut torque) = (Vector3::zeros(), Vector3::zeros());
                for (h, held) in holds.iter_mut().zip(&self.held) {
                    torque += turn * held.arm.cross(&h.pull);
                    h.pull = turn * h.pull;
                    force += h.pull;
                }
                rigid.apply(f.frame, &self.model, force, torque);
            }
        }
        let [q, v, a, z] = &self.free;
        state.q.copy_from_slice(q);
        state.v.copy_from_slice(v);
        state.a.copy_from_slice(a);
        if state.z.len() == z.len() {
            state.z.copy_from_slice(z);
        }
        self.old.copy_from_slice(&self.force);
    }

    /// Where the hands are and where the patches go without them.
    fn place(&mut self, q: &[f64], holds: &[Hold], frame: Option<&Frame>) {
        self.by_place.prepare(&self.patches, &self.used, &self.table.response[0]);
        let damped = holds.iter().any(|h| matches!(h.by, By::Hand { config, .. } if config.relaxation > 0.0));
        if damped {
            self.by_speed.prepare(&self.patches, &self.used, &self.table.response[1]);
        }
        let center = Vector3::from(self.model.center_of_mass());
        self.held.clear();
        for (h, &index) in holds.iter().zip(&self.used) {
            let patch = &self.patches[index];
            let mut held = Held {
                free: patch.reduce(&self.free[0], self.warp),
                from: patch.reduce(q, self.warp),
                compliance: patch.compliance * self.creeping.at_once,
                ..Held::default()
            };
            match h.by {
                By::Measured(place) => {
                    // Where the hand must have been: a grab that pulls so from there leaves the patch where it was.
                    held.place = place + held.compliance * h.pull;
                }
                By::Hand { target, velocity, config } => {
                    let back = frame.map(|f| f.rotation().inverse());
                    let local = match (frame, back) {
                        (Some(f), Some(back)) => back * (target - f.to_world(center)) + center,
                        _ => target,
                    };
                    held.place = local - patch.rest;
                    held.crept = self.creeping.ratio * self.creeping.carry * h.flow;
                    held.compliance += Matrix3::identity() * config.stiffness.map_or(0.0, |k| 1.0 / k);
                    held.relaxation = config.relaxation;
                    if config.relaxation > 0.0 {
                        held.speed = patch.reduce(&self.free[1], self.warp);
                        held.velocity = back.map_or(velocity, |back| back * velocity);
                    }
                }
            }
            self.held.push(held);
        }
    }

    /// One Newton round: the pulls on the tangent taken at `from`.
    fn solve(&mut self, holds: &mut [Hold], frame: Option<&Frame>, mut rigid: Option<&mut RigidMotion>) {
        let n = 3 * holds.len();
        let reach = self.model.size();
        let center = Vector3::from(self.model.center_of_mass());
        self.gap.clear();
        self.matrix.clear();
        self.matrix.resize(n * n, 0.0);
        for (h, (held, &index)) in holds.iter().zip(self.held.iter_mut().zip(&self.used)) {
            (held.at, held.tangent) = tangent(&held.from, self.warp);
            let ahead = held.at + held.tangent * (held.free - held.from);
            let rest = self.patches[index].rest;
            held.arm = rest + held.at - center;
            let mut gap = held.place - ahead - held.crept;
            if held.relaxation > 0.0 {
                let mut speed = held.tangent * held.speed;
                if let Some(f) = frame {
                    speed += f.rotation().inverse() * f.velocity_at(&self.model, rest + ahead);
                }
                gap += held.relaxation * (held.velocity - speed);
            }
            // A hand that is a body's length away pulls no harder than from there: targets may teleport.
            let distance = gap.norm();
            if distance > reach && matches!(h.by, By::Hand { .. }) {
                gap *= reach / distance;
            }
            self.gap.extend(gap.iter());
        }
        if let Some(rigid) = &mut rigid {
            // The pulls of the round before; none in the first.
            let pulls = self.held.iter().zip(holds.iter()).map(|(held, h)| (held.arm, h.pull));
            rigid.tighten(&self.model, pulls);
        }
        for i in 0..holds.len() {
            for j in 0..=i {
                let (a, b) = (&self.held[i], &self.held[j]);
                let mut block = a.tangent * self.by_place.at(i, j) * b.tangent.transpose();
                let relaxation = a.relaxation.max(b.relaxation);
                if relaxation > 0.0 {
                    block += relaxation * (a.tangent * self.by_speed.at(i, j) * b.tangent.transpose());
                }
                if let Some(rigid) = &rigid {
                    block += rigid.response(&a.arm, &b.arm, relaxation);
                }
                if i == j {
                    block += a.compliance;
                }
                for x in 0..3 {
                    for y in 0..3 {
                        self.matrix[(3 * i + x) * n + 3 * j + y] = block[(x, y)];
                    }
                }
            }
        }
        if solve_lower(&mut self.matrix, &mut self.gap) {
            for (h, pull) in holds.iter_mut().zip(self.gap.chunks_exact(3)) {
                h.pull = Vector3::new(pull[0], pull[1], pull[2]);
            }
        } else {
            holds.iter_mut().for_each(|h| h.pull = Vector3::zeros());
        }
        self.forces.clear();
        self.forces.extend(holds.iter().zip(&self.held).map(|(h, held)| held.tangent.tr_mul(&h.pull)));
    }

    /// Adds what the pulls do to the free step, and to the modal forces.
    fn pull(&mut self) {
        let mut more = std::mem::take(&mut self.more);
        more.clear();
        more.resize(self.force.len(), 0.0);
        for (forces, &index) in self.forces.iter().zip(&self.used) {
            self.patches[index].spread(forces, self.warp, &mut more);
        }
        self.table.press(&more, &mut self.free);
        for (f, more) in self.force.iter_mut().zip(&more) {
            *f += more;
        }
        self.more = more;
    }

    /// Where a patch is at `q`, as displacement from rest in body axes, m; zero for a vertex that the model has not got.
    pub fn displacement(&mut self, q: &[f64], vertex: u32, radius: f64) -> [f64; 3] {
        self.make_room(1);
        let warp = self.warp;
        match self.patch(vertex, radius) {
            Some(index) => displaced(&self.patches[index].reduce(q, warp), warp).into(),
            None => [0.0; 3],
        }
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
        out.clone_from(&self.old);
        self.step(from, grabs, rotation, load);
        self.old.copy_from_slice(out);
        out.clear();
        let [by_q, by_v, _] = &self.table.response;
        for (k, weight) in self.softness.iter().enumerate() {
            let at = |slice: &[f64]| slice.get(k).copied().unwrap_or(0.0);
            let (rq, rv) = (at(to[0]) - from.q[k], at(to[1]) - from.v[k]);
            let (bq, bv) = (by_q[k], by_v[k]);
            let scale = bq * bq + bv * bv * weight;
            out.push(if scale > 0.0 { (bq * rq + bv * rv * weight) / scale } else { 0.0 });
        }
    }

    /// The receiver-side reaction (equation (10) of Tang et al. 2013): the modal force that the shown state implies,
    /// `f = a + c v + omega^2 (q - ratio z)`, laid on the grabs' patches by least squares:
    /// `min |f + sum rows^T R^T reaction|^2`. Writes the reactions into `grabs`; those whose rows are dependent share.
    pub fn reactions(&mut self, state: &ModalState, grabs: &mut [GrabState], rotation: [f64; 4]) {
        if grabs.is_empty() {
            return;
        }
        self.make_room(grabs.len());
        let mut used = std::mem::take(&mut self.used);
        used.clear();
        let mut known = Vec::with_capacity(grabs.len());
        for (i, g) in grabs.iter().enumerate() {
            if let Some(index) = self.patch(g.vertex, g.radius) {
                used.push(index);
                known.push(i);
            }
        }
        self.used = used;
        // Modes are weighed by their compliance: stiff ones, whose force is least certain, would drown the others.
        self.by_softness.prepare(&self.patches, &self.used, &self.softness);
        let (omega, damping) = (&self.omega, &self.damping);
        for (k, f) in self.force.iter_mut().enumerate() {
            let gravity = self.weight.get(k).copied().unwrap_or(0.0);
            let stretch = state.q[k] - self.creeping.ratio * state.z.get(k).copied().unwrap_or(0.0);
            let all = state.a[k] + damping[k] * state.v[k] + omega[k] * omega[k] * stretch;
            *f = (all - gravity) * self.softness[k];
        }
        let n = 3 * known.len();
        let mut tangents: Vec<Tangent> = Vec::with_capacity(known.len());
        let mut right = Vec::with_capacity(n);
        for &index in &self.used {
            let patch = &self.patches[index];
            let (_, t) = tangent(&patch.reduce(&state.q, self.warp), self.warp);
            let along = t * patch.reduce(&self.force, self.warp);
            right.extend(along.iter().map(|x| -x));
            tangents.push(t);
        }
        self.matrix.clear();
        self.matrix.resize(n * n, 0.0);
        let mut trace = 0.0;
        for i in 0..known.len() {
            for j in 0..=i {
                let block = tangents[i] * self.by_softness.at(i, j) * tangents[j].transpose();
                for x in 0..3 {
                    for y in 0..3 {
                        self.matrix[(3 * i + x) * n + 3 * j + y] = block[(x, y)];
                    }
                }
                trace += if i == j { block.trace() } else { 0.0 };
            }
        }
        let ridge = 1e-9 * trace / n.max(1) as f64 + f64::MIN_POSITIVE;
        for i in 0..n {
            self.matrix[i * n + i] += ridge;
        }
        if !solve_lower(&mut self.matrix, &mut right) {
            return;
        }
        let turn = inverse_rotation(rotation).transpose();
        for (&i, r) in known.iter().zip(right.chunks_exact(3)) {
            grabs[i].reaction = (turn * Vector3::new(r[0], r[1], r[2])).into();
        }
    }
}

/// World to body.
pub(crate) fn inverse_rotation([x, y, z, w]: [f64; 4]) -> Matrix3<f64> {
    UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-12)
        .map_or_else(Matrix3::identity, |q| *q.inverse().to_rotation_matrix().matrix())
}
