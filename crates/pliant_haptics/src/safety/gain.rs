//! Stages that scale the whole force: engage ramp, velocity cut-out, stale fade, faults, emergency
//! stop.
//!
//! One gain serves all of them. Each stage sets an upper limit of the gain. The gain falls to the
//! smallest limit at once, and each limit itself falls at a bounded rate (except the emergency
//! stop). The gain rises only by the ramp, so that the force always comes back gently.

use super::SafetyConfig;
use crate::Fault;

/// Limits of the hand's speed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VelocityCutConfig {
    /// Speed at which the force begins to fade, m/s. Default: 1.5.
    pub limit: f64,
    /// Speed below which the force may come back, m/s. Default: 0.75.
    pub release: f64,
}

impl Default for VelocityCutConfig {
    fn default() -> Self {
        Self { limit: 1.5, release: 0.75 }
    }
}

/// Limits of the time without a local model update.
///
/// The limits apply to a simulation that publishes every 25 ms or more often. Where it is known to
/// publish less often (simulated time runs slower than real time), the limits are longer in
/// proportion, by a factor of at most four.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StaleConfig {
    /// Time without an update at which the fade begins, s: a step at 40 Hz and its jitter. Default:
    /// 0.030.
    pub patience: f64,
    /// Time without an update after which there is no force, s. Default: 0.050.
    pub limit: f64,
}

impl Default for StaleConfig {
    fn default() -> Self {
        Self { patience: 0.030, limit: 0.050 }
    }
}

impl StaleConfig {
    /// Longest update interval for which the limits apply unscaled, s.
    const EVERY: f64 = 0.025;
    /// Largest factor by which the limits grow.
    const MAX: f64 = 4.0;

    /// Scales the time without an update, `silent` (s), for a simulation that publishes every
    /// `interval` s.
    pub(crate) fn counted(silent: f64, interval: f64) -> f64 {
        let slower = interval / Self::EVERY;
        // `clamp` does not fit here: an interval that is NaN must leave the time unchanged.
        if slower > 1.0 { silent / slower.min(Self::MAX) } else { silent }
    }

    /// Returns the largest gain allowed: 1 up to `patience`, 0 from `limit` on, and linear in
    /// between.
    pub fn allows(&self, silent: f64) -> f64 {
        ((self.limit - silent) / (self.limit - self.patience)).clamp(0.0, 1.0)
    }
}

#[cfg(test)]
#[test]
fn a_slow_simulation_is_waited_for_within_bounds() {
    let stale = StaleConfig::default();
    let allowed = |silent: f64, interval: f64| stale.allows(StaleConfig::counted(silent, interval));
    for interval in [0.0, 0.016, 0.025, f64::NAN, -1.0] {
        assert_eq!((allowed(0.029, interval), allowed(0.050, interval)), (1.0, 0.0), "every {interval} s");
    }
    // The simulated time runs at a quarter of the speed at 40 Hz.
    assert_eq!((allowed(0.119, 0.1), allowed(0.2, 0.1)), (1.0, 0.0));
    // The limit is at most 0.2 s, however slow the simulation is.
    for interval in [1.0, 1e300, f64::INFINITY] {
        assert_eq!(allowed(0.2, interval), 0.0, "every {interval} s");
    }
}

/// The gain that scales the whole force, 0 to 1.
#[derive(Debug, Clone, Copy)]
pub struct Gain {
    value: f64,
    cutting: bool,
    stopped: bool,
}

impl Gain {
    pub(crate) fn new(config: &SafetyConfig) -> Self {
        let value = if config.ramp.is_some() { 0.0 } else { 1.0 };
        Self { value, cutting: false, stopped: false }
    }

    pub(crate) fn value(&self) -> f64 {
        self.value
    }

    pub(crate) fn is_stopped(&self) -> bool {
        self.stopped
    }

    pub(crate) fn reset_stop(&mut self) {
        self.stopped = false;
        self.value = 0.0;
    }

    pub(crate) fn engage(&mut self) {
        self.value = 0.0;
    }

    pub(crate) fn tick(
        &mut self,
        config: &SafetyConfig,
        dt: f64,
        speed: f64,
        [silent, interval]: [f64; 2],
        fault: Option<Fault>,
        stop: bool,
    ) -> (f64, Option<Fault>) {
        let mut found = None;
        if let Some(limits) = &config.velocity {
            self.cutting = if self.cutting { speed > limits.release } else { speed > limits.limit };
            if self.cutting {
                found = Some(Fault::TooFast(speed));
            }
        }
        // The fade starts at the current value and not at one. A fault that appears and disappears
        // every tick must fade the force as well.
        self.value = if fault.is_some() || self.cutting {
            config.fade.map_or(0.0, |fade| (self.value - dt / fade).max(0.0))
        } else {
            config.ramp.map_or(1.0, |ramp| (self.value + dt / ramp).min(1.0))
        };
        if let Some(stale) = &config.stale {
            let allowed = stale.allows(StaleConfig::counted(silent, interval));
            if allowed < 1.0 {
                found = Some(Fault::Stale(silent));
            }
            self.value = self.value.min(allowed);
        }
        self.stopped |= stop;
        if self.stopped {
            self.value = 0.0;
            found = Some(Fault::EmergencyStop);
        }
        (self.value, found)
    }
}
