//! A body in motion: its modal coordinates, its frame, its grabs, and one step of all of them.

mod advance;
mod frame;
mod grab;
mod solve;
mod stepping;

use std::sync::Arc;

use nalgebra::Vector3;

pub use frame::{Frame, RigidMotion};
pub use grab::{GrabConfig, GrabId};

use crate::{
    Coefficients, Flow, Integrator, ModalModel, Patch, Precision, Relaxation, StepError, error::finite,
    warp::warp_with_jacobian,
};
use grab::Grab;
use solve::Schur;
use stepping::Stepping;

/// How a body is stepped.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyConfig {
    /// Seconds a step. Default: 1/60.
    pub step: f64,
    /// Default: [`Integrator::Exact`].
    pub integrator: Integrator,
    /// Bend by modal warping; off, displacements stay linear and grow when the body turns. Default: `true`.
    pub warp: bool,
    /// Keep only the first so many modes; `None` keeps all. Modes are ordered, so this is the level of detail. Default: `None`.
    pub modes: Option<usize>,
    /// Uniform acceleration, m/s^2, world axes. Default: none.
    pub gravity: [f64; 3],
    /// Factor on all damping coefficients, 0 or more. Default: 1.
    pub damping_scale: f64,
    /// Factor on the material's stiffness, 1e-6 to 1e6: the body as it would be with Young's modulus so many times the baked one. Frequencies go
    /// with its root, compliances with its inverse, what the grabs' patches give way by too; damping as
    /// [`ModalModel::stiffened`] says. Default: 1.
    pub stiffness_scale: f64,
    /// A material that relaxes: every mode, and the flexibility under every grab, is a standard linear solid. Default: none, elastic.
    pub relaxation: Option<Relaxation>,
    /// Newton corrections of the grabs under warp in one step, 1 to 8. Default: 2.
    pub corrections: usize,
    /// What [`Body::reconstruct`] reads. Steps, grabs and forces are in double precision either way. Default: [`Precision::Single`].
    pub precision: Precision,
}

impl Default for BodyConfig {
    fn default() -> Self {
        Self {
            step: 1.0 / 60.0,
            integrator: Integrator::default(),
            warp: true,
            modes: None,
            gravity: [0.0; 3],
            damping_scale: 1.0,
            stiffness_scale: 1.0,
            relaxation: None,
            corrections: 2,
            precision: Precision::default(),
        }
    }
}

/// What moves: the modal coordinates of one tick. All slices have one entry a kept mode, `z` none where the body does not relax.
#[derive(Debug, PartialEq, Default)]
pub struct State {
    /// Modal coordinates, kg^1/2 m.
    pub q: Vec<f64>,
    /// Modal velocities, kg^1/2 m/s.
    pub v: Vec<f64>,
    /// Modal accelerations as the integrator defines them, kg^1/2 m/s^2.
    pub a: Vec<f64>,
    /// Modal forces of the last step, kg^1/2 m/s^2 (generalized-alpha remembers them).
    pub f: Vec<f64>,
    /// Modal flows, kg^1/2 m: how far the dashpot of each mode's Maxwell branch has gone; see [`Relaxation`]. Empty without one.
    pub z: Vec<f64>,
    /// Where the body is.
    pub frame: Frame,
}

impl State {
    /// Beyond this, kg^1/2 m and its like, squares of coordinates and velocities may overflow in a step.
    const MOST: f64 = 1e100;

    /// Whether coordinates, velocities and forces are such that a step without hands and pushes stays finite.
    fn is_moderate(&self) -> bool {
        let frame = &self.frame;
        let rigid = frame.velocity().into_iter().chain(frame.spin()).chain(frame.center());
        let modes = [&self.q, &self.v, &self.a, &self.f, &self.z].into_iter().flatten().copied();
        modes.chain(rigid).all(|x| x.abs() <= Self::MOST)
    }

    /// At rest and undeformed, where the frame is (or at the origin, where that is nowhere).
    fn stop(&mut self) {
        for slice in [&mut self.q, &mut self.v, &mut self.a, &mut self.f, &mut self.z] {
            slice.fill(0.0);
        }
        self.frame.stop(Self::MOST);
    }
}

impl Clone for State {
    fn clone(&self) -> Self {
        let mut copy = Self::default();
        copy.clone_from(self);
        copy
    }

    /// Keeps the allocations of `self`: a step saves its state without any (a derived `clone_from` would make new ones).
    fn clone_from(&mut self, from: &Self) {
        let Self { q, v, a, f, z, frame } = from;
        self.q.clone_from(q);
        self.v.clone_from(v);
        self.a.clone_from(a);
        self.f.clone_from(f);
        self.z.clone_from(z);
        self.frame = *frame;
    }
}

