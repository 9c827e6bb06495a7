//! The own shapes of held patches: which of them count from which tick, who says so, and what is to
//! be made.
//!
//! The peer with the lowest number decides. It sends what it begins to make, so that the others
//! make it at the same time, and when it has made it, from which tick it counts.

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{HeldPlace, HeldShapes};

use super::repair::late_cost;
use super::{BodyId, PeerId, PeerMessage, PeerSession, Tick, UserId, WINDOW};
use crate::link::Budget;
use crate::peer::columns::fit;
use crate::wire::InputTick;

/// Time from the announcement of shapes to the tick from which they count, s. A message that takes
/// longer makes its receiver roll back.
const AHEAD: f64 = 0.25;

/// The budget of shapes that this peer has made, whoever asks for them: one a second, since they
/// take up to some seconds of a core.
pub(super) fn making() -> Budget {
    Budget::new(1.0, 8.0)
}

impl PeerSession {
    /// Returns the own shapes of held patches that are to be made, by body, as
    /// [`HeldShapes::of_places`] takes them. They are due until [`PeerSession::take_shapes`] has
    /// them. At most one more a second comes up, and eight at once.
    ///
    /// An application that makes them calls this in each frame: the call is also where the peer
    /// with the lowest number decides about shapes. Without them hands feel what the coordinates
    /// leave out as a mere compliance. All peers of a session should make them, or none. Those that
    /// make none differ from the others as long as somebody holds a body with reduced elasticity.
    pub fn shapes_to_make(&mut self) -> Vec<(BodyId, Vec<HeldPlace>)> {
        let leads = self.leads();
        let ids: Vec<BodyId> =
            self.bodies.iter().filter(|(_, body)| body.takes_shapes()).map(|(id, _)| *id).collect();
        let mut list = Vec::new();
        for id in ids {
            if leads {
                self.decide(id);
            }
            let Some(body) = self.bodies.get_mut(&id) else { continue };
            let (making, now) = (&mut self.making, self.updated);
            let due = body.columns.due(|| making.spend(now, 1.0));
            list.extend(due.into_iter().map(|places| (id, places)));
        }
        list
    }

    /// Takes shapes that were due ([`PeerSession::shapes_to_make`]); `None` where none can be made.
    /// Shapes of other places are ignored, and those of another model act as none.
    ///
    /// Where their tick has passed, the body steps its ticks again from there, and where it
    /// is not remembered any more, this peer requests a state.
    pub fn take_shapes(&mut self, body: BodyId, places: &[HeldPlace], shapes: Option<Arc<HeldShapes>>) {
        let leads = self.leads();
        // Late inputs that are known by now come first.
        self.roll_back();
        let Some(own) = self.bodies.get_mut(&body) else { return };
        let is_of = |shapes: &Arc<HeldShapes>| shapes.places().eq(places.iter().copied());
        if shapes.as_ref().is_some_and(|shapes| !is_of(shapes)) {
            return;
        }
        let (taken, is_whole) = own.take_shapes(places, &shapes, self.taken, &self.inputs);
        if taken.are_next && leads {
            if shapes.is_some() {
                self.announce(body, places);
            } else if let Some(own) = self.bodies.get_mut(&body) {
                own.columns.expect_none();
            }
        }
        if !is_whole {
            self.others.values_mut().for_each(|o| o.lost = true);
        }
    }

    /// Whether this peer says which shapes count.
    fn leads(&self) -> bool {
        self.started
            && self.others.values().filter_map(|other| other.user).all(|user| self.config.user < user)
    }

    /// Decides whether a body needs other shapes, which are then made next.
    fn decide(&mut self, id: BodyId) {
        let Some(body) = self.bodies.get_mut(&id) else { return };
        // One set after another.
        let (from, own) = body.columns.newest().unwrap_or((0, None));
        if from > self.tick || body.columns.is_waiting() {
            return;
        }
        let own = own.cloned();
        let held = body.held_places();
        if held.is_empty() {
            return body.columns.expect_none();
        }
        let wanted = HeldShapes::wanted(body.model(), held, own.as_deref());
        let wanted = wanted.filter(|places| fit(body.model(), places) && !body.columns.is_without(places));
        let Some(places) = wanted else { return body.columns.expect_none() };
        let key = |place: &HeldPlace| (place.vertex, place.radius.to_bits());
        // What is being made of the same patches is made to its end, wherever the hands go.
        if body.columns.expected().is_some_and(|next| next.iter().map(key).eq(places.iter().map(key))) {
            return;
        }
        // What cannot be paid for is not begun.
        if !self.making.has(self.updated, 1.0) {
            return;
        }
        body.columns.expect(places.clone());
        self.broadcast(&PeerMessage::Shapes { body: id.0, from: 0, places });
    }

    /// Says from which tick shapes count that this peer has made.
    fn announce(&mut self, id: BodyId, places: &[HeldPlace]) {
        let ahead = ((AHEAD / self.config.step).ceil() as Tick).clamp(2, WINDOW as Tick / 2);
        let from = self.tick + ahead;
        let Some(body) = self.bodies.get_mut(&id) else { return };
        if body.columns.add(from, places.to_vec()) {
            self.broadcast(&PeerMessage::Shapes { body: id.0, from, places: places.to_vec() });
        } else {
            body.columns.expect_none();
        }
    }

    /// Takes what another peer says of shapes. Only one with a lower number is believed, and
    /// anybody by a peer that has no state yet, as with states.
    pub(super) fn take_places(
        &mut self,
        now: Duration,
        peer: PeerId,
        body: BodyId,
        from: Tick,
        places: Vec<HeldPlace>,
    ) {
        let (own, started, tick) = (self.config.user, self.started, self.tick);
        let Some(other) = self.others.get_mut(&peer) else { return };
        let is_believed = other.user.is_some_and(|user: UserId| user < own || !started);
        let known = self.bodies.get_mut(&body).filter(|body| body.takes_shapes());
        let Some(known) = known.filter(|body| is_believed && fit(body.model(), &places)) else {
            return other.link.reject();
        };
        // A set far ahead would shut out those before it.
        let is_far = started && from > tick + WINDOW as Tick / 2;
        if is_far || !other.budgets.shapes.spend(now, 1.0) {
            return other.link.reject();
        }
        if from == 0 {
            return known.columns.expect(places);
        }
        if !known.columns.add(from, places) {
            return other.link.reject();
        }
        if !started || from > tick || known.columns.is_waiting() {
            return;
        }
        // A set that is made already, and came too late, is like a late input.
        let first = from.max(self.taken + 1);
        let again = (known.resimulated_to() + 1).saturating_sub(first);
        let cost = late_cost((&self.bodies, &self.inputs), &InputTick::default(), again);
        if again == 0 || other.pays_for_late(&mut self.shared, now, cost) {
            self.mark(&[body], first);
        } else {
            other.lost = true;
        }
    }
}
