//! Whole numbers that follow one another, in few bits: each is predicted from those before it, and
//! the difference is written in an adaptive Golomb-Rice code.
//!
//! Encoder and decoder keep the same state and change it in the same way, in whole numbers below
//! 2^53, so that a page in JavaScript follows exactly. No choice is written: each number's own past
//! chooses the predictor and the code.

use crate::StreamError;
use crate::wire::bits::{BitReader, BitWriter, LARGEST};

/// Predictors: hold, go on straight, go on with the last curvature.
const PREDICTORS: usize = 3;
/// The sums of the predictors' errors lose `1 / 2^DECAY` at each number.
const DECAY: u32 = 3;
/// A quotient of this many ones says that the number follows in 32 bits.
const ESCAPE: u32 = 20;
/// Largest parameter of the code.
const LARGEST_RICE: u32 = 30;
/// Bits of a level, the start of the errors' sums.
pub(super) const LEVEL_BITS: u32 = 5;

/// The past of one number.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Past {
    /// The last three values, newest first.
    values: [i32; 3],
    /// Decayed sums of the predictors' errors.
    errors: [i64; PREDICTORS],
}

impl Past {
    /// Begins at a value, with a difference to the value before it, and errors of 2^`level`.
    pub(super) fn start(value: i32, before: i32, level: u32) -> Self {
        let straight = clamped(2 * i64::from(before) - i64::from(value));
        let error = if level == 0 { 0 } else { 1_i64 << (level + DECAY - 1) };
        // A straight course is the likeliest, as long as nothing is known.
        Self { values: [value, before, straight], errors: [2 * error, error, 2 * error] }
    }

    pub(super) fn value(&self) -> i32 {
        self.values[0]
    }

    /// The level with which a past like this one starts.
    pub(super) fn level(&self) -> u32 {
        let mean = self.errors.iter().copied().min().unwrap_or(0) >> DECAY;
        (64 - mean.leading_zeros()).min((1 << LEVEL_BITS) - 1)
    }

    fn predictions(&self) -> [i64; PREDICTORS] {
        let [a, b, c] = self.values.map(i64::from);
        [a, clamped(2 * a - b).into(), clamped(3 * a - 3 * b + c).into()]
    }

    /// The prediction and the parameter of the code.
    fn expect(&self) -> (i64, u32) {
        let mut best = 0;
        for k in 1..PREDICTORS {
            if self.errors[k] < self.errors[best] {
                best = k;
            }
        }
        // The best parameter for a mean error m is about log2(1.4 m); the sum is 8 m.
        let scaled = (self.errors[best] * 11) >> 6;
        let parameter = if scaled < 2 { 0 } else { 63 - scaled.leading_zeros() };
        (self.predictions()[best], parameter.min(LARGEST_RICE))
    }

    fn follow(&mut self, value: i32) {
        let predictions = self.predictions();
        for (error, predicted) in self.errors.iter_mut().zip(predictions) {
            *error += (i64::from(value) - predicted).abs() - (*error >> DECAY);
        }
        self.values = [value, self.values[0], self.values[1]];
    }

    /// Writes the next value, at most [`LARGEST`] in magnitude.
    pub(super) fn write(&mut self, bits: &mut BitWriter<'_>, value: i32) {
        let (predicted, parameter) = self.expect();
        let residual = i64::from(value) - predicted;
        // Both are below 2^30 in magnitude, so the zigzag fits 32 bits.
        let zigzag = ((residual << 1) ^ (residual >> 63)) as u32;
        let quotient = zigzag >> parameter;
        if quotient < ESCAPE {
            bits.put((1 << quotient) - 1, quotient + 1);
            bits.put(zigzag, parameter);
        } else {
            bits.put((1 << ESCAPE) - 1, ESCAPE);
            bits.put(zigzag, 32);
        }
        self.follow(value);
    }

    /// Reads the next value.
    pub(super) fn read(&mut self, bits: &mut BitReader<'_, '_>) -> Result<i32, StreamError> {
        const WHAT: &str = "watched value";
        let (predicted, parameter) = self.expect();
        let mut quotient = 0;
        while quotient < ESCAPE && bits.take(WHAT, 1)? == 1 {
            quotient += 1;
        }
        let zigzag = if quotient < ESCAPE {
            (u64::from(quotient) << parameter) + u64::from(bits.take(WHAT, parameter)?)
        } else {
            bits.take(WHAT, 32)?.into()
        };
        let residual = (zigzag >> 1) as i64 ^ -((zigzag & 1) as i64);
        let value = predicted + residual;
        if value.abs() > i64::from(LARGEST) {
            return Err(StreamError::Invalid {
                what: WHAT,
                found: value.to_string(),
                expected: "below 2^30 in magnitude",
            });
        }
        let value = value as i32;
        self.follow(value);
        Ok(value)
    }
}

fn clamped(x: i64) -> i32 {
    x.clamp(-i64::from(LARGEST), i64::from(LARGEST)) as i32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::{Reader, Writer};

    /// Any values come back, the extremes too. A course that a predictor knows costs a bit a value,
    /// as soon as its errors at the beginning are forgotten.
    #[test]
    fn values_come_back_and_what_is_foreseen_costs_a_bit() {
        let courses: [Vec<i32>; 4] = [
            vec![0, 1, -1, LARGEST, -LARGEST, LARGEST, 0, 7, -LARGEST, -LARGEST, 3],
            (0..200).map(|k| 1000 * k - 70_000).collect(),
            (0..200).map(|k| 3 * k * k - 500).collect(),
            vec![5; 200],
        ];
        for (which, course) in courses.iter().enumerate() {
            let mut past = Past::start(course[0], course[0], 0);
            let mut back = past;
            for (part, values) in course[1..].chunks(99).enumerate() {
                let mut w = Writer::with_capacity(64);
                let mut bits = BitWriter::new(&mut w);
                values.iter().for_each(|x| past.write(&mut bits, *x));
                bits.finish();
                let bytes = w.into_bytes();
                let mut r = Reader::new(&bytes);
                let mut bits = BitReader::new(&mut r);
                for x in values {
                    assert_eq!(back.read(&mut bits).unwrap(), *x);
                    assert_eq!(back.value(), *x);
                }
                assert_eq!(back.level(), past.level());
                if part > 0 {
                    assert_eq!(bytes.len(), values.len().div_ceil(8), "course {which}");
                }
            }
        }
    }
}
