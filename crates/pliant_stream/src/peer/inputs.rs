//! What all users do, tick by tick.

use std::collections::BTreeMap;

use pliant_modal::Body;

use crate::prediction::Ring;
use crate::recovery::Forecast;
use crate::state::{BodyId, Tick, UserId};
use crate::wire::{HeldAt, ImpulseAt, InputTick};

/// Number of ticks remembered.
pub(crate) const WINDOW: usize = 128;

/// Largest number of hands that act on one body, as many as at a host. A step with 32 hands takes
/// some ten times as long as one with 8, and would hold up everybody's frames.
const MAX_HANDS: usize = Body::MAX_GRABS;
/// The square of the number of hands on one body, divided by this, is what they add to the cost of
/// its step, as a number of steps without hands.
const SQUARED_HANDS_PER_STEP: u64 = 32;

/// The cost of a step with a number of hands on the body, as a number of steps without hands.
pub(crate) fn step_cost(hands: u64) -> u64 {
    1 + hands.min(MAX_HANDS as u64).pow(2) / SQUARED_HANDS_PER_STEP
}

/// What all users do with one body at one tick, by user.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct BodyInputs {
    pub(crate) held: Vec<(UserId, HeldAt)>,
    pub(crate) impulses: Vec<(UserId, ImpulseAt)>,
}

/// Inputs of one user.
#[derive(Debug)]
pub(crate) struct UserInputs {
    slots: Ring<InputTick>,
    /// The first tick for which inputs are expected.
    pub(crate) first: Tick,
    /// The newest known tick.
    pub(crate) highest: Tick,
    /// All ticks up to this one are known.
    pub(crate) complete: Tick,
    /// The user has left. Nothing is held after `highest`.
    pub(crate) gone: bool,
}

impl UserInputs {
    fn new(first: Tick) -> Self {
        let before = first.saturating_sub(1);
        Self { slots: Ring::new(WINDOW), first, highest: before, complete: before, gone: false }
    }

    pub(crate) fn at(&self, tick: Tick) -> Option<&InputTick> {
        self.slots.get(tick)
    }

    /// The newest input that is known, from which hands go on.
    pub(crate) fn newest(&self) -> Option<&InputTick> {
        (0..WINDOW as u64).map_while(|back| self.highest.checked_sub(back)).find_map(|tick| self.at(tick))
    }

    /// Returns whether the input of a tick is missing and not too old.
    fn lacks(&self, tick: Tick) -> bool {
        tick + (WINDOW as u64) > self.highest && self.at(tick).is_none()
    }

    fn put(&mut self, input: InputTick) -> bool {
        let tick = input.tick;
        if !self.lacks(tick) {
            return false;
        }
        *self.slots.place(tick).0 = input;
        self.highest = self.highest.max(tick);
        self.complete = self.complete.max(self.highest.saturating_sub(WINDOW as u64));
        while self.at(self.complete + 1).is_some() {
            self.complete += 1;
        }
        true
    }

    /// The input whose hands act at a tick, and whether it is known: that of the tick, or the last
    /// one before, from which hands go on. `None` where the user holds nothing.
    pub(crate) fn acting(&self, tick: Tick) -> (Option<&InputTick>, bool) {
        if tick < self.first || (self.gone && tick > self.highest) {
            return (None, true);
        }
        if let Some(input) = self.at(tick) {
            return (Some(input), true);
        }
        ((1..WINDOW as u64).map_while(|b| tick.checked_sub(b)).find_map(|t| self.at(t)), false)
    }

    /// Where a hand of the input of tick `last` is at a later tick. `samples` is a workspace.
    fn forecast(
        &self,
        (g, last): (&HeldAt, Tick),
        tick: Tick,
        forecast: &Forecast,
        samples: &mut Vec<(u64, [f64; 3])>,
    ) -> [f64; 3] {
        samples.clear();
        for back in 0..=forecast.window().saturating_sub(1).min(last) {
            let input = self.at(last - back);
            let held = input.and_then(|i| i.held.iter().find(|x| x.grab == g.grab && x.body == g.body));
            samples.extend(held.map(|held| (back, held.target)));
        }
        forecast.go_on(samples, tick - last).unwrap_or(g.target)
    }
}

/// Inputs of all users.
#[derive(Debug, Default)]
pub(crate) struct InputLog {
    pub(crate) users: BTreeMap<UserId, UserInputs>,
}

impl InputLog {
    /// Expects inputs of a user from a tick on.
    pub(crate) fn expect(&mut self, user: UserId, first: Tick) {
        self.users.insert(user, UserInputs::new(first));
    }

    /// Forgets users that have left and whose last input is older than the window. Nothing is
    /// stepped again from that far back, and a user that has left holds nothing after the last
    /// input.
    pub(crate) fn forget_gone(&mut self, tick: Tick) {
        self.users.retain(|_, u| {
            let is_missing = u.highest < u.first;
            !(u.gone && (is_missing || u.highest + WINDOW as u64 <= tick))
        });
    }

