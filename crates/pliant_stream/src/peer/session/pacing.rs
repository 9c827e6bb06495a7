//! Pacing: how fast this peer steps, to stay with the others.

use std::time::Duration;

use super::PeerSession;

/// Largest share by which a peer's step is stretched or shortened to match the other peers' ticks.
const SLEW: f64 = 0.01;
/// Number of ticks behind most others from which on a peer catches up by steps of its own.
pub(super) const BEHIND: u64 = 8;
/// A peer counts for so long after its last tick arrived: at least this long, and at least so many
/// steps.
const PRESENT: Duration = Duration::from_millis(250);
const PRESENT_STEPS: f64 = 4.0;

impl PeerSession {
    /// By how many ticks most other peers are at least ahead of this one, and by how many behind,
    /// judged by the newest tick received from each of late. Some may have stalled together. Where
    /// less than half have sent one of late, both are zero.
    pub(super) fn lead(&self) -> (u64, u64) {
        let known = || self.others.values().filter(|o| o.user.is_some() && o.newest > 0);
        let patience = PRESENT.max(Duration::from_secs_f64(PRESENT_STEPS * self.config.step));
        let present = known().filter(|o| self.updated.saturating_sub(o.newest_at) <= patience);
        let mut newest: Vec<u64> = present.map(|o| o.newest).collect();
        if 2 * newest.len() < known().count() {
            return (0, 0);
        }
        newest.sort_unstable();
        let half = newest.len() / 2;
        let of = |at: usize| newest.get(at).copied().unwrap_or(self.tick);
        let (high, low) = (of(newest.len().saturating_sub(1 + half)), of(half));
        (high.saturating_sub(self.tick), self.tick.saturating_sub(low))
    }

    /// Steps up to `most` of the ticks that this peer has missed, if most others are well ahead.
    /// Then it was a stall. Returns the number of ticks.
    pub(super) fn catch_up(&mut self, most: u64) -> u64 {
        let (ahead, _) = self.lead();
        self.catches_up = ahead > if self.catches_up { 0 } else { BEHIND };
        if !self.catches_up {
            return 0;
        }
        let ticks = most.min(ahead).min(self.missed);
        (0..ticks).for_each(|_| self.step());
        self.missed -= ticks;
        self.caught_up += ticks;
        for ahead in self.others.values_mut().filter_map(|o| o.ahead.as_mut()) {
            *ahead += ticks as f64;
        }
        ticks
    }

    /// Share by which a step is longer than `step`, to stay with the other peers; positive when
    /// this peer is ahead.
    ///
    /// Each side sees the other late by the one-way delay. With `d` the true lead and `w` the
    /// one-way delay in ticks, this side sees `d + w` and the other `w - d`, so half the difference
    /// is `d`.
    pub(super) fn drift(&self) -> f64 {
        let leads: Vec<f64> =
            self.others.values().filter_map(|o| Some(0.5 * (o.ahead? - o.theirs?))).collect();
        if leads.is_empty() {
            return 0.0;
        }
        let mean = leads.iter().sum::<f64>() / leads.len() as f64;
        (0.01 * mean).clamp(-SLEW, SLEW)
    }
}
