//! The dent of a ball on a smooth surface.

use nalgebra::{Matrix3, Vector3};

use super::Carriers;

/// The law of the place where a part of a sphere touches: H. Hertz, *Ueber die Beruehrung fester
/// elastischer Koerper*, J. reine angew. Math. 92, 1881.
///
/// Under the force `F` the contact is a circle of the radius `a` with `a^3 = 3/4 F R / E*`, and the
/// half-space gives way by `3 F / (4 E* a)`. With `b = 1 / (pi E*)`, and with what the shape of the
/// body adds and the modes have already (`fixed`), the dent is
/// `h(F) = (fixed + 3 pi b / (4 a)) F`. A force that is large has the line that begins where the
/// tangent's factor of `b` is `least`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Indent {
    /// The sites around the place, which carry it. They stay for a step.
    pub(crate) carriers: Carriers,
    soft: Softness,
    /// `a^3 = growth F + start`. The circle without a force keeps the compliance finite.
    growth: f64,
    start: f64,
    /// The force from which on the dent is linear, N.
    end: f64,
    /// Dent of the tangent where it has no force, m.
    pub(crate) shift: f64,
}

/// How the surface of a ball gives way along its normal and across it.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Softness {
    /// Compliance without the half-space, m/N, and its factor, m^2/N.
    pub(crate) fixed: [f64; 2],
    pub(crate) slope: [f64; 2],
    /// Smallest factor of the slope, 1/m.
    pub(crate) least: f64,
}

const HALF_PI: f64 = std::f64::consts::FRAC_PI_2;

impl Indent {
    /// Makes the law of a place with this softness over `scale` (the stiffness). `radius` is that
    /// of the sphere that on a plane would touch as both surfaces do, and `smallest` that of the
    /// circle without a force, m.
    pub(crate) fn new(carriers: Carriers, soft: &Softness, scale: f64, radius: f64, smallest: f64) -> Self {
        let scaled = |soft: [f64; 2]| soft.map(|soft| soft / scale);
        let soft = Softness { fixed: scaled(soft.fixed), slope: scaled(soft.slope), ..*soft };
        let growth = 1.5 * HALF_PI * radius * soft.slope[0];
        let start = smallest.powi(3);
        let end = (((HALF_PI / soft.least).powi(3) - start) / growth).max(0.0);
        Self { carriers, soft, growth, start, end, shift: 0.0 }
    }

    /// Radius of the circle under a force along the normal (N), m.
    pub(crate) fn circle(&self, force: f64) -> f64 {
        (self.growth * force.max(0.0) + self.start).cbrt()
    }

    /// Dent under a force along the normal (N), m, and its derivative by the force, m/N.
    pub(crate) fn dent(&self, force: f64) -> (f64, f64) {
        let (fixed, slope, force) = (self.soft.fixed[0], self.soft.slope[0], force.max(0.0));
        let at = force.min(self.end);
        let a = self.circle(at);
        let factor = 1.5 * HALF_PI / a;
        let dent = (fixed + slope * factor) * at;
        let derivative = if force > self.end {
            fixed + slope * self.soft.least
        } else {
            fixed + slope * factor * (1.0 - self.growth * at / (3.0 * a.powi(3)))
        };
        (dent + (force - at) * derivative, derivative)
    }

    /// Energy in the dent, J: the force times the dent, less the sum of the dents of all smaller
    /// forces.
    pub(crate) fn energy(&self, force: f64) -> f64 {
        let force = force.max(0.0);
        let at = force.min(self.end);
        // The integral of `F / a(F)`, without the difference of its ends.
        let (a, b) = (self.circle(at), self.circle(0.0));
        let parts = 2.0 * a.powi(3) + 4.0 * a * a * b + 6.0 * a * b * b + 3.0 * b.powi(3);
        let sum = 0.3 * at * at * parts / (a * a + a * b + b * b).powi(2);
        let ((begun, _), (dent, derivative)) = (self.dent(at), self.dent(force));
        let beyond = (force - at) * (begun + 0.5 * (force - at) * derivative);
        force * dent - 0.5 * self.soft.fixed[0] * at * at - 1.5 * HALF_PI * self.soft.slope[0] * sum - beyond
    }

    /// Compliance for small changes of a force along the normal (N), m/N. Keeps the dent of its
    /// tangent.
    pub(crate) fn linearize(&mut self, normal: &Vector3<f64>, force: f64) -> Matrix3<f64> {
        let force = if force.is_finite() { force.max(0.0) } else { 0.0 };
        let (dent, derivative) = self.dent(force);
        self.shift = dent - derivative * force;
        let Softness { fixed, slope, least } = self.soft;
        let factor = ((derivative - fixed[0]) / slope[0]).max(least);
        let across = fixed[1] + factor * slope[1];
        across * Matrix3::identity() + (derivative - across) * normal * normal.transpose()
    }

    /// The force (N) that closes a gap (m, below 0) where it also moves the body by `response`
    /// (m/N).
    pub(crate) fn first_force(&self, gap: f64, response: f64) -> f64 {
        let mut force = 0.0f64;
        // From below, each step stays below: the dent grows ever less.
        for _ in 0..12 {
            let (dent, derivative) = self.dent(force);
            let step = (-gap - dent - response * force) / (derivative + response);
            force += step.max(0.0);
            if step.is_nan() || step <= 1e-3 * force {
                break;
            }
        }
        if force.is_finite() { force } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_half_space_has_the_force_and_the_energy_of_hertz() {
        let (young, radius) = (2e5, 0.05);
        let slope = 1.0 / (std::f64::consts::PI * young);
        let none = || Carriers::new(std::iter::empty());
        let soft = Softness { fixed: [0.0; 2], slope: [slope; 2], least: 1e-3 };
        let mut law = Indent::new(none(), &soft, 1.0, radius, 1e-6);
        for force in [1e-3, 0.1, 4.0] {
            let want = (9.0 * force * force / (16.0 * radius * young * young)).cbrt();
            let (dent, derivative) = law.dent(force);
            assert!((dent / want - 1.0).abs() < 1e-4, "{force}: {dent} {want}");
            let energy = law.energy(force) / (0.4 * force * want);
            assert!((energy - 1.0).abs() < 1e-4, "{force}: {energy}");
            let step = 1e-4 * force;
            let by_steps = (law.dent(force + step).0 - law.dent(force - step).0) / (2.0 * step);
            assert!((derivative / by_steps - 1.0).abs() < 1e-6, "{force}: {derivative} {by_steps}");
            let tangent = law.linearize(&Vector3::z(), force)[(2, 2)];
            assert!((law.shift + tangent * force - dent).abs() < 1e-12 * dent);
            let first = law.first_force(-dent, 0.0);
            assert!((first / force - 1.0).abs() < 1e-2, "{force}: {first}");
        }
        // Where the shape takes away, the dent goes on along a line and never falls.
        let soft = Softness { fixed: [-0.5 * slope / 0.02; 2], slope: [slope; 2], least: 0.6 / 0.02 };
        let law = Indent::new(none(), &soft, 2.0, radius, 1e-6);
        let mut before = (0.0, 0.0);
        for k in 1..200 {
            let force = 0.5 * f64::from(k);
            let now = (law.dent(force).0, law.energy(force));
            assert!(now.0 > before.0 && now.1 > before.1, "{force}");
            before = now;
        }
    }
}
