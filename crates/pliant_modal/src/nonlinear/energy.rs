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
use crate::{HeldShapes, ModalModel, ModelError, ReducedElasticity};

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
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: The check above found AVX2 and FMA.
                return unsafe { self.energy_avx2(q) };
            }
        }
        self.energy_with(q)
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn energy_avx2(&self, q: &[f64]) -> f64 {
        self.energy_with(q)
    }

    #[inline(always)]
    fn energy_with(&self, q: &[f64]) -> f64 {
        let (q, stride) = (&q[..self.modes.min(q.len())], self.gradients.padded);
        let mut sum = 0.0;
        // A closure would not be compiled for the registers of this function.
        for (weight, rows) in self.points() {
            sum += weight * self.law.energy(&gradient(rows, stride, q));
        }
        sum
    }

    /// Writes the elastic force `dU/dq` at `q`, kg^1/2 m/s^2.
    pub fn force_at(&self, q: &[f64], out: &mut [f64]) {
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: The check above found AVX2 and FMA.
                return unsafe { self.force_at_avx2(q, out) };
            }
        }
        self.force_at_with(q, out);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn force_at_avx2(&self, q: &[f64], out: &mut [f64]) {
        self.force_at_with(q, out);
    }

    #[inline(always)]
    fn force_at_with(&self, q: &[f64], out: &mut [f64]) {
        let (q, stride) = (&q[..self.modes.min(q.len())], self.gradients.padded);
        let given = self.modes.min(out.len());
        let out = &mut out[..given];
        out.fill(0.0);
        for (weight, rows) in self.points() {
            let stress: Matrix3<f64> = weight * self.law.stress(&gradient(rows, stride, q));
            for (stress, row) in stress.iter().zip(rows.chunks_exact(stride)) {
                out.iter_mut().zip(row).for_each(|(out, g)| *out = stress.mul_add(f64::from(*g), *out));
            }
        }
    }

    /// Computes the force alone at `q`. The tangent stays that of the last linearization.
    pub fn compute_force(&mut self, q: &[f64]) {
        self.load(q);
        self.dispatch(false);
    }

    /// Computes force and positive semidefinite tangent at `q`.
    pub fn linearize(&mut self, q: &[f64]) {
        self.load(q);
        self.dispatch(true);
    }

    fn dispatch(&mut self, tangent: bool) {
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx512f") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: The check above found AVX-512F and FMA.
                unsafe { self.linearize_avx512(tangent) };
                return;
            }
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: The check above found AVX2 and FMA.
                unsafe { self.linearize_avx2(tangent) };
                return;
            }
        }
        self.linearize_with(tangent);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f,fma")]
    fn linearize_avx512(&mut self, tangent: bool) {
        self.linearize_with(tangent);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    fn linearize_avx2(&mut self, tangent: bool) {
        self.linearize_with(tangent);
    }

    #[inline(always)]
    fn linearize_with(&mut self, tangent: bool) {
        let (modes, padded, stride) = (self.modes, self.padded, self.gradients.padded);
        let gradients = self.gradients.clone();
        self.force.fill(0.0);
        if tangent {
            self.tangent.fill(0.0);
            self.raised = 0;
        }
        let groups = self.weights.chunks(LANES).zip(gradients.values.chunks(9 * stride * LANES));
        for ((weights, values), scaled) in groups.zip(gradients.scaled.chunks(9 * stride * LANES)) {
            // Lanes beyond the last point are at rest.
            let mut h = [Lane::splat(0.0); 9];
            for (lane, rows) in values.chunks_exact(9 * stride).enumerate() {
                let own = gradient(rows, stride, &self.q);
                h.iter_mut().zip(own.iter()).for_each(|(h, own)| h.0[lane] = *own);
            }
            let stress = self.law.stresses(&h);
            for (lane, (&weight, rows)) in weights.iter().zip(values.chunks_exact(9 * stride)).enumerate() {
                let own = Matrix3::from_fn(|r, c| weight * stress[3 * c + r].0[lane]);
                add_force(&own, rows, stride, &mut self.force);
            }
            if !tangent {
                continue;
            }
            let mut f = h;
            (0..3).for_each(|k| f[4 * k] = f[4 * k] + Lane::splat(1.0));
            let roots = positive_roots(self.law, &f);
            let points = weights.iter().zip(scaled.chunks_exact(9 * stride));
            let mut outs = self.rows.chunks_exact_mut(padded);
            let mut kept = 0;
            for (lane, (&weight, rows)) in points.enumerate() {
                self.raised += usize::from(roots.least.0[lane] < 0.0);
                let share = weight.sqrt();
                let mut factors = [[0.0f32; 9]; 9];
                for (factors, roots) in factors.iter_mut().zip(&roots.rows) {
                    for (factor, root) in factors.iter_mut().zip(roots) {
                        *factor = (share * root.0[lane]) as f32;
                    }
                }
                // Rows of eigenvalues that were raised to zero add nothing.
                for factors in factors.iter().filter(|factors| factors.iter().any(|x| *x != 0.0)) {
                    if let Some(out) = outs.next() {
                        combine(factors, rows, stride, out);
                        kept += 1;
                    }
                }
            }
            add_squares(&self.rows[..padded * kept], modes, padded, &mut self.tangent);
        }
    }
}

