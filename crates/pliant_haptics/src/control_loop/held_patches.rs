//! The forces of what the tool holds, before safety: one spring a grab, or the reactions of a body that the loop steps itself.
//!
//! Nothing here is cut. A grab that takes another's place comes by a ramp of its own, and where one local model takes over from another (a new copy of
//! the body, the proxy after the copy) the force begins where the last one was and leaves it within [`BLEND`] seconds.

use nalgebra::{Matrix3, Vector3};

use crate::{
    LocalModel, MAX_CONTACTS, ModalLocal, control_loop::proxy::ProxyExtrapolation, control_loop::tool::Tool,
};

/// Time in which one local model's force becomes another's, s.
const BLEND: f64 = 0.05;

/// Forces before safety, world axes.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PatchForces {
    pub(crate) elastic: Vector3<f64>,
    pub(crate) damping: Vector3<f64>,
    pub(crate) torque: Vector3<f64>,
    pub(crate) stored: f64,
    /// Springs are coming up, and are stretched by more than is felt of them.
    pub(crate) growing: bool,
}

/// What a new word changed about what is held.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Change {
    /// The same grabs as before.
    None,
    /// Others, or more, or fewer.
    Other,
    /// The first after nothing.
    First,
}

/// When a tick is: loop clock, length, the loop's own period, s.
#[derive(Debug, Clone, Copy)]
pub(crate) struct When {
    pub(crate) now: f64,
    pub(crate) dt: f64,
    pub(crate) period: f64,
}

/// One contact and how much of it is felt.
#[derive(Debug, Clone, Copy)]
struct Slot {
    key: u64,
    follow: ProxyExtrapolation,
    share: f64,
}

#[derive(Debug)]
pub(crate) struct HeldPatches {
    slots: [Slot; MAX_CONTACTS],
    count: usize,
    /// Time from nothing of a grab to all of it, s; `None`: at once.
    ramp: Option<f64>,
    modal: Option<Box<ModalLocal>>,
    /// The force and torque of the last tick; what the local model before felt more than this one, and how much of that is left, 1 to 0.
    last: [Vector3<f64>; 2],
    offset: [Vector3<f64>; 2],
    left: f64,
    swapped: bool,
}

impl HeldPatches {
    pub(crate) fn new(ramp: Option<f64>) -> Self {
        let zero = [Vector3::zeros(); 2];
        Self {
            slots: [Slot { key: 0, follow: ProxyExtrapolation::default(), share: 1.0 }; MAX_CONTACTS],
            count: 0,
            ramp,
            modal: None,
            last: zero,
            offset: zero,
            left: 0.0,
            swapped: false,
        }
    }

    /// The one before comes back. What is felt goes over from its force to the new one's.
    pub(crate) fn set_modal(&mut self, modal: Option<Box<ModalLocal>>) -> Option<Box<ModalLocal>> {
        self.swapped = self.count > 0;
        std::mem::replace(&mut self.modal, modal)
    }

    pub(crate) fn has_modal(&self) -> bool {
        self.modal.is_some()
    }

    /// Takes note of the grabs of a word. Those that stay keep what they know, whichever place they have now.
    pub(crate) fn take(&mut self, model: &LocalModel) -> Change {
        let contacts = model.contacts();
        let old = &self.slots[..self.count];
        if old.len() == contacts.len() && old.iter().zip(contacts).all(|(slot, c)| slot.key == c.key) {
            return Change::None;
        }
        let first = self.count == 0;
        // The first come by the ramp of the whole force.
        let share = if first || self.ramp.is_none() { 1.0 } else { 0.0 };
        let (before, mut taken) = (self.slots, [false; MAX_CONTACTS]);
        for (i, contact) in contacts.iter().enumerate() {
            let same = |j: &usize| before[*j].key == contact.key && !taken[*j];
            let known = (i < self.count).then_some(i).into_iter().chain(0..self.count).find(same);
            if let Some(j) = known {
                taken[j] = true;
            }
            self.slots[i] = known
                .map_or(Slot { key: contact.key, follow: ProxyExtrapolation::default(), share }, |j| {
                    before[j]
                });
        }
        self.count = contacts.len();
        if self.count == 0 {
            self.rest();
        }
        if first { Change::First } else { Change::Other }
    }

    /// Nothing is felt: what comes next begins at nothing.
    pub(crate) fn rest(&mut self) {
        self.last = [Vector3::zeros(); 2];
        (self.left, self.swapped) = (0.0, false);
    }

    /// The forces of this tick. `well`: the hand's place is to be trusted, so the loop's own body may follow it.
    pub(crate) fn forces(&mut self, when: When, well: bool, tool: &Tool, model: &LocalModel) -> PatchForces {
        let mut felt = PatchForces { stored: model.stored, ..PatchForces::default() };
        let stepped = match &mut self.modal {
            Some(modal) if well => {
                let steps = (when.dt / when.period).round().clamp(1.0, 4.0) as usize;
                modal.advance(when.now, steps, tool, model)
            }
            _ => false,
        };
        let modal = self.modal.as_deref().filter(|_| stepped);
        if let Some(modal) = modal {
            felt.stored = modal.energy();
        }
        let dt = when.dt.min(2.0 * when.period);
        for (i, (contact, slot)) in model.contacts().iter().zip(&mut self.slots).enumerate() {
            let arm = tool.orientation * Vector3::from(contact.offset);
            let (proxy, speed) = slot.follow.advance(when.now, dt, model, contact);
            let at = tool.position + arm;
            let k = Matrix3::from_fn(|r, c| contact.stiffness[r][c]);
            let stored = |stretch: Vector3<f64>| 0.5 * stretch.dot(&(k * stretch)).max(0.0);
            let (elastic, damping) = match modal {
                Some(modal) => {
                    felt.stored += modal.proxy(i).map_or(0.0, |proxy| stored(at - proxy));
                    (modal.reaction(i), Vector3::zeros())
                }
                None => {
                    felt.stored += stored(at - proxy);
                    (-(k * (at - proxy)), -(tool.velocity - speed) * contact.damping)
                }
            };
            slot.share = (slot.share + self.ramp.map_or(1.0, |ramp| dt / ramp)).min(1.0);
            felt.growing |= slot.share < 1.0;
            felt.elastic += elastic * slot.share;
            felt.damping += damping * slot.share;
            felt.torque += arm.cross(&(elastic + damping)) * slot.share;
        }
        if tool.is_clutched() {
            // A tool that is off the world is not dragged by it; what is held stays where it is held.
            (felt.elastic, felt.damping, felt.torque) = Default::default();
            self.rest();
            return felt;
        }
        self.blend(&mut felt, dt);
        felt
    }

    fn blend(&mut self, felt: &mut PatchForces, dt: f64) {
        if std::mem::take(&mut self.swapped) {
            self.offset = [self.last[0] - felt.elastic - felt.damping, self.last[1] - felt.torque];
            // What was not a number is not to be gone on from.
            self.left = if self.offset.iter().flatten().all(|x| x.is_finite()) { 1.0 } else { 0.0 };
        }
        if self.left > 0.0 {
            self.left = (self.left - dt / BLEND).max(0.0);
            felt.elastic += self.offset[0] * self.left;
            felt.torque += self.offset[1] * self.left;
            felt.growing = true;
        }
        self.last = [felt.elastic + felt.damping, felt.torque];
    }
}
