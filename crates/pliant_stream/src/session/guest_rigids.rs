//! The rigid bodies of a session at a guest: shown between the states that have come, and beyond
//! them by their velocities.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use nalgebra::{UnitQuaternion, Vector3};

use crate::playout::PlayoutClock;
use crate::recovery::Playout;
use crate::state::{RigidId, RigidState, Tick};
use crate::wire::{MAX_RIGIDS, RigidPoses};

/// Largest number of states of one rigid body that are kept.
const KEPT: usize = 64;
/// Longest time for which a rigid body is led on by its velocities, s.
const LEAD: f64 = 0.25;
/// Time in which a correction of what was shown falls to a third, s.
const FADE: f64 = 0.08;
/// Ticks by which the picture is behind the schedule, as that of bodies, which a frame shows
/// between the last two ticks.
const BEHIND: f64 = 1.0;
/// A way that is longer than the velocities explain by more than this acceleration (m/s^2) is a
/// jump, and is shown as one.
const JUMP: f64 = 200.0;

/// A correction is shown at once where it is longer than this beyond the way of a second, m.
const SNAP: f64 = 1.0;

/// A state of the host.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Sample {
    tick: Tick,
    state: RigidState,
    resting: bool,
}

/// A rigid body as the guest shows it.
#[derive(Debug, Clone)]
pub struct StreamedRigid {
    id: RigidId,
    name: String,
    /// In the order of their ticks, at least one.
    samples: VecDeque<Sample>,
    /// The tick that is shown, and what is shown.
    at: f64,
    visual: RigidState,
    /// What is shown beside what the samples say, until the correction is over.
    offset: [Vector3<f64>; 2],
}

impl StreamedRigid {
    fn new(id: RigidId, name: &str, tick: Tick, state: RigidState) -> Self {
        let samples = VecDeque::from([Sample { tick, state, resting: false }]);
        let offset = [Vector3::zeros(); 2];
        Self { id, name: name.to_owned(), samples, at: f64::MIN, visual: state, offset }
    }

    /// Number of the rigid body in the session.
    pub fn id(&self) -> RigidId {
        self.id
    }

    /// Name of the rigid body, at most 64 bytes.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Where the rigid body is shown at the last [`GuestSession::update`], and how it moves, in the
    /// axes of the host's world. It is continuous, but where the host's jumps.
    ///
    /// [`GuestSession::update`]: super::GuestSession::update
    pub fn visual(&self) -> RigidState {
        self.visual
    }

    /// The tick that is shown, with its fraction.
    pub fn tick(&self) -> f64 {
        self.at
    }

    /// Returns whether the host has said that the rigid body rests, and it is shown so.
    pub fn is_resting(&self) -> bool {
        let newest = self.samples.back();
        newest.is_some_and(|s| s.resting && self.at >= s.tick as f64) && self.offset == [Vector3::zeros(); 2]
    }

    fn take(&mut self, sample: Sample) {
        let place = self.samples.partition_point(|s| s.tick < sample.tick);
        if let Some(known) = self.samples.get_mut(place).filter(|s| s.tick == sample.tick) {
            // That it rests there is said after where it is.
            if sample.resting {
                *known = sample;
            }
            return;
        }
        if place == 0 && !self.samples.is_empty() {
            // What is older than all that is kept is not shown any more.
            return;
        }
        self.samples.insert(place, sample);
        if self.samples.len() > KEPT {
            self.samples.pop_front();
        }
    }

