//! Computes the lowest modes of `K phi = lambda M phi` by shift-invert block Lanczos.
//!
//! The iteration uses the M-inner product, full reorthogonalization and thick restart (Grimes,
//! Lewis and Simon 1994; Wu and Simon 2000). The operator is `K^-1 M`, whose largest eigenvalues
//! are `1 / lambda`. For a free body K is singular. There `K^-1` is the inertia-relief
//! pseudo-inverse of [`Solver`], and the rigid modes are deflated, so that only elastic modes
//! remain.
//!
//! A block of eight vectors contains eight directions of an eigenspace. Further directions enter
//! only through rounding, which may be too late. Converged modes are therefore counted against the
//! inertia of `K - mu M` (`sturm.rs`). Where modes are missing, the block receives random vectors
//! for them and the iteration continues. The count does not change the result of a body that lacks
//! no mode.

use faer::Mat;

use crate::blocks::{self, Tall};
use crate::solver::Solver;
use crate::sturm::Count;

/// Residual at which every wanted Ritz pair has converged, relative to its own eigenvalue, in the
/// M-norm.
const TOLERANCE: f64 = 4e-9;

/// Relative distance below the last wanted mode at which the modes are counted.
///
/// A mode that is closer to the last mode, directly or through a chain of close modes, is
/// equivalent to the last mode.
const NEAR: f64 = 1e-6;

/// Largest such distance, where rounding demands more than [`NEAR`].
const FAR: f64 = 1e-2;

/// Number of rounds that search for missing modes.
const ROUNDS: usize = 8;

/// Number of degrees of freedom up to which a problem is solved densely. Problems with fewer than
/// three per wanted mode are solved densely as well.
const DENSE: usize = 300;

/// Eigenvalues in ascending order ((rad/s)^2) and M-orthonormal eigenvectors as a block with one
/// column each.
#[derive(Clone, Debug)]
pub(crate) struct Eigenpairs {
    pub(crate) lambda: Vec<f64>,
    pub(crate) phi: Vec<f64>,
}

/// Reason why the eigensolver returns no modes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Failure {
    /// The iteration did not converge, or a small eigenproblem failed.
    NoConvergence,
    /// Modes are missing below `lambda`, and the iteration did not find them.
    Missed { lambda: f64, modes: usize, found: usize },
    /// Floating-point arithmetic cannot decide whether modes are missing below `lambda`.
    Uncounted { lambda: f64 },
}

/// Number of elastic modes below `lambda`, and how many of them the iteration found.
#[derive(Clone, Copy, Debug)]
struct Below {
    lambda: f64,
    modes: usize,
    found: usize,
}

/// Computes the `wanted` lowest elastic modes. `report` receives the progress of the iteration, 0
/// to 1.
pub(crate) fn lowest(
    solver: &Solver,
    wanted: usize,
    report: &mut dyn FnMut(f64),
) -> Result<Eigenpairs, Failure> {
    let n = solver.dofs();
    if n <= DENSE || n < 3 * wanted + 6 {
        return dense(solver, wanted);
    }
    let ritz = Lanczos::new(solver, wanted).run(report)?;
    polish(solver, &ritz, wanted)
}

impl Below {
    fn missed(self) -> Failure {
        Failure::Missed { lambda: self.lambda, modes: self.modes, found: self.found }
    }
}

struct Lanczos<'a> {
    solver: &'a Solver<'a>,
    wanted: usize,
    /// Basis vectors. The storage reserves `stride` columns.
    basis: Vec<f64>,
    stride: usize,
    /// Number of filled columns whose images are known.
    done: usize,
    /// First column that the next image has large parts along: the start of the previous block, or
    /// 0 after a restart.
    coupled: usize,
    /// Projected operator.
    projected: Mat<f64>,
    /// Next block, M-orthonormal to the basis. `width` is its number of columns.
    next: Vec<f64>,
    width: usize,
    seed: u64,
}

/// Converged Ritz vectors and their images under the operator, as blocks of the wanted number of
/// columns.
struct Ritz {
    vectors: Vec<f64>,
    images: Vec<f64>,
}

/// Coefficients of the remainder of one expansion: `next = remainder coefficients^-1`.
struct Remainder {
    coefficients: Mat<f64>,
    width: usize,
}

