//! One body at a peer: stepped at once, and stepped again when a late input arrives.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use pliant_modal::{Frame, Hand, Hold, Load, ModalModel, StepSettings};

use super::inputs::{InputLog, WINDOW};
use crate::StreamError;
use crate::codec::checksum::{checksum, projection};
use crate::newmark::{FlowFilter, Newmark};
use crate::recovery::{Blend, Forecast, PoseBlend};
use crate::replica::Replica;
use crate::state::{BodyId, GrabKey, GrabState, Pose, State, Tick, UserId};
use crate::wire::{HeldAt, PeerBodyState, PeerFrame, PeerGrip};

/// Correction of the state for a late input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Repair {
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

/// Force and target of a grab in a step.
#[derive(Debug, Clone, Copy, PartialEq)]
struct HandSlot {
    key: GrabKey,
    /// Force on the body at the end of the step (`pull`) and over it (`mean`), world axes, N.
    pull: Vector3<f64>,
    mean: Vector3<f64>,
    /// Position of the hand, world, m.
    target: Vector3<f64>,
    /// Viscoelastic state of the patch's residual flexibility, body axes, m.
    flow: Vector3<f64>,
}

#[derive(Debug, Clone, Default)]
struct Past {
    tick: Tick,
    state: State,
    pulls: Vec<HandSlot>,
    used: Vec<(UserId, HeldAt)>,
}

/// A body that this peer steps.
#[derive(Debug)]
pub struct PeerBody {
    pub(crate) id: BodyId,
    pub(crate) model: Arc<ModalModel>,
    replica: Replica,
    forecast: Forecast,
    newmark: Newmark,
    flow: Option<FlowFilter>,
    repair: Repair,
    tick: Tick,
    state: State,
    pulls: Vec<HandSlot>,
    past: Vec<Past>,
    held: Vec<(UserId, HeldAt)>,
    blend: Blend,
    pose_blend: PoseBlend,
    visual: State,
    pose: Option<Pose>,
    grabs: Vec<GrabState>,
    restepped: u64,
}

impl PeerBody {
    pub(crate) fn new(
        id: BodyId,
        model: Arc<ModalModel>,
        settings: &StepSettings,
        h: f64,
        repair: Repair,
        blend_ticks: u16,
    ) -> Result<Self, StreamError> {
        let replica = Replica::new(model.clone(), *settings, model.mode_count(), h)?;
        let rest = replica.kernel().at_rest();
        let (beta, gamma) = settings.integrator.newmark().unwrap_or((0.25, 0.5));
        let mut made = Self {
            id,
            pose: model.is_free().then(|| Pose::of_frame(&model, &rest.frame)),
            pose_blend: PoseBlend::new(h, blend_ticks),
            model,
            replica,
            forecast: Forecast::new(h),
            flow: settings.relaxation.map(|r| FlowFilter::new(r, &Newmark { h, beta, gamma }, WINDOW)),
            newmark: Newmark { h, beta, gamma },
            repair,
            tick: 0,
            state: rest.clone(),
            pulls: Vec::new(),
            past: vec![Past::default(); WINDOW],
            held: Vec::new(),
            blend: Blend::new(h, blend_ticks),
            visual: rest,
            grabs: Vec::new(),
            restepped: 0,
        };
        // A rollback can return to the initial state like to any other tick.
        made.remember();
        Ok(made)
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
        self.tick
    }

    /// The live state at [`PeerBody::tick`]: stepped with the inputs that are known, and with
    /// forecasts of those that are not.
    pub fn live(&self) -> &State {
        &self.state
    }

    /// The visual state for display and hands. It is continuous in position and velocity.
    pub fn visual(&self) -> &State {
        &self.visual
    }

    /// The visual rigid frame of a free body; `None` for an anchored one.
    pub fn pose(&self) -> Option<Pose> {
        self.pose
    }

