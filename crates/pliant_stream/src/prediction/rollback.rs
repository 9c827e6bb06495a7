//! The last copies of a body by tick, to return to.

use super::{BodyCopy, Ring};
use crate::state::Tick;

/// A body's copy and its past.
#[derive(Debug)]
pub(crate) struct Rollback {
    tick: Tick,
    /// The copy at [`Rollback::tick`].
    pub now: BodyCopy,
    past: Ring<BodyCopy>,
}

impl Rollback {
    /// Begins at tick 0 and remembers the last `length` ticks.
    pub(crate) fn new(now: BodyCopy, length: usize) -> Self {
        let mut made = Self { tick: 0, now, past: Ring::new(length) };
        made.reach(0);
        made
    }

    /// The tick of the copy.
    pub(crate) fn tick(&self) -> Tick {
        self.tick
    }

    /// Takes the copy for that of `tick`, and remembers it.
    pub(crate) fn reach(&mut self, tick: Tick) {
        self.tick = tick;
        self.past.place(tick).0.clone_from(&self.now);
    }

    /// The copy at a tick that is remembered.
    pub(crate) fn at(&self, tick: Tick) -> Option<&BodyCopy> {
        self.past.get(tick).filter(|_| tick <= self.tick)
    }

    /// As [`Rollback::at`], to correct the past.
    pub(crate) fn at_mut(&mut self, tick: Tick) -> Option<&mut BodyCopy> {
        let now = self.tick;
        self.past.get_mut(tick).filter(|_| tick <= now)
    }

    /// Returns to a tick. Returns false, and changes nothing, if it is not remembered.
    pub(crate) fn back_to(&mut self, tick: Tick) -> bool {
        let Some(copy) = self.past.get(tick).filter(|_| tick <= self.tick) else { return false };
        self.now.clone_from(copy);
        self.tick = tick;
        true
    }
}
