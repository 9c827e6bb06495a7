//! The interface to haptic devices. A device applies a wrench for one period and reports the hand's
//! pose.

pub(crate) mod find;
pub(crate) mod hand;
#[cfg(feature = "inverse")]
pub(crate) mod inverse;
#[cfg(any(feature = "inverse", feature = "vendor"))]
#[cfg_attr(not(feature = "vendor"), expect(dead_code, reason = "an Inverse's cut ends its connection"))]
pub(crate) mod link;
pub(crate) mod positioned;
pub(crate) mod record;
#[cfg(any(feature = "inverse", feature = "vendor"))]
pub(crate) mod renewal;
pub(crate) mod virtual_device;

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use thiserror::Error;

#[cfg(any(feature = "inverse", feature = "vendor"))]
use crate::control_loop::sync;

/// Force and torque that a device exerts on the hand. Device axes are Bevy's: x right, y up, z
/// toward the user.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Wrench {
    /// Force on the hand, N. Default: zero.
    pub force: [f64; 3],
    /// Torque on the hand about the tool point, N m. Devices of three degrees of freedom ignore it,
    /// and real devices are sent none. Default: zero.
    pub torque: [f64; 3],
}

impl Wrench {
    /// A wrench without force and torque.
    pub const ZERO: Self = Self { force: [0.0; 3], torque: [0.0; 3] };
}

/// State of a device at the end of a period. Device axes are Bevy's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// Position of the tool point, m, from the center of the workspace.
    pub position: [f64; 3],
    /// Orientation of the tool as a unit quaternion x, y, z, w. It is the identity for devices of
    /// three degrees of freedom.
    pub orientation: [f64; 4],
    /// Velocity from the device's own filter, m/s. With `None` the loop estimates the velocity from
    /// positions.
    pub velocity: Option<[f64; 3]>,
    /// Buttons that are down, one bit each. The lowest bit is the main button.
    pub buttons: u32,
    /// Whether the motors exert the force that they are sent. It is `false` while the force is
    /// switched off at the device: by its button, its safety switch, its own watchdog, or because
    /// the driver has found that the force was not renewed in time. The position is valid then.
    /// Default: `true`.
    pub force_on: bool,
    /// Count of the device's own measurements, where the device has such a count. It distinguishes
    /// a frozen device from a hand at rest.
    pub sequence: Option<u64>,
}

impl Default for Sample {
    /// Returns a sample in the center of the workspace with no button down.
    fn default() -> Self {
        Self {
            position: [0.0; 3],
            orientation: [0.0, 0.0, 0.0, 1.0],
            velocity: None,
            buttons: 0,
            force_on: true,
            sequence: None,
        }
    }
}

impl Sample {
    /// Creates a sample at `position` (m), with defaults for everything else.
    pub fn at(position: [f64; 3]) -> Self {
        Self { position, ..Self::default() }
    }
}

/// Properties of a device. The safety pipeline is based on their limits.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DeviceInfo {
    /// Name of the model.
    pub name: String,
    /// Serial number or other mark that distinguishes two devices of a kind. It may be empty.
    pub serial: String,
    /// Maximum momentary force, N.
    pub peak_force: f64,
    /// Maximum permanent force, N. The motors withstand this force without overheating.
    pub continuous_force: f64,
    /// Maximum torque, N m. It is 0 without motors for torque.
    pub peak_torque: f64,
    /// Position axes that have motors.
    pub force_axes: [bool; 3],
    /// Rotation axes that have motors.
    pub torque_axes: [bool; 3],
    /// Maximum stiffness that the device renders stably according to its maker, N/m. It is infinite
    /// if unknown.
    pub max_stiffness: f64,
    /// Maximum damping that the device renders stably according to its maker, N s/m. It is infinite
    /// if unknown.
    pub max_damping: f64,
    /// The device's own viscous damping at the tool, N s/m: the `b` of `K < 2 b / T`. A low
    /// estimate is safer than a high one.
    pub damping: f64,
    /// The device's own Coulomb friction at the tool, N.
    pub friction: f64,
    /// Apparent mass at the tool, kg.
    pub mass: f64,
    /// Smallest step that the position measurement resolves, m.
    pub resolution: f64,
    /// Delay from a measurement to the force that answers it, beyond the hold itself, s.
    pub delay: f64,
    /// Corners of the reachable box, m, smallest corner first.
    pub workspace: [[f64; 3]; 2],
    /// Number of buttons.
    pub buttons: u32,
    /// Whether the device exerts no real forces. Only such a device may run without parts of the
    /// safety pipeline.
    pub simulated: bool,
}

