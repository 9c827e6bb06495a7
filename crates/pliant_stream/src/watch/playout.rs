//! Which state to draw at which time: a little behind the host, so that there is a next state. The
//! page in `crates/pliant_cli/page/src/playout.ts` does the same.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use super::{WatchHand, WatchHands, WatchedState};
use crate::state::{RigidState, Tick};

/// Most states of a body that wait to be drawn.
const MOST: usize = 64;
/// How long the earliest arrivals count.
const WINDOW: Duration = Duration::from_secs(5);
/// A jump of the offset that is no jitter, s.
const JUMP: f64 = 1.0;
/// Number of frames by which a group may begin before what was seen last.
const OVERLAP: u64 = 1000;

/// The host's ticks by the clock of the watcher: the line through the earliest arrivals of the last
/// seconds, which are those that waited least.
#[derive(Debug, Clone)]
pub struct TickClock {
    step: f64,
    /// When an arrival was, and by how much its tick was ahead of the watcher's clock, s. Later
    /// entries are less ahead, and the first one counts.
    ahead: VecDeque<(Duration, f64)>,
}

impl TickClock {
    /// A clock for ticks of `step` seconds.
    pub fn new(step: f64) -> Self {
        Self { step, ahead: VecDeque::new() }
    }

    /// A tick has arrived at `now`.
    pub fn arrived(&mut self, tick: Tick, now: Duration) {
        let offset = tick as f64 * self.step - now.as_secs_f64();
        // Another count of ticks, or a pause of this machine.
        if self.ahead.front().is_some_and(|(_, known)| (offset - known).abs() > JUMP) {
            self.ahead.clear();
        }
        while self.ahead.back().is_some_and(|(_, less)| *less <= offset) {
            self.ahead.pop_back();
        }
        self.ahead.push_back((now, offset));
        while self.ahead.front().is_some_and(|(at, _)| *at + WINDOW < now) {
            self.ahead.pop_front();
        }
    }

    /// The tick to draw at `now`, `delay` behind the earliest arrivals. `None` before the first
    /// one.
    pub fn tick(&self, now: Duration, delay: Duration) -> Option<f64> {
        let (_, offset) = self.ahead.front()?;
        Some((now.as_secs_f64() + offset - delay.as_secs_f64()) / self.step)
    }
}

/// The states of a body that are drawn or wait.
#[derive(Debug, Clone)]
pub struct BodyPlayout {
    every: u64,
    states: VecDeque<WatchedState>,
}

impl BodyPlayout {
    /// For a body with `every` ticks from one frame to the next.
    pub fn new(every: u64) -> Self {
        Self { every: every.max(1), states: VecDeque::new() }
    }

    /// The newest state.
    pub fn newest(&self) -> Option<&WatchedState> {
        self.states.back()
    }

    /// Takes a state. One that is older than the newest is left out, unless ticks are counted anew.
    pub fn push(&mut self, state: WatchedState) {
        if let Some(last) = self.states.back() {
            if state.tick <= last.tick {
                if last.tick - state.tick < OVERLAP * self.every {
                    return;
                }
                self.states.clear();
            } else if last.resting && state.tick > last.tick + self.every {
                // It slept until a moment ago, and did not glide all that time.
                let until = WatchedState { tick: state.tick - self.every, ..last.clone() };
                self.states.push_back(until);
            }
        }
        self.states.push_back(state);
        while self.states.len() > MOST {
            self.states.pop_front();
        }
    }

    /// Writes the state at a tick: coordinates into `q`, and returns the pose of a free body.
    /// `None` without a state. Beyond the newest state the body stays in it.
    pub fn at(&mut self, tick: f64, q: &mut Vec<f64>) -> Option<Option<RigidState>> {
        while self.states.get(1).is_some_and(|next| next.tick as f64 <= tick) {
            self.states.pop_front();
        }
        let from = self.states.front()?;
        let to = self.states.get(1).unwrap_or(from);
        let span = (to.tick - from.tick) as f64;
        let part = if span > 0.0 { ((tick - from.tick as f64) / span).clamp(0.0, 1.0) } else { 0.0 };
        q.clear();
        let ends = from.q.iter().zip(&to.q);
        q.extend(ends.map(|(a, b)| a + (b - a) * part));
        let pose = from.pose.zip(to.pose).map(|(a, b)| between(&a, &b, part));
        Some(pose.or(to.pose))
    }
}

