//! The visible state of one body in groups of frames.

use pliant_modal::ModalModel;

use super::MAX_GROUP_FRAMES;
use super::residual::{LEVEL_BITS, Past};
use super::surface::coordinate_steps;
use crate::StreamError;
use crate::state::{MAGNITUDE_LIMIT, MAX_MODES, RigidState, TICK_LIMIT, Tick, TickState, in_range};
use crate::wire::bits::{BitReader, BitWriter, LARGEST, WIDTH_BITS, whole, width};
use crate::wire::{Reader, Writer};

const SNAPSHOT: u8 = 1;
const RESTING: u8 = 2;
const POSE: u8 = 4;
/// Place of the number of ticks in the first byte of a frame that is no snapshot.
const TICKS_SHIFT: u32 = 2;
/// Position and quaternion.
const POSE_VALUES: usize = 7;

/// What watchers get of a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WatchConfig {
    /// Frames per second, rounded to a whole number of ticks. Default: 30.
    pub rate: f64,
    /// Largest number of modal coordinates, in the order of the model. Default: 30.
    pub modes: usize,
    /// Displacement of the surface by one step of a coordinate, as a share of the body's size. A
    /// coordinate is off by half a step at most. Default: 1e-4.
    pub resolution: f64,
    /// Length of a group, s. A watcher that joins sees the body within the last group, and a
    /// watcher that lost a group sees it again with the next. Default: 1.
    pub group: f64,
}

impl Default for WatchConfig {
    fn default() -> Self {
        Self { rate: 30.0, modes: 30, resolution: 1e-4, group: 1.0 }
    }
}

impl WatchConfig {
    /// Checks the ranges: a rate of 0.1 to 1000 Hz, 1 to [`MAX_MODES`] modes, a resolution of 1e-7
    /// to 0.1, groups of 0.1 to 10 s.
    ///
    /// # Errors
    /// [`StreamError::Config`] for a value outside its range.
    pub fn check(&self) -> Result<(), StreamError> {
        let check = |what, inside: bool, found: f64, expected| {
            let found = || found.to_string();
            if inside { Ok(()) } else { Err(StreamError::Config { what, found: found(), expected }) }
        };
        check("rate", (0.1..=1000.0).contains(&self.rate), self.rate, "0.1 to 1000 Hz")?;
        check("modes", (1..=MAX_MODES).contains(&self.modes), self.modes as f64, "1 to 4096")?;
        check("resolution", (1e-7..=0.1).contains(&self.resolution), self.resolution, "1e-7 to 0.1")?;
        check("group", (0.1..=10.0).contains(&self.group), self.group, "0.1 to 10 s")
    }

    /// Number of ticks from one frame to the next, for ticks of `step` seconds.
    pub fn every(&self, step: f64) -> u64 {
        let ticks = (1.0 / (self.rate * step)).round();
        // A float-to-int cast saturates and maps NaN to 0.
        (ticks as u64).clamp(1, u64::from(u16::MAX))
    }
}

/// A frame of a body's track.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EncodedFrame {
    /// The frame begins a group.
    pub begins_group: bool,
    /// The bytes.
    pub bytes: Vec<u8>,
}

/// Writes the frames of a body, in a closed loop: each frame is the difference to what the watcher
/// has, so rounding errors do not add up.
#[derive(Debug, Clone)]
pub struct BodyEncoder {
    /// The value in each coordinate of one meter of displacement.
    places: Vec<f32>,
    /// Displacement by one step, m.
    unit: f32,
    /// Largest distance of the surface from the body's origin, m.
    reach: f64,
    every: u64,
    group_ticks: u64,
    /// Steps of the current group: meters, and parts of a quaternion.
    steps: (f32, f32),
    past: Vec<Past>,
    scratch: Vec<i32>,
    group: Option<Group>,
    /// Whether the last frame says that the body rests.
    sent_rest: bool,
}

#[derive(Debug, Clone, Copy)]
struct Group {
    began: Tick,
    last: Tick,
    frames: usize,
}

impl BodyEncoder {
    /// An encoder for a body with ticks of `step` seconds.
    ///
    /// # Errors
    /// [`StreamError::Config`] for a configuration outside its ranges.
    pub fn new(model: &ModalModel, config: WatchConfig, step: f64) -> Result<Self, StreamError> {
        config.check()?;
        if !(1e-6..=10.0).contains(&step) {
            let found = step.to_string();
            return Err(StreamError::Config { what: "step", found, expected: "1e-6 to 10 s" });
        }
        let far = |p: &[f32; 3]| p.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt();
        Ok(Self {
            places: coordinate_steps(model, config.modes),
            unit: (config.resolution * model.size()).max(f64::from(f32::MIN_POSITIVE)) as f32,
            reach: model.surface().positions().iter().map(far).fold(1e-6, f64::max),
            every: config.every(step),
            group_ticks: ((config.group / step).round() as u64).max(1),
            steps: (0.0, 0.0),
            past: Vec::new(),
            scratch: Vec::new(),
            group: None,
            sent_rest: false,
        })
    }