impl DeviceInfo {
    /// Checks that the loop can work with every number.
    ///
    /// # Errors
    /// Returns the first number that is out of range.
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
    /// Name of the number.
    pub what: &'static str,
    /// Allowed range.
    pub expected: &'static str,
    /// The value.
    pub got: f64,
}

/// Says whether the loop or the device does the timing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pacing {
    /// The loop does the timing. [`HapticDevice::exchange`] must wait by the given [`Scheduler`].
    Loop,
    /// The device does the timing. `exchange` returns when the device's own servo has ticked, at
    /// about this rate, Hz.
    Device(f64),
}

/// State of the calibration: whether positions are valid yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Calibration {
    /// Positions are valid.
    Ready,
    /// Positions are not valid yet, and the user must act. The text says what to do.
    Needed(&'static str),
}

/// Fault in a period. Every fault except the emergency stop fades the force. After its end, the
/// force ramps up again.
#[derive(Debug, Clone, Copy, PartialEq, Error, Serialize, Deserialize)]
#[non_exhaustive]
pub enum Fault {
    /// The device is not connected any more.
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
    /// A position, orientation or velocity is NaN or infinite, or the computed force is.
    #[error("a measurement, or the force that answers it, is a number that is not finite")]
    NotFinite,
    /// The position jumped farther than a hand can move.
    #[error("the position jumped by {0} m in one period")]
    Jump(f64),
    /// The device repeats its last measurement.
    #[error("the device has sent the same measurement for {0} s")]
    Frozen(f64),
    /// The hand is faster than the cut-out allows, or the device reports a speed that no hand
    /// reaches.
    #[error("the hand moves at {0} m/s")]
    TooFast(f64),
    /// No local model update has arrived for this long, s.
    #[error("the simulation has been silent for {0} s")]
    Stale(f64),
    /// A local model contains a number that is not finite.
    #[error("the simulation sent a number that is not finite")]
    BadModel,
    /// The loop itself was not run for this long (a debugger, a suspended machine), s.
    #[error("the loop was not run for {0} s")]
    Stalled(f64),
    /// Positions are not valid until the device is calibrated. A device that returns this fault
    /// from [`HapticDevice::exchange`] is asked for its [`calibration`](HapticDevice::calibration)
    /// again.
    #[error("the device needs calibration")]
    NotCalibrated,
    /// Somebody pressed the emergency stop.
    #[error("emergency stop")]
    EmergencyStop,
    /// The driver panicked, and its loop has ended. The device does not come back until the app
    /// adds it again.
    #[error("the driver panicked; its loop is over")]
    Panicked,
    /// The force is switched off at the device, see [`Sample::force_on`].
    #[error("the force is switched off at the device")]
    ForceOff,
    /// The driver's own scheduler did not run what it was given, so nothing was sent or measured.
    #[error("the driver's scheduler does not run")]
    NotRun,
    /// A call of the driver has not returned for this long, s. The device's [`StopHandle`] has cut
    /// the force, if there is one.
    #[error("the driver has not answered for {0} s")]
    Hung(f64),
}

impl Fault {
    /// Returns a small number for each kind, in the order of the variants. It serves as an index
    /// into counters.
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
            Self::ForceOff => 14,
            Self::NotRun => 15,
            Self::Hung(_) => 16,
        }
    }

    /// Number of kinds of faults.
    pub const KINDS: usize = 17;
}

