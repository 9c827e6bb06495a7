//! The safety pipeline between the computed force and the device.
//!
//! The stages run in this order, and each stage is small and independent:
//!
//! | Stage | What it does |
//! | --- | --- |
//! | finite check | replaces a force that is not finite by zero and reports a fault, before the other stages and once more after them |
//! | [`Passivity`] | counts the energy at the port exactly, damps leaked energy, and lets no more energy out than went in plus a tank |
//! | damping cap | limits the damping to what the device can render stably at the loop rate |
//! | [`Slew`] | limits the change of the force, N/s |
//! | magnitude clamp | limits the force to the peak of the device and keeps the direction |
//! | [`Thermal`] | limits the force to what the motors withstand over time |
//! | engage ramp | raises the force slowly after a start, a grab or a fault |
//! | velocity cut-out | fades the force of a hand that is too fast |
//! | stale fade | fades the force to zero by 50 ms after the last local model update |
//! | emergency stop | latched, and the only stage that cuts the force instead of fading |
//!
//! While there is a fault, the force does not rise.

mod gain;
mod passivity;
mod shape;

use nalgebra::Vector3;
use thiserror::Error;

pub use gain::{Gain, StaleConfig, VelocityCutConfig};
pub use passivity::{Passivity, PassivityConfig, Port};
pub use shape::{Slew, Thermal, ThermalConfig, cap_damping, clamp_magnitude};

use crate::{DeviceInfo, Fault};

/// The stages of the safety pipeline and their limits. `None` leaves a stage out, which is allowed
/// only for a simulated device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SafetyConfig {
    /// Energy accounting at the port.
    pub passivity: Option<PassivityConfig>,
    /// Maximum damping of the whole force, N s/m.
    pub max_damping: Option<f64>,
    /// Maximum rate of change of the force, N/s.
    pub slew: Option<f64>,
    /// Maximum force, N.
    pub peak: Option<f64>,
    /// Thermal limit of the motors.
    pub thermal: Option<ThermalConfig>,
    /// Duration of the ramp from zero to full force after a start, a grab or a fault, s.
    pub ramp: Option<f64>,
    /// Duration in which a fault fades the force, s.
    pub fade: Option<f64>,
    /// Limits of the hand's speed.
    pub velocity: Option<VelocityCutConfig>,
    /// Limits of the time without a local model update.
    pub stale: Option<StaleConfig>,
}

impl SafetyConfig {
    /// Enables all stages, with the limits that suit `device` at `rate` (Hz).
    pub fn for_device(device: &DeviceInfo, rate: f64) -> Self {
        let max_damping = device.max_damping.min(stable_damping(device, rate, 0.0));
        Self {
            passivity: Some(PassivityConfig { max_damping, ..PassivityConfig::default() }),
            max_damping: Some(max_damping),
            // The full force is reached in 5 ms. This limit does not round off a wall met at 0.5
            // m/s, but it does round off a kick.
            slew: Some(device.peak_force / 0.005),
            peak: Some(device.peak_force),
            thermal: Some(ThermalConfig { continuous: device.continuous_force, ..ThermalConfig::default() }),
            ramp: Some(0.3),
            fade: Some(0.02),
            velocity: Some(VelocityCutConfig::default()),
            stale: Some(StaleConfig::default()),
        }
    }

    /// Leaves out all stages except the finite check and the emergency stop. This configuration
    /// serves to measure the effect of a bare loop on a simulated device.
    pub fn bare() -> Self {
        Self {
            passivity: None,
            max_damping: None,
            slew: None,
            peak: None,
            thermal: None,
            ramp: None,
            fade: None,
            velocity: None,
            stale: None,
        }
    }

