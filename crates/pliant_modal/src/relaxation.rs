//! Viscoelastic bodies: every mode is a standard linear solid.

use crate::{Coefficients, Integrator, StepError, exponential::exponential};

/// A relaxing material: the standard linear solid (Zener) with one relaxation time.
///
/// The solid is a spring beside a Maxwell branch (a spring and a dashpot in series). The baked
/// Young's modulus `E` is the instantaneous one. Under a strain held for long, `(1 - ratio) E` is
/// left.
///
/// ```text
/// q'' + c q' + omega^2 (q - ratio z) = f        z: the viscoelastic state, how far the dashpot has gone
/// time z' = q - z
/// ```
///
/// Here `z` is the viscoelastic state of the mode. The stress under a held strain
/// falls as [`modulus`](Self::modulus), and the strain under a held stress grows as
/// [`creep`](Self::creep). The branch stores `ratio omega^2 (q - z)^2 / 2` and loses
/// `ratio omega^2 (q - z)^2 / time`.
///
/// Source: C. Zener, *Elasticity and Anelasticity of Metals*, 1948; R. M. Christensen, *Theory of
/// Viscoelasticity*, 2nd ed. 1982, ch. 1.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Relaxation {
    /// Share of the instantaneous stiffness that relaxes away, 0 or more and below 1. At 1 the body
    /// would be a fluid and flow forever.
    pub ratio: f64,
    /// Relaxation time under a held strain, s, above 0.
    pub time: f64,
}

/// A material that relaxes by nothing (ratio 0), within a second.
impl Default for Relaxation {
    fn default() -> Self {
        Self { ratio: 0.0, time: 1.0 }
    }
}

impl Relaxation {
    /// Checks both values.
    ///
    /// # Errors
    /// Returns an error if the ratio is outside `[0, 1)` or the time is not finite or not above 0.
    pub fn check(&self) -> Result<(), StepError> {
        let Self { ratio, time } = *self;
        StepError::check("relaxation ratio", "0 or more, below 1", (0.0..1.0).contains(&ratio), ratio)?;
        StepError::check("relaxation time", "finite seconds above 0", time.is_finite() && time > 0.0, time)
    }

    /// Relaxation modulus: the stress at `t` s after a unit step of strain, as a share of the
    /// instantaneous stress.
    ///
    /// It is `1 - ratio (1 - exp(-t / time))`.
    pub fn modulus(&self, t: f64) -> f64 {
        1.0 + self.ratio * (-t / self.time).exp_m1()
    }

    /// Creep compliance: the strain at `t` s after a unit step of stress, as a multiple of the
    /// instantaneous strain.
    ///
    /// It is `(1 - ratio exp(-(1 - ratio) t / time)) / (1 - ratio)`.
    pub fn creep(&self, t: f64) -> f64 {
        let left = 1.0 - self.ratio;
        1.0 - self.ratio * (-left * t / self.time).exp_m1() / left
    }

    /// Weights of `z0`, `q0` and `q1` in the viscoelastic state after a step of `h` s, over which
    /// the coordinate moves linearly from `q0` to `q1`. They add up to 1.
    ///
    /// ```text
    /// z1 = e^-x z0 + (g - e^-x) q0 + (1 - g) q1,   x = h / time, g = (1 - e^-x) / x
    /// ```
    pub fn linear_weights(&self, h: f64) -> [f64; 3] {
        let x = h / self.time;
        let gone = -(-x).exp_m1();
        // The closed form loses all digits of the last weight for small x.
        let new = if x < 1e-3 {
            x * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0 - x / 120.0)))
        } else {
            1.0 - gone / x
        };
        [(-x).exp(), gone - new, new]
    }

    /// Storage and loss modulus at `omega` rad/s, as shares of the instantaneous modulus.
    ///
    /// They are `1 - ratio / (1 + x^2)` and `ratio x / (1 + x^2)` with `x = omega time`.
    pub fn complex_modulus(&self, omega: f64) -> [f64; 2] {
        let x = omega * self.time;
        // The form x / (1 + x^2) is avoided for large x because the square may overflow.
        let share = if x > 1.0 { self.ratio / (x + 1.0 / x) } else { self.ratio * x / (1.0 + x * x) };
        let lost = if x > 0.0 { share / x } else { self.ratio };
        [1.0 - lost, share]
    }
}