/// One period of the loop with its measured times.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Period {
    /// Time of the period's end since the loop began, s.
    pub now: f64,
    /// Length of the period, s.
    pub dt: f64,
    /// Lateness of the period's end, s.
    pub late: f64,
    /// Number of whole periods that were skipped to catch up.
    pub missed: u32,
}

/// Real or virtual time of the loop. The loop lends the scheduler to the device for the length of
/// an exchange.
pub trait Scheduler {
    /// Waits until the next period begins, and returns the period that ended.
    fn wait(&mut self) -> Period;

    /// Returns the last period that [`wait`](Self::wait) or [`note`](Self::note) ended.
    fn last(&self) -> Period;

    /// Ends the period at the present time, for a device that does the timing itself.
    fn note(&mut self) -> Period;
}

/// Cuts the force of a device from another thread while a call of the device hangs.
///
/// The loop's supervisor calls it on a thread of its own when the device has not come back from
/// [`HapticDevice::exchange`] for 25 ms, or for 10 ms after the emergency stop was pressed. After
/// the cut the device may be called again: its next exchanges must send no force and report
/// [`Sample::force_on`] as `false` until the motors are enabled again, so that the force returns by
/// the ramp.
pub trait StopHandle: Send + Sync {
    /// Cuts the force by whatever way is left. The call may come at any time and more than once,
    /// does nothing to a device that is closed, and may block: each cut has a thread of its own.
    fn cut(&self);
}

/// A haptic device. The device lives on the loop's thread, and only this thread calls it, except
/// for its [`StopHandle`].
pub trait HapticDevice: Send {
    /// Returns the properties of the device. The loop calls this method when it starts and again
    /// after a [`reopen`](Self::reopen).
    fn info(&self) -> DeviceInfo;

    /// Says whether the loop or the device does the timing.
    fn pacing(&self) -> Pacing {
        Pacing::Loop
    }

    /// Returns the state of the calibration. The loop calls this method until positions are valid.
    fn calibration(&mut self) -> Calibration {
        Calibration::Ready
    }

    /// Applies `wrench`, waits for one period (`scheduler.wait()`, or the device's own servo and
    /// then `scheduler.note()`) and returns the state of the device at its end. The wrench is held
    /// from the start of the call. In this order a force never waits a period for its turn.
    ///
    /// # Errors
    /// Returns the fault. The loop fades the force and calls again, so a device that is gone
    /// permanently must return its fault each time.
    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault>;

    /// Cuts all force at once. The loop calls this method at the end, after a loss and at an
    /// emergency stop. It does nothing on a device that is gone. An implementation must call it
    /// when the device is dropped.
    fn safe_stop(&mut self);

    /// Returns the way to cut the force while a call of this device hangs. The loop calls this
    /// method once when it starts, so the handle must stay valid when the device is reopened. The
    /// default is `None`, for a device without motors.
    fn stop_handle(&self) -> Option<Arc<dyn StopHandle>> {
        None
    }

    /// Tries to reopen a lost device. The loop calls this method about once per second while the
    /// device is lost, and the call may block.
    ///
    /// # Errors
    /// Returns [`Fault::Gone`] as long as the device is not there. A device that cannot come back
    /// always returns this fault, which is the default.
    fn reopen(&mut self) -> Result<(), Fault> {
        Err(Fault::Gone)
    }
}

/// An output that vibrates without a position and without a force in newtons: a gamepad's motors or
/// a phone.
pub trait VibrationOutput: Send {
    /// Vibrates with `strong` (low frequency) and `weak` (high frequency) at 0 to 1 for `seconds`.
    /// Values outside are clamped, and NaN counts as 0.
    fn vibrate(&mut self, strong: f64, weak: f64, seconds: f64);

    /// Stops the vibration at once.
    fn stop(&mut self);
}
