//! Comparison of states, and states that are received and sent.

use std::time::Duration;

use super::{CHECK_TOLERANCE, MAX_MISSED, MAX_OUT, PeerSession};
use crate::peer::config::PeerEvent;
use crate::peer::inputs::WINDOW;
use crate::peer::other::RemotePeer;
use crate::state::{BodyId, PeerId, Tick, UserId};
use crate::wire::{InputTick, PeerBodyState, PeerMessage, StateCheck};

impl PeerSession {
    pub(super) fn take_state(
        &mut self,
        now: Duration,
        from: UserId,
        tick: Tick,
        theirs: Tick,
        bodies: &[PeerBodyState],
    ) {
        let to = if self.started { self.tick } else { theirs.min(tick + WINDOW as u64 / 2) };
        if tick > to || to - tick >= WINDOW as u64 {
            return;
        }
        if !self.started {
            for inputs in self.inputs.users.values_mut() {
                inputs.first = inputs.first.max(tick + 1);
                inputs.complete = inputs.complete.max(tick);
            }
            // This peer held nothing in the ticks before it joined.
            for t in tick + 1..=to {
                self.inputs.put(self.config.user, InputTick { tick: t, held: Vec::new() });
            }
        }
        for b in bodies {
            if let Some(body) = self.bodies.get_mut(&BodyId(b.body)) {
                body.import(tick, to, b, &self.inputs);
            }
        }
        self.tick = to;
        self.taken = tick;
        if self.started {
            self.event(PeerEvent::Resynced { from });
        } else {
            self.started = true;
            // The state may be old if somebody's inputs are late, and so may be the tick of a peer
            // that has stalled itself.
            self.missed = (theirs.saturating_sub(to) + WINDOW as u64).min(MAX_MISSED);
            self.next_step = Some(now + Duration::from_secs_f64(self.config.step));
            self.event(PeerEvent::Started);
        }
        self.others.values_mut().for_each(RemotePeer::agreed);
    }

    /// Only checks of peers with a lower number count.
    pub(super) fn compare(&mut self, peer: PeerId, user: UserId, check: StateCheck) {
        let unsettled = self.rollback_from.is_some_and(|from| from <= check.tick);
        if user > self.config.user || unsettled || check.tick > self.confirmed() {
            return;
        }
        let Some((own, size)) = self.bodies.get(&check.body).and_then(|b| b.check(check.tick)) else {
            return;
        };
        let agrees = (own - f64::from(check.value)).abs() <= CHECK_TOLERANCE * size + 1e-7;
        if let Some(other) = self.others.get_mut(&peer) {
            let count = other.mismatched.entry(check.body).or_default();
            *count = if agrees { 0 } else { *count + 1 };
        }
    }

    /// Requests the state of the peer with the lowest number, unless that is this peer, at most
    /// once a second.
    pub(super) fn request_state(&mut self, now: Duration) {
        if self.requested.is_some_and(|at| now.saturating_sub(at) <= Duration::from_secs(1)) {
            return;
        }
        let lowest = self.others.iter_mut().filter_map(|(p, o)| o.user.map(|u| (u, *p, o)));
        if let Some((user, peer, other)) = lowest.min_by_key(|(u, ..)| *u)
            && user < self.config.user
        {
            self.requested = Some(now);
            other.asked_state = true;
            self.message(peer, &PeerMessage::StateRequest);
        }
    }

    pub(super) fn give_states(&mut self, now: Duration) {
        let wanting: Vec<PeerId> =
            self.others.iter().filter(|(_, o)| o.wants_state && o.user.is_some()).map(|(p, _)| *p).collect();
        // A peer that has just joined has no inputs yet and must not hold the confirmed tick back.
        let each = self.inputs.users.values().filter(|u| !u.gone && u.first <= self.tick);
        let tick = each.map(|u| u.complete).min().unwrap_or(self.tick).min(self.tick);
        if wanting.is_empty() || tick == 0 || self.out.len() >= MAX_OUT {
            return;
        }
        let bodies: Vec<_> = self.bodies.values().filter_map(|b| b.export(tick)).collect();
        if bodies.len() != self.bodies.len() {
            return;
        }
        let state = PeerMessage::State { tick, now: self.tick, bodies };
        for peer in wanting {
            let Some(other) = self.others.get_mut(&peer) else { continue };
            // A peer that asks too often waits.
            if other.link.states.spend(now, 1.0) {
                other.wants_state = false;
                self.message(peer, &state);
            }
        }
    }
}