/// Terms that the viscoelastic state `z` adds to the recurrence of a mode. [`Coefficients`] holds
/// the other terms.
///
/// ```text
/// [q1 v1 a1] = Coefficients + onto z0
/// z1         = free [q0 v0 a0 f0] + carry z0 + response f1
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViscoelasticCoefficients {
    /// Change of the new `q`, `v`, `a` per unit of the old `z`.
    pub onto: [f64; 3],
    /// Factors of the old `q`, `v`, `a` and modal force in the new `z`.
    pub free: [f64; 4],
    /// Factor of the old `z` in the new `z`.
    pub carry: f64,
    /// Change of the new `z` per unit modal force at the new time.
    pub response: f64,
}

impl ViscoelasticCoefficients {
    /// Returns `z` after one step from `[q0, v0, a0]` and `z0`, with old force `f0` and new force
    /// `f1`.
    #[inline]
    pub fn step(&self, state: [f64; 3], z0: f64, f0: f64, f1: f64) -> f64 {
        let [q, v, a, f] = self.free;
        q * state[0] + v * state[1] + a * state[2] + f * f0 + self.carry * z0 + self.response * f1
    }
}

/// Largest `rate x step` of a relaxing mode. The phase of a faster mode has no correct digits left.
const FASTEST: f64 = 1e12;

impl Coefficients {
    /// Computes the coefficients as [`Coefficients::new`] does, for a mode of a relaxing material.
    ///
    /// [`Integrator::Exact`] is exact for a force that is constant over the step. It uses the
    /// exponential of the 3 x 3 system in twice double precision.
    ///
    /// [`Integrator::Newmark`] and [`Integrator::GeneralizedAlpha`] treat the stress of the branch
    /// implicitly, like the elastic stress. The stress relaxes exactly for a strain that is linear
    /// over the step: `s1 = e^-x s0 + omega^2 ratio (1 - e^-x)/x (q1 - q0)` with
    /// `s = omega^2 ratio (q - z)` and `x = h / time`. Under average acceleration this is passive
    /// at any step: without a force, the energy with the branch's share multiplied by
    /// `(x/2) coth(x/2)` never grows. The energy itself may grow for one step if a state was set by
    /// hand whose branch is far from relaxed although `time` is far below `h`.
    ///
    /// # Errors
    /// Returns an error if a number is not finite or out of range, or if `omega h` or `c h` is
    /// above 1e12.
    pub fn relaxing(
        integrator: Integrator,
        omega: f64,
        c: f64,
        relaxation: Relaxation,
        h: f64,
    ) -> Result<(Self, ViscoelasticCoefficients), StepError> {
        relaxation.check()?;
        // The checks of the elastic mode apply here too.
        Self::new(integrator, omega, c, h)?;
        let fastest = (omega * h).max(c * h);
        StepError::check(
            "omega",
            "a relaxing mode of omega h and c h up to 1e12",
            fastest <= FASTEST,
            omega,
        )?;
        let made = match integrator {
            Integrator::Exact => exact(omega, c, relaxation, h),
            Integrator::Newmark => alpha(omega, c, relaxation, h, [0.0, 0.0, 0.25, 0.5]),
            Integrator::GeneralizedAlpha { rho_inf: r } => {
                let (am, af) = ((2.0 * r - 1.0) / (r + 1.0), r / (r + 1.0));
                let gamma = 0.5 + af - am;
                alpha(omega, c, relaxation, h, [am, af, (gamma + 0.5).powi(2) / 4.0, gamma])
            }
        };
        let (table, viscoelastic) = &made;
        let mut numbers = table.free.iter().flatten().chain(&table.response).chain(&viscoelastic.onto);
        let finite = numbers.all(|x| x.is_finite()) && viscoelastic.free.iter().all(|x| x.is_finite());
        StepError::check("omega", "a frequency whose square is finite", finite, omega)?;
        Ok(made)
    }
}

