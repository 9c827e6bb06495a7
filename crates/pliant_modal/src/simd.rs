//! Sixteen single-precision numbers at once, in the widest registers of the processor.
//!
//! The compiler turns plain loops over `[[f32; 16]; 6]` accumulators into scalar code. Explicit
//! register types keep the accumulators in registers. Kernels are written once over [`Lanes`], and
//! the instruction set is chosen at run time.

use half::f16;

use crate::basis::BLOCK;

/// Number of partial sums of a dot product. The fixed order gives equal results on all machines and
/// vectorizes.
pub(crate) const LANES: usize = 4;

#[inline(always)]
pub(crate) fn dot(row: &[f64], x: &[f64]) -> f64 {
    let mut sums = [0.0; LANES];
    let ((a, tail_a), (b, tail_b)) = (row.as_chunks::<LANES>(), x.as_chunks::<LANES>());
    for (a, b) in a.iter().zip(b) {
        for k in 0..LANES {
            sums[k] += a[k] * b[k];
        }
    }
    let rest: f64 = tail_a.iter().zip(tail_b).map(|(a, b)| a * b).sum();
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// Work of plain loops that the compiler vectorizes. [`Work::run`] has to be inlined always.
pub(crate) trait Work {
    type Out;
    fn run(self) -> Self::Out;
}

/// Does work in the widest registers of the processor. The result is the same in all of them,
/// because the compiler neither fuses nor reorders operations.
pub(crate) fn widest<W: Work>(work: W) -> W::Out {
    #[cfg(target_arch = "x86_64")]
    {
        if std::arch::is_x86_feature_detected!("avx512f") && std::arch::is_x86_feature_detected!("fma") {
            // SAFETY: The check above found AVX-512F and FMA.
            return unsafe { with_avx512(work) };
        }
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
            // SAFETY: The check above found AVX2 and FMA.
            return unsafe { with_avx2(work) };
        }
    }
    work.run()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn with_avx512<W: Work>(work: W) -> W::Out {
    work.run()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn with_avx2<W: Work>(work: W) -> W::Out {
    work.run()
}

/// [`BLOCK`] numbers in one register, two registers or an array.
///
/// # Safety
/// The methods of an implementation may only be called if its instruction set is known to be
/// available.
pub(crate) trait Lanes: Copy {
    /// Whether there are enough registers for a dozen sums at once.
    const MANY: bool;
    unsafe fn splat(x: f32) -> Self;
    unsafe fn load(from: &[f32; BLOCK]) -> Self;
    unsafe fn load_half(from: &[f16; BLOCK]) -> Self;
    unsafe fn store(self, to: &mut [f32; BLOCK]);
    /// Computes `self * by + plus`.
    unsafe fn mul_add(self, by: Self, plus: Self) -> Self;
    /// Computes `self * by + plus` with one rounding, on every processor.
    unsafe fn fused(self, by: Self, plus: Self) -> Self;
    /// Computes `minus - self * by`.
    unsafe fn neg_mul_add(self, by: Self, minus: Self) -> Self;
    unsafe fn mul(self, by: Self) -> Self;
    /// Returns whether all lanes are at most `limit`. With NaN lanes the result may be either.
    unsafe fn all_at_most(self, limit: f32) -> bool;
}

/// Work of explicit registers. [`Kernel::run`] has to be inlined always.
pub(crate) trait Kernel {
    type Out;
    /// # Safety
    /// The instruction set of the registers has to be available.
    unsafe fn run<D: Doubles, L: Lanes>(self) -> Self::Out;
}

/// Runs a kernel with the widest registers of the processor.
pub(crate) fn with_registers<K: Kernel>(kernel: K) -> K::Out {
    #[cfg(target_arch = "x86_64")]
    {
        let fma = std::arch::is_x86_feature_detected!("fma");
        if std::arch::is_x86_feature_detected!("avx512f") && fma {
            // SAFETY: The check above found AVX-512F and FMA.
            return unsafe { x86::kernel_avx512(kernel) };
        }
        if std::arch::is_x86_feature_detected!("avx2") && fma {
            // SAFETY: The check above found AVX2 and FMA.
            return unsafe { x86::kernel_avx2(kernel) };
        }
    }
    with_arrays(kernel)
}

/// Runs a kernel with arrays, which need no instruction set.
pub(crate) fn with_arrays<K: Kernel>(kernel: K) -> K::Out {
    // SAFETY: Arrays need no instruction set.
    unsafe { kernel.run::<PortableDoubles, Portable>() }
}

/// Eight double-precision numbers in one register, two registers or an array. Results have the same
/// bits on every processor.
///
/// # Safety
/// As for [`Lanes`].
pub(crate) trait Doubles: Copy {
    unsafe fn splat(x: f64) -> Self;
    unsafe fn load(from: &[f64; 8]) -> Self;
    unsafe fn load_single(from: &[f32; 8]) -> Self;
    unsafe fn store(self, to: &mut [f64; 8]);
    unsafe fn add(self, other: Self) -> Self;
    unsafe fn mul(self, by: Self) -> Self;
    /// Computes `self * by + plus` with one rounding.
    unsafe fn fused(self, by: Self, plus: Self) -> Self;
}

/// An array for any processor.
#[derive(Clone, Copy)]
pub(crate) struct PortableDoubles([f64; 8]);

impl Doubles for PortableDoubles {
    #[inline(always)]
    unsafe fn splat(x: f64) -> Self {
        Self([x; 8])
    }
    #[inline(always)]
    unsafe fn load(from: &[f64; 8]) -> Self {
        Self(*from)
    }
    #[inline(always)]
    unsafe fn load_single(from: &[f32; 8]) -> Self {
        Self(from.map(f64::from))
    }
    #[inline(always)]
    unsafe fn store(self, to: &mut [f64; 8]) {
        *to = self.0;
    }
    #[inline(always)]
    unsafe fn add(self, other: Self) -> Self {
        Self(std::array::from_fn(|l| self.0[l] + other.0[l]))
    }
    #[inline(always)]
    unsafe fn mul(self, by: Self) -> Self {
        Self(std::array::from_fn(|l| self.0[l] * by.0[l]))
    }
    #[inline(always)]
    unsafe fn fused(self, by: Self, plus: Self) -> Self {
        Self(std::array::from_fn(|l| self.0[l].mul_add(by.0[l], plus.0[l])))
    }
}

/// An array for any processor, which the compiler vectorizes as far as it can.
#[derive(Clone, Copy)]
pub(crate) struct Portable([f32; BLOCK]);

impl Lanes for Portable {
    const MANY: bool = false;
    #[inline(always)]
    unsafe fn splat(x: f32) -> Self {
        Self([x; BLOCK])
    }
    #[inline(always)]
    unsafe fn load(from: &[f32; BLOCK]) -> Self {
        Self(*from)
    }
    #[inline(always)]
    unsafe fn load_half(from: &[f16; BLOCK]) -> Self {
        Self(from.map(f16::to_f32))
    }
    #[inline(always)]
    unsafe fn store(self, to: &mut [f32; BLOCK]) {
        *to = self.0;
    }
    #[inline(always)]
    unsafe fn mul_add(self, by: Self, plus: Self) -> Self {
        Self(std::array::from_fn(|l| self.0[l] * by.0[l] + plus.0[l]))
    }
    #[inline(always)]
    unsafe fn fused(self, by: Self, plus: Self) -> Self {
        Self(std::array::from_fn(|l| self.0[l].mul_add(by.0[l], plus.0[l])))
    }
    #[inline(always)]
    unsafe fn neg_mul_add(self, by: Self, minus: Self) -> Self {
        Self(std::array::from_fn(|l| minus.0[l] - self.0[l] * by.0[l]))
    }
    #[inline(always)]
    unsafe fn mul(self, by: Self) -> Self {
        Self(std::array::from_fn(|l| self.0[l] * by.0[l]))
    }
    #[inline(always)]
    unsafe fn all_at_most(self, limit: f32) -> bool {
        self.0.iter().all(|x| *x <= limit)
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) mod x86 {
    use std::arch::x86_64::{
        __m256, __m256d, __m512, __m512d, _CMP_LE_OQ, _mm_loadu_ps, _mm_loadu_si128, _mm256_add_pd,
        _mm256_and_ps, _mm256_cmp_ps, _mm256_cvtph_ps, _mm256_cvtps_pd, _mm256_fmadd_pd, _mm256_fmadd_ps,
        _mm256_fnmadd_ps, _mm256_loadu_pd, _mm256_loadu_ps, _mm256_loadu_si256, _mm256_movemask_ps,
        _mm256_mul_pd, _mm256_mul_ps, _mm256_set1_pd, _mm256_set1_ps, _mm256_storeu_pd, _mm256_storeu_ps,
        _mm512_add_pd, _mm512_cmp_ps_mask, _mm512_cvtph_ps, _mm512_cvtps_pd, _mm512_fmadd_pd,
        _mm512_fmadd_ps, _mm512_fnmadd_ps, _mm512_loadu_pd, _mm512_loadu_ps, _mm512_mul_pd, _mm512_mul_ps,
        _mm512_set1_pd, _mm512_set1_ps, _mm512_storeu_pd, _mm512_storeu_ps,
    };

    use half::f16;

    use super::{BLOCK, Doubles, Kernel, Lanes};

    #[target_feature(enable = "avx512f,fma")]
    pub(crate) fn kernel_avx512<K: Kernel>(kernel: K) -> K::Out {
        // SAFETY: This function has the instruction set.
        unsafe { kernel.run::<Avx512Doubles, Avx512>() }
    }

    #[target_feature(enable = "avx2,fma")]
    pub(crate) fn kernel_avx2<K: Kernel>(kernel: K) -> K::Out {
        // SAFETY: This function has the instruction set.
        unsafe { kernel.run::<Avx2Doubles, Avx2>() }
    }

    /// One AVX-512 register.
    #[derive(Clone, Copy)]
    pub(crate) struct Avx512(__m512);

    impl Lanes for Avx512 {
        const MANY: bool = true;
        #[inline(always)]
        unsafe fn splat(x: f32) -> Self {
            // SAFETY: The caller has checked for AVX-512F. References are to 16 numbers.
            Self(unsafe { _mm512_set1_ps(x) })
        }
        #[inline(always)]
        unsafe fn load(from: &[f32; BLOCK]) -> Self {
            // SAFETY: The caller has checked for AVX-512F. References are to 16 numbers.
            Self(unsafe { _mm512_loadu_ps(from.as_ptr()) })
        }
        #[inline(always)]
        unsafe fn load_half(from: &[f16; BLOCK]) -> Self {
            // SAFETY: The caller has checked for AVX-512F. References are to 16 numbers.
            Self(unsafe { _mm512_cvtph_ps(_mm256_loadu_si256(from.as_ptr().cast())) })
        }
        #[inline(always)]
        unsafe fn store(self, to: &mut [f32; BLOCK]) {
            // SAFETY: The caller has checked for AVX-512F. References are to 16 numbers.
            unsafe { _mm512_storeu_ps(to.as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        unsafe fn mul_add(self, by: Self, plus: Self) -> Self {
            // SAFETY: The caller has checked for AVX-512F. References are to 16 numbers.
            Self(unsafe { _mm512_fmadd_ps(self.0, by.0, plus.0) })
        }
        #[inline(always)]
        unsafe fn fused(self, by: Self, plus: Self) -> Self {
            // SAFETY: The caller has checked for the instruction set.
            unsafe { self.mul_add(by, plus) }
        }
        #[inline(always)]
        unsafe fn neg_mul_add(self, by: Self, minus: Self) -> Self {
            // SAFETY: The caller has checked for AVX-512F. References are to 16 numbers.
            Self(unsafe { _mm512_fnmadd_ps(self.0, by.0, minus.0) })
        }
        #[inline(always)]
        unsafe fn mul(self, by: Self) -> Self {
            // SAFETY: The caller has checked for AVX-512F. References are to 16 numbers.
            Self(unsafe { _mm512_mul_ps(self.0, by.0) })
        }
        #[inline(always)]
        unsafe fn all_at_most(self, limit: f32) -> bool {
            // SAFETY: The caller has checked for AVX-512F. References are to 16 numbers.
            unsafe { _mm512_cmp_ps_mask::<_CMP_LE_OQ>(self.0, _mm512_set1_ps(limit)) == u16::MAX }
        }
    }

    /// Two AVX registers, with FMA.
    #[derive(Clone, Copy)]
    pub(crate) struct Avx2(__m256, __m256);

    impl Lanes for Avx2 {
        const MANY: bool = false;
        #[inline(always)]
        unsafe fn splat(x: f32) -> Self {
            // SAFETY: The caller has checked for AVX2, FMA and F16C. References are to 16 numbers.
            let x = unsafe { _mm256_set1_ps(x) };
            Self(x, x)
        }
        #[inline(always)]
        unsafe fn load(from: &[f32; BLOCK]) -> Self {
            let p = from.as_ptr();
            // SAFETY: The caller has checked for AVX2, FMA and F16C. References are to 16 numbers.
            unsafe { Self(_mm256_loadu_ps(p), _mm256_loadu_ps(p.add(8))) }
        }
        #[inline(always)]
        unsafe fn load_half(from: &[f16; BLOCK]) -> Self {
            let p = from.as_ptr();
            // SAFETY: The caller has checked for AVX2, FMA and F16C. References are to 16 numbers.
            unsafe {
                Self(
                    _mm256_cvtph_ps(_mm_loadu_si128(p.cast())),
                    _mm256_cvtph_ps(_mm_loadu_si128(p.add(8).cast())),
                )
            }
        }
        #[inline(always)]
        unsafe fn store(self, to: &mut [f32; BLOCK]) {
            let p = to.as_mut_ptr();
            // SAFETY: The caller has checked for AVX2, FMA and F16C. References are to 16 numbers.
            unsafe {
                _mm256_storeu_ps(p, self.0);
                _mm256_storeu_ps(p.add(8), self.1);
            }
        }
        #[inline(always)]
        unsafe fn mul_add(self, by: Self, plus: Self) -> Self {
            // SAFETY: The caller has checked for AVX2, FMA and F16C. References are to 16 numbers.
            unsafe { Self(_mm256_fmadd_ps(self.0, by.0, plus.0), _mm256_fmadd_ps(self.1, by.1, plus.1)) }
        }
        #[inline(always)]
        unsafe fn fused(self, by: Self, plus: Self) -> Self {
            // SAFETY: The caller has checked for the instruction set.
            unsafe { self.mul_add(by, plus) }
        }
        #[inline(always)]
        unsafe fn neg_mul_add(self, by: Self, minus: Self) -> Self {
            // SAFETY: The caller has checked for AVX2, FMA and F16C. References are to 16 numbers.
            unsafe { Self(_mm256_fnmadd_ps(self.0, by.0, minus.0), _mm256_fnmadd_ps(self.1, by.1, minus.1)) }
        }
        #[inline(always)]
        unsafe fn mul(self, by: Self) -> Self {
            // SAFETY: The caller has checked for AVX2, FMA and F16C. References are to 16 numbers.
            unsafe { Self(_mm256_mul_ps(self.0, by.0), _mm256_mul_ps(self.1, by.1)) }
        }
        #[inline(always)]
        unsafe fn all_at_most(self, limit: f32) -> bool {
            // SAFETY: The caller has checked for AVX2, FMA and F16C. References are to 16 numbers.
            unsafe {
                let limit = _mm256_set1_ps(limit);
                let both = _mm256_and_ps(
                    _mm256_cmp_ps::<_CMP_LE_OQ>(self.0, limit),
                    _mm256_cmp_ps::<_CMP_LE_OQ>(self.1, limit),
                );
                _mm256_movemask_ps(both) == 0xff
            }
        }
    }

    /// One AVX-512 register.
    #[derive(Clone, Copy)]
    pub(crate) struct Avx512Doubles(__m512d);

    impl Doubles for Avx512Doubles {
        #[inline(always)]
        unsafe fn splat(x: f64) -> Self {
            // SAFETY: The caller has checked for AVX-512F. References are to 8 numbers.
            Self(unsafe { _mm512_set1_pd(x) })
        }
        #[inline(always)]
        unsafe fn load(from: &[f64; 8]) -> Self {
            // SAFETY: The caller has checked for AVX-512F. References are to 8 numbers.
            Self(unsafe { _mm512_loadu_pd(from.as_ptr()) })
        }
        #[inline(always)]
        unsafe fn load_single(from: &[f32; 8]) -> Self {
            // SAFETY: The caller has checked for AVX-512F. References are to 8 numbers.
            Self(unsafe { _mm512_cvtps_pd(_mm256_loadu_ps(from.as_ptr())) })
        }
        #[inline(always)]
        unsafe fn store(self, to: &mut [f64; 8]) {
            // SAFETY: The caller has checked for AVX-512F. References are to 8 numbers.
            unsafe { _mm512_storeu_pd(to.as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        unsafe fn add(self, other: Self) -> Self {
            // SAFETY: The caller has checked for AVX-512F.
            Self(unsafe { _mm512_add_pd(self.0, other.0) })
        }
        #[inline(always)]
        unsafe fn mul(self, by: Self) -> Self {
            // SAFETY: The caller has checked for AVX-512F.
            Self(unsafe { _mm512_mul_pd(self.0, by.0) })
        }
        #[inline(always)]
        unsafe fn fused(self, by: Self, plus: Self) -> Self {
            // SAFETY: The caller has checked for AVX-512F. References are to 8 numbers.
            Self(unsafe { _mm512_fmadd_pd(self.0, by.0, plus.0) })
        }
    }

    /// Two AVX registers, with FMA.
    #[derive(Clone, Copy)]
    pub(crate) struct Avx2Doubles(__m256d, __m256d);

    impl Doubles for Avx2Doubles {
        #[inline(always)]
        unsafe fn splat(x: f64) -> Self {
            // SAFETY: The caller has checked for AVX2 and FMA. References are to 8 numbers.
            let x = unsafe { _mm256_set1_pd(x) };
            Self(x, x)
        }
        #[inline(always)]
        unsafe fn load(from: &[f64; 8]) -> Self {
            let p = from.as_ptr();
            // SAFETY: The caller has checked for AVX2 and FMA. References are to 8 numbers.
            unsafe { Self(_mm256_loadu_pd(p), _mm256_loadu_pd(p.add(4))) }
        }
        #[inline(always)]
        unsafe fn load_single(from: &[f32; 8]) -> Self {
            let p = from.as_ptr();
            // SAFETY: The caller has checked for AVX2 and FMA. References are to 8 numbers.
            unsafe { Self(_mm256_cvtps_pd(_mm_loadu_ps(p)), _mm256_cvtps_pd(_mm_loadu_ps(p.add(4)))) }
        }
        #[inline(always)]
        unsafe fn store(self, to: &mut [f64; 8]) {
            let p = to.as_mut_ptr();
            // SAFETY: The caller has checked for AVX2 and FMA. References are to 8 numbers.
            unsafe {
                _mm256_storeu_pd(p, self.0);
                _mm256_storeu_pd(p.add(4), self.1);
            }
        }
        #[inline(always)]
        unsafe fn add(self, other: Self) -> Self {
            // SAFETY: The caller has checked for AVX2.
            unsafe { Self(_mm256_add_pd(self.0, other.0), _mm256_add_pd(self.1, other.1)) }
        }
        #[inline(always)]
        unsafe fn mul(self, by: Self) -> Self {
            // SAFETY: The caller has checked for AVX2.
            unsafe { Self(_mm256_mul_pd(self.0, by.0), _mm256_mul_pd(self.1, by.1)) }
        }
        #[inline(always)]
        unsafe fn fused(self, by: Self, plus: Self) -> Self {
            // SAFETY: The caller has checked for AVX2 and FMA. References are to 8 numbers.
            unsafe { Self(_mm256_fmadd_pd(self.0, by.0, plus.0), _mm256_fmadd_pd(self.1, by.1, plus.1)) }
        }
    }
}
