//! One body at a peer: stepped at once, and stepped again when a late input arrives.

mod passes;

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::Vector3;
use pliant_modal::{Frame, HeldPlace, HeldShapes, Load, ModalModel, StepSettings};

pub(crate) use passes::CONTACT_COST;
use passes::Pass;

use super::columns::{Columns, Taken};
use super::inputs::{BodyInputs, InputLog, WINDOW};
use crate::codec::checksum::{checksum, projection};
use crate::newmark::{Newmark, ViscoelasticFilter};
use crate::prediction::{BodyCopy, HandState, Ring, Rollback, VisualCopy};
use crate::recovery::Forecast;
use crate::replica::Replica;
use crate::state::{BodyId, GrabKey, GrabState, RigidState, State, Tick, UserId};
use crate::wire::{PeerBodyState, PeerFrame, PeerHandState};
use crate::{StreamError, Surroundings};

/// Correction of the state for a late input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LateInputRepair {
    /// Rolls back to the tick before the input and steps again with all known inputs. This is
    /// exact, and the default.
    #[default]
    Rollback,
    /// Compensates as in the paper. The acceleration that the late target would have caused at its
    /// tick, less the one that was used, changes displacement and velocity by equations (8) and
    /// (9). This is cheaper by the number of ticks, and accurate only as far as the body does not
    /// respond within them.
    Compensate,
}

/// A body that this peer steps.
#[derive(Debug)]
pub struct PeerBody {
    pub(crate) id: BodyId,
    pub(crate) model: Arc<ModalModel>,
    replica: Replica,
    around: Surroundings,
    forecast: Forecast,
    newmark: Newmark,
    viscoelastic: Option<ViscoelasticFilter>,
    repair: LateInputRepair,
    rollback: Rollback,
    /// The inputs of the last step, and those that each tick was stepped with.
    inputs: BodyInputs,
    used: Ring<BodyInputs>,
    visual: VisualCopy,
    grabs: Vec<GrabState>,
    /// Ticks that are stepped again, and the first one that the next pass begins with.
    pass: Option<Pass>,
    late: Option<Tick>,
    /// Memory for the inputs of a tick that is stepped again.
    again: BodyInputs,
    restepped: u64,
    pub(crate) columns: Columns,
    /// Whether the body is stepped with own shapes of held patches, where it can be.
    pub(crate) wants_shapes: bool,
    /// A state that was taken without the shapes that it had, because they are not made yet.
    unshaped: Option<(Tick, Box<PeerBodyState>)>,
}

impl PeerBody {
    pub(crate) fn new(
        id: BodyId,
        model: Arc<ModalModel>,
        settings: &StepSettings,
        h: f64,
        repair: LateInputRepair,
        blend_ticks: u16,
    ) -> Result<Self, StreamError> {
        let replica = Replica::new(model.clone(), *settings, model.mode_count(), h)?;
        let rest = replica.kernel().at_rest();
        let (beta, gamma) = settings.integrator.newmark().unwrap_or((0.25, 0.5));
        Ok(Self {
            id,
            visual: VisualCopy::new(&model, rest.clone(), h, blend_ticks),
            model,
            replica,
            around: Surroundings::default(),
            forecast: Forecast::new(h),
            viscoelastic: settings
                .relaxation
                .map(|r| ViscoelasticFilter::new(r, &Newmark { h, beta, gamma }, WINDOW)),
            newmark: Newmark { h, beta, gamma },
            repair,
            // A rollback can return to the initial state like to any other tick.
            rollback: Rollback::new(BodyCopy::new(rest), WINDOW),
            inputs: BodyInputs::default(),
            used: Ring::new(WINDOW),
            grabs: Vec::new(),
            pass: None,
            late: None,
            again: BodyInputs::default(),
            restepped: 0,
            columns: Columns::default(),
            wants_shapes: true,
            unshaped: None,
        })
    }

    /// Lets the body touch what stands around it, from the next step on.
    pub(crate) fn set_surroundings(&mut self, around: Surroundings) -> Result<(), StreamError> {
        self.replica.set_surroundings(&around)?;
        self.around = around;
        Ok(())
    }

    /// Whether the body may touch anything.
    pub(crate) fn touches(&self) -> bool {
        self.replica.touches()
    }

    /// What stands still around the body.
    pub fn surroundings(&self) -> &Surroundings {
        &self.around
    }

    /// Number of the body.
    pub fn id(&self) -> BodyId {
        self.id
    }

