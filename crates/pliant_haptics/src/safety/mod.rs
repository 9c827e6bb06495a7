//! The safety pipeline: what stands between a force that somebody computed and a hand.
//!
//! In this order, each stage small and for itself:
//!
//! | Stage | What it does |
//! | --- | --- |
//! | finite check | a number that is not finite counts as none, and as a fault; before the other stages, and once more after them |
//! | [`Passivity`] | counts the energy at the port exactly; damps what leaks, and lets no more out than went in plus a tank |
//! | damping cap | no more damping than device and rate close stably |
//! | [`Slew`] | the force changes by so many newtons a second and no faster |
//! | magnitude clamp | no more than the device's peak, direction kept |
//! | [`Thermal`] | what the motors bear for long |
//! | engage ramp | after a start, a grab or a fault, force comes back slowly |
//! | velocity cut-out | a hand that flies off gets no push |
//! | stale fade | 50 ms after the simulation's last word there is no force |
//! | emergency stop | latched; the only one that cuts instead of fading |

mod gain;
mod passivity;
mod shape;

use nalgebra::Vector3;

pub use gain::{Gain, StaleConfig, VelocityCutConfig};
pub use passivity::{Passivity, PassivityConfig, Port};
pub use shape::{Slew, Thermal, ThermalConfig, cap_damping, clamp_magnitude};

use crate::{DeviceInfo, Fault};

/// Which stages there are, and their limits. `None` leaves a stage out, which only a simulated device is allowed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SafetyConfig {
    /// Energy accounting at the port.
    pub passivity: Option<PassivityConfig>,
    /// Most damping of the whole force, N s/m.
    pub max_damping: Option<f64>,
    /// Most change of the force, N/s.
    pub slew: Option<f64>,
    /// Most force, N.
    pub peak: Option<f64>,
    /// What the motors bear.
    pub thermal: Option<ThermalConfig>,
    /// Time from no force to all of it after a start, a grab or a fault, s.
    pub ramp: Option<f64>,
    /// Time in which a fault fades the force, s.
    pub fade: Option<f64>,
    /// When the hand is too fast.
    pub velocity: Option<VelocityCutConfig>,
    /// When the simulation has been silent.
    pub stale: Option<StaleConfig>,
}

impl SafetyConfig {
    /// All stages, with the limits that suit `device` at `rate` (Hz).
    pub fn for_device(device: &DeviceInfo, rate: f64) -> Self {
        let max_damping = device.max_damping.min(stable_damping(device, rate, 0.0));
        Self {
            passivity: Some(PassivityConfig { max_damping, ..PassivityConfig::default() }),
            max_damping: Some(max_damping),
            // The whole of the force in 5 ms: a wall met at half a metre a second is not rounded off, a kick is.
            slew: Some(device.peak_force / 0.005),
            peak: Some(device.peak_force),
            thermal: Some(ThermalConfig { continuous: device.continuous_force, ..ThermalConfig::default() }),
            ramp: Some(0.3),
            fade: Some(0.02),
            velocity: Some(VelocityCutConfig::default()),
            stale: Some(StaleConfig::default()),
        }
    }

    /// No stage at all but the finite check and the emergency stop: for measuring what a bare loop does to a simulated device.
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

    /// Every stage is there, with limits that are finite, positive and not above what the device can do.
    pub fn is_complete(&self, device: &DeviceInfo) -> bool {
        let within = |value: Option<f64>, most: f64| value.is_some_and(|v| v > 0.0 && v <= most);
        self.passivity.is_some_and(|p| p.is_valid())
            && self.max_damping.is_some_and(|b| b >= 0.0 && b <= device.max_damping)
            && self.slew.is_some_and(|s| s > 0.0 && s.is_finite())
            && within(self.peak, device.peak_force)
            && self.thermal.is_some_and(|t| t.is_valid() && t.continuous <= device.continuous_force)
            && within(self.ramp, 10.0)
            && within(self.fade, 0.1)
            && self.velocity.is_some_and(|v| v.is_valid())
            && self.stale.is_some_and(|s| s.is_valid())
    }
}

/// Most damping on a measured velocity that `device` closes at `rate` (Hz) with `delay` (s) beyond its own, N s/m: a third of `M / lag`, the lag being
/// the period, the delays, and half of the window that a velocity is taken from.
pub fn stable_damping(device: &DeviceInfo, rate: f64, delay: f64) -> f64 {
    let window =
        if device.resolution > 0.0 { 0.5 * crate::control_loop::validation::WINDOW as f64 } else { 0.0 };
    device.mass / 3.0 / ((1.0 + window) / rate + device.delay + delay.max(0.0))
}

