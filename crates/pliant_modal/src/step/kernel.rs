//! One step of a body: first the modes and the frame without hands, then all hands together,
//! implicitly.

pub(crate) mod group;
mod hold;
mod mass_force;
mod points;
mod press;
mod touch;

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use group::{Parts, View};

use super::{
    Frame, FrameMotion, Hand, Hold, RigidMotion, State, StepSettings,
    constraint::ViscoelasticPatch,
    elastic::ElasticStep,
    gravity::BendScratch,
    modes::Modes,
    patch::{Grams, Six, Tangent},
    solve::System,
};
use crate::{Contacts, HeldShapes, ModalModel, StepError};

/// Result of one step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StepReport {
    /// Number of directions in which hands were linearly dependent and had to be regularized.
    pub regularized: usize,
    /// Number of points of a reduced elasticity at which the tangent of the last round had negative
    /// eigenvalues, which were raised to zero. Zero with linear elasticity.
    pub projected: usize,
}

/// Forces on a body in one step besides its hands and gravity.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Load<'a> {
    /// Modal force, kg^1/2 m/s^2. It may cover only the first modes.
    pub modal: &'a [f64],
    /// Force on the frame of a free body, N, world axes.
    pub force: Vector3<f64>,
    /// Torque on the frame of a free body about the center of mass, N m, world axes.
    pub torque: Vector3<f64>,
    /// Motion of the anchors of an anchored body over the step. A free body ignores it.
    pub motion: FrameMotion,
    /// The frame of a free body at the end of the step, if it is known from elsewhere. The step
    /// then takes it as it is, and forces act on the modes alone. An anchored body ignores it.
    pub frame: Option<Frame>,
}

/// Data of a hand during one step.
#[derive(Debug, Clone, Default)]
struct Solving {
    /// The patch's six numbers after the step without hands.
    free: Six,
    /// Mean velocities of the six numbers over the step without hands, which dampers see.
    speed: Six,
    /// The six numbers at which the tangent is taken.
    from: Six,
    /// Displacement of the patch at `from`, m, body axes. `tangent` is its derivative there.
    at: Vector3<f64>,
    tangent: Tangent,
    compliance: Matrix3<f64>,
    /// Relaxation time of the damper, s.
    relaxation: f64,
    /// Target position that the solve uses, m, and the target velocity times the relaxation time,
    /// m, both in world axes.
    target: Vector3<f64>,
    lead: Vector3<f64>,
    /// Extrapolation factor `x` of [`StepSettings::extrapolation`]: the force at the end of the
    /// step is `(1 + x) F - x F_before`.
    beyond: f64,
    /// Displacement of the patch in this step that is due to earlier forces alone, m, body axes.
    creep_displacement: Vector3<f64>,
    /// Position of the patch relative to the center of mass, m, body axes.
    arm: Vector3<f64>,
    /// Force on the body over the step, N, body axes.
    pull: Vector3<f64>,
    /// Whether the target is farther away than the hand may pull.
    is_capped: bool,
}

impl Solving {
    /// Whether all that the hand does is to stretch a spring between its target and the patch.
    fn is_plain(&self, hand: &Hand) -> bool {
        let is_target = matches!(hand.hold, Hold::Target { .. });
        is_target && !self.is_capped && self.relaxation == 0.0 && self.creep_displacement == Vector3::zeros()
    }
}

/// Steps states of one model. No other type steps bodies.
///
/// A kernel holds tables and workspace and no state, so one kernel may step any number of copies of
/// the body.
///
/// Hands are compliant and implicit. With the patch positions after the step `x = x* + A pull`, the
/// forces `pull` (N) solve `(A + C) pull = target - x*`. `C` is the compliance of each hand: the
/// part of the patch's compliance that the modes leave out, and the hand's spring. A damper adds
/// its relaxation time times the velocities. Under warp, Newton's method corrects the rows and the
/// pose of a free body's frame.
///
/// A step allocates nothing after a call of [`Kernel::prepare`] with the same hands.
#[derive(Debug, Clone)]
pub struct Kernel {
    model: Arc<ModalModel>,
    settings: StepSettings,
    h: f64,
    /// Kernels with the same settings share this.
    modes: Arc<Modes>,
    /// The nonlinear part of the step. `None` with linear elasticity.
    elastic: Option<ElasticStep>,
    creep: ViscoelasticPatch,
    before: State,
    /// Modal forces of gravity and loads, and at the end of a step those of the hands too. `pulls`
    /// holds the modal forces of gravity on the bent shape, and then those of the hands.
    force: Vec<f64>,
    pulls: Vec<f64>,
    /// Scratch of gravity on the bent shape.
    bend: BendScratch,
    /// Contact forces over this step.
    push: touch::ContactPush,
    solving: Vec<Solving>,
    /// Forces of the hands on the six numbers of their patches.
    forces: Vec<Six>,
    responses: Grams,
    system: System,
}

