//! The loop's body without a clock, a thread or a device: a sample and the simulation's last word in, a wrench out.

use nalgebra::Vector3;
use thiserror::Error;

use crate::{
    Coupling, CouplingConfig, DeviceInfo, Fault, InfoError, LocalModel, ModalLocal, Port, Safety,
    SafetyConfig, Sample, ToolMap, Wanted, Wrench,
    control_loop::held_patches::{Change, HeldPatches, PatchForces, When},
    control_loop::tool::{Tool, masked},
    control_loop::validation::{Believed, SampleValidation},
    safety::{Slew, clamp_magnitude},
};

/// A loop that was not run for longer than this has stalled, s.
const STALL: f64 = 0.02;
/// For so long after a stall the force stays faded, s.
const AFTER_STALL: f64 = 0.05;

/// How a loop is run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LoopConfig {
    /// Periods a second, 500 to 8000 Hz. Default: 1000.
    pub rate: f64,
    /// Coupling between hand and body. Default: as stiff as the device closes.
    pub coupling: CouplingConfig,
    /// Delay of the force beyond what the device itself declares, s. Default: 0.
    pub delay: f64,
    /// Round trip to the simulation and back, s: from the hand's position to the word that has seen it, beyond the simulation's own step.
    /// Clamps the coupling, unless `modal`. Default: 0.
    pub round_trip: f64,
    /// The loop will be given a body to step itself ([`ModalLocal`]): it feels the body at once, whatever the round trip. Default: `false`.
    pub modal: bool,
    /// Stages of the safety pipeline; `None`: all of them, with limits for the device. Default: `None`.
    pub safety: Option<SafetyConfig>,
    /// Where the workspace is in the world. Default: its middle at the origin, metre for metre.
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

/// Why a loop does not start.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum StartError {
    /// A rate outside of what is supported.
    #[error("the loop's rate must be 500 to 8000 Hz, got {0}")]
    Rate(f64),
    /// A delay that is not one.
    #[error("the loop's delay must be finite seconds, 0 or more, got {0}")]
    Delay(f64),
    /// A tool map with a number out of range.
    #[error("the tool's map has a number that is not finite or a scale that is not positive")]
    Tool,
    /// The device says something impossible about itself.
    #[error(transparent)]
    Device(#[from] InfoError),
    /// A device that exerts forces on people is not run without the whole safety pipeline.
    #[error(
        "{0} exerts real forces: every stage of the safety pipeline must be there and within the device's limits"
    )]
    Unsafe(String),
    /// The thread could not be made.
    #[error("the loop's thread could not be started: {0}")]
    Thread(String),
}

/// What a tick saw and did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tick {
    /// Loop clock, s.
    pub now: f64,
    /// The hand in device axes, m.
    pub position: [f64; 3],
    /// Its velocity, m/s, device axes.
    pub velocity: [f64; 3],
    /// The tool in the world, m.
    pub tool: [f64; 3],
    /// Its velocity, m/s, world axes.
    pub tool_velocity: [f64; 3],
    /// Its orientation, unit quaternion x, y, z, w, world axes.
    pub tool_orientation: [f64; 4],
    /// The tool is lifted off the world by its clutch.
    pub clutched: bool,
    /// Buttons that are believed to be down.
    pub buttons: u32,
    /// What was sent to the device.
    pub wrench: Wrench,
    /// Force on the hand before safety, N, device axes.
    pub wanted: [f64; 3],
    /// Part of the force that is felt, 0 to 1.
    pub gain: f64,
    /// Energy at the port.
    pub port: Port,
    /// What is wrong now.
    pub fault: Option<Fault>,
    /// Time since the simulation's last word, s; 0 while nothing is held.
    pub silent: f64,
}

impl Default for Tick {
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

/// The loop's body. Allocates nothing, knows no clock, and is the same in a thread and in a test.
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
    /// Last word of the simulation: its tick, when it came, what others had supplied, whether it was finite.
    heard: u64,
    heard_at: f64,
    supplied: f64,
    good: bool,
    last_position: Vector3<f64>,
    stalled_until: f64,
    stall: f64,
    stop: bool,
    last: Tick,
}

