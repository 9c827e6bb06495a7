//! The core of the loop without a clock, a thread or a device. It computes a wrench from a sample
//! and the last local model update.

use nalgebra::Vector3;
use thiserror::Error;

use crate::{
    Coupling, CouplingConfig, DeviceInfo, Fault, InfoError, LocalModel, ModalLocal, Port, Safety,
    SafetyConfig, SafetyError, Sample, ToolMap, Wanted, Wrench,
    control_loop::held_patches::{Change, HeldPatches, PatchForces, When},
    control_loop::tool::{Tool, masked},
    control_loop::touch::Touch,
    control_loop::validation::{Believed, SampleValidation},
    safety::{Slew, clamp_magnitude},
};

/// Length of a period above which the loop counts as stalled, s. A hand at 0.5 m/s moves 5 mm in
/// this time.
const STALL: f64 = 0.01;
/// Time after a stall during which the force stays faded, s.
const AFTER_STALL: f64 = 0.05;

/// Settings of a loop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopConfig {
    /// Periods per second, 500 to 8000 Hz. Default: 1000.
    pub rate: f64,
    /// Coupling between the hand and the body. Default: as stiff as the device renders stably.
    pub coupling: CouplingConfig,
    /// Delay of the force beyond the delay that the device declares, s. Default: 0.
    pub delay: f64,
    /// Round trip to the simulation, s: from the hand's position to the local model update that
    /// contains it, beyond the simulation's own step. The round trip limits the coupling, unless
    /// `modal` is set. Default: 0.
    pub round_trip: f64,
    /// Whether the loop will step a copy of the body itself ([`ModalLocal`]). The body then
    /// responds to the hand without the delay of the round trip. Default: `false`.
    pub modal: bool,
    /// Stages of the safety pipeline. With `None` the loop uses all stages, with limits for the
    /// device. Default: `None`.
    pub safety: Option<SafetyConfig>,
    /// Pose of the workspace in the world. Default: the center at the origin, at a scale of 1.
    pub tool: ToolMap,
}

impl Default for LoopConfig {
    fn default() -> Self {
        Self {
            rate: 1000.0,
            coupling: CouplingConfig::default(),
            delay: 0.0,
            round_trip: 0.0,
            modal: false,
            safety: None,
            tool: ToolMap::default(),
        }
    }
}

/// Reason why a loop does not start.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum StartError {
    /// The rate is outside of the supported range.
    #[error("the loop's rate must be 500 to 8000 Hz, got {0}")]
    Rate(f64),
    /// The delay or the round trip is negative or not finite.
    #[error("the loop's delay must be finite seconds, 0 or more, got {0}")]
    Delay(f64),
    /// The tool map has a number that is out of range.
    #[error("the tool's map has a number that is not finite or a scale that is not positive")]
    Tool,
    /// The device reports invalid properties.
    #[error(transparent)]
    Device(#[from] InfoError),
    /// A device that exerts real forces lacks a part of the safety pipeline, or a limit of it is
    /// out of bounds.
    #[error("{device} exerts real forces, and its safety settings are not accepted: {reason}")]
    Unsafe {
        /// Name of the device.
        device: String,
        /// What is missing or out of bounds.
        reason: SafetyError,
    },
    /// The thread could not be created.
    #[error("the loop's thread could not be started: {0}")]
    Thread(String),
}

/// Input and output of one tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopTick {
    /// Time on the loop's clock, s.
    pub now: f64,
    /// Position of the hand, m, device axes.
    pub position: [f64; 3],
    /// Velocity of the hand, m/s, device axes.
    pub velocity: [f64; 3],
    /// Position of the tool, m, world axes.
    pub tool: [f64; 3],
    /// Velocity of the tool, m/s, world axes.
    pub tool_velocity: [f64; 3],
    /// Orientation of the tool, unit quaternion x, y, z, w, world axes.
    pub tool_orientation: [f64; 4],
    /// Whether the clutch detaches the tool from the hand.
    pub clutched: bool,
    /// Buttons that are validated as down, as bits.
    pub buttons: u32,
    /// The wrench sent to the device.
    pub wrench: Wrench,
    /// Force on the hand before the safety pipeline, N, device axes.
    pub wanted: [f64; 3],
    /// The gain of the force, 0 to 1.
    pub gain: f64,
    /// Energies at the port.
    pub port: Port,
    /// The present fault.
    pub fault: Option<Fault>,
    /// Time since the last local model update, s. It is 0 while nothing is held.
    pub silent: f64,
}

