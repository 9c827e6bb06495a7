//! Force Dimension devices (omega, delta, sigma, lambda; Novint Falcon) through the vendor's DHD
//! library, version 3.
//!
//! If the device is to find its reference by itself, the driver uses the vendor's DRD library,
//! which has the same functions and additional robotic ones. The loop does the timing. The vendor's
//! axes are x toward the user, y right, z up, in meters and newtons. Bevy's axes are (y, z, x).

use std::{
    ffi::{c_char, c_int, c_uchar, c_uint},
    path::PathBuf,
};

use libloading::Library;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};

use super::{VendorError, functions, load, text};
use crate::{Calibration, DeviceInfo, Fault, HapticDevice, Sample, Scheduler, Wrench};

functions! {
    /// DHD, as dhdc.h declares it.
    struct ForceDimensionApi {
        version = "dhdGetSDKVersion": fn(*mut c_int, *mut c_int, *mut c_int, *mut c_int);
        count = "dhdGetDeviceCount": fn() -> c_int;
        open_id = "dhdOpenID": fn(c_char) -> c_int;
        close = "dhdClose": fn(c_char) -> c_int;
        name = "dhdGetSystemName": fn(c_char) -> *const c_char;
        serial = "dhdGetSerialNumber": fn(*mut u16, c_char) -> c_int;
        status = "dhdGetStatus": fn(*mut c_int, c_char) -> c_int;
        enable = "dhdEnableForce": fn(c_uchar, c_char) -> c_int;
        pose = "dhdGetPositionAndOrientationFrame": fn(*mut f64, *mut f64, *mut f64, *mut [f64; 3], c_char) -> c_int;
        velocity = "dhdGetLinearVelocity": fn(*mut f64, *mut f64, *mut f64, c_char) -> c_int;
        buttons = "dhdGetButtonMask": fn(c_char) -> c_uint;
        wrench = "dhdSetForceAndTorque": fn(f64, f64, f64, f64, f64, f64, c_char) -> c_int;
        active_wrist = "dhdHasActiveWrist": fn(c_char) -> bool;
        error = "dhdErrorGetLast": fn() -> c_int;
        error_text = "dhdErrorGetLastStr": fn() -> *const c_char;
    }
}

functions! {
    /// DRD's own functions, as drdc.h declares them.
    struct Robotic {
        open_id = "drdOpenID": fn(c_char) -> c_int;
        close = "drdClose": fn(c_char) -> c_int;
        supported = "drdIsSupported": fn(c_char) -> bool;
        initialized = "drdIsInitialized": fn(c_char) -> bool;
        auto_init = "drdAutoInit": fn(c_char) -> c_int;
        stop = "drdStop": fn(bool, c_char) -> c_int;
    }
}

/// Index in the status that says whether the device knows its position.
const STATUS_RESET: usize = 3;
/// Length of the status array. It is more than any version of the library writes.
const STATUS_ROOM: usize = 64;

/// Choice of the device and of the library.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct ForceDimensionConfig {
    /// Path of the library. With `None` the library is searched by its usual names. Default:
    /// `None`.
    pub library: Option<PathBuf>,
    /// Whether a device that does not know its position finds it by itself, when it is opened and
    /// when it comes back.
    ///
    /// **The device then drives through its workspace with its own motors** for some seconds, and
    /// Pliant's emergency stop does not reach it meanwhile. Keep hands off, and keep a thumb on the
    /// device's own switch. This setting needs the vendor's DRD library. Default: `false`, the user
    /// moves the device by hand.
    pub auto_init: bool,
    /// Index of the device among the connected devices, from 0. Default: 0.
    pub index: u8,
}

/// A Force Dimension device.
pub struct ForceDimension {
    api: ForceDimensionApi,
    robotic: Option<Robotic>,
    config: ForceDimensionConfig,
    id: Option<c_char>,
    info: DeviceInfo,
    /// This field comes last, so that the library is unloaded after everything that calls into it.
    _library: Library,
}

