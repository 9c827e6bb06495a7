//! The state that a peer keeps of another peer.

use std::collections::BTreeMap;
use std::time::Duration;

use pliant_modal::ModalModel;

use crate::link::{Budget, Link, PatchBudget, SharedBudgets, state_budget};
use crate::state::{BodyId, PeerId, Tick, UserId};
use crate::wire::{HeldAt, PeerBodyState};

/// Number of consecutive mismatches after which the other peer's state is taken.
const CHECKS: u32 = 3;

/// A hello that was found in order.
#[derive(Debug, Clone)]
pub(super) struct Hello {
    /// [`UserId::HOST`] when the peer requests a number.
    pub(super) user: UserId,
    pub(super) name: String,
    pub(super) address: String,
    pub(super) joining: bool,
}

/// A state whose last message has not arrived.
#[derive(Debug)]
pub(super) struct PartialState {
    pub(super) tick: Tick,
    /// One for each body, so that nobody fills the memory.
    pub(super) bodies: BTreeMap<u16, PeerBodyState>,
}

/// The budgets of one peer. They are kept while it is away.
#[derive(Debug)]
pub(super) struct PeerBudgets {
    /// New patches.
    pub(super) patches: PatchBudget,
    /// States that are sent to the peer.
    pub(super) states: Budget,
    /// Ticks that are sent again to the peer.
    pub(super) repeats: Budget,
    /// What the peer's late inputs cost: for each tick that is stepped again, one and one for each
    /// hand.
    pub(super) late: Budget,
    /// What the peer says of shapes of held patches.
    pub(super) shapes: Budget,
}

impl PeerBudgets {
    fn new(step: f64) -> Self {
        Self {
            patches: PatchBudget::default(),
            states: state_budget(),
            // Inputs are the same for all bodies. A request for the whole window every 150 ms is
            // 853 ticks a second, and a well-behaved peer requests no more.
            repeats: Budget::new(1000.0, 1000.0),
            // An input with one hand may be as late as can be, and one with ten hands 23 ticks. In
            // each tick, one with one hand may be 96 ticks late, and one with ten 17.
            late: Budget::new(192.0 / step, 256.0),
            // Each set is announced twice, and a peer has no more than one a second made.
            shapes: Budget::new(3.0, 24.0),
        }
    }
}

/// Late inputs of all peers: those of two that spend all they can.
pub(super) fn late_of_all(step: f64) -> Budget {
    Budget::new(2.0 * 192.0 / step, 512.0)
}

/// One peer's own of them: an input with one hand two ticks later than all others, in each tick.
fn late_of_one(now: Duration, step: f64) -> Budget {
    Budget::empty(now, 4.0 / step, 64.0)
}

#[derive(Debug)]
pub(super) struct RemotePeer {
    pub(super) link: Link,
    /// When the peer last announced others.
    pub(super) announced_at: Option<Duration>,
    /// User number of the peer, after its hello.
    pub(super) user: Option<UserId>,
    /// User number that the peer must have; `None` when its hello has it.
    pub(super) expected: Option<UserId>,
    /// A hello was sent to the peer.
    pub(super) greeted: bool,
    /// The peer's hello, until this peer has a number and, where it requests one, so has the other.
    pub(super) hello: Option<Hello>,
    /// Mean of the local clock minus the time of the sender's tick, at arrival, s.
    pub(super) way: Option<f64>,
    /// Running mean of this peer's tick minus the other's tick, at arrival here, ticks.
    pub(super) ahead: Option<f64>,
    /// The same mean as the other peer reports it, ticks.
    pub(super) theirs: Option<f64>,
    /// The newest tick that the other peer has sent.
    pub(super) newest: Tick,
    /// When that arrived.
    pub(super) newest_at: Duration,
    pub(super) requested: BTreeMap<Tick, Duration>,
    /// Number of consecutive checks that disagreed, per body.
    pub(super) mismatched: BTreeMap<BodyId, u32>,
    /// The peer's inputs arrived too late or are missing too long, so only a state can help.
    pub(super) lost: bool,
    pub(super) wants_state: bool,
    /// This peer has requested the other's state and has no answer yet.
    pub(super) asked_state: bool,
    /// What has come of the peer's state.
    pub(super) partial: Option<PartialState>,
    /// What the peer may cost this one. This outlives the connection.
    pub(super) budgets: PeerBudgets,
    /// What is the peer's own of the budgets that all peers share.
    share: SharedBudgets,
}

