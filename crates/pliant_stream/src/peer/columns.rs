//! The own shapes of the patches that hands hold on one body, and the tick from which each set
//! counts.
//!
//! Peers step alike only with the same shapes at the same tick. The peer with the lowest number
//! says which these are. Every peer makes them itself, beside its ticks, because they are the same
//! on every machine. A set that is made after its tick is like a late input.

use std::sync::Arc;

use pliant_modal::{HeldPlace, HeldShapes, ModalModel};

use super::inputs::{BodyInputs, WINDOW};
use crate::state::Tick;
use crate::wire::{MAX_SETS, PeerShapes};

/// Shapes that were made; `None` where none can be made.
type Made = Option<Arc<HeldShapes>>;

/// Shapes that count from a tick on.
#[derive(Debug, Clone)]
struct Set {
    from: Tick,
    places: Vec<HeldPlace>,
    /// `None` until they are made.
    made: Option<Made>,
    /// The making is paid for.
    paid: bool,
}

/// Shapes that may be announced for a tick soon, and are made beforehand.
#[derive(Debug, Clone)]
struct Next {
    places: Vec<HeldPlace>,
    made: Option<Made>,
    paid: bool,
}

/// What [`Columns::take`] has taken shapes for.
#[derive(Debug, Default)]
pub(crate) struct Taken {
    /// The first tick from which they count.
    pub(crate) from: Option<Tick>,
    /// They are those that were to be announced.
    pub(crate) are_next: bool,
}

/// The sets of one body.
#[derive(Debug, Default)]
pub(crate) struct Columns {
    /// In the order of their ticks, without those that no tick needs any more.
    sets: Vec<Set>,
    next: Option<Next>,
    /// Places for which no shapes can be made.
    without: Vec<HeldPlace>,
}

/// Whether places can be those of shapes of a model: one to four patches of its surface in the
/// order of [`HeldShapes::wanted`], and within the body's size of their rest.
pub(crate) fn fit(model: &ModalModel, places: &[HeldPlace]) -> bool {
    let (size, count) = (model.size(), model.surface().positions().len());
    let key = |place: &HeldPlace| (place.vertex, place.radius.to_bits());
    let is_near = |place: &HeldPlace| {
        let length = place.displacement.iter().map(|x| x * x).sum::<f64>().sqrt();
        (place.vertex as usize) < count && (0.0..=size).contains(&place.radius) && length <= size
    };
    (1..=HeldShapes::MAX_PATCHES).contains(&places.len())
        && places.iter().all(is_near)
        && places.windows(2).all(|pair| key(&pair[0]) < key(&pair[1]))
}

/// Whether a hand of the inputs is on one of the places.
fn holds(inputs: &BodyInputs, places: &[HeldPlace]) -> bool {
    let key = |vertex: u32, radius: f64| (vertex, radius.to_bits());
    let on = |of: (u32, u64)| places.iter().any(|place| key(place.vertex, place.radius) == of);
    inputs.held.iter().any(|(_, held)| on(key(held.vertex, held.radius)))
}

impl Columns {
    /// The shapes of a step to a tick with these inputs. Where those of the tick are not made yet,
    /// the ones before serve. A body whose patches nobody holds has none.
    pub(crate) fn of_step(&self, tick: Tick, inputs: &BodyInputs) -> Option<&Arc<HeldShapes>> {
        let mut until = self.sets.iter().rev().filter(|set| set.from <= tick);
        let set = until.find(|set| set.made.is_some())?;
        set.made.as_ref()?.as_ref().filter(|_| holds(inputs, &set.places))
    }

    /// Whether a step to a tick with these inputs lacks shapes that are not made yet.
    pub(crate) fn lacks(&self, tick: Tick, inputs: &BodyInputs) -> bool {
        let set = self.sets.iter().rev().find(|set| set.from <= tick);
        set.is_some_and(|set| set.made.is_none() && holds(inputs, &set.places))
    }

    /// The shapes of the set that counts at a tick, if there is one. They are `None` until they are
    /// made, and where none can be made.
    pub(crate) fn at(&self, tick: Tick) -> Option<Option<&Arc<HeldShapes>>> {
        let set = self.sets.iter().rev().find(|set| set.from <= tick)?;
        Some(set.made.as_ref().and_then(Option::as_ref))
    }

    /// Whether there are shapes, or will be.
    pub(crate) fn is_empty(&self) -> bool {
        self.sets.is_empty()
    }

    /// The newest set: its tick and its shapes, if they are made.
    pub(crate) fn newest(&self) -> Option<(Tick, Option<&Arc<HeldShapes>>)> {
        self.sets.last().map(|set| (set.from, set.made.as_ref().and_then(Option::as_ref)))
    }

    /// Whether the newest set waits for its shapes.
    pub(crate) fn is_waiting(&self) -> bool {
        self.sets.last().is_some_and(|set| set.made.is_none())
    }

