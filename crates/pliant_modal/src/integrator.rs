//! One step of one mode, `q'' + c q' + omega^2 q = f`, as a linear recurrence.
//!
//! All integrators use the same kernel with different coefficients. The new state is a linear
//! function of the old state plus a response to the force at the new time. A constraint needs only
//! the response.

use crate::StepError;

/// Time integration method of the modes.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub enum Integrator {
    /// The closed form of the oscillator, exact if the force is constant over the step. This is the
    /// default. It has no period error at any step length.
    #[default]
    Exact,
    /// Newmark's method (beta = 1/4, gamma = 1/2: average acceleration), as in Tang et al. 2013.
    ///
    /// It adds no damping of its own. Its period error is `(omega h / 2) / atan(omega h / 2)`.
    Newmark,
    /// Generalized-alpha (Chung and Hulbert 1993), of second order.
    ///
    /// Of infinitely fast modes only `rho_inf` is left after a step. This is the method whose
    /// accelerations are streamed.
    GeneralizedAlpha {
        /// Spectral radius at infinite frequency, 0 to 1. A value of 1 conserves fast modes, 0
        /// removes them in one step. A value of 0.5 suits hands.
        rho_inf: f64,
    },
}

impl Integrator {
    /// Returns Newmark's `(beta, gamma)`.
    ///
    /// A step obeys `v1 = v0 + h ((1 - gamma) a0 + gamma a1)` and
    /// `q1 = q0 + h v0 + h^2 ((1/2 - beta) a0 + beta a1)`. Returns `None` for
    /// [`Integrator::Exact`], whose accelerations do not integrate to its state.
    pub fn newmark(self) -> Option<(f64, f64)> {
        match self {
            Self::Exact => None,
            Self::Newmark => Some((0.25, 0.5)),
            Self::GeneralizedAlpha { rho_inf: r } => {
                let (am, af) = ((2.0 * r - 1.0) / (r + 1.0), r / (r + 1.0));
                let gamma = 0.5 + af - am;
                Some(((gamma + 0.5).powi(2) / 4.0, gamma))
            }
        }
    }
}

/// The recurrence of one mode for one step length.
///
/// ```text
/// [q1]   [      ] [q0]
/// [v1] = [ free ] [v0] + response f1        free: 3 x 4, response: 3
/// [a1]   [      ] [a0]
///                 [f0]
/// ```
/// `f0` and `f1` are the modal forces at the old and the new time. [`Integrator::Exact`] takes `f1`
/// as constant over the step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coefficients {
    /// Factors on the old state. Rows: `q`, `v`, `a`. Columns: `q0`, `v0`, `a0`, `f0`.
    pub free: [[f64; 4]; 3],
    /// Change of `q`, `v`, `a` per unit modal force at the new time.
    pub response: [f64; 3],
}

impl Coefficients {
    /// Computes the coefficients for a mode of angular frequency `omega` (rad/s, 0 or more) and
    /// damping coefficient `c` (1/s, 0 or more) at step length `h` (s).
    ///
    /// # Errors
    /// Returns an error if a number is not finite or out of range.
    pub fn new(integrator: Integrator, omega: f64, c: f64, h: f64) -> Result<Self, StepError> {
        StepError::check("omega", "finite rad/s, 0 or more", omega.is_finite() && omega >= 0.0, omega)?;
        StepError::check("damping coefficient", "finite 1/s, 0 or more", c.is_finite() && c >= 0.0, c)?;
        StepError::check("step", "finite seconds above 0", h.is_finite() && h > 0.0, h)?;
        let made = match integrator {
            Integrator::Exact => Self::exact(omega, c, h),
            Integrator::Newmark => Self::alpha(omega, c, h, 0.0, 0.0, 0.25, 0.5),
            Integrator::GeneralizedAlpha { rho_inf: r } => {
                StepError::check("rho_inf", "0 to 1", (0.0..=1.0).contains(&r), r)?;
                let (am, af) = ((2.0 * r - 1.0) / (r + 1.0), r / (r + 1.0));
                let gamma = 0.5 + af - am;
                Self::alpha(omega, c, h, am, af, (gamma + 0.5).powi(2) / 4.0, gamma)
            }
        };
        // The square of an absurd frequency (1e200 rad/s) overflows. This must be an error instead
        // of NaN.
        let finite = made.free.iter().flatten().chain(&made.response).all(|x| x.is_finite());
        StepError::check("omega", "a frequency whose square is finite", finite, omega)?;
        Ok(made)
    }

