//! Integers in as many bits as they need. The least significant bit comes first, and zeros fill the
//! last byte.

use crate::StreamError;

use super::{Reader, Writer};

/// Number of bits of a width field.
pub(crate) const WIDTH_BITS: u32 = 5;
/// Largest magnitude of a number: 30 bits and a sign.
pub(crate) const LARGEST: i32 = (1 << 30) - 1;

/// Number of bits that a number needs in two's complement; 0 for 0.
pub(crate) fn width(x: i32) -> u32 {
    if x == 0 { 0 } else { 33 - (x ^ (x >> 31)).leading_zeros() }
}

/// Returns the integer nearest to `x`; NaN counts as 0.
pub(crate) fn whole(x: f64) -> i32 {
    // A float-to-int cast saturates and maps NaN to 0.
    (x.round() as i32).clamp(-LARGEST, LARGEST)
}

/// Appends bits to a writer.
pub(crate) struct BitWriter<'a> {
    to: &'a mut Writer,
    pending: u64,
    count: u32,
}

impl<'a> BitWriter<'a> {
    pub(crate) fn new(to: &'a mut Writer) -> Self {
        Self { to, pending: 0, count: 0 }
    }

    /// Writes the lowest `bits` (at most 32) of a number.
    pub(crate) fn put(&mut self, x: u32, bits: u32) {
        let mask = (1_u64 << bits) - 1;
        self.pending |= (u64::from(x) & mask) << self.count;
        self.count += bits;
        while self.count >= 8 {
            self.to.u8(self.pending as u8);
            self.pending >>= 8;
            self.count -= 8;
        }
    }

    /// Fills the last byte with zeros.
    pub(crate) fn finish(self) {
        if self.count > 0 {
            self.to.u8(self.pending as u8);
        }
    }
}

/// Takes bits from a reader.
pub(crate) struct BitReader<'r, 'a> {
    from: &'r mut Reader<'a>,
    pending: u64,
    count: u32,
}

impl<'r, 'a> BitReader<'r, 'a> {
    pub(crate) fn new(from: &'r mut Reader<'a>) -> Self {
        Self { from, pending: 0, count: 0 }
    }

    /// Reads the next `bits` (at most 32).
    pub(crate) fn take(&mut self, what: &'static str, bits: u32) -> Result<u32, StreamError> {
        while self.count < bits {
            self.pending |= u64::from(self.from.u8(what)?) << self.count;
            self.count += 8;
        }
        let x = self.pending & ((1_u64 << bits) - 1);
        self.pending >>= bits;
        self.count -= bits;
        Ok(x as u32)
    }

    /// Reads a number of `bits` bits in two's complement.
    pub(crate) fn signed(&mut self, what: &'static str, bits: u32) -> Result<i32, StreamError> {
        if bits == 0 {
            return Ok(0);
        }
        let x = self.take(what, bits)?;
        Ok(((x << (32 - bits)) as i32) >> (32 - bits))
    }

    /// Checks that only zeros fill the last byte.
    pub(crate) fn finish(self, what: &'static str) -> Result<(), StreamError> {
        if self.pending == 0 {
            Ok(())
        } else {
            Err(StreamError::Invalid {
                what,
                found: "bits left over".into(),
                expected: "zeros to the next byte",
            })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back_in_the_bits_that_they_need() {
        let widths =
            [(0, 0), (-1, 1), (1, 2), (-2, 2), (2, 3), (127, 8), (-128, 8), (LARGEST, 31), (-LARGEST, 31)];
        let mut w = Writer::with_capacity(64);
        let mut bits = BitWriter::new(&mut w);
        for (x, wide) in widths {
            assert_eq!(width(x), wide, "{x}");
            bits.put(wide, WIDTH_BITS);
            bits.put(x as u32, wide);
        }
        bits.finish();
        let bytes = w.into_bytes();
        let all: u32 = widths.iter().map(|w| w.1 + WIDTH_BITS).sum();
        assert_eq!(bytes.len(), all.div_ceil(8) as usize);
        let mut r = Reader::new(&bytes);
        let mut back = BitReader::new(&mut r);
        for (x, wide) in widths {
            let read = back.take("width", WIDTH_BITS).unwrap();
            assert_eq!(read, wide);
            assert_eq!(back.signed("value", read).unwrap(), x);
        }
        back.finish("padding").unwrap();
        assert_eq!(whole(f64::NAN), 0);
        assert_eq!(whole(1e300), LARGEST);
    }
}
