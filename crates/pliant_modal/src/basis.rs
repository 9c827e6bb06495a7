//! Reconstruction of the deformed surface from modal coordinates.
//!
//! Memory bandwidth limits reconstruction, so the data layout decides the speed. Vertices are
//! stored in blocks of 16. Each block has six rows per mode (displacement x, y, z and rotation x,
//! y, z) of 16 contiguous numbers. One pass reads the basis once, from front to back. A
//! reconstruction with fewer modes reads a prefix of every block.

use half::f16;

use crate::{
    simd::{Lanes, Portable},
    warp::{SERIES_A, SERIES_B, SERIES_TERMS, WARP_SERIES_LIMIT, closed_f32},
};

/// Number of vertices per block.
pub const BLOCK: usize = 16;

/// Number of rows per vertex and mode: three for displacement and three for rotation.
pub const ROWS: usize = 6;

type Row<S> = [S; BLOCK];

/// The number type in which basis entries are stored.
///
/// # Safety
/// As for [`Lanes`]: `load` may only be called where the instruction set of `L` is available.
trait Stored: Copy {
    /// Whether stored rows are divided by a factor per mode.
    const SCALED: bool;
    unsafe fn load<L: Lanes>(row: &Row<Self>) -> L;
}

impl Stored for f32 {
    const SCALED: bool = false;
    #[inline(always)]
    unsafe fn load<L: Lanes>(row: &Row<Self>) -> L {
        // SAFETY: The caller guarantees that the instruction set of `L` is available.
        unsafe { L::load(row) }
    }
}

impl Stored for f16 {
    const SCALED: bool = true;
    #[inline(always)]
    unsafe fn load<L: Lanes>(row: &Row<Self>) -> L {
        // SAFETY: The caller guarantees that the instruction set of `L` is available.
        unsafe { L::load_half(row) }
    }
}

/// Precision in which the numbers of a [`Basis`] are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Precision {
    /// 32 bits per number.
    #[default]
    Single,
    /// 16 bits per number, scaled per mode.
    ///
    /// This halves the memory that a reconstruction reads, which limits the time for a large
    /// surface. The error of each entry is at most 2^-11 of the largest entry of its mode. For a
    /// bar pulled aside by a fifth of its length, the error is at most 5e-5 of the length.
    Half,
}

#[derive(Debug, Clone, PartialEq)]
enum BasisRows {
    Single(Vec<[Row<f32>; ROWS]>),
    /// Half precision has a narrow range, so the rows of every mode are divided by their largest
    /// entry.
    Half(Vec<[Row<f16>; ROWS]>),
}

/// The modes at the surface, in blocks for reconstruction.
#[derive(Debug, Clone, PartialEq)]
pub struct Basis {
    vertices: usize,
    modes: usize,
    /// Layout: `[block][mode][row][lane]`.
    rows: BasisRows,
    /// Factors per mode for displacement and rotation, by which stored rows must be multiplied.
    scales: Vec<[f32; 2]>,
    /// Rest positions, `[block][axis][lane]`, m.
    rest: Vec<[Row<f32>; 3]>,
}

impl Basis {
    /// Arranges `displacement` and `rotation` in blocks.
    ///
    /// Both are `[mode][vertex][axis]` with `3 x vertices x modes` entries. Missing entries are
    /// zero.
    pub(crate) fn new(positions: &[[f32; 3]], modes: usize, displacement: &[f32], rotation: &[f32]) -> Self {
        let vertices = positions.len();
        let blocks = vertices.div_ceil(BLOCK);
        let mut rest = vec![[[0.0; BLOCK]; 3]; blocks];
        for (v, p) in positions.iter().enumerate() {
            for axis in 0..3 {
                rest[v / BLOCK][axis][v % BLOCK] = p[axis];
            }
        }
        let mut rows = vec![[[0.0; BLOCK]; ROWS]; blocks * modes];
        for (half, source) in [displacement, rotation].into_iter().enumerate() {
            for (mode, shape) in source.chunks_exact((vertices * 3).max(1)).take(modes).enumerate() {
                for (v, value) in shape.chunks_exact(3).enumerate() {
                    let row = &mut rows[(v / BLOCK) * modes + mode];
                    for axis in 0..3 {
                        row[half * 3 + axis][v % BLOCK] = value[axis];
                    }
                }
            }
        }
        Self { vertices, modes, rows: BasisRows::Single(rows), scales: vec![[1.0; 2]; modes], rest }
    }