    /// The model of the body.
    pub fn model(&self) -> &Arc<ModalModel> {
        &self.model
    }

    /// The step settings of the body.
    pub fn settings(&self) -> &StepSettings {
        self.replica.kernel().settings()
    }

    /// The tick that the body has reached.
    pub fn tick(&self) -> Tick {
        self.rollback.tick()
    }

    /// The live state at [`PeerBody::tick`]: stepped with the inputs that are known, and with
    /// forecasts of those that are not.
    pub fn live(&self) -> &State {
        &self.rollback.now.state
    }

    /// The visual state for display and hands. It is continuous in position and velocity.
    pub fn visual(&self) -> &State {
        &self.visual.state
    }

    /// The visual rigid frame of a free body; `None` for an anchored one.
    pub fn pose(&self) -> Option<RigidState> {
        self.visual.pose
    }

    /// The rigid frame of a free body after a remembered tick.
    pub(crate) fn past_pose(&self, tick: Tick) -> Option<RigidState> {
        let past = self.past(tick)?;
        self.model.is_free().then(|| RigidState::of_frame(&self.model, &past.frame))
    }

    /// Returns the checksum of a remembered tick and the magnitude that scales its tolerance.
    pub(crate) fn check(&self, tick: Tick) -> Option<(f64, f64)> {
        let BodyCopy { state, shapes, .. } = self.rollback.at(tick)?;
        let mut size = state.q.iter().chain(&state.z).map(|q| q * q).sum::<f64>();
        let mut sum = checksum(tick, state);
        if let Some(pose) = self.past_pose(tick) {
            // Position and rotation are scaled to the units of the modal coordinates.
            let (mass, span) = (self.model.mass().sqrt(), self.model.size());
            let sign = if pose.rotation[3] < 0.0 { -span } else { span };
            let turn = pose.rotation.map(|x| x * sign);
            let all: Vec<f64> = pose.position.iter().chain(&turn).map(|x| x * mass).collect();
            size += all.iter().map(|x| x * x).sum::<f64>();
            sum += projection(tick ^ 1, &all);
        }
        let size = size.sqrt();
        // Peers with other shapes disagree, however little these have changed yet.
        let named = shapes.as_ref().map_or(0.0, |shapes| name(shapes));
        Some((sum + size * named, size))
    }

    /// Whether the own shapes of held patches at a remembered tick are still to be made.
    pub(crate) fn lacks_shapes(&self, tick: Tick) -> bool {
        self.used.get(tick).is_some_and(|inputs| self.columns.lacks(tick, inputs))
    }

    /// The own shapes of held patches in the live state, and their coordinates.
    pub fn held_shapes(&self) -> Option<(&Arc<HeldShapes>, &[f64])> {
        let BodyCopy { state, shapes, .. } = &self.rollback.now;
        Some((shapes.as_ref()?, &state.s))
    }

    /// Whether shapes of held patches count for the body.
    pub(crate) fn takes_shapes(&self) -> bool {
        let reduced = self.model.parts().reduced.as_ref();
        let has_mesh = reduced.is_some_and(|reduced| reduced.mesh.is_some());
        self.wants_shapes && has_mesh && self.settings().is_reduced(&self.model)
    }

    /// The patches that hands hold, and where they are in the live state. Each user's first hand
    /// comes before anybody's second, so that nobody's many hands displace another one.
    pub(crate) fn held_places(&mut self) -> Vec<HeldPlace> {
        let mut of_user: BTreeMap<UserId, usize> = BTreeMap::new();
        let mut order: Vec<(usize, u32, f64)> = Vec::new();
        for (user, held) in self.inputs.held.iter().filter(|(_, held)| held.radius <= self.model.size()) {
            let count = of_user.entry(*user).or_default();
            order.push((*count, held.vertex, held.radius));
            *count += 1;
        }
        order.sort_by_key(|(count, ..)| *count);
        order.truncate(HeldShapes::MAX_PATCHES);
        let state = &self.rollback.now.state;
        let place = |(_, vertex, radius)| self.replica.held_place(state, vertex, radius);
        order.into_iter().filter_map(place).collect()
    }