/// What one step did.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StepReport {
    /// Directions in which grabs were linearly dependent and had to be regularised.
    pub regularised: usize,
}

/// A deformable body: an [`Arc`] to its model, its state, and the hands on it.
///
/// A step costs a few operations a mode and 3 rows a grab, allocates nothing, and leaves the body in its last good state when it fails.
#[derive(Debug, Clone)]
pub struct Body {
    model: Arc<ModalModel>,
    config: BodyConfig,
    /// Of the kept modes, as they are stepped: with the scales of stiffness and damping.
    omega: Vec<f64>,
    damping: Vec<f64>,
    coefficients: Vec<Coefficients>,
    /// Empty where the material does not relax.
    flows: Vec<Flow>,
    state: State,
    before: State,
    /// Modal force of everything but grabs, held for one step.
    pushes: Vec<f64>,
    push_force: Vector3<f64>,
    push_torque: Vector3<f64>,
    grabs: Vec<Grab>,
    next_grab: u64,
    schur: Schur,
    /// Scratch, one entry a mode.
    force: Vec<f64>,
    linear: Vec<f64>,
    single: Vec<f32>,
}

impl Body {
    /// Most grabs that one body takes.
    pub const MAX_GRABS: usize = 32;

    /// A body at rest, in its model's own place.
    ///
    /// # Errors
    /// A configuration value that is not finite or not in its range.
    pub fn new(model: Arc<ModalModel>, config: BodyConfig) -> Result<Self, StepError> {
        let modes = config.modes.unwrap_or(usize::MAX).min(model.mode_count());
        let Stepping { omega, damping, coefficients, flows } = Stepping::new(&model, &config, modes)?;
        finite("gravity", &config.gravity)?;
        let zero = vec![0.0; modes];
        let frame = Frame::at_rest(&model);
        let z = vec![0.0; flows.len()];
        let state = State { q: zero.clone(), v: zero.clone(), a: zero.clone(), f: zero.clone(), z, frame };
        Ok(Self {
            omega,
            damping,
            coefficients,
            flows,
            before: state.clone(),
            state,
            pushes: zero.clone(),
            push_force: Vector3::zeros(),
            push_torque: Vector3::zeros(),
            grabs: Vec::new(),
            next_grab: 1,
            schur: Schur::default(),
            force: zero.clone(),
            linear: zero,
            single: vec![0.0; modes],
            model,
            config,
        })
    }

    /// The model it is made of.
    pub fn model(&self) -> &Arc<ModalModel> {
        &self.model
    }

    /// How it is stepped.
    pub fn config(&self) -> &BodyConfig {
        &self.config
    }

    /// The recurrences of the kept modes.
    pub fn coefficients(&self) -> &[Coefficients] {
        &self.coefficients
    }

    /// What relaxation adds to the recurrences of the kept modes; empty where the material does not relax.
    pub fn flows(&self) -> &[Flow] {
        &self.flows
    }

    /// Number of modes kept.
    pub fn mode_count(&self) -> usize {
        self.state.q.len()
    }

    /// Angular frequencies of the kept modes as they are stepped, rad/s: the model's, with the scale of stiffness.
    pub fn omega(&self) -> &[f64] {
        &self.omega
    }

    /// Damping coefficients of the kept modes as they are stepped, 1/s: the model's, with the scales of stiffness and damping.
    pub fn damping(&self) -> &[f64] {
        &self.damping
    }

    /// Changes step size, integrator, warp, gravity, damping, stiffness or relaxation; coordinates and velocities go on, and accelerations change
    /// by as much as the elastic and damping forces. The number of modes stays as it was made.
    /// A material that begins to relax begins with nothing relaxed; one that ceases to forgets what had.
    ///
    /// # Errors
    /// As [`Body::new`]; the old configuration then stays.
    pub fn reconfigure(&mut self, config: BodyConfig) -> Result<(), StepError> {
        finite("gravity", &config.gravity)?;
        let Stepping { omega, damping, coefficients, flows } =
            Stepping::new(&self.model, &config, self.mode_count())?;
        // `a = f - c v - omega^2 (q - ratio z)`: the acceleration belongs to the state. What has not changed cancels to the bit.
        let resisted = |body: &Self, i: usize| {
            let ratio = body.config.relaxation.map_or(0.0, |r| r.ratio);
            let stretch = body.state.q[i] - ratio * body.state.z.get(i).copied().unwrap_or(0.0);
            body.damping[i] * body.state.v[i] + body.omega[i].powi(2) * stretch
        };
        // Scratch of the step.
        for i in 0..self.mode_count() {
            self.linear[i] = resisted(self, i);
        }
        (self.omega, self.damping, self.coefficients, self.flows) = (omega, damping, coefficients, flows);
        self.config = BodyConfig { modes: self.config.modes, ..config };
        self.state.z.resize(self.flows.len(), 0.0);
        for i in 0..self.mode_count() {
            self.state.a[i] += self.linear[i] - resisted(self, i);
        }
        for grab in &mut self.grabs {
            grab.set_material(&self.config);
        }
        Ok(())
    }

