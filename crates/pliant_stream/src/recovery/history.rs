//! What has arrived, tick by tick: a ring of fixed length.

use crate::state::{GrabKey, GrabState, MAX_GRABS, Pose, Tick};
use crate::wire::{Frame, FrameGrab, Slice};

/// Ticks that a receiver remembers. Older data is not used any more.
pub const HISTORY: usize = 256;

/// What is known of one tick.
#[derive(Debug, Clone, Default)]
pub struct TickData {
    /// Which tick this slot holds.
    pub tick: Tick,
    /// The part that drives the state (accelerations or reactions) is here.
    pub known: bool,
    /// The frame of this tick itself is here, not only a repeat.
    pub head: bool,
    /// Modal accelerations; empty where the stream carries none.
    pub accelerations: Vec<f64>,
    /// The grabs that held, with their reactions and where their patches were.
    pub grabs: Vec<FrameGrab>,
    /// Rigid frame of a free body.
    pub pose: Option<Pose>,
    /// A part of the absolute state.
    pub slice: Option<Slice>,
    /// Checksum of the state.
    pub check: Option<f32>,
}

/// The last [`HISTORY`] ticks.
#[derive(Debug, Clone)]
pub struct History {
    slots: Vec<TickData>,
    highest: Tick,
}

impl History {
    /// Nothing known; `tick` is the last one that is not of interest any more.
    pub fn new(tick: Tick) -> Self {
        Self { slots: vec![TickData::default(); HISTORY], highest: tick }
    }

    /// The newest tick for which something arrived.
    pub fn highest(&self) -> Tick {
        self.highest
    }

    /// What is known of a tick, if its driving part is.
    pub fn known(&self, tick: Tick) -> Option<&TickData> {
        let slot = &self.slots[(tick % HISTORY as u64) as usize];
        (slot.tick == tick && slot.known).then_some(slot)
    }

    /// The state of a tick as far as the frame itself has come.
    pub fn head(&self, tick: Tick) -> Option<&TickData> {
        self.known(tick).filter(|d| d.head)
    }

    /// The newest known tick at or before `tick` and after `tick - HISTORY`.
    pub fn last_known(&self, tick: Tick) -> Option<&TickData> {
        (0..HISTORY as u64).map_while(|back| tick.checked_sub(back)).find_map(|t| self.known(t))
    }

    fn slot(&mut self, tick: Tick) -> &mut TickData {
        let slot = &mut self.slots[(tick % HISTORY as u64) as usize];
        if slot.tick != tick {
            slot.tick = tick;
            slot.known = false;
            slot.head = false;
            slot.accelerations.clear();
            slot.grabs.clear();
            slot.pose = None;
            slot.slice = None;
            slot.check = None;
        }
        slot
    }

    fn accepts(&self, tick: Tick) -> bool {
        tick > 0 && tick + (HISTORY as u64) > self.highest
    }

    /// Takes a frame and what it repeats. Calls `new(tick, head)` for each tick that was not known before (`head` false
    /// for a repeat) and for a head that completes a tick known from a repeat.
    pub fn take(&mut self, frame: &Frame, modes: usize, mut new: impl FnMut(Tick, bool)) {
        self.highest = self.highest.max(frame.tick);
        for repeat in &frame.repeats {
            let Some(tick) = frame.tick.checked_sub(u64::from(repeat.back)) else { continue };
            if !self.accepts(tick) || self.known(tick).is_some() {
                continue;
            }
            let slot = self.slot(tick);
            slot.grabs.extend(repeat.grabs.iter().filter_map(|r| {
                let grab = frame.grabs.get(usize::from(r.index))?;
                let state = GrabState { reaction: r.reaction, ..grab.state };
                Some(FrameGrab { state, displacement: r.displacement, held: true })
            }));
            slot.grabs.truncate(MAX_GRABS);
            if let Some(a) = &repeat.accelerations {
                slot.accelerations.extend((0..modes).map(|k| a.get(k)));
            }
            slot.known = true;
            new(tick, false);
        }
        if !self.accepts(frame.tick) || self.head(frame.tick).is_some() {
            return;
        }
        let slot = self.slot(frame.tick);
        slot.grabs.clear();
        slot.grabs.extend(frame.grabs.iter().filter(|g| g.held));
        slot.accelerations.clear();
        if let Some(a) = &frame.accelerations {
            slot.accelerations.extend((0..modes).map(|k| a.get(k)));
        }
        slot.pose = frame.pose;
        slot.slice.clone_from(&frame.slice);
        slot.check = frame.check;
        slot.known = true;
        slot.head = true;
        new(frame.tick, true);
    }

