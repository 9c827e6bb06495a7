//! Values of the last ticks.

use crate::state::Tick;

/// Values by tick. A tick takes the place of the tick one length before.
#[derive(Debug, Clone)]
pub(crate) struct Ring<T> {
    slots: Vec<(Option<Tick>, T)>,
}

impl<T: Clone + Default> Ring<T> {
    /// Makes an empty ring for at least one tick.
    pub(crate) fn new(length: usize) -> Self {
        Self { slots: vec![(None, T::default()); length.max(1)] }
    }

    fn index(&self, tick: Tick) -> usize {
        (tick % self.slots.len() as u64) as usize
    }

    /// The value of a tick, if it is remembered.
    pub(crate) fn get(&self, tick: Tick) -> Option<&T> {
        let (at, value) = &self.slots[self.index(tick)];
        (*at == Some(tick)).then_some(value)
    }

    /// As [`Ring::get`], to change the value.
    pub(crate) fn get_mut(&mut self, tick: Tick) -> Option<&mut T> {
        let index = self.index(tick);
        let (at, value) = &mut self.slots[index];
        (*at == Some(tick)).then_some(value)
    }

    /// The place of a tick, and whether it still holds the value of another tick, whose memory can
    /// be used again.
    pub(crate) fn place(&mut self, tick: Tick) -> (&mut T, bool) {
        let index = self.index(tick);
        let (at, value) = &mut self.slots[index];
        let other = at.replace(tick) != Some(tick);
        (value, other)
    }
}