impl<'a> Lanczos<'a> {
    fn new(solver: &'a Solver<'a>, wanted: usize) -> Self {
        let n = solver.dofs();
        // Wider blocks solve faster and converge later. A width of 8 was the fastest of 4, 8, 12
        // and 16 from 12,000 to 45,000 degrees of freedom. 60 modes take about 250 vectors.
        let block = 8;
        let stride = (5 * wanted + 8 * block).min(n - 6);
        Self {
            solver,
            wanted,
            basis: vec![0.0; n * stride],
            stride,
            done: 0,
            coupled: 0,
            projected: Mat::zeros(stride, stride),
            next: Vec::new(),
            width: block,
            seed: 0x9E37_79B9_7F4A_7C15,
        }
    }

    fn run(mut self, report: &mut dyn FnMut(f64)) -> Result<Ritz, Failure> {
        // Each restart improves the result. More than about a hundred basis vectors per mode mean
        // that something is wrong.
        let most_blocks = 100 + 100 * self.wanted / self.width.max(1);
        self.start()?;
        let mut check_at = 3 * self.wanted;
        // This is the last count that found missing modes.
        let mut missed: Option<Below> = None;
        let mut rounds = 0;
        let mut blocks = 0;
        while blocks < most_blocks {
            blocks += 1;
            let remainder = self.expand()?;
            let full = self.done + self.width > self.stride;
            if self.done < check_at.min(self.stride - self.width) && !full {
                report(0.7 * self.done as f64 / check_at as f64);
                continue;
            }
            let (values, vectors) = self.ritz()?;
            let converged = self.converged(&values, &vectors, &remainder);
            // The small eigenproblem has a cost, so the checks are less frequent while most pairs
            // are far from converged.
            let ahead = if 4 * converged < self.wanted { 3 } else { 1 };
            check_at = self.done + ahead * self.width;
            report(0.7 + 0.3 * converged as f64 / self.wanted as f64);
            // Ritz values approach the operator's eigenvalues from below, so missed modes do not
            // appear at once. The next count waits until enough Ritz values have passed the shift
            // of the last count.
            let appeared = missed.is_none_or(|below| {
                let last = below.modes.min(self.wanted) - 1;
                values[last] * below.lambda * (1.0 + 0.5 * NEAR) >= 1.0
            });
            if converged >= self.wanted && appeared {
                let ritz = self.finish(&values, &vectors, &remainder);
                let below = self.count(&values, &ritz)?;
                if below.modes == below.found {
                    return Ok(ritz);
                }
                if rounds == ROUNDS {
                    return Err(below.missed());
                }
                (rounds, blocks, missed) = (rounds + 1, 0, Some(below));
                self.widen(&values, &vectors, below.modes - below.found)?;
                check_at = self.done + 2 * self.width;
                continue;
            }
            if full {
                let keep = self.keep(self.width)?;
                self.restart(&values, &vectors, keep);
            }
        }
        Err(missed.map_or(Failure::NoConvergence, |below| below.missed()))
    }

    /// Returns the number of Ritz vectors that a restart keeps, with room for two blocks of
    /// `width`.
    fn keep(&self, width: usize) -> Result<usize, Failure> {
        let keep = (self.wanted + width + (self.stride - self.wanted) / 4)
            .min(self.stride.saturating_sub(2 * width))
            .min(self.done);
        if keep < self.wanted { Err(Failure::NoConvergence) } else { Ok(keep) }
    }

    /// Counts the elastic modes below the last wanted mode and its equivalents, and how many of
    /// them were found.
    ///
    /// The shift lies just below these modes, so the count needs no gap above them: a cluster may
    /// extend beyond the wanted modes.
    fn count(&self, values: &[f64], ritz: &Ritz) -> Result<Below, Failure> {
        let rigid = if self.solver.rigid.is_some() { 6 } else { 0 };
        let lambda = |mode: usize| 1.0 / values[mode];
        let mut near = NEAR;
        for _ in 0..4 {
            let mut found = self.wanted - 1;
            while found > 0 && lambda(found - 1) >= (1.0 - 2.0 * near) * lambda(found) {
                found -= 1;
            }
            let shift = (1.0 - near) * lambda(found);
            let counted = Count::new(&self.solver.factor.symbolic, self.solver.matrix, shift);
            let blur =
                counted.as_ref().map_or(f64::INFINITY, |count| count.blur(&ritz.vectors, self.wanted, shift));
            if let Ok(count) = counted
                && blur <= near
                && count.below >= rigid + found
            {
                return Ok(Below { lambda: shift, modes: count.below - rigid, found });
            }
            // Another shift has other pivots. A count below the number of known modes means that
            // rounding is worse than estimated.
            near = if blur.is_finite() { (2.0 * near).max(4.0 * blur) } else { 2.0 * near };
            if near > FAR {
                break;
            }
        }
        Err(Failure::Uncounted { lambda: lambda(self.wanted - 1) })
    }