impl LoopCore {
    /// For a device and a configuration.
    ///
    /// # Errors
    /// A number out of range; a device that is not simulated with a stage of the safety pipeline missing.
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
        if !info.simulated && !safety.is_complete(&info) {
            return Err(StartError::Unsafe(info.name));
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
            heard: 0,
            heard_at: 0.0,
            supplied: 0.0,
            good: true,
            last_position: Vector3::zeros(),
            stalled_until: f64::NEG_INFINITY,
            stall: 0.0,
            stop: false,
            last: Tick::default(),
            coupling,
            info,
            config,
        })
    }

    /// The device as it was described.
    pub fn info(&self) -> &DeviceInfo {
        &self.info
    }

    /// How it is run.
    pub fn config(&self) -> &LoopConfig {
        &self.config
    }

    /// The coupling in force, and what was wanted.
    pub fn coupling(&self) -> &Coupling {
        &self.coupling
    }

    /// What the last tick saw and did.
    pub fn last(&self) -> &Tick {
        &self.last
    }

    /// Moves the workspace in the world. An invalid map is refused and the old one stays.
    pub fn set_tool(&mut self, map: ToolMap) -> bool {
        self.tool.set_map(map)
    }

    /// Gives the loop a body to step itself, or takes it away; the one before comes back, to be dropped elsewhere. The force goes over from the
    /// one's to the other's within 50 ms.
    pub fn set_modal(&mut self, modal: Option<Box<ModalLocal>>) -> Option<Box<ModalLocal>> {
        self.held.set_modal(modal)
    }

    /// Whether there is a body to step.
    pub fn has_modal(&self) -> bool {
        self.held.has_modal()
    }

    /// No force from the next tick on, until [`reset_stop`](Self::reset_stop).
    pub fn emergency_stop(&mut self) {
        self.stop = true;
    }

    /// Whether the emergency stop is latched.
    pub fn is_stopped(&self) -> bool {
        self.stop || self.safety.is_stopped()
    }

    /// Unlatches the emergency stop; force comes back by the ramp.
    pub fn reset_stop(&mut self) {
        self.stop = false;
        self.safety.reset_stop();
    }

    /// The device was lost: its buttons are up, and where it is next is not a jump. The force fades as for any fault.
    pub fn lose(&mut self) {
        self.validation.forget();
    }

    /// A device is there: the first force comes by the ramp.
    pub fn engage(&mut self) {
        self.validation.forget();
        self.safety.engage();
    }

    /// One period with a sample from its end. `now`: the loop's clock, s; `dt`: length of the period as measured, s.
    pub fn tick(&mut self, now: f64, dt: f64, sample: &Sample, model: &LocalModel) -> Wrench {
        let dt = positive(dt);
        let force = self.safety.force().norm();
        let believed = self.validation.take(now, dt, sample, force);
        self.run(now, dt, believed, model)
    }

    /// One period without a sample: what the device said instead.
    pub fn miss(&mut self, now: f64, dt: f64, fault: Fault, model: &LocalModel) -> Wrench {
        let believed = self.validation.hold(fault);
        self.run(now, positive(dt), believed, model)
    }

    fn run(&mut self, now: f64, dt: f64, hand: Believed, model: &LocalModel) -> Wrench {
        let moved = if hand.jumped { Vector3::zeros() } else { hand.position - self.last_position };
        self.last_position = hand.position;
        self.tool.follow(hand.position, hand.velocity, hand.orientation, hand.buttons, hand.shifted);

        let mut fault = hand.fault;
        if dt > STALL {
            self.stalled_until = now + AFTER_STALL;
            self.stall = dt;
        }
        if now < self.stalled_until {
            fault = fault.or(Some(Fault::Stalled(self.stall)));
        }
        let supplied = self.hear(now, model);
        if !self.good {
            fault = fault.or(Some(Fault::BadModel));
        }
        let holding = self.good && self.heard > 0 && model.count > 0;
        let silent = if holding { (now - self.heard_at).max(0.0) } else { 0.0 };

        let felt = if holding {
            let when = When { now, dt, period: 1.0 / self.config.rate };
            self.held.forces(when, hand.fault.is_none(), &self.tool, model)
        } else {
            self.held.rest();
            PatchForces::default()
        };
        let scale = self.tool.energy_scale();
        let axes = self.info.force_axes;
        let [elastic, damping, weight] = [
            self.tool.force_to_hand(felt.elastic),
            self.tool.force_to_hand(felt.damping),
            self.tool.weight(),
        ]
        .map(|force| masked(force, axes));
        let allowed = self.safety.tick(&Wanted {
            // Memory of what came before is not run faster after a stall: a fade takes its ticks.
            dt: dt.min(2.0 / self.config.rate),
            moved,
            velocity: hand.velocity,
            elastic,
            damping,
            weight,
            stored: scale * felt.stored,
            partial: model.partial,
            supplied: scale * supplied,
            growing: felt.growing,
            holding,
            silent,
            interval: model.interval,
            fault,
            stop: std::mem::take(&mut self.stop),
        });
        let asked = (elastic + damping + weight).norm();
        let share = if asked > 1e-9 { (allowed.force.norm() / asked).min(1.0) } else { 1.0 };
        let torque = self.torque_to_hand(&felt, dt, allowed.gain, share);
        let wrench = Wrench { force: allowed.force.into(), torque: torque.into() };
        let orientation = self.tool.orientation.quaternion();
        self.last = Tick {
            now,
            position: hand.position.into(),
            velocity: hand.velocity.into(),
            tool: self.tool.position.into(),
            tool_velocity: self.tool.velocity.into(),
            tool_orientation: [orientation.i, orientation.j, orientation.k, orientation.w],
            clutched: self.tool.is_clutched(),
            buttons: hand.buttons,
            wrench,
            wanted: self.tool.force_to_hand(felt.elastic + felt.damping).into(),
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

    /// Takes note of a new word. Returns what others have supplied since the last, J of the world.
    fn hear(&mut self, now: f64, model: &LocalModel) -> f64 {
        if model.tick == self.heard {
            return 0.0;
        }
        self.good = model.is_finite();
        let first_word = self.heard == 0;
        self.heard = model.tick;
        self.heard_at = now;
        if !self.good {
            return 0.0;
        }
        let change = self.held.take(model);
        if change == Change::First {
            self.safety.engage();
        }
        // What is told of other grabs, and so perhaps of another body, does not go on from what was told of these.
        let goes_on = !first_word && change == Change::None;
        let supplied = if goes_on { model.supplied - self.supplied } else { 0.0 };
        self.supplied = model.supplied;
        supplied
    }

    /// The torque of what is held, cut as the force was: `share` of the force that was asked for is felt, and `gain` of a couple, which asks for none.
    ///
    /// Beyond that it is only clamped and slewed: its work is not counted at the port, and the stiffness that turns a handle is not held to what the
    /// device closes. So a device that pushes somebody gets none.
    fn torque_to_hand(&mut self, felt: &PatchForces, dt: f64, gain: f64, share: f64) -> Vector3<f64> {
        if !self.info.simulated || gain <= 0.0 {
            self.torque = Slew::default();
            return Vector3::zeros();
        }
        let peak = self.info.peak_torque;
        let torque = masked(self.tool.torque_to_hand(felt.torque), self.info.torque_axes);
        let torque = if torque.iter().all(|x| x.is_finite()) {
            clamp_magnitude(&(torque * share.min(gain)), peak)
        } else {
            Vector3::zeros()
        };
        // The whole torque in 5 ms, as for the force.
        let torque = self.torque.limit(&torque, peak / 0.005 * dt.min(2.0 / self.config.rate));
        self.torque.hold(&torque);
        torque
    }
}

fn positive(dt: f64) -> f64 {
    if dt.is_finite() && dt > 0.0 { dt } else { f64::MIN_POSITIVE }
}