    /// What the samples say of a tick, and whether there is a jump between the tick `from` and it.
    fn state_at(&self, tick: f64, from: f64, h: f64) -> (RigidState, bool) {
        let next = self.samples.partition_point(|s| s.tick as f64 <= tick);
        let jumped = |k: usize| {
            k > 0 && self.samples[k].tick as f64 > from && is_jump(&self.samples[k - 1], &self.samples[k], h)
        };
        let since = self.samples.partition_point(|s| s.tick as f64 <= from);
        let jumps = (since..next).any(jumped);
        let Some(a) = next.checked_sub(1).and_then(|k| self.samples.get(k)) else {
            // Nothing is known of before.
            return (self.samples.front().map_or(self.visual, |s| s.state), jumps);
        };
        let state = match self.samples.get(next) {
            Some(b) => between(a, b, tick, h),
            None if a.resting => a.state,
            None => led(&a.state, ((tick - a.tick as f64) * h).clamp(0.0, LEAD)),
        };
        (state, jumps)
    }

    fn advance(&mut self, tick: f64, h: f64) {
        let before = self.at;
        let (now, jumps) = self.state_at(tick, before, h);
        if before == f64::MIN || jumps {
            self.offset = [Vector3::zeros(); 2];
        } else {
            // What has come since tells that the last picture was wrong by so much. Where the
            // schedule goes back, as after a pause of the host, the picture goes on from there.
            let (was, _) = self.state_at(before.min(tick), before, h);
            let left = (-(tick - before).max(0.0) * h / FADE).exp();
            self.offset = difference(&self.visual, &was).map(|off| off * left);
            let [way, turn] = self.offset.map(|off| off.norm());
            let speed = Vector3::from(was.linear).norm();
            if way.max(turn) < 1e-6 || way > SNAP + speed {
                self.offset = [Vector3::zeros(); 2];
            }
        }
        self.at = tick;
        let visual = moved(&now, self.offset);
        if visual.is_valid() {
            self.visual = visual;
        }
        // One state before the picture is needed, and for corrections of it no more.
        while self.samples.get(1).is_some_and(|s| s.tick as f64 <= tick) {
            self.samples.pop_front();
        }
    }
}

/// Whether two states that follow each other are farther apart than their velocities explain.
fn is_jump(a: &Sample, b: &Sample, h: f64) -> bool {
    // What rests begins to move a tick before it has moved.
    let from = if a.resting { b.tick.saturating_sub(1).max(a.tick) } else { a.tick };
    let passed = b.tick.saturating_sub(from) as f64 * h;
    let way = (Vector3::from(b.state.position) - Vector3::from(a.state.position)).norm();
    let speed = |s: &Sample| Vector3::from(s.state.linear).norm();
    way > 2.0 * speed(a).max(speed(b)) * passed + JUMP * passed * passed
}

/// Position (m) and rotation (rad) that lead from one state to another.
fn difference(to: &RigidState, from: &RigidState) -> [Vector3<f64>; 2] {
    let way = Vector3::from(to.position) - Vector3::from(from.position);
    let turn = to
        .turn()
        .zip(from.turn())
        .map_or_else(Vector3::zeros, |(to, from)| (to * from.inverse()).scaled_axis());
    [way, turn]
}

/// A state that is moved and turned by an offset.
fn moved(state: &RigidState, [way, turn]: [Vector3<f64>; 2]) -> RigidState {
    let position = (Vector3::from(state.position) + way).into();
    let rotation =
        state.turn().map_or(state.rotation, |now| quaternion(UnitQuaternion::from_scaled_axis(turn) * now));
    RigidState { position, rotation, ..*state }
}

fn quaternion(turn: UnitQuaternion<f64>) -> [f64; 4] {
    let q = turn.quaternion();
    [q.i, q.j, q.k, q.w]
}

/// A state that goes on as it moves, after a time (s).
fn led(state: &RigidState, time: f64) -> RigidState {
    moved(state, [state.linear, state.angular].map(|speed| Vector3::from(speed) * time))
}