/// A body that is stepped without others.
struct Alone<'a>(Parts<'a>);

impl group::Member for Alone<'_> {
    fn parts(&mut self) -> Parts<'_> {
        let Parts { kernel, state, hands, load, contacts, report } = &mut self.0;
        Parts { kernel, state, hands, load: *load, contacts, report }
    }

    fn view(&self) -> View<'_> {
        let Parts { kernel, state, hands, load, contacts, .. } = &self.0;
        View { kernel, state, hands, load: *load, contacts }
    }
}

/// Makes the nonlinear part of a step if the settings and the model have one.
fn elastic(
    model: &ModalModel,
    settings: &StepSettings,
    modes: &Modes,
    h: f64,
    shapes: Option<Arc<HeldShapes>>,
) -> Option<ElasticStep> {
    let (scale, relaxation) = (settings.stiffness_scale, settings.relaxation);
    if settings.is_reduced(model) && modes.count() > 0 {
        ElasticStep::new(model, modes, scale, relaxation, h, shapes)
    } else {
        None
    }
}

impl Kernel {
    /// Makes a kernel for the first `modes` modes of a model at steps of `h` seconds.
    ///
    /// # Errors
    /// Returns an error if a setting or the step length is not finite or out of range.
    pub fn new(
        model: Arc<ModalModel>,
        settings: StepSettings,
        modes: usize,
        h: f64,
    ) -> Result<Self, StepError> {
        settings.check()?;
        let modes = model.shared_modes().get(&model, &settings, modes, h)?;
        let zero = vec![0.0; modes.count()];
        let mut kernel = Self {
            elastic: elastic(&model, &settings, &modes, h, None),
            creep: ViscoelasticPatch::new(settings.relaxation, settings.stiffness_scale, h),
            before: State::default(),
            force: zero.clone(),
            pulls: zero.clone(),
            bend: BendScratch::new(zero.len()),
            push: touch::ContactPush { modal: zero, ..Default::default() },
            solving: Vec::new(),
            forces: Vec::new(),
            responses: Grams::default(),
            system: System::default(),
            model,
            settings,
            h,
            modes,
        };
        kernel.before = kernel.at_rest();
        kernel.prepare_weight();
        Ok(kernel)
    }

    /// Changes the settings and the step length. The number of modes stays.
    ///
    /// # Errors
    /// Returns the errors of [`Kernel::new`]. The old settings and step length then stay.
    pub fn reconfigure(&mut self, settings: StepSettings, h: f64) -> Result<(), StepError> {
        settings.check()?;
        self.modes = self.model.shared_modes().get(&self.model, &settings, self.modes.count(), h)?;
        let shapes = self.held_shapes().cloned();
        self.elastic = elastic(&self.model, &settings, &self.modes, h, shapes);
        self.creep = ViscoelasticPatch::new(settings.relaxation, settings.stiffness_scale, h);
        (self.settings, self.h) = (settings, h);
        self.before = self.at_rest();
        self.prepare_weight();
        self.responses.forget();
        Ok(())
    }