    /// One grab at a tick: as it arrived, or between its neighbours, or going on from the last with a slope that shrinks
    /// by `keep` every tick. `None` when nothing near the tick knows the grab.
    pub fn grab(&self, key: GrabKey, tick: Tick, keep: f64) -> Option<FrameGrab> {
        let at = |t: Tick| self.known(t).and_then(|d| d.grabs.iter().find(|g| g.state.key == key)).copied();
        if self.known(tick).is_some() {
            return at(tick);
        }
        const NEAR: u64 = 40;
        let before = (1..NEAR).map_while(|b| tick.checked_sub(b)).find(|&t| self.known(t).is_some());
        let after =
            (1..NEAR).map(|b| tick + b).take_while(|&t| t <= self.highest).find(|&t| self.known(t).is_some());
        match (before.and_then(|t| at(t).map(|x| (t, x))), after.and_then(|t| at(t).map(|x| (t, x)))) {
            (Some((t0, x0)), Some((t1, x1))) => {
                let s = (tick - t0) as f64 / (t1 - t0) as f64;
                Some(between(&x0, &x1, s))
            }
            (None, Some((_, x1))) => Some(x1),
            (Some((t0, x0)), None) => {
                // A grab that a later frame no longer lists has ended somewhere in between.
                if after.is_some() {
                    return None;
                }
                let Some(x1) = t0.checked_sub(1).and_then(at) else { return Some(x0) };
                let ahead = (tick - t0).min(200) as u32;
                let (mut s, mut c) = (1.0, 0.0);
                let x2 = t0.checked_sub(2).and_then(at);
                // Velocity and acceleration of the hand, both fading, in ticks: x0 + s (x0 - x1) + c (x0 - 2 x1 + x2).
                let (mut ds, mut dc, mut keep_a) = (0.0, 0.0, 1.0);
                for n in 0..ahead {
                    let keep_v = keep.powi(n as i32 + 1);
                    ds += keep_v;
                    // The backward difference is the velocity half a tick ago; each tick adds what is left of the
                    // acceleration.
                    s += if n == 0 { 0.0 } else { keep_a };
                    dc += keep_v * (s - 0.5);
                    keep_a *= keep * keep * keep * keep;
                    c = dc;
                }
                let Some(x2) = x2 else { return Some(between(&x1, &x0, 1.0 + ds)) };
                Some(along(&x0, &x1, &x2, ds, c))
            }
            (None, None) => None,
        }
    }
}

/// `x0 + s (x0 - x1) + c (x0 - 2 x1 + x2)` of a grab's numbers.
fn along(x0: &FrameGrab, x1: &FrameGrab, x2: &FrameGrab, s: f64, c: f64) -> FrameGrab {
    let go = |a: [f64; 3], b: [f64; 3], d: [f64; 3]| {
        std::array::from_fn(|k| a[k] + s * (a[k] - b[k]) + c * (a[k] - 2.0 * b[k] + d[k]))
    };
    FrameGrab {
        state: GrabState {
            target: go(x0.state.target, x1.state.target, x2.state.target),
            reaction: go(x0.state.reaction, x1.state.reaction, x2.state.reaction),
            ..x0.state
        },
        displacement: go(x0.displacement, x1.displacement, x2.displacement),
        held: true,
    }
}

/// The grab on the line from `a` (0) through `b` (1).
fn between(a: &FrameGrab, b: &FrameGrab, s: f64) -> FrameGrab {
    let mix = |x: [f64; 3], y: [f64; 3]| std::array::from_fn(|k| x[k] + s * (y[k] - x[k]));
    FrameGrab {
        state: GrabState {
            target: mix(a.state.target, b.state.target),
            reaction: mix(a.state.reaction, b.state.reaction),
            ..b.state
        },
        displacement: mix(a.displacement, b.displacement),
        held: true,
    }
}
