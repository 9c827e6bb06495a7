//! Stages that scale the force as a whole: engage ramp, velocity cut-out, stale fade, faults, emergency stop.
//!
//! One gain for all of them. Each stage names the most that it allows; the gain falls to the smallest at once (each falls at a bounded rate
//! itself) and rises again only by the ramp. So whatever fades a force, it comes back gently.

use super::SafetyConfig;
use crate::Fault;

/// When the hand is too fast.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VelocityCutConfig {
    /// Speed at which the force begins to fade, m/s. Default: 1.5.
    pub limit: f64,
    /// Speed below which it may come back, m/s. Default: 0.75.
    pub release: f64,
}

impl Default for VelocityCutConfig {
    fn default() -> Self {
        Self { limit: 1.5, release: 0.75 }
    }
}

impl VelocityCutConfig {
    pub(crate) fn is_valid(&self) -> bool {
        self.limit.is_finite() && self.release > 0.0 && self.release <= self.limit
    }
}

/// When the simulation is silent. The limits are for one that speaks every 25 ms or more often; where
/// it is known to speak more seldom (simulated time runs slower than real time) they are longer in
/// proportion, at most four times.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StaleConfig {
    /// Silence that is taken for granted, s: a step at 40 Hz and its jitter. Default: 0.030.
    pub patience: f64,
    /// Silence after which there is no force, s. Default: 0.050.
    pub limit: f64,
}

impl Default for StaleConfig {
    fn default() -> Self {
        Self { patience: 0.030, limit: 0.050 }
    }
}

impl StaleConfig {
    /// How often the simulation speaks for which the limits are, s.
    const EVERY: f64 = 0.025;
    /// Most times that they are longer.
    const MOST: f64 = 4.0;

    /// A silence (s) as it counts where the simulation speaks every `interval` s.
    pub(crate) fn counted(silent: f64, interval: f64) -> f64 {
        let slower = interval / Self::EVERY;
        // Not `clamp`: what is not a number changes nothing.
        if slower > 1.0 { silent / slower.min(Self::MOST) } else { silent }
    }

    pub(crate) fn is_valid(&self) -> bool {
        self.patience >= 0.0 && self.limit.is_finite() && self.limit > self.patience
    }

    /// 1 while patient, 0 from the limit on, a straight line between.
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
    // A quarter of the speed at 40 Hz.
    assert_eq!((allowed(0.119, 0.1), allowed(0.2, 0.1)), (1.0, 0.0));
    // However slow it is, a fifth of a second is the most.
    for interval in [1.0, 1e300, f64::INFINITY] {
        assert_eq!(allowed(0.2, interval), 0.0, "every {interval} s");
    }
}

/// Part of the force that is felt.
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
        // From where it is, not from one: a fault that comes and goes each tick must fade the force as well.
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