    /// Adds a set that counts from a tick on, after all others. Returns false, and changes nothing,
    /// where there are as many as can be, or for a tick that is not after theirs.
    pub(crate) fn add(&mut self, from: Tick, places: Vec<HeldPlace>) -> bool {
        if self.sets.len() >= MAX_SETS || self.sets.last().is_some_and(|set| set.from >= from) {
            return false;
        }
        let known = self.made(&places);
        let paid =
            known.is_some() || self.next.as_ref().is_some_and(|next| next.paid && next.places == places);
        if self.next.as_ref().is_some_and(|next| next.places == places) {
            self.next = None;
        }
        self.sets.push(Set { from, places, made: known, paid });
        true
    }

    /// Shapes of places that are made already.
    fn made(&self, places: &[HeldPlace]) -> Option<Made> {
        let of_sets = self.sets.iter().filter(|set| set.places == places).find_map(|set| set.made.clone());
        of_sets.or_else(|| self.next.as_ref().filter(|next| next.places == places)?.made.clone())
    }

    /// Takes places as those that may be announced next, instead of the ones before.
    pub(crate) fn expect(&mut self, places: Vec<HeldPlace>) {
        if self.next.as_ref().is_none_or(|next| next.places != places) {
            let made = self.made(&places);
            self.next = Some(Next { places, paid: made.is_some(), made });
        }
    }

    /// The places that may be announced next.
    pub(crate) fn expected(&self) -> Option<&[HeldPlace]> {
        self.next.as_ref().map(|next| &next.places[..])
    }

    /// Drops what may be announced next.
    pub(crate) fn expect_none(&mut self) {
        self.next = None;
    }

    /// Whether no shapes can be made for places.
    pub(crate) fn is_without(&self, places: &[HeldPlace]) -> bool {
        self.without == places
    }

    /// The places whose shapes are to be made, each once `pays` has allowed it.
    pub(crate) fn due(&mut self, mut pays: impl FnMut() -> bool) -> Vec<Vec<HeldPlace>> {
        let mut list: Vec<Vec<HeldPlace>> = Vec::new();
        let sets = self.sets.iter_mut().map(|set| (&set.places, set.made.is_some(), &mut set.paid));
        let next = self.next.iter_mut().map(|next| (&next.places, next.made.is_some(), &mut next.paid));
        for (places, is_made, paid) in sets.chain(next) {
            if is_made || list.contains(places) {
                continue;
            }
            *paid = *paid || pays();
            if *paid {
                list.push(places.clone());
            }
        }
        list
    }

    /// Takes shapes that were made.
    pub(crate) fn take(&mut self, places: &[HeldPlace], shapes: &Made) -> Taken {
        let mut taken = Taken::default();
        for set in self.sets.iter_mut().filter(|set| set.places == places && set.made.is_none()) {
            set.made = Some(shapes.clone());
            taken.from = taken.from.or(Some(set.from));
        }
        if let Some(next) = self.next.as_mut().filter(|next| next.places == places) {
            next.made = Some(shapes.clone());
            taken.are_next = true;
        }
        if shapes.is_none() {
            self.without = places.to_vec();
        }
        taken
    }

    /// Forgets the sets that no tick needs from `tick` minus the window on.
    pub(crate) fn forget(&mut self, tick: Tick) {
        let first = tick.saturating_sub(WINDOW as u64);
        // A set serves until the next one counts and is made.
        let serves = |set: &Set| set.from <= first && set.made.is_some();
        if let Some(index) = self.sets.iter().rposition(serves) {
            self.sets.drain(..index);
        }
    }

    /// The sets that a state after `tick` carries: the one that counts then, and all later ones.
    pub(crate) fn since(&self, tick: Tick) -> Vec<PeerShapes> {
        let first = self.sets.iter().rposition(|set| set.from <= tick).unwrap_or(0);
        let shapes = |set: &Set| PeerShapes { from: set.from, places: set.places.clone() };
        self.sets[first..].iter().map(shapes).collect()
    }

    /// Takes over the sets of a received state. Later ones that only this peer knows stay.
    pub(crate) fn replace(&mut self, model: &ModalModel, received: &[PeerShapes]) {
        let before = std::mem::take(&mut self.sets);
        let find = |places: &[HeldPlace]| before.iter().find(|set| set.places == places);
        for PeerShapes { from, places } in received.iter().filter(|shapes| fit(model, &shapes.places)) {
            let known = find(places);
            self.sets.push(Set {
                from: *from,
                places: places.clone(),
                made: known.and_then(|set| set.made.clone()),
                paid: known.is_some_and(|set| set.paid),
            });
        }
        let last = received.last().map_or(0, |shapes| shapes.from);
        let room = MAX_SETS.saturating_sub(self.sets.len());
        self.sets.extend(before.into_iter().filter(|set| set.from > last).take(room));
    }
}
