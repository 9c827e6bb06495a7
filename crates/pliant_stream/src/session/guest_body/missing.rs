//! The ticks that a guest lacks, and when it requests them.

use std::time::Duration;

use super::StreamedBody;
use crate::recovery::Policy;
use crate::wire::{MAX_NACK_RUNS, Nack, NackRun};

/// Largest number of NACKs for one missing tick.
const MAX_REQUESTS: u8 = 12;
/// Age beyond which a missing tick is not requested, ticks.
const REQUEST_WITHIN: u64 = 200;

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct TickRequest {
    times: u8,
    next: Duration,
}

impl StreamedBody {
    /// Returns the missing ticks for which a NACK is due.
    pub(crate) fn missing(&mut self, now: Duration, round_trip: Duration) -> Option<Nack> {
        let receiver = self.receiver.as_ref()?;
        if !self.config.nack {
            return None;
        }
        let history = receiver.history();
        let highest = history.highest();
        let from = (self.resolved + 1).max(highest.saturating_sub(REQUEST_WITHIN));
        // Ticks that a repeat in a later frame may still bring are not requested.
        let to = highest.saturating_sub(u64::from(self.config.repeats));
        let step = Duration::from_secs_f64(2.0 * self.newmark.h);
        let again = (round_trip.mul_f64(1.5) + step).max(Duration::from_millis(60));
        if self.resolved + 1 < from {
            // The host will not send these ticks again. A stream of accelerations cannot recover
            // from their loss.
            let unknown = (self.resolved + 1..from).any(|t| history.known(t).is_none());
            let integrates = !matches!(self.config.policy, Policy::ForceDriven { .. });
            self.wants_snapshot |= unknown && integrates && self.config.snapshots;
            self.resolved = from - 1;
        }
        let mut runs: Vec<NackRun> = Vec::new();
        let mut resolved = self.resolved;
        for tick in from..to {
            if history.known(tick).is_some() {
                if resolved + 1 == tick {
                    resolved = tick;
                }
                continue;
            }
            let (request, other) = self.requests.place(tick);
            if other {
                *request = TickRequest { times: 0, next: now };
            }
            if request.times >= MAX_REQUESTS || request.next > now {
                continue;
            }
            let room = runs.len() < MAX_NACK_RUNS;
            match runs.last_mut() {
                Some(run) if run.first + u64::from(run.count) == tick && run.count < 64 => run.count += 1,
                _ if room => runs.push(NackRun { first: tick, count: 1 }),
                _ => break,
            }
            request.times += 1;
            // The interval grows after the fourth request, since an answer may be slow rather than
            // lost.
            request.next = now + again.mul_f64(1.5_f64.powi(i32::from(request.times.saturating_sub(4))));
        }
        self.resolved = resolved;
        (!runs.is_empty()).then_some(Nack { body: self.id, runs })
    }

    /// Time at which the next NACK is to be repeated.
    pub(crate) fn next_request(&self) -> Option<Duration> {
        let receiver = self.receiver.as_ref().filter(|_| self.config.nack)?;
        let history = receiver.history();
        let highest = history.highest();
        let from = (self.resolved + 1).max(highest.saturating_sub(REQUEST_WITHIN));
        let to = highest.saturating_sub(u64::from(self.config.repeats));
        (from..to)
            .filter(|t| history.known(*t).is_none())
            .filter_map(|t| self.requests.get(t))
            .filter(|a| a.times > 0 && a.times < MAX_REQUESTS)
            .map(|a| a.next)
            .min()
    }
}
