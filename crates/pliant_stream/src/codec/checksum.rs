//! The checksum of a state: a projection that shows any lasting error and tolerates rounding.

use crate::state::{State, Tick};

/// Sum of all coordinates with signs drawn from the tick (SplitMix64).
///
/// A hash would change with the last bit of any coordinate. This sum is compared with a tolerance
/// instead. An error that the signs of one tick hide shows with the signs of the next tick.
pub fn projection(tick: Tick, q: &[f64]) -> f64 {
    let mut sum = 0.0;
    let mut bits = 0;
    for (k, q) in q.iter().enumerate() {
        if k % 64 == 0 {
            bits = mix(tick.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (k as u64 / 64));
        }
        sum += if bits >> (k % 64) & 1 == 0 { *q } else { -*q };
    }
    sum
}

/// The checksum of a state. It covers the coordinates, and for a body that relaxes the viscoelastic
/// state with the signs of another tick.
pub fn checksum(tick: Tick, state: &State) -> f64 {
    projection(tick, &state.q) + projection(!tick, &state.z)
}

fn mix(mut x: u64) -> u64 {
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}
