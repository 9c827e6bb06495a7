//! Energy, force and tangent of the reduced elasticity.
//!
//! Energy and force have double precision. The tangent only steers Newton's method: its sums have
//! single precision, in coordinates of equal stiffness (`omega_i q_i`), so that soft ones keep
//! their digits. All sums have a fixed order and fused products, so that their bits are the same
//! whatever the width of the registers.

use std::sync::Arc;

use nalgebra::Matrix3;

use super::{
    Hyperelastic,
    lanes::{LANES, Lane},
    principal::positive_roots,
};
use crate::{
    HeldShapes, ModalModel, ModelError, ReducedElasticity,
    simd::{Doubles, Kernel, Lanes, with_registers},
};

/// Number of coordinates in one block of the tangent's columns.
const WIDTH: usize = 16;

/// Number of rows of the tangent that are computed at once.
const ROWS: usize = 4;

/// Gradients of a model's cubature, padded to whole blocks: the shared part of all copies of a
/// body.
#[derive(Debug, PartialEq)]
pub(crate) struct Gradients {
    padded: usize,
    values: Vec<f32>,
    /// The same, each column divided by the frequency of its coordinate (rad/s).
    scaled: Vec<f32>,
}

impl Gradients {
    pub(crate) fn new(gradients: &[f32], omega: &[f64]) -> Self {
        let padded = omega.len().next_multiple_of(WIDTH);
        let rows = gradients.len() / omega.len().max(1);
        let (mut values, mut scaled) = (vec![0.0; rows * padded], vec![0.0; rows * padded]);
        let outs = values.chunks_exact_mut(padded).zip(scaled.chunks_exact_mut(padded));
        for (row, (values, scaled)) in gradients.chunks_exact(omega.len()).zip(outs) {
            for (k, (&x, omega)) in row.iter().zip(omega).enumerate() {
                values[k] = x;
                scaled[k] = (f64::from(x) / omega) as f32;
            }
        }
        Self { padded, values, scaled }
    }
}

/// The reduced elastic energy `U(q)` of a body, with its force and its tangent.
///
/// Slices of coordinates have one entry per coordinate. Entries that a shorter slice lacks count as
/// zero, and those that a longer one has beyond them are not used.
#[derive(Debug, Clone)]
pub struct ElasticEnergy {
    gradients: Arc<Gradients>,
    /// Weights of the points, m^3.
    weights: Vec<f64>,
    law: Hyperelastic,
    modes: usize,
    /// Number of coordinates in whole blocks.
    padded: usize,
    omega: Vec<f64>,
    /// The coordinates, padded.
    q: Vec<f64>,
    /// Elastic force `dU/dq`, kg^1/2 m/s^2, padded.
    force: Vec<f64>,
    /// The rule's positive semidefinite tangent over the frequencies, its upper triangle by blocks
    /// of columns, `modes` rows of `padded` entries.
    tangent: Vec<f32>,
    /// Rows of some points: their gradients under the roots of the material's tangent.
    rows: Vec<f32>,
    /// Number of points whose tangent had negative eigenvalues at the last linearization.
    raised: usize,
}

impl ElasticEnergy {
    /// Makes the energy of the first `modes` coordinates of a model with `scale` times the baked
    /// stiffness. Returns `None` for a model without reduced elasticity.
    pub(crate) fn of_model(model: &ModalModel, modes: usize, scale: f64) -> Option<Self> {
        let reduced = model.parts().reduced.as_ref()?;
        let law = model.law(reduced.material, scale);
        let omega = &model.omega()[..modes];
        Some(Self::assemble(model.cubature_gradients(), &reduced.weights, law, omega))
    }

    /// Makes the energy of all coordinates of a model and the columns of held patches, which come
    /// before the coordinates, with `scale` times the baked stiffness. Returns `None` for a model
    /// without reduced elasticity.
    pub(crate) fn of_shapes(model: &ModalModel, shapes: &HeldShapes, scale: f64) -> Option<Self> {
        let law = model.law(model.material()?, scale);
        let (gradients, weights) = shapes.rule();
        let columns = std::iter::repeat_n(1.0, shapes.columns());
        let omega: Vec<f64> = columns.chain(model.omega().iter().copied()).collect();
        Some(Self::assemble(gradients, weights, law, &omega))
    }

