//! A frame: one tick of one body. Intra-coded: it is read without any other.

use serde::{Deserialize, Serialize};

use super::{Reader, Writer};
use crate::StreamError;
use crate::state::{BodyId, GrabKey, GrabState, MAX_GRABS, MAX_MODES, Pose, Tick, UserId};

const POSE: u8 = 1;
const ACCELERATIONS: u8 = 2;
const SLICE: u8 = 4;
const RESTING: u8 = 8;
const CHECK: u8 = 16;
const RESENT: u8 = 32;
const DISPLACEMENTS: u8 = 64;
const KNOWN_FLAGS: u8 = 127;

/// Bytes of one grab in a frame.
const GRAB_BYTES: usize = 34;
/// Most repeats in one frame.
pub(crate) const MAX_REPEATS: usize = 7;

/// How modal accelerations are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub enum AccelerationCoding {
    /// 16-bit steps of one scale per frame, in a closed loop: 2 bytes a mode. The default.
    Scaled16,
    /// 4 bytes a mode.
    F32,
    /// 8 bytes a mode: no rounding, for measurements.
    F64,
}

impl AccelerationCoding {
    /// Bytes that one mode takes.
    pub fn bytes_per_mode(self) -> usize {
        match self {
            Self::Scaled16 => 2,
            Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

/// Modal accelerations as they cross.
#[derive(Debug, Clone, PartialEq)]
pub enum Accelerations {
    /// Value = scale x step.
    Scaled16 {
        /// Size of a step.
        scale: f32,
        /// Whole steps, one a mode.
        steps: Vec<i16>,
    },
    /// Plain.
    F32(Vec<f32>),
    /// Plain.
    F64(Vec<f64>),
}

impl Accelerations {
    /// Rounds values to what a coding can carry.
    pub fn quantise(coding: AccelerationCoding, values: &[f64]) -> Self {
        match coding {
            AccelerationCoding::Scaled16 => {
                let largest = values.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
                let scale = step_size(largest);
                Self::Scaled16 { scale, steps: values.iter().map(|&x| to_step(x, scale)).collect() }
            }
            AccelerationCoding::F32 => Self::F32(values.iter().map(|&x| x as f32).collect()),
            AccelerationCoding::F64 => Self::F64(values.to_vec()),
        }
    }

    /// Number of modes.
    pub fn modes(&self) -> usize {
        match self {
            Self::Scaled16 { steps, .. } => steps.len(),
            Self::F32(x) => x.len(),
            Self::F64(x) => x.len(),
        }
    }

    /// The value of one mode; zero beyond the last.
    pub fn get(&self, mode: usize) -> f64 {
        match self {
            Self::Scaled16 { scale, steps } => {
                f64::from(*scale) * f64::from(steps.get(mode).copied().unwrap_or(0))
            }
            Self::F32(x) => f64::from(x.get(mode).copied().unwrap_or(0.0)),
            Self::F64(x) => x.get(mode).copied().unwrap_or(0.0),
        }
    }

    fn encode(&self, w: &mut Writer) {
        match self {
            Self::Scaled16 { scale, steps } => {
                w.u8(0);
                w.u16(steps.len() as u16);
                w.f32(*scale);
                steps.iter().for_each(|&x| w.i16(x));
            }
            Self::F32(x) => {
                w.u8(1);
                w.u16(x.len() as u16);
                x.iter().for_each(|&x| w.f32(x));
            }
            Self::F64(x) => {
                w.u8(2);
                w.u16(x.len() as u16);
                x.iter().for_each(|&x| w.f64(x));
            }
        }
    }

    fn bytes(&self) -> usize {
        match self {
            Self::Scaled16 { steps, .. } => 7 + 2 * steps.len(),
            Self::F32(x) => 3 + 4 * x.len(),
            Self::F64(x) => 3 + 8 * x.len(),
        }
    }

    fn decode(r: &mut Reader<'_>) -> Result<Self, StreamError> {
        let coding = r.u8("acceleration coding")?;
        let count = usize::from(r.u16("acceleration count")?);
        if count > MAX_MODES {
            return Err(StreamError::Invalid {
                what: "acceleration count",
                found: count.to_string(),
                expected: "at most 4096",
            });
        }
        let fits = |size: usize| {
            if count * size <= r.left() {
                Ok(count)
            } else {
                let (needed, left) = (count * size, r.left());
                Err(StreamError::Truncated { what: "accelerations", offset: 0, needed, left })
            }
        };
        match coding {
            0 => {
                let mut steps = Vec::with_capacity(fits(2)?);
                let scale = r.wide32("acceleration scale")?;
                for _ in 0..count {
                    steps.push(r.i16("acceleration")?);
                }
                Ok(Self::Scaled16 { scale, steps })
            }
            1 => {
                let mut x = Vec::with_capacity(fits(4)?);
                for _ in 0..count {
                    x.push(r.wide32("acceleration")?);
                }
                Ok(Self::F32(x))
            }
            2 => {
                let mut x = Vec::with_capacity(fits(8)?);
                for _ in 0..count {
                    x.push(r.wide("acceleration")?);
                }
                Ok(Self::F64(x))
            }
            other => Err(StreamError::Invalid {
                what: "acceleration coding",
                found: other.to_string(),
                expected: "0..=2",
            }),
        }
    }
}

/// The step whose 32,767-fold is `largest`; never too small to represent it.
fn step_size(largest: f64) -> f32 {
    let scale = (largest / 32_767.0) as f32;
    // Rounding to f32 may go down; the outermost step then clamps and the closed loop repays it at the next tick.
    if scale.is_finite() { scale } else { 0.0 }
}

fn to_step(x: f64, scale: f32) -> i16 {
    if scale == 0.0 {
        return 0;
    }
    // A float-to-int cast saturates and takes NaN to 0.
    (x / f64::from(scale)).round() as i16
}

/// One mode of a slice.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SliceEntry {
    /// Which mode.
    pub mode: usize,
    /// Modal coordinate after the frame's tick.
    pub q: f64,
    /// Velocity after the frame's tick.
    pub v: f64,
    /// Modal force that the streamed reactions do not explain.
    pub load: f64,
}

/// The absolute part of a frame: the state of some modes after the frame's tick.
#[derive(Debug, Clone, PartialEq)]
pub struct Slice {
    /// Sizes of a step of q, v and load; a load of size 0 does not cross.
    pub scales: [f32; 3],
    /// Mode, and whole steps of q, v and load; at most 255.
    pub steps: Vec<(u16, [i16; 3])>,
}

impl Slice {
    /// Rounds a state to what a slice can carry: mode and (q, v, load), at most 255.
    pub fn quantise(values: &[(u16, [f64; 3])]) -> Self {
        let values = &values[..values.len().min(255)];
        let mut scales = [0.0_f32; 3];
        for (k, scale) in scales.iter_mut().enumerate() {
            *scale = step_size(values.iter().fold(0.0_f64, |m, x| m.max(x.1[k].abs())));
        }
        let steps = |x: &[f64; 3]| std::array::from_fn(|k| to_step(x[k], scales[k]));
        Self { steps: values.iter().map(|(mode, x)| (*mode, steps(x))).collect(), scales }
    }

    /// What the receiver reads, mode by mode.
    pub fn entries(&self) -> impl Iterator<Item = SliceEntry> + '_ {
        let value = |k: usize, steps: &[i16; 3]| f64::from(self.scales[k]) * f64::from(steps[k]);
        self.steps.iter().map(move |(mode, s)| SliceEntry {
            mode: usize::from(*mode),
            q: value(0, s),
            v: value(1, s),
            load: value(2, s),
        })
    }

    fn has_load(&self) -> bool {
        self.scales[2] != 0.0
    }

    /// Bytes that a slice of so many modes takes.
    pub(crate) fn bytes_of(modes: usize, load: bool) -> usize {
        if load { 14 + 8 * modes } else { 10 + 6 * modes }
    }

    fn encode(&self, w: &mut Writer) {
        w.u8(self.steps.len() as u8);
        w.u8(u8::from(self.has_load()));
        let parts = if self.has_load() { 3 } else { 2 };
        self.scales[..parts].iter().for_each(|&x| w.f32(x));
        for (mode, s) in &self.steps {
            w.u16(*mode);
            s[..parts].iter().for_each(|&x| w.i16(x));
        }
    }

    fn decode(r: &mut Reader<'_>) -> Result<Self, StreamError> {
        let count = usize::from(r.u8("slice count")?);
        let parts = match r.u8("slice parts")? {
            0 => 2,
            1 => 3,
            other => {
                return Err(StreamError::Invalid {
                    what: "slice parts",
                    found: other.to_string(),
                    expected: "0 or 1",
                });
            }
        };
        let mut scales = [0.0; 3];
        for scale in &mut scales[..parts] {
            *scale = r.wide32("slice scale")?;
        }
        let mut steps = Vec::with_capacity(count.min(r.left() / (2 + 2 * parts)));
        for _ in 0..count {
            let mode = r.u16("slice mode")?;
            if usize::from(mode) >= MAX_MODES {
                return Err(StreamError::Invalid {
                    what: "slice mode",
                    found: mode.to_string(),
                    expected: "below 4096",
                });
            }
            let mut s = [0; 3];
            for x in &mut s[..parts] {
                *x = r.i16("slice step")?;
            }
            steps.push((mode, s));
        }
        Ok(Self { scales, steps })
    }
}

/// A grab as a frame carries it. Reactions cross rounded to 16 bits of mantissa, targets and radius as `f32`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameGrab {
    /// The grab.
    pub state: GrabState,
    /// Where the patch is, as displacement from rest in body axes, m; zero in acceleration streams, which do not carry it.
    pub displacement: [f64; 3],
    /// Held at the frame's tick. Grabs that ended within the repeated ticks are listed too, with `false`.
    pub held: bool,
}