/// The state at a tick between two samples: the cubic through both places with both velocities,
/// limited so that it does not leave the space between them (Fritsch and Carlson 1980).
fn between(a: &Sample, b: &Sample, tick: f64, h: f64) -> RigidState {
    let passed = (b.tick - a.tick) as f64;
    // What rests stays where it is until the tick before the one in which it has moved. What jumps
    // does so at its tick.
    let start = if a.resting { (b.tick as f64 - 1.0).max(a.tick as f64) } else { a.tick as f64 };
    if tick <= start || is_jump(a, b, h) {
        return a.state;
    }
    let length = if a.resting { b.tick as f64 - start } else { passed };
    let s = ((tick - start) / length).clamp(0.0, 1.0);
    let time = length * h;
    let mut state = a.state;
    for k in 0..3 {
        let (from, way) = (a.state.position[k], b.state.position[k] - a.state.position[k]);
        let slope = |speed: f64| {
            let end = speed * time;
            if way == 0.0 || (end / way) <= 0.0 { 0.0 } else { way * (end / way).min(3.0) }
        };
        let [at, to] = [slope(a.state.linear[k]), slope(b.state.linear[k])];
        let (s2, s3) = (s * s, s * s * s);
        state.position[k] = from + (3.0 * s2 - 2.0 * s3) * way + (s3 - 2.0 * s2 + s) * at + (s3 - s2) * to;
        state.linear[k] += (b.state.linear[k] - a.state.linear[k]) * s;
        state.angular[k] += (b.state.angular[k] - a.state.angular[k]) * s;
    }
    if let Some((from, to)) = a.state.turn().zip(b.state.turn()) {
        // Two opposite rotations have no shortest way between them.
        state.rotation = quaternion(from.try_slerp(&to, s, 1e-9).unwrap_or(to));
    }
    state
}

/// All rigid bodies of a guest.
#[derive(Debug)]
pub(super) struct GuestRigids {
    h: f64,
    clock: PlayoutClock,
    newest: Tick,
    all: BTreeMap<RigidId, StreamedRigid>,
}

impl GuestRigids {
    pub(super) fn new(h: f64, playout: Playout) -> Self {
        Self { h, clock: PlayoutClock::new(h, playout), newest: 0, all: BTreeMap::new() }
    }

    pub(super) fn get(&self, rigid: RigidId) -> Option<&StreamedRigid> {
        self.all.get(&rigid)
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &StreamedRigid> {
        self.all.values()
    }

    /// Adds a rigid body. Returns false where the host breaks the protocol.
    pub(super) fn add(&mut self, rigid: RigidId, name: &str, tick: Tick, state: RigidState) -> bool {
        if self.all.len() >= MAX_RIGIDS || self.all.contains_key(&rigid) {
            return false;
        }
        self.all.insert(rigid, StreamedRigid::new(rigid, name, tick, state));
        true
    }

    pub(super) fn remove(&mut self, rigid: RigidId) -> bool {
        self.all.remove(&rigid).is_some()
    }

    pub(super) fn take(&mut self, now: Duration, poses: &RigidPoses) {
        let tick = poses.tick;
        if tick > self.newest {
            self.newest = tick;
            self.clock.arrived(now, tick);
        }
        for &(rigid, state) in &poses.poses {
            if let Some(entry) = self.all.get_mut(&rigid) {
                entry.take(Sample { tick, state, resting: false });
            }
        }
    }

    pub(super) fn rest(&mut self, tick: Tick, rigids: &[(u16, RigidState)]) {
        for &(rigid, state) in rigids {
            if let Some(entry) = self.all.get_mut(&RigidId(rigid)) {
                let still = RigidState { linear: [0.0; 3], angular: [0.0; 3], ..state };
                entry.take(Sample { tick, state: still, resting: true });
            }
        }
    }

    pub(super) fn advance(&mut self, now: Duration) {
        let scheduled = self.clock.tick_at(now).map(|tick| tick - BEHIND);
        for entry in self.all.values_mut() {
            // Before anything has moved there is no schedule, and all are where the host said.
            let newest = entry.samples.back().map_or(0.0, |s| s.tick as f64);
            entry.advance(scheduled.unwrap_or(newest), self.h);
        }
    }
}