    /// Takes shapes of held patches that were made, and marks the ticks that lacked them. Returns
    /// for what they were taken, and false when the tick from which they count is not remembered.
    pub(crate) fn take_shapes(
        &mut self,
        places: &[HeldPlace],
        shapes: &Option<Arc<HeldShapes>>,
        taken: Tick,
        inputs: &InputLog,
    ) -> (Taken, bool) {
        let found = self.columns.take(places, shapes);
        let Some(from) = found.from.filter(|from| *from <= self.tick()) else { return (found, true) };
        let remembered = self.tick().saturating_sub(WINDOW as u64 - 1);
        let is_made = |(tick, _): &mut (Tick, _)| self.columns.at(*tick).flatten().is_some();
        if let Some((tick, state)) = self.unshaped.take_if(is_made) {
            // The state that was taken had these shapes.
            let is_whole = tick >= remembered && self.import(tick, self.tick(), &state, inputs);
            return (found, is_whole);
        }
        // What is before the last state that was taken stays as the state had it.
        let from = from.max(taken + 1);
        let is_whole = from > self.tick() || self.rollback.at(from - 1).is_some();
        if is_whole {
            self.mark(from);
        }
        (found, is_whole)
    }

    /// All grabs of the body, with their reactions.
    pub fn grabs(&self) -> &[GrabState] {
        &self.grabs
    }

    /// Number of ticks that were stepped again.
    pub fn restepped(&self) -> u64 {
        self.restepped
    }

    /// Returns whether a hand on this patch costs no new patch.
    pub(crate) fn has_patch(&self, vertex: u32, radius: f64) -> bool {
        self.replica.has_patch(vertex, radius)
    }

    /// Number of patches that were made for hands.
    pub fn patches_made(&self) -> u64 {
        self.replica.made
    }

    /// The state after a remembered tick.
    pub(crate) fn past(&self, tick: Tick) -> Option<&State> {
        self.rollback.at(tick).map(|past| &past.state)
    }

    /// Reactions (N) of the hands at a remembered tick, with their users.
    pub(crate) fn reactions_at(&self, tick: Tick) -> Option<Vec<(UserId, [f64; 3])>> {
        let past = self.rollback.at(tick)?;
        Some(past.hands.iter().map(|hand| (hand.key.user, (-hand.pull).into())).collect())
    }

    pub(crate) fn export(&self, tick: Tick) -> Option<PeerBodyState> {
        let BodyCopy { state, hands, contacts, .. } = self.rollback.at(tick)?;
        Some(PeerBodyState {
            s: state.s.clone(),
            shapes: self.columns.since(tick),
            body: self.id.0,
            q: state.q.clone(),
            v: state.v.clone(),
            a: state.a.clone(),
            z: state.z.clone(),
            force: state.f.clone(),
            frame: self.model.is_free().then_some(state.frame).map(|f| PeerFrame {
                center: f.center(),
                orientation: f.orientation(),
                velocity: f.velocity(),
                spin: f.spin(),
            }),
            pulls: hands
                .iter()
                .map(|hand| PeerHandState {
                    user: hand.key.user.0,
                    grab: hand.key.grab,
                    pull: hand.pull.into(),
                    mean: hand.mean.into(),
                    target: hand.target.unwrap_or_default().into(),
                    viscoelastic: hand.viscoelastic.into(),
                })
                .collect(),
            contacts: contacts.clone(),
        })
    }