    /// Makes the energy of a rule for coordinates with these frequencies (rad/s).
    ///
    /// # Errors
    /// Returns an error if a length does not match, or if a number is not finite or out of range.
    pub fn new(reduced: &ReducedElasticity, law: Hyperelastic, omega: &[f64]) -> Result<Self, ModelError> {
        if omega.is_empty() {
            return Err(ModelError::Empty("mode"));
        }
        if let Some(index) = omega.iter().position(|omega| !(omega.is_finite() && *omega > 0.0)) {
            let (what, expected) = ("omega", "finite rad/s above 0");
            return Err(ModelError::Value { what, index, expected, got: omega[index] });
        }
        crate::check::check_reduced(reduced, omega)?;
        let gradients = Arc::new(Gradients::new(&reduced.gradients, omega));
        Ok(Self::assemble(gradients, &reduced.weights, law, omega))
    }

    fn assemble(gradients: Arc<Gradients>, weights: &[f64], law: Hyperelastic, omega: &[f64]) -> Self {
        let modes = omega.len();
        let padded = modes.next_multiple_of(WIDTH);
        Self {
            gradients,
            weights: weights.to_vec(),
            law,
            modes,
            padded,
            omega: omega.to_vec(),
            q: vec![0.0; padded],
            force: vec![0.0; padded],
            tangent: vec![0.0; modes.next_multiple_of(ROWS) * padded],
            rows: vec![0.0; 9 * LANES * padded],
            raised: 0,
        }
    }

    /// Volume of the body, m^3: the sum of the weights.
    pub fn volume(&self) -> f64 {
        self.weights.iter().sum()
    }

    /// Number of points whose tangent had negative eigenvalues at the last linearization.
    pub fn raised(&self) -> usize {
        self.raised
    }

    /// Elastic force `dU/dq` at the last linearization, kg^1/2 m/s^2.
    pub fn force(&self) -> &[f64] {
        &self.force[..self.modes]
    }

    /// Entry `i` of the tangent's diagonal at the last linearization, 1/s^2.
    pub(crate) fn stiffness(&self, i: usize) -> f64 {
        let at = i * self.padded + i;
        self.omega[i] * self.omega[i] * f64::from(self.tangent[at])
    }

    /// Writes row `i` of the tangent's upper triangle at the last linearization, from column `i`
    /// on, 1/s^2.
    pub fn tangent_row(&self, i: usize, out: &mut [f64]) {
        if i >= self.modes {
            return;
        }
        let row = i * self.padded;
        let parts = self.tangent[row + i..].iter().zip(&self.omega[i..]);
        for (out, (tangent, omega)) in out.iter_mut().zip(parts) {
            *out = self.omega[i] * omega * f64::from(*tangent);
        }
    }

    fn load(&mut self, q: &[f64]) {
        let given = self.modes.min(q.len());
        self.q[..given].copy_from_slice(&q[..given]);
        self.q[given..].fill(0.0);
    }

    fn points(&self) -> impl Iterator<Item = (f64, &[f32])> {
        self.weights.iter().copied().zip(self.gradients.values.chunks_exact(9 * self.gradients.padded))
    }

    /// Elastic energy, J.
    pub fn energy(&self, q: &[f64]) -> f64 {
        with_registers(EnergyAt { energy: self, q: Blocks::of(&q[..self.modes.min(q.len())]) })
    }

    /// Writes the elastic force `dU/dq` at `q`, kg^1/2 m/s^2.
    pub fn force_at(&self, q: &[f64], out: &mut [f64]) {
        let q = Blocks::of(&q[..self.modes.min(q.len())]);
        let mut force = vec![0.0; self.padded];
        with_registers(ForceAt { energy: self, q, out: &mut force });
        out.iter_mut().zip(&force[..self.modes]).for_each(|(out, force)| *out = *force);
    }

    /// Computes the force alone at `q`. The tangent stays that of the last linearization.
    pub fn compute_force(&mut self, q: &[f64]) {
        self.load(q);
        with_registers(Linearize { energy: self, tangent: false });
    }

    /// Computes force and positive semidefinite tangent at `q`.
    pub fn linearize(&mut self, q: &[f64]) {
        self.load(q);
        with_registers(Linearize { energy: self, tangent: true });
    }
}

struct EnergyAt<'a> {
    energy: &'a ElasticEnergy,
    q: Blocks<'a>,
}

