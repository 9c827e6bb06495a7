//! The received data per tick, in a ring of fixed length.

use crate::codec::quantization::Quanta;
use crate::prediction::Ring;
use crate::state::{GrabKey, GrabState, MAX_GRABS, RigidState, Tick};
use crate::wire::{FrameGrab, SliceEntry, TickFrame};

use nalgebra::{UnitQuaternion, Vector3};

use super::forecast::{CHANNELS, Forecast};

/// Number of ticks that a receiver remembers. Older data is ignored.
pub const HISTORY: usize = 256;

/// Largest distance in ticks at which a lookup searches for known ticks.
const NEAR: u64 = 40;
/// Longest time for which a rigid pose without data keeps its acceleration, s.
const FALL: f64 = 0.4;

/// The received data of one tick.
#[derive(Debug, Clone, Default)]
pub struct TickData {
    /// True when the data that drives the state (accelerations or reactions) has arrived.
    pub known: bool,
    /// True when the frame of this tick itself has arrived, not only a repeat.
    pub head: bool,
    /// Modal accelerations. Empty if the stream carries none.
    pub accelerations: Vec<f64>,
    /// The grabs that were held, with their reactions and the displacements of their patches.
    pub grabs: Vec<FrameGrab>,
    /// Rigid pose of a free body.
    pub pose: Option<RigidState>,
    /// Part of the absolute state.
    pub slice: Vec<SliceEntry>,
    /// Checksum of the state.
    pub check: Option<f32>,
    /// The grabs from the parts of this tick's frame that have arrived, and a bit mask of those
    /// parts.
    pending: Vec<FrameGrab>,
    parts: u32,
}

/// The received data of the last [`HISTORY`] ticks.
#[derive(Debug, Clone)]
pub struct History {
    slots: Ring<TickData>,
    highest: Tick,
    /// The rigid pose of the last snapshot.
    snapshot: Option<(Tick, RigidState)>,
}

impl History {
    /// Creates an empty history. `tick` is the tick before the first tick of interest.
    pub fn new(tick: Tick) -> Self {
        Self { slots: Ring::new(HISTORY), highest: tick, snapshot: None }
    }

    /// The newest tick for which data has arrived.
    pub fn highest(&self) -> Tick {
        self.highest
    }

    /// The data of `tick`, if the part that drives the state has arrived.
    pub fn known(&self, tick: Tick) -> Option<&TickData> {
        self.slots.get(tick).filter(|slot| slot.known)
    }

    /// The data of `tick`, if the frame itself has arrived.
    pub fn head(&self, tick: Tick) -> Option<&TickData> {
        self.known(tick).filter(|d| d.head)
    }

    /// The newest known tick at or before `tick` and after `tick - HISTORY`.
    pub fn last_known(&self, tick: Tick) -> Option<&TickData> {
        (0..HISTORY as u64).map_while(|back| tick.checked_sub(back)).find_map(|t| self.known(t))
    }

    /// Stores the rigid pose of a snapshot.
    pub fn take_pose(&mut self, tick: Tick, pose: Option<RigidState>) {
        self.snapshot = pose.map(|pose| (tick, pose)).or(self.snapshot);
    }

    /// The rigid pose at `tick`, if it was received.
    pub fn received_pose(&self, tick: Tick) -> Option<RigidState> {
        let in_snapshot = || self.snapshot.filter(|(at, _)| *at == tick).map(|(_, pose)| pose);
        self.known(tick).and_then(|d| d.pose).or_else(in_snapshot)
    }

    /// The rigid pose at `tick`, with `h` seconds per tick: received, interpolated between
    /// neighbors, or extrapolated from the last poses. Returns `None` when no recent pose is known.
    pub fn pose(&self, tick: Tick, h: f64) -> Option<RigidState> {
        let at = |t: Tick| self.received_pose(t);
        if let Some(pose) = at(tick) {
            return Some(pose);
        }
        let mut back = (1..HISTORY as u64).map_while(|b| tick.checked_sub(b));
        let (before, pose) = back.find_map(|t| at(t).map(|p| (t, p)))?;
        let after = (1..NEAR).map(|b| tick + b).take_while(|&t| t <= self.highest);
        if let Some((t, next)) = after.filter_map(|t| at(t).map(|p| (t, p))).next() {
            let [passed, all] = [tick, t].map(|t| (t - before) as f64);
            return Some(between(&pose, &next, passed / all, all * h));
        }
        // A body in free fall keeps its acceleration, so the extrapolation continues the last
        // change of velocity for a while.
        let faster = before
            .checked_sub(1)
            .and_then(at)
            .map_or([0.0; 3], |last| std::array::from_fn(|k| (pose.linear[k] - last.linear[k]) / h));
        Some(go_on(&pose, faster, (tick - before) as f64 * h))
    }