impl Default for LoopTick {
    fn default() -> Self {
        Self {
            now: 0.0,
            position: [0.0; 3],
            velocity: [0.0; 3],
            tool: [0.0; 3],
            tool_velocity: [0.0; 3],
            tool_orientation: [0.0, 0.0, 0.0, 1.0],
            clutched: false,
            buttons: 0,
            wrench: Wrench::ZERO,
            wanted: [0.0; 3],
            gain: 0.0,
            port: Port::default(),
            fault: None,
            silent: 0.0,
        }
    }
}

/// The core of the loop. It does not allocate, reads no clock, and behaves the same in a thread and
/// in a test.
#[derive(Debug)]
pub struct LoopCore {
    info: DeviceInfo,
    config: LoopConfig,
    coupling: Coupling,
    validation: SampleValidation,
    tool: Tool,
    safety: Safety,
    torque: Slew,
    held: HeldPatches,
    touch: Touch,
    /// The last local model update: its tick, its time of arrival, the energy that others had
    /// supplied, and whether it was finite.
    received_tick: u64,
    received_at: f64,
    supplied: f64,
    good: bool,
    last_position: Vector3<f64>,
    stalled_until: f64,
    stall: f64,
    stop: bool,
    last: LoopTick,
}

impl LoopCore {
    /// Creates the core for a device and a configuration.
    ///
    /// # Errors
    /// Returns an error if a number is out of range, or if the safety settings of a device that is
    /// not simulated do not pass [`SafetyConfig::check`].
    pub fn new(info: DeviceInfo, config: LoopConfig) -> Result<Self, StartError> {
        info.check()?;
        if !(500.0..=8000.0).contains(&config.rate) {
            return Err(StartError::Rate(config.rate));
        }
        if !(config.delay.is_finite() && config.delay >= 0.0) {
            return Err(StartError::Delay(config.delay));
        }
        if !(config.round_trip.is_finite() && config.round_trip >= 0.0) {
            return Err(StartError::Delay(config.round_trip));
        }
        if !config.tool.is_valid() {
            return Err(StartError::Tool);
        }
        let safety = config.safety.unwrap_or_else(|| SafetyConfig::for_device(&info, config.rate));
        if !info.simulated
            && let Err(reason) = safety.check(&info, config.rate)
        {
            return Err(StartError::Unsafe { device: info.name, reason });
        }
        let coupling = {
            let round_trip = if config.modal { 0.0 } else { config.round_trip };
            Coupling::clamp(&config.coupling, &info, config.rate, config.delay, round_trip)
        };
        Ok(Self {
            validation: SampleValidation::new(&info),
            tool: Tool::new(config.tool),
            safety: Safety::new(safety, info.mass),
            torque: Slew::default(),
            held: HeldPatches::new(safety.ramp),
            touch: Touch::default(),
            received_tick: 0,
            received_at: 0.0,
            supplied: 0.0,
            good: true,
            last_position: Vector3::zeros(),
            stalled_until: f64::NEG_INFINITY,
            stall: 0.0,
            stop: false,
            last: LoopTick::default(),
            coupling,
            info,
            config,
        })
    }

    /// Returns the description of the device.
    pub fn info(&self) -> &DeviceInfo {
        &self.info
    }

    /// Returns the settings of the loop.
    pub fn config(&self) -> &LoopConfig {
        &self.config
    }

    /// Returns the coupling in force and the wanted coupling.
    pub fn coupling(&self) -> &Coupling {
        &self.coupling
    }

    /// Returns the input and output of the last tick.
    pub fn last(&self) -> &LoopTick {
        &self.last
    }

    /// Moves the workspace in the world. An invalid map is refused, and the old map stays.
    pub fn set_tool(&mut self, map: ToolMap) -> bool {
        self.tool.set_map(map)
    }

