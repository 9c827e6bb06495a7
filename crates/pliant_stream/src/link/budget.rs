//! Rate limits.

use std::time::Duration;

use pliant_modal::ModalModel;

/// A token bucket.
#[derive(Debug, Clone)]
pub(crate) struct Budget {
    rate: f64,
    most: f64,
    left: f64,
    at: Duration,
}

impl Budget {
    /// Creates a full bucket that gains `rate` per second and holds at most `most`.
    pub(crate) fn new(rate: f64, most: f64) -> Self {
        Self { rate, most, left: most, at: Duration::ZERO }
    }

    fn refill(&mut self, now: Duration) {
        let passed = now.saturating_sub(self.at).as_secs_f64();
        self.left = (self.left + passed * self.rate).min(self.most);
        self.at = self.at.max(now);
    }

    /// Returns whether `amount` is available.
    pub(crate) fn has(&mut self, now: Duration, amount: f64) -> bool {
        self.refill(now);
        self.left >= amount
    }

    /// Takes `amount` if it is available, and returns whether it was.
    pub(crate) fn spend(&mut self, now: Duration, amount: f64) -> bool {
        let there = self.has(now, amount);
        if there {
            self.left -= amount;
        }
        there
    }

    /// Takes `amount` if anything is available, and returns whether it was. What is lacking is
    /// owed, so that an amount larger than the bucket can be spent, at the same rate.
    fn spend_or_owe(&mut self, now: Duration, amount: f64) -> bool {
        let any = self.has(now, f64::MIN_POSITIVE);
        if any {
            self.left -= amount;
        }
        any
    }

    /// Returns the time at which `amount` will be available.
    pub(crate) fn ready_at(&self, amount: f64) -> Duration {
        let missing = (amount.min(self.most) - self.left).max(0.0);
        self.at
            + Duration::from_secs_f64((missing / self.rate.max(1e-9)).min(3600.0))
            + Duration::from_micros(1)
    }
}

/// A limit on the new patches of one user. Each patch costs every copy of its body a table over its
/// vertices.
#[derive(Debug, Clone)]
pub(crate) struct PatchBudget {
    patches: Budget,
    entries: Budget,
}

impl Default for PatchBudget {
    fn default() -> Self {
        Self {
            // A sliding hand makes a new patch each tick. The budget covers this rate and a burst.
            patches: Budget::new(60.0, 120.0),
            // With those patches, 136 vertices in each.
            entries: Budget::new(8192.0, 16_384.0),
        }
    }
}

impl PatchBudget {
    /// Pays for a patch, and returns whether the budget allows it.
    pub(crate) fn spend(&mut self, now: Duration, model: &ModalModel, vertex: u32, radius: f64) -> bool {
        self.patches.spend(now, 1.0) && self.entries.spend_or_owe(now, entries(model, vertex, radius))
    }
}

/// Number of vertices within the radius, of which a patch has some or all.
fn entries(model: &ModalModel, vertex: u32, radius: f64) -> f64 {
    let positions = model.surface().positions();
    let Some(center) = positions.get(vertex as usize) else { return 1.0 };
    let distance2 = |p: &[f32; 3]| (0..3).map(|k| f64::from(p[k] - center[k]).powi(2)).sum::<f64>();
    positions.iter().filter(|p| distance2(p) <= radius * radius).count() as f64
}
