//! Late and missing inputs: what is stepped again for them, what is requested, and who pays.

use std::collections::BTreeMap;
use std::time::Duration;

use super::{
    BodyId, InputLog, PeerBody, PeerId, PeerSession, RemotePeer, SharedBudgets, Tick, UserId, WINDOW,
};
use crate::peer::body::CONTACT_COST;
use crate::wire::{Datagram, HeldAt, InputTick, Inputs, MAX_NACK_RUN, MAX_NACK_RUNS, MAX_TICKS, NackRun};

/// What an update spends on ticks that are stepped again, in steps without hands. On top of it
/// each body goes on by one tick with each step, so that none comes farther behind.
const RESIMULATED: u64 = 192;
/// Pause between requests for the same tick.
const REQUEST_INTERVAL: Duration = Duration::from_millis(150);

impl PeerSession {
    /// Begins to step again what late inputs have changed.
    pub(super) fn roll_back(&mut self) {
        let mut too_late = false;
        for body in self.bodies.values_mut() {
            // The peer that gave a state knew all inputs up to its tick, so the state contains late
            // inputs.
            too_late |= !body.begin_pass(self.taken, &self.inputs);
        }
        if too_late {
            // Only a state can help. It is requested together with the missing inputs.
            self.others.values_mut().for_each(|o| o.lost = true);
        }
    }

    /// Steps past ticks again, as far as an update may. The bodies have their turns.
    pub(super) fn resimulate(&mut self) {
        let behind = |(id, body): (&BodyId, &PeerBody)| body.is_behind().then_some(*id);
        let ids: Vec<BodyId> =
            self.bodies.range(self.turn..).chain(self.bodies.range(..self.turn)).filter_map(behind).collect();
        let mut left = RESIMULATED;
        for id in ids {
            if left == 0 {
                self.turn = id;
                return;
            }
            if let Some(body) = self.bodies.get_mut(&id) {
                left = body.resimulate(&self.inputs, left);
            }
        }
    }

    /// The newest tick whose state has all inputs that are known, of all bodies.
    pub(super) fn resimulated_to(&self) -> Tick {
        self.bodies.values().map(PeerBody::resimulated_to).fold(self.tick, Tick::min)
    }

    /// The bodies that an input of a user changes: those on which it acts, and those on which the
    /// hands acted from which it was guessed.
    pub(super) fn changed_by(&self, user: UserId, input: &InputTick) -> Vec<BodyId> {
        let guessed = self.inputs.users.get(&user).and_then(|inputs| inputs.acting(input.tick).0);
        let held = input.held.iter().chain(guessed.map_or(&[][..], |guessed| &guessed.held));
        let bodies = held.map(|held| held.body).chain(input.impulses.iter().map(|impulse| impulse.body));
        let mut bodies: Vec<BodyId> = bodies.filter(|body| self.bodies.contains_key(body)).collect();
        bodies.sort_unstable();
        bodies.dedup();
        bodies
    }

    /// The number of ticks that are stepped again if one changes for some bodies.
    pub(super) fn ticks_to_resimulate(&self, bodies: &[BodyId], tick: Tick) -> u64 {
        let tick = tick.max(self.taken + 1);
        let ends = bodies.iter().filter_map(|id| self.bodies.get(id)).map(PeerBody::resimulated_to);
        ends.max().map_or(0, |end| (end + 1).saturating_sub(tick))
    }

    /// Marks a tick that has changed for some bodies. What is before the last state that was taken
    /// stays as the state had it.
    pub(super) fn mark(&mut self, bodies: &[BodyId], tick: Tick) {
        let tick = tick.max(self.taken + 1);
        if tick <= self.tick {
            for id in bodies {
                if let Some(body) = self.bodies.get_mut(id) {
                    body.mark(tick);
                }
            }
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
/// the ticks that are stepped `again` for it, and the patches that no body has yet.
pub(super) fn affords(
    now: Duration,
    (other, all): (&mut RemotePeer, &mut SharedBudgets),
    (bodies, inputs): (&BTreeMap<BodyId, PeerBody>, &InputLog),
    input: &InputTick,
    again: u64,
) -> bool {
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
    // A step with contacts takes as long as several without, whichever body has them.
    let touches = bodies.values().any(PeerBody::touches);
    let done = input.held.len() + input.impulses.len();
    let own = 1 + done as u64 + if touches { CONTACT_COST } else { 0 };
    [own, inputs.cost_of_hands()].map(|cost| (ticks * cost) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn late_inputs_are_paid_for_by_the_hands_of_all() {
        let (step, begun, late) = (0.025, Duration::from_secs(1), 40);
        let input = |tick| {
            let (body, radius, target, hold) = (BodyId(1), 0.1, [0.0; 3], Default::default());
            let hand = |grab| HeldAt { body, grab, vertex: 5, radius, target, hold };
            InputTick { tick, held: (0..4).map(hand).collect(), impulses: Vec::new() }
        };
        let mut log = InputLog::default();
        for user in (1..=24).map(UserId) {
            log.expect(user, 1);
            assert!(log.put(user, input(1)));
        }
        let mut all = SharedBudgets::of_all(crate::peer::other::late_of_all(step));
        let mut peers: Vec<RemotePeer> =
            (0..24).map(|k| RemotePeer::new(PeerId(k), begun, None, 1200, step)).collect();
        let mut steps = 0;
        for tick in 1..=400 {
            let now = begun + tick * Duration::from_millis(25);
            let cost = late_cost((&BTreeMap::new(), &log), &input(1), late);
            // The ticks are the same for all of them, so that one pays.
            if peers.iter_mut().any(|peer| peer.pays_for_late(&mut all, now, cost)) {
                steps += late;
            }
        }
        // Of the budget of all, which begins full, a tick costs 37. The last ticks may be owed.
        let most = (512.0 + 400.0 * 384.0) / 37.0 + late as f64;
        println!("24 members: {steps} ticks are paid for of {most:.0}, with 32 hands each");
        assert!((steps as f64) <= most, "{steps} of {most}");
        assert!((steps as f64) > 0.9 * most, "what can be afforded is taken: {steps} of {most}");
    }
}
