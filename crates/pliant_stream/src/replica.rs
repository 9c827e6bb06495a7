//! A copy of a body: the kernel that steps it, and its patches by vertex and radius.

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_modal::{
    Contacts, Frame, GrabConfig, Hand, HeldPatch, HeldPlace, HeldShapes, Hold, ImpliedPulls, Kernel, Load,
    ModalModel, ObstacleShape, Patch, State, StepSettings,
};

use crate::prediction::{BodyCopy, HandState};
use crate::state::{GrabKey, GrabState, RigidState, capped_impulse};
use crate::wire::FrameGrab;
use crate::{StreamError, Surroundings};

/// Largest number of cached patches. One more empties the table.
const PATCHES: usize = 256;

/// Key of a patch: the vertex and the bits of the radius.
type Key = (u32, u64);

/// Steps copies of one body.
#[derive(Debug)]
pub(crate) struct Replica {
    kernel: Kernel,
    patches: Vec<(Key, Arc<HeldPatch>)>,
    /// The hands of the next step, and their keys.
    hands: Vec<Hand>,
    keys: Vec<GrabKey>,
    implied: ImpliedPulls,
    /// What the body may touch, and the contacts of the last step.
    contacts: Contacts,
    /// Memory for the state before an impulse.
    spare: State,
    /// Number of patches made.
    pub(crate) made: u64,
}

impl Replica {
    /// Creates a replica for the first `modes` of a model at step `h` (s).
    pub(crate) fn new(
        model: Arc<ModalModel>,
        settings: StepSettings,
        modes: usize,
        h: f64,
    ) -> Result<Self, StreamError> {
        let kernel = Kernel::new(model, settings, modes, h).map_err(|e| StreamError::Model(e.to_string()))?;
        let implied = ImpliedPulls::new(&kernel);
        Ok(Self {
            kernel,
            patches: Vec::new(),
            hands: Vec::new(),
            keys: Vec::new(),
            implied,
            contacts: Contacts::default(),
            spare: State::default(),
            made: 0,
        })
    }

    /// Lets copies of the body touch what stands around it.
    ///
    /// Only free bodies touch it, because the axes of an anchored body are not those of its world,
    /// and only with all modes: fewer would need contact sites of their own. All copies of a body
    /// in a session follow the same rule. For the others, contacts are a load that the host
    /// corrects.
    pub(crate) fn set_surroundings(&mut self, around: &Surroundings) -> Result<(), StreamError> {
        let model = self.kernel.model();
        let whole = model.is_free() && self.kernel.modes() == model.mode_count();
        around.check()?;
        let refused = |error: pliant_modal::StepError| StreamError::Model(error.to_string());
        let obstacles = around.obstacles.iter().filter(|_| whole);
        let obstacles = obstacles.map(|&obstacle| Arc::new(obstacle) as Arc<dyn ObstacleShape>);
        self.contacts.set_friction(around.friction).map_err(refused)?;
        self.contacts.set_obstacles(obstacles.collect()).map_err(refused)?;
        if self.touches() {
            self.kernel.prepare_contacts(&mut self.contacts).map_err(refused)
        } else {
            Ok(())
        }
    }

    /// Whether copies of the body may touch anything.
    pub(crate) fn touches(&self) -> bool {
        !self.contacts.obstacles().is_empty()
    }

    /// Sum of the contact forces of the last step (N), and their torque about `center` (N m), world
    /// axes.
    pub(crate) fn contact_push(&self, center: &Vector3<f64>) -> [Vector3<f64>; 2] {
        let contacts = self.contacts.contacts().iter();
        contacts.fold([Vector3::zeros(); 2], |[force, torque], contact| {
            let (push, arm) = (Vector3::from(contact.force), Vector3::from(contact.point) - center);
            [force + push, torque + arm.cross(&push)]
        })
    }

    /// The frame at the end of a step of a copy, if it is known: that of `pose`. Without one the
    /// frame of a body that touches nothing stays, and that of another is stepped.
    pub(crate) fn end_frame(&self, copy: &BodyCopy, pose: Option<&RigidState>) -> Option<Frame> {
        let known = pose.and_then(|pose| pose.frame(self.model()));
        known.or((!self.touches()).then_some(copy.state.frame)).filter(|_| self.model().is_free())
    }

    pub(crate) fn kernel(&self) -> &Kernel {
        &self.kernel
    }