    /// Sets the own shapes of the patches that hands hold. Linear elasticity does not use them, nor
    /// does a kernel that steps fewer modes than its model has.
    ///
    /// Hands on other patches feel what the modes leave out as a compliance, as all hands do
    /// without shapes. The shapes of `state` come to rest under the forces of `hands`, so that
    /// these go on as they were, and so do stiff coordinates where the patches are others. Where
    /// nobody holds a patch of the old shapes any more, the body gains no energy: what it would
    /// gain is taken from its velocities, and where these do not suffice the coordinates yield.
    ///
    /// # Errors
    /// Returns [`StepError::OtherModel`] for shapes of another model, and [`StepError::Length`] for
    /// a state of another size. Nothing then changes.
    pub fn set_held_shapes(
        &mut self,
        shapes: Option<Arc<HeldShapes>>,
        state: &mut State,
        hands: &[Hand],
    ) -> Result<(), StepError> {
        if shapes.as_ref().is_some_and(|shapes| !shapes.are_of_model(&self.model)) {
            return Err(StepError::OtherModel);
        }
        self.check_lengths(state)?;
        // Only a state with the old columns loses them.
        let before = self.elastic.as_ref().filter(|elastic| elastic.shapes().is_some());
        let before = before.filter(|elastic| state.s.len() == elastic.columns());
        let before = before.map(|elastic| elastic.energy(state));
        let is_let_go = self.held_shapes().is_some_and(|shapes| !shapes.are_all_held(hands));
        let old = self.held_shapes().cloned();
        let Some(step) = &self.elastic else {
            state.s.clear();
            return Ok(());
        };
        let mut force = vec![0.0; state.q.len()];
        step.force_at(state, &mut force);
        state.s.clear();
        self.elastic = elastic(&self.model, &self.settings, &self.modes, self.h, shapes);
        self.responses.forget();
        self.equilibrate_columns(state, hands);
        let have_changed = match (&old, self.held_shapes()) {
            (Some(old), Some(new)) => !old.are_of_patches_of(new),
            (old, new) => old.is_some() != new.is_some(),
        };
        if let (Some(elastic), true) = (&mut self.elastic, have_changed && !hands.is_empty()) {
            elastic.settle(state, &force);
        }
        if let (Some(most), Some(elastic), true) = (before, &mut self.elastic, is_let_go) {
            elastic.lower(most, state);
        }
        Ok(())
    }

    /// Brings the columns of held patches in `state` to rest under the forces of `hands`, while the
    /// coordinates stay. Without shapes of held patches nothing changes.
    ///
    /// This finds the columns of a state that came from elsewhere, such as a network.
    pub fn equilibrate_columns(&mut self, state: &mut State, hands: &[Hand]) {
        let back = state.frame.rotation().inverse();
        let pulls = hands.iter().map(|hand| {
            let relaxed = self.creep.ratio() * self.creep.relaxed_force(hand);
            (&*hand.patch, back * hand.mean + relaxed)
        });
        if let Some(elastic) = self.elastic.as_mut().filter(|elastic| elastic.shapes().is_some()) {
            elastic.equilibrate_columns(state, pulls);
        }
    }

    /// The own shapes of held patches that the steps use.
    pub fn held_shapes(&self) -> Option<&Arc<HeldShapes>> {
        self.elastic.as_ref().and_then(ElasticStep::shapes)
    }

    /// The model of the body.
    pub fn model(&self) -> &Arc<ModalModel> {
        &self.model
    }

    /// The step settings.
    pub fn settings(&self) -> &StepSettings {
        &self.settings
    }

    /// Length of a step, s.
    pub fn h(&self) -> f64 {
        self.h
    }

    /// Number of modes stepped.
    pub fn modes(&self) -> usize {
        self.modes.count()
    }

    /// Angular frequencies of the modes as they are stepped, rad/s.
    pub fn omega(&self) -> &[f64] {
        &self.modes.omega
    }

    /// Damping coefficients of the modes as they are stepped, 1/s.
    pub fn damping(&self) -> &[f64] {
        &self.modes.damping
    }

    /// Change of coordinate, velocity and acceleration of each mode per unit modal force in a step.
    pub fn responses(&self) -> [&[f64]; 3] {
        self.modes.response.each_ref().map(Vec::as_slice)
    }

    /// Computes the modal force that the last step lacked to end at the coordinates and velocities
    /// `to` instead of at `reached`, kg^1/2 m/s^2. Entries that `to` lacks count as zero.
    ///
    /// With linear elasticity it is a least-squares fit of both, in units of each mode's own
    /// amplitude. With reduced elasticity, where a force moves all coordinates, it is that of the
    /// coordinates on the tangent of the step.
    pub fn missing_force(&mut self, reached: &State, to: [&[f64]; 2], out: &mut [f64]) {
        let at = |slice: &[f64], k: usize| slice.get(k).copied().unwrap_or(0.0);
        if let Some(elastic) = &mut self.elastic {
            elastic.force_of_increment(|k| at(to[0], k) - reached.q[k], out);
            // After a step that has failed, the tangent may have any value.
            if out.iter().any(|x| !x.is_finite()) {
                out.fill(0.0);
            }
            return;
        }
        for (k, (out, omega)) in out.iter_mut().zip(&self.modes.omega).enumerate() {
            let (rq, rv) = (at(to[0], k) - reached.q[k], at(to[1], k) - reached.v[k]);
            let (bq, bv) = (self.modes.response[0][k], self.modes.response[1][k]);
            let weight = 1.0 / omega.powi(2).max(1e-12);
            let scale = bq * bq + bv * bv * weight;
            *out = if scale > 0.0 { (bq * rq + bv * rv * weight) / scale } else { 0.0 };
        }
    }

