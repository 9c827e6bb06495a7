//! A frame: one tick of one body. It is intra-coded, so it is decoded without any other frame.

use pliant_modal::GrabConfig;
use serde::{Deserialize, Serialize};

use super::bits::{BitReader, BitWriter, WIDTH_BITS, whole, width};
use super::datagram::bounded;
use super::hold::{decode_hold, encode_hold, hold_bytes, hold_parts};
use super::{Reader, Slice, Writer};
use crate::StreamError;
use crate::codec::quantization::Quanta;
use crate::state::{BodyId, GrabKey, GrabState, MAX_GRABS, MAX_MODES, RigidState, Tick, UserId};

const POSE: u8 = 1;
const ACCELERATIONS: u8 = 2;
const SLICE: u8 = 4;
const RESTING: u8 = 8;
const CHECK: u8 = 16;
const RESENT: u8 = 32;
const DISPLACEMENTS: u8 = 64;
const PART: u8 = 128;

/// Bytes of one grab in a frame, without spring, damper and displacement.
const GRAB_BYTES: usize = 34;
/// Largest number of datagrams for one tick of a body.
pub(crate) const MAX_PARTS: u8 = 16;
/// Largest number of repeats in one frame.
pub(crate) const MAX_REPEATS: usize = 7;

/// Encoding of modal accelerations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub enum AccelerationCoding {
    /// Quantization steps of equal displacement on the surface, in as many bits as the modes need,
    /// in a closed loop; see [`Quanta`]. This is the default.
    Visible,
    /// 8 bytes per mode without rounding, for measurements.
    F64,
}

impl AccelerationCoding {
    /// Estimated number of bytes per mode.
    pub fn bytes_per_mode(self) -> usize {
        match self {
            Self::Visible => 1,
            Self::F64 => 8,
        }
    }
}

/// Number of modes that share a width.
const BLOCK: usize = 8;

/// Modal accelerations in a frame.
#[derive(Debug, Clone, PartialEq)]
pub enum Accelerations {
    /// Value = unit x the mode's acceleration step (see [`Quanta`]) x whole number.
    Visible {
        /// Displacement of the surface by one quantization step, m.
        unit: f32,
        /// Quantization steps, one per mode.
        steps: Vec<i32>,
    },
    /// Unquantized values.
    F64(Vec<f64>),
}

impl Accelerations {
    /// Rounds values to an encoding. `unit` (m) and `quanta` apply to
    /// [`AccelerationCoding::Visible`].
    pub fn quantize(coding: AccelerationCoding, values: &[f64], unit: f32, quanta: &Quanta) -> Self {
        match coding {
            AccelerationCoding::Visible => {
                let step =
                    |(x, p): (&f64, &f64)| if unit > 0.0 { whole(x / (p * f64::from(unit))) } else { 0 };
                Self::Visible { unit, steps: values.iter().zip(&quanta.acceleration).map(step).collect() }
            }
            AccelerationCoding::F64 => Self::F64(values.to_vec()),
        }
    }

    /// Number of modes.
    pub fn modes(&self) -> usize {
        match self {
            Self::Visible { steps, .. } => steps.len(),
            Self::F64(x) => x.len(),
        }
    }

    /// Returns the value of one mode, or zero beyond the last mode.
    pub fn get(&self, mode: usize, quanta: &Quanta) -> f64 {
        match self {
            Self::Visible { unit, steps } => match (steps.get(mode), quanta.acceleration.get(mode)) {
                (Some(step), Some(quantum)) => f64::from(*unit) * quantum * f64::from(*step),
                _ => 0.0,
            },
            Self::F64(x) => x.get(mode).copied().unwrap_or(0.0),
        }
    }

