//! Reconstruction: from modal coordinates to the deformed surface.
//!
//! Bound by memory bandwidth, so the layout is the algorithm: vertices in blocks of 16; for each block and mode six rows
//! (displacement x y z, rotation x y z) of 16 contiguous numbers. One pass reads the basis once, front to back, and a model with
//! fewer modes reads a prefix of every block.

use crate::{
    simd::{Lanes, Portable},
    warp::{SERIES_A, SERIES_B, SERIES_TERMS, WARP_SERIES_LIMIT, closed_f32},
};

/// Vertices a block.
pub const BLOCK: usize = 16;

/// Rows a vertex and mode: three of displacement, three of rotation.
pub const ROWS: usize = 6;

type Row = [f32; BLOCK];

/// The modes at the surface, blocked for reconstruction.
#[derive(Debug, Clone, PartialEq)]
pub struct Basis {
    vertices: usize,
    modes: usize,
    /// `[block][mode][row][lane]`.
    rows: Vec<[Row; ROWS]>,
    /// `[block][axis][lane]`, m.
    rest: Vec<[Row; 3]>,
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
        Self { vertices, modes, rows, rest }
    }

    /// Surface vertices.
    pub fn vertices(&self) -> usize {
        self.vertices
    }

    /// Modes.
    pub fn modes(&self) -> usize {
        self.modes
    }

    /// Bytes that one reconstruction with `modes` modes reads and writes: the floor under its time.
    pub fn traffic_bytes(&self, modes: usize) -> usize {
        let blocks = self.rest.len();
        blocks * (modes.min(self.modes) * ROWS + 3) * BLOCK * 4 + self.vertices * 12
    }

    /// The blocked rows, `[block][mode][row][lane]`, for a device that reconstructs on its own (a GPU).
    pub fn rows(&self) -> &[[Row; ROWS]] {
        &self.rows
    }

    /// Writes the deformed positions (m, body axes) for modal coordinates `q`, which may have fewer entries than there are modes.
    ///
    /// `warped`: bend by modal warping; else the plain linear sum. Vertices beyond `out`'s length are not written.
    pub fn reconstruct(&self, q: &[f32], warped: bool, out: &mut [[f32; 3]]) {
        let modes = q.len().min(self.modes);
        let q = &q[..modes];
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx512f") {
                // SAFETY: the processor has just said that it has AVX-512F.
                unsafe { self.reconstruct_avx512(q, warped, out) };
                return;
            }
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: the processor has just said that it has AVX2 and FMA.
                unsafe { self.reconstruct_avx2(q, warped, out) };
                return;
            }
        }
        // SAFETY: portable lanes ask nothing of the processor.
        unsafe { self.reconstruct_with::<Portable>(q, warped, out) }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f")]
    fn reconstruct_avx512(&self, q: &[f32], warped: bool, out: &mut [[f32; 3]]) {
        // SAFETY: this function's own feature list.
        unsafe { self.reconstruct_with::<crate::simd::x86::Avx512>(q, warped, out) }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn reconstruct_avx2(&self, q: &[f32], warped: bool, out: &mut [[f32; 3]]) {
        // SAFETY: this function's own feature list.
        unsafe { self.reconstruct_with::<crate::simd::x86::Avx2>(q, warped, out) }
    }

    /// The one kernel.
    ///
    /// # Safety
    /// As [`Lanes`]: the instruction set of `L` is there.
    #[inline(always)]
    unsafe fn reconstruct_with<L: Lanes>(&self, q: &[f32], warped: bool, out: &mut [[f32; 3]]) {
        for ((block, lanes), rest) in out.chunks_mut(BLOCK).enumerate().zip(&self.rest) {
            let rows = &self.rows[block * self.modes..block * self.modes + q.len()];
            // SAFETY: the caller's.
            let position = unsafe {
                if warped { warped_block::<L>(rows, q, rest) } else { linear_block::<L>(rows, q, rest) }
            };
            for (l, p) in lanes.iter_mut().enumerate() {
                *p = [position[0][l], position[1][l], position[2][l]];
            }
        }
    }
}

/// `rest + sum of q x displacement`.
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
unsafe fn linear_block<L: Lanes>(rows: &[[Row; ROWS]], q: &[f32], rest: &[Row; 3]) -> [Row; 3] {
    // SAFETY: the caller's.
    unsafe {
        let (mut x, mut y, mut z) = (L::load(&rest[0]), L::load(&rest[1]), L::load(&rest[2]));
        for (row, &q) in rows.iter().zip(q) {
            let q = L::splat(q);
            x = L::load(&row[0]).mul_add(q, x);
            y = L::load(&row[1]).mul_add(q, y);
            z = L::load(&row[2]).mul_add(q, z);
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
unsafe fn warped_block<L: Lanes>(rows: &[[Row; ROWS]], q: &[f32], rest: &[Row; 3]) -> [Row; 3] {
    // SAFETY: the caller's.
    unsafe {
        let zero = L::splat(0.0);
        let (mut dx, mut dy, mut dz, mut wx, mut wy, mut wz) = (zero, zero, zero, zero, zero, zero);
        for (row, &q) in rows.iter().zip(q) {
            let q = L::splat(q);
            dx = L::load(&row[0]).mul_add(q, dx);
            dy = L::load(&row[1]).mul_add(q, dy);
            dz = L::load(&row[2]).mul_add(q, dz);
            wx = L::load(&row[3]).mul_add(q, wx);
            wy = L::load(&row[4]).mul_add(q, wy);
            wz = L::load(&row[5]).mul_add(q, wz);
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
        unsafe { basis.reconstruct_with::<Portable>(&q, true, &mut out) };
        check("portable", &out);
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
            // SAFETY: just asked.
            unsafe { basis.reconstruct_avx2(&q, true, &mut out) };
            check("avx2", &out);
        }
    }
}