    /// Sets or removes the body that the loop steps itself, and returns the previous one to be
    /// dropped elsewhere. The force blends from the old model to the new one within 50 ms.
    pub fn set_modal(&mut self, modal: Option<Box<ModalLocal>>) -> Option<Box<ModalLocal>> {
        self.held.set_modal(modal)
    }

    /// Returns whether the loop has a body to step.
    pub fn has_modal(&self) -> bool {
        self.held.has_modal()
    }

    /// Stops the force from the next tick on, until [`reset_stop`](Self::reset_stop).
    pub fn emergency_stop(&mut self) {
        self.stop = true;
    }

    /// Returns whether the emergency stop is latched.
    pub fn is_stopped(&self) -> bool {
        self.stop || self.safety.is_stopped()
    }

    /// Unlatches the emergency stop. The force then rises by the ramp.
    pub fn reset_stop(&mut self) {
        self.stop = false;
        self.safety.reset_stop();
    }

    /// Handles the loss of the device. Its buttons are released, and its next position does not
    /// count as a jump. The force fades as for any fault.
    pub fn lose(&mut self) {
        self.validation.forget();
    }

    /// Handles the start or return of a device. The first force rises by the ramp.
    pub fn engage(&mut self) {
        self.validation.forget();
        self.safety.engage();
    }

    /// Runs one period with the sample from its end. `now` is the time on the loop's clock, s. `dt`
    /// is the measured length of the period, s.
    pub fn tick(&mut self, now: f64, dt: f64, sample: &Sample, model: &LocalModel) -> Wrench {
        let dt = positive(dt);
        let force = self.safety.force().norm();
        let mut believed = self.validation.take(now, dt, sample, force);
        if !sample.force_on {
            // The hand feels nothing, so there is nothing to fade, and the force that comes back
            // must begin at zero.
            self.safety.engage();
            believed.fault = believed.fault.or(Some(Fault::ForceOff));
        }
        self.run(now, dt, believed, model)
    }

    /// Runs one period without a sample, with the `fault` that the device returned instead.
    pub fn miss(&mut self, now: f64, dt: f64, fault: Fault, model: &LocalModel) -> Wrench {
        let believed = self.validation.hold(fault);
        self.run(now, positive(dt), believed, model)
    }