    /// Returns the same modes in half precision.
    ///
    /// This halves the memory and, where memory is the limit, the time. The error of each entry is
    /// at most 2^-11 of the largest entry of its mode (displacement and rotation have separate
    /// scales).
    pub fn to_half(&self) -> Self {
        let BasisRows::Single(single) = &self.rows else { return self.clone() };
        let mut scales = vec![[0.0f32; 2]; self.modes];
        for (index, rows) in single.iter().enumerate() {
            let scale = &mut scales[index % self.modes];
            for (r, row) in rows.iter().enumerate() {
                scale[r / 3] = row.iter().fold(scale[r / 3], |m, x| m.max(x.abs()));
            }
        }
        let half = single
            .iter()
            .enumerate()
            .map(|(index, rows)| {
                let scale = scales[index % self.modes];
                std::array::from_fn(|r| {
                    let by = if scale[r / 3] > 0.0 { scale[r / 3] } else { 1.0 };
                    rows[r].map(|x| f16::from_f32(x / by))
                })
            })
            .collect();
        Self { rows: BasisRows::Half(half), scales, rest: self.rest.clone(), ..*self }
    }

    /// Number of surface vertices.
    pub fn vertices(&self) -> usize {
        self.vertices
    }

    /// Number of modes.
    pub fn modes(&self) -> usize {
        self.modes
    }

    /// Bytes that one warped reconstruction with `modes` modes reads and writes. They set a lower
    /// bound on its time.
    pub fn traffic_bytes(&self, modes: usize) -> usize {
        let number = if matches!(self.rows, BasisRows::Single(_)) { 4 } else { 2 };
        let rows = modes.min(self.modes) * ROWS * number;
        self.rest.len() * (rows + 3 * 4) * BLOCK + self.vertices * 12
    }

    /// The rows, `[block][mode][row][lane]`, for a device that reconstructs by itself (a GPU).
    /// Returns `None` in half precision.
    pub fn rows(&self) -> Option<&[[[f32; BLOCK]; ROWS]]> {
        match &self.rows {
            BasisRows::Single(rows) => Some(rows),
            BasisRows::Half(_) => None,
        }
    }

    /// Writes the deformed positions (m, body axes) for modal coordinates `q`.
    ///
    /// `q` may have fewer entries than there are modes. With `warped` the shape bends by modal
    /// warping, otherwise it is the plain linear sum. Vertices beyond the length of `out` are not
    /// written.
    pub fn reconstruct(&self, q: &[f32], warped: bool, out: &mut [[f32; 3]]) {
        self.reconstruct_all(warped, &mut [(q, out)]);
    }