    pub(crate) fn model(&self) -> &Arc<ModalModel> {
        self.kernel.model()
    }

    /// Returns whether the patch has been made.
    pub(crate) fn has_patch(&self, vertex: u32, radius: f64) -> bool {
        let wanted = (vertex, radius.to_bits());
        self.patches.iter().any(|(key, _)| *key == wanted)
    }

    /// Returns a patch of the body and makes it on first use. The result is `None` for a vertex
    /// that the model lacks.
    pub(crate) fn patch(&mut self, vertex: u32, radius: f64) -> Option<Arc<HeldPatch>> {
        let wanted = (vertex, radius.to_bits());
        if let Some((_, patch)) = self.patches.iter().find(|(key, _)| *key == wanted) {
            return Some(patch.clone());
        }
        let patch = Patch::around(self.model().surface(), vertex, radius).ok()?;
        let patch = Arc::new(HeldPatch::new(self.model(), &patch, self.kernel.modes()).ok()?);
        self.made += 1;
        if self.patches.len() >= PATCHES {
            self.patches.clear();
        }
        self.patches.push((wanted, patch.clone()));
        Some(patch)
    }

    /// Removes all hands of the next step.
    pub(crate) fn release_all(&mut self) {
        self.hands.clear();
        self.keys.clear();
    }

    fn hold(&mut self, key: GrabKey, hand: Hand) -> Option<&mut Hand> {
        self.keys.push(key);
        self.hands.push(hand);
        self.hands.last_mut()
    }

    /// Adds a hand whose reaction and patch displacement are known. `before` is the copy that the
    /// step begins with. The result is `None` for a vertex that the model lacks.
    pub(crate) fn hold_measured(&mut self, before: &BodyCopy, g: &FrameGrab) -> Option<&mut Hand> {
        let key = g.state.key;
        let patch = self.patch(g.state.vertex, g.state.radius)?;
        let hand = Hand::new(patch, Hold::Measured(g.displacement.into()));
        let pull = -Vector3::from(g.state.reaction);
        self.hold(key, Hand { pull, mean: before.mean(key), ..hand })
    }

    /// Adds a hand at a target (m, world axes) with its own spring and damper. The hand has come
    /// there from its target in `before`; a new hand has not moved.
    pub(crate) fn hold_at(
        &mut self,
        before: &BodyCopy,
        key: GrabKey,
        (vertex, radius): (u32, f64),
        target: Vector3<f64>,
        config: GrabConfig,
    ) {
        let Some(patch) = self.patch(vertex, radius) else { return };
        let known = before.hand(key);
        let way = known.and_then(|known| known.target).map(|from| target - from);
        let velocity = way.map_or_else(Vector3::zeros, |way| way / self.kernel.h());
        let mut hand = Hand::new(patch, Hold::Target { target, velocity, config });
        if let Some(known) = known {
            (hand.mean, hand.viscoelastic) = (known.mean, known.viscoelastic);
        }
        self.hold(key, hand);
    }

    /// Applies a user's impulse (N s, world axes) to a copy, within the limit of a session. One
    /// that the body cannot take does nothing, alike on all machines.
    pub(crate) fn apply_impulse(&mut self, copy: &mut BodyCopy, vertex: u32, impulse: [f64; 3]) {
        let impulse = capped_impulse(self.kernel.model(), impulse);
        self.kernel.apply_impulse(&mut copy.state, &mut self.spare, vertex, impulse).ok();
    }

    /// Steps a copy with the hands that were added since [`Replica::release_all`]. A step whose
    /// result would not be finite leaves the state unchanged.
    pub(crate) fn step_held(&mut self, copy: &mut BodyCopy, load: &Load<'_>) {
        // The error is ignored on purpose. The sizes match by construction, and a receiver cannot
        // report a state that it cannot step. A checksum or a snapshot repairs the state.
        if self.touches() {
            self.contacts.recall(&copy.contacts);
            self.kernel.step_touching(&mut copy.state, &mut self.hands, load, &mut self.contacts).ok();
            self.contacts.remember(&mut copy.contacts);
        } else {
            self.kernel.step(&mut copy.state, &mut self.hands, load).ok();
        }
        copy.hands.clear();
        copy.hands.extend(self.keys.iter().zip(&self.hands).map(|(&key, hand)| {
            let target = match hand.hold {
                Hold::Target { target, .. } => Some(target),
                Hold::Measured(_) => None,
            };
            HandState { key, pull: hand.pull, mean: hand.mean, target, viscoelastic: hand.viscoelastic }
        }));
    }