    /// Returns whether [`InputLog::put`] would take an input of a tick.
    pub(crate) fn lacks(&self, user: UserId, tick: Tick) -> bool {
        self.users.get(&user).is_some_and(|u| u.lacks(tick))
    }

    /// Adds an input. Returns true when it is new.
    pub(crate) fn put(&mut self, user: UserId, input: InputTick) -> bool {
        self.users.get_mut(&user).is_some_and(|u| u.put(input))
    }

    /// Collects the grabs of a body and the impulses on it at a tick, by user. Returns true when
    /// all inputs are known. Hands go on where they are not, and impulses are never guessed.
    pub(crate) fn of_body(
        &self,
        tick: Tick,
        body: BodyId,
        forecast: &Forecast,
        out: &mut BodyInputs,
    ) -> bool {
        out.held.clear();
        out.impulses.clear();
        let mut known = true;
        for (user, inputs) in &self.users {
            let (acting, is_known) = inputs.acting(tick);
            known &= is_known;
            let held = acting.map_or(&[][..], |input| &input.held);
            out.held.extend(held.iter().filter(|g| g.body == body).map(|g| (*user, *g)));
            let impulses = inputs.at(tick).map_or(&[][..], |input| &input.impulses);
            out.impulses.extend(impulses.iter().filter(|i| i.body == body).map(|i| (*user, *i)));
        }
        make_room(&mut out.held);
        // Only the hands that act are worth a forecast. Those of a user follow each other.
        let (mut samples, mut of) = (Vec::new(), None::<(UserId, &UserInputs, Tick)>);
        for (user, g) in &mut out.held {
            if of.is_none_or(|(of, ..)| of != *user) {
                let Some(inputs) = self.users.get(user) else { continue };
                let Some(last) = inputs.acting(tick).0 else { continue };
                of = Some((*user, inputs, last.tick));
            }
            if let Some((_, inputs, last)) = of.filter(|(.., last)| *last < tick) {
                g.target = inputs.forecast((g, last), tick, forecast, &mut samples);
            }
        }
        known
    }

    /// What the hands of all users add to the cost of a tick that is stepped again, as a number of
    /// steps without hands: of each body, the square of its hands.
    pub(crate) fn cost_of_hands(&self) -> u64 {
        let mut hands: BTreeMap<BodyId, u64> = BTreeMap::new();
        let present = self.users.values().filter(|u| !u.gone);
        for held in present.filter_map(UserInputs::newest).flat_map(|input| &input.held) {
            *hands.entry(held.body).or_default() += 1;
        }
        hands.into_values().map(|hands| step_cost(hands) - 1).sum()
    }

    /// The newest tick up to which all inputs are known.
    pub(crate) fn complete(&self) -> Tick {
        let each = self.users.values().filter(|u| !u.gone).map(|u| u.complete);
        each.min().unwrap_or(0)
    }
}

/// Leaves as many hands as act on one body, alike at all peers: each user's first one comes before
/// anybody's second, and so on. The hands of a user follow each other.
fn make_room(held: &mut Vec<(UserId, HeldAt)>) {
    if held.len() <= MAX_HANDS {
        return;
    }
    let mut turns: Vec<(usize, usize)> = Vec::with_capacity(held.len());
    for (index, (user, _)) in held.iter().enumerate() {
        let follows = index.checked_sub(1).is_some_and(|before| held[before].0 == *user);
        let turn = if follows { turns[index - 1].0 + 1 } else { 0 };
        turns.push((turn, index));
    }
    turns.sort_unstable();
    let mut stays = vec![false; held.len()];
    turns.iter().take(MAX_HANDS).for_each(|(_, index)| stays[*index] = true);
    let mut stays = stays.into_iter();
    held.retain(|_| stays.next() == Some(true));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn users_that_have_gone_are_forgotten_after_the_window() {
        let mut log = InputLog::default();
        let window = WINDOW as u64;
        for user in 0..1000_u16 {
            let (user, tick) = (UserId(user), 10 * (u64::from(user) + 1));
            log.expect(user, tick);
            assert!(log.put(user, InputTick { tick, ..Default::default() }));
            if let Some(u) = log.users.get_mut(&user) {
                u.gone = true;
            }
            log.forget_gone(tick);
            // The users are ten ticks apart, so as many remain as fit in the window.
            assert!(log.users.len() as u64 <= window / 10 + 1, "{}", log.users.len());
        }
        assert_eq!(log.users.len() as u64, window / 10 + 1);
        // A user without inputs is forgotten at once, and a user that stays is never forgotten.
        log.expect(UserId(2000), 10_001);
        if let Some(u) = log.users.get_mut(&UserId(2000)) {
            u.gone = true;
        }
        log.expect(UserId(3000), 10_001);
        log.forget_gone(10_000 + window);
        assert_eq!(log.users.keys().copied().collect::<Vec<_>>(), [UserId(3000)]);
    }
}
