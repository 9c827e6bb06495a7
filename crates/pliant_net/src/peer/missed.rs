//! Whom a peer misses, and at which addresses it looks for them.
//!
//! An address that another peer reports may be false, by a lie or because it is old. Each reporter
//! has an address of its own for everybody who is missed, and only so many calls under way, so that
//! a false one keeps no true one away.

use std::collections::BTreeSet;
use std::time::Duration;

use pliant_stream::{PeerId, UserId};
use tracing::debug;

use crate::retry::Retry;
use crate::transport::{Fingerprint, Invite};

/// Most lost peers that are tracked, and most that one reporter may report. Of those that were lost
/// here, the one that was lost first is given up first.
const MAX_MISSED: usize = 64;
/// Most calls under way to addresses that one reporter has reported, and that all have reported.
const CALLS_OF_ONE: usize = 8;
const CALLS_OF_ALL: usize = 64;

/// An address at which a peer is looked for.
#[derive(Debug, Clone)]
struct Trace {
    number: UserId,
    invite: Invite,
    /// Who has reported the address; `None` for a peer that was lost here.
    reporter: Option<UserId>,
    retry: Retry,
    /// The next attempt may be made.
    due: bool,
    attempts: u32,
    /// The attempt under way.
    calling: Option<PeerId>,
}

impl Trace {
    /// Whether two traces lead to one place, with whatever token.
    fn meets(&self, other: &Self) -> bool {
        let place = |trace: &Self| (trace.number, trace.invite.port, trace.invite.fingerprint);
        place(self) == place(other) && self.invite.host == other.invite.host
    }
}

/// The peers that are missed.
#[derive(Debug)]
pub(super) struct Missed {
    traces: Vec<Trace>,
    /// How long a peer is looked for.
    patience: Duration,
    /// The own key, by which pauses differ.
    key: Fingerprint,
}

impl Missed {
    pub(super) fn new(patience: Duration, key: Fingerprint) -> Self {
        Self { traces: Vec::new(), patience, key }
    }

    /// Number of peers that are looked for.
    pub(super) fn count(&self) -> usize {
        self.traces.iter().map(|trace| trace.number).collect::<BTreeSet<_>>().len()
    }

    /// Looks for a peer that was lost here, where it was last reached.
    pub(super) fn lose(&mut self, now: Duration, number: UserId, invite: Invite) {
        let own = || self.traces.iter().filter(|trace| trace.reporter.is_none());
        if own().any(|trace| trace.number == number) {
            return;
        }
        if own().count() >= MAX_MISSED
            && let Some(first) = self.traces.iter().position(|trace| trace.reporter.is_none())
        {
            self.traces.remove(first);
        }
        self.look(now, number, invite, None);
    }

    /// Looks for a peer where another one reports it. A reporter's later address takes the
    /// place of its earlier one, unless that is being called.
    pub(super) fn report(&mut self, now: Duration, reporter: UserId, number: UserId, invite: Invite) {
        let reported = |trace: &&Trace| trace.reporter == Some(reporter);
        let count = self.traces.iter().filter(reported).count();
        let before = self.traces.iter().position(|trace| reported(&trace) && trace.number == number);
        match before.and_then(|at| self.traces.get(at).map(|trace| (at, trace))) {
            Some((_, trace)) if trace.calling.is_some() || trace.invite == invite => {}
            Some((at, _)) => {
                self.traces.remove(at);
                self.look(now, number, invite, Some(reporter));
            }
            None if count < MAX_MISSED => self.look(now, number, invite, Some(reporter)),
            None => {}
        }
    }

    fn look(&mut self, now: Duration, number: UserId, invite: Invite, reporter: Option<UserId>) {
        let mut retry = Retry::default();
        if retry.schedule(now, self.patience, self.key) {
            debug!("user {} is looked for", number.0);
            self.traces.push(Trace {
                number,
                invite,
                reporter,
                retry,
                due: false,
                attempts: 0,
                calling: None,
            });
        }
    }

    /// Takes the end of a connection. Returns whether it was an attempt. The other peer may not
    /// have noticed the loss yet, so its answer does not matter: only the time ends the attempts.
    pub(super) fn ended(&mut self, now: Duration, peer: PeerId) -> bool {
        let Some(trace) = self.traces.iter_mut().find(|trace| trace.calling == Some(peer)) else {
            return false;
        };
        trace.calling = None;
        trace.retry.schedule(now, self.patience, self.key);
        true
    }

    /// Stops looking for a peer that has connected. Returns the attempts under way.
    pub(super) fn found(&mut self, number: UserId) -> Vec<PeerId> {
        let found = self.traces.extract_if(.., |trace| trace.number == number);
        found.filter_map(|trace| trace.calling).collect()
    }

    /// Makes the attempts that are due, and gives up those who are missed for too long. `connect`
    /// returns nothing for an address that cannot be called.
    pub(super) fn call(&mut self, now: Duration, mut connect: impl FnMut(UserId, &Invite) -> Option<PeerId>) {
        self.traces.retain(|trace| !trace.retry.is_over(now, self.patience));
        self.traces.iter_mut().for_each(|trace| trace.due |= trace.retry.is_due(now));
        while let Some(trace) = self.next().and_then(|at| self.traces.get_mut(at)) {
            trace.due = false;
            trace.attempts += 1;
            trace.calling = connect(trace.number, &trace.invite);
            if trace.calling.is_none() {
                trace.retry.schedule(now, self.patience, self.key);
            }
        }
    }

