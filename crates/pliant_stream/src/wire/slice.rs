//! The absolute part of a frame: the state of some modes, in quantization steps of equal
//! displacement on the surface.

use super::bits::{BitReader, BitWriter, WIDTH_BITS, whole, width};
use super::{Reader, Writer};
use crate::StreamError;
use crate::codec::quantization::Quanta;

/// Number of bits of a mode index.
const MODE_BITS: u32 = 12;
/// Bits of the `parts` byte.
const LOAD: u8 = 1;
const VISCOELASTIC: u8 = 2;

/// One mode of a slice.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SliceEntry {
    /// Index of the mode.
    pub mode: usize,
    /// Modal coordinate after the frame's tick.
    pub q: f64,
    /// Velocity after the frame's tick.
    pub v: f64,
    /// Modal force that the streamed reactions do not explain.
    pub load: f64,
    /// Viscoelastic state after the frame's tick, for a body that relaxes.
    pub z: f64,
}

/// The absolute part of a frame: the state of some modes after the frame's tick.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Slice {
    /// Displacement of the surface by one quantization step, m; see [`Quanta`].
    pub unit: f32,
    /// The slice carries loads. Otherwise they are 0.
    pub loads: bool,
    /// The slice carries viscoelastic states. Otherwise they are 0.
    pub viscoelastic: bool,
    /// Mode index, and quantization steps of q, v, load and z; at most 255 entries.
    pub steps: Vec<(u16, [i32; 4])>,
}

impl Slice {
    /// Quantizes a state for a slice, at most 255 modes.
    pub fn quantize(
        values: &[SliceEntry],
        unit: f32,
        loads: bool,
        viscoelastic: bool,
        quanta: &Quanta,
    ) -> Self {
        let mut made = Self { unit, loads, viscoelastic, steps: Vec::with_capacity(values.len().min(255)) };
        for e in values.iter().take(255).filter(|e| e.mode < quanta.modes()) {
            let k = e.mode;
            let step = |x: f64, quantum: f64| {
                if unit > 0.0 { whole(x / (quantum * f64::from(unit))) } else { 0 }
            };
            let load = if loads { step(e.load, quanta.load[k]) } else { 0 };
            let z = if viscoelastic { step(e.z, quanta.place[k]) } else { 0 };
            made.steps.push((k as u16, [step(e.q, quanta.place[k]), step(e.v, quanta.speed[k]), load, z]));
        }
        made
    }

    /// Iterates over the decoded modes. Modes beyond those of `quanta` are left out.
    pub fn entries<'a>(&'a self, quanta: &'a Quanta) -> impl Iterator<Item = SliceEntry> + 'a {
        let unit = f64::from(self.unit);
        self.steps.iter().filter(|s| usize::from(s.0) < quanta.modes()).map(move |(mode, s)| {
            let k = usize::from(*mode);
            SliceEntry {
                mode: k,
                q: unit * quanta.place[k] * f64::from(s[0]),
                v: unit * quanta.speed[k] * f64::from(s[1]),
                load: unit * quanta.load[k] * f64::from(s[2]),
                z: unit * quanta.place[k] * f64::from(s[3]),
            }
        })
    }

    fn crosses(&self, part: usize) -> bool {
        match part {
            2 => self.loads,
            3 => self.viscoelastic,
            _ => true,
        }
    }

    /// Number of bytes of the first `count` modes.
    pub(crate) fn bytes_of(&self, count: usize) -> usize {
        let one = |s: &(u16, [i32; 4])| {
            let parts = s.1.iter().enumerate().filter(|(part, _)| self.crosses(*part));
            MODE_BITS + parts.map(|(_, &x)| WIDTH_BITS + width(x)).sum::<u32>()
        };
        6 + self.steps.iter().take(count).map(one).sum::<u32>().div_ceil(8) as usize
    }

    /// Number of bytes in a frame.
    pub(crate) fn bytes(&self) -> usize {
        self.bytes_of(self.steps.len())
    }

    pub(crate) fn encode(&self, w: &mut Writer) {
        w.u8(self.steps.len() as u8);
        w.u8(if self.loads { LOAD } else { 0 } | if self.viscoelastic { VISCOELASTIC } else { 0 });
        w.f32(self.unit);
        let mut bits = BitWriter::new(w);
        for (mode, steps) in &self.steps {
            bits.put(u32::from(*mode), MODE_BITS);
            for (_, &x) in steps.iter().enumerate().filter(|(part, _)| self.crosses(*part)) {
                let wide = width(x);
                bits.put(wide, WIDTH_BITS);
                bits.put(x as u32, wide);
            }
        }
        bits.finish();
    }

    pub(crate) fn decode(r: &mut Reader<'_>) -> Result<Self, StreamError> {
        let count = usize::from(r.u8("slice count")?);
        let parts = r.u8("slice parts")?;
        if parts & !(LOAD | VISCOELASTIC) != 0 {
            let found = parts.to_string();
            return Err(StreamError::Invalid { what: "slice parts", found, expected: "bits 0 and 1 only" });
        }
        let unit = r.f32("slice unit")? as f32;
        // The capacity follows from the bytes present: a mode takes at least 22 bits.
        let steps = Vec::with_capacity(count.min(r.left() * 8 / 22));
        let mut made =
            Self { unit, loads: parts & LOAD != 0, viscoelastic: parts & VISCOELASTIC != 0, steps };
        let mut bits = BitReader::new(r);
        for _ in 0..count {
            let mode = bits.take("slice mode", MODE_BITS)? as u16;
            let mut steps = [0; 4];
            for (part, step) in steps.iter_mut().enumerate() {
                if made.crosses(part) {
                    let wide = bits.take("slice width", WIDTH_BITS)?;
                    *step = bits.signed("slice step", wide)?;
                }
            }
            made.steps.push((mode, steps));
        }
        bits.finish("slice padding")?;
        Ok(made)
    }
}