fn exact(omega: f64, c: f64, relaxation: Relaxation, h: f64) -> (Coefficients, ViscoelasticCoefficients) {
    let Relaxation { ratio, time } = relaxation;
    let k = omega * omega;
    // The state is (q, v / s, z) and time is in steps, so that the entries of a fast mode are
    // comparable.
    let s = omega.max(1e-3 / h);
    let stiffness = k / s * h;
    // A branch with a relaxation time of 1e-12 steps is fully relaxed within a step.
    let rate = (h / time).min(FASTEST);
    let system = [[0.0, s * h, 0.0], [-stiffness, -c * h, ratio * stiffness], [rate, 0.0, -rate]];
    let (e, g) = exponential(system, [0.0, 1.0, 0.0]);
    let push = h / s;
    let q = [e[0][0], e[0][1] / s, e[0][2], g[0] * push];
    let v = [e[1][0] * s, e[1][1], e[1][2] * s, g[1] * h];
    let z = [e[2][0], e[2][1] / s, e[2][2], g[2] * push];
    // a1 = f1 - c v1 - k (q1 - ratio z1), so that the acceleration matches the new state.
    let a: [f64; 4] =
        std::array::from_fn(|i| f64::from(u8::from(i == 3)) - c * v[i] - k * (q[i] - ratio * z[i]));
    let table = Coefficients {
        free: [[q[0], q[1], 0.0, 0.0], [v[0], v[1], 0.0, 0.0], [a[0], a[1], 0.0, 0.0]],
        response: [q[3], v[3], a[3]],
    };
    (
        table,
        ViscoelasticCoefficients {
            onto: [q[2], v[2], a[2]],
            free: [z[0], z[1], 0.0, 0.0],
            carry: z[2],
            response: z[3],
        },
    )
}

fn alpha(
    omega: f64,
    c: f64,
    relaxation: Relaxation,
    h: f64,
    [am, af, beta, gamma]: [f64; 4],
) -> (Coefficients, ViscoelasticCoefficients) {
    let k = omega * omega;
    let flowing = k * relaxation.ratio;
    let [e, w0, w1] = relaxation.linear_weights(h);
    let (bh, gh) = (beta * h * h, gamma * h);
    let (ph, mh) = (h * h * (0.5 - beta), h * (1.0 - gamma));
    // This solves the following equation for a1:
    // (1 - am) a1 + am a0 + (1 - af)(c v1 + k q1 - flowing z1) + af (c v0 + k q0 - flowing z0)
    // = (1 - af) f1 + af f0.
    let (new, old) = (1.0 - af, af);
    let held = k - flowing * w1;
    let d = (1.0 - am) + new * (c * gh + held * bh);
    let a = [
        -(new * (held - flowing * w0) + old * k) / d,
        -(c + new * held * h) / d,
        -(am + new * (c * mh + held * ph)) / d,
        old / d,
    ];
    let a_z = flowing * (new * e + old) / d;
    let r = new / d;
    let q = [1.0 + bh * a[0], h + bh * a[1], ph + bh * a[2], bh * a[3]];
    let v = [gh * a[0], 1.0 + gh * a[1], mh + gh * a[2], gh * a[3]];
    let table = Coefficients { free: [q, v, a], response: [bh * r, gh * r, r] };
    let viscoelastic = ViscoelasticCoefficients {
        onto: [bh * a_z, gh * a_z, a_z],
        free: [w0 + w1 * q[0], w1 * q[1], w1 * q[2], w1 * q[3]],
        carry: e + w1 * bh * a_z,
        response: w1 * bh * r,
    };
    (table, viscoelastic)
}
