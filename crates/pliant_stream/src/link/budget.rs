//! Rate limits.

use std::collections::VecDeque;
use std::time::Duration;

use pliant_modal::ModalModel;

use crate::state::UserId;

/// Largest number of users that are away and whose budgets are kept. Budgets refill within some ten
/// seconds, so that those who left before that many others have mostly full ones.
const MAX_AWAY: usize = 4096;

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

    /// Creates an empty bucket, which is filled from `now` on.
    pub(crate) fn empty(now: Duration, rate: f64, most: f64) -> Self {
        Self { left: 0.0, at: now, ..Self::new(rate, most) }
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
    pub(crate) fn spend_or_owe(&mut self, now: Duration, amount: f64) -> bool {
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
    /// Vertices of the patches.
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
    /// What is for all users together: the patches of sixteen that spend all they can. Of 256
    /// users, each may at once make four patches of 64 vertices each.
    pub(crate) fn of_all() -> Self {
        Self { patches: Budget::new(960.0, 1024.0), entries: Budget::new(131_072.0, 65_536.0) }
    }

    /// What is one user's own of that: for 256 users, as much again as is for all.
    pub(crate) fn of_one(now: Duration) -> Self {
        Self { patches: Budget::empty(now, 4.0, 16.0), entries: Budget::empty(now, 512.0, 2048.0) }
    }

    /// Pays for a new patch, also from what is for all or the user's own `share` of it. Returns the
    /// number of vertices within its radius, or `None` where the budgets do not allow it.
    pub(crate) fn spend(
        &mut self,
        [all, share]: [&mut Self; 2],
        now: Duration,
        model: &ModalModel,
        vertex: u32,
        radius: f64,
    ) -> Option<usize> {
        // The vertices are counted last, because that takes a while.
        if !self.patches.spend(now, 1.0) || !pay(&mut all.patches, &mut share.patches, now, 1.0) {
            return None;
        }
        let count = entries(model, vertex, radius);
        let entries = count as f64;
        let paid = self.entries.spend_or_owe(now, entries)
            && pay(&mut all.entries, &mut share.entries, now, entries);
        paid.then_some(count)
    }
}

/// Budgets that all users of a session share, so that many cost no more than a few that stay.
///
/// Each user has a share of its own besides, so that the others cannot take what it needs. The
/// share belongs to the connection and begins empty, so that nobody gains by coming anew.
#[derive(Debug)]
pub(crate) struct SharedBudgets {
    pub(crate) patches: PatchBudget,
    /// What costs most besides: impulses at a host, late inputs among peers.
    pub(crate) work: Budget,
}

impl SharedBudgets {
    /// What is for all.
    pub(crate) fn of_all(work: Budget) -> Self {
        Self { patches: PatchBudget::of_all(), work }
    }

    /// What is one user's own, from `now` on.
    pub(crate) fn of_one(now: Duration, work: Budget) -> Self {
        Self { patches: PatchBudget::of_one(now), work }
    }
}

/// Pays from a user's own share, and where it is too small, from what is for all.
pub(crate) fn pay(all: &mut Budget, share: &mut Budget, now: Duration, amount: f64) -> bool {
    share.spend(now, amount) || all.spend_or_owe(now, amount)
}

/// Number of vertices within the radius, of which a patch has some or all.
fn entries(model: &ModalModel, vertex: u32, radius: f64) -> usize {
    let positions = model.surface().positions();
    let Some(center) = positions.get(vertex as usize) else { return 1 };
    let distance2 = |p: &[f32; 3]| (0..3).map(|k| f64::from(p[k] - center[k]).powi(2)).sum::<f64>();
    positions.iter().filter(|p| distance2(p) <= radius * radius).count()
}

/// The budget of the snapshots or states that one user gets.
pub(crate) fn state_budget() -> Budget {
    Budget::new(2.0, 16.0)
}

/// Budgets of users that are away. Nobody gains by leaving and coming back, since a budget is
/// filled at its next use by the time that has passed, as if its user had stayed.
#[derive(Debug)]
pub(crate) struct AwayBudgets<B> {
    /// Who has left last comes last.
    users: VecDeque<(UserId, B)>,
}

impl<B> Default for AwayBudgets<B> {
    fn default() -> Self {
        Self { users: VecDeque::new() }
    }
}

impl<B> AwayBudgets<B> {
    /// Keeps the budgets of a user that leaves. Who left longest ago is forgotten first, since its
    /// budgets are the fullest.
    pub(crate) fn keep(&mut self, user: UserId, budgets: B) {
        self.take(user);
        if self.users.len() >= MAX_AWAY {
            self.users.pop_front();
        }
        self.users.push_back((user, budgets));
    }

    /// Returns the budgets of a user that comes back.
    pub(crate) fn take(&mut self, user: UserId) -> Option<B> {
        let at = self.users.iter().position(|(away, _)| *away == user)?;
        self.users.remove(at).map(|(_, budgets)| budgets)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_comes_back_has_what_it_left_and_what_time_has_added() {
        let mut away = AwayBudgets::default();
        let mut budget = Budget::new(2.0, 16.0);
        assert!(budget.spend(Duration::from_secs(1), 16.0));
        away.keep(UserId(7), budget);
        let back = away.take(UserId(7));
        assert!(back.is_some_and(|mut b| b.has(Duration::from_secs(4), 6.0) && !b.has(Duration::ZERO, 6.5)));
        assert!(away.take(UserId(7)).is_none(), "it is not away any more");
    }

    #[test]
    fn of_too_many_that_are_away_the_one_that_left_first_is_forgotten() {
        let mut away = AwayBudgets::default();
        for user in 0..=MAX_AWAY as u16 {
            away.keep(UserId(user), user);
        }
        assert_eq!(away.users.len(), MAX_AWAY);
        assert_eq!([0, 1].map(|user| away.take(UserId(user))), [None, Some(1)]);
    }
}