impl RemotePeer {
    pub(super) fn new(
        peer: PeerId,
        now: Duration,
        expected: Option<UserId>,
        max_datagram: usize,
        step: f64,
    ) -> Self {
        Self {
            link: Link::new(peer, now, max_datagram),
            announced_at: None,
            user: None,
            expected,
            greeted: false,
            hello: None,
            way: None,
            ahead: None,
            theirs: None,
            newest: 0,
            newest_at: Duration::ZERO,
            requested: BTreeMap::new(),
            mismatched: BTreeMap::new(),
            lost: false,
            wants_state: false,
            asked_state: false,
            partial: None,
            budgets: PeerBudgets::new(step),
            share: SharedBudgets::of_one(now, late_of_one(now, step)),
        }
    }

    /// Pays for what is stepped again for a late input, and returns whether the budgets allow it.
    ///
    /// What the hands of all add is paid for from the budget of all, and from nobody's own: those
    /// who hold with many hands would make the inputs of the others too dear.
    pub(super) fn pays_for_late(
        &mut self,
        all: &mut SharedBudgets,
        now: Duration,
        [own, of_all]: [f64; 2],
    ) -> bool {
        self.budgets.late.spend(now, own)
            && (self.share.work.spend(now, own) || all.work.spend_or_owe(now, own + of_all))
    }

    /// Pays for a new patch, and returns whether the budgets allow it.
    pub(super) fn pays_for_patch(
        &mut self,
        all: &mut SharedBudgets,
        now: Duration,
        model: &ModalModel,
        held: &HeldAt,
    ) -> bool {
        let all = [&mut all.patches, &mut self.share.patches];
        self.budgets.patches.spend(all, now, model, held.vertex, held.radius).is_some()
    }

    /// Returns whether the peer has connected by itself and said nothing since.
    pub(super) fn is_silent(&self) -> bool {
        self.user.is_none() && self.expected.is_none() && self.hello.is_none() && !self.greeted
    }

    /// Returns whether a body lastingly differs from the other peer's.
    pub(super) fn is_apart(&self) -> bool {
        self.lost || self.mismatched.values().any(|count| *count >= CHECKS)
    }

    /// Clears all recorded differences.
    pub(super) fn agreed(&mut self) {
        self.mismatched.clear();
        self.lost = false;
    }

    /// Records the arrival of a datagram that was sent at `theirs` (s of the sender's ticks), for
    /// the jitter (RFC 3550, 6.4.1).
    pub(super) fn came(&mut self, now: Duration, theirs: f64) {
        let early = now.as_secs_f64() - theirs;
        let off = early - *self.way.get_or_insert(early);
        // A difference this large means that one of the clocks has jumped.
        if off.abs() > 10.0 {
            self.way = Some(early);
            return;
        }
        self.way = self.way.map(|way| way + off / 16.0);
        let jitter = self.link.stats.jitter.as_secs_f64();
        self.link.stats.jitter = Duration::from_secs_f64(jitter + (off.abs() - jitter) / 16.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_peers_that_spend_all_they_can_stay_within_the_budget_of_all_and_leave_others_their_share() {
        let step = 0.025;
        let mut all = SharedBudgets::of_all(late_of_all(step));
        let begun = Duration::from_secs(1);
        let peer = |k| RemotePeer::new(PeerId(k), begun, None, 1200, step);
        let mut peers: Vec<RemotePeer> = (0..60).map(peer).collect();
        let (mut spent, mut kept) = (0.0, 0);
        for tick in 1..=400 {
            let now = begun + tick * Duration::from_millis(25);
            let (last, others) = peers.split_last_mut().unwrap();
            for other in others {
                while other.pays_for_late(&mut all, now, [11.0, 0.0]) {
                    spent += 11.0;
                }
            }
            // An input with one hand, two ticks late.
            kept += u32::from(last.pays_for_late(&mut all, now, [4.0, 0.0]));
        }
        // Beside the first burst, two peers' worth and the shares. Each alone may spend 192 a tick.
        let most = 512.0 + 400.0 * 2.0 * 192.0 + 59.0 * 400.0 * 4.0;
        println!("59 peers: {spent} of {most}, and {kept} of 400 inputs of another one");
        assert!(spent <= most + 11.0 * 400.0, "{spent} of {most}");
        assert!(spent > 400.0 * 2.0 * 180.0, "what can be afforded is taken: {spent}");
        assert_eq!(kept, 400);
    }
}