    /// The rigid frame of a free body after a remembered tick.
    pub(crate) fn past_pose(&self, tick: Tick) -> Option<Pose> {
        self.past(tick)?;
        let past = &self.past[(tick % WINDOW as u64) as usize];
        self.model.is_free().then(|| Pose::of_frame(&self.model, &past.state.frame))
    }

    /// Returns the checksum of a remembered tick and the magnitude that scales its tolerance.
    pub(crate) fn check(&self, tick: Tick) -> Option<(f64, f64)> {
        let state = self.past(tick)?;
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
        Some((sum, size.sqrt()))
    }

    /// All grabs of the body, with their reactions.
    pub fn grabs(&self) -> &[GrabState] {
        &self.grabs
    }

    /// Number of ticks that were stepped again.
    pub fn restepped(&self) -> u64 {
        self.restepped
    }

    /// The state after a remembered tick.
    pub(crate) fn past(&self, tick: Tick) -> Option<&State> {
        let past = &self.past[(tick % WINDOW as u64) as usize];
        (past.tick == tick && tick <= self.tick && past.state.modes() > 0).then_some(&past.state)
    }

    /// Reactions (N) of the hands at a remembered tick, with their users.
    pub(crate) fn reactions_at(&self, tick: Tick) -> Option<Vec<(UserId, [f64; 3])>> {
        self.past(tick)?;
        let past = &self.past[(tick % WINDOW as u64) as usize];
        Some(past.pulls.iter().map(|g| (g.key.user, (-g.pull).into())).collect())
    }

    pub(crate) fn export(&self, tick: Tick) -> Option<PeerBodyState> {
        let past = &self.past[(tick % WINDOW as u64) as usize];
        (past.tick == tick && past.state.modes() > 0).then(|| PeerBodyState {
            body: self.id.0,
            q: past.state.q.clone(),
            v: past.state.v.clone(),
            a: past.state.a.clone(),
            z: past.state.z.clone(),
            force: past.state.f.clone(),
            frame: self.model.is_free().then_some(past.state.frame).map(|f| PeerFrame {
                center: f.center(),
                orientation: f.orientation(),
                velocity: f.velocity(),
                spin: f.spin(),
            }),
            pulls: past
                .pulls
                .iter()
                .map(|g| PeerGrip {
                    user: g.key.user.0,
                    grab: g.key.grab,
                    pull: g.pull.into(),
                    mean: g.mean.into(),
                    target: g.target.into(),
                    flow: g.flow.into(),
                })
                .collect(),
        })
    }