/// The hands that are drawn or wait. They are played out by their ticks, as bodies are: shown at
/// their arrival they would be ahead of the body that they hold.
#[derive(Debug, Clone, Default)]
pub struct HandsPlayout {
    frames: VecDeque<WatchHands>,
}

impl HandsPlayout {
    /// Takes a frame. One that is older than the newest is left out, unless ticks are counted anew.
    pub fn push(&mut self, frame: WatchHands) {
        if let Some(last) = self.frames.back()
            && frame.tick <= last.tick
        {
            if last.tick - frame.tick < OVERLAP {
                return;
            }
            self.frames.clear();
        }
        self.frames.push_back(frame);
        while self.frames.len() > MOST {
            self.frames.pop_front();
        }
    }

    /// The hands at a tick, in straight lines between two frames. A hand that only the earlier of
    /// them has stays where it was until the later one.
    pub fn at(&mut self, tick: f64) -> Vec<WatchHand> {
        while self.frames.get(1).is_some_and(|next| next.tick as f64 <= tick) {
            self.frames.pop_front();
        }
        let Some(from) = self.frames.front().filter(|from| from.tick as f64 <= tick) else {
            return Vec::new();
        };
        let to = self.frames.get(1).unwrap_or(from);
        let span = (to.tick - from.tick) as f64;
        let part = if span > 0.0 { ((tick - from.tick as f64) / span).clamp(0.0, 1.0) } else { 0.0 };
        let mix = |a: [f64; 3], b: [f64; 3]| std::array::from_fn(|k| a[k] + (b[k] - a[k]) * part);
        let of = |hand: &WatchHand| (hand.body, hand.key);
        let next: BTreeMap<_, _> = to.hands.iter().map(|hand| (of(hand), hand)).collect();
        let hands = from.hands.iter().map(|hand| match next.get(&of(hand)) {
            Some(next) => WatchHand {
                target: mix(hand.target, next.target),
                reaction: mix(hand.reaction, next.reaction),
                ..*hand
            },
            None => *hand,
        });
        hands.collect()
    }
}