    /// Reconstructs several bodies of one model in one pass over the basis, like
    /// [`reconstruct`](Self::reconstruct).
    ///
    /// Each entry of `bodies` holds the modal coordinates of a body and the slice for its
    /// positions. From the second body on, the basis comes from the cache.
    pub fn reconstruct_all(&self, warped: bool, bodies: &mut [(&[f32], &mut [[f32; 3]])]) {
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx512f") {
                // SAFETY: The check above found AVX-512F.
                unsafe { self.reconstruct_avx512(warped, bodies) };
                return;
            }
            if std::arch::is_x86_feature_detected!("avx2")
                && std::arch::is_x86_feature_detected!("fma")
                && std::arch::is_x86_feature_detected!("f16c")
            {
                // SAFETY: The checks above found AVX2, FMA and F16C.
                unsafe { self.reconstruct_avx2(warped, bodies) };
                return;
            }
        }
        // SAFETY: Portable lanes have no processor requirements.
        unsafe { self.reconstruct_with::<Portable>(warped, bodies) }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f")]
    fn reconstruct_avx512(&self, warped: bool, bodies: &mut [(&[f32], &mut [[f32; 3]])]) {
        // SAFETY: The `target_feature` attribute of this function enables the instruction set.
        unsafe { self.reconstruct_with::<crate::simd::x86::Avx512>(warped, bodies) }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma,f16c")]
    fn reconstruct_avx2(&self, warped: bool, bodies: &mut [(&[f32], &mut [[f32; 3]])]) {
        // SAFETY: The `target_feature` attribute of this function enables the instruction set.
        unsafe { self.reconstruct_with::<crate::simd::x86::Avx2>(warped, bodies) }
    }

    /// # Safety
    /// As for [`Lanes`]: the instruction set of `L` must be available.
    #[inline(always)]
    unsafe fn reconstruct_with<L: Lanes>(&self, warped: bool, bodies: &mut [(&[f32], &mut [[f32; 3]])]) {
        // SAFETY: The caller guarantees that the instruction set of `L` is available.
        unsafe {
            match &self.rows {
                BasisRows::Single(rows) => self.reconstruct_rows::<L, f32>(rows, warped, bodies),
                BasisRows::Half(rows) => self.reconstruct_rows::<L, f16>(rows, warped, bodies),
            }
        }
    }

    /// The reconstruction kernel, shared by all instruction sets and precisions.
    ///
    /// # Safety
    /// As for [`Lanes`]: the instruction set of `L` must be available.
    #[inline(always)]
    unsafe fn reconstruct_rows<L: Lanes, S: Stored>(
        &self,
        rows: &[[Row<S>; ROWS]],
        warped: bool,
        bodies: &mut [(&[f32], &mut [[f32; 3]])],
    ) {
        for (block, rest) in self.rest.iter().enumerate() {
            let rows = &rows[block * self.modes..(block + 1) * self.modes];
            for (q, out) in bodies.iter_mut() {
                let start = (block * BLOCK).min(out.len());
                let end = (start + BLOCK).min(out.len());
                // SAFETY: The caller guarantees that the instruction set of `L` is available.
                let position = unsafe {
                    if warped {
                        warped_block::<L, S>(rows, q, &self.scales, rest)
                    } else {
                        linear_block::<L, S>(rows, q, &self.scales, rest)
                    }
                };
                for (l, p) in out[start..end].iter_mut().enumerate() {
                    *p = [position[0][l], position[1][l], position[2][l]];
                }
            }
        }
    }
}

/// Computes `rest + sum of q x displacement` for one block.
///
/// # Safety
/// As for [`Lanes`]: the instruction set of `L` must be available.
#[inline(always)]
unsafe fn linear_block<L: Lanes, S: Stored>(
    rows: &[[Row<S>; ROWS]],
    q: &[f32],
    scales: &[[f32; 2]],
    rest: &[Row<f32>; 3],
) -> [Row<f32>; 3] {
    // SAFETY: The caller guarantees that the instruction set of `L` is available.
    unsafe {
        let (mut x, mut y, mut z) = (L::load(&rest[0]), L::load(&rest[1]), L::load(&rest[2]));
        for ((row, &q), scale) in rows.iter().zip(q).zip(scales) {
            let q = L::splat(if S::SCALED { q * scale[0] } else { q });
            x = S::load::<L>(&row[0]).mul_add(q, x);
            y = S::load::<L>(&row[1]).mul_add(q, y);
            z = S::load::<L>(&row[2]).mul_add(q, z);
        }
        let mut out = [[0.0; BLOCK]; 3];
        x.store(&mut out[0]);
        y.store(&mut out[1]);
        z.store(&mut out[2]);
        out
    }
}