    fn encode(&self, w: &mut Writer) {
        match self {
            Self::Visible { unit, steps } => {
                w.u8(0);
                w.u16(steps.len() as u16);
                w.f32(*unit);
                let mut bits = BitWriter::new(w);
                for block in steps.chunks(BLOCK) {
                    let wide = block_width(block);
                    bits.put(wide, WIDTH_BITS);
                    block.iter().for_each(|&x| bits.put(x as u32, wide));
                }
                bits.finish();
            }
            Self::F64(x) => {
                w.u8(1);
                w.u16(x.len() as u16);
                x.iter().for_each(|&x| w.f64(x));
            }
        }
    }

    pub(crate) fn bytes(&self) -> usize {
        match self {
            Self::Visible { steps, .. } => {
                let bits = |block: &[i32]| WIDTH_BITS + block_width(block) * block.len() as u32;
                7 + steps.chunks(BLOCK).map(bits).sum::<u32>().div_ceil(8) as usize
            }
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
        let fits = |needed: usize| {
            let left = r.left();
            if needed <= left {
                Ok(count)
            } else {
                Err(StreamError::Truncated { what: "accelerations", offset: 0, needed, left })
            }
        };
        match coding {
            0 => {
                // The bytes present hold at least a width for each block, so the reserved memory
                // stays in proportion.
                let mut steps =
                    Vec::with_capacity(fits(4 + count.div_ceil(BLOCK) * WIDTH_BITS as usize / 8)?);
                let unit = r.f32("acceleration unit")? as f32;
                let mut bits = BitReader::new(r);
                while steps.len() < count {
                    let wide = bits.take("acceleration width", WIDTH_BITS)?;
                    for _ in 0..BLOCK.min(count - steps.len()) {
                        steps.push(bits.signed("acceleration", wide)?);
                    }
                }
                bits.finish("acceleration padding")?;
                Ok(Self::Visible { unit, steps })
            }
            1 => {
                let mut x = Vec::with_capacity(fits(8 * count)?);
                for _ in 0..count {
                    x.push(r.wide("acceleration")?);
                }
                Ok(Self::F64(x))
            }
            other => Err(StreamError::Invalid {
                what: "acceleration coding",
                found: other.to_string(),
                expected: "0 or 1",
            }),
        }
    }
}

fn block_width(block: &[i32]) -> u32 {
    block.iter().map(|&x| width(x)).max().unwrap_or(0)
}

/// A grab in a frame. Reactions are rounded to 16 bits of mantissa, targets and radius to `f32`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameGrab {
    /// State of the grab.
    pub state: GrabState,
    /// Displacement of the patch from rest in body axes, m. It is zero in acceleration streams,
    /// which do not carry it.
    pub displacement: [f64; 3],
    /// The grab holds at the frame's tick. Grabs that ended within the repeated ticks are listed
    /// with `false`.
    pub held: bool,
}

/// A grab at a repeated tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RepeatGrab {
    /// Index into the frame's grabs.
    pub index: u8,
    /// Reaction at the repeated tick, N.
    pub reaction: [f64; 3],
    /// Displacement of the patch at the repeated tick, as in [`FrameGrab`].
    pub displacement: [f64; 3],
}

/// A repeated earlier tick.
#[derive(Debug, Clone, PartialEq)]
pub struct Repeat {
    /// Number of ticks before the frame's tick, 1..=255.
    pub back: u8,
    /// The grabs that held at the repeated tick.
    pub grabs: Vec<RepeatGrab>,
    /// The accelerations, if the stream carries them.
    pub accelerations: Option<Accelerations>,
}

/// One tick of one body.
#[derive(Debug, Clone, PartialEq)]
pub struct TickFrame {
    /// The body.
    pub body: BodyId,
    /// The tick.
    pub tick: Tick,
    /// Number of ticks before this one that were streamed without a break, saturated at 65,535.
    /// Older ticks are not missing.
    pub run: u16,
    /// The body sleeps from this tick on.
    pub resting: bool,
    /// The frame is a resend, for example after a NACK.
    pub resent: bool,
    /// The grabs carry the displacements of their patches. This is the case in streams without
    /// accelerations.
    pub displacements: bool,
    /// Index and number of the datagrams of this tick, when the grabs do not fit in one; `None` for
    /// a single datagram.
    pub part: Option<(u8, u8)>,
    /// All grabs of the body, at most 64. In a part, the grabs of that part.
    pub grabs: Vec<FrameGrab>,
    /// Rigid frame of a free body.
    pub pose: Option<RigidState>,
    /// Accelerations, for [`super::Payload::Accelerations`].
    pub accelerations: Option<Accelerations>,
    /// A part of the absolute state.
    pub slice: Option<Slice>,
    /// Checksum of the receiver's state after this tick: the sum of all coordinates with signs
    /// drawn from the tick.
    pub check: Option<f32>,
    /// Repeated earlier ticks, at most 7.
    pub repeats: Vec<Repeat>,
}

