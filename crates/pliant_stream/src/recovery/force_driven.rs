//! The force-driven policy: the receiver steps its own damped model with the streamed reactions.

use super::{Forecast, HISTORY, History, Recovery};
use crate::replica::{self, Mean, Replica};
use crate::state::{State, Tick};
use crate::wire::FrameGrab;

/// The state after a stepped tick.
#[derive(Debug, Clone, Default)]
struct Stepped {
    tick: Tick,
    state: State,
    means: Vec<Mean>,
}

/// Steps the modal recurrence with the reactions. When data arrives for a predicted tick, the
/// policy steps again from that tick.
#[derive(Debug)]
pub struct ForceDriven {
    replica: Replica,
    tick: Tick,
    first: Tick,
    state: State,
    load: Vec<f64>,
    means: Vec<Mean>,
    past: Vec<Stepped>,
    grabs: Vec<FrameGrab>,
    forecast: Forecast,
}

impl ForceDriven {
    /// Starts at rest at tick 0. Hands without data move as `forecast` predicts.
    pub(crate) fn new(replica: Replica, forecast: Forecast) -> Self {
        let state = replica.kernel().at_rest();
        Self {
            tick: 0,
            first: 0,
            load: vec![0.0; state.modes()],
            means: Vec::new(),
            state,
            past: vec![Stepped::default(); HISTORY],
            grabs: Vec::new(),
            forecast,
            replica,
        }
    }

    fn remember(&mut self, tick: Tick) {
        let slot = &mut self.past[(tick % HISTORY as u64) as usize];
        slot.tick = tick;
        slot.state.clone_from(&self.state);
        slot.means.clone_from(&self.means);
    }

    fn step_to(&mut self, tick: Tick, history: &History) {
        self.grabs.clear();
        if let Some(data) = history.known(tick) {
            self.grabs.extend_from_slice(&data.grabs);
        } else if let Some(near) = history.last_known(tick) {
            self.grabs
                .extend(near.grabs.iter().filter_map(|g| history.grab(g.state.key, tick, &self.forecast)));
        }
        if self.replica.model().is_free() {
            let pose = history.pose(tick, self.replica.kernel().h());
            replica::place(&mut self.state, self.replica.model(), pose.as_ref());
        }
        self.replica.step_measured(&mut self.state, &self.grabs, &self.load, &mut self.means);
        self.take_slice(tick, history);
        self.remember(tick);
    }

    fn take_slice(&mut self, tick: Tick, history: &History) {
        let Some(data) = history.known(tick) else { return };
        let modes = self.load.len();
        for e in data.slice.iter().filter(|e| e.mode < modes) {
            self.state.q[e.mode] = e.q;
            self.state.v[e.mode] = e.v;
            if let Some(z) = self.state.z.get_mut(e.mode) {
                *z = e.z;
            }
            self.load[e.mode] = e.load;
        }
    }
}

impl Recovery for ForceDriven {
    fn restart(&mut self, tick: Tick, state: &State, load: &[f64], means: &[Mean]) {
        let modes = self.state.modes();
        let fill = |mine: &mut Vec<f64>, theirs: &[f64]| {
            mine.clear();
            mine.extend(theirs.iter().copied().chain(std::iter::repeat(0.0)).take(modes));
        };
        replica::fill(&mut self.state, [&state.q, &state.v, &state.a, &state.z]);
        fill(&mut self.load, load);
        self.means.clear();
        self.means.extend_from_slice(means);
        (self.tick, self.first) = (tick, tick);
        self.remember(tick);
    }

    fn advance(&mut self, tick: Tick, history: &History) {
        self.step_to(tick, history);
        self.tick = tick;
    }

    fn correct(&mut self, from: Tick, history: &History) -> bool {
        if from <= self.first || from > self.tick || from + (HISTORY as u64) <= self.tick {
            return false;
        }
        let base = &self.past[((from - 1) % HISTORY as u64) as usize];
        if base.tick != from - 1 || base.state.modes() != self.state.modes() {
            return false;
        }
        self.state.clone_from(&base.state);
        self.means.clone_from(&base.means);
        for tick in from..=self.tick {
            self.step_to(tick, history);
        }
        true
    }

    fn refresh(&mut self, _tick: Tick, _history: &History) {
        // Stepping to a tick already applies the slices of that tick.
    }

    fn confirmed(&self) -> &State {
        &self.state
    }

    fn load(&self) -> &[f64] {
        &self.load
    }

    fn means(&self) -> &[Mean] {
        &self.means
    }

    fn driven_by_reactions(&self) -> bool {
        true
    }
}