impl Kernel for EnergyAt<'_> {
    type Out = f64;
    #[inline(always)]
    unsafe fn run<D: Doubles, L: Lanes>(self) -> f64 {
        let energy = self.energy;
        let mut sum = 0.0;
        // A closure would not be compiled for the registers of this function.
        for (weight, rows) in energy.points() {
            // SAFETY: The caller has checked for the instruction set.
            let h = unsafe { gradient::<D>(rows, energy.gradients.padded, &self.q) };
            sum += weight * energy.law.energy(&Matrix3::from_column_slice(&h));
        }
        sum
    }
}

struct ForceAt<'a> {
    energy: &'a ElasticEnergy,
    q: Blocks<'a>,
    /// Padded to whole blocks.
    out: &'a mut [f64],
}

impl Kernel for ForceAt<'_> {
    type Out = ();
    #[inline(always)]
    unsafe fn run<D: Doubles, L: Lanes>(self) {
        let (energy, stride) = (self.energy, self.energy.gradients.padded);
        for (weight, rows) in energy.points() {
            // SAFETY: The caller has checked for the instruction set.
            unsafe {
                let mut stress = energy.law.stresses(&gradient::<D>(rows, stride, &self.q));
                for stress in &mut stress {
                    *stress *= weight;
                }
                add_force::<D>(&stress, rows, stride, self.out);
            }
        }
    }
}

/// Force and, if asked for, tangent at the coordinates that the energy has loaded.
struct Linearize<'a> {
    energy: &'a mut ElasticEnergy,
    tangent: bool,
}

impl Kernel for Linearize<'_> {
    type Out = ();
    #[inline(always)]
    unsafe fn run<D: Doubles, L: Lanes>(self) {
        let Self { energy, tangent } = self;
        let (modes, padded, stride) = (energy.modes, energy.padded, energy.gradients.padded);
        let (gradients, q) = (energy.gradients.clone(), Blocks::of(&energy.q));
        energy.force.fill(0.0);
        if tangent {
            energy.tangent.fill(0.0);
            energy.raised = 0;
        }
        let groups = energy.weights.chunks(LANES).zip(gradients.values.chunks(9 * stride * LANES));
        for ((weights, values), scaled) in groups.zip(gradients.scaled.chunks(9 * stride * LANES)) {
            // Lanes beyond the last point are at rest and have no weight.
            let (mut h, mut share) = ([Lane::splat(0.0); 9], Lane::splat(0.0));
            share.0[..weights.len()].copy_from_slice(weights);
            for (lane, rows) in values.chunks_exact(9 * stride).enumerate() {
                // SAFETY: The caller has checked for the instruction set.
                let own = unsafe { gradient::<D>(rows, stride, &q) };
                for (h, own) in h.iter_mut().zip(own) {
                    h.0[lane] = own;
                }
            }
            let mut stress = energy.law.stresses(&h);
            for stress in &mut stress {
                *stress = *stress * share;
            }
            for (lane, rows) in values.chunks_exact(9 * stride).enumerate() {
                let own = std::array::from_fn(|e| stress[e].0[lane]);
                // SAFETY: The caller has checked for the instruction set.
                unsafe { add_force::<D>(&own, rows, stride, &mut energy.force) };
            }
            if !tangent {
                continue;
            }
            for k in 0..3 {
                h[4 * k] = h[4 * k] + Lane::splat(1.0);
            }
            let roots = positive_roots(energy.law, &h);
            let factors = singles(&roots.rows, share.sqrt());
            let mut kept = 0;
            for (lane, rows) in scaled.chunks_exact(9 * stride).enumerate() {
                energy.raised += usize::from(roots.least.0[lane] < 0.0);
                // Rows of eigenvalues that were raised to zero add nothing.
                let (mut of, mut count) = ([0; 9], 0);
                for (k, size) in roots.sizes.iter().enumerate() {
                    of[count] = k;
                    count += usize::from(size.0[lane] != 0.0);
                }
                let outs = &mut energy.rows[kept * padded..];
                // SAFETY: The caller has checked for the instruction set.
                unsafe { combine::<L>(&factors, lane, &of[..count], rows, [stride, padded], outs) };
                kept += count;
            }
            // SAFETY: The caller has checked for the instruction set.
            unsafe { add_squares::<L>(&energy.rows[..padded * kept], modes, padded, &mut energy.tangent) };
        }
    }
}

/// Coordinates in whole blocks: the last one has zeros beyond the last coordinate.
struct Blocks<'a> {
    whole: &'a [[f64; LANES]],
    last: Option<[f64; LANES]>,
}

