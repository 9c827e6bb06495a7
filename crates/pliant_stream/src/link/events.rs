//! A bounded queue of events for the application.

use std::collections::VecDeque;

/// Largest number of events that wait for the application.
const MAX: usize = 4096;

/// Events in order. When the queue is full, the oldest event is dropped and counted.
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
    pub(crate) fn push(&mut self, event: T) {
        if self.waiting.len() >= MAX {
            self.waiting.pop_front();
            self.dropped += 1;
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
