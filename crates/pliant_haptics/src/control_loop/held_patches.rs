//! Forces of the held patches before the safety pipeline: one spring per grab, or the reactions of
//! a body that the loop steps itself.
//!
//! No force is limited here. A grab that replaces another one rises by a ramp of its own. Where one
//! local model replaces another (a new copy of the body, or the proxy after the copy), the force
//! starts at its last value and blends to the new one within [`BLEND`] seconds.

use nalgebra::{Matrix3, Vector3};

use crate::{
    LocalModel, MAX_CONTACTS, ModalLocal, control_loop::proxy::ProxyExtrapolation, control_loop::tool::Tool,
};

/// Time in which the force blends from one local model to another, s.
const BLEND: f64 = 0.05;

/// Forces before the safety pipeline, world axes.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PatchForces {
    pub(crate) elastic: Vector3<f64>,
    pub(crate) damping: Vector3<f64>,
    pub(crate) torque: Vector3<f64>,
    pub(crate) stored: f64,
    /// Whether springs are still ramping up or blending, so that they are stretched further than
    /// the force on the hand shows.
    pub(crate) growing: bool,
}

/// The change of the grabs by a local model update.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Change {
    /// The grabs are the same as before.
    None,
    /// Grabs were added, removed or replaced.
    Other,
    /// The first grabs after none.
    First,
}

/// Times of a tick, s: the loop's clock, the length of the period, and the loop's nominal period.
#[derive(Debug, Clone, Copy)]
pub(crate) struct When {
    pub(crate) now: f64,
    pub(crate) dt: f64,
    pub(crate) period: f64,
}

/// One contact and the share of its force on the hand.
#[derive(Debug, Clone, Copy)]
struct Slot {
    key: u64,
    extrapolation: ProxyExtrapolation,
    share: f64,
}

#[derive(Debug)]
pub(crate) struct HeldPatches {
    slots: [Slot; MAX_CONTACTS],
    count: usize,
    /// Time in which a grab's force rises from zero to full, s. With `None` the force is full at
    /// once.
    ramp: Option<f64>,
    modal: Option<Box<ModalLocal>>,
    /// `last` is the force and torque of the last tick. `offset` is the excess of the previous
    /// local model's force and torque over the present one's. `left` is the part of `offset` that
    /// remains, from 1 to 0.
    last: [Vector3<f64>; 2],
    offset: [Vector3<f64>; 2],
    left: f64,
    swapped: bool,
}

impl HeldPatches {
    pub(crate) fn new(ramp: Option<f64>) -> Self {
        let zero = [Vector3::zeros(); 2];
        Self {
            slots: [Slot { key: 0, extrapolation: ProxyExtrapolation::default(), share: 1.0 }; MAX_CONTACTS],
            count: 0,
            ramp,
            modal: None,
            last: zero,
            offset: zero,
            left: 0.0,
            swapped: false,
        }
    }

    /// Replaces the body that the loop steps, and returns the previous one. The force blends from
    /// the old model to the new one.
    pub(crate) fn set_modal(&mut self, modal: Option<Box<ModalLocal>>) -> Option<Box<ModalLocal>> {
        self.swapped = self.count > 0;
        std::mem::replace(&mut self.modal, modal)
    }

    pub(crate) fn has_modal(&self) -> bool {
        self.modal.is_some()
    }