/// A grab at a repeated tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RepeatGrab {
    /// Index into the frame's grabs.
    pub index: u8,
    /// Its reaction then, N.
    pub reaction: [f64; 3],
    /// Where its patch was then, as in [`FrameGrab`].
    pub displacement: [f64; 3],
}

/// An earlier tick said again.
#[derive(Debug, Clone, PartialEq)]
pub struct Repeat {
    /// How many ticks before the frame's, 1..=255.
    pub back: u8,
    /// The grabs that held then.
    pub grabs: Vec<RepeatGrab>,
    /// The accelerations, where the stream carries them.
    pub accelerations: Option<Accelerations>,
}

/// One tick of one body.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Which body.
    pub body: BodyId,
    /// Which tick.
    pub tick: Tick,
    /// How many ticks before this one were streamed without a break; more count as 65,535. What is older is not missing.
    pub run: u16,
    /// The body sleeps from this tick on.
    pub resting: bool,
    /// Sent again after a NACK.
    pub resent: bool,
    /// The grabs carry where their patches are: streams without accelerations.
    pub displacements: bool,
    /// Everything that holds the body, at most 64.
    pub grabs: Vec<FrameGrab>,
    /// Rigid frame of a free body.
    pub pose: Option<Pose>,
    /// Accelerations, for [`super::Payload::Accelerations`].
    pub accelerations: Option<Accelerations>,
    /// A part of the absolute state.
    pub slice: Option<Slice>,
    /// Checksum of the receiver's state after this tick: the sum of all coordinates with signs drawn from the tick.
    pub check: Option<f32>,
    /// Earlier ticks said again, at most 7.
    pub repeats: Vec<Repeat>,
}