    /// Number of coordinates that watchers get.
    pub fn modes(&self) -> usize {
        self.places.len()
    }

    /// Number of ticks from one frame to the next.
    pub fn every(&self) -> u64 {
        self.every
    }

    /// Begins a new group with the next frame.
    pub fn restart(&mut self) {
        self.group = None;
        self.sent_rest = false;
    }

    /// The frame of a tick. `None` for a tick without a frame: between two frames, and while the
    /// body sleeps. A state with a pose gives a frame with a pose, also that of an anchored body
    /// that is moved.
    ///
    /// # Errors
    /// [`StreamError::NotFinite`] for a state with a number that is not finite or beyond
    /// [`MAGNITUDE_LIMIT`]. [`StreamError::TickOrder`] for a tick that does not ascend.
    pub fn encode(&mut self, state: &TickState<'_>) -> Result<Option<EncodedFrame>, StreamError> {
        if let Some(group) = &self.group
            && state.tick <= group.last
        {
            return Err(StreamError::TickOrder { last: group.last, found: state.tick });
        }
        if !state.tick.is_multiple_of(self.every) || (state.resting && self.sent_rest) {
            return Ok(None);
        }
        let pose = state.pose;
        let shown = &state.q[..state.q.len().min(self.places.len())];
        if !in_range(shown) || pose.is_some_and(|pose| !pose.is_valid()) || state.tick >= TICK_LIMIT {
            return Err(StreamError::NotFinite { what: "watched state" });
        }
        self.sent_rest = state.resting;
        let count = self.places.len() + if pose.is_some() { POSE_VALUES } else { 0 };
        let goes_on = self.group.filter(|group| {
            state.tick - group.began < self.group_ticks
                && state.tick - group.last <= u64::from(u16::MAX)
                && group.frames < MAX_GROUP_FRAMES / 2
                && self.past.len() == count
        });
        if let Some(mut group) = goes_on
            && self.quantize(shown, pose)
        {
            let ticks = (state.tick - group.last) as u16;
            group.last = state.tick;
            group.frames += 1;
            self.group = Some(group);
            return Ok(Some(self.difference(ticks, state.resting)));
        }
        // The unit is coarser only as long as a value needs it.
        self.set_unit(self.unit);
        while !self.quantize(shown, pose) {
            self.set_unit(self.steps.0 * 2.0);
        }
        self.group = Some(Group { began: state.tick, last: state.tick, frames: 1 });
        Ok(Some(self.snapshot(state.tick, state.resting, pose.is_some())))
    }

    fn set_unit(&mut self, unit: f32) {
        if self.steps.0 != unit {
            // A rotation needs no coarser steps, however far the body is.
            let turn = (f64::from(self.unit) / (4.0 * self.reach)).clamp(1e-8, 0.01);
            self.steps = (unit, turn as f32);
            // The values before had other steps.
            self.past.clear();
        }
    }

    /// Rounds a state to steps. Returns false when a value has too many of them.
    fn quantize(&mut self, q: &[f64], pose: Option<RigidState>) -> bool {
        let (unit, turn) = (f64::from(self.steps.0), f64::from(self.steps.1));
        self.scratch.clear();
        let mut fits = true;
        let mut put = |x: f64, into: &mut Vec<i32>| {
            fits &= x.abs() < f64::from(LARGEST);
            into.push(whole(x));
        };
        for (k, place) in self.places.iter().enumerate() {
            let q = q.get(k).copied().unwrap_or(0.0);
            put(q / (unit * f64::from(*place)), &mut self.scratch);
        }
        if let Some(pose) = pose {
            let norm = pose.rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
            // Of the two quaternions of a rotation the one nearer to the last.
            let modes = self.places.len();
            let last = self.past.get(modes + 3..).unwrap_or_default();
            let along: f64 = last.iter().zip(pose.rotation).map(|(p, x)| f64::from(p.value()) * x).sum();
            let sign = if along < 0.0 { -1.0 } else { 1.0 };
            pose.position.iter().for_each(|x| put(x / unit, &mut self.scratch));
            pose.rotation.iter().for_each(|x| put(sign * x / (norm * turn), &mut self.scratch));
        }
        fits
    }