    /// Restarts with random vectors added to the next block, for eigenvectors that the current
    /// space does not contain.
    ///
    /// The image of the kept vectors lies in the old part of the next block, as in any restart.
    fn widen(&mut self, values: &[f64], vectors: &Mat<f64>, missing: usize) -> Result<(), Failure> {
        // The space must hold the wanted vectors and two blocks. There is no use for more new
        // vectors than wanted modes.
        let room = ((self.stride - self.wanted) / 2).saturating_sub(self.width);
        let fresh = missing.min(self.wanted).max(8).min(room);
        if fresh == 0 {
            return Err(Failure::NoConvergence);
        }
        let keep = self.keep(self.width + fresh)?;
        self.restart(values, vectors, keep);
        let mut block = self.random(fresh);
        // The next block joins the basis temporarily, so that the random vectors become orthogonal
        // to it as well.
        blocks::put(&mut self.basis, self.stride, self.done, &self.next, self.width);
        self.done += self.width;
        self.orthogonalize(&mut block, fresh, 0);
        self.done -= self.width;
        let (block, Remainder { width: fresh, .. }) =
            normalize(self.solver, block, fresh).ok_or(Failure::NoConvergence)?;
        let width = self.width + fresh;
        let mut next = vec![0.0; self.solver.dofs() * width];
        blocks::put(&mut next, width, 0, &self.next, self.width);
        if fresh > 0 {
            blocks::put(&mut next, width, self.width, &block, fresh);
        }
        (self.next, self.width) = (next, width);
        Ok(())
    }

    fn start(&mut self) -> Result<(), Failure> {
        let mut block = self.random(self.width);
        self.orthogonalize(&mut block, self.width, 0);
        let (next, remainder) = normalize(self.solver, block, self.width).ok_or(Failure::NoConvergence)?;
        self.next = next;
        self.width = remainder.width;
        if self.width == 0 { Err(Failure::NoConvergence) } else { Ok(()) }
    }

    /// Returns random vectors without rigid motion.
    fn random(&mut self, width: usize) -> Vec<f64> {
        let mut block = vec![0.0; self.solver.dofs() * width];
        for x in &mut block {
            // The generator is splitmix64 and gives the same start vectors in every run.
            self.seed = self.seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = self.seed;
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            z ^= z >> 31;
            *x = (z >> 11) as f64 / (1u64 << 53) as f64 - 0.5;
        }
        self.solver.remove_rigid(&mut block, width);
        block
    }

    /// Adds the next block to the basis, applies the operator to the block and orthogonalizes the
    /// image.
    fn expand(&mut self) -> Result<Remainder, Failure> {
        let width = self.width;
        let at = self.done;
        blocks::put(&mut self.basis, self.stride, at, &self.next, width);
        self.done += width;
        let mut image = self.solver.operator(&self.next, width);
        let scale = image.iter().map(|x| x * x).sum::<f64>();
        let h = self.orthogonalize(&mut image, width, self.coupled);
        self.coupled = at;
        for j in 0..width {
            for i in 0..self.done {
                self.projected[(i, at + j)] = h[(i, j)];
                self.projected[(at + j, i)] = h[(i, j)];
            }
        }
        for j in 0..width {
            for i in 0..j {
                let mean = 0.5 * (h[(at + i, j)] + h[(at + j, i)]);
                self.projected[(at + i, at + j)] = mean;
                self.projected[(at + j, at + i)] = mean;
            }
        }
        if !scale.is_finite() {
            return Err(Failure::NoConvergence);
        }
        let (next, remainder) = normalize(self.solver, image, width).ok_or(Failure::NoConvergence)?;
        if remainder.width == 0 {
            // The space is invariant, so the iteration continues with new random directions.
            self.width = width;
            self.start()?;
            return Ok(Remainder { coefficients: Mat::zeros(self.width, width), width: self.width });
        }
        self.next = next;
        self.width = remainder.width;
        Ok(remainder)
    }