    /// The trace to call next: of the reporter with the fewest calls under way, the one with the
    /// fewest attempts.
    fn next(&self) -> Option<usize> {
        let under_way = || self.traces.iter().filter(|trace| trace.calling.is_some());
        let calls = |trace: &Trace| match trace.reporter {
            None => 0,
            reporter => under_way().filter(|other| other.reporter == reporter).count(),
        };
        let all = under_way().filter(|trace| trace.reporter.is_some()).count();
        let room =
            |trace: &Trace| trace.reporter.is_none() || (all < CALLS_OF_ALL && calls(trace) < CALLS_OF_ONE);
        let may = |trace: &Trace| {
            let free = trace.due && trace.calling.is_none() && room(trace);
            free && !under_way().any(|other| other.meets(trace))
        };
        let may = self.traces.iter().enumerate().filter(|(_, trace)| may(trace));
        may.min_by_key(|(_, trace)| (calls(trace), trace.attempts)).map(|(at, _)| at)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed test should panic")]

    use super::*;

    const S: Duration = Duration::from_secs(1);
    const KEY: Fingerprint = Fingerprint([7; 32]);
    const MALICIOUS: UserId = UserId(3);
    const HONEST: UserId = UserId(4);
    const LOST: UserId = UserId(2);

    fn at(port: u16) -> Invite {
        Invite::new(([192, 0, 2, 7], port).into(), KEY)
    }

    /// Makes the calls that are due, and returns the ports that are called. Connections are
    /// numbered by their ports.
    fn calls(missed: &mut Missed, now: Duration) -> Vec<u16> {
        let mut called = Vec::new();
        missed.call(now, |_, invite| {
            called.push(invite.port);
            Some(PeerId(u64::from(invite.port)))
        });
        called
    }

    #[test]
    fn a_false_address_keeps_no_true_one_away() {
        let mut missed = Missed::new(60 * S, KEY);
        // The false one is called first, and nobody answers.
        missed.report(Duration::ZERO, MALICIOUS, LOST, at(666));
        assert_eq!(calls(&mut missed, S), [666]);
        missed.report(S, HONEST, LOST, at(1));
        assert_eq!(calls(&mut missed, 2 * S), [1], "the true one is called beside it");
        assert_eq!(missed.count(), 1, "one peer is looked for");
        assert_eq!(missed.found(LOST), [PeerId(666), PeerId(1)]);
        assert_eq!(missed.count(), 0);
        // Where it was last reached here is called beside what others tell, too.
        missed.report(2 * S, MALICIOUS, LOST, at(666));
        missed.lose(2 * S, LOST, at(1));
        let mut called = calls(&mut missed, 3 * S);
        called.sort_unstable();
        assert_eq!(called, [1, 666]);
    }

    #[test]
    fn false_addresses_of_one_reporter_leave_room_for_those_of_another() {
        let mut missed = Missed::new(60 * S, KEY);
        let (mut largest, mut called) = (0, 0);
        for half in 0..40_u16 {
            let now = S / 2 * u32::from(half);
            for number in 1..=200 {
                missed.report(now, MALICIOUS, UserId(number), at(1000 + number + 200 * half));
            }
            largest = largest.max(missed.traces.len());
            called += calls(&mut missed, now + S / 4).len();
        }
        assert_eq!((largest, called), (MAX_MISSED, CALLS_OF_ONE), "none of the calls ends");
        let now = 20 * S;
        missed.report(now, HONEST, LOST, at(1));
        missed.lose(now, UserId(300), at(2));
        let mut called = calls(&mut missed, now + S);
        called.sort_unstable();
        assert_eq!(called, [1, 2], "while {CALLS_OF_ONE} calls of the liar's are under way");
    }

    #[test]
    fn two_that_tell_of_one_place_cause_one_call_at_a_time() {
        let mut missed = Missed::new(60 * S, KEY);
        missed.report(Duration::ZERO, MALICIOUS, LOST, at(1));
        missed.report(Duration::ZERO, HONEST, LOST, at(1));
        assert_eq!(calls(&mut missed, S), [1]);
        assert!(missed.ended(S, PeerId(1)));
        assert!(!missed.ended(S, PeerId(1)), "it has ended");
        assert_eq!(calls(&mut missed, S), [1], "the other one's, with its token");
        // Nobody is called for longer than the patience.
        assert!(missed.ended(59 * S, PeerId(1)));
        assert_eq!(calls(&mut missed, 61 * S), [0_u16; 0]);
        assert_eq!(missed.count(), 0);
    }

    #[test]
    fn of_those_that_were_lost_here_the_first_is_given_up_first() {
        let mut missed = Missed::new(60 * S, KEY);
        for number in 1..=70 {
            missed.lose(Duration::ZERO, UserId(number), at(number));
        }
        let mut called = calls(&mut missed, S);
        called.sort_unstable();
        assert_eq!(called, (7..=70).collect::<Vec<u16>>());
    }
}
