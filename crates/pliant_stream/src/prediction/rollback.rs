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

    /// Remembers another copy for a tick up to the present one.
    pub(crate) fn remember(&mut self, tick: Tick, copy: &BodyCopy) {
        self.past.place(tick).0.clone_from(copy);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::state::State;

    #[test]
    fn a_copy_returns_to_its_last_ticks_and_to_no_other() {
        let at = |tick: u64| State { q: vec![tick as f64], ..State::zero(1, false) };
        let mut rollback = Rollback::new(BodyCopy::new(at(0)), 4);
        for tick in 1..=6 {
            rollback.now.state = at(tick);
            rollback.reach(tick);
        }
        assert!(!rollback.back_to(2), "another tick has its place");
        assert!(!rollback.back_to(7), "not reached yet");
        assert_eq!((rollback.tick(), rollback.now.state.q[0]), (6, 6.0), "nothing changes then");
        assert!(rollback.back_to(4));
        assert_eq!((rollback.tick(), rollback.now.state.q[0]), (4, 4.0));
        // What was after it is void until it is stepped again.
        assert!(rollback.at(5).is_none() && !rollback.back_to(6));
        rollback.now.state = at(50);
        rollback.reach(5);
        assert_eq!(rollback.at(5).map(|copy| copy.state.q[0]), Some(50.0));
        assert!(rollback.back_to(3));
    }
}
