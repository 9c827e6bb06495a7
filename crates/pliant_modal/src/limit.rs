//! The limit that memory sets: what reconstruction is measured against.

use crate::basis::BLOCK;
use crate::simd::{Lanes, Portable};

/// Registers of running sums: as many as hide the latency of an addition.
const CHAINS: usize = 8;

/// The sum of a buffer, read front to back as fast as this processor reads: in its widest registers, eight running sums at a time. Numbers past
/// the last whole 128 are left out. For measuring only: the order of the additions is the registers'.
pub fn streaming_sum(buffer: &[f32]) -> f32 {
    #[cfg(target_arch = "x86_64")]
    {
        if std::arch::is_x86_feature_detected!("avx512f") {
            // SAFETY: the processor has just said that it has AVX-512F.
            return unsafe { sum_avx512(buffer) };
        }
        if std::arch::is_x86_feature_detected!("avx2")
            && std::arch::is_x86_feature_detected!("fma")
            && std::arch::is_x86_feature_detected!("f16c")
        {
            // SAFETY: the processor has just said that it has AVX2, FMA and F16C.
            return unsafe { sum_avx2(buffer) };
        }
    }
    // SAFETY: portable lanes ask nothing of the processor.
    unsafe { sum_with::<Portable>(buffer) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn sum_avx512(buffer: &[f32]) -> f32 {
    // SAFETY: this function's own feature list.
    unsafe { sum_with::<crate::simd::x86::Avx512>(buffer) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,f16c")]
fn sum_avx2(buffer: &[f32]) -> f32 {
    // SAFETY: this function's own feature list.
    unsafe { sum_with::<crate::simd::x86::Avx2>(buffer) }
}

/// # Safety
/// As [`Lanes`]: the instruction set of `L` is there.
#[inline(always)]
unsafe fn sum_with<L: Lanes>(buffer: &[f32]) -> f32 {
    let (rows, _) = buffer.as_chunks::<BLOCK>();
    let (groups, _) = rows.as_chunks::<CHAINS>();
    // SAFETY: the caller's.
    unsafe {
        let one = L::splat(1.0);
        let mut sums = [L::splat(0.0); CHAINS];
        for group in groups {
            for (sum, row) in sums.iter_mut().zip(group) {
                *sum = L::load(row).mul_add(one, *sum);
            }
        }
        let mut total = 0.0;
        for sum in sums {
            let mut lanes = [0.0; BLOCK];
            sum.store(&mut lanes);
            total += lanes.iter().sum::<f32>();
        }
        total
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_instruction_set_sums_all_of_it() {
        let buffer: Vec<f32> = (0..128 * 7).map(|i| (i % 13) as f32).collect();
        let want: f32 = buffer.iter().sum();
        assert_eq!(streaming_sum(&buffer), want);
        // SAFETY: portable lanes ask nothing of the processor.
        assert_eq!(unsafe { sum_with::<Portable>(&buffer) }, want);
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2")
            && std::arch::is_x86_feature_detected!("fma")
            && std::arch::is_x86_feature_detected!("f16c")
        {
            // SAFETY: checked above.
            assert_eq!(unsafe { sum_avx2(&buffer) }, want);
        }
        assert_eq!(streaming_sum(&buffer[..100]), 0.0);
    }
}
