//! When a guest shows which tick.

use std::collections::VecDeque;
use std::time::Duration;

use crate::recovery::Playout;
use crate::state::Tick;

/// Arrivals that the estimate looks back on.
const WINDOW: usize = 128;
/// The schedule is drawn towards the estimate at this rate, so that nobody sees it: 1 %.
const SLEW: f64 = 0.01;
/// An estimate farther off than this is taken over at once, s: the path or the host's clock has jumped.
const JUMP: f64 = 0.25;
/// So many frames in a row later than `SHIFTED` ticks behind the line mean that the line has moved: the host paused.
const LATE_ROW: usize = 8;
const SHIFTED: f64 = 3.0;
/// Least and most room for scattered arrivals on top of a fixed delay, in ticks.
const MARGIN: f64 = 0.25;
const MOST_SCATTER: f64 = 2.0;
/// Share of frames that may come too late.
const LATE_SHARE: f64 = 0.02;

/// Maps ticks to the guest's clock by when their frames arrive: the earliest arrivals of the last 128 frames mark a line
/// `t = offset + tick h`; a tick is shown some ticks behind it. No clock of the host is needed, and one that jumps does
/// no harm.
#[derive(Debug, Clone)]
pub struct PlayoutClock {
    h: f64,
    playout: Playout,
    samples: VecDeque<f64>,
    offset: Option<f64>,
    at: f64,
    scratch: Vec<f64>,
}

impl PlayoutClock {
    /// For ticks of `h` seconds.
    pub fn new(h: f64, playout: Playout) -> Self {
        Self {
            h,
            playout,
            samples: VecDeque::with_capacity(WINDOW),
            offset: None,
            at: 0.0,
            scratch: Vec::new(),
        }
    }

    /// A frame that is newer than all before has arrived.
    pub fn arrived(&mut self, now: Duration, tick: Tick) {
        let now = now.as_secs_f64();
        let sample = now - tick as f64 * self.h;
        if self.samples.back().is_some_and(|last| (sample - last).abs() > 10.0 * JUMP) {
            // The host paused, or numbered on from elsewhere: what was learnt is void.
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
                let room = SLEW * (now - self.at).clamp(0.0, 1.0);
                old + (target - old).clamp(-room, room)
            }
            _ => target,
        });
        self.at = now;
    }

    /// Where the line plus the delay should be.
    fn target(&mut self) -> f64 {
        let earliest = self.samples.iter().copied().fold(f64::INFINITY, f64::min);
        self.scratch.clear();
        self.scratch.extend(self.samples.iter().map(|s| (s - earliest) / self.h));
        // Both sides work frame by frame of their pictures: arrivals scatter by that even on a perfect path.
        let last = self.scratch.len().saturating_sub(1);
        let index = ((self.scratch.len() as f64 * (1.0 - LATE_SHARE)) as usize).min(last);
        let late = match self.scratch.get_mut(..) {
            Some(all) if !all.is_empty() => *all.select_nth_unstable_by(index, f64::total_cmp).1,
            _ => 0.0,
        };
        let ticks = match self.playout {
            Playout::Fixed(ticks) => f64::from(ticks) + late.clamp(MARGIN, MOST_SCATTER),
            Playout::Adaptive(most) => (late + MARGIN).min(f64::from(most) + MARGIN),
        };
        earliest + ticks * self.h
    }

    /// When a tick is to be shown, on the guest's clock; `None` before the first frame.
    pub fn due(&self, tick: Tick) -> Option<Duration> {
        let t = self.offset? + tick as f64 * self.h;
        Duration::try_from_secs_f64(t.max(0.0)).ok()
    }

    /// How far the shown tick lies behind its earliest arrival, s.
    pub fn delay(&self) -> f64 {
        let earliest = self.samples.iter().copied().fold(f64::INFINITY, f64::min);
        self.offset.map_or(0.0, |o| (o - earliest).max(0.0))
    }
}