/// Computes `rest + R~(w) d` for one block, where `d` and `w` are the sums of displacement and
/// rotation rows.
///
/// # Safety
/// As for [`Lanes`]: the instruction set of `L` must be available.
#[inline(always)]
unsafe fn warped_block<L: Lanes, S: Stored>(
    rows: &[[Row<S>; ROWS]],
    q: &[f32],
    scales: &[[f32; 2]],
    rest: &[Row<f32>; 3],
) -> [Row<f32>; 3] {
    // SAFETY: The caller guarantees that the instruction set of `L` is available.
    unsafe {
        let zero = L::splat(0.0);
        let (mut dx, mut dy, mut dz, mut wx, mut wy, mut wz) = (zero, zero, zero, zero, zero, zero);
        for ((row, &q), scale) in rows.iter().zip(q).zip(scales) {
            let (qd, qw) = if S::SCALED {
                (L::splat(q * scale[0]), L::splat(q * scale[1]))
            } else {
                let q = L::splat(q);
                (q, q)
            };
            dx = S::load::<L>(&row[0]).mul_add(qd, dx);
            dy = S::load::<L>(&row[1]).mul_add(qd, dy);
            dz = S::load::<L>(&row[2]).mul_add(qd, dz);
            wx = S::load::<L>(&row[3]).mul_add(qw, wx);
            wy = S::load::<L>(&row[4]).mul_add(qw, wy);
            wz = S::load::<L>(&row[5]).mul_add(qw, wz);
        }
        let s = wx.mul_add(wx, wy.mul_add(wy, wz.mul(wz)));
        let (a, b) = if s.all_at_most(WARP_SERIES_LIMIT) {
            // Horner's rule on the nine-term series needs no sine, no division and no branch.
            let last = SERIES_TERMS - 1;
            let (mut a, mut b) = (L::splat(SERIES_A[last]), L::splat(SERIES_B[last]));
            for k in (0..last).rev() {
                a = a.mul_add(s, L::splat(SERIES_A[k]));
                b = b.mul_add(s, L::splat(SERIES_B[k]));
            }
            (a, b)
        } else {
            // At least one vertex of the block turns by more than half a turn.
            let mut squares = [0.0; BLOCK];
            s.store(&mut squares);
            let (mut a, mut b) = ([0.0; BLOCK], [0.0; BLOCK]);
            for l in 0..BLOCK {
                (a[l], b[l]) = closed_f32(squares[l]);
            }
            (L::load(&a), L::load(&b))
        };
        let cx = wz.neg_mul_add(dy, wy.mul(dz));
        let cy = wx.neg_mul_add(dz, wz.mul(dx));
        let cz = wy.neg_mul_add(dx, wx.mul(dy));
        let ex = wz.neg_mul_add(cy, wy.mul(cz));
        let ey = wx.neg_mul_add(cz, wz.mul(cx));
        let ez = wy.neg_mul_add(cx, wx.mul(cy));
        let one = L::splat(1.0);
        let mut out = [[0.0; BLOCK]; 3];
        b.mul_add(ex, a.mul_add(cx, dx)).mul_add(one, L::load(&rest[0])).store(&mut out[0]);
        b.mul_add(ey, a.mul_add(cy, dy)).mul_add(one, L::load(&rest[1])).store(&mut out[1]);
        b.mul_add(ez, a.mul_add(cz, dz)).mul_add(one, L::load(&rest[2])).store(&mut out[2]);
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every instruction set of this processor gives the plain double-precision result, also beyond
    /// half a turn and for a last, partial block.
    #[test]
    fn all_instruction_sets_agree_with_the_formula() {
        let (vertices, modes) = (37, 5);
        let positions: Vec<[f32; 3]> = (0..vertices).map(|i| [i as f32 * 0.1, 0.3, -0.2]).collect();
        let wave = |i: usize| ((i * 37 % 101) as f32 / 101.0 - 0.5) * 0.2;
        let displacement: Vec<f32> = (0..vertices * modes * 3).map(wave).collect();
        let rotation: Vec<f32> = (0..vertices * modes * 3).map(|i| 20.0 * wave(i + 13)).collect();
        let basis = Basis::new(&positions, modes, &displacement, &rotation);
        let q: Vec<f32> = vec![0.5, -0.3, 0.8, 0.1, -0.6];
        let mut want = vec![[0.0f64; 3]; vertices];
        for (v, want) in want.iter_mut().enumerate() {
            let sum = |source: &[f32]| -> [f64; 3] {
                std::array::from_fn(|axis| {
                    (0..modes)
                        .map(|m| f64::from(source[(m * vertices + v) * 3 + axis]) * f64::from(q[m]))
                        .sum()
                })
            };
            let u = crate::warp(sum(&rotation), sum(&displacement));
            *want = std::array::from_fn(|axis| f64::from(positions[v][axis]) + u[axis]);
        }
        let check = |name: &str, got: &[[f32; 3]]| {
            for (v, (got, want)) in got.iter().zip(&want).enumerate() {
                for axis in 0..3 {
                    assert!(
                        (f64::from(got[axis]) - want[axis]).abs() < 2e-6,
                        "{name}, vertex {v}: {got:?}, {want:?}"
                    );
                }
            }
        };
        let mut out = vec![[0.0; 3]; vertices];
        basis.reconstruct(&q, true, &mut out);
        check("chosen", &out);
        // SAFETY: Portable lanes have no processor requirements.
        unsafe { basis.reconstruct_with::<Portable>(true, &mut [(&q[..], &mut out[..])]) };
        check("portable", &out);
        let mut second = vec![[0.0; 3]; vertices];
        basis.reconstruct_all(true, &mut [(&[0.1; 5], &mut second[..]), (&q, &mut out[..])]);
        check("second of two bodies", &out);
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2")
            && std::arch::is_x86_feature_detected!("fma")
            && std::arch::is_x86_feature_detected!("f16c")
        {
            // SAFETY: The checks above found AVX2, FMA and F16C.
            unsafe { basis.reconstruct_avx2(true, &mut [(&q[..], &mut out[..])]) };
            check("avx2", &out);
        }
    }
    #[test]
    fn half_precision_is_off_by_its_rounding_only() {
        // A tiny body has huge mass-normalized rows, far beyond the largest number of half
        // precision. The scales per mode bring these rows into range.
        let (vertices, modes) = (50, 4);
        let positions = vec![[0.0f32; 3]; vertices];
        let displacement: Vec<f32> =
            (0..vertices * modes * 3).map(|i| 3e6 * ((i as f32) * 0.7).sin()).collect();
        let rotation: Vec<f32> = (0..vertices * modes * 3).map(|i| 9e9 * ((i as f32) * 0.3).cos()).collect();
        let basis = Basis::new(&positions, modes, &displacement, &rotation);
        let half = basis.to_half();
        let q = vec![1e-10f32; modes];
        let (mut want, mut got) = (vec![[0.0; 3]; vertices], vec![[0.0; 3]; vertices]);
        for warped in [false, true] {
            basis.reconstruct(&q, warped, &mut want);
            half.reconstruct(&q, warped, &mut got);
            let largest = want.as_flattened().iter().fold(0.0f32, |m, x| m.max(x.abs()));
            // The error is 2^-11 per mode with four modes. The warp turns by up to 9e9 * 4e-10 =
            // 3.6 rad, which adds to the error.
            let bound = if warped { 5e-3 } else { 2e-3 };
            for (g, w) in got.as_flattened().iter().zip(want.as_flattened()) {
                assert!((g - w).abs() <= bound * largest, "{g} and {w} of {largest}");
            }
        }
        assert!(half.traffic_bytes(modes) < basis.traffic_bytes(modes) * 6 / 10);
    }
}