    /// Modal coordinates, kg^1/2 m.
    pub fn q(&self) -> &[f64] {
        &self.state.q
    }

    /// Modal velocities, kg^1/2 m/s.
    pub fn v(&self) -> &[f64] {
        &self.state.v
    }

    /// Modal accelerations, kg^1/2 m/s^2.
    pub fn a(&self) -> &[f64] {
        &self.state.a
    }

    /// Modal flows, kg^1/2 m; empty where the material does not relax. See [`Relaxation`].
    pub fn z(&self) -> &[f64] {
        &self.state.z
    }

    /// The whole state.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Where the body is.
    pub fn frame(&self) -> &Frame {
        &self.state.frame
    }

    /// Puts the body into a state of the same number of modes.
    ///
    /// # Errors
    /// A slice of another length, a number that is not finite; the body then stays as it was.
    pub fn set_state(&mut self, state: &State) -> Result<(), StepError> {
        for (what, slice) in [("q", &state.q), ("v", &state.v), ("a", &state.a), ("f", &state.f)] {
            if slice.len() != self.mode_count() {
                return Err(StepError::Length { what, expected: self.mode_count(), got: slice.len() });
            }
            finite(what, slice)?;
        }
        if state.z.len() != self.flows.len() {
            return Err(StepError::Length { what: "z", expected: self.flows.len(), got: state.z.len() });
        }
        finite("z", &state.z)?;
        state.frame.check()?;
        self.state.clone_from(state);
        Ok(())
    }

    /// Places the body: position of the model's origin (m) and rotation (unit quaternion x, y, z, w; normalised here), world axes.
    /// Modal coordinates and velocities stay.
    ///
    /// # Errors
    /// A number that is not finite, a quaternion of length zero.
    pub fn set_pose(&mut self, position: [f64; 3], rotation: [f64; 4]) -> Result<(), StepError> {
        self.state.frame.set_pose(&self.model, position, rotation)
    }

    /// Holds a patch of the body; its target begins where the patch is now, so that grabbing moves nothing.
    ///
    /// # Errors
    /// A vertex that is not on the surface, a configuration out of range, too many grabs.
    pub fn grab(&mut self, patch: &Patch, config: GrabConfig) -> Result<GrabId, StepError> {
        if self.grabs.len() >= Self::MAX_GRABS {
            return Err(StepError::TooManyGrabs { limit: Self::MAX_GRABS });
        }
        let id = GrabId(self.next_grab);
        let mut grab = Grab::new(id, &self.model, patch, config, self.mode_count())?;
        grab.set_material(&self.config);
        let local = grab.local_position(&self.state.q, self.config.warp);
        grab.target = self.state.frame.to_world(local);
        self.next_grab += 1;
        self.grabs.push(grab);
        self.schur.reserve(self.grabs.len());
        Ok(id)
    }

    /// Lets go. Letting go twice is no error.
    pub fn release(&mut self, id: GrabId) {
        self.grabs.retain(|g| g.id != id);
    }

