//! Comparison of states, and states that are received and sent.

use std::collections::BTreeMap;
use std::time::Duration;

use super::{CHECK_TOLERANCE, MAX_MISSED, MAX_OUT, PeerSession};
use crate::peer::config::PeerEvent;
use crate::peer::inputs::WINDOW;
use crate::peer::other::{PartialState, RemotePeer};
use crate::session::MAX_MESSAGE;
use crate::state::{BodyId, PeerId, Tick, UserId};
use crate::wire::{InputTick, PeerBodyState, PeerMessage, StateCheck};

/// Bytes of the bodies in one message. The rest of it is shorter than this leaves.
const PART: usize = MAX_MESSAGE - 64;

impl PeerSession {
    /// Takes a message with a state. The state is taken with the last of its messages.
    pub(super) fn take_part(
        &mut self,
        now: Duration,
        peer: PeerId,
        [tick, theirs]: [Tick; 2],
        more: bool,
        bodies: Vec<PeerBodyState>,
    ) {
        let Some(other) = self.others.get_mut(&peer) else { return };
        let Some(user) = other.user else { return };
        let partial = other.partial.take().filter(|partial| partial.tick == tick);
        // A joining peer has asked all peers by its hello. After that, a state is taken only on
        // request and only from a lower number. A peer that could send a state at will could force
        // any shape on any peer.
        if self.started && !(other.asked_state && user < self.config.user) {
            other.asked_state = false;
            return;
        }
        let mut partial = partial.unwrap_or(PartialState { tick, bodies: BTreeMap::new() });
        for body in bodies {
            let own = self.bodies.get(&BodyId(body.body));
            if own.is_some_and(|own| own.model().mode_count() == body.q.len()) {
                partial.bodies.insert(body.body, body);
            }
        }
        if more {
            other.partial = Some(partial);
            return;
        }
        other.asked_state = false;
        if partial.bodies.len() != self.bodies.len() {
            return other.link.reject();
        }
        let bodies: Vec<PeerBodyState> = partial.bodies.into_values().collect();
        self.take_state(now, user, tick, theirs, &bodies);
    }

    fn take_state(
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
                self.inputs.put(self.config.user, InputTick { tick: t, ..Default::default() });
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
        if user > self.config.user || check.tick > self.confirmed() {
            return;
        }
        // What waits for shapes differs until it has them.
        let body = self.bodies.get(&check.body).filter(|body| !body.lacks_shapes(check.tick));
        let Some((own, size)) = body.and_then(|body| body.check(check.tick)) else {
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
        let tick = each.map(|u| u.complete).min().unwrap_or(self.tick).min(self.resimulated_to());
        if wanting.is_empty() || tick == 0 || self.out.len() >= MAX_OUT {
            return;
        }
        let bodies: Vec<_> = self.bodies.values().filter_map(|b| b.export(tick)).collect();
        if bodies.len() != self.bodies.len() {
            return;
        }
        let (mut parts, mut bytes) = (vec![Vec::new()], 0);
        for body in bodies {
            let more = body.most_bytes();
            if bytes + more > PART && bytes > 0 {
                parts.push(Vec::new());
                bytes = 0;
            }
            bytes += more;
            if let Some(part) = parts.last_mut() {
                part.push(body);
            }
        }
        let (count, reached) = (parts.len(), self.tick);
        let state: Vec<PeerMessage> = (1..)
            .zip(parts)
            .map(|(k, bodies)| PeerMessage::State { tick, now: reached, more: k < count, bodies })
            .collect();
        for peer in wanting {
            let Some(other) = self.others.get_mut(&peer) else { continue };
            // A peer that asks too often waits.
            if other.budgets.states.spend(now, 1.0) {
                other.wants_state = false;
                state.iter().for_each(|part| self.message(peer, part));
            }
        }
    }
}