/// What a tick knows when it comes to the pipeline. Device axes.
#[derive(Debug, Clone, Copy)]
pub struct Wanted {
    /// Time since the last force was sent, s.
    pub dt: f64,
    /// Displacement of the hand in that time, m.
    pub moved: Vector3<f64>,
    /// Velocity of the hand, m/s.
    pub velocity: Vector3<f64>,
    /// Force of springs (or of the body that the loop steps), N.
    pub elastic: Vector3<f64>,
    /// Force of dampers, N.
    pub damping: Vector3<f64>,
    /// Constant load of the tool, N: conservative, so not part of the energy accounting.
    pub weight: Vector3<f64>,
    /// Energy that the springs and the body could give back, J at the hand.
    pub stored: f64,
    /// `stored` is the least that it could be.
    pub partial: bool,
    /// Energy that others have put in since the last tick, J at the hand.
    pub supplied: f64,
    /// Springs are coming up by ramps of their own: what they store without being felt has not leaked.
    pub growing: bool,
    /// The tool holds something.
    pub holding: bool,
    /// Time since the simulation's last word, s.
    pub silent: f64,
    /// How often it speaks, s.
    pub interval: f64,
    /// Something is wrong with the sample or the model: fade.
    pub fault: Option<Fault>,
    /// Somebody pressed the emergency stop.
    pub stop: bool,
}

/// What the pipeline makes of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Allowed {
    /// The force that goes to the hand, N.
    pub force: Vector3<f64>,
    /// Part of it that is felt, 0 to 1: ramp, fades and cut-out together.
    pub gain: f64,
    /// What the pipeline itself found wrong.
    pub fault: Option<Fault>,
    /// Energy at the port.
    pub port: Port,
}

/// The stages in a row, with their memory.
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
    /// A pipeline with nothing engaged yet: the first force comes by the ramp.
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

    /// The stages and limits.
    pub fn config(&self) -> &SafetyConfig {
        &self.config
    }

    /// The last force let out, N.
    pub fn force(&self) -> Vector3<f64> {
        self.last
    }

    /// Whether the emergency stop is latched.
    pub fn is_stopped(&self) -> bool {
        self.gain.is_stopped()
    }

    /// Unlatches the emergency stop; force comes back by the ramp.
    pub fn reset_stop(&mut self) {
        self.gain.reset_stop();
    }

    /// The next force comes by the ramp: called at a grab and after a loss.
    pub fn engage(&mut self) {
        self.gain.engage();
    }

    /// What the slew stage allows, N/s: the limit less what the fades behind it can add, so that the sum of both keeps to it.
    fn slew_rate(&self) -> f64 {
        let Some(limit) = self.config.slew else { return f64::INFINITY };
        let peak = self.config.peak.unwrap_or(0.0);
        let fades = self.config.fade.map_or(0.0, |fade| peak / fade);
        (limit - fades).max(0.25 * limit)
    }

    /// One tick. Whatever it is given, what it lets out is finite; no force at a gain of 0 is exactly that.
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

        // Energy first of what was really held since the last tick.
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
            damping += self.passivity.dissipate(&w.velocity, w.dt);
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
            // None of the stages is to let such a force through; if one does, it goes no further, and none of them remembers it.
            fault = fault.or(Some(Fault::NotFinite));
            force = zero;
            self.slew = Slew::default();
            self.passivity = Passivity::new(self.config.passivity.unwrap_or_default());
        }
        self.slew.hold(&force);
        let (speed, silence) = (w.velocity.norm(), [w.silent, w.interval]);
        let (gain, cut) = self.gain.tick(&self.config, w.dt, speed, silence, w.fault.or(fault), w.stop);
        fault = fault.or(cut);
        // Times zero a number may still be one with a sign.
        let felt = |f: Vector3<f64>| if gain > 0.0 { f * gain } else { zero };
        let force = felt(force);
        if let Some(thermal) = &self.config.thermal {
            self.thermal.heat(thermal, self.config.peak.unwrap_or(thermal.continuous), force.norm(), w.dt);
        }
        self.last_weight = felt(w.weight);
        self.last = force;
        Allowed { force, gain, fault, port: self.passivity.port() }
    }
}

fn is_finite(v: &Vector3<f64>) -> bool {
    v.iter().all(|x| x.is_finite())
}

#[cfg(test)]
mod tests;