    /// The grabs on the body, oldest first.
    pub fn grabs(&self) -> impl Iterator<Item = GrabId> + '_ {
        self.grabs.iter().map(|g| g.id)
    }

    /// Moves a grab's target (m, world axes).
    ///
    /// # Errors
    /// A target that is not finite (the old one stays), or no such grab.
    pub fn set_target(&mut self, id: GrabId, target: [f64; 3]) -> Result<(), StepError> {
        finite("grab target", &target)?;
        self.find_mut(id)?.target = target.into();
        Ok(())
    }

    /// Where the grab is being pulled to, m, world axes.
    ///
    /// # Errors
    /// No such grab.
    pub fn target(&self, id: GrabId) -> Result<[f64; 3], StepError> {
        Ok(self.find(id)?.target.into())
    }

    /// Where the held patch is now, m, world axes.
    ///
    /// # Errors
    /// No such grab.
    pub fn grab_position(&self, id: GrabId) -> Result<[f64; 3], StepError> {
        let local = self.find(id)?.local_position(&self.state.q, self.config.warp);
        Ok(self.state.frame.to_world(local).into())
    }

    /// The reaction: the force that the body exerts on the hand, N, world axes, as of the last step.
    ///
    /// # Errors
    /// No such grab.
    pub fn reaction(&self, id: GrabId) -> Result<[f64; 3], StepError> {
        Ok((-self.find(id)?.pull).into())
    }

    /// What [`compliance`](Self::compliance) would be of a rigid hand on a patch of an elastic body of so many modes, whose stiffness is
    /// `stiffness_scale` times the baked one, without making the body: 3x3, m/N, body axes.
    ///
    /// # Errors
    /// A patch of another surface.
    pub fn compliance_of(
        model: &ModalModel,
        patch: &Patch,
        modes: usize,
        stiffness_scale: f64,
    ) -> Result<[[f64; 3]; 3], StepError> {
        let c = grab::give_at(model, patch, modes.min(model.mode_count()))? / stiffness_scale;
        Ok(std::array::from_fn(|i| std::array::from_fn(|j| c[(i, j)])))
    }

    /// The compliance of a grab within one step (3x3, m/N, body axes): residual flexibility of the patch plus the hand's own spring. Where
    /// the material relaxes, the first is multiplied by [`Relaxation::creep`] of one step.
    ///
    /// # Errors
    /// No such grab.
    pub fn compliance(&self, id: GrabId) -> Result<[[f64; 3]; 3], StepError> {
        let c = self.find(id)?.compliance;
        Ok(std::array::from_fn(|i| std::array::from_fn(|j| c[(i, j)])))
    }

    /// How far the residual flexibility under a grab has flown (m, body axes): the `z` of what the modes leave out, with `creep` of the
    /// pulls so far. Zero where the material does not relax. A copy of a body that takes over a [`State`] takes over this too.
    ///
    /// # Errors
    /// No such grab.
    pub fn grab_flow(&self, id: GrabId) -> Result<[f64; 3], StepError> {
        Ok(self.find(id)?.flow.into())
    }

    /// Sets what [`grab_flow`](Self::grab_flow) tells; nothing where the material does not relax.
    ///
    /// # Errors
    /// No such grab, a number that is not finite.
    pub fn set_grab_flow(&mut self, id: GrabId, flow: [f64; 3]) -> Result<(), StepError> {
        finite("grab flow", &flow)?;
        let relaxes = !self.flows.is_empty();
        let grab = self.find_mut(id)?;
        if relaxes {
            grab.flow = flow.into();
        }
        Ok(())
    }

    /// Pushes a surface vertex with `force` (N, world axes) during the next step only.
    ///
    /// # Errors
    /// A force that is not finite, a vertex that is not on the surface.
    pub fn push(&mut self, vertex: u32, force: [f64; 3]) -> Result<(), StepError> {
        finite("force", &force)?;
        let (rows, arm) = self.vertex_rows(vertex)?;
        let force = Vector3::from(force);
        let local = self.state.frame.rotation().inverse() * force;
        for (mode, p) in self.pushes.iter_mut().enumerate() {
            *p += rows.at(mode).dot(&local);
        }
        self.push_force += force;
        self.push_torque += arm.cross(&force);
        Ok(())
    }

    /// Strikes a surface vertex with `impulse` (N s, world axes): velocities change at once.
    ///
    /// # Errors
    /// An impulse that is not finite or brings a velocity or an acceleration beyond 1e100, a vertex that is not on the surface; the body
    /// then stays as it was.
    pub fn strike(&mut self, vertex: u32, impulse: [f64; 3]) -> Result<(), StepError> {
        finite("impulse", &impulse)?;
        let (rows, arm) = self.vertex_rows(vertex)?;
        let impulse = Vector3::from(impulse);
        let local = self.state.frame.rotation().inverse() * impulse;
        self.before.clone_from(&self.state);
        for i in 0..self.mode_count() {
            let dv = rows.at(i).dot(&local);
            self.state.v[i] += dv;
            // The acceleration belongs to the state: damping answers the new velocity.
            self.state.a[i] -= self.damping[i] * dv;
        }
        if self.model.is_free() {
            self.state.frame.add_momentum(&self.model, impulse, arm.cross(&impulse));
        }
        // What has overflowed here no step would put right: it goes back to the state before it, which is this one.
        if self.state.is_moderate() {
            return Ok(());
        }
        self.state.clone_from(&self.before);
        let expected = "one that leaves velocities and accelerations below 1e100";
        Err(StepError::Input { what: "impulse", expected, got: impulse.norm() })
    }

    /// For a vertex: its (unwarped) displacement rows by mode, and its arm from the centre of mass in world axes.
    fn vertex_rows(&self, vertex: u32) -> Result<(VertexRows, Vector3<f64>), StepError> {
        let surface = self.model.surface().positions();
        let count = surface.len();
        let Some(rest) = surface.get(vertex as usize) else {
            return Err(StepError::Vertex { vertex, count });
        };
        let arm = self.state.frame.rotation()
            * (Vector3::from(rest.map(f64::from)) - Vector3::from(self.model.center_of_mass()));
        let rows = VertexRows { model: self.model.clone(), vertex };
        Ok((rows, arm))
    }

    /// Kinetic plus elastic energy of the modes, and of the rigid motion of a free body, J. Potential energy in gravity is not in it.
    /// Where the material relaxes, both springs of each mode count: `omega^2 ((1 - ratio) q^2 + ratio (q - z)^2) / 2`.
    pub fn energy(&self) -> f64 {
        let ratio = self.config.relaxation.map_or(0.0, |r| r.ratio);
        let modes: f64 = (0..self.mode_count())
            .map(|i| {
                let (omega, q, v) = (self.omega[i], self.state.q[i], self.state.v[i]);
                let stretch = omega * q;
                let elastic = match self.state.z.get(i) {
                    None => stretch * stretch,
                    Some(z) => {
                        (1.0 - ratio) * stretch * stretch + ratio * (omega * (q - z)) * (omega * (q - z))
                    }
                };
                0.5 * (v * v + elastic)
            })
            .sum();
        modes + if self.model.is_free() { self.state.frame.kinetic_energy(&self.model) } else { 0.0 }
    }

    /// Linear (kg m/s) and angular momentum about the world's origin (kg m^2/s) of a free body's rigid motion; zero for an anchored one.
    pub fn momentum(&self) -> ([f64; 3], [f64; 3]) {
        if self.model.is_free() { self.state.frame.momentum(&self.model) } else { ([0.0; 3], [0.0; 3]) }
    }

    /// Writes the deformed surface (m, body axes): multiply by the frame, or by an engine's transform, to place it.
    ///
    /// # Errors
    /// `out` is shorter than the surface.
    pub fn reconstruct(&mut self, out: &mut [[f32; 3]]) -> Result<(), StepError> {
        let expected = self.model.surface().positions().len();
        if out.len() < expected {
            return Err(StepError::Length { what: "positions", expected, got: out.len() });
        }
        for (s, q) in self.single.iter_mut().zip(&self.state.q) {
            *s = *q as f32;
        }
        self.model.basis_in(self.config.precision).reconstruct(&self.single, self.config.warp, out);
        Ok(())
    }

    fn find(&self, id: GrabId) -> Result<&Grab, StepError> {
        self.grabs.iter().find(|g| g.id == id).ok_or(StepError::NoGrab)
    }

    fn find_mut(&mut self, id: GrabId) -> Result<&mut Grab, StepError> {
        self.grabs.iter_mut().find(|g| g.id == id).ok_or(StepError::NoGrab)
    }
}