    fn snapshot(&mut self, tick: Tick, resting: bool, pose: bool) -> EncodedFrame {
        let mut w = Writer::with_capacity(32 + 4 * self.scratch.len());
        w.u8(SNAPSHOT | if resting { RESTING } else { 0 } | if pose { POSE } else { 0 });
        w.tick(tick);
        w.f32(self.steps.0);
        if pose {
            w.f32(self.steps.1);
        }
        w.u16(self.places.len() as u16);
        let known = self.past.len() == self.scratch.len();
        let mut bits = BitWriter::new(&mut w);
        let mut past = Vec::with_capacity(self.scratch.len());
        for (k, &value) in self.scratch.iter().enumerate() {
            let before = self.past.get(k).filter(|_| known);
            let level = before.map_or(0, Past::level);
            let step = before.map_or(0, |past| i64::from(value) - i64::from(past.value()));
            let step = step.clamp(-i64::from(LARGEST), i64::from(LARGEST)) as i32;
            let (wide, wide_step) = (width(value), width(step));
            bits.put(level, LEVEL_BITS);
            bits.put(wide, WIDTH_BITS);
            bits.put(wide_step, WIDTH_BITS);
            bits.put(value as u32, wide);
            bits.put(step as u32, wide_step);
            past.push(started(value, step, level));
        }
        bits.finish();
        self.past = past;
        EncodedFrame { begins_group: true, bytes: w.into_bytes() }
    }

    fn difference(&mut self, ticks: u16, resting: bool) -> EncodedFrame {
        let mut w = Writer::with_capacity(8 + 2 * self.scratch.len());
        write_head(&mut w, ticks, resting);
        let mut bits = BitWriter::new(&mut w);
        for (past, value) in self.past.iter_mut().zip(&self.scratch) {
            past.write(&mut bits, *value);
        }
        bits.finish();
        EncodedFrame { begins_group: false, bytes: w.into_bytes() }
    }
}

fn write_head(w: &mut Writer, ticks: u16, resting: bool) {
    let rest = if resting { RESTING } else { 0 };
    match u8::try_from(ticks) {
        Ok(few @ 1..64) => w.u8(rest | few << TICKS_SHIFT),
        _ => {
            w.u8(rest);
            w.u16(ticks);
        }
    }
}

fn started(value: i32, step: i32, level: u32) -> Past {
    let most = i64::from(LARGEST);
    let before = (i64::from(value) - i64::from(step)).clamp(-most, most) as i32;
    Past::start(value, before, level)
}

/// What a watcher sees of a body at a tick.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct WatchedState {
    /// The host's tick.
    pub tick: Tick,
    /// Modal coordinates, kg^1/2 m. Those of the model's further modes are 0.
    pub q: Vec<f64>,
    /// Pose of a free body, and of an anchored one that is moved, in meters of the body. Its speeds
    /// are 0, since watchers get none.
    pub pose: Option<RigidState>,
    /// The body sleeps: it stays as it is until the next frame.
    pub resting: bool,
}

/// Header of a frame, as [`BodyDecoder::decode`] found it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WatchFrame {
    /// The frame begins a group.
    Snapshot,
    /// The frame leans on the one before.
    Difference,
}

/// Reads the frames of a body. A frame that is wrong ends its group: the decoder then waits for a
/// snapshot.
#[derive(Debug, Clone)]
pub struct BodyDecoder {
    places: Vec<f32>,
    steps: (f64, f64),
    modes: usize,
    past: Vec<Past>,
    frames: usize,
    state: WatchedState,
}

impl BodyDecoder {
    /// A decoder for a body. `places` are the value in each coordinate of one meter of displacement
    /// ([`coordinate_steps`], [`WatchSurface::places`](super::WatchSurface::places)).
    pub fn new(places: Vec<f32>) -> Self {
        Self {
            places,
            steps: (0.0, 0.0),
            modes: 0,
            past: Vec::new(),
            frames: 0,
            state: WatchedState::default(),
        }
    }

    /// The state of the last frame. `None` before the first snapshot and after a wrong frame.
    pub fn state(&self) -> Option<&WatchedState> {
        (self.frames > 0).then_some(&self.state)
    }

    /// Reads the next frame of the group.
    ///
    /// # Errors
    /// [`StreamError::Truncated`], [`StreamError::Invalid`] or [`StreamError::NotFinite`] for wrong
    /// bytes. [`StreamError::State`] for a frame without its snapshot. [`StreamError::Full`] for a
    /// group that does not end.
    pub fn decode(&mut self, frame: &[u8]) -> Result<(WatchFrame, &WatchedState), StreamError> {
        match self.read(frame) {
            Ok(kind) => Ok((kind, &self.state)),
            Err(error) => {
                (self.frames, self.modes) = (0, 0);
                self.past.clear();
                Err(error)
            }
        }
    }

    fn read(&mut self, frame: &[u8]) -> Result<WatchFrame, StreamError> {
        let mut r = Reader::new(frame);
        let head = r.u8("watched frame")?;
        let kind = if head & SNAPSHOT != 0 {
            self.read_snapshot(head, &mut r)?;
            WatchFrame::Snapshot
        } else {
            self.read_difference(head, &mut r)?;
            WatchFrame::Difference
        };
        r.finish("watched frame")?;
        self.write_state()?;
        self.state.resting = head & RESTING != 0;
        Ok(kind)
    }