    /// Checks that every stage is present and that its limits limit something on `device`, whose
    /// loop runs at `rate` (Hz).
    ///
    /// | Limit | Bounds |
    /// | --- | --- |
    /// | `peak` | above 0, at most the device's peak force |
    /// | `slew` | the whole of `peak` in 0.5 s, to the device's peak force in 2 ms |
    /// | `ramp`, `fade` | 0.05 to 10 s, 1 to 100 ms |
    /// | `thermal` | a continuous force of at most the device's, a peak for at most 30 s |
    /// | `velocity` | a cut-out of at most 5 m/s, a release above 0 and of at most the cut-out |
    /// | `stale` | a limit of at most 0.25 s, a fade of at least 5 ms |
    /// | `max_damping` | at most the device's and three times the [stable one](stable_damping) |
    /// | `passivity` | a tank of at most 50 mJ, a repayment of at most 100 mW, the damping as above |
    ///
    /// A slew limit has a lower bound because a force that may hardly change cannot fall either.
    ///
    /// # Errors
    /// Returns the first stage that is missing or the first limit that is out of bounds.
    pub fn check(&self, device: &DeviceInfo, rate: f64) -> Result<(), SafetyError> {
        fn stage<T>(what: &'static str, stage: Option<T>) -> Result<T, SafetyError> {
            stage.ok_or(SafetyError::Missing(what))
        }
        let within = |what, got: f64, least: f64, most: f64| {
            // A NaN is within no bounds.
            if got >= least && got <= most {
                Ok(())
            } else {
                Err(SafetyError::OutOfBounds { what, least, most, got })
            }
        };
        let most_damping = device.max_damping.min(3.0 * stable_damping(device, rate, 0.0));
        let passivity = stage("passivity", self.passivity)?;
        within("passivity.tank", passivity.tank, 0.0, 0.05)?;
        within("passivity.repay", passivity.repay, 0.0, 0.1)?;
        within("passivity.max_damping", passivity.max_damping, 0.0, most_damping)?;
        within("max_damping", stage("max_damping", self.max_damping)?, 0.0, most_damping)?;
        let peak = stage("peak", self.peak)?;
        within("peak", peak, f64::MIN_POSITIVE, device.peak_force)?;
        within("slew", stage("slew", self.slew)?, peak / 0.5, device.peak_force / 0.002)?;
        let thermal = stage("thermal", self.thermal)?;
        within("thermal.continuous", thermal.continuous, f64::MIN_POSITIVE, device.continuous_force)?;
        within("thermal.peak_seconds", thermal.peak_seconds, f64::MIN_POSITIVE, 30.0)?;
        within("ramp", stage("ramp", self.ramp)?, 0.05, 10.0)?;
        within("fade", stage("fade", self.fade)?, 0.001, 0.1)?;
        let velocity = stage("velocity", self.velocity)?;
        within("velocity.limit", velocity.limit, f64::MIN_POSITIVE, 5.0)?;
        within("velocity.release", velocity.release, f64::MIN_POSITIVE, velocity.limit)?;
        let stale = stage("stale", self.stale)?;
        within("stale.limit", stale.limit, 0.005, 0.25)?;
        within("stale.patience", stale.patience, 0.0, stale.limit - 0.005)
    }
}

