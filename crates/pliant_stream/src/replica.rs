//! A copy of a body: the kernel that steps it, and its patches by vertex and radius.

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_modal::{
    GrabConfig, Hand, HeldPatch, HeldShapes, Hold, ImpliedPulls, Kernel, Load, ModalModel, Patch, State,
    StepSettings,
};

use crate::StreamError;
use crate::prediction::{BodyCopy, HandState};
use crate::state::{GrabKey, GrabState, RigidState};
use crate::wire::FrameGrab;

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
        Ok(Self { kernel, patches: Vec::new(), hands: Vec::new(), keys: Vec::new(), implied, made: 0 })
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

    /// Steps a copy with the hands that were added since [`Replica::release_all`]. A step whose
    /// result would not be finite leaves the state unchanged.
    pub(crate) fn step_held(&mut self, copy: &mut BodyCopy, load: &Load<'_>) {
        // The error is ignored on purpose. The sizes match by construction, and a receiver cannot
        // report a state that it cannot step. A checksum or a snapshot repairs the state.
        self.kernel.step(&mut copy.state, &mut self.hands, load).ok();
        copy.hands.clear();
        copy.hands.extend(self.keys.iter().zip(&self.hands).map(|(&key, hand)| {
            let target = match hand.hold {
                Hold::Target { target, .. } => Some(target),
                Hold::Measured(_) => None,
            };
            HandState { key, pull: hand.pull, mean: hand.mean, target, viscoelastic: hand.viscoelastic }
        }));
    }

    /// Steps a state with the streamed reactions and patch displacements. The rigid frame stays
    /// where the state has it.
    ///
    /// Reaction and displacement together say where the hand must have been, `place + C pull`, with
    /// `place` the position of the patch and `C` the hand's compliance. The step is then the body's
    /// own. The reactions alone would be a dead load: a bent body under a load that pushes is
    /// unstable (it buckles), although the same body held in place is stable, and a small error
    /// would grow. With the displacements the receiver is an observer. The constraint force is the
    /// measured one when the state is right. Otherwise it draws the patches to their positions as
    /// the grab does, so errors decay as they would in the held body. A grab whose vertex the model
    /// lacks exerts no force.
    pub(crate) fn step_measured(&mut self, copy: &mut BodyCopy, grabs: &[FrameGrab], load: &[f64]) {
        self.release_all();
        for g in grabs {
            self.hold_measured(copy, g);
        }
        self.step_held(copy, &Load { modal: load, frame_is_given: true, ..Load::default() });
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
        out: &mut Vec<f64>,
    ) {
        self.step_measured(from, grabs, load);
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