    fn run(&mut self, now: f64, dt: f64, hand: Believed, model: &LocalModel) -> Wrench {
        let moved = if hand.jumped { Vector3::zeros() } else { hand.position - self.last_position };
        self.last_position = hand.position;
        self.tool.update(hand.position, hand.velocity, hand.orientation, hand.buttons, hand.shifted);

        let mut fault = hand.fault;
        if dt > STALL {
            self.stalled_until = now + AFTER_STALL;
            self.stall = dt;
        }
        if now < self.stalled_until {
            fault = fault.or(Some(Fault::Stalled(self.stall)));
        }
        let supplied = self.receive(now, model);
        if !self.good {
            fault = fault.or(Some(Fault::BadModel));
        }
        let fresh = self.good && self.received_tick > 0;
        let mut holding = fresh && model.count > 0;
        // Planes that an update has no more go away until the next one, and not at once.
        let touching = fresh && !holding && (model.plane_count > 0 || self.touch.touches());
        let silent = if holding || touching { (now - self.received_at).max(0.0) } else { 0.0 };

        let forces = if holding {
            let when = When { now, dt, period: 1.0 / self.config.rate };
            self.held.forces(when, hand.fault.is_none(), &self.tool, model)
        } else {
            self.held.rest();
            PatchForces::default()
        };
        let forces = if touching {
            let touched = self.touch.forces(now, dt.min(2.0 / self.config.rate), &self.tool, model);
            // In free air the energy of the port begins anew.
            holding = self.touch.touches();
            let stored = touched.stored + model.stored;
            PatchForces {
                elastic: touched.elastic,
                damping: touched.damping,
                torque: touched.torque,
                stored,
                ..forces
            }
        } else {
            self.touch.rest();
            forces
        };
        let scale = self.tool.energy_scale();
        let axes = self.info.force_axes;
        let [elastic, damping, weight] = [
            self.tool.force_to_hand(forces.elastic),
            self.tool.force_to_hand(forces.damping),
            self.tool.weight(),
        ]
        .map(|force| masked(force, axes));
        let allowed = self.safety.tick(&Wanted {
            // A stall must not speed up the stages with memory: a fade takes its ticks.
            dt: dt.min(2.0 / self.config.rate),
            moved,
            velocity: hand.velocity,
            elastic,
            damping,
            weight,
            stored: scale * forces.stored,
            partial: model.partial,
            supplied: scale * supplied,
            growing: forces.growing,
            one_sided: touching,
            holding,
            silent,
            interval: model.interval,
            fault,
            stop: std::mem::take(&mut self.stop),
        });
        let asked = (elastic + damping + weight).norm();
        let share = if asked > 1e-9 { (allowed.force.norm() / asked).min(1.0) } else { 1.0 };
        let torque = self.torque_to_hand(&forces, dt, allowed.gain, share);
        let wrench = Wrench { force: allowed.force.into(), torque: torque.into() };
        let orientation = self.tool.orientation.quaternion();
        self.last = LoopTick {
            now,
            position: hand.position.into(),
            velocity: hand.velocity.into(),
            tool: self.tool.position.into(),
            tool_velocity: self.tool.velocity.into(),
            tool_orientation: [orientation.i, orientation.j, orientation.k, orientation.w],
            clutched: self.tool.is_clutched(),
            buttons: hand.buttons,
            wrench,
            wanted: self.tool.force_to_hand(forces.elastic + forces.damping).into(),
            gain: allowed.gain,
            port: allowed.port,
            fault: if self.safety.is_stopped() {
                Some(Fault::EmergencyStop)
            } else {
                fault.or(allowed.fault)
            },
            silent,
        };
        wrench
    }

    /// Registers a new local model update. Returns the energy that others have supplied since the
    /// last one, J of the world.
    fn receive(&mut self, now: f64, model: &LocalModel) -> f64 {
        if model.tick == self.received_tick {
            return 0.0;
        }
        self.good = model.is_finite();
        let first_update = self.received_tick == 0;
        self.received_tick = model.tick;
        self.received_at = now;
        if !self.good {
            return 0.0;
        }
        let change = self.held.take(model);
        if change == Change::First {
            self.safety.engage();
        }
        // An update for other grabs, and so perhaps for another body, does not continue the count
        // of the previous grabs.
        let goes_on = !first_update && change == Change::None;
        let supplied = if goes_on { model.supplied - self.supplied } else { 0.0 };
        self.supplied = model.supplied;
        supplied
    }

    /// Returns the torque of what the tool holds or touches, reduced as the force was: by `share`,
    /// the part of the wanted force that was let through, and at most to `gain`. A pure couple
    /// wants no force and is reduced by `gain` alone.
    ///
    /// Beyond that, the torque is only clamped and slewed. Its work is not counted at the port, and
    /// its stiffness is not limited to what the device renders stably. Devices that exert real
    /// forces therefore get no torque.
    fn torque_to_hand(&mut self, forces: &PatchForces, dt: f64, gain: f64, share: f64) -> Vector3<f64> {
        if !self.info.simulated || gain <= 0.0 {
            self.torque = Slew::default();
            return Vector3::zeros();
        }
        let peak = self.info.peak_torque;
        let torque = masked(self.tool.torque_to_hand(forces.torque), self.info.torque_axes);
        let torque = if torque.iter().all(|x| x.is_finite()) {
            clamp_magnitude(&(torque * share.min(gain)), peak)
        } else {
            Vector3::zeros()
        };
        // As for the force, the full torque is reached in 5 ms.
        let torque = self.torque.limit(&torque, peak / 0.005 * dt.min(2.0 / self.config.rate));
        self.torque.hold(&torque);
        torque
    }
}

fn positive(dt: f64) -> f64 {
    if dt.is_finite() && dt > 0.0 { dt } else { f64::MIN_POSITIVE }
}