impl TickFrame {
    /// Bytes of one grab.
    pub(crate) fn grab_bytes(&self, g: &FrameGrab) -> usize {
        GRAB_BYTES + if self.displacements { 9 } else { 0 } + hold_bytes(&g.state.hold)
    }

    /// Bytes of this frame in a datagram, without the 3 bytes of header.
    pub fn bytes(&self) -> usize {
        let more = if self.displacements { 9 } else { 0 };
        let repeat = |r: &Repeat| {
            3 + (10 + more) * r.grabs.len() + r.accelerations.as_ref().map_or(0, Accelerations::bytes)
        };
        12 + self.grabs.iter().map(|g| self.grab_bytes(g)).sum::<usize>()
            + if self.pose.is_some() { 46 } else { 0 }
            + self.accelerations.as_ref().map_or(0, Accelerations::bytes)
            + if self.part.is_some() { 2 } else { 0 }
            + self.slice.as_ref().map_or(0, Slice::bytes)
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
            | flag(self.displacements, DISPLACEMENTS)
            | flag(self.part.is_some(), PART));
        if let Some((which, of)) = self.part {
            w.u8(which);
            w.u8(of);
        }
        let grabs = &self.grabs[..self.grabs.len().min(MAX_GRABS)];
        w.u8(grabs.len() as u8);
        for g in grabs {
            w.u16(g.state.key.user.0);
            w.u16(g.state.key.grab);
            w.u8(u8::from(g.held) | hold_parts(&g.state.hold) << 1);
            w.u32(g.state.vertex);
            w.f32(g.state.radius as f32);
            w.vector(g.state.target);
            w.vector24(g.state.reaction);
            if self.displacements {
                w.vector24(g.displacement);
            }
            encode_hold(&g.state.hold, w);
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
        let invalid = |what, found: String, expected| Err(StreamError::Invalid { what, found, expected });
        let part = if flags & PART == 0 {
            None
        } else {
            let (which, of) = (r.u8("frame part")?, r.u8("frame parts")?);
            if which >= of || !(2..=MAX_PARTS).contains(&of) {
                return invalid("frame part", format!("{which} of {of}"), "one of 2 to 16");
            }
            Some((which, of))
        };
        let count = usize::from(r.u8("grab count")?);
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
            let parts = r.u8("grab parts")?;
            bounded("grab parts", parts, 7, "0 to 7")?;
            let mut state = GrabState {
                key,
                vertex: r.u32("grab vertex")?,
                radius: r.f32("grab radius")?,
                target: r.vector("grab target")?,
                reaction: r.vector24("grab reaction")?,
                hold: GrabConfig::default(),
            };
            if state.radius < 0.0 {
                return invalid("grab radius", state.radius.to_string(), "0 m or more");
            }
            let displacement = displacement(r)?;
            state.hold = decode_hold(parts >> 1, r)?;
            grabs.push(FrameGrab { state, displacement, held: parts & 1 != 0 });
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
            part,
            grabs,
            pose,
            accelerations,
            slice,
            check,
            repeats,
        })
    }
}

fn decode_pose(r: &mut Reader<'_>) -> Result<RigidState, StreamError> {
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
    Ok(RigidState {
        position,
        rotation,
        linear: r.vector24("pose linear")?,
        angular: r.vector24("pose angular")?,
    })
}