    /// Makes the block M-orthogonal to the basis and returns the removed coefficients.
    ///
    /// The first pass covers the columns from `coupled` on, where the block has large parts. The
    /// second pass covers all columns, and only rounding is left there. Each large part is
    /// therefore removed twice.
    fn orthogonalize(&self, block: &mut [f64], width: usize, coupled: usize) -> Mat<f64> {
        let mut sum = Mat::zeros(self.done, width);
        if self.done == 0 {
            return sum;
        }
        let mut mass = vec![0.0; block.len()];
        for from in [coupled, 0] {
            let columns = self.done - from;
            let basis = Tall { data: &self.basis, stride: self.stride, from, columns };
            self.solver.matrix.mass_times(block, width, &mut mass);
            let h = blocks::gram(basis, Tall::new(&mass, width));
            blocks::add_product(block, basis, h.as_ref(), -1.0);
            let mut part = sum.as_mut().subrows_mut(from, columns);
            part += h;
        }
        sum
    }

    /// Returns the Ritz values in descending order and their vectors in basis coordinates.
    fn ritz(&self) -> Result<(Vec<f64>, Mat<f64>), Failure> {
        let projected = self.projected.as_ref().submatrix(0, 0, self.done, self.done);
        let (mut values, vectors) = blocks::symmetric_eigen(projected).ok_or(Failure::NoConvergence)?;
        values.reverse();
        let vectors = Mat::from_fn(self.done, self.done, |i, j| vectors[(i, self.done - 1 - j)]);
        Ok((values, vectors))
    }

    /// Returns how many of the leading wanted Ritz pairs have converged.
    fn converged(&self, values: &[f64], vectors: &Mat<f64>, remainder: &Remainder) -> usize {
        let c = &remainder.coefficients;
        let first = self.done - c.ncols();
        (0..self.wanted.min(self.done))
            .take_while(|&k| {
                let mut norm2 = 0.0;
                for i in 0..c.nrows() {
                    let entry: f64 = (0..c.ncols()).map(|j| c[(i, j)] * vectors[(first + j, k)]).sum();
                    norm2 += entry * entry;
                }
                values[k] > 0.0 && norm2.sqrt() <= TOLERANCE * values[k]
            })
            .count()
    }

    /// Returns the Ritz vectors `V s` and their images `theta V s + next (coefficients s_last)`,
    /// which need no further solve.
    fn finish(&self, values: &[f64], vectors: &Mat<f64>, remainder: &Remainder) -> Ritz {
        let wanted = self.wanted;
        let phi = self.combine(vectors, wanted);
        let c = &remainder.coefficients;
        let last = vectors.as_ref().submatrix(self.done - c.ncols(), 0, c.ncols(), wanted);
        let mut images: Vec<f64> = phi
            .chunks_exact(wanted)
            .flat_map(|row| row.iter().zip(values).map(|(x, theta)| theta * x))
            .collect();
        let rest = c * last;
        blocks::add_product(&mut images, Tall::new(&self.next, self.width), rest.as_ref(), 1.0);
        Ritz { vectors: phi, images }
    }

    fn combine(&self, vectors: &Mat<f64>, count: usize) -> Vec<f64> {
        let basis = Tall { data: &self.basis, stride: self.stride, from: 0, columns: self.done };
        blocks::product(basis, vectors.as_ref().subcols(0, count))
    }

    /// Keeps the leading Ritz vectors as the new basis.
    ///
    /// Their coupling with the next block results from the full orthogonalization of that block.
    fn restart(&mut self, values: &[f64], vectors: &Mat<f64>, keep: usize) {
        let kept = self.combine(vectors, keep);
        blocks::put(&mut self.basis, self.stride, 0, &kept, keep);
        self.projected.fill(0.0);
        for (i, value) in values.iter().enumerate().take(keep) {
            self.projected[(i, i)] = *value;
        }
        self.done = keep;
        self.coupled = 0;
    }
}

/// M-orthonormalizes the columns of a block among themselves and drops linearly dependent columns.
///
/// The result satisfies `block = result coefficients`. Returns `None` when the small eigenproblem
/// fails.
fn normalize(solver: &Solver, mut block: Vec<f64>, width: usize) -> Option<(Vec<f64>, Remainder)> {
    let mut coefficients = Mat::<f64>::identity(width, width);
    let mut columns = width;
    for _ in 0..2 {
        let mut mass = vec![0.0; block.len()];
        solver.matrix.mass_times(&block, columns, &mut mass);
        let gram = blocks::gram(Tall::new(&block, columns), Tall::new(&mass, columns));
        let (values, vectors) = blocks::symmetric_eigen(gram.as_ref())?;
        let largest = values.last().copied().unwrap_or(0.0);
        let keep: Vec<usize> =
            (0..columns).filter(|&i| values[i] > 1e-26 * largest && values[i] > 0.0).collect();
        let turn = Mat::from_fn(columns, keep.len(), |i, j| vectors[(i, keep[j])] / values[keep[j]].sqrt());
        let back = Mat::from_fn(keep.len(), columns, |i, j| vectors[(j, keep[i])] * values[keep[i]].sqrt());
        block = blocks::product(Tall::new(&block, columns), turn.as_ref());
        coefficients = back * coefficients;
        columns = keep.len();
        if columns == 0 {
            break;
        }
    }
    Some((block, Remainder { coefficients, width: columns }))
}