/// The pose `part` of the way from one to another. Frames are close, so that the straight line
/// between two quaternions, scaled to unit length, is as good as the arc.
fn between(from: &RigidState, to: &RigidState, part: f64) -> RigidState {
    let along: f64 = from.rotation.iter().zip(to.rotation).map(|(a, b)| a * b).sum();
    let sign = if along < 0.0 { -1.0 } else { 1.0 };
    let mix = |a: f64, b: f64| a + (b - a) * part;
    let turned: [f64; 4] = std::array::from_fn(|k| mix(from.rotation[k], sign * to.rotation[k]));
    let norm = turned.iter().map(|x| x * x).sum::<f64>().sqrt();
    RigidState {
        position: std::array::from_fn(|k| mix(from.position[k], to.position[k])),
        rotation: if norm > 1e-6 { turned.map(|x| x / norm) } else { to.rotation },
        ..RigidState::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(tick: Tick, x: f64, resting: bool) -> WatchedState {
        WatchedState { tick, q: vec![x], pose: None, resting }
    }

    #[test]
    fn the_picture_moves_evenly_behind_late_arrivals() {
        let step = 1.0 / 60.0;
        let mut clock = TickClock::new(step);
        let mut playout = BodyPlayout::new(2);
        let mut seed = 1_u64;
        let (mut worst, mut q) = (0.0_f64, Vec::new());
        for frame in 0..600_u64 {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            // A frame each 1/30 s, up to 30 ms late. Ticks begin at 5,000.
            let late = 0.03 * (seed >> 40) as f64 / (1_u64 << 24) as f64;
            let sent = frame as f64 / 30.0;
            let now = Duration::from_secs_f64(1.0 + sent + late);
            let tick = 5000 + 2 * frame;
            clock.arrived(tick, now);
            playout.push(state(tick, tick as f64, false));
            let drawn = clock.tick(now, Duration::from_secs_f64(1.0 / 30.0 + 0.04)).unwrap();
            if frame > 60 {
                playout.at(drawn, &mut q).unwrap();
                // What is drawn is the tick itself, since the coordinate is its number.
                worst = worst.max((q[0] - drawn).abs());
                let due = 5000.0 + 60.0 * (sent + late) - 60.0 * (1.0 / 30.0 + 0.04);
                assert!((drawn - due).abs() < 0.5, "tick {drawn} at {due}");
            }
        }
        assert!(worst < 1e-6, "the picture is off by {worst} ticks");
    }

    #[test]
    fn hands_are_where_they_were_at_the_bodys_time() {
        let hand = |grab, x: f64| WatchHand {
            key: crate::GrabKey { grab, ..Default::default() },
            target: [x, 0.0, 0.0],
            reaction: [0.0, 2.0 * x, 0.0],
            ..WatchHand::default()
        };
        let frame = |tick, hands| WatchHands { tick, hands, ..WatchHands::default() };
        let mut playout = HandsPlayout::default();
        assert_eq!(playout.at(0.0), []);
        playout.push(frame(10, vec![hand(1, 1.0), hand(2, 5.0)]));
        playout.push(frame(12, vec![hand(3, 9.0), hand(1, 2.0)]));
        // One goes on, one ends with its frame, and one begins with its own.
        assert_eq!(playout.at(9.0), []);
        assert_eq!(playout.at(10.0), [hand(1, 1.0), hand(2, 5.0)]);
        assert_eq!(playout.at(11.0), [hand(1, 1.5), hand(2, 5.0)]);
        assert_eq!(playout.at(12.0), [hand(3, 9.0), hand(1, 2.0)]);
        assert_eq!(playout.at(1e9), [hand(3, 9.0), hand(1, 2.0)], "the newest stays");
        playout.push(frame(11, Vec::new()));
        assert_eq!(playout.at(12.0).len(), 2, "an old frame is left out");
        for tick in 13..5000 {
            playout.push(frame(tick, Vec::new()));
        }
        assert!(playout.frames.len() <= MOST);
        // A host that has started again counts from the beginning.
        playout.push(frame(7, vec![hand(1, 3.0)]));
        assert_eq!(playout.at(7.0), [hand(1, 3.0)]);
    }

    #[test]
    fn sleep_new_counts_and_floods() {
        let mut playout = BodyPlayout::new(2);
        let mut q = Vec::new();
        assert_eq!(playout.at(0.0, &mut q), None);
        playout.push(state(100, 1.0, true));
        playout.push(state(500, 2.0, false));
        playout.at(400.0, &mut q).unwrap();
        assert_eq!(q, [1.0], "a body that slept until just now does not glide");
        playout.at(499.0, &mut q).unwrap();
        assert_eq!(q, [1.5]);
        playout.push(state(480, 9.0, false));
        assert_eq!(playout.newest().unwrap().tick, 500, "an old state is left out");
        playout.at(1e9, &mut q).unwrap();
        assert_eq!(q, [2.0]);
        for tick in 501..5000 {
            playout.push(state(tick, 0.0, false));
        }
        assert!(playout.states.len() <= MOST);
        // A host that has started again counts from the beginning.
        playout.push(state(7, 3.0, false));
        assert_eq!(playout.newest().unwrap().tick, 7);
        let mut clock = TickClock::new(0.1);
        assert_eq!(clock.tick(Duration::ZERO, Duration::ZERO), None);
        clock.arrived(1000, Duration::from_secs(1));
        clock.arrived(7, Duration::from_secs(2));
        let tick = clock.tick(Duration::from_secs(2), Duration::ZERO).unwrap();
        assert!((tick - 7.0).abs() < 1e-9);
    }
}