    fn slot(&mut self, tick: Tick) -> &mut TickData {
        let (slot, other) = self.slots.place(tick);
        if other {
            slot.known = false;
            slot.head = false;
            slot.accelerations.clear();
            slot.grabs.clear();
            slot.pose = None;
            slot.slice.clear();
            slot.check = None;
            slot.pending.clear();
            slot.parts = 0;
        }
        slot
    }

    fn accepts(&self, tick: Tick) -> bool {
        tick > 0 && tick + (HISTORY as u64) > self.highest
    }

    /// Stores a frame and its repeats. Calls `new(tick, true)` for each tick that was not known
    /// before, and `new(tick, false)` for a frame that completes a tick known from a repeat.
    pub fn take(&mut self, frame: &TickFrame, quanta: &Quanta, mut new: impl FnMut(Tick, bool)) {
        let modes = quanta.modes();
        self.highest = self.highest.max(frame.tick);
        for repeat in &frame.repeats {
            let Some(tick) = frame.tick.checked_sub(u64::from(repeat.back)) else { continue };
            if !self.accepts(tick) || self.known(tick).is_some() {
                continue;
            }
            let slot = self.slot(tick);
            slot.grabs.clear();
            slot.grabs.extend(repeat.grabs.iter().filter_map(|r| {
                let grab = frame.grabs.get(usize::from(r.index))?;
                let state = GrabState { reaction: r.reaction, ..grab.state };
                Some(FrameGrab { state, displacement: r.displacement, held: true })
            }));
            slot.grabs.truncate(MAX_GRABS);
            if let Some(a) = &repeat.accelerations {
                slot.accelerations.extend((0..modes).map(|k| a.get(k, quanta)));
            }
            slot.known = true;
            new(tick, true);
        }
        if !self.accepts(frame.tick) || self.head(frame.tick).is_some() {
            return;
        }
        let first = self.known(frame.tick).is_none();
        let slot = self.slot(frame.tick);
        let (which, of) = frame.part.unwrap_or((0, 1));
        if slot.parts >> which & 1 == 1 {
            return;
        }
        slot.parts |= 1 << which;
        slot.pending.extend(frame.grabs.iter().filter(|g| g.held));
        if which == 0 {
            // The first part carries everything except the remaining grabs.
            if let Some(a) = &frame.accelerations {
                slot.accelerations.clear();
                slot.accelerations.extend((0..modes).map(|k| a.get(k, quanta)));
            }
            slot.pose = frame.pose;
            slot.slice.clear();
            slot.slice.extend(frame.slice.iter().flat_map(|s| s.entries(quanta)));
            slot.check = frame.check;
        }
        if slot.parts.count_ones() < u32::from(of) {
            return;
        }
        slot.pending.truncate(MAX_GRABS);
        std::mem::swap(&mut slot.grabs, &mut slot.pending);
        slot.pending.clear();
        slot.known = true;
        slot.head = true;
        new(frame.tick, first);
    }

    /// The largest second difference of a grab's received reactions, N, in the `window` ticks
    /// before `tick`. Zero if no three ticks in a row are known.
    pub(crate) fn second_difference(&self, key: GrabKey, tick: Tick, window: u64) -> f64 {
        let at = |back: u64| {
            let data = self.known(tick.checked_sub(back)?)?;
            let grab = data.grabs.iter().find(|g| g.state.key == key)?;
            Some(Vector3::from(grab.state.reaction))
        };
        let (mut last, mut largest) = ([None::<Vector3<f64>>; 2], 0.0f64);
        for back in 0..window {
            let now = at(back);
            if let (Some(a), Some(b), Some(c)) = (last[0], last[1], now) {
                largest = largest.max((a - 2.0 * b + c).norm_squared());
            }
            last = [last[1], now];
        }
        largest.sqrt()
    }