impl<'a> Blocks<'a> {
    #[inline(always)]
    fn of(q: &'a [f64]) -> Self {
        let (whole, tail) = q.as_chunks::<LANES>();
        let mut last = [0.0; LANES];
        last[..tail.len()].copy_from_slice(tail);
        Self { whole, last: (!tail.is_empty()).then_some(last) }
    }
}

/// Displacement gradient of a point, from its rows of `stride` entries, of which `q` may cover the
/// first.
#[inline(always)]
unsafe fn gradient<D: Doubles>(rows: &[f32], stride: usize, q: &Blocks<'_>) -> [f64; 9] {
    let (rows, blocks) = (rows.as_chunks::<LANES>().0, stride / LANES);
    // SAFETY: The caller has checked for the instruction set.
    unsafe {
        let mut sums = [D::splat(0.0); 9];
        for (block, q) in q.whole.iter().chain(&q.last).enumerate() {
            let q = D::load(q);
            for e in 0..9 {
                sums[e] = D::load_single(&rows[e * blocks + block]).fused(q, sums[e]);
            }
        }
        let mut h = [0.0; 9];
        for e in 0..9 {
            let mut s = [0.0; LANES];
            sums[e].store(&mut s);
            h[e] = ((s[0] + s[4]) + (s[1] + s[5])) + ((s[2] + s[6]) + (s[3] + s[7]));
        }
        h
    }
}

/// Adds the force of a point with this stress times its weight.
#[inline(always)]
unsafe fn add_force<D: Doubles>(stress: &[f64; 9], rows: &[f32], stride: usize, out: &mut [f64]) {
    let (rows, out) = (rows.as_chunks::<LANES>().0, out.as_chunks_mut::<LANES>().0);
    let blocks = stride / LANES;
    // SAFETY: The caller has checked for the instruction set.
    unsafe {
        let mut factors = [D::splat(0.0); 9];
        for e in 0..9 {
            factors[e] = D::splat(stress[e]);
        }
        let one = D::splat(1.0);
        for (block, out) in out.iter_mut().enumerate() {
            // Three sums at once hide the time that each addition takes.
            let mut sums = [D::splat(0.0); 3];
            for e in 0..9 {
                let row = D::load_single(&rows[e * blocks + block]);
                sums[e % 3] = factors[e].fused(row, sums[e % 3]);
            }
            let sum = one.fused(sums[0], sums[1]);
            one.fused(one.fused(sum, sums[2]), D::load(out)).store(out);
        }
    }
}

/// Rows times `share`, in single precision.
#[inline(always)]
fn singles(rows: &[[Lane; 9]; 9], share: Lane) -> [[[f32; LANES]; 9]; 9] {
    let mut out = [[[0.0; LANES]; 9]; 9];
    for (out, row) in out.iter_mut().zip(rows) {
        for (out, x) in out.iter_mut().zip(row) {
            let x = share * *x;
            for (out, x) in out.iter_mut().zip(&x.0) {
                *out = *x as f32;
            }
        }
    }
    out
}

/// Writes combinations of the nine rows of a point with factors of its lane.
#[inline(always)]
unsafe fn combine<L: Lanes>(
    factors: &[[[f32; LANES]; 9]; 9],
    lane: usize,
    of: &[usize],
    rows: &[f32],
    [stride, padded]: [usize; 2],
    outs: &mut [f32],
) {
    let (rows, outs) = (rows.as_chunks::<WIDTH>().0, outs.as_chunks_mut::<WIDTH>().0);
    let (from, blocks) = (stride / WIDTH, padded / WIDTH);
    // SAFETY: The caller has checked for the instruction set.
    unsafe {
        for block in 0..blocks {
            let mut own = [L::splat(0.0); 9];
            for (own, row) in own.iter_mut().zip(rows.chunks_exact(from)) {
                *own = L::load(&row[block]);
            }
            for (&k, outs) in of.iter().zip(outs.chunks_exact_mut(blocks)) {
                let factors = &factors[k];
                let mut sum = L::splat(factors[0][lane]).fused(own[0], L::splat(0.0));
                for e in 1..9 {
                    sum = L::splat(factors[e][lane]).fused(own[e], sum);
                }
                sum.store(&mut outs[block]);
            }
        }
    }
}

