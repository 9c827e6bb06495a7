//! The paper's scheme as printed: average acceleration, hands as rigid position constraints (its
//! eq. 4), and the warp's rotation taken from the last step. The scheme has no compliance, no
//! Newton correction and no regularization.

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};
use pliant_modal::{Coefficients, Integrator, ModalModel, Patch, StepError, warp_jacobian};

use super::bodies::ringing;

/// The reason why the scheme cannot continue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Broken {
    /// The constraint system has no solution, or the solver's result does not solve it.
    Singular,
    /// A number is no longer finite.
    NotFinite,
}

/// A body stepped by the paper's scheme.
pub(super) struct Plain {
    coefficients: Vec<Coefficients>,
    state: Vec<[f64; 3]>,
    force: Vec<f64>,
    hands: Vec<PlainHand>,
}

struct PlainHand {
    rest: Vector3<f64>,
    displacement: Vec<Vector3<f64>>,
    rotation: Vec<Vector3<f64>>,
}

impl Plain {
    pub(super) fn new(model: &ModalModel, step: f64, patches: &[Patch]) -> Result<Self, StepError> {
        let modes = model.mode_count();
        let coefficients = (0..modes)
            .map(|i| Coefficients::new(Integrator::Newmark, model.omega()[i], model.damping()[i], step))
            .collect::<Result<_, _>>()?;
        let hands = patches.iter().map(|patch| PlainHand::new(model, patch)).collect();
        Ok(Self { coefficients, state: vec![[0.0; 3]; modes], force: vec![0.0; modes], hands })
    }

    /// Positions at which the hands began to hold.
    pub(super) fn starts(&self) -> Vec<Vector3<f64>> {
        self.hands.iter().map(|hand| hand.rest).collect()
    }

    /// Takes one step with the hands exactly at their targets. Returns the reactions (N).
    pub(super) fn step(&mut self, targets: &[Vector3<f64>]) -> Result<Vec<Vector3<f64>>, Broken> {
        let q: Vec<f64> = self.state.iter().map(|s| s[0]).collect();
        let free: Vec<[f64; 3]> = self
            .coefficients
            .iter()
            .zip(&self.state)
            .zip(&self.force)
            .map(|((c, s), f)| c.step(*s, *f, 0.0))
            .collect();
        let turned: Vec<Vec<Vector3<f64>>> = self.hands.iter().map(|hand| hand.rows(&q)).collect();
        let n = 3 * self.hands.len();
        let mut matrix = DMatrix::zeros(n, n);
        let mut right = DVector::zeros(n);
        for (g, a) in turned.iter().enumerate() {
            let at = a.iter().zip(&free).fold(self.hands[g].rest, |p, (row, s)| p + row * s[0]);
            for k in 0..3 {
                right[3 * g + k] = targets[g][k] - at[k];
            }
            for (h, b) in turned.iter().enumerate() {
                let block = a
                    .iter()
                    .zip(b)
                    .zip(&self.coefficients)
                    .fold(Matrix3::zeros(), |sum, ((a, b), c)| sum + c.response[0] * a * b.transpose());
                for i in 0..3 {
                    for j in 0..3 {
                        matrix[(3 * g + i, 3 * h + j)] = block[(i, j)];
                    }
                }
            }
        }
        let pulls = matrix.clone().lu().solve(&right).ok_or(Broken::Singular)?;
        let left = (&matrix * &pulls - &right).norm();
        if !left.is_finite() {
            return Err(Broken::NotFinite);
        }
        if left > 1e-6 * right.norm() {
            return Err(Broken::Singular);
        }
        for (i, c) in self.coefficients.iter().enumerate() {
            let pull: f64 = turned
                .iter()
                .enumerate()
                .map(|(g, rows)| (0..3).map(|k| rows[i][k] * pulls[3 * g + k]).sum::<f64>())
                .sum();
            self.state[i] = std::array::from_fn(|k| free[i][k] + c.response[k] * pull);
            self.force[i] = pull;
        }
        if !self.state.iter().flatten().all(|x| x.is_finite()) {
            return Err(Broken::NotFinite);
        }
        Ok((0..self.hands.len()).map(|g| Vector3::from_fn(|k, _| -pulls[3 * g + k])).collect())
    }
}

impl PlainHand {
    fn new(model: &ModalModel, patch: &Patch) -> Self {
        let modes = model.mode_count();
        let mut hand = Self {
            rest: Vector3::zeros(),
            displacement: vec![Vector3::zeros(); modes],
            rotation: vec![Vector3::zeros(); modes],
        };
        for &(vertex, weight) in patch.entries() {
            hand.rest += weight * Vector3::from(model.surface().positions()[vertex as usize].map(f64::from));
            for mode in 0..modes {
                for axis in 0..3 {
                    hand.displacement[mode][axis] +=
                        weight * f64::from(model.displacement_row(vertex, axis, mode));
                    hand.rotation[mode][axis] += weight * f64::from(model.rotation_row(vertex, axis, mode));
                }
            }
        }
        hand
    }

    /// `R~ Phi` of the patch, with the rotation at `q`.
    fn rows(&self, q: &[f64]) -> Vec<Vector3<f64>> {
        let w = self.rotation.iter().zip(q).fold(Vector3::zeros(), |w, (psi, q)| w + psi * *q);
        let (_, turn, _) = warp_jacobian(w.into(), [0.0; 3]);
        let turn = Matrix3::from_fn(|i, j| turn[i][j]);
        self.displacement.iter().map(|phi| turn * phi).collect()
    }
}

/// Runs a script and describes the result in words. `away(step)` is the displacement of each hand
/// from the start of its grab, m.
pub(super) fn beside(
    model: &ModalModel,
    step: f64,
    patches: &[Patch],
    steps: usize,
    away: impl Fn(usize) -> Vec<[f64; 3]>,
) -> Result<String, StepError> {
    let mut plain = Plain::new(model, step, patches)?;
    let starts = plain.starts();
    let mut forces = Vec::with_capacity(steps);
    for i in 0..steps {
        let targets: Vec<_> = starts.iter().zip(away(i)).map(|(s, a)| s + Vector3::from(a)).collect();
        match plain.step(&targets) {
            Ok(reactions) => forces.push(reactions.first().copied().unwrap_or_default()),
            Err(Broken::Singular) => {
                return Ok(format!("stops at step {i}: its constraints have no solution"));
            }
            Err(Broken::NotFinite) => return Ok(format!("overflows at step {i}")),
        }
    }
    let rings = ringing(&forces);
    let peak = |part: &[Vector3<f64>]| part.iter().fold(0.0f64, |m, f| m.max(f.norm()));
    let half = forces.len() / 2;
    let grown = peak(&forces[half..]) / peak(&forces[..half]).max(f64::MIN_POSITIVE);
    let flips = if rings > 2.0 { ", the force flips its sign from step to step" } else { "" };
    let grows = if grown > 1.5 {
        format!(", and is {grown:.1} times as large in the second half")
    } else {
        String::new()
    };
    Ok(format!("ringing {rings:.3}{flips}{grows}"))
}