    fn read_snapshot(&mut self, head: u8, r: &mut Reader<'_>) -> Result<(), StreamError> {
        if head & !(SNAPSHOT | RESTING | POSE) != 0 {
            let found = format!("{head:#x}");
            return Err(StreamError::Invalid { what: "watched frame", found, expected: "known flags" });
        }
        let tick = r.tick("watched tick")?;
        let unit = positive("watched unit", r.f32("watched unit")?)?;
        let turn = if head & POSE != 0 { positive("watched turn", r.f32("watched turn")?)? } else { 0.0 };
        let modes = usize::from(r.u16("watched modes")?);
        if modes > self.places.len() {
            return Err(StreamError::Length {
                what: "watched modes",
                found: modes,
                expected: self.places.len(),
            });
        }
        let count = modes + if head & POSE != 0 { POSE_VALUES } else { 0 };
        self.past.clear();
        let mut bits = BitReader::new(r);
        for _ in 0..count {
            let level = bits.take("watched level", LEVEL_BITS)?;
            let wide = bits.take("watched width", WIDTH_BITS)?;
            let wide_step = bits.take("watched width", WIDTH_BITS)?;
            let value = bits.signed("watched value", wide)?;
            let step = bits.signed("watched value", wide_step)?;
            if value.abs() > LARGEST || step.abs() > LARGEST {
                return Err(StreamError::Invalid {
                    what: "watched value",
                    found: value.to_string(),
                    expected: "below 2^30 in magnitude",
                });
            }
            self.past.push(started(value, step, level));
        }
        bits.finish("watched padding")?;
        (self.steps, self.modes, self.frames, self.state.tick) = ((unit, turn), modes, 1, tick);
        Ok(())
    }

    fn read_difference(&mut self, head: u8, r: &mut Reader<'_>) -> Result<(), StreamError> {
        if self.frames == 0 {
            return Err(StreamError::State {
                what: "a watched frame",
                state: "without its snapshot",
                needed: "the beginning of the group",
            });
        }
        if self.frames >= MAX_GROUP_FRAMES {
            return Err(StreamError::Full { what: "a watched group", limit: MAX_GROUP_FRAMES });
        }
        let ticks = match head >> TICKS_SHIFT {
            0 => u64::from(r.u16("watched ticks")?),
            few => u64::from(few),
        };
        let tick = self.state.tick + ticks;
        if ticks == 0 || tick >= TICK_LIMIT {
            let found = tick.to_string();
            return Err(StreamError::Invalid { what: "watched tick", found, expected: "ascending ticks" });
        }
        let mut bits = BitReader::new(r);
        for past in &mut self.past {
            past.read(&mut bits)?;
        }
        bits.finish("watched padding")?;
        self.frames += 1;
        self.state.tick = tick;
        Ok(())
    }

    fn write_state(&mut self) -> Result<(), StreamError> {
        let (unit, turn) = self.steps;
        self.state.q.clear();
        let q = self.past[..self.modes].iter().zip(&self.places);
        self.state.q.extend(q.map(|(past, place)| f64::from(past.value()) * unit * f64::from(*place)));
        self.state.pose = if let [x, y, z, a, b, c, d] = self.past[self.modes..] {
            let pose = RigidState {
                position: [x, y, z].map(|past| f64::from(past.value()) * unit),
                rotation: unit_quaternion([a, b, c, d].map(|past| f64::from(past.value()) * turn))?,
                ..RigidState::default()
            };
            pose.is_valid().then_some(pose)
        } else {
            None
        };
        let lost_pose = self.past.len() > self.modes && self.state.pose.is_none();
        if !in_range(&self.state.q) || lost_pose {
            let found = "a value out of range".to_owned();
            return Err(StreamError::Invalid { what: "watched state", found, expected: "at most 1e9" });
        }
        Ok(())
    }
}

fn unit_quaternion(x: [f64; 4]) -> Result<[f64; 4], StreamError> {
    let norm = x.iter().map(|x| x * x).sum::<f64>().sqrt();
    if (0.5..2.0).contains(&norm) {
        Ok(x.map(|x| x / norm))
    } else {
        let found = format!("a length of {norm}");
        Err(StreamError::Invalid { what: "watched rotation", found, expected: "a length of 1" })
    }
}

fn positive(what: &'static str, x: f64) -> Result<f64, StreamError> {
    if x > 0.0 && x <= MAGNITUDE_LIMIT {
        Ok(x)
    } else {
        Err(StreamError::Invalid { what, found: x.to_string(), expected: "above 0" })
    }
}