/// The (unwarped) displacement rows of one vertex.
struct VertexRows {
    model: Arc<ModalModel>,
    vertex: u32,
}

impl VertexRows {
    fn at(&self, mode: usize) -> Vector3<f64> {
        Vector3::from_fn(|axis, _| f64::from(self.model.displacement_row(self.vertex, axis, mode)))
    }
}

/// The position of a patch (m, body axes) and, when wanted, its derivative by each modal coordinate.
fn patch_position(
    rest: Vector3<f64>,
    displacement: &[Vector3<f64>],
    rotation: &[Vector3<f64>],
    q: &[f64],
    warped: bool,
    rows: Option<&mut [Vector3<f64>]>,
) -> Vector3<f64> {
    let sum = |columns: &[Vector3<f64>]| columns.iter().zip(q).fold(Vector3::zeros(), |s, (c, q)| s + c * *q);
    let d = sum(displacement);
    if !warped {
        if let Some(rows) = rows {
            rows.copy_from_slice(displacement);
        }
        return rest + d;
    }
    let (u, by_d, by_w) = warp_with_jacobian(sum(rotation), d);
    if let Some(rows) = rows {
        for ((row, phi), psi) in rows.iter_mut().zip(displacement).zip(rotation) {
            *row = by_d * phi + by_w * psi;
        }
    }
    rest + u
}