impl Frame {
    /// Bytes of this frame in a datagram, without the 3 bytes of header.
    pub fn bytes(&self) -> usize {
        let more = if self.displacements { 9 } else { 0 };
        let repeat = |r: &Repeat| {
            3 + (10 + more) * r.grabs.len() + r.accelerations.as_ref().map_or(0, Accelerations::bytes)
        };
        12 + (GRAB_BYTES + more) * self.grabs.len()
            + if self.pose.is_some() { 46 } else { 0 }
            + self.accelerations.as_ref().map_or(0, Accelerations::bytes)
            + self.slice.as_ref().map_or(0, |s| Slice::bytes_of(s.steps.len(), s.has_load()))
            + if self.check.is_some() { 4 } else { 0 }
            + 1
            + self.repeats.iter().map(repeat).sum::<usize>()
    }

    /// Writes the frame after a datagram header.
    pub(crate) fn encode(&self, w: &mut Writer) {
        w.u16(self.body.0);
        w.tick(self.tick);
        w.u16(self.run);
        let flag = |on: bool, bit: u8| if on { bit } else { 0 };
        w.u8(flag(self.pose.is_some(), POSE)
            | flag(self.accelerations.is_some(), ACCELERATIONS)
            | flag(self.slice.is_some(), SLICE)
            | flag(self.resting, RESTING)
            | flag(self.check.is_some(), CHECK)
            | flag(self.resent, RESENT)
            | flag(self.displacements, DISPLACEMENTS));
        let grabs = &self.grabs[..self.grabs.len().min(MAX_GRABS)];
        w.u8(grabs.len() as u8);
        for g in grabs {
            w.u16(g.state.key.user.0);
            w.u16(g.state.key.grab);
            w.u8(u8::from(g.held));
            w.u32(g.state.vertex);
            w.f32(g.state.radius as f32);
            w.vector(g.state.target);
            w.vector24(g.state.reaction);
            if self.displacements {
                w.vector24(g.displacement);
            }
        }
        if let Some(p) = &self.pose {
            w.vector(p.position);
            p.rotation.iter().for_each(|&x| w.f32(x as f32));
            w.vector24(p.linear);
            w.vector24(p.angular);
        }
        if let Some(a) = &self.accelerations {
            a.encode(w);
        }
        if let Some(s) = &self.slice {
            s.encode(w);
        }
        if let Some(c) = self.check {
            w.f32(c);
        }
        let repeats = &self.repeats[..self.repeats.len().min(MAX_REPEATS)];
        w.u8(repeats.len() as u8);
        for repeat in repeats {
            w.u8(repeat.back);
            w.u8(u8::from(repeat.accelerations.is_some()));
            w.u8(repeat.grabs.len() as u8);
            for g in &repeat.grabs {
                w.u8(g.index);
                w.vector24(g.reaction);
                if self.displacements {
                    w.vector24(g.displacement);
                }
            }
            if let Some(a) = &repeat.accelerations {
                a.encode(w);
            }
        }
    }