    /// Makes a state of the body at rest, in the pose in which its model was baked.
    pub fn at_rest(&self) -> State {
        let frame = Frame::at_rest(&self.model);
        State { frame, ..State::zero(self.modes.count(), self.modes.is_viscous()) }
    }

    /// Checks that a state has as many numbers as this kernel steps and that all of them are
    /// finite.
    ///
    /// # Errors
    /// Returns an error if a slice has another length or a number is not finite.
    pub fn check(&self, state: &State) -> Result<(), StepError> {
        self.check_lengths(state)?;
        let slices = [("q", &state.q), ("v", &state.v), ("a", &state.a), ("f", &state.f), ("z", &state.z)];
        let slices = slices.into_iter().chain([("s", &state.s)]);
        slices.into_iter().try_for_each(|(what, slice)| crate::error::finite(what, slice))?;
        state.frame.check()
    }

    fn check_lengths(&self, state: &State) -> Result<(), StepError> {
        let expected = self.modes.count();
        for (what, got) in
            [("q", state.q.len()), ("v", state.v.len()), ("a", state.a.len()), ("f", state.f.len())]
        {
            if got != expected {
                return Err(StepError::Length { what, expected, got });
            }
        }
        let (expected, got) = (if self.modes.is_viscous() { expected } else { 0 }, state.z.len());
        if got == expected { Ok(()) } else { Err(StepError::Length { what: "z", expected, got }) }
    }

    /// Makes the tables and workspace for steps with these hands, so that the steps allocate
    /// nothing.
    pub fn prepare(&mut self, hands: &[Hand]) {
        self.responses.prepare(hands, &self.modes.response[0]);
        self.solving.reserve(hands.len().saturating_sub(self.solving.len()));
        self.forces.reserve(hands.len().saturating_sub(self.forces.len()));
        self.system.reserve(hands.len());
        if let Some(elastic) = &mut self.elastic {
            elastic.reserve(hands.len());
        }
    }

    /// Elastic energy of a state, J. Without viscoelastic parts.
    pub fn elastic_energy(&self, state: &State) -> f64 {
        match &self.elastic {
            Some(elastic) => elastic.energy(state),
            None => 0.5 * state.q.iter().zip(&self.modes.omega).map(|(q, w)| (w * q) * (w * q)).sum::<f64>(),
        }
    }

    /// Writes the elastic force `dU/dq` of a state, kg^1/2 m/s^2.
    pub fn elastic_force(&self, state: &State, out: &mut [f64]) {
        match &self.elastic {
            Some(elastic) => elastic.force_at(state, out),
            None => {
                for ((out, q), omega) in out.iter_mut().zip(&state.q).zip(&self.modes.omega) {
                    *out = omega * omega * q;
                }
            }
        }
    }

    /// Whether the body has reduced elasticity.
    pub fn is_reduced(&self) -> bool {
        self.elastic.is_some()
    }

    /// Whether the shape bends by modal warping.
    pub fn warps(&self) -> bool {
        self.settings.warp && self.elastic.is_none()
    }

    /// Performs one step of a state with these hands.
    ///
    /// # Errors
    /// - Returns [`StepError::Length`] if the state or a patch has another size. Nothing then
    ///   changes.
    /// - Returns [`StepError::Diverged`] if the result would not be finite. The state then returns
    ///   to that before the step, and the forces and viscoelastic states of the hands become zero.
    ///   If that state contains a number above 1e100, it is instead set to rest at the pose of its
    ///   frame.
    pub fn step(
        &mut self,
        state: &mut State,
        hands: &mut [Hand],
        load: &Load<'_>,
    ) -> Result<StepReport, StepError> {
        self.check_step(state, hands)?;
        self.before.clone_from(state);
        let report = self.advance(state, hands, load);
        let bad = |hand: &Hand| {
            !hand.pull.iter().chain(&hand.mean).chain(&hand.viscoelastic).all(|x| x.is_finite())
        };
        let what = state.non_finite().or(hands.iter().any(bad).then_some("a reaction"));
        let Some(what) = what else { return Ok(report) };
        self.give_up(state, hands);
        Err(StepError::Diverged { what })
    }