    /// Adds a streamed hand on a body that moves on from what the stream knows: by a frame that is
    /// stepped, or by the guest's own hands. The hand is held at its target by its own spring and
    /// damper, not where the patch was. It has come there from its target in the tick before.
    pub(crate) fn hold_streamed(&mut self, before: &BodyCopy, g: &FrameGrab, from: Option<&FrameGrab>) {
        let h = self.kernel.h();
        let Some(hand) = self.hold_measured(before, g) else { return };
        let target = Vector3::from(g.state.target);
        let way = from.map(|from| target - Vector3::from(from.state.target));
        let velocity = way.map_or_else(Vector3::zeros, |way| way / h);
        hand.hold = Hold::Target { target, velocity, config: g.state.hold };
    }

    /// Steps a state with the streamed reactions and patch displacements. A free body has `frame`
    /// at the end.
    ///
    /// Reaction and displacement together say where the hand must have been, `place + C pull`, with
    /// `place` the position of the patch and `C` the hand's compliance. The step is then the body's
    /// own. The reactions alone would be a dead load: a bent body under a load that pushes is
    /// unstable (it buckles), although the same body held in place is stable, and a small error
    /// would grow. With the displacements the receiver is an observer. The constraint force is the
    /// measured one when the state is right. Otherwise it draws the patches to their positions as
    /// the grab does, so errors decay as they would in the held body. A grab whose vertex the model
    /// lacks exerts no force.
    ///
    /// The same holds for contacts with what stands around the body: with the frame at both ends of
    /// the step, they press the shape to where it must be.
    pub(crate) fn step_measured(
        &mut self,
        copy: &mut BodyCopy,
        grabs: &[FrameGrab],
        load: &[f64],
        frame: Option<Frame>,
    ) {
        self.release_all();
        for g in grabs {
            self.hold_measured(copy, g);
        }
        self.step_held(copy, &Load { modal: load, frame, ..Load::default() });
    }

    /// Extrapolation factor of the host, which keeps all modes, whatever this copy keeps.
    fn extrapolation(&self, hands: usize) -> f64 {
        let model = self.kernel.model();
        self.kernel.settings().extrapolation(model, model.mode_count(), hands)
    }

    /// Extrapolates the force of a hand at the end of a step from its mean over this step and the
    /// mean `before` over the step before, N. `hands` is the number of hands on the body.
    pub(crate) fn end(&self, mean: Vector3<f64>, before: Vector3<f64>, hands: usize) -> Vector3<f64> {
        let beyond = self.extrapolation(hands);
        mean + beyond * (mean - before)
    }

    /// Returns the mean force of a hand over a step from its force at the `end` of the step and the
    /// mean `before` over the step before (N, world axes). `hands` is the number of hands on the
    /// body.
    pub(crate) fn mean(&self, end: Vector3<f64>, before: Vector3<f64>, hands: usize) -> Vector3<f64> {
        let beyond = self.extrapolation(hands);
        (end + beyond * before) / (1.0 + beyond)
    }

    /// Displacement of a patch from rest at `q` in body axes, m. It is zero for a vertex that the
    /// model lacks. Modes that `q` lacks do not move.
    pub(crate) fn displacement(&mut self, q: &[f64], vertex: u32, radius: f64) -> [f64; 3] {
        let warp = self.kernel.warps();
        self.patch(vertex, radius).map_or([0.0; 3], |patch| patch.displacement(q, warp).into())
    }

    /// Computes the modal force per mode that a step from the true state `from` lacks to reach the
    /// true coordinates and velocities `to` (see [`Kernel::missing_force`]). The call steps `from`.
    pub(crate) fn lacking(
        &mut self,
        from: &mut BodyCopy,
        to: [&[f64]; 2],
        grabs: &[FrameGrab],
        load: &[f64],
        frame: Option<Frame>,
        out: &mut Vec<f64>,
    ) {
        self.step_measured(from, grabs, load, frame);
        out.clear();
        out.resize(from.state.modes(), 0.0);
        self.kernel.missing_force(&from.state, to, out);
    }