/// Displacement gradient of a point, from its rows of `stride` entries, of which `q` may cover the
/// first.
#[inline(always)]
fn gradient(rows: &[f32], stride: usize, q: &[f64]) -> Matrix3<f64> {
    let (rows, (q, tail)) = (rows.as_chunks::<LANES>().0, q.as_chunks::<LANES>());
    let blocks = stride / LANES;
    let mut sums = [[0.0f64; LANES]; 9];
    if !tail.is_empty() {
        for (row, sum) in rows.chunks_exact(blocks).zip(&mut sums) {
            for ((sum, row), q) in sum.iter_mut().zip(&row[q.len()]).zip(tail) {
                *sum = f64::from(*row) * q;
            }
        }
    }
    for (block, q) in q.iter().enumerate() {
        for (e, sum) in sums.iter_mut().enumerate() {
            let row = &rows[e * blocks + block];
            for k in 0..LANES {
                sum[k] = f64::from(row[k]).mul_add(q[k], sum[k]);
            }
        }
    }
    let mut h = Matrix3::zeros();
    for (h, s) in h.iter_mut().zip(&sums) {
        *h = ((s[0] + s[4]) + (s[1] + s[5])) + ((s[2] + s[6]) + (s[3] + s[7]));
    }
    h
}

/// Adds the force of a point with this stress times its weight.
#[inline(always)]
fn add_force(stress: &Matrix3<f64>, rows: &[f32], stride: usize, out: &mut [f64]) {
    let (rows, out) = (rows.as_chunks::<LANES>().0, out.as_chunks_mut::<LANES>().0);
    let blocks = stride / LANES;
    for (block, out) in out.iter_mut().enumerate() {
        let mut sum = *out;
        for e in 0..9 {
            let row = &rows[e * blocks + block];
            for k in 0..LANES {
                sum[k] = stress[e].mul_add(f64::from(row[k]), sum[k]);
            }
        }
        *out = sum;
    }
}

/// Writes the combination of nine rows of a point with these factors.
#[inline(always)]
fn combine(factors: &[f32; 9], rows: &[f32], stride: usize, out: &mut [f32]) {
    let (rows, out) = (rows.as_chunks::<WIDTH>().0, out.as_chunks_mut::<WIDTH>().0);
    let from = stride / WIDTH;
    for (block, out) in out.iter_mut().enumerate() {
        let mut sum = [0.0f32; WIDTH];
        for (e, factor) in factors.iter().enumerate() {
            let row = &rows[e * from + block];
            for k in 0..WIDTH {
                sum[k] = factor.mul_add(row[k], sum[k]);
            }
        }
        *out = sum;
    }
}

/// Adds `sum_k g_k g_k^T` for rows `g_k`: the upper triangle by blocks of columns.
#[inline(always)]
fn add_squares(rows: &[f32], modes: usize, padded: usize, out: &mut [f32]) {
    let blocks = padded / WIDTH;
    let (rows, out) = (rows.as_chunks::<WIDTH>().0, out.as_chunks_mut::<WIDTH>().0);
    for i in (0..modes).step_by(ROWS) {
        let (own, inside) = (i / WIDTH, i % WIDTH);
        for block in own..blocks {
            let mut sums = [[0.0f32; WIDTH]; ROWS];
            for row in rows.chunks_exact(blocks) {
                let (columns, factors) = (&row[block], &row[own]);
                for (r, sum) in sums.iter_mut().enumerate() {
                    let factor = factors[(inside + r) % WIDTH];
                    for k in 0..WIDTH {
                        sum[k] = factor.mul_add(columns[k], sum[k]);
                    }
                }
            }
            for (r, sum) in sums.iter().enumerate() {
                let out = &mut out[(i + r) * blocks + block];
                for k in 0..WIDTH {
                    out[k] += sum[k];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Material;

    /// Guests and hosts may have other processors.
    #[test]
    fn all_registers_give_the_same_bits() {
        let (points, modes) = (21, 37);
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
        let plain = bits(&|energy| energy.linearize_with(true));
        assert!(plain.2 > 0 && plain.0.iter().any(|&x| x != 0));
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: The check above found AVX2 and FMA.
                assert!(bits(&|energy| unsafe { energy.linearize_avx2(true) }) == plain, "AVX2");
            }
            if std::arch::is_x86_feature_detected!("avx512f") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: The check above found AVX-512F and FMA.
                assert!(bits(&|energy| unsafe { energy.linearize_avx512(true) }) == plain, "AVX-512");
            }
        }
    }
}