    /// Takes a state of a tick. A body without a state so far steps from it to the tick `to`, and
    /// another one does so with the next updates. Returns false when the state does not fit the
    /// body.
    pub(crate) fn import(&mut self, tick: Tick, to: Tick, state: &PeerBodyState, inputs: &InputLog) -> bool {
        let received = state
            .frame
            .as_ref()
            .and_then(|f| Frame::from_motion(&self.model, f.center, f.orientation, f.velocity, f.spin).ok());
        if received.is_some() != self.model.is_free() {
            return false;
        }
        let (q, v, a, z) = (state.q.clone(), state.v.clone(), state.a.clone(), state.z.clone());
        let f = state.force.clone();
        let mut received =
            State { q, v, a, f, z, s: Vec::new(), frame: received.unwrap_or(self.live().frame) };
        if self.replica.kernel().check(&received).is_err() {
            return false;
        }
        self.columns.replace(&self.model, if self.takes_shapes() { &state.shapes } else { &[] });
        // Without the shapes that the state had, the body goes on nearly alike until they are made.
        let had = self.columns.at(tick).filter(|_| !state.s.is_empty());
        let shapes = had.flatten().filter(|shapes| shapes.columns() == state.s.len()).cloned();
        if shapes.is_some() {
            received.s.clone_from(&state.s);
        }
        self.unshaped = had.is_some_and(|made| made.is_none()).then(|| (tick, Box::new(state.clone())));
        let hand = |p: &PeerHandState| HandState {
            key: GrabKey { user: UserId(p.user), grab: p.grab },
            pull: p.pull.into(),
            mean: p.mean.into(),
            target: Some(p.target.into()),
            viscoelastic: p.viscoelastic.into(),
        };
        let hands = state.pulls.iter().map(hand).collect();
        let contacts = state.contacts.clone();
        let received = BodyCopy { state: received, hands, contacts, shapes };
        (self.pass, self.late) = (None, None);
        inputs.of_body(tick, self.id, &self.forecast, &mut self.again);
        if self.tick() == 0 || tick >= self.tick() {
            let before = std::mem::replace(&mut self.rollback.now, received);
            let fresh = self.tick() == 0;
            self.inputs.clone_from(&self.again);
            self.reach(tick);
            while self.tick() < to {
                self.step_once(inputs);
            }
            if fresh {
                self.visual.clear();
            } else {
                self.visual.add(&self.model, &before.state, &self.rollback.now.state);
            }
            self.show();
        } else {
            self.rollback.remember(tick, &received);
            self.used.place(tick).0.clone_from(&self.again);
            self.pass = Some(Pass { tick, copy: Some(received) });
        }
        true
    }

    /// Steps to the next tick, and goes on with what is stepped again, so that it comes no
    /// farther behind.
    pub(crate) fn advance(&mut self, inputs: &InputLog) {
        self.go_on(inputs);
        self.step_once(inputs);
        self.visual.advance();
        self.show();
    }

    fn step_once(&mut self, inputs: &InputLog) {
        let tick = self.tick() + 1;
        inputs.of_body(tick, self.id, &self.forecast, &mut self.inputs);
        if self.pass.is_some() {
            self.lead_on(tick, inputs);
        }
        let shapes = self.columns.of_step(tick, &self.inputs);
        Self::press(&mut self.replica, &mut self.rollback.now, &self.inputs, shapes);
        self.reach(tick);
    }

    /// Steps a copy once with the impulses and the hands of the inputs, and with the own shapes of
    /// held patches.
    fn press(
        replica: &mut Replica,
        copy: &mut BodyCopy,
        inputs: &BodyInputs,
        shapes: Option<&Arc<HeldShapes>>,
    ) {
        for (_, i) in &inputs.impulses {
            replica.apply_impulse(copy, i.vertex, i.impulse);
        }
        replica.release_all();
        for (user, g) in &inputs.held {
            // All peers ignore the same patches. A patch larger than the body would visit every
            // vertex of the body.
            if g.radius <= replica.model().size() {
                replica.hold_at(copy, g.key(*user), (g.vertex, g.radius), g.target.into(), g.hold);
            }
        }
        replica.shape(copy, shapes);
        replica.step_held(copy, &Load::default());
    }

    /// Remembers the copy, and the inputs of the last step, as those of `tick`.
    fn reach(&mut self, tick: Tick) {
        self.rollback.reach(tick);
        self.used.place(tick).0.clone_from(&self.inputs);
    }

    fn show(&mut self) {
        let copy = &self.rollback.now;
        self.visual.show(&self.model, &copy.state);
        self.grabs.clear();
        for (user, g) in &self.inputs.held {
            let key = g.key(*user);
            let pull = copy.hand(key).map_or_else(Vector3::zeros, |hand| hand.pull);
            self.grabs.push(GrabState {
                key,
                vertex: g.vertex,
                radius: g.radius,
                target: g.target,
                reaction: (-pull).into(),
                hold: g.hold,
            });
        }
    }
}

/// A number from -1 to 1 that stands for the places that shapes were made of.
fn name(shapes: &HeldShapes) -> f64 {
    let bits = |place: HeldPlace| {
        let numbers = [place.radius, place.displacement[0], place.displacement[1], place.displacement[2]];
        [u64::from(place.vertex)].into_iter().chain(numbers.map(f64::to_bits))
    };
    // FNV-1a over whole words. Its upper bits depend on all of them.
    let hash = shapes.places().flat_map(bits).fold(0xCBF2_9CE4_8422_2325_u64, |hash, word| {
        (hash ^ word).wrapping_mul(0x0000_0100_0000_01B3).rotate_left(29)
    });
    (hash >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
}
