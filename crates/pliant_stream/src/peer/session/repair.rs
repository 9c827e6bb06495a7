//! Late and missing inputs: what is stepped again for them, what is requested, and who pays.

use std::collections::BTreeMap;
use std::time::Duration;

use super::{BodyId, InputLog, PeerBody, PeerId, PeerSession, RemotePeer, SharedBudgets, Tick, WINDOW};
use crate::wire::{Datagram, HeldAt, InputTick, Inputs, MAX_NACK_RUN, MAX_NACK_RUNS, MAX_TICKS, NackRun};

/// What a tick that is stepped again with contacts costs more than one without.
const CONTACT_COST: u64 = 4;
/// Pause between requests for the same tick.
const REQUEST_INTERVAL: Duration = Duration::from_millis(150);

impl PeerSession {
    /// Rolls back to the earliest tick for which a new input is known.
    pub(super) fn roll_back(&mut self) {
        let Some(from) = self.rollback_from.take() else { return };
        // The peer that gave a state knew all inputs up to its tick, so the state contains late
        // inputs.
        let from = from.max(self.taken + 1);
        let mut too_late = false;
        for body in self.bodies.values_mut() {
            too_late |= !body.correct(from, &self.inputs);
        }
        if too_late {
            // Only a state can help. It is requested together with the missing inputs.
            self.others.values_mut().for_each(|o| o.lost = true);
        }
    }

    pub(super) fn answer(&mut self, now: Duration, peer: PeerId, runs: &[NackRun]) {
        let Some(own) = self.inputs.users.get(&self.config.user) else { return };
        let Some(other) = self.others.get_mut(&peer) else { return };
        let wanted = runs.iter().flat_map(|run| run.first..run.first + u64::from(run.count));
        let known = wanted.filter_map(|t| own.at(t)).take(WINDOW);
        let mut ticks: Vec<InputTick> =
            known.take_while(|_| other.budgets.repeats.spend(now, 1.0)).cloned().collect();
        let limit = other.link.max_datagram;
        while !ticks.is_empty() {
            let mut count = ticks.len().min(MAX_TICKS);
            while count > 1 && Inputs::bytes(&ticks[..count]) > limit {
                count -= 1;
            }
            let rest = ticks.split_off(count);
            let (now, ahead) = (self.tick, self.others.get(&peer).and_then(|o| o.ahead));
            self.datagram(peer, &Datagram::Inputs(Inputs { now, ahead, ticks, check: None }));
            ticks = rest;
        }
    }

    /// Requests from each peer the inputs that are missing and that no repeat will bring.
    pub(super) fn ask(&mut self, now: Duration) {
        let mut questions = Vec::new();
        for (peer, other) in &mut self.others {
            let Some(inputs) = other.user.and_then(|u| self.inputs.users.get(&u)) else { continue };
            let to = inputs.highest.saturating_sub(self.config.repeats as u64);
            let from = (inputs.complete + 1).max(inputs.first);
            let mut runs: Vec<NackRun> = Vec::new();
            for tick in from..to {
                let again =
                    other.requested.get(&tick).is_some_and(|at| now.saturating_sub(*at) < REQUEST_INTERVAL);
                if inputs.at(tick).is_some() || again {
                    continue;
                }
                other.requested.insert(tick, now);
                match runs.last_mut() {
                    Some(run) if run.first + u64::from(run.count) == tick && run.count < MAX_NACK_RUN => {
                        run.count += 1;
                    }
                    _ => runs.push(NackRun { first: tick, count: 1 }),
                }
            }
            other.requested.retain(|t, _| *t >= from);
            runs.truncate(MAX_NACK_RUNS);
            if !runs.is_empty() {
                other.link.stats.nacks += 1;
                questions.push((*peer, Datagram::InputRequest(runs)));
            }
            if inputs.complete + (WINDOW as u64) / 2 < inputs.highest {
                other.lost = true;
            }
        }
        for (peer, question) in questions {
            self.datagram(peer, &question);
        }
        if self.others.values().any(RemotePeer::is_apart) {
            self.request_state(now);
        }
    }
}

/// Pays for an input from the budgets of its sender and of all, and returns whether they allow it:
/// the ticks before `planned` that are stepped again for it, and the patches that no body has yet.
pub(super) fn affords(
    now: Duration,
    (other, all): (&mut RemotePeer, &mut SharedBudgets),
    (bodies, inputs): (&BTreeMap<BodyId, PeerBody>, &InputLog),
    input: &InputTick,
    planned: Tick,
) -> bool {
    let again = planned.saturating_sub(input.tick);
    // A hand that does not act has no patch, and goes on without paying for it again.
    let before = other.user.and_then(|user| inputs.users.get(&user)?.newest());
    let goes_on = |hand: &HeldAt| {
        let key = |held: &HeldAt| (held.body, held.vertex, held.radius.to_bits());
        before.is_some_and(|before| before.held.iter().any(|held| key(held) == key(hand)))
    };
    (again == 0 || other.pays_for_late(all, now, late_cost((bodies, inputs), input, again)))
        && input.held.iter().all(|held| match bodies.get(&held.body) {
            Some(body) if !body.has_patch(held.vertex, held.radius) && !goes_on(held) => {
                other.pays_for_patch(all, now, body.model(), held)
            }
            _ => true,
        })
}

/// What it costs to step a number of ticks again for an input: what its sender pays, and what the
/// hands of all add to that.
pub(super) fn late_cost(
    (bodies, inputs): (&BTreeMap<BodyId, PeerBody>, &InputLog),
    input: &InputTick,
    ticks: u64,
) -> [f64; 2] {
    // All bodies are stepped again, and a step with contacts takes as long as several without.
    let touches = bodies.values().any(PeerBody::touches);
    let done = input.held.len() + input.impulses.len();
    let own = 1 + done as u64 + if touches { CONTACT_COST } else { 0 };
    [own, inputs.cost_of_hands()].map(|cost| (ticks * cost) as f64)
}
