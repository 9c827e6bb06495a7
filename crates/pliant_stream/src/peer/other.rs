//! What a peer knows of another.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::session::Budget;
use crate::state::{Tick, UserId};

#[derive(Debug)]
pub(super) struct Other {
    /// Who it is, once it has said so.
    pub(super) user: Option<UserId>,
    /// Who it must be.
    pub(super) expected: UserId,
    pub(super) heard: Duration,
    pub(super) sequence: u16,
    /// Running mean of: own tick less theirs at arrival.
    pub(super) ahead: Option<f64>,
    /// The same as they see it.
    pub(super) theirs: Option<f64>,
    pub(super) asked: BTreeMap<Tick, Duration>,
    pub(super) max_datagram: usize,
    pub(super) mismatched: u32,
    pub(super) wants_state: bool,
    /// We have asked it for its state and it has not answered.
    pub(super) asked_state: bool,
    /// Ticks that it may have said again.
    pub(super) answer_budget: Budget,
    /// States that it may have.
    pub(super) state_budget: Budget,
}

impl Other {
    pub(super) fn new(now: Duration, expected: UserId, max_datagram: usize) -> Self {
        Self {
            user: None,
            expected,
            heard: now,
            sequence: 0,
            ahead: None,
            theirs: None,
            asked: BTreeMap::new(),
            max_datagram,
            mismatched: 0,
            wants_state: false,
            asked_state: false,
            // All of the window, asked for again every 150 ms, is 853 ticks a second: nobody honest asks for more.
            answer_budget: Budget::new(1000.0, 1000.0),
            state_budget: Budget::new(2.0, 16.0),
        }
    }
}