/// Does one step of inverse subspace iteration, `x = K^-1 M phi`, and a Rayleigh-Ritz projection.
///
/// The step damps the remaining high modes, which the stiffness would amplify in the residual
/// `K phi - lambda M phi`. The iteration has already computed `x`.
fn polish(solver: &Solver, ritz: &Ritz, wanted: usize) -> Result<Eigenpairs, Failure> {
    let mut loads = vec![0.0; ritz.vectors.len()];
    solver.matrix.mass_times(&ritz.vectors, wanted, &mut loads);
    let x = &ritz.images;
    // Since K x = M phi, x^T K x = x^T M phi needs no product with the stiffness.
    let tall = Tall::new(x, wanted);
    let stiffness = blocks::gram(tall, Tall::new(&loads, wanted));
    let mut mass_x = vec![0.0; x.len()];
    solver.matrix.mass_times(x, wanted, &mut mass_x);
    let mass = blocks::gram(tall, Tall::new(&mass_x, wanted));
    let (lambda, turn) = generalized(stiffness, mass).ok_or(Failure::NoConvergence)?;
    Ok(Eigenpairs { lambda, phi: blocks::product(tall, turn.as_ref()) })
}

/// Solves `A y = lambda B y` for small symmetric A and positive definite B. The eigenvalues are
/// ascending and `Y^T B Y = I`.
fn generalized(a: Mat<f64>, b: Mat<f64>) -> Option<(Vec<f64>, Mat<f64>)> {
    let n = a.nrows();
    // The columns of inverse iteration differ in length as 1 / lambda, so they are scaled first.
    let scale: Vec<f64> = (0..n).map(|i| 1.0 / b[(i, i)].sqrt()).collect();
    let scaled =
        |m: &Mat<f64>| Mat::from_fn(n, n, |i, j| 0.5 * (m[(i, j)] + m[(j, i)]) * scale[i] * scale[j]);
    let (values, vectors) = blocks::symmetric_eigen(scaled(&b).as_ref())?;
    if !values.iter().all(|&v| v > 0.0) {
        return None;
    }
    let root = Mat::from_fn(n, n, |i, j| vectors[(i, j)] / values[j].sqrt());
    let reduced = root.transpose() * scaled(&a) * &root;
    let symmetric = Mat::from_fn(n, n, |i, j| 0.5 * (reduced[(i, j)] + reduced[(j, i)]));
    let (lambda, y) = blocks::symmetric_eigen(symmetric.as_ref())?;
    let turned = root * y;
    Some((lambda, Mat::from_fn(n, n, |i, j| scale[i] * turned[(i, j)])))
}

/// Computes all modes of a small problem and keeps the lowest elastic ones. The rigid modes of a
/// free body come first and are dropped.
fn dense(solver: &Solver, wanted: usize) -> Result<Eigenpairs, Failure> {
    let n = solver.dofs();
    let mut identity = vec![0.0; n * n];
    identity.iter_mut().step_by(n + 1).for_each(|x| *x = 1.0);
    let (mut k, mut m) = (vec![0.0; n * n], vec![0.0; n * n]);
    solver.matrix.stiffness_times(&identity, n, &mut k);
    solver.matrix.mass_times(&identity, n, &mut m);
    let stiffness = Mat::from_fn(n, n, |i, j| k[i * n + j]);
    let mass = Mat::from_fn(n, n, |i, j| m[i * n + j]);
    let (lambda, y) = generalized(stiffness, mass).ok_or(Failure::NoConvergence)?;
    let skip = if solver.rigid.is_some() { 6 } else { 0 };
    let mut phi = Vec::with_capacity(n * wanted);
    for i in 0..n {
        phi.extend((skip..skip + wanted).map(|j| y[(i, j)]));
    }
    Ok(Eigenpairs { lambda: lambda[skip..skip + wanted].to_vec(), phi })
}

#[cfg(test)]
#[path = "lanczos_tests.rs"]
mod tests;
