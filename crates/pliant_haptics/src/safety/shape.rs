//! Stages that shape a single force: damping cap, slew limit, magnitude clamp, thermal budget.

use nalgebra::Vector3;

/// The damping force cut to what `limit` (N s/m) would give at this velocity, its direction kept.
///
/// A damper on a measured velocity is stable to about `M / (T + d)`; above that it shakes the hand that it should calm.
pub fn cap_damping(force: &Vector3<f64>, velocity: &Vector3<f64>, limit: f64) -> Vector3<f64> {
    clamp_magnitude(force, limit * velocity.norm())
}

/// The force cut to `limit` (N), its direction kept.
pub fn clamp_magnitude(force: &Vector3<f64>, limit: f64) -> Vector3<f64> {
    let norm = force.norm();
    if norm > limit { force * (limit / norm) } else { *force }
}

/// Limits how fast a force changes.
#[derive(Debug, Clone, Copy, Default)]
pub struct Slew {
    last: Vector3<f64>,
}

impl Slew {
    /// `force`, or as near to it as `most` newtons from the last one allow.
    pub fn limit(&self, force: &Vector3<f64>, most: f64) -> Vector3<f64> {
        self.last + clamp_magnitude(&(force - self.last), most)
    }

    /// The force that the next one is measured from.
    pub fn hold(&mut self, force: &Vector3<f64>) {
        self.last = *force;
    }
}

/// How long motors bear more than they bear for ever.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ThermalConfig {
    /// Force that is borne for ever, N.
    pub continuous: f64,
    /// How long the peak is borne from cold, s. Default: 5.
    pub peak_seconds: f64,
}

impl Default for ThermalConfig {
    fn default() -> Self {
        Self { continuous: 1.0, peak_seconds: 5.0 }
    }
}

impl ThermalConfig {
    pub(crate) fn is_valid(&self) -> bool {
        let ok = |x: f64| x.is_finite() && x > 0.0;
        ok(self.continuous) && ok(self.peak_seconds)
    }
}

/// Heat in the motors: current is as force, heating as its square.
///
/// `h' = F^2 - Fc^2`, `h >= 0`; from half of the budget `(Fp^2 - Fc^2) t_peak` on the limit comes down from the peak `Fp` to the continuous
/// `Fc`, which it reaches when the budget is spent: no step in the force.
#[derive(Debug, Clone, Copy, Default)]
pub struct Thermal {
    heat: f64,
}

impl Thermal {
    /// Most force now, N.
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

    /// Takes a force of `force` newtons for `dt` seconds.
    pub fn heat(&mut self, config: &ThermalConfig, peak: f64, force: f64, dt: f64) {
        let continuous = config.continuous.min(peak);
        let budget = (peak * peak - continuous * continuous) * config.peak_seconds;
        self.heat = (self.heat + (force * force - continuous * continuous) * dt).clamp(0.0, budget.max(0.0));
    }
}
