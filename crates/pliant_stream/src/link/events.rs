//! A bounded queue of events for the application.

use std::collections::VecDeque;

/// Largest number of events that wait for the application.
const MAX: usize = 4096;

/// Events in order. When the queue is full, an event is dropped and counted.
#[derive(Debug)]
pub(crate) struct Events<T> {
    waiting: VecDeque<T>,
    dropped: u64,
}

impl<T> Default for Events<T> {
    fn default() -> Self {
        Self { waiting: VecDeque::new(), dropped: 0 }
    }
}

impl<T> Events<T> {
    /// Adds an event. A full queue drops its oldest one.
    pub(crate) fn push(&mut self, event: T) {
        self.push_sparing(event, |_| true);
    }

    /// As [`Events::push`], but a full queue drops its oldest event that `can_go`, or the new one.
    /// Where none can go, it drops the oldest.
    pub(crate) fn push_sparing(&mut self, event: T, can_go: impl Fn(&T) -> bool) {
        if self.waiting.len() >= MAX {
            self.dropped += 1;
            match self.waiting.iter().position(&can_go) {
                Some(oldest) => drop(self.waiting.remove(oldest)),
                None if can_go(&event) => return,
                None => drop(self.waiting.pop_front()),
            }
        }
        self.waiting.push_back(event);
    }

    pub(crate) fn pop(&mut self) -> Option<T> {
        self.waiting.pop_front()
    }

    /// Number of events that were dropped before the application fetched them.
    pub(crate) fn dropped(&self) -> u64 {
        self.dropped
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_queue_drops_its_oldest_event_that_can_go() {
        let mut events = Events::default();
        let odd = |event: &usize| event % 2 == 1;
        (0..MAX).for_each(|event| events.push_sparing(event, odd));
        events.push_sparing(MAX, odd);
        assert_eq!((events.dropped(), events.waiting.get(1)), (1, Some(&2)), "0 stays and 1 goes");
        (1..MAX / 2).for_each(|_| events.push_sparing(0, odd));
        assert_eq!(events.pop(), Some(0), "all odd ones are gone, and all even ones are there");
        (0..2).for_each(|_| events.push_sparing(0, odd));
        assert_eq!(events.pop(), Some(4), "where none can go, the oldest does");
        events.push_sparing(0, odd);
        events.push_sparing(1, odd);
        assert_eq!((events.pop(), events.waiting.back()), (Some(6), Some(&0)), "the new one goes first");
        assert_eq!((events.dropped(), events.waiting.len()), (MAX as u64 / 2 + 2, MAX - 1));
    }
}