    /// Computes the coefficients of the linear part of reduced elasticity.
    ///
    /// Coordinates up to `omega h = 1` are stepped by [`Integrator::Exact`], so that they ring on.
    /// Faster ones are stepped by backward Euler, as their exact response to a force comes to
    /// nothing at `omega h = 2 pi`, and a held body would ring.
    ///
    /// # Errors
    /// Returns an error if a number is not finite or out of range.
    pub fn reduced(omega: f64, c: f64, h: f64) -> Result<Self, StepError> {
        let exact = Self::new(Integrator::Exact, omega, c, h)?;
        if omega * h <= 1.0 {
            return Ok(exact);
        }
        let k = omega * omega;
        let r = h * h / (1.0 + c * h + k * h * h);
        let q = [(1.0 / (h * h) + c / h) * r, r / h, 0.0, 0.0];
        let v = [(q[0] - 1.0) / h, q[1] / h, 0.0, 0.0];
        let a = [v[0] / h, (v[1] - 1.0) / h, 0.0, 0.0];
        Ok(Self { free: [q, v, a], response: [r, r / h, r / (h * h)] })
    }

    fn exact(omega: f64, c: f64, h: f64) -> Self {
        let k = omega * omega;
        let sigma = 0.5 * c;
        let delta = (omega - sigma) * (omega + sigma);
        let x = delta.abs() * h * h;
        // ec = exp(-sigma h) cosh|cos(sqrt|delta| h),
        // es = exp(-sigma h) sinh|sin(..)/sqrt|delta|.
        // r is the integral of es from 0 to h.
        let (ec, es);
        let mut r;
        if x < 1e-8 {
            // At and near critical damping both closed forms divide zero by zero.
            let e = (-sigma * h).exp();
            ec = e * (1.0 - 0.5 * delta * h * h);
            es = e * h * (1.0 - delta * h * h / 6.0);
            r = if sigma * h < 1e-2 { f64::NAN } else { (1.0 - (ec + sigma * es)) / k };
        } else if delta > 0.0 {
            let w = delta.sqrt();
            let e = (-sigma * h).exp();
            ec = e * (w * h).cos();
            es = e * (w * h).sin() / w;
            r = (1.0 - (ec + sigma * es)) / k;
        } else {
            let w = (-delta).sqrt();
            let (slow, fast) = (-k / (sigma + w), -(sigma + w));
            let (e1, e2) = ((slow * h).exp(), (fast * h).exp());
            ec = 0.5 * (e1 + e2);
            es = 0.5 * (e1 - e2) / w;
            let one = |rate: f64| if rate == 0.0 { h } else { (rate * h).exp_m1() / rate };
            r = (one(slow) - one(fast)) / (2.0 * w);
        }
        if omega * h < 1e-2 && sigma * h < 1e-2 {
            // 1 - a cancels here. The Taylor series of the impulse response b(s) is integrated
            // instead, with b'' = -c b' - k b, b(0) = 0, b'(0) = 1.
            let derivatives = {
                let mut b = [0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
                for i in 2..b.len() {
                    b[i] = -c * b[i - 1] - k * b[i - 2];
                }
                b
            };
            let (mut power, mut factorial) = (h, 1.0);
            r = 0.0;
            for (i, b) in derivatives.iter().enumerate().skip(1) {
                power *= h;
                factorial *= (i + 1) as f64;
                r += b * power / factorial;
            }
        }
        let q = [ec + sigma * es, es, 0.0, 0.0];
        let v = [-k * es, ec - sigma * es, 0.0, 0.0];
        let response = [r, es];
        // a1 = f1 - c v1 - k q1, so that the acceleration matches the new state.
        let a = [-c * v[0] - k * q[0], -c * v[1] - k * q[1], 0.0, 0.0];
        Self {
            free: [q, v, a],
            response: [response[0], response[1], 1.0 - c * response[1] - k * response[0]],
        }
    }

    fn alpha(omega: f64, c: f64, h: f64, am: f64, af: f64, beta: f64, gamma: f64) -> Self {
        let k = omega * omega;
        let d = (1.0 - am) + (1.0 - af) * (c * gamma * h + k * beta * h * h);
        // This solves the following equation for a1:
        // (1 - am) a1 + am a0 + (1 - af)(c v1 + k q1) + af (c v0 + k q0) = (1 - af) f1 + af f0.
        let a = [
            -k / d,
            -(c + (1.0 - af) * k * h) / d,
            -(am + (1.0 - af) * (c * h * (1.0 - gamma) + k * h * h * (0.5 - beta))) / d,
            af / d,
        ];
        let r = (1.0 - af) / d;
        let (bh, gh) = (beta * h * h, gamma * h);
        let q = [1.0 + bh * a[0], h + bh * a[1], h * h * (0.5 - beta) + bh * a[2], bh * a[3]];
        let v = [gh * a[0], 1.0 + gh * a[1], h * (1.0 - gamma) + gh * a[2], gh * a[3]];
        Self { free: [q, v, a], response: [bh * r, gh * r, r] }
    }

    /// Returns the state after one step from `[q0, v0, a0]` with old force `f0` and new force `f1`.
    #[inline]
    pub fn step(&self, state: [f64; 3], f0: f64, f1: f64) -> [f64; 3] {
        std::array::from_fn(|i| {
            let row = &self.free[i];
            row[0] * state[0] + row[1] * state[1] + row[2] * state[2] + row[3] * f0 + self.response[i] * f1
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Classical Runge-Kutta integration with very many substeps, as an independent reference.
    fn reference(omega: f64, c: f64, h: f64, f: f64, mut q: f64, mut v: f64) -> [f64; 2] {
        let n = 40_000;
        let dt = h / f64::from(n);
        let acc = |q: f64, v: f64| f - c * v - omega * omega * q;
        for _ in 0..n {
            let (k1q, k1v) = (v, acc(q, v));
            let (k2q, k2v) = (v + 0.5 * dt * k1v, acc(q + 0.5 * dt * k1q, v + 0.5 * dt * k1v));
            let (k3q, k3v) = (v + 0.5 * dt * k2v, acc(q + 0.5 * dt * k2q, v + 0.5 * dt * k2v));
            let (k4q, k4v) = (v + dt * k3v, acc(q + dt * k3q, v + dt * k3v));
            q += dt * (k1q + 2.0 * k2q + 2.0 * k3q + k4q) / 6.0;
            v += dt * (k1v + 2.0 * k2v + 2.0 * k3v + k4v) / 6.0;
        }
        [q, v]
    }

    #[test]
    fn exact_step_is_exact_whatever_the_damping() {
        let h = 0.025;
        for (omega, zeta) in [
            (0.001, 0.0),
            (30.0, 0.0),
            (30.0, 0.05),
            (30.0, 0.999_999_99),
            (30.0, 1.0),
            (30.0, 1.000_1),
            (30.0, 7.0),
            (900.0, 0.02),
            (0.05, 3.0),
        ] {
            let c = 2.0 * zeta * omega;
            let got =
                Coefficients::new(Integrator::Exact, omega, c, h).unwrap().step([0.3, -2.0, 0.0], 0.0, 5.0);
            let want = reference(omega, c, h, 5.0, 0.3, -2.0);
            assert!(
                (got[0] - want[0]).abs() < 1e-10,
                "q at omega {omega}, zeta {zeta}: {} and {}",
                got[0],
                want[0]
            );
            assert!(
                (got[1] - want[1]).abs() < 1e-8,
                "v at omega {omega}, zeta {zeta}: {} and {}",
                got[1],
                want[1]
            );
            assert!((got[2] - (5.0 - c * got[1] - omega * omega * got[0])).abs() < 1e-7);
        }
    }

    #[test]
    fn exact_static_limit_of_stiff_modes() {
        // The mode is over-damped and far faster than the step, so `q = f / omega^2` tracks the
        // force.
        let c = Coefficients::new(Integrator::Exact, 1e7, 2e8, 0.025).unwrap();
        assert!((c.response[0] * 1e14 - 1.0).abs() < 1e-9, "{}", c.response[0] * 1e14);
    }

    #[test]
    fn newmark_period_error_is_the_known_one() {
        // One step of average acceleration turns the phase by 2 atan(omega h / 2). The trace of the
        // step is twice the cosine of this angle.
        let (omega, h) = (2.0 * std::f64::consts::PI * 5.0, 1.0 / 40.0);
        let c = Coefficients::new(Integrator::Newmark, omega, 0.0, h).unwrap();
        let k = -omega * omega;
        // Eliminate a0 = -omega^2 q0 to get the 2 x 2 map.
        let trace = (c.free[0][0] + c.free[0][2] * k) + c.free[1][1];
        let phase = 2.0 * (0.5 * omega * h).atan();
        assert!((trace - 2.0 * phase.cos()).abs() < 1e-12, "{trace} and {}", 2.0 * phase.cos());
    }

    #[test]
    fn generalized_alpha_forgets_infinite_frequencies_at_rho() {
        for rho in [0.0, 0.3, 0.5, 0.9, 1.0] {
            let c = Coefficients::new(Integrator::GeneralizedAlpha { rho_inf: rho }, 1e9, 0.0, 0.01).unwrap();
            // The state (q, h v, h^2 a) has comparable entries.
            let h = 0.01f64;
            let scale = [1.0, h, h * h];
            let m = nalgebra::Matrix3::from_fn(|i, j| c.free[i][j] * scale[i] / scale[j]);
            let radius = m.complex_eigenvalues().iter().map(|z| z.norm()).fold(0.0, f64::max);
            // The eigenvalue is (nearly) triple, so rounding enters as its cube root,
            // `(1e-16)^(1/3) = 5e-6`, times the conditioning.
            assert!((radius - rho).abs() < 1e-4, "rho {rho}: {radius}");
        }
    }

    #[test]
    fn newmark_identities_hold() {
        for integrator in [Integrator::Newmark, Integrator::GeneralizedAlpha { rho_inf: 0.5 }] {
            let (beta, gamma) = integrator.newmark().unwrap();
            let h = 0.02;
            let c = Coefficients::new(integrator, 40.0, 1.5, h).unwrap();
            let (s0, f0, f1) = ([0.2, -1.0, 7.0], 3.0, -2.0);
            let s1 = c.step(s0, f0, f1);
            assert!((s1[1] - (s0[1] + h * ((1.0 - gamma) * s0[2] + gamma * s1[2]))).abs() < 1e-13);
            assert!(
                (s1[0] - (s0[0] + h * s0[1] + h * h * ((0.5 - beta) * s0[2] + beta * s1[2]))).abs() < 1e-14
            );
        }
    }

    #[test]
    fn absurd_numbers_are_refused() {
        for (omega, c, h) in [
            (f64::NAN, 0.0, 0.1),
            (1.0, f64::INFINITY, 0.1),
            (1.0, -1.0, 0.1),
            (1.0, 0.0, 0.0),
            (1e200, 0.0, 0.1),
        ] {
            assert!(Coefficients::new(Integrator::Exact, omega, c, h).is_err());
        }
        assert!(Coefficients::new(Integrator::GeneralizedAlpha { rho_inf: 2.0 }, 1.0, 0.0, 0.1).is_err());
    }
}