/// Reason why a real device is not run with a [`SafetyConfig`].
#[derive(Debug, Clone, Copy, PartialEq, Error)]
#[non_exhaustive]
pub enum SafetyError {
    /// A stage is missing.
    #[error("the stage `{0}` is missing")]
    Missing(&'static str),
    /// A limit is out of its bounds, which [`SafetyConfig::check`] lists.
    #[error("`{what}` must be {least} to {most}, got {got}")]
    OutOfBounds {
        /// Name of the limit.
        what: &'static str,
        /// Lower bound, in the unit of the limit.
        least: f64,
        /// Upper bound, in the unit of the limit.
        most: f64,
        /// The value.
        got: f64,
    },
}

/// Maximum damping on a measured velocity that `device` renders stably at `rate` (Hz) with an extra
/// `delay` (s), N s/m.
///
/// The limit is a third of `M / lag`. The lag is the sum of the period, the delays and half of the
/// window over which the velocity is measured.
pub fn stable_damping(device: &DeviceInfo, rate: f64, delay: f64) -> f64 {
    let window =
        if device.resolution > 0.0 { 0.5 * crate::control_loop::validation::WINDOW as f64 } else { 0.0 };
    device.mass / 3.0 / ((1.0 + window) / rate + device.delay + delay.max(0.0))
}

/// Input of the pipeline for one tick, in device axes.
#[derive(Debug, Clone, Copy)]
pub struct Wanted {
    /// Time since the last force was sent, s.
    pub dt: f64,
    /// Displacement of the hand in that time, m.
    pub moved: Vector3<f64>,
    /// Velocity of the hand, m/s.
    pub velocity: Vector3<f64>,
    /// Force of the springs, or of the body that the loop steps, N.
    pub elastic: Vector3<f64>,
    /// Force of the dampers, N.
    pub damping: Vector3<f64>,
    /// Constant weight of the tool, N. This force is conservative and therefore not part of the
    /// energy accounting.
    pub weight: Vector3<f64>,
    /// Energy that the springs and the body could give back, J at the hand.
    pub stored: f64,
    /// Whether `stored` is only a lower bound.
    pub partial: bool,
    /// Energy that other participants supplied since the last tick, J at the hand.
    pub supplied: f64,
    /// Whether springs are engaging by ramps of their own. Energy that such a spring stores while
    /// the hand does not feel its force has not leaked.
    pub growing: bool,
    /// Whether the tool only touches, so that nothing may pull the hand against the wanted force.
    pub one_sided: bool,
    /// Whether the tool holds or touches something.
    pub holding: bool,
    /// Time since the last local model update, s.
    pub silent: f64,
    /// Interval of the local model updates, s.
    pub interval: f64,
    /// Fault of the sample or of the local model. A fault fades the force.
    pub fault: Option<Fault>,
    /// Whether somebody pressed the emergency stop.
    pub stop: bool,
}

/// Output of the pipeline for one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Allowed {
    /// The force that goes to the hand, N.
    pub force: Vector3<f64>,
    /// The gain of the force, 0 to 1: ramp, fades and cut-out together.
    pub gain: f64,
    /// The fault that the pipeline itself found.
    pub fault: Option<Fault>,
    /// Energies at the port.
    pub port: Port,
}

/// The stages of the pipeline with their state.
#[derive(Debug, Clone)]
pub struct Safety {
    config: SafetyConfig,
    passivity: Passivity,
    slew: Slew,
    thermal: Thermal,
    gain: Gain,
    mass: f64,
    last: Vector3<f64>,
    last_weight: Vector3<f64>,
}

impl Safety {
    /// Creates a pipeline that has not engaged yet, so that the first force rises by the ramp.
    ///
    /// `mass`: the device's apparent mass, kg.
    pub fn new(config: SafetyConfig, mass: f64) -> Self {
        Self {
            config,
            passivity: Passivity::new(config.passivity.unwrap_or_default()),
            slew: Slew::default(),
            thermal: Thermal::default(),
            gain: Gain::new(&config),
            mass,
            last: Vector3::zeros(),
            last_weight: Vector3::zeros(),
        }
    }

    /// Returns the stages and their limits.
    pub fn config(&self) -> &SafetyConfig {
        &self.config
    }

    /// Returns the last force that the pipeline let out, N.
    pub fn force(&self) -> Vector3<f64> {
        self.last
    }

    /// Returns whether the emergency stop is latched.
    pub fn is_stopped(&self) -> bool {
        self.gain.is_stopped()
    }

    /// Unlatches the emergency stop. The force then rises by the ramp.
    pub fn reset_stop(&mut self) {
        self.gain.reset_stop();
    }

    /// Restarts the ramp for the next force. Call this method at a grab and after a loss.
    pub fn engage(&mut self) {
        self.gain.engage();
    }

    /// Returns the limit of the slew stage, N/s. The limit of the configuration is reduced by the
    /// rate that the later fades can add, so that both together keep to it.
    fn slew_rate(&self) -> f64 {
        let Some(limit) = self.config.slew else { return f64::INFINITY };
        let peak = self.config.peak.unwrap_or(0.0);
        let fades = self.config.fade.map_or(0.0, |fade| peak / fade);
        (limit - fades).max(0.25 * limit)
    }