    /// Takes a state and steps from it to the tick `to`. Returns false when the state does not fit
    /// the body.
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
        let received = State { q, v, a, f, z, s: Vec::new(), frame: received.unwrap_or(self.state.frame) };
        if self.replica.kernel().check(&received).is_err() {
            return false;
        }
        let before = std::mem::replace(&mut self.state, received);
        let pull = |p: &PeerGrip| HandSlot {
            key: GrabKey { user: UserId(p.user), grab: p.grab },
            pull: p.pull.into(),
            mean: p.mean.into(),
            target: p.target.into(),
            flow: p.flow.into(),
        };
        self.pulls = state.pulls.iter().map(pull).collect();
        let fresh = self.tick == 0;
        self.tick = tick;
        self.remember();
        while self.tick < to {
            self.step_once(inputs);
        }
        if fresh {
            self.blend.clear();
            self.pose_blend.clear();
        } else {
            self.add_blend(&before);
        }
        self.show();
        true
    }

    /// Steps to the next tick.
    pub(crate) fn advance(&mut self, inputs: &InputLog) {
        self.step_once(inputs);
        self.blend.advance();
        self.pose_blend.advance();
        self.show();
    }

    /// Corrects the state for new inputs at tick `from` and later. Returns false when `from` is not
    /// remembered.
    pub(crate) fn correct(&mut self, from: Tick, inputs: &InputLog) -> bool {
        if from > self.tick {
            return true;
        }
        let Some(base) = from.checked_sub(1) else { return false };
        let past = &self.past[(base % WINDOW as u64) as usize];
        if past.tick != base || past.state.modes() == 0 {
            return false;
        }
        let before = self.state.clone();
        match self.repair {
            Repair::Rollback => {
                let to = self.tick;
                self.state.clone_from(&past.state);
                self.pulls.clone_from(&past.pulls);
                self.tick = base;
                while self.tick < to {
                    self.step_once(inputs);
                    self.restepped += 1;
                }
            }
            Repair::Compensate => self.compensate(from, inputs),
        }
        self.add_blend(&before);
        true
    }

    /// Applies equations (8) and (9) to every tick from `from` on whose known inputs differ from
    /// those used.
    fn compensate(&mut self, from: Tick, inputs: &InputLog) {
        let mut held = Vec::new();
        for tick in from..=self.tick {
            let index = (tick % WINDOW as u64) as usize;
            let known = inputs.held(tick, self.id, &self.forecast, &mut held);
            if self.past[index].tick != tick || !known || held == self.past[index].used {
                continue;
            }
            let before = &self.past[((tick - 1) % WINDOW as u64) as usize];
            if before.tick + 1 != tick {
                continue;
            }
            let (mut with, mut without) = (before.state.clone(), before.state.clone());
            let (mut pulls, mut old_pulls) = (before.pulls.clone(), before.pulls.clone());
            let used = std::mem::take(&mut self.past[index].used);
            Self::press(&mut self.replica, &mut with, &mut pulls, &held);
            Self::press(&mut self.replica, &mut without, &mut old_pulls, &used);
            // The history is corrected like the present state, because later corrections and checks
            // use it.
            for t in tick..=self.tick {
                let at = (t % WINDOW as u64) as usize;
                if self.past[at].tick != t {
                    continue;
                }
                let (to_q, to_v) = self.newmark.response(t - tick);
                let to_z = self.flow.as_ref().map_or(0.0, |flow| flow.response(t - tick));
                let seconds = (t - tick) as f64 * self.replica.kernel().h();
                let moved = self
                    .model
                    .is_free()
                    .then(|| self.moved(&self.past[at].state.frame, &with.frame, &without.frame, seconds));
                let state = &mut self.past[at].state;
                for k in 0..state.modes() {
                    let da = with.a[k] - without.a[k];
                    // The difference at the tick itself is known exactly.
                    let own = t == tick;
                    state.q[k] += if own { with.q[k] - without.q[k] } else { to_q * da };
                    state.v[k] += if own { with.v[k] - without.v[k] } else { to_v * da };
                    if let Some(z) = state.z.get_mut(k) {
                        *z += to_z * da;
                    }
                }
                if let Some(frame) = moved {
                    state.frame = frame;
                }
            }
            let now = &mut self.past[index];
            (now.state.a, now.state.f) = (with.a, with.f);
            now.pulls = pulls;
            self.past[index].used.clone_from(&held);
            self.restepped += 1;
        }
        let now = &self.past[(self.tick % WINDOW as u64) as usize];
        self.state.clone_from(&now.state);
        self.pulls.clone_from(&now.pulls);
    }

    /// Returns the frame as it would be if the body had been at `there` instead of `here` `seconds`
    /// ago. The difference in velocity and spin has acted since.
    fn moved(&self, frame: &Frame, there: &Frame, here: &Frame, seconds: f64) -> Frame {
        let of = |f: fn(&Frame) -> [f64; 3]| Vector3::from(f(there)) - Vector3::from(f(here));
        let (faster, spin) = (of(Frame::velocity), of(Frame::spin));
        let center = Vector3::from(frame.center()) + of(Frame::center) + faster * seconds;
        let turning = there.angular_velocity(&self.model) - here.angular_velocity(&self.model);
        let turned = (there.rotation() * here.rotation().inverse()).scaled_axis() + turning * seconds;
        let turn = UnitQuaternion::from_scaled_axis(turned) * frame.rotation();
        let velocity = Vector3::from(frame.velocity()) + faster;
        let spin = Vector3::from(frame.spin()) + spin;
        let q = [turn.i, turn.j, turn.k, turn.w];
        Frame::from_motion(&self.model, center.into(), q, velocity.into(), spin.into()).unwrap_or(*frame)
    }

    fn step_once(&mut self, inputs: &InputLog) {
        let tick = self.tick + 1;
        let mut held = std::mem::take(&mut self.held);
        inputs.held(tick, self.id, &self.forecast, &mut held);
        Self::press(&mut self.replica, &mut self.state, &mut self.pulls, &held);
        self.held = held;
        self.tick = tick;
        self.remember();
    }

    /// Steps a state with hands once and replaces `pulls` by the grabs of this step.
    fn press(replica: &mut Replica, state: &mut State, pulls: &mut Vec<HandSlot>, held: &[(UserId, HeldAt)]) {
        let mut hands = Vec::with_capacity(held.len());
        let mut keys = Vec::with_capacity(held.len());
        for (user, g) in held {
            // All peers ignore the same patches. A patch larger than the body would visit every
            // vertex of the body.
            if g.radius > replica.model().size() {
                continue;
            }
            let Some(patch) = replica.patch(g.vertex, g.radius) else { continue };
            let key = g.key(*user);
            let (target, config) = (Vector3::from(g.target), g.hold);
            let before = pulls.iter().find(|p| p.key == key);
            // A new hand has not moved yet.
            let way = before.map_or_else(Vector3::zeros, |before| target - before.target);
            let velocity = way / replica.kernel().h();
            let hand = Hand::new(patch, Hold::Target { target, velocity, config });
            hands.push(match before {
                Some(before) => Hand { pull: before.pull, mean: before.mean, flow: before.flow, ..hand },
                None => hand,
            });
            keys.push((key, target));
        }
        replica.step(state, &mut hands, &Load::default());
        pulls.clear();
        let grip = |((key, target), hand): ((GrabKey, Vector3<f64>), &Hand)| {
            let &Hand { pull, mean, flow, .. } = hand;
            HandSlot { key, pull, mean, target, flow }
        };
        pulls.extend(keys.into_iter().zip(&hands).map(grip));
    }

    fn remember(&mut self) {
        let past = &mut self.past[(self.tick % WINDOW as u64) as usize];
        past.tick = self.tick;
        past.state.clone_from(&self.state);
        past.pulls.clone_from(&self.pulls);
        past.used.clone_from(&self.held);
    }

    fn add_blend(&mut self, before: &State) {
        let now = &self.state;
        self.blend.add(
            before.q.iter().zip(&now.q).map(|(b, n)| b - n),
            before.v.iter().zip(&now.v).map(|(b, n)| b - n),
        );
        if self.model.is_free() {
            let (before, now) = (&before.frame, &now.frame);
            self.pose_blend.add(&Pose::of_frame(&self.model, before), &Pose::of_frame(&self.model, now));
        }
    }

    fn show(&mut self) {
        self.visual.clone_from(&self.state);
        self.blend.apply(&mut self.visual.q, &mut self.visual.v);
        let pose = self.model.is_free().then(|| Pose::of_frame(&self.model, &self.state.frame));
        self.pose = pose.map(|pose| self.pose_blend.apply(&pose));
        self.grabs.clear();
        for (user, g) in &self.held {
            let key = g.key(*user);
            let pull = self.pulls.iter().find(|p| p.key == key).map_or_else(Vector3::zeros, |p| p.pull);
            self.grabs.push(GrabState {
                key,
                vertex: g.vertex,
                radius: g.radius,
                target: g.target,
                reaction: (-pull).into(),
            });
        }
    }
}
