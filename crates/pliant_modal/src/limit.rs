//! The speed limit that memory sets, as a reference for reconstruction.

use crate::basis::BLOCK;
use crate::simd::{Lanes, Portable};

/// Number of registers with running sums, enough to hide the latency of an addition.
const CHAINS: usize = 8;

/// Sums a buffer from front to back as fast as this processor can read it.
///
/// The sum uses the widest registers of the processor and eight running sums. Numbers after the
/// last whole group of 128 are left out. Use this for measurements only: the order of the additions
/// depends on the registers.
pub fn streaming_sum(buffer: &[f32]) -> f32 {
    #[cfg(target_arch = "x86_64")]
    {
        if std::arch::is_x86_feature_detected!("avx512f") {
            // SAFETY: The check above found AVX-512F.
            return unsafe { sum_avx512(buffer) };
        }
        if std::arch::is_x86_feature_detected!("avx2")
            && std::arch::is_x86_feature_detected!("fma")
            && std::arch::is_x86_feature_detected!("f16c")
        {
            // SAFETY: The checks above found AVX2, FMA and F16C.
            return unsafe { sum_avx2(buffer) };
        }
    }
    // SAFETY: Portable lanes have no processor requirements.
    unsafe { sum_with::<Portable>(buffer) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn sum_avx512(buffer: &[f32]) -> f32 {
    // SAFETY: The `target_feature` attribute of this function enables the instruction set.
    unsafe { sum_with::<crate::simd::x86::Avx512>(buffer) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,f16c")]
fn sum_avx2(buffer: &[f32]) -> f32 {
    // SAFETY: The `target_feature` attribute of this function enables the instruction set.
    unsafe { sum_with::<crate::simd::x86::Avx2>(buffer) }
}

/// # Safety
/// As for [`Lanes`]: the instruction set of `L` must be available.
#[inline(always)]
unsafe fn sum_with<L: Lanes>(buffer: &[f32]) -> f32 {
    let (rows, _) = buffer.as_chunks::<BLOCK>();
    let (groups, _) = rows.as_chunks::<CHAINS>();
    // SAFETY: The caller guarantees that the instruction set of `L` is available.
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
        // SAFETY: Portable lanes have no processor requirements.
        assert_eq!(unsafe { sum_with::<Portable>(&buffer) }, want);
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2")
            && std::arch::is_x86_feature_detected!("fma")
            && std::arch::is_x86_feature_detected!("f16c")
        {
            // SAFETY: The checks above found AVX2, FMA and F16C.
            assert_eq!(unsafe { sum_avx2(&buffer) }, want);
        }
        assert_eq!(streaming_sum(&buffer[..100]), 0.0);
    }
}
