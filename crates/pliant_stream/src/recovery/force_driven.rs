//! The better way: the receiver owns the damped model and steps it with the streamed reactions.

use super::{Forecast, HISTORY, History, Recovery};
use crate::state::{ModalState, Tick};
use crate::stepper::ForceStepper;
use crate::wire::FrameGrab;

/// A tick as it was stepped.
#[derive(Debug, Clone, Default)]
struct Stepped {
    tick: Tick,
    state: ModalState,
    force: Vec<f64>,
}

/// Steps the modal recurrence with the reactions. What was stepped on a guess is stepped again when the truth comes.
#[derive(Debug)]
pub struct ForceDriven {
    stepper: ForceStepper,
    tick: Tick,
    first: Tick,
    state: ModalState,
    load: Vec<f64>,
    past: Vec<Stepped>,
    grabs: Vec<FrameGrab>,
    forecast: Forecast,
    /// The body has a rigid frame of its own.
    free: bool,
    h: f64,
}

impl ForceDriven {
    /// At rest at tick 0; hands that are not heard of go where the forecast has them.
    pub fn new(stepper: ForceStepper, forecast: Forecast) -> Self {
        let modes = stepper.modes();
        let rest = stepper.at_rest();
        Self {
            free: stepper.is_free(),
            h: stepper.h(),
            stepper,
            tick: 0,
            first: 0,
            state: rest,
            load: vec![0.0; modes],
            past: vec![Stepped::default(); HISTORY],
            grabs: Vec::new(),
            forecast,
        }
    }

    fn remember(&mut self, tick: Tick) {
        let slot = &mut self.past[(tick % HISTORY as u64) as usize];
        slot.tick = tick;
        slot.state.copy_from(&self.state);
        slot.force.clear();
        slot.force.extend_from_slice(self.stepper.last_force());
    }

    fn step_to(&mut self, tick: Tick, history: &History) {
        self.grabs.clear();
        if let Some(data) = history.known(tick) {
            self.grabs.extend_from_slice(&data.grabs);
        } else if let Some(near) = history.last_known(tick) {
            self.grabs
                .extend(near.grabs.iter().filter_map(|g| history.grab(g.state.key, tick, &self.forecast)));
        }
        let pose = if self.free { history.pose(tick, self.h) } else { None };
        let rotation = pose.map_or([0.0, 0.0, 0.0, 1.0], |p| p.rotation);
        self.stepper.step(&mut self.state, &self.grabs, rotation, &self.load);
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
    fn restart(&mut self, tick: Tick, state: &ModalState, load: &[f64]) {
        let modes = self.state.modes();
        let fill = |mine: &mut Vec<f64>, theirs: &[f64]| {
            mine.clear();
            mine.extend(theirs.iter().copied().chain(std::iter::repeat(0.0)).take(modes));
        };
        self.state.fill_from(state.parts());
        fill(&mut self.load, load);
        self.stepper.restart();
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
        self.state.copy_from(&base.state);
        self.stepper.set_last_force(&base.force);
        for tick in from..=self.tick {
            self.step_to(tick, history);
        }
        true
    }

    fn refresh(&mut self, _tick: Tick, _history: &History) {
        // Slices are part of stepping to their tick.
    }

    fn hidden(&self) -> &ModalState {
        &self.state
    }

    fn load(&self) -> &[f64] {
        &self.load
    }

    fn last_force(&self) -> &[f64] {
        self.stepper.last_force()
    }

    fn driven_by_reactions(&self) -> bool {
        true
    }
}