    /// Runs one tick. The output force is finite for every input, and at a gain of 0 it is exactly
    /// zero.
    pub fn tick(&mut self, wanted: &Wanted) -> Allowed {
        let zero = Vector3::zeros();
        let mut fault = None;
        let mut w = *wanted;
        if ![w.elastic, w.damping, w.weight].iter().all(is_finite) {
            fault = Some(Fault::BadModel);
            (w.elastic, w.damping, w.weight) = (zero, zero, zero);
        }
        if !(is_finite(&w.moved)
            && is_finite(&w.velocity)
            && w.dt.is_finite()
            && w.dt >= 0.0
            && w.silent.is_finite())
        {
            fault = fault.or(Some(Fault::NotFinite));
            (w.moved, w.velocity, w.dt, w.silent) = (zero, zero, 0.0, f64::INFINITY);
        }

        // The energy accounting comes first. It counts the work of the force that was applied since
        // the last tick.
        let interaction = self.last - self.last_weight;
        self.passivity.observe(&interaction, &w.moved, w.supplied, w.stored, w.partial, w.holding);
        if self.gain.value() < 1.0 || w.growing {
            if self.gain.value() <= 0.0 {
                self.passivity.refill();
            }
            self.passivity.forgive();
        } else {
            self.passivity.repay(w.dt);
        }
        let (mut elastic, mut damping) = (w.elastic, w.damping);
        let slew = self.slew_rate();
        if self.config.passivity.is_some() {
            let wanted = elastic + damping;
            let mut brake = self.passivity.dissipate(&w.velocity, w.dt);
            if w.one_sided {
                // The controller may take away what pushes, but it may not pull. Across the push
                // it brakes no harder than that pushes, so that a hand that leaves a surface
                // feels no jerk. What is missing then stays on the account.
                let push = wanted.try_normalize(f64::MIN_POSITIVE).unwrap_or_else(Vector3::zeros);
                let along = brake.dot(&push);
                let across = clamp_magnitude(&(brake - push * along), wanted.norm());
                brake = across + push * along.max(-wanted.norm());
            }
            damping += brake;
            if w.one_sided && wanted == zero {
                damping = zero;
            }
            if let Some(limit) = self.config.max_damping {
                damping = cap_damping(&damping, &w.velocity, limit);
            }
            let total = self.passivity.restrain(&(elastic + damping), &w.velocity, w.dt, slew, self.mass);
            elastic = total - damping;
        } else if let Some(limit) = self.config.max_damping {
            damping = cap_damping(&damping, &w.velocity, limit);
        }

        let mut force = elastic + damping + w.weight;
        if slew.is_finite() {
            force = self.slew.limit(&force, slew * w.dt);
        }
        if let Some(peak) = self.config.peak {
            force = clamp_magnitude(&force, peak);
        }
        if let Some(thermal) = &self.config.thermal {
            let limit = self.thermal.limit(thermal, self.config.peak.unwrap_or(thermal.continuous));
            force = clamp_magnitude(&force, limit);
        }
        if !is_finite(&force) {
            // No stage should let a force through that is not finite. If one does, the force stops
            // here and the stages that remember forces are reset.
            fault = fault.or(Some(Fault::NotFinite));
            force = zero;
            self.slew = Slew::default();
            self.passivity = Passivity::new(self.config.passivity.unwrap_or_default());
        }
        self.slew.hold(&force);
        let (speed, silence) = (w.velocity.norm(), [w.silent, w.interval]);
        let (gain, cut) = self.gain.tick(&self.config, w.dt, speed, silence, w.fault.or(fault), w.stop);
        fault = fault.or(cut);
        // A multiplication by zero could leave a negative zero.
        let scaled = |f: Vector3<f64>| if gain > 0.0 { f * gain } else { zero };
        let faded = scaled(force);
        // A fault never lets the force rise. After a stall, for example, the hand may be far from
        // where the last force met it.
        let most = if w.fault.or(fault).is_some() { self.last.norm() } else { f64::INFINITY };
        let force = clamp_magnitude(&faded, most);
        let kept = if faded == force { 1.0 } else { force.norm() / faded.norm() };
        if let Some(thermal) = &self.config.thermal {
            self.thermal.heat(thermal, self.config.peak.unwrap_or(thermal.continuous), force.norm(), w.dt);
        }
        self.last_weight = scaled(w.weight) * kept;
        self.last = force;
        Allowed { force, gain, fault, port: self.passivity.port() }
    }
}

fn is_finite(v: &Vector3<f64>) -> bool {
    v.iter().all(|x| x.is_finite())
}

#[cfg(test)]
mod tests;