    /// Sets the own shapes of the patches that hands hold. Shapes of another model are ignored.
    pub(crate) fn set_held_shapes(&mut self, shapes: Option<Arc<HeldShapes>>) {
        // Each state gets its columns when it is settled.
        let mut state = self.kernel.at_rest();
        self.kernel.set_held_shapes(shapes, &mut state, &[]).ok();
    }

    /// Gives a copy the own shapes of held patches with which it is stepped next, with the hands
    /// that were added since [`Replica::release_all`]. What the hands feel goes on as it was.
    pub(crate) fn shape(&mut self, copy: &mut BodyCopy, to: Option<&Arc<HeldShapes>>) {
        let same = |a: Option<&Arc<HeldShapes>>, b: Option<&Arc<HeldShapes>>| {
            a.map(Arc::as_ptr) == b.map(Arc::as_ptr)
        };
        // The kernel may have stepped a copy of another tick last.
        if !same(self.kernel.held_shapes(), copy.shapes.as_ref()) {
            self.set_held_shapes(copy.shapes.clone());
        }
        if !same(copy.shapes.as_ref(), to) {
            self.kernel.set_held_shapes(to.cloned(), &mut copy.state, &self.hands).ok();
            copy.shapes = self.kernel.held_shapes().cloned();
        }
    }

    /// Brings the columns of held patches in a state to rest under the reactions (N, world axes) of
    /// hands on patches, given by vertex and radius (m).
    pub(crate) fn equilibrate_columns(
        &mut self,
        state: &mut State,
        hands: impl Iterator<Item = (u32, f64, [f64; 3])>,
    ) {
        self.release_all();
        for (vertex, radius, reaction) in hands {
            let Some(patch) = self.patch(vertex, radius) else { continue };
            let hand = Hand::new(patch, Hold::Measured(Vector3::zeros()));
            self.hands.push(Hand { mean: -Vector3::from(reaction), ..hand });
        }
        self.kernel.equilibrate_columns(state, &self.hands);
        self.release_all();
    }

    /// Where a held patch is in a state. `None` for a patch that the model does not have.
    pub(crate) fn held_place(&mut self, state: &State, vertex: u32, radius: f64) -> Option<HeldPlace> {
        let modal = self.patch(vertex, radius)?.displacement(&state.q, self.kernel.warps());
        let own = self.kernel.held_shapes().and_then(|shapes| shapes.mean(vertex, radius, &state.s));
        Some(HeldPlace {
            vertex,
            radius,
            displacement: (modal + Vector3::from(own.unwrap_or_default())).into(),
        })
    }

    /// Writes the reactions that a state implies into `grabs`; see [`ImpliedPulls`].
    pub(crate) fn reactions(&mut self, state: &State, grabs: &mut [GrabState]) {
        let mut hands = std::mem::take(&mut self.hands);
        hands.clear();
        let known = |replica: &mut Self, g: &GrabState| {
            let hand = Hand::new(replica.patch(g.vertex, g.radius)?, Hold::Measured(Vector3::zeros()));
            Some(Hand { pull: -Vector3::from(g.reaction), ..hand })
        };
        hands.extend(grabs.iter().filter_map(|g| known(self, g)));
        self.implied.solve(&self.kernel, state, &mut hands);
        let mut solved = hands.iter();
        for g in grabs {
            if self.patch(g.vertex, g.radius).is_some()
                && let Some(hand) = solved.next()
            {
                g.reaction = (-hand.pull).into();
            }
        }
        self.hands = hands;
    }
}

/// Copies coordinates, velocities, accelerations and viscoelastic states into a state, as far as
/// both sides have them. Missing values become 0, and so do the forces of the last step. The sizes
/// and the rigid frame stay.
pub(crate) fn fill(state: &mut State, from: [&[f64]; 4]) {
    let mine = [&mut state.q, &mut state.v, &mut state.a, &mut state.z];
    for (mine, theirs) in mine.into_iter().zip(from) {
        let count = mine.len().min(theirs.len());
        mine[..count].copy_from_slice(&theirs[..count]);
        mine[count..].fill(0.0);
    }
    state.f.fill(0.0);
}

/// Sets the rigid frame of a state to a pose. Without a valid pose the frame stays.
pub(crate) fn place(state: &mut State, model: &ModalModel, pose: Option<&RigidState>) {
    if let Some(frame) = pose.and_then(|pose| pose.frame(model)) {
        state.frame = frame;
    }
}
