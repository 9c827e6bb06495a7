//! Bounded little-endian reading and writing. A reader never allocates and never reads past its
//! slice.

use crate::StreamError;
use crate::state::{MAGNITUDE_LIMIT, TICK_LIMIT, Tick};

/// Appends little-endian numbers to a buffer.
#[derive(Debug, Default)]
pub(crate) struct Writer {
    bytes: Vec<u8>,
}

impl Writer {
    pub(crate) fn with_capacity(capacity: usize) -> Self {
        Self { bytes: Vec::with_capacity(capacity) }
    }

    pub(crate) fn into_bytes(self) -> Vec<u8> {
        self.bytes
    }

    pub(crate) fn raw(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }

    pub(crate) fn u8(&mut self, x: u8) {
        self.bytes.push(x);
    }

    pub(crate) fn u16(&mut self, x: u16) {
        self.raw(&x.to_le_bytes());
    }

    pub(crate) fn i16(&mut self, x: i16) {
        self.raw(&x.to_le_bytes());
    }

    pub(crate) fn u32(&mut self, x: u32) {
        self.raw(&x.to_le_bytes());
    }

    pub(crate) fn u64(&mut self, x: u64) {
        self.raw(&x.to_le_bytes());
    }

    pub(crate) fn f32(&mut self, x: f32) {
        self.raw(&x.to_le_bytes());
    }

    pub(crate) fn f64(&mut self, x: f64) {
        self.raw(&x.to_le_bytes());
    }

    pub(crate) fn vector(&mut self, x: [f64; 3]) {
        for c in x {
            self.f32(c as f32);
        }
    }

    /// Writes a number in 3 bytes: sign, 8 bits of exponent, 15 of mantissa; see [`round24`].
    pub(crate) fn f24(&mut self, x: f64) {
        let bits = (round24(x) as f32).to_bits();
        self.raw(&bits.to_le_bytes()[1..]);
    }

    pub(crate) fn vector24(&mut self, x: [f64; 3]) {
        for c in x {
            self.f24(c);
        }
    }

    /// Writes a tick in 6 bytes.
    pub(crate) fn tick(&mut self, tick: Tick) {
        self.raw(&tick.to_le_bytes()[..6]);
    }
}

/// Rounds a number as its 3-byte form does: to an `f32` without its last 8 mantissa bits, with a
/// relative error of at most 2^-16. Numbers beyond [`MAGNITUDE_LIMIT`] and NaN do not reach this
/// function, since the session refuses them.
pub(crate) fn round24(x: f64) -> f64 {
    let bits = (x as f32).to_bits();
    f64::from(f32::from_bits(bits.saturating_add(0x80) & 0xFFFF_FF00))
}

/// Reads little-endian numbers from a slice. Each read names the field for its error.
#[derive(Debug, Clone)]
pub(crate) struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    pub(crate) fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    pub(crate) fn take(&mut self, what: &'static str, count: usize) -> Result<&'a [u8], StreamError> {
        let left = self.left();
        if count > left {
            return Err(StreamError::Truncated { what, offset: self.at, needed: count, left });
        }
        let out = &self.bytes[self.at..self.at + count];
        self.at += count;
        Ok(out)
    }

    fn array<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], StreamError> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(what, N)?);
        Ok(out)
    }

    pub(crate) fn u8(&mut self, what: &'static str) -> Result<u8, StreamError> {
        Ok(self.array::<1>(what)?[0])
    }

    pub(crate) fn u16(&mut self, what: &'static str) -> Result<u16, StreamError> {
        Ok(u16::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn i16(&mut self, what: &'static str) -> Result<i16, StreamError> {
        Ok(i16::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn u32(&mut self, what: &'static str) -> Result<u32, StreamError> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn u64(&mut self, what: &'static str) -> Result<u64, StreamError> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    /// Reads a finite number within [`MAGNITUDE_LIMIT`].
    pub(crate) fn f32(&mut self, what: &'static str) -> Result<f64, StreamError> {
        ranged(what, f64::from(f32::from_le_bytes(self.array(what)?)))
    }

    pub(crate) fn vector(&mut self, what: &'static str) -> Result<[f64; 3], StreamError> {
        Ok([self.f32(what)?, self.f32(what)?, self.f32(what)?])
    }

    /// Reads a finite number in 3 bytes, within [`MAGNITUDE_LIMIT`].
    pub(crate) fn f24(&mut self, what: &'static str) -> Result<f64, StreamError> {
        let high: [u8; 3] = self.array(what)?;
        ranged(what, f64::from(f32::from_le_bytes([0, high[0], high[1], high[2]])))
    }

    pub(crate) fn vector24(&mut self, what: &'static str) -> Result<[f64; 3], StreamError> {
        Ok([self.f24(what)?, self.f24(what)?, self.f24(what)?])
    }

    /// Reads a finite `f64` of magnitude up to 1e15. Modal accelerations of stiff modes exceed
    /// [`MAGNITUDE_LIMIT`].
    pub(crate) fn wide(&mut self, what: &'static str) -> Result<f64, StreamError> {
        wide(what, f64::from_le_bytes(self.array(what)?))
    }

    /// Reads a finite `f32` of magnitude up to 1e15.
    pub(crate) fn wide32(&mut self, what: &'static str) -> Result<f32, StreamError> {
        let x = f32::from_le_bytes(self.array(what)?);
        wide(what, f64::from(x)).map(|_| x)
    }

    pub(crate) fn tick(&mut self, what: &'static str) -> Result<Tick, StreamError> {
        let low: [u8; 6] = self.array(what)?;
        let mut all = [0; 8];
        all[..6].copy_from_slice(&low);
        let tick = Tick::from_le_bytes(all);
        debug_assert!(tick < TICK_LIMIT);
        Ok(tick)
    }

    /// Checks that the datagram is used up. Trailing bytes mean that it is not of the kind that it
    /// claims.
    pub(crate) fn finish(self, what: &'static str) -> Result<(), StreamError> {
        if self.left() == 0 {
            Ok(())
        } else {
            Err(StreamError::Invalid {
                what,
                found: format!("{} bytes too many", self.left()),
                expected: "nothing after the last field",
            })
        }
    }
}

/// Largest magnitude of modal accelerations and loads on the wire.
pub(crate) const WIDE_LIMIT: f64 = 1e15;

fn wide(what: &'static str, x: f64) -> Result<f64, StreamError> {
    if !x.is_finite() {
        Err(StreamError::NotFinite { what })
    } else if x.abs() > WIDE_LIMIT {
        Err(StreamError::Invalid { what, found: x.to_string(), expected: "at most 1e15 in magnitude" })
    } else {
        Ok(x)
    }
}

fn ranged(what: &'static str, x: f64) -> Result<f64, StreamError> {
    if !x.is_finite() {
        Err(StreamError::NotFinite { what })
    } else if x.abs() > MAGNITUDE_LIMIT {
        Err(StreamError::Invalid { what, found: x.to_string(), expected: "at most 1e9 in magnitude" })
    } else {
        Ok(x)
    }
}