    /// Performs one step of a state with these hands and contacts with obstacles.
    ///
    /// # Errors
    /// Returns the errors of [`Kernel::step`], and [`StepError::Input`] for an obstacle whose
    /// distance, normal or velocity is not finite. The state then stays as it was.
    pub fn step_touching(
        &mut self,
        state: &mut State,
        hands: &mut [Hand],
        load: &Load<'_>,
        contacts: &mut Contacts,
    ) -> Result<StepReport, StepError> {
        if contacts.are_none() {
            self.check_step(state, hands)?;
            contacts.end();
            let stepped = self.step(state, hands, load);
            if let Err(StepError::Diverged { .. }) = stepped {
                contacts.forget();
            }
            return stepped;
        }
        self.check_step(state, hands)?;
        let mut work = std::mem::take(&mut contacts.touching);
        let mut report = StepReport::default();
        let step = self.h;
        let mut alone =
            [Alone(Parts { kernel: self, state, hands, load: *load, contacts, report: &mut report })];
        let others = group::Others { probes: &mut [], held: &[], rigids: &mut [], pushed: &[], h: step };
        let stepped = group::step(&mut alone, &[0], &[], &mut [], others, &mut work);
        contacts.touching = work;
        if let Err(StepError::Diverged { .. }) = stepped {
            contacts.forget();
            self.give_up(state, hands);
        }
        stepped.map(|()| report)
    }

    /// Checks that a state and hands have as many numbers as this kernel steps.
    pub(crate) fn check_step(&self, state: &State, hands: &[Hand]) -> Result<(), StepError> {
        self.check_lengths(state)?;
        let expected = self.modes.count();
        match hands.iter().find(|hand| hand.patch.modes() != expected) {
            Some(hand) => Err(StepError::Length { what: "a held patch", expected, got: hand.patch.modes() }),
            None => Ok(()),
        }
    }

    /// Returns to the state before a step whose result is not finite.
    fn give_up(&self, state: &mut State, hands: &mut [Hand]) {
        state.clone_from(&self.before);
        if !state.is_moderate() {
            state.stop();
        }
        for hand in hands {
            hand.pull = Vector3::zeros();
            hand.mean = Vector3::zeros();
            hand.viscoelastic = Vector3::zeros();
        }
    }

    /// Kinetic energy of the modes, and of the rigid motion of a free body, J.
    pub(crate) fn kinetic_energy(&self, state: &State) -> f64 {
        let frame = if self.model.is_free() { state.frame.kinetic_energy(&self.model) } else { 0.0 };
        frame + state.v.iter().map(|v| 0.5 * v * v).sum::<f64>()
    }

    fn advance(&mut self, state: &mut State, hands: &mut [Hand], load: &Load<'_>) -> StepReport {
        let gravity = Vector3::from(self.settings.gravity);
        if let Some(frame) = load.frame.filter(|_| self.model.is_free()) {
            state.frame = frame;
        }
        let on_mass = self.mass_force(&state.frame, &load.motion);
        let mut force = std::mem::take(&mut self.force);
        self.force_at_rest(&on_mass, &mut force);
        self.force = force;
        for (f, load) in self.force.iter_mut().zip(load.modal) {
            *f += load;
        }
        if self.push.is_on {
            self.force.iter_mut().zip(&self.push.modal).for_each(|(f, push)| *f += push);
        }
        self.modes.advance(&self.before, &self.force, state);
        if self.bends_under(&on_mass) {
            self.bend_under(&on_mass, state);
        }
        let rigid = (self.model.is_free() && load.frame.is_none()).then(|| {
            let [force, torque] = self.push.at_once(load.force, load.torque);
            let rigid = RigidMotion::predict(&mut state.frame, &self.model, self.h, gravity, force, torque);
            self.push.add_rest(&mut state.frame, &self.model, self.h, force, gravity);
            rigid
        });
        let mut report = StepReport::default();
        if !hands.is_empty() || self.elastic.is_some() {
            let is_alone = !self.push.is_on && load.torque == Vector3::zeros();
            let weight = is_alone.then(|| self.model.mass() * gravity + load.force);
            report = self.hold(state, hands, rigid, weight);
        }
        state.f.copy_from_slice(&self.force);
        report
    }
}
