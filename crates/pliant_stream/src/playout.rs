//! Decides when a guest shows which tick.

use std::collections::VecDeque;
use std::time::Duration;

use crate::recovery::Playout;
use crate::state::Tick;

/// Number of arrivals that the estimate uses.
const WINDOW: usize = 128;
/// Slew rate of the schedule toward the estimate, 1 %. Slewing keeps the change invisible.
const SLEW: f64 = 0.01;
/// Error that a hitch of the host, the network or this guest leaves, ticks. A guest that is ahead
/// would show guesses, and waits at once. One that is behind runs after the schedule.
const HITCH: f64 = 2.0;
/// Speed of running after the schedule, on top of the normal one, and the error at which it ends,
/// ticks.
const RUN: f64 = 0.75;
const CAUGHT_UP: f64 = 0.1;
/// Error beyond which the estimate is adopted at once, s. It means that the path or the host's
/// clock has jumped.
const JUMP: f64 = 0.25;
/// Number of consecutive frames later than `SHIFTED` ticks behind the line after which the line
/// itself has moved, because the host paused.
pub(crate) const LATE_ROW: usize = 4;
const SHIFTED: f64 = 3.0;
/// Smallest and largest margin for scattered arrivals on top of a fixed delay, ticks.
const MARGIN: f64 = 0.25;
const MAX_SCATTER: f64 = 2.0;
/// Share of frames that may arrive too late.
const LATE_SHARE: f64 = 0.02;

/// Maps ticks to the guest's clock by the arrival times of their frames.
///
/// The earliest arrivals of the last 128 frames mark a line `t = offset + tick h`. A tick is shown
/// some ticks behind this line. The estimate needs no clock of the host, and a host clock that
/// jumps does no harm.
#[derive(Debug, Clone)]
pub struct PlayoutClock {
    h: f64,
    playout: Playout,
    samples: VecDeque<f64>,
    offset: Option<f64>,
    at: f64,
    runs: bool,
    scratch: Vec<f64>,
}

impl PlayoutClock {
    /// Creates a clock for ticks of `h` seconds.
    pub fn new(h: f64, playout: Playout) -> Self {
        Self {
            h,
            playout,
            samples: VecDeque::with_capacity(WINDOW),
            offset: None,
            at: 0.0,
            runs: false,
            scratch: Vec::new(),
        }
    }

    /// Adds the arrival of a frame that is newer than all frames before.
    pub fn arrived(&mut self, now: Duration, tick: Tick) {
        let now = now.as_secs_f64();
        let sample = now - tick as f64 * self.h;
        if self.samples.back().is_some_and(|last| (sample - last).abs() > 10.0 * JUMP) {
            // The host paused or restarted its tick numbers, so the older samples do not apply.
            self.samples.clear();
        }
        let earliest = self.samples.iter().copied().fold(f64::INFINITY, f64::min);
        let row = self.samples.iter().rev().take(LATE_ROW - 1);
        if self.samples.len() >= LATE_ROW && row.chain([&sample]).all(|s| *s > earliest + SHIFTED * self.h) {
            let old = self.samples.len() - (LATE_ROW - 1);
            self.samples.drain(..old);
        }
        if self.samples.len() >= WINDOW {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
        let target = self.target();
        self.offset = Some(match self.offset {
            Some(old) if (target - old).abs() < JUMP => {
                let ahead = (target - old) / self.h;
                self.runs = ahead < -HITCH || (self.runs && ahead < -CAUGHT_UP);
                let rate = if self.runs { RUN } else { SLEW };
                let room = rate * (now - self.at).clamp(0.0, 1.0);
                if ahead > HITCH { target } else { old + (target - old).clamp(-room, room) }
            }
            _ => target,
        });
        self.at = now;
    }

    /// Computes the time to which the line plus the delay should move.
    fn target(&mut self) -> f64 {
        let earliest = self.samples.iter().copied().fold(f64::INFINITY, f64::min);
        self.scratch.clear();
        self.scratch.extend(self.samples.iter().map(|s| (s - earliest) / self.h));
        // Host and guest both run once per rendered frame, which scatters arrivals even on a
        // perfect path.
        let last = self.scratch.len().saturating_sub(1);
        let index = ((self.scratch.len() as f64 * (1.0 - LATE_SHARE)) as usize).min(last);
        let late = match self.scratch.get_mut(..) {
            Some(all) if !all.is_empty() => *all.select_nth_unstable_by(index, f64::total_cmp).1,
            _ => 0.0,
        };
        let ticks = match self.playout {
            Playout::Fixed(ticks) => f64::from(ticks) + late.clamp(MARGIN, MAX_SCATTER),
            Playout::Adaptive(most) => (late + MARGIN).min(f64::from(most) + MARGIN),
        };
        earliest + ticks * self.h
    }

    /// Time at which a tick is shown, on the guest's clock; `None` before the first frame.
    pub fn due(&self, tick: Tick) -> Option<Duration> {
        let t = self.offset? + tick as f64 * self.h;
        Duration::try_from_secs_f64(t.max(0.0)).ok()
    }

    /// The tick that is shown at a time, with its fraction; `None` before the first frame.
    pub fn tick_at(&self, now: Duration) -> Option<f64> {
        Some((now.as_secs_f64() - self.offset?) / self.h)
    }

    /// Delay of the shown tick behind its earliest arrival, s.
    pub fn delay(&self) -> f64 {
        let earliest = self.samples.iter().copied().fold(f64::INFINITY, f64::min);
        self.offset.map_or(0.0, |o| (o - earliest).max(0.0))
    }
}
