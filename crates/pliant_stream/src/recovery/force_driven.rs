//! The force-driven policy: the receiver steps its own damped model with the streamed reactions.

use nalgebra::Vector3;
use pliant_modal::{ContactState, Frame, Load};

use super::{Forecast, HISTORY, History, Recovery};
use crate::prediction::{BodyCopy, HandState, Rollback};
use crate::replica::{self, Replica};
use crate::state::{State, Tick};
use crate::wire::FrameGrab;

/// Steps the modal recurrence with the reactions. When data arrives for a predicted tick, the
/// policy steps again from that tick.
#[derive(Debug)]
pub struct ForceDriven {
    replica: Replica,
    /// The tick of the last restart. Rollback never goes to an earlier tick.
    first: Tick,
    rollback: Rollback,
    load: Vec<f64>,
    /// The contact forces of the last step, see [`Recovery::contact_push`].
    push: [Vector3<f64>; 2],
    grabs: Vec<FrameGrab>,
    forecast: Forecast,
}

impl ForceDriven {
    /// Starts at rest at tick 0. Hands without data move as `forecast` predicts.
    pub(crate) fn new(replica: Replica, forecast: Forecast) -> Self {
        let state = replica.kernel().at_rest();
        Self {
            first: 0,
            load: vec![0.0; state.modes()],
            push: [Vector3::zeros(); 2],
            rollback: Rollback::new(BodyCopy::new(state), HISTORY),
            grabs: Vec::new(),
            forecast,
            replica,
        }
    }

    fn step_to(&mut self, tick: Tick, history: &History) {
        self.grabs.clear();
        if let Some(data) = history.known(tick) {
            self.grabs.extend_from_slice(&data.grabs);
        } else if let Some(near) = history.last_known(tick) {
            self.grabs
                .extend(near.grabs.iter().filter_map(|g| history.grab(g.state.key, tick, &self.forecast)));
        }
        let (copy, replica) = (&mut self.rollback.now, &mut self.replica);
        let touches = replica.touches();
        // A guess of the pose would lead through the floor. A body that touches is stepped instead.
        let pose =
            if touches { history.received_pose(tick) } else { history.pose(tick, replica.kernel().h()) };
        let frame = replica.end_frame(copy, pose.as_ref());
        if touches && frame.is_none() {
            replica.release_all();
            for g in &self.grabs {
                let before = history.grab(g.state.key, tick.saturating_sub(1), &self.forecast);
                replica.hold_streamed(copy, g, before.as_ref());
            }
            replica.step_held(copy, &Load { modal: &self.load, ..Load::default() });
        } else {
            replica.step_measured(copy, &self.grabs, &self.load, frame);
        }
        if touches {
            self.push = replica.contact_push(&Vector3::from(copy.state.frame.center()));
        }
        self.take_slice(tick, history);
        self.rollback.reach(tick);
    }

    fn take_slice(&mut self, tick: Tick, history: &History) {
        let Some(data) = history.known(tick) else { return };
        let modes = self.load.len();
        let state = &mut self.rollback.now.state;
        for e in data.slice.iter().filter(|e| e.mode < modes) {
            state.q[e.mode] = e.q;
            state.v[e.mode] = e.v;
            if let Some(z) = state.z.get_mut(e.mode) {
                *z = e.z;
            }
            self.load[e.mode] = e.load;
        }
    }
}

impl Recovery for ForceDriven {
    fn restart(
        &mut self,
        tick: Tick,
        state: &State,
        load: &[f64],
        hands: &[HandState],
        contacts: &ContactState,
    ) {
        let (copy, modes) = (&mut self.rollback.now, self.load.len());
        replica::fill(&mut copy.state, [&state.q, &state.v, &state.a, &state.z]);
        copy.state.frame = state.frame;
        copy.contacts.clone_from(contacts);
        copy.hands.clear();
        copy.hands.extend_from_slice(hands);
        self.load.clear();
        self.load.extend(load.iter().copied().chain(std::iter::repeat(0.0)).take(modes));
        self.first = tick;
        self.rollback.reach(tick);
    }

    fn advance(&mut self, tick: Tick, history: &History) {
        self.step_to(tick, history);
    }

    fn correct(&mut self, from: Tick, history: &History) -> bool {
        let to = self.rollback.tick();
        if from <= self.first || from > to || !self.rollback.back_to(from - 1) {
            return false;
        }
        (from..=to).for_each(|tick| self.step_to(tick, history));
        true
    }

    fn refresh(&mut self, _tick: Tick, _history: &History) {
        // Stepping to a tick already applies the slices of that tick.
    }

    fn confirmed(&self) -> &State {
        &self.rollback.now.state
    }

    fn load(&self) -> &[f64] {
        &self.load
    }

    fn frame(&self) -> Option<&Frame> {
        self.replica.touches().then_some(&self.rollback.now.state.frame)
    }

    fn contacts(&self) -> Option<&ContactState> {
        Some(&self.rollback.now.contacts)
    }

    fn contact_push(&self) -> [Vector3<f64>; 2] {
        self.push
    }

    fn hands(&self) -> &[HandState] {
        &self.rollback.now.hands
    }

    fn driven_by_reactions(&self) -> bool {
        true
    }
}
