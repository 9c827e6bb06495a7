//! Reconstruction: from modal coordinates to the deformed surface.
//!
//! Bound by memory bandwidth, so the layout is the algorithm: vertices in blocks of 16; for each block and mode six rows
//! (displacement x y z, rotation x y z) of 16 contiguous numbers. One pass reads the basis once, front to back, and a model with
//! fewer modes reads a prefix of every block.

use half::f16;

use crate::{
    simd::{Lanes, Portable},
    warp::{SERIES_A, SERIES_B, SERIES_TERMS, WARP_SERIES_LIMIT, closed_f32},
};

/// Vertices a block.
pub const BLOCK: usize = 16;

/// Rows a vertex and mode: three of displacement, three of rotation.
pub const ROWS: usize = 6;

type Row<S> = [S; BLOCK];

/// What a basis number is stored as.
///
/// # Safety
/// As [`Lanes`]: `load` may only be called where the instruction set of `L` is there.
trait Stored: Copy {
    /// Are rows stored divided by a factor of their mode?
    const SCALED: bool;
    unsafe fn load<L: Lanes>(row: &Row<Self>) -> L;
}

impl Stored for f32 {
    const SCALED: bool = false;
    #[inline(always)]
    unsafe fn load<L: Lanes>(row: &Row<Self>) -> L {
        // SAFETY: the caller's.
        unsafe { L::load(row) }
    }
}

impl Stored for f16 {
    const SCALED: bool = true;
    #[inline(always)]
    unsafe fn load<L: Lanes>(row: &Row<Self>) -> L {
        // SAFETY: the caller's.
        unsafe { L::load_half(row) }
    }
}

/// How finely the numbers of a [`Basis`] are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Precision {
    /// 32 bits.
    #[default]
    Single,
    /// 16 bits, scaled by mode: half the memory to read, which is what bounds the time of a large surface. Each entry is off by at most 2^-11 of the
    /// largest of its mode; a bar pulled aside by a fifth of its length by 5e-5 of the length at most.
    Half,
}

#[derive(Debug, Clone, PartialEq)]
enum Rows {
    Single(Vec<[Row<f32>; ROWS]>),
    /// Half precision has a narrow range, so every mode's rows are stored divided by their largest entry.
    Half(Vec<[Row<f16>; ROWS]>),
}

/// The modes at the surface, blocked for reconstruction.
#[derive(Debug, Clone, PartialEq)]
pub struct Basis {
    vertices: usize,
    modes: usize,
    /// `[block][mode][row][lane]`.
    rows: Rows,
    /// By mode, for displacement and for rotation: what stored rows are to be multiplied by.
    scales: Vec<[f32; 2]>,
    /// `[block][axis][lane]`, m.
    rest: Vec<[Row<f32>; 3]>,
}

