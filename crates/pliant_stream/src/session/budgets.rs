//! What guests may ask of a host: each of them, and all together.

use std::time::Duration;

use pliant_modal::ModalModel;

use super::host_peer::{GuestPeer, MAX_GUEST_GRABS};
use crate::link::{Budget, PatchBudget, SharedBudgets, pay, state_budget};
use crate::wire::MAX_BODIES;

/// Largest number of impulses of one guest at once.
pub(super) const IMPULSES_AT_ONCE: usize = 120;

/// The budget of impulses of one guest, which guest and host both keep: 60 a second.
pub(super) fn impulse_budget() -> Budget {
    Budget::new(60.0, IMPULSES_AT_ONCE as f64)
}

/// The budgets of one guest. They are kept while it is away.
#[derive(Debug)]
pub(crate) struct GuestBudgets {
    patches: PatchBudget,
    impulses: Budget,
    /// Snapshots that the guest requests.
    pub(super) snapshots: Budget,
    /// Ticks that are sent again.
    pub(super) repeats: Budget,
    /// Bytes of models.
    pub(super) models: Budget,
    /// Messages of all kinds that have no budget of their own.
    pub(super) messages: Budget,
    /// New targets of hands.
    pub(super) targets: Budget,
    /// Changes of interest.
    pub(super) interests: Budget,
}

impl GuestBudgets {
    pub(super) fn new(model_rate: f64) -> Self {
        Self {
            patches: PatchBudget::default(),
            impulses: impulse_budget(),
            snapshots: state_budget(),
            // This covers 60 Hz at full loss with every tick requested eight times, for several
            // bodies at once. At once, four bodies' whole past may be requested.
            repeats: Budget::new(4000.0, 1024.0),
            models: Budget::new(model_rate, 64.0 * 1024.0),
            messages: Budget::new(200.0, 400.0),
            // All hands that a guest may have, each moved 240 times a second.
            targets: Budget::new(MAX_GUEST_GRABS as f64 * 240.0, 1024.0),
            // One for each of the most bodies that a session may have.
            interests: Budget::new(100.0, MAX_BODIES as f64),
        }
    }
}

/// Impulses for all guests: those of sixty-four that spend all they can. Of 256 guests, each may at
/// once make eight.
pub(super) fn impulses_of_all() -> Budget {
    Budget::new(3840.0, 2048.0)
}

/// One guest's own of them: for 256 guests, as much again as is for all.
pub(super) fn impulses_of_one(now: Duration) -> Budget {
    Budget::empty(now, 15.0, 30.0)
}

impl GuestPeer {
    /// Pays for a new patch, and returns its number of vertices if the budgets allow it. Each patch
    /// costs every encoder of its body a table over its vertices.
    pub(super) fn pays_for_patch(
        &mut self,
        all: &mut SharedBudgets,
        now: Duration,
        model: &ModalModel,
        vertex: u32,
        radius: f64,
    ) -> Option<usize> {
        let all = [&mut all.patches, &mut self.share.patches];
        self.budgets.patches.spend(all, now, model, vertex, radius)
    }

    /// Pays for an impulse, and returns whether the budgets allow it.
    pub(super) fn pays_for_impulse(&mut self, all: &mut SharedBudgets, now: Duration) -> bool {
        self.budgets.impulses.spend(now, 1.0) && pay(&mut all.work, &mut self.share.work, now, 1.0)
    }
}