    /// Registers the grabs of a local model update. Grabs that stay keep their state, whichever
    /// slot they have in the update.
    pub(crate) fn take(&mut self, model: &LocalModel) -> Change {
        let contacts = model.contacts();
        let old = &self.slots[..self.count];
        if old.len() == contacts.len() && old.iter().zip(contacts).all(|(slot, c)| slot.key == c.key) {
            return Change::None;
        }
        let first = self.count == 0;
        // The first grabs need no ramp of their own, because the whole force ramps up.
        let share = if first || self.ramp.is_none() { 1.0 } else { 0.0 };
        let (before, mut taken) = (self.slots, [false; MAX_CONTACTS]);
        for (i, contact) in contacts.iter().enumerate() {
            let same = |j: &usize| before[*j].key == contact.key && !taken[*j];
            let known = (i < self.count).then_some(i).into_iter().chain(0..self.count).find(same);
            if let Some(j) = known {
                taken[j] = true;
            }
            self.slots[i] = known.map_or(
                Slot { key: contact.key, extrapolation: ProxyExtrapolation::default(), share },
                |j| before[j],
            );
        }
        self.count = contacts.len();
        if self.count == 0 {
            self.rest();
        }
        if first { Change::First } else { Change::Other }
    }

    /// Resets the blend while no force acts, so that the next force starts without an offset.
    pub(crate) fn rest(&mut self) {
        self.last = [Vector3::zeros(); 2];
        (self.left, self.swapped) = (0.0, false);
    }

    /// Returns the forces of this tick. `well` says whether the hand's position is valid, so that
    /// the loop's own body may follow it.
    pub(crate) fn forces(&mut self, when: When, well: bool, tool: &Tool, model: &LocalModel) -> PatchForces {
        let mut forces = PatchForces { stored: model.stored, ..PatchForces::default() };
        let stepped = match &mut self.modal {
            Some(modal) if well => {
                let steps = (when.dt / when.period).round().clamp(1.0, 4.0) as usize;
                modal.advance(when.now, steps, tool, model)
            }
            _ => false,
        };
        let modal = self.modal.as_deref().filter(|_| stepped);
        if let Some(modal) = modal.filter(|modal| modal.has_all(model)) {
            forces.stored = modal.energy();
        }
        let dt = when.dt.min(2.0 * when.period);
        for (contact, slot) in model.contacts().iter().zip(&mut self.slots) {
            let arm = tool.orientation * Vector3::from(contact.offset);
            let (proxy, speed) = slot.extrapolation.advance(when.now, dt, model, contact);
            let at = tool.position + arm;
            let k = Matrix3::from_fn(|r, c| contact.stiffness[r][c]);
            let stored = |stretch: Vector3<f64>| 0.5 * stretch.dot(&(k * stretch)).max(0.0);
            let (elastic, damping) = match modal.and_then(|modal| modal.reaction(contact.key)) {
                Some([reaction, proxy]) => {
                    forces.stored += stored(at - proxy);
                    (reaction, Vector3::zeros())
                }
                None => {
                    forces.stored += stored(at - proxy);
                    (-(k * (at - proxy)), -(tool.velocity - speed) * contact.damping)
                }
            };
            slot.share = (slot.share + self.ramp.map_or(1.0, |ramp| dt / ramp)).min(1.0);
            forces.growing |= slot.share < 1.0;
            forces.elastic += elastic * slot.share;
            forces.damping += damping * slot.share;
            forces.torque += arm.cross(&(elastic + damping)) * slot.share;
        }
        if tool.is_clutched() {
            // The clutch detaches the tool from the hand, so the body must not drag the hand. The
            // held patches stay where they are.
            (forces.elastic, forces.damping, forces.torque) = Default::default();
            self.rest();
            return forces;
        }
        self.blend(&mut forces, dt);
        forces
    }

    fn blend(&mut self, forces: &mut PatchForces, dt: f64) {
        if std::mem::take(&mut self.swapped) {
            self.offset = [self.last[0] - forces.elastic - forces.damping, self.last[1] - forces.torque];
            // An offset that is not finite is discarded.
            self.left = if self.offset.iter().flatten().all(|x| x.is_finite()) { 1.0 } else { 0.0 };
        }
        if self.left > 0.0 {
            self.left = (self.left - dt / BLEND).max(0.0);
            forces.elastic += self.offset[0] * self.left;
            forces.torque += self.offset[1] * self.left;
            forces.growing = true;
        }
        self.last = [forces.elastic + forces.damping, forces.torque];
    }
}
