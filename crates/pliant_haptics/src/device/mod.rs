//! What a haptic device is to this crate: something that takes a wrench, holds it for a while, and says where the hand is.

pub(crate) mod find;
pub(crate) mod hand;
#[cfg(feature = "inverse")]
pub(crate) mod inverse;
pub(crate) mod positioned;
pub(crate) mod record;
pub(crate) mod virtual_device;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// What a device is told to exert on the hand. Device axes are Bevy's: x right, y up, z toward the user.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Wrench {
    /// Force on the hand, N. Default: none.
    pub force: [f64; 3],
    /// Torque on the hand about the tool point, N m; devices of three degrees of freedom ignore it, and real ones are sent none. Default: none.
    pub torque: [f64; 3],
}

impl Wrench {
    /// No force, no torque.
    pub const ZERO: Self = Self { force: [0.0; 3], torque: [0.0; 3] };
}

/// What a device says at the end of a period. Device axes are Bevy's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// Where the tool point is, m, from the middle of the workspace.
    pub position: [f64; 3],
    /// Orientation of the tool as a unit quaternion x, y, z, w; identity for devices of three degrees of freedom.
    pub orientation: [f64; 4],
    /// Velocity as the device's own filter has it, m/s; `None`: the loop estimates it from positions.
    pub velocity: Option<[f64; 3]>,
    /// One bit a button, the lowest is the main one.
    pub buttons: u32,
    /// Counts the device's own measurements, where it has such a count: tells a frozen device from a still hand.
    pub sequence: Option<u64>,
}

impl Default for Sample {
    /// In the middle of the workspace, no button pressed.
    fn default() -> Self {
        Self {
            position: [0.0; 3],
            orientation: [0.0, 0.0, 0.0, 1.0],
            velocity: None,
            buttons: 0,
            sequence: None,
        }
    }
}

impl Sample {
    /// A sample at `position` (m), everything else at its default.
    pub fn at(position: [f64; 3]) -> Self {
        Self { position, ..Self::default() }
    }
}

/// What is known about a device: its limits are where the safety pipeline begins.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DeviceInfo {
    /// The model's name.
    pub name: String,
    /// Serial number or other mark that tells two of a kind apart; may be empty.
    pub serial: String,
    /// Largest force for a moment, N.
    pub peak_force: f64,
    /// Largest force for ever, N: what the motors bear without heating up.
    pub continuous_force: f64,
    /// Largest torque, N m; 0 without motors for it.
    pub peak_torque: f64,
    /// Which axes of position have motors.
    pub force_axes: [bool; 3],
    /// Which axes of rotation have motors.
    pub torque_axes: [bool; 3],
    /// Stiffness that the maker names as the most that the device closes stably, N/m; infinite when not known.
    pub max_stiffness: f64,
    /// Damping that the maker names as the most that the device closes stably, N s/m; infinite when not known.
    pub max_damping: f64,
    /// The device's own viscous damping at the tool, N s/m: the `b` of `K < 2 b / T`. A cautious guess is better than a high one.
    pub damping: f64,
    /// The device's own Coulomb friction at the tool, N.
    pub friction: f64,
    /// Apparent mass at the tool, kg.
    pub mass: f64,
    /// Smallest step that the position measurement resolves, m.
    pub resolution: f64,
    /// From a measurement to the force that answers it, beyond the hold itself, s.
    pub delay: f64,
    /// Corners of the reachable box, m, smallest then largest.
    pub workspace: [[f64; 3]; 2],
    /// Number of buttons.
    pub buttons: u32,
    /// Exerts forces on nobody: only such a device may be run with parts of the safety pipeline left out.
    pub simulated: bool,
}

impl DeviceInfo {
    /// Every number is one that the loop can work with.
    ///
    /// # Errors
    /// The first that is not.
    pub fn check(&self) -> Result<(), InfoError> {
        let refuse = |what, expected, got| Err(InfoError { what, expected, got });
        let positive = [
            ("peak_force", self.peak_force),
            ("continuous_force", self.continuous_force),
            ("mass", self.mass),
        ];
        for (what, got) in positive {
            if !(got.is_finite() && got > 0.0) {
                return refuse(what, "finite and above 0", got);
            }
        }
        let not_negative = [
            ("peak_torque", self.peak_torque),
            ("damping", self.damping),
            ("friction", self.friction),
            ("resolution", self.resolution),
            ("delay", self.delay),
        ];
        for (what, got) in not_negative {
            if !(got.is_finite() && got >= 0.0) {
                return refuse(what, "finite, 0 or more", got);
            }
        }
        for (what, got) in [("max_stiffness", self.max_stiffness), ("max_damping", self.max_damping)] {
            if got.is_nan() || got <= 0.0 {
                return refuse(what, "above 0", got);
            }
        }
        let [low, high] = self.workspace;
        for (l, h) in low.into_iter().zip(high) {
            if !(l.is_finite() && h.is_finite() && l < h) {
                return refuse("workspace", "finite, smallest corner first", h - l);
            }
        }
        Ok(())
    }
}

/// A number in a [`DeviceInfo`] that the loop cannot work with.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("{what} of the device: expected {expected}, got {got}")]
pub struct InfoError {
    /// Which number.
    pub what: &'static str,
    /// What is allowed.
    pub expected: &'static str,
    /// What came.
    pub got: f64,
}

/// Who keeps the time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pacing {
    /// The loop: [`HapticDevice::exchange`] is to wait by the [`Scheduler`] it is given.
    Loop,
    /// The device: `exchange` returns when its own servo has ticked, at about this rate, Hz.
    Device(f64),
}