impl Basis {
    /// Blocks `displacement` and `rotation`, both `[mode][vertex][axis]` of `3 x vertices x modes` entries (missing ones are zero).
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
        Self { vertices, modes, rows: Rows::Single(rows), scales: vec![[1.0; 2]; modes], rest }
    }

    /// The same modes in half precision: half the memory and, where memory is the limit, half the time.
    ///
    /// Each entry is off by at most 2^-11 of the largest entry of its mode (displacement and rotation apart).
    pub fn to_half(&self) -> Self {
        let Rows::Single(single) = &self.rows else { return self.clone() };
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
        Self { rows: Rows::Half(half), scales, rest: self.rest.clone(), ..*self }
    }

    /// Surface vertices.
    pub fn vertices(&self) -> usize {
        self.vertices
    }

    /// Modes.
    pub fn modes(&self) -> usize {
        self.modes
    }

    /// Bytes that one warped reconstruction with `modes` modes reads and writes: the floor under its time.
    pub fn traffic_bytes(&self, modes: usize) -> usize {
        let number = if matches!(self.rows, Rows::Single(_)) { 4 } else { 2 };
        let rows = modes.min(self.modes) * ROWS * number;
        self.rest.len() * (rows + 3 * 4) * BLOCK + self.vertices * 12
    }

    /// The blocked rows, `[block][mode][row][lane]`, for a device that reconstructs on its own (a GPU); `None` in half precision.
    pub fn rows(&self) -> Option<&[[[f32; BLOCK]; ROWS]]> {
        match &self.rows {
            Rows::Single(rows) => Some(rows),
            Rows::Half(_) => None,
        }
    }

    /// Writes the deformed positions (m, body axes) for modal coordinates `q`, which may have fewer entries than there are modes.
    ///
    /// `warped`: bend by modal warping; else the plain linear sum. Vertices beyond `out`'s length are not written.
    pub fn reconstruct(&self, q: &[f32], warped: bool, out: &mut [[f32; 3]]) {
        self.reconstruct_all(warped, &mut [(q, out)]);
    }

    /// [`reconstruct`](Self::reconstruct) for several bodies of one model in one pass over the basis: for each its modal coordinates and where its
    /// positions go. Past the first body the basis comes from the cache.
    pub fn reconstruct_all(&self, warped: bool, bodies: &mut [(&[f32], &mut [[f32; 3]])]) {
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx512f") {
                // SAFETY: the processor has just said that it has AVX-512F.
                unsafe { self.reconstruct_avx512(warped, bodies) };
                return;
            }
            if std::arch::is_x86_feature_detected!("avx2")
                && std::arch::is_x86_feature_detected!("fma")
                && std::arch::is_x86_feature_detected!("f16c")
            {
                // SAFETY: the processor has just said that it has AVX2, FMA and F16C.
                unsafe { self.reconstruct_avx2(warped, bodies) };
                return;
            }
        }
        // SAFETY: portable lanes ask nothing of the processor.
        unsafe { self.reconstruct_with::<Portable>(warped, bodies) }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f")]
    fn reconstruct_avx512(&self, warped: bool, bodies: &mut [(&[f32], &mut [[f32; 3]])]) {
        // SAFETY: this function's own feature list.
        unsafe { self.reconstruct_with::<crate::simd::x86::Avx512>(warped, bodies) }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma,f16c")]
    fn reconstruct_avx2(&self, warped: bool, bodies: &mut [(&[f32], &mut [[f32; 3]])]) {
        // SAFETY: this function's own feature list.
        unsafe { self.reconstruct_with::<crate::simd::x86::Avx2>(warped, bodies) }
    }

    /// # Safety
    /// As [`Lanes`]: the instruction set of `L` is there.
    #[inline(always)]
    unsafe fn reconstruct_with<L: Lanes>(&self, warped: bool, bodies: &mut [(&[f32], &mut [[f32; 3]])]) {
        // SAFETY: the caller's.
        unsafe {
            match &self.rows {
                Rows::Single(rows) => self.reconstruct_rows::<L, f32>(rows, warped, bodies),
                Rows::Half(rows) => self.reconstruct_rows::<L, f16>(rows, warped, bodies),
            }
        }
    }

    /// The one kernel.
    ///
    /// # Safety
    /// As [`Lanes`].
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
                // SAFETY: the caller's.
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

/// `rest + sum of q x displacement`.
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
unsafe fn linear_block<L: Lanes, S: Stored>(
    rows: &[[Row<S>; ROWS]],
    q: &[f32],
    scales: &[[f32; 2]],
    rest: &[Row<f32>; 3],
) -> [Row<f32>; 3] {
    // SAFETY: the caller's.
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

/// `rest + R~(w) d` with `d`, `w` the sums of displacement and rotation rows.
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
unsafe fn warped_block<L: Lanes, S: Stored>(
    rows: &[[Row<S>; ROWS]],
    q: &[f32],
    scales: &[[f32; 2]],
    rest: &[Row<f32>; 3],
) -> [Row<f32>; 3] {
    // SAFETY: the caller's.
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
            // Horner's rule on the nine-term series: no sine, no division, no branch.
            let last = SERIES_TERMS - 1;
            let (mut a, mut b) = (L::splat(SERIES_A[last]), L::splat(SERIES_B[last]));
            for k in (0..last).rev() {
                a = a.mul_add(s, L::splat(SERIES_A[k]));
                b = b.mul_add(s, L::splat(SERIES_B[k]));
            }
            (a, b)
        } else {
            // More than half a turn somewhere in the block.
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

    /// Every instruction set that this processor has gives the plain double-precision answer, also beyond half a turn and for a last, partial block.
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
        // SAFETY: portable lanes ask nothing of the processor.
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
            // SAFETY: just asked.
            unsafe { basis.reconstruct_avx2(true, &mut [(&q[..], &mut out[..])]) };
            check("avx2", &out);
        }
    }
    #[test]
    fn half_precision_is_off_by_its_rounding_only() {
        // A tiny body has huge mass-normalised rows, far beyond half precision's largest number: the scales take care of that.
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
            // 2^-11 a mode, four modes; the warp turns by up to 9e9 * 4e-10 = 3.6 rad and adds its own share.
            let bound = if warped { 5e-3 } else { 2e-3 };
            for (g, w) in got.as_flattened().iter().zip(want.as_flattened()) {
                assert!((g - w).abs() <= bound * largest, "{g} and {w} of {largest}");
            }
        }
        assert!(half.traffic_bytes(modes) < basis.traffic_bytes(modes) * 6 / 10);
    }
}
