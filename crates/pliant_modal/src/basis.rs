//! Reconstruction: from modal coordinates to the deformed surface.
//!
//! Bound by memory bandwidth, so the layout is the algorithm: vertices in blocks of 16; for each block and mode six rows
//! (displacement x y z, rotation x y z) of 16 contiguous numbers. One pass reads the basis once, front to back, and a model with
//! fewer modes reads a prefix of every block.

use crate::warp::{WARP_SERIES_LIMIT, closed_f32, series_f32};

/// Vertices a block.
pub const BLOCK: usize = 16;

/// Rows a vertex and mode: three of displacement, three of rotation.
pub const ROWS: usize = 6;

type Lanes = [f32; BLOCK];

/// The modes at the surface, blocked for reconstruction.
#[derive(Debug, Clone, PartialEq)]
pub struct Basis {
    vertices: usize,
    modes: usize,
    /// `[block][mode][row][lane]`.
    rows: Vec<[Lanes; ROWS]>,
    /// `[block][axis][lane]`, m.
    rest: Vec<[Lanes; 3]>,
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
    pub fn rows(&self) -> &[[Lanes; ROWS]] {
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
                // SAFETY: the processor has just said that it has AVX-512F (which implies AVX2 and FMA in this kernel's feature list).
                unsafe { self.reconstruct_avx512(q, warped, out) };
                return;
            }
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: the processor has just said that it has AVX2 and FMA.
                unsafe { self.reconstruct_avx2(q, warped, out) };
                return;
            }
        }
        self.reconstruct_with::<false>(q, warped, out);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,avx2,fma")]
    fn reconstruct_avx512(&self, q: &[f32], warped: bool, out: &mut [[f32; 3]]) {
        self.reconstruct_with::<true>(q, warped, out);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn reconstruct_avx2(&self, q: &[f32], warped: bool, out: &mut [[f32; 3]]) {
        self.reconstruct_with::<true>(q, warped, out);
    }

    /// The one kernel; `FMA` where the caller's instruction set has it (without it `mul_add` would be a library call).
    #[inline(always)]
    fn reconstruct_with<const FMA: bool>(&self, q: &[f32], warped: bool, out: &mut [[f32; 3]]) {
        let fma = |a: f32, b: f32, c: f32| if FMA { a.mul_add(b, c) } else { a * b + c };
        let used = if warped { ROWS } else { 3 };
        for (block, lanes) in out.chunks_mut(BLOCK).enumerate().take(self.rest.len()) {
            let rows = &self.rows[block * self.modes..block * self.modes + q.len()];
            let mut sum = [[0.0f32; BLOCK]; ROWS];
            if used == ROWS {
                for (row, &qi) in rows.iter().zip(q) {
                    for r in 0..ROWS {
                        for l in 0..BLOCK {
                            sum[r][l] = fma(row[r][l], qi, sum[r][l]);
                        }
                    }
                }
            } else {
                for (row, &qi) in rows.iter().zip(q) {
                    for r in 0..3 {
                        for l in 0..BLOCK {
                            sum[r][l] = fma(row[r][l], qi, sum[r][l]);
                        }
                    }
                }
            }
            let [dx, dy, dz, wx, wy, wz] = sum;
            let rest = &self.rest[block];
            let mut position = [[0.0f32; BLOCK]; 3];
            if warped {
                let mut s = [0.0f32; BLOCK];
                let mut widest = 0.0f32;
                for l in 0..BLOCK {
                    s[l] = fma(wx[l], wx[l], fma(wy[l], wy[l], wz[l] * wz[l]));
                }
                for value in s {
                    widest = if value > widest { value } else { widest };
                }
                let (mut a, mut b) = ([0.0f32; BLOCK], [0.0f32; BLOCK]);
                if widest <= WARP_SERIES_LIMIT {
                    for l in 0..BLOCK {
                        (a[l], b[l]) = series_f32(s[l]);
                    }
                } else {
                    for l in 0..BLOCK {
                        (a[l], b[l]) = closed_f32(s[l]);
                    }
                }
                for l in 0..BLOCK {
                    let cx = fma(wy[l], dz[l], -(wz[l] * dy[l]));
                    let cy = fma(wz[l], dx[l], -(wx[l] * dz[l]));
                    let cz = fma(wx[l], dy[l], -(wy[l] * dx[l]));
                    let ex = fma(wy[l], cz, -(wz[l] * cy));
                    let ey = fma(wz[l], cx, -(wx[l] * cz));
                    let ez = fma(wx[l], cy, -(wy[l] * cx));
                    position[0][l] = rest[0][l] + fma(b[l], ex, fma(a[l], cx, dx[l]));
                    position[1][l] = rest[1][l] + fma(b[l], ey, fma(a[l], cy, dy[l]));
                    position[2][l] = rest[2][l] + fma(b[l], ez, fma(a[l], cz, dz[l]));
                }
            } else {
                for l in 0..BLOCK {
                    position[0][l] = rest[0][l] + dx[l];
                    position[1][l] = rest[1][l] + dy[l];
                    position[2][l] = rest[2][l] + dz[l];
                }
            }
            for (l, p) in lanes.iter_mut().enumerate() {
                *p = [position[0][l], position[1][l], position[2][l]];
            }
        }
    }
}
