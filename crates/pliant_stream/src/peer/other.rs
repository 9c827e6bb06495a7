//! What a peer knows of another.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::link::{Budget, Link};
use crate::state::{BodyId, PeerId, Tick, UserId};

/// Disagreements in a row before the other's state is taken over.
const CHECKS: u32 = 3;

#[derive(Debug)]
pub(super) struct Other {
    pub(super) link: Link,
    /// Who it is, once it has said so.
    pub(super) user: Option<UserId>,
    /// Who it must be.
    pub(super) expected: UserId,
    /// How early datagrams come, s: own clock less their ticks' time, the mean of it.
    pub(super) way: Option<f64>,
    /// Running mean of: own tick less theirs at arrival.
    pub(super) ahead: Option<f64>,
    /// The same as they see it.
    pub(super) theirs: Option<f64>,
    pub(super) asked: BTreeMap<Tick, Duration>,
    /// Checks in a row that disagreed, for each body.
    pub(super) mismatched: BTreeMap<BodyId, u32>,
    /// What it said came too late to be of use: only a state can help.
    pub(super) lost: bool,
    pub(super) wants_state: bool,
    /// We have asked it for its state and it has not answered.
    pub(super) asked_state: bool,
    /// Ticks that it may have said again.
    pub(super) answer_budget: Budget,
    /// States that it may have.
    pub(super) state_budget: Budget,
}

impl Other {
    pub(super) fn new(peer: PeerId, now: Duration, expected: UserId, max_datagram: usize) -> Self {
        Self {
            link: Link::new(peer, now, max_datagram),
            user: None,
            expected,
            way: None,
            ahead: None,
            theirs: None,
            asked: BTreeMap::new(),
            mismatched: BTreeMap::new(),
            lost: false,
            wants_state: false,
            asked_state: false,
            // All of the window, asked for again every 150 ms, is 853 ticks a second: nobody honest asks for more.
            answer_budget: Budget::new(1000.0, 1000.0),
            state_budget: Budget::new(2.0, 16.0),
        }
    }

    /// Whether a body of ours lastingly differs from this peer's.
    pub(super) fn is_apart(&self) -> bool {
        self.lost || self.mismatched.values().any(|count| *count >= CHECKS)
    }

    /// Forgets what differed.
    pub(super) fn agreed(&mut self) {
        self.mismatched.clear();
        self.lost = false;
    }

    /// Takes in when a datagram came that was sent at `theirs` (s of the sender's ticks): how unevenly the way takes (RFC 3550, 6.4.1).
    pub(super) fn came(&mut self, now: Duration, theirs: f64) {
        let early = now.as_secs_f64() - theirs;
        let off = early - *self.way.get_or_insert(early);
        // Far off: one of the clocks has jumped.
        if off.abs() > 10.0 {
            self.way = Some(early);
            return;
        }
        self.way = self.way.map(|way| way + off / 16.0);
        let jitter = self.link.stats.jitter.as_secs_f64();
        self.link.stats.jitter = Duration::from_secs_f64(jitter + (off.abs() - jitter) / 16.0);
    }
}