/// Whether positions can be trusted yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Calibration {
    /// Yes.
    Ready,
    /// Not yet, and the user must do something: what, in words.
    Needed(&'static str),
}

/// What went wrong in a period. Everything but the emergency stop fades the force and, once it is over, ramps it up again.
#[derive(Debug, Clone, Copy, PartialEq, Error, Serialize, Deserialize)]
#[non_exhaustive]
pub enum Fault {
    /// The device is not there any more.
    #[error("the device is gone")]
    Gone,
    /// The device did not answer in time.
    #[error("the device did not answer within {0} s")]
    Timeout(f64),
    /// The driver reported an error of its own.
    #[error("the driver reported error {0:#x}")]
    Driver(i64),
    /// The device's answer could not be read.
    #[error("the device sent something that could not be read")]
    Malformed,
    /// A position, orientation or velocity that is NaN or infinite, or a force that came out so.
    #[error("a measurement, or the force that answers it, is a number that is not finite")]
    NotFinite,
    /// The position jumped farther than a hand can.
    #[error("the position jumped by {0} m in one period")]
    Jump(f64),
    /// The device repeats its last measurement.
    #[error("the device has sent the same measurement for {0} s")]
    Frozen(f64),
    /// The hand is faster than the cut-out allows, or than any hand, as the device has it.
    #[error("the hand moves at {0} m/s")]
    TooFast(f64),
    /// The simulation has been silent for so long, s.
    #[error("the simulation has been silent for {0} s")]
    Stale(f64),
    /// A local model with a number that is not finite.
    #[error("the simulation sent a number that is not finite")]
    BadModel,
    /// The loop itself was not run for so long (a debugger, a suspended machine), s.
    #[error("the loop was not run for {0} s")]
    Stalled(f64),
    /// Positions cannot be trusted until the device is calibrated.
    #[error("the device needs calibration")]
    NotCalibrated,
    /// Somebody pressed the emergency stop.
    #[error("emergency stop")]
    EmergencyStop,
    /// The driver panicked, and the loop with it: this device does not come back until it is added anew.
    #[error("the driver panicked; its loop is over")]
    Panicked,
}

impl Fault {
    /// A small number for each kind, in the order of the variants: an index into counters.
    pub fn kind(&self) -> usize {
        match self {
            Self::Gone => 0,
            Self::Timeout(_) => 1,
            Self::Driver(_) => 2,
            Self::Malformed => 3,
            Self::NotFinite => 4,
            Self::Jump(_) => 5,
            Self::Frozen(_) => 6,
            Self::TooFast(_) => 7,
            Self::Stale(_) => 8,
            Self::BadModel => 9,
            Self::Stalled(_) => 10,
            Self::NotCalibrated => 11,
            Self::EmergencyStop => 12,
            Self::Panicked => 13,
        }
    }

    /// How many kinds there are.
    pub const KINDS: usize = 14;
}

/// One period of the loop, as it was and not as it should have been.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Period {
    /// Seconds since the loop began, at its end.
    pub now: f64,
    /// How long it was, s.
    pub dt: f64,
    /// How late it ended, s.
    pub late: f64,
    /// Whole periods that were left out to catch up.
    pub missed: u32,
}

/// Time, real or virtual: the loop's own, lent to the device for the length of an exchange.
pub trait Scheduler {
    /// Waits until the next period begins, and says how long the last one was.
    fn wait(&mut self) -> Period;

    /// The period that [`wait`](Self::wait) ended last.
    fn last(&self) -> Period;

    /// For a device that keeps the time itself: takes the time of now as a period's end.
    fn note(&mut self) -> Period;
}

/// A haptic device. It lives on the loop's thread and is called by nobody else.
pub trait HapticDevice: Send {
    /// What it is. Asked once when the loop starts and again after a [`reopen`](Self::reopen).
    fn info(&self) -> DeviceInfo;

    /// Who keeps the time.
    fn pacing(&self) -> Pacing {
        Pacing::Loop
    }

    /// Whether positions can be trusted yet; asked until they can.
    fn calibration(&mut self) -> Calibration {
        Calibration::Ready
    }

    /// Hands over `wrench`, to be held from now on; lets one period pass (`scheduler.wait()`, or the device's own servo and then `scheduler.note()`);
    /// returns the state of the device at its end. In this order a force never waits a period for its turn.
    ///
    /// # Errors
    /// What went wrong; the loop fades what it asks for and calls again, so a device that is gone for good says so each time.
    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault>;

    /// Takes all force off at once. Called at the end, after a loss and at an emergency stop; does nothing on a device that is gone.
    /// An implementation calls it when it is dropped.
    fn safe_stop(&mut self);

    /// Tries to get a lost device back; called about once a second while it is lost, and may take its time.
    ///
    /// # Errors
    /// [`Fault::Gone`] as long as it is not there. A device that cannot come back always says so, which is the default.
    fn reopen(&mut self) -> Result<(), Fault> {
        Err(Fault::Gone)
    }
}

/// An output that can buzz but not push: a gamepad's motors, a phone. Honest about it: there is no position and no force in newtons.
pub trait VibrationOutput: Send {
    /// Buzzes with `strong` (low frequency) and `weak` (high frequency) at 0 to 1 for `seconds`; values outside are clamped, NaN is 0.
    fn vibrate(&mut self, strong: f64, weak: f64, seconds: f64);

    /// Stops at once.
    fn stop(&mut self);
}