impl ForceDimension {
    /// Loads the library and opens the device. The forces are enabled, and they are zero until the
    /// loop runs.
    ///
    /// # Errors
    /// Returns an error if there is no library, if it is older than 3 or lacks a function, if there
    /// is no such device, or if the device could not find its reference by itself as requested.
    pub fn open(config: ForceDimensionConfig) -> Result<Self, VendorError> {
        let names = if config.auto_init { ROBOTIC_NAMES } else { NAMES };
        let (library, path) = load(config.library.as_ref(), names)?;
        let api = ForceDimensionApi::from(&library, &path)?;
        let robotic = if config.auto_init { Some(Robotic::from(&library, &path)?) } else { None };
        let mut v = [0 as c_int; 4];
        // SAFETY: the header specifies four integers.
        unsafe {
            let at = v.as_mut_ptr();
            (api.version)(at, at.add(1), at.add(2), at.add(3));
        }
        if v[0] < 3 {
            let found = format!("{}.{}.{}.{}", v[0], v[1], v[2], v[3]);
            return Err(VendorError::Version { library: path, found, needed: "3" });
        }
        let mut device =
            Self { api, robotic, config, id: None, info: describe("", 0, false), _library: library };
        device.connect()?;
        Ok(device)
    }

    /// Returns the number of connected devices.
    ///
    /// # Errors
    /// Returns an error if there is no library or it lacks a function.
    pub fn count(config: &ForceDimensionConfig) -> Result<usize, VendorError> {
        let (library, path) = load(config.library.as_ref(), NAMES)?;
        let api = ForceDimensionApi::from(&library, &path)?;
        // SAFETY: the function takes nothing and keeps nothing.
        Ok(unsafe { (api.count)() }.max(0) as usize)
    }

    fn connect(&mut self) -> Result<(), VendorError> {
        let api = self.api;
        // SAFETY: arguments and results are plain values. The library owns the strings.
        unsafe {
            let refused = |what| VendorError::Device {
                what,
                code: (api.error)().into(),
                text: text((api.error_text)()),
            };
            let index = self.config.index as c_char;
            let id = match &self.robotic {
                Some(robotic) => (robotic.open_id)(index),
                None => (api.open_id)(index),
            };
            if id < 0 {
                return Err(refused(if self.robotic.is_some() { "drdOpenID" } else { "dhdOpenID" }));
            }
            let id = id as c_char;
            self.id = Some(id);
            if let Some(robotic) = &self.robotic
                && (robotic.supported)(id)
                && !(robotic.initialized)(id)
            {
                let found = (robotic.auto_init)(id);
                // The control loop of the library is stopped in any case. The forces stay enabled
                // for Pliant's own loop.
                let stopped = (robotic.stop)(true, id);
                if found < 0 || stopped < 0 {
                    let error = refused("drdAutoInit");
                    self.disconnect();
                    return Err(error);
                }
            }
            let mut serial = 0u16;
            let _ = (api.serial)(&raw mut serial, id);
            self.info = describe(&text((api.name)(id)), serial, (api.active_wrist)(id));
            (api.wrench)(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, id);
            if (api.enable)(1, id) < 0 {
                let error = refused("dhdEnableForce");
                self.disconnect();
                return Err(error);
            }
        }
        Ok(())
    }

    fn disconnect(&mut self) {
        if let Some(id) = self.id.take() {
            // SAFETY: this value owns the id and does not use it again.
            unsafe {
                match &self.robotic {
                    Some(robotic) => (robotic.close)(id),
                    None => (self.api.close)(id),
                };
            }
        }
    }

    /// Turns a result into an error if it is below zero. Zero and the time guard's one are no
    /// errors.
    fn check(&self, result: c_int) -> Result<(), Fault> {
        if result >= 0 {
            return Ok(());
        }
        // SAFETY: the function takes nothing and keeps nothing.
        Err(Fault::Driver(unsafe { (self.api.error)() }.into()))
    }
}

#[cfg(windows)]
const NAMES: &[&str] = &["dhd64.dll", "dhd.dll"];
#[cfg(target_os = "macos")]
const NAMES: &[&str] = &["libdhd.dylib", "libdhd.3.dylib"];
#[cfg(not(any(windows, target_os = "macos")))]
const NAMES: &[&str] = &["libdhd.so", "libdhd.so.3"];

#[cfg(windows)]
const ROBOTIC_NAMES: &[&str] = &["drd64.dll", "drd.dll"];
#[cfg(target_os = "macos")]
const ROBOTIC_NAMES: &[&str] = &["libdrd.dylib", "libdrd.3.dylib"];
#[cfg(not(any(windows, target_os = "macos")))]
const ROBOTIC_NAMES: &[&str] = &["libdrd.so", "libdrd.so.3"];

