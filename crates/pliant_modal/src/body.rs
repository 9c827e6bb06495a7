//! A moving body: its state, its grabs and the forces on it.

mod attachments;
mod grabs;

use std::sync::Arc;

use nalgebra::Vector3;

use crate::{
    Contacts, Frame, FrameMotion, GrabConfig, Hand, HeldPlace, Hold, Kernel, Load, ModalModel, ObstacleShape,
    Precision, State, StepError, StepReport, StepSettings,
    contact::{Memory, Touched},
    error::finite,
    step::group::{Parts, View},
};

/// Time constant with which a hand comes back to its target after the shapes of held patches have
/// changed, s.
const SLIP_TIME: f64 = 0.25;

/// Identifier of a grab on a body. A body never uses an identifier twice.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct GrabId(pub(crate) u64);

/// Configuration of one copy of a body.
///
/// All copies of a body share the [`StepSettings`]. The other fields may differ between copies.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyConfig {
    /// Settings of the step, the same for all copies.
    pub settings: StepSettings,
    /// Length of a step, s. Default: 1/60.
    pub step: f64,
    /// Number of modes to keep, lowest frequencies first (level of detail). Default: `None`, all
    /// modes.
    pub modes: Option<usize>,
    /// Precision of the basis that [`Body::reconstruct`] reads. Steps, grabs and forces use double
    /// precision in either case. Default: [`Precision::Single`].
    pub precision: Precision,
}

impl Default for BodyConfig {
    fn default() -> Self {
        StepSettings::default().into()
    }
}

impl From<StepSettings> for BodyConfig {
    /// Makes a configuration with these step settings and defaults for the other fields.
    fn from(settings: StepSettings) -> Self {
        Self { settings, step: 1.0 / 60.0, modes: None, precision: Precision::default() }
    }
}

/// A deformable body: an [`Arc`] to its model, its state and the grabs on it.
///
/// A step costs a few operations per mode and a system with three rows per grab. A step allocates
/// nothing. If a step fails, the body keeps its last good state.
#[derive(Debug, Clone)]
pub struct Body {
    config: BodyConfig,
    /// Held patches for which there were no shapes.
    without: Vec<HeldPlace>,
    kernel: Kernel,
    state: State,
    /// Modal force from [`Body::push`], constant over one step.
    pushes: Vec<f64>,
    push_force: Vector3<f64>,
    push_torque: Vector3<f64>,
    /// Motion of the anchors over the next step.
    motion: FrameMotion,
    /// The hands. `grabs` holds their identifiers in the same order.
    pub(crate) hands: Vec<Hand>,
    pub(crate) grabs: Vec<GrabEntry>,
    next_grab: u64,
    /// What the body may touch, and its contacts.
    contacts: Contacts,
    /// Scratch: a state and one entry per mode.
    spare: State,
    resisted: Vec<f64>,
    single: Vec<f32>,
    drawn: Vec<f64>,
}

#[derive(Debug, Clone)]
pub(crate) struct GrabEntry {
    pub(crate) id: GrabId,
    pub(crate) target: Vector3<f64>,
    /// The target of the previous step, or `None` before the first step of the grab.
    pub(crate) last_target: Option<Vector3<f64>>,
    /// How far the hand is off its target since the shapes of held patches changed, m, world axes.
    pub(crate) slip: Vector3<f64>,
    pub(crate) config: GrabConfig,
}

impl Body {
    /// Makes a body at rest, in the pose in which its model was baked.
    ///
    /// # Errors
    /// Returns an error if a configuration value is not finite or out of range.
    pub fn new(model: Arc<ModalModel>, config: BodyConfig) -> Result<Self, StepError> {
        let modes = config.modes.unwrap_or(usize::MAX);
        let kernel = Kernel::new(model, config.settings, modes, config.step)?;
        let zero = vec![0.0; kernel.modes()];
        let state = kernel.at_rest();
        Ok(Self {
            config,
            spare: state.clone(),
            state,
            pushes: zero.clone(),
            push_force: Vector3::zeros(),
            push_torque: Vector3::zeros(),
            motion: FrameMotion::default(),
            hands: Vec::new(),
            grabs: Vec::new(),
            next_grab: 1,
            without: Vec::new(),
            contacts: Contacts::default(),
            single: vec![0.0; zero.len()],
            drawn: zero.clone(),
            resisted: zero,
            kernel,
        })
    }