    /// One grab at `tick`: received, interpolated between neighbors, or extrapolated by `forecast`.
    /// Returns `None` when no known tick nearby lists the grab.
    pub fn grab(&self, key: GrabKey, tick: Tick, forecast: &Forecast) -> Option<FrameGrab> {
        let at = |t: Tick| self.known(t).and_then(|d| d.grabs.iter().find(|g| g.state.key == key)).copied();
        if self.known(tick).is_some() {
            return at(tick);
        }
        let before = (1..NEAR).map_while(|b| tick.checked_sub(b)).find(|&t| self.known(t).is_some());
        let after =
            (1..NEAR).map(|b| tick + b).take_while(|&t| t <= self.highest).find(|&t| self.known(t).is_some());
        match (before.and_then(|t| at(t).map(|x| (t, x))), after.and_then(|t| at(t).map(|x| (t, x)))) {
            (Some((t0, x0)), Some((t1, x1))) => {
                let s = (tick - t0) as f64 / (t1 - t0) as f64;
                let (a, b) = (channels(&x0), channels(&x1));
                Some(with_channels(&x1, std::array::from_fn(|k| a[k] + s * (b[k] - a[k]))))
            }
            (None, Some((_, x1))) => Some(x1),
            (Some((t0, x0)), None) => {
                // A grab that a later frame does not list has ended in between.
                if after.is_some() {
                    return None;
                }
                let samples: Vec<_> = (0..forecast.window())
                    .map_while(|back| t0.checked_sub(back).map(|t| (back, t)))
                    .filter_map(|(back, t)| at(t).map(|g| (back, channels(&g))))
                    .collect();
                let ahead = forecast.go_on(&samples, tick - t0)?;
                Some(with_channels(&x0, ahead))
            }
            (None, None) => None,
        }
    }
}

/// Extrapolates a pose by `seconds` with its own twist. The pose keeps the acceleration `faster`
/// (m/s^2) for at most `FALL` seconds.
fn go_on(pose: &RigidState, faster: [f64; 3], seconds: f64) -> RigidState {
    let Some(turn) = pose.turn() else { return *pose };
    let turned = UnitQuaternion::from_scaled_axis(Vector3::from(pose.angular) * seconds) * turn;
    let (gaining, after) = (seconds.min(FALL), (seconds - FALL).max(0.0));
    RigidState {
        position: std::array::from_fn(|k| {
            let gained = faster[k] * gaining;
            pose.position[k] + pose.linear[k] * seconds + gained * (0.5 * gaining + after)
        }),
        rotation: [turned.i, turned.j, turned.k, turned.w],
        linear: std::array::from_fn(|k| pose.linear[k] + faster[k] * gaining),
        angular: pose.angular,
    }
}

/// Interpolates between two poses that are `seconds` apart. `share` 0 gives `a` and 1 gives `b`.
///
/// The position follows the cubic that has the places and velocities of both (Hermite's). On a
/// straight line, a point of a spinning body would be off by millimeters.
fn between(a: &RigidState, b: &RigidState, share: f64, seconds: f64) -> RigidState {
    let (Some(from), Some(to)) = (a.turn(), b.turn()) else { return *a };
    let way = (to * from.inverse()).scaled_axis() * share;
    let turn = UnitQuaternion::from_scaled_axis(way) * from;
    let mix = |a: [f64; 3], b: [f64; 3]| std::array::from_fn(|k| a[k] + share * (b[k] - a[k]));
    let (s, rest) = (share, 1.0 - share);
    let position = std::array::from_fn(|k| {
        let places = (1.0 + 2.0 * s) * rest * rest * a.position[k] + (3.0 - 2.0 * s) * s * s * b.position[k];
        places + s * rest * seconds * (rest * a.linear[k] - s * b.linear[k])
    });
    RigidState {
        position,
        rotation: [turn.i, turn.j, turn.k, turn.w],
        linear: mix(a.linear, b.linear),
        angular: mix(a.angular, b.angular),
    }
}

fn channels(g: &FrameGrab) -> [f64; CHANNELS] {
    let [a, b, c] = g.state.target;
    let [d, e, f] = g.state.reaction;
    let [x, y, z] = g.displacement;
    [a, b, c, d, e, f, x, y, z]
}

fn with_channels(g: &FrameGrab, [a, b, c, d, e, f, x, y, z]: [f64; CHANNELS]) -> FrameGrab {
    let state = GrabState { target: [a, b, c], reaction: [d, e, f], ..g.state };
    FrameGrab { state, displacement: [x, y, z], held: true }
}