/// Returns the properties of a device. The library does not report them, so they come from the
/// vendors' data sheets by name, with a cautious estimate for the rest.
fn describe(name: &str, serial: u16, active_wrist: bool) -> DeviceInfo {
    let lower = name.to_lowercase();
    let (force, stiffness, damping, mass) = [
        ("omega", (12.0, 5000.0, 30.0, 0.2)),
        ("delta", (20.0, 5000.0, 30.0, 0.25)),
        ("sigma", (20.0, 5000.0, 30.0, 0.3)),
        ("lambda", (20.0, 5000.0, 30.0, 0.3)),
        ("falcon", (8.0, 2000.0, 10.0, 0.15)),
    ]
    .into_iter()
    .find(|(known, _)| lower.contains(known))
    .map_or((5.0, 1000.0, 5.0, 0.1), |(_, numbers)| numbers);
    DeviceInfo {
        name: if name.is_empty() { "Force Dimension device".into() } else { name.into() },
        serial: serial.to_string(),
        peak_force: force,
        continuous_force: force,
        peak_torque: if active_wrist { 0.2 } else { 0.0 },
        force_axes: [true; 3],
        torque_axes: [active_wrist; 3],
        max_stiffness: stiffness,
        max_damping: damping,
        damping: 0.5,
        friction: 0.1,
        mass,
        resolution: 10e-6,
        delay: 0.0,
        workspace: [[-0.08, -0.055, -0.05], [0.08, 0.055, 0.05]],
        buttons: 8,
        simulated: false,
    }
}

impl HapticDevice for ForceDimension {
    fn info(&self) -> DeviceInfo {
        self.info.clone()
    }

    fn calibration(&mut self) -> Calibration {
        let Some(id) = self.id else { return Calibration::Needed("connect the device") };
        let mut status = [0 as c_int; STATUS_ROOM];
        // SAFETY: the array has room for more than any version writes.
        let result = unsafe { (self.api.status)(status.as_mut_ptr(), id) };
        if result >= 0 && status[STATUS_RESET] != 0 {
            Calibration::Ready
        } else {
            Calibration::Needed(
                "initialise the device with its maker's HapticInit, move the handle to all its end stops, or let it find them (`auto_init`)",
            )
        }
    }

    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        let Some(id) = self.id else {
            scheduler.wait();
            return Err(Fault::Gone);
        };
        let [fx, fy, fz] = to_device(wrench.force);
        let [tx, ty, tz] = to_device(wrench.torque);
        // SAFETY: all arguments are plain values.
        let set = unsafe { (self.api.wrench)(fx, fy, fz, tx, ty, tz, id) };
        scheduler.wait();
        self.check(set)?;
        let (mut p, mut v) = ([f64::NAN; 3], [0.0f64; 3]);
        let mut frame = [[0.0f64; 3]; 3];
        // SAFETY: the header specifies three doubles each and a row-major 3x3 matrix.
        unsafe {
            let at = p.as_mut_ptr();
            self.check((self.api.pose)(at, at.add(1), at.add(2), frame.as_mut_ptr(), id))?;
            let at = v.as_mut_ptr();
            self.check((self.api.velocity)(at, at.add(1), at.add(2), id))?;
        }
        let [a, b, c] = frame;
        let rotation = Matrix3::new(a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]);
        // Both sides change from the vendor's axes to Bevy's.
        let axes = Matrix3::new(0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0);
        let turned = axes * rotation * axes.transpose();
        let q = if turned.determinant() > 0.5 {
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(turned))
        } else {
            UnitQuaternion::identity()
        };
        Ok(Sample {
            position: from_device(p),
            orientation: [q.i, q.j, q.k, q.w],
            velocity: Some(from_device(v)),
            // SAFETY: the argument is a plain value.
            buttons: unsafe { (self.api.buttons)(id) },
            sequence: None,
        })
    }

    fn safe_stop(&mut self) {
        if let Some(id) = self.id {
            // SAFETY: all arguments are plain values.
            unsafe {
                (self.api.wrench)(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, id);
            }
        }
    }

    fn reopen(&mut self) -> Result<(), Fault> {
        self.disconnect();
        self.connect().map_err(|_| Fault::Gone)
    }
}

/// Converts (x toward the user, y right, z up) to (x right, y up, z toward the user).
fn from_device([x, y, z]: [f64; 3]) -> [f64; 3] {
    [y, z, x]
}

fn to_device([x, y, z]: [f64; 3]) -> [f64; 3] {
    [z, x, y]
}

impl Drop for ForceDimension {
    fn drop(&mut self) {
        self.safe_stop();
        self.disconnect();
    }
}

impl std::fmt::Debug for ForceDimension {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ForceDimension").field("info", &self.info).finish_non_exhaustive()
    }
}