    /// The model of the body.
    pub fn model(&self) -> &Arc<ModalModel> {
        self.kernel.model()
    }

    /// The configuration of the body.
    pub fn config(&self) -> &BodyConfig {
        &self.config
    }

    /// Number of modes that the body keeps.
    pub fn mode_count(&self) -> usize {
        self.state.q.len()
    }

    /// Angular frequencies of the kept modes as stepped, rad/s: the values of the model, scaled by
    /// the stiffness scale.
    pub fn omega(&self) -> &[f64] {
        self.kernel.omega()
    }

    /// Damping coefficients of the kept modes as stepped, 1/s: the values of the model, scaled by
    /// the stiffness and damping scales.
    pub fn damping(&self) -> &[f64] {
        self.kernel.damping()
    }

    /// Changes step size, integrator, warp, gravity, damping, stiffness or relaxation.
    ///
    /// Coordinates and velocities stay. Accelerations change by as much as the elastic and damping
    /// forces. The number of modes stays as it was at construction. If relaxation is switched on,
    /// the viscoelastic state starts at zero. If relaxation is switched off, the viscoelastic state
    /// is dropped.
    ///
    /// # Errors
    /// Returns the errors of [`Body::new`]. The old configuration then stays.
    pub fn reconfigure(&mut self, config: BodyConfig) -> Result<(), StepError> {
        let before = *self.kernel.settings();
        // The acceleration belongs to the state: `a = f - c v - omega^2 (q - ratio z)`. Terms that
        // have not changed cancel to the bit.
        let resisted = |kernel: &Kernel, state: &State, settings: &StepSettings, i: usize| {
            let ratio = settings.relaxation.map_or(0.0, |r| r.ratio);
            let stretch = state.q[i] - ratio * state.z.get(i).copied().unwrap_or(0.0);
            kernel.damping()[i] * state.v[i] + kernel.omega()[i].powi(2) * stretch
        };
        for (i, force) in self.resisted.iter_mut().enumerate() {
            *force = resisted(&self.kernel, &self.state, &before, i);
        }
        let settings = config.settings;
        self.kernel.reconfigure(settings, config.step)?;
        if self.kernel.held_shapes().is_none() {
            self.state.s.clear();
        }
        self.kernel.prepare(&self.hands);
        self.config = BodyConfig { modes: self.config.modes, ..config };
        let branches = if settings.relaxation.is_some() { self.mode_count() } else { 0 };
        self.state.z.resize(branches, 0.0);
        for (i, force) in self.resisted.iter().enumerate() {
            self.state.a[i] += force - resisted(&self.kernel, &self.state, &settings, i);
        }
        if settings.relaxation.is_none() {
            self.hands.iter_mut().for_each(|hand| hand.viscoelastic = Vector3::zeros());
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

    /// Viscoelastic modal state, kg^1/2 m. Empty where the material does not relax. See
    /// [`Relaxation`](crate::Relaxation).
    pub fn z(&self) -> &[f64] {
        &self.state.z
    }

    /// The complete state.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Pose and rigid motion of the body.
    pub fn frame(&self) -> &Frame {
        &self.state.frame
    }

    /// Sets the state of the body. The state must have the same number of modes.
    ///
    /// # Errors
    /// Returns an error if a slice has another length or a number is not finite. The body then
    /// stays as it was.
    pub fn set_state(&mut self, state: &State) -> Result<(), StepError> {
        self.kernel.check(state)?;
        self.state.clone_from(state);
        self.contacts.forget();
        Ok(())
    }

    /// Sets the pose of the body: position of the model's origin (m) and rotation, in world axes.
    ///
    /// The rotation is a quaternion x, y, z, w, which this method normalizes. Modal coordinates and
    /// velocities stay.
    ///
    /// # Errors
    /// Returns an error if a number is not finite or the quaternion has length zero.
    pub fn set_pose(&mut self, position: [f64; 3], rotation: [f64; 4]) -> Result<(), StepError> {
        self.state.frame.set_pose(self.kernel.model(), position, rotation)?;
        // An anchored body on something that moves is posed anew at every step.
        self.contacts.begin_anew();
        Ok(())
    }

    /// Sets the obstacles that the body may touch. Default: none.
    ///
    /// The first call chooses the contact sites of the model, which takes a fraction of a second.
    /// Obstacles that move are set before every step, each at the same index.
    ///
    /// # Errors
    /// Returns the error of [`ObstacleShape::check`]. The old obstacles then stay.
    pub fn set_obstacles(&mut self, obstacles: Vec<Arc<dyn ObstacleShape>>) -> Result<(), StepError> {
        let prepared = self.contacts.obstacles().len() == obstacles.len();
        self.contacts.set_obstacles(obstacles)?;
        if prepared { Ok(()) } else { self.kernel.prepare_contacts(&mut self.contacts) }
    }

    /// Sets the body's coefficient of friction, 0 to [`Contacts::MAX_FRICTION`]. It counts at
    /// obstacles that have none of their own, and at others the geometric mean of both. Default:
    /// [`Contacts::FRICTION`].
    ///
    /// # Errors
    /// Returns [`StepError::Input`] for another number. The old one then stays.
    pub fn set_friction(&mut self, friction: f64) -> Result<(), StepError> {
        self.contacts.set_friction(friction)
    }

    /// The obstacles and the contacts of the last step.
    pub fn contacts(&self) -> &Contacts {
        &self.contacts
    }

    /// Pushes a surface vertex with `force` (N, world axes) during the next step only.
    ///
    /// # Errors
    /// Returns an error if the force is not finite or the vertex is not on the surface.
    pub fn push(&mut self, vertex: u32, force: [f64; 3]) -> Result<(), StepError> {
        finite("force", &force)?;
        let force = Vector3::from(force);
        let pressed = self.kernel.press(&self.state, vertex, &force)?;
        for (mode, push) in self.pushes.iter_mut().enumerate() {
            *push += pressed.modal_force(mode);
        }
        self.push_force += force;
        self.push_torque += pressed.arm.cross(&force);
        Ok(())
    }

    /// Lets the mass of an anchored body feel how its anchors move during the next step
    /// ([`FrameMotion`]). [`Body::set_pose`] alone moves the anchors without that.
    ///
    /// For a step of second order these are the values in the middle of the step. A motion that
    /// would leave the body behind by more than its size in one step counts as one that does not. A
    /// free body ignores the motion, because its frame is its own.
    ///
    /// The first call finds the moments of the model, which takes some milliseconds for 60 modes,
    /// and time that grows with the square of their number.
    ///
    /// # Errors
    /// Returns an error if a number is not finite. The motion then stays as it was.
    pub fn set_frame_motion(&mut self, motion: FrameMotion) -> Result<(), StepError> {
        motion.check()?;
        self.kernel.prepare_motion();
        self.motion = motion;
        Ok(())
    }

    /// Applies `impulse` (N s, world axes) to a surface vertex. Velocities change at once.
    ///
    /// # Errors
    /// Returns an error if the impulse is not finite, if it brings a velocity or an acceleration
    /// above 1e100, or if the vertex is not on the surface. The body then stays as it was.
    pub fn apply_impulse(&mut self, vertex: u32, impulse: [f64; 3]) -> Result<(), StepError> {
        self.kernel.apply_impulse(&mut self.state, &mut self.spare, vertex, impulse)
    }

    /// Kinetic plus elastic energy of the modes, and of the rigid motion of a free body, J.
    ///
    /// Potential energy in gravity is not included. Where the material relaxes, both springs of
    /// each mode count: `omega^2 ((1 - ratio) q^2 + ratio (q - z)^2) / 2`. With reduced elasticity
    /// the spring that relaxes counts as one of the stiffness at rest, which its force stretches.
    pub fn energy(&self) -> f64 {
        let frame = if self.model().is_free() { self.state.frame.kinetic_energy(self.model()) } else { 0.0 };
        if self.kernel.is_reduced() {
            let kinetic: f64 = self.state.v.iter().map(|v| 0.5 * v * v).sum();
            let Some(relaxation) = self.config.settings.relaxation else {
                return kinetic + self.kernel.elastic_energy(&self.state) + frame;
            };
            let mut force = vec![0.0; self.mode_count()];
            self.kernel.elastic_force(&self.state, &mut force);
            let over = force.iter().zip(&self.state.z).zip(self.omega());
            let over: f64 = over.map(|((force, z), omega)| (force / omega - omega * z).powi(2)).sum();
            let long = (1.0 - relaxation.ratio) * self.kernel.elastic_energy(&self.state);
            return kinetic + long + 0.5 * relaxation.ratio * over + frame;
        }
        let ratio = self.config.settings.relaxation.map_or(0.0, |r| r.ratio);
        let modes: f64 = (0..self.mode_count())
            .map(|i| {
                let (omega, q, v) = (self.omega()[i], self.state.q[i], self.state.v[i]);
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
        modes + frame
    }

    /// Kinetic energy of the modes, and of the rigid motion of a free body, J.
    pub fn kinetic_energy(&self) -> f64 {
        self.kernel.kinetic_energy(&self.state)
    }

    /// Potential energy in gravity, J.
    ///
    /// For an anchored body it is that of the deformation (0 when undeformed). For a free body it
    /// is that of the position (0 at the world origin).
    pub fn potential_energy(&self) -> f64 {
        self.kernel.potential_energy(&self.state)
    }

    /// Linear momentum (kg m/s) and angular momentum about the world origin (kg m^2/s) of a free
    /// body's rigid motion. Both are zero for an anchored body.
    pub fn momentum(&self) -> ([f64; 3], [f64; 3]) {
        if self.model().is_free() { self.state.frame.momentum(self.model()) } else { ([0.0; 3], [0.0; 3]) }
    }

    /// Writes the deformed surface (m, body axes) to `out`.
    ///
    /// Multiply by the frame, or by an engine's transform, to place the surface in the world.
    ///
    /// # Errors
    /// Returns an error if `out` is shorter than the surface.
    pub fn reconstruct(&mut self, out: &mut [[f32; 3]]) -> Result<(), StepError> {
        let expected = self.model().surface().positions().len();
        if out.len() < expected {
            return Err(StepError::Length { what: "positions", expected, got: out.len() });
        }
        self.drawn.copy_from_slice(&self.state.q);
        if let Some(shapes) = self.kernel.held_shapes() {
            shapes.draw(&self.state.s, &mut self.drawn);
        }
        for (s, q) in self.single.iter_mut().zip(&self.drawn) {
            *s = *q as f32;
        }
        self.kernel.model().basis_in(self.config.precision).reconstruct(
            &self.single,
            self.kernel.warps(),
            out,
        );
        if let Some(shapes) = self.kernel.held_shapes() {
            shapes.add_to(&self.state.s, out);
        }
        Ok(())
    }

    /// Performs one step of the configured length. See [`Kernel`].
    ///
    /// # Errors
    /// Returns [`StepError::Diverged`] if the result would not be finite. The body then returns to
    /// its state before the step. If that state contains a number above 1e100, the body is set to
    /// rest, undeformed, at the pose of its frame.
    pub fn step(&mut self) -> Result<StepReport, StepError> {
        self.begin_step();
        let report = self.step_alone();
        self.end_step();
        report
    }

    /// Leads the hands to their targets.
    pub(crate) fn begin_step(&mut self) {
        let fade = || (-self.config.step / SLIP_TIME).exp();
        for (hand, grab) in self.hands.iter_mut().zip(&mut self.grabs) {
            // A hand has no velocity in the first step of its grab.
            let way = grab.last_target.map_or_else(Vector3::zeros, |last| grab.target - last);
            // Below a nanometer nothing is left, so that a body at rest may sleep.
            let slip = if grab.slip.norm() > 1e-9 { fade() * grab.slip } else { Vector3::zeros() };
            let way = way + slip - grab.slip;
            grab.slip = slip;
            let (target, config) = (grab.target + grab.slip, grab.config);
            hand.hold = Hold::Target { target, velocity: way / self.config.step, config };
            grab.last_target = Some(grab.target);
        }
    }

    /// Performs one step without other bodies, after [`Body::begin_step`].
    pub(crate) fn step_alone(&mut self) -> Result<StepReport, StepError> {
        let (force, torque) = (self.push_force, self.push_torque);
        let load = Load { modal: &self.pushes, force, torque, motion: self.motion, frame: None };
        self.kernel.step_touching(&mut self.state, &mut self.hands, &load, &mut self.contacts)
    }

    /// Drops the pushes of the step.
    pub(crate) fn end_step(&mut self) {
        self.pushes.fill(0.0);
        self.push_force = Vector3::zeros();
        self.push_torque = Vector3::zeros();
        self.motion = FrameMotion::default();
    }

    /// Bound on the speed of the surface about the frame, m/s.
    pub(crate) fn speed_bound(&self) -> f64 {
        self.contacts.places.as_ref().map_or(0.0, |sites| sites.bound(&self.state.v))
    }

    /// Whether the surface is no farther from a point (m, world axes) than `within` (m), or the
    /// point is inside. Chooses the contact sites at the first call.
    pub(crate) fn is_near(&mut self, point: &Vector3<f64>, within: f64) -> bool {
        if self.contacts.places.is_none() && self.kernel.prepare_contacts(&mut self.contacts).is_err() {
            return false;
        }
        let Some(sites) = &self.contacts.places else { return false };
        self.kernel.shape(sites, &self.state, None, None).is_near(point, within)
    }

    /// Whether the body has touched the obstacle of an index in the last step, or comes within a
    /// distance (m) of it. It may say so of one that is a little farther, and does so of all before
    /// the body has touched its first.
    pub fn may_touch(&self, obstacle: usize, within: f64) -> bool {
        let touched = |memory: &Memory| memory.other == Touched::Obstacle(obstacle);
        if self.contacts.memory.iter().any(touched) {
            return true;
        }
        let Some(obstacle) = self.contacts.obstacles().get(obstacle) else { return false };
        let Some(sites) = &self.contacts.places else { return true };
        let frame = &self.state.frame;
        let near = within + sites.bound(&self.state.q);
        // Comparisons with no number are false, and such a body is taken for near.
        !sites.sites.iter().all(|site| {
            let place = frame.to_world(site.rest(&site.outward));
            obstacle.at(&place).distance > near + site.slides
        })
    }

    pub(crate) fn contacts_mut(&mut self) -> &mut Contacts {
        &mut self.contacts
    }

    /// What a step with others changes.
    pub(crate) fn parts<'a>(&'a mut self, report: &'a mut StepReport) -> Parts<'a> {
        let (force, torque) = (self.push_force, self.push_torque);
        let load = Load { modal: &self.pushes, force, torque, motion: self.motion, frame: None };
        Parts {
            kernel: &mut self.kernel,
            state: &mut self.state,
            hands: &mut self.hands,
            load,
            contacts: &mut self.contacts,
            report,
        }
    }

    /// What a step with others reads.
    pub(crate) fn view(&self) -> View<'_> {
        let (force, torque) = (self.push_force, self.push_torque);
        let load = Load { modal: &self.pushes, force, torque, motion: self.motion, frame: None };
        View { kernel: &self.kernel, state: &self.state, hands: &self.hands, load, contacts: &self.contacts }
    }
}