/// Adds `sum_k g_k g_k^T` for rows `g_k`: the upper triangle by blocks of columns.
#[inline(always)]
unsafe fn add_squares<L: Lanes>(rows: &[f32], modes: usize, padded: usize, out: &mut [f32]) {
    let blocks = padded / WIDTH;
    let (rows, out) = (rows.as_chunks::<WIDTH>().0, out.as_chunks_mut::<WIDTH>().0);
    for i in (0..modes).step_by(ROWS) {
        let mut block = i / WIDTH;
        // SAFETY: The caller has checked for the instruction set.
        unsafe {
            while L::MANY && block + 3 <= blocks {
                add_tile::<L, 3>(rows, [i, block, blocks], out);
                block += 3;
            }
            while L::MANY && block + 2 <= blocks {
                add_tile::<L, 2>(rows, [i, block, blocks], out);
                block += 2;
            }
            while block < blocks {
                add_tile::<L, 1>(rows, [i, block, blocks], out);
                block += 1;
            }
        }
    }
}

/// Adds to the [`ROWS`] rows from `i` on and to `N` blocks of their columns.
#[inline(always)]
unsafe fn add_tile<L: Lanes, const N: usize>(
    rows: &[[f32; WIDTH]],
    [i, block, blocks]: [usize; 3],
    out: &mut [[f32; WIDTH]],
) {
    let (own, inside) = (i / WIDTH, i % WIDTH);
    // SAFETY: The caller has checked for the instruction set.
    unsafe {
        let mut sums = [[L::splat(0.0); N]; ROWS];
        for row in rows.chunks_exact(blocks) {
            let mut columns = [L::splat(0.0); N];
            for n in 0..N {
                columns[n] = L::load(&row[block + n]);
            }
            for r in 0..ROWS {
                let factor = L::splat(row[own][(inside + r) % WIDTH]);
                for n in 0..N {
                    sums[r][n] = factor.fused(columns[n], sums[r][n]);
                }
            }
        }
        let one = L::splat(1.0);
        for r in 0..ROWS {
            for n in 0..N {
                let out = &mut out[(i + r) * blocks + block + n];
                one.fused(L::load(out), sums[r][n]).store(out);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Material, simd};

    /// Guests and hosts may have other processors.
    #[test]
    fn all_registers_give_the_same_bits() {
        // Miri takes a minute for a few points.
        let (points, modes) = (if cfg!(miri) { 3 } else { 21 }, 37);
        let noise = |i: usize| (i * 7919 % 1009) as f64 / 1009.0 - 0.5;
        let reduced = ReducedElasticity {
            material: Material::NeoHookean,
            weights: (0..points).map(|i| 1.0 + noise(i)).collect(),
            gradients: (0..9 * points * modes).map(|i| noise(i) as f32).collect(),
            mesh: None,
        };
        let omega: Vec<f64> = (0..modes).map(|i| 5.0 + 40.0 * i as f64).collect();
        let law = Material::NeoHookean.with(2e5, 1e5);
        let q: Vec<f64> = (0..modes).map(|i| 0.3 * noise(31 * i + 7)).collect();
        let bits = |run: &dyn Fn(&mut ElasticEnergy)| {
            let mut energy = ElasticEnergy::new(&reduced, law, &omega).unwrap();
            energy.load(&q);
            run(&mut energy);
            let force: Vec<u64> = energy.force.iter().map(|x| x.to_bits()).collect();
            let tangent: Vec<u32> = energy.tangent.iter().map(|x| x.to_bits()).collect();
            (force, tangent, energy.raised)
        };
        let plain = bits(&|energy| simd::with_arrays(Linearize { energy, tangent: true }));
        assert!(plain.2 > 0 && plain.0.iter().any(|&x| x != 0));
        #[cfg(target_arch = "x86_64")]
        {
            let tangent = true;
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: The check above found AVX2 and FMA.
                let run = |energy: &mut ElasticEnergy| unsafe {
                    simd::x86::kernel_avx2(Linearize { energy, tangent })
                };
                assert!(bits(&run) == plain, "AVX2");
            }
            if std::arch::is_x86_feature_detected!("avx512f") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: The check above found AVX-512F and FMA.
                let run = |energy: &mut ElasticEnergy| unsafe {
                    simd::x86::kernel_avx512(Linearize { energy, tangent })
                };
                assert!(bits(&run) == plain, "AVX-512");
            }
        }
    }
}
