//! Stages that shape a single force: damping cap, slew limit, magnitude clamp, thermal budget.

use nalgebra::Vector3;

/// Cuts the damping force to what `limit` (N s/m) gives at this velocity, and keeps its direction.
///
/// A damper on a measured velocity is stable up to about `M / (T + d)`. Above that limit the damper
/// shakes the hand instead of calming it.
pub fn cap_damping(force: &Vector3<f64>, velocity: &Vector3<f64>, limit: f64) -> Vector3<f64> {
    clamp_magnitude(force, limit * velocity.norm())
}

/// Cuts the force to `limit` (N) and keeps its direction.
pub fn clamp_magnitude(force: &Vector3<f64>, limit: f64) -> Vector3<f64> {
    let norm = force.norm();
    if norm > limit { force * (limit / norm) } else { *force }
}

/// Limits the rate of change of a force.
#[derive(Debug, Clone, Copy, Default)]
pub struct Slew {
    last: Vector3<f64>,
}

impl Slew {
    /// Returns `force`, or the nearest force that differs from the last force by at most `most`
    /// newtons.
    pub fn limit(&self, force: &Vector3<f64>, most: f64) -> Vector3<f64> {
        self.last + clamp_magnitude(&(force - self.last), most)
    }

    /// Sets the last force, from which the next change is measured.
    pub fn hold(&mut self, force: &Vector3<f64>) {
        self.last = *force;
    }
}

/// Thermal limits of the motors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThermalConfig {
    /// Force that the motors withstand permanently, N. Default: 1.
    pub continuous: f64,
    /// Time that cold motors withstand the peak force, s. Default: 5.
    pub peak_seconds: f64,
}

impl Default for ThermalConfig {
    fn default() -> Self {
        Self { continuous: 1.0, peak_seconds: 5.0 }
    }
}

/// Heat in the motors. The motor current is proportional to the force, and the heating to its
/// square.
///
/// `h' = F^2 - Fc^2`, `h >= 0`. The budget is `(Fp^2 - Fc^2) t_peak`. When half of the budget is
/// spent, the limit begins to fall from the peak `Fp`. It reaches the continuous force `Fc` when
/// the whole budget is spent, so the force makes no step.
#[derive(Debug, Clone, Copy, Default)]
pub struct Thermal {
    heat: f64,
}

impl Thermal {
    /// Returns the maximum force at the current heat, N.
    pub fn limit(&self, config: &ThermalConfig, peak: f64) -> f64 {
        let continuous = config.continuous.min(peak);
        let span = peak * peak - continuous * continuous;
        let budget = span * config.peak_seconds;
        if budget <= 0.0 {
            return continuous;
        }
        let left = (2.0 * (1.0 - self.heat / budget)).clamp(0.0, 1.0);
        (continuous * continuous + span * left).sqrt()
    }

    /// Adds the heat of a force of `force` newtons that lasts `dt` seconds.
    pub fn heat(&mut self, config: &ThermalConfig, peak: f64, force: f64, dt: f64) {
        let continuous = config.continuous.min(peak);
        let budget = (peak * peak - continuous * continuous) * config.peak_seconds;
        self.heat = (self.heat + (force * force - continuous * continuous) * dt).clamp(0.0, budget.max(0.0));
    }
}