    /// Reads a frame after the datagram header.
    pub(crate) fn decode(r: &mut Reader<'_>) -> Result<Self, StreamError> {
        let body = BodyId(r.u16("body")?);
        let tick = r.tick("tick")?;
        let run = r.u16("run")?;
        let flags = r.u8("frame flags")?;
        let count = usize::from(r.u8("grab count")?);
        let invalid = |what, found: String, expected| Err(StreamError::Invalid { what, found, expected });
        if flags & !KNOWN_FLAGS != 0 {
            return invalid("frame flags", flags.to_string(), "bits 0..=6 only");
        }
        if count > MAX_GRABS {
            return invalid("grab count", count.to_string(), "at most 64");
        }
        let displacements = flags & DISPLACEMENTS != 0;
        let displacement = |r: &mut Reader<'_>| -> Result<[f64; 3], StreamError> {
            if displacements { r.vector24("grab displacement") } else { Ok([0.0; 3]) }
        };
        let mut grabs = Vec::with_capacity(count.min(r.left() / GRAB_BYTES));
        for _ in 0..count {
            let key = GrabKey { user: UserId(r.u16("grab user")?), grab: r.u16("grab")? };
            let held = r.u8("grab held")? != 0;
            let state = GrabState {
                key,
                vertex: r.u32("grab vertex")?,
                radius: r.f32("grab radius")?,
                target: r.vector("grab target")?,
                reaction: r.vector24("grab reaction")?,
            };
            if state.radius < 0.0 {
                return invalid("grab radius", state.radius.to_string(), "0 m or more");
            }
            grabs.push(FrameGrab { state, displacement: displacement(r)?, held });
        }
        let pose = if flags & POSE == 0 { None } else { Some(decode_pose(r)?) };
        let accelerations = if flags & ACCELERATIONS == 0 { None } else { Some(Accelerations::decode(r)?) };
        let slice = if flags & SLICE == 0 { None } else { Some(Slice::decode(r)?) };
        let check = if flags & CHECK == 0 { None } else { Some(r.wide32("check")?) };
        let count = usize::from(r.u8("repeat count")?);
        if count > MAX_REPEATS {
            return invalid("repeat count", count.to_string(), "at most 7");
        }
        let mut repeats = Vec::with_capacity(count);
        for _ in 0..count {
            let back = r.u8("repeat offset")?;
            if back == 0 {
                return invalid("repeat offset", back.to_string(), "1..=255");
            }
            let with_accelerations = r.u8("repeat parts")? != 0;
            let held_count = usize::from(r.u8("repeat grabs")?);
            let mut held = Vec::with_capacity(held_count.min(r.left() / 10));
            for _ in 0..held_count {
                let index = r.u8("repeat grab")?;
                if usize::from(index) >= grabs.len() {
                    return invalid("repeat grab", index.to_string(), "one of the frame's grabs");
                }
                let reaction = r.vector24("repeat reaction")?;
                held.push(RepeatGrab { index, reaction, displacement: displacement(r)? });
            }
            let accelerations = if with_accelerations { Some(Accelerations::decode(r)?) } else { None };
            repeats.push(Repeat { back, grabs: held, accelerations });
        }
        let (resting, resent) = (flags & RESTING != 0, flags & RESENT != 0);
        Ok(Self {
            body,
            tick,
            run,
            resting,
            resent,
            displacements,
            grabs,
            pose,
            accelerations,
            slice,
            check,
            repeats,
        })
    }
}

fn decode_pose(r: &mut Reader<'_>) -> Result<Pose, StreamError> {
    let position = r.vector("pose position")?;
    let mut rotation = [0.0; 4];
    for x in &mut rotation {
        *x = r.f32("pose rotation")?;
    }
    let norm = rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
    if !(0.5..2.0).contains(&norm) {
        return Err(StreamError::Invalid {
            what: "pose rotation",
            found: format!("norm {norm}"),
            expected: "a unit quaternion",
        });
    }
    rotation.iter_mut().for_each(|x| *x /= norm);
    Ok(Pose { position, rotation, linear: r.vector24("pose linear")?, angular: r.vector24("pose angular")? })
}
