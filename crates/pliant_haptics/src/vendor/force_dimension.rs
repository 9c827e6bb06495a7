//! Force Dimension devices (omega, delta, sigma, lambda; Novint Falcon) through the vendor's DHD
//! library, version 3.
//!
//! If the device is to find its reference by itself, the driver uses the vendor's DRD library,
//! which has the same functions and additional robotic ones. The loop does the timing. The vendor's
//! axes are x toward the user, y right, z up, in meters and newtons. Bevy's axes are (y, z, x).

//!
//! The device's firmware switches the force off by itself when no command has come for 20 ms
//! (`dhdSetWatchdog`, from version 3.3.2 of the library on). The loop's supervisor switches it off
//! by `dhdEnableForce` from its own thread. The library keeps its last error per thread and takes
//! the device with every call; its documentation says no more about threads.

use std::{
    ffi::{c_char, c_int, c_uchar, c_uint},
    path::PathBuf,
    sync::Arc,
};

use libloading::Library;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};

use super::{VendorError, functions, load, text};
use crate::{
    Calibration, DeviceInfo, Fault, HapticDevice, Sample, Scheduler, StopHandle, Wrench,
    device::{
        link::{Link, Seen},
        renewal::{LAPSE, Renewal},
    },
};

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

functions! {
    /// Functions of the expert part of DHD, which older versions lack.
    struct Watchdog {
        expert = "dhdEnableExpertMode": fn() -> c_int;
        no_expert = "dhdDisableExpertMode": fn() -> c_int;
        set = "dhdSetWatchdog": fn(c_uchar, c_char) -> c_int;
    }
}

/// The firmware's time without a command after which it switches the force off, in its units of
/// 125 us.
const WATCHDOG: c_uchar = (LAPSE.as_micros() / 125) as c_uchar;
const _: () = assert!(WATCHDOG as u128 * 125 == LAPSE.as_micros());

/// Index in the status that says whether the device knows its position.
const STATUS_RESET: usize = 3;
/// Index in the status that says whether the force is switched on.
const STATUS_FORCE: usize = 5;
/// Index in the status that says why the force is switched off.
const STATUS_FORCE_OFF_CAUSE: usize = 14;
/// The firmware's watchdog switched the force off.
const CAUSE_WATCHDOG: c_int = 3;
/// The software switched the force off.
const CAUSE_SOFTWARE: c_int = 4;
/// Number of exchanges from one look at the status to the next. What the look costs on a real
/// device is not known.
const STATUS_EVERY: u32 = 8;
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
    /// **The device then drives through its workspace with its own motors** for some seconds. When
    /// it is opened for the first time, Pliant's emergency stop does not reach it meanwhile; when
    /// it comes back in a running loop, the stop ends the drive by `drdStop`, and a latched stop
    /// keeps the device closed. Keep hands off, and keep a thumb on the device's own switch. This
    /// setting needs the vendor's DRD library. Default: `false`, the user moves the device by hand.
    pub auto_init: bool,
    /// Index of the device among the connected devices, from 0. Default: 0.
    pub index: u8,
}

/// A Force Dimension device.
pub struct ForceDimension {
    api: ForceDimensionApi,
    robotic: Option<Robotic>,
    config: ForceDimensionConfig,
    watchdog: Option<Watchdog>,
    id: Option<c_char>,
    info: DeviceInfo,
    switch: Arc<DhdForceSwitch>,
    renewal: Renewal,
    /// Whether the force was off at the last look at the status.
    off: bool,
    exchanges: u32,
    /// This field comes last, so that the library is unloaded after everything that calls into it.
    _library: Arc<Library>,
}

/// Switches the force off from another thread.
struct DhdForceSwitch {
    enable: unsafe extern "system" fn(c_uchar, c_char) -> c_int,
    /// Ends the robotic loop of DRD, which may be driving the device.
    stop: Option<unsafe extern "system" fn(bool, c_char) -> c_int>,
    /// The open device, and whether DRD's loop drives it.
    link: Link<(c_char, bool)>,
    /// The library stays loaded as long as this value can call it.
    _library: Arc<Library>,
}

impl StopHandle for DhdForceSwitch {
    fn cut(&self) {
        let Some(cut) = self.link.cut() else { return };
        let (id, driving) = cut.device;
        // SAFETY: all arguments are plain values, and the library is loaded.
        unsafe {
            if let Some(stop) = self.stop.filter(|_| driving) {
                stop(false, id);
            }
            (self.enable)(0, id);
        }
    }
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
        let watchdog = Watchdog::from(&library, &path).ok();
        let library = Arc::new(library);
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
        let switch = Arc::new(DhdForceSwitch {
            enable: api.enable,
            stop: robotic.map(|r| r.stop),
            link: Link::new(),
            _library: library.clone(),
        });
        let mut device = Self {
            api,
            robotic,
            config,
            watchdog,
            id: None,
            info: describe("", 0, false),
            switch,
            renewal: Renewal::default(),
            off: false,
            exchanges: 0,
            _library: library,
        };
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
        // What was cut was the device before. A cut from here on is the emergency stop.
        if !self.switch.link.begin() {
            let text = "a call that cut the force has not returned".into();
            return Err(VendorError::Device { what: "dhdEnableForce", code: 0, text });
        }
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
            (self.renewal, self.off, self.exchanges) = (Renewal::default(), false, 0);
            if let Some(robotic) = &self.robotic
                && (robotic.supported)(id)
                && !(robotic.initialized)(id)
            {
                // A cut before the device was open has reached nothing. The supervisor repeats a
                // cut that comes between this look and the drive.
                let clear = self.switch.link.open((id, true));
                let found = if clear { (robotic.auto_init)(id) } else { -1 };
                // The control loop of the library is stopped in any case. The forces stay enabled
                // for Pliant's own loop.
                let stopped = (robotic.stop)(true, id);
                if found < 0 || stopped < 0 || !self.switch.link.open((id, false)) {
                    let error = refused("drdAutoInit");
                    self.disconnect();
                    return Err(error);
                }
            } else {
                self.switch.link.open((id, false));
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
        self.arm_watchdog();
        Ok(())
    }

    /// Asks the firmware to switch the force off when no command has come for [`LAPSE`].
    fn arm_watchdog(&self) {
        let Some(id) = self.id else { return };
        let armed = self.watchdog.is_some_and(|watchdog| {
            // SAFETY: all arguments are plain values.
            unsafe {
                (watchdog.expert)();
                let set = (watchdog.set)(WATCHDOG, id);
                (watchdog.no_expert)();
                set >= 0
            }
        });
        if !armed {
            tracing::warn!(
                device = self.info.name,
                "the device or its library has no watchdog: if this program is killed or stopped, its force may stay on"
            );
        }
    }

    fn disconnect(&mut self) {
        self.switch.link.close();
        if let Some(id) = self.id.take() {
            // SAFETY: this value owns the id and does not use it again.
            unsafe {
                (self.api.enable)(0, id);
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

impl ForceDimension {
    fn status(&self, id: c_char) -> Result<[c_int; STATUS_ROOM], Fault> {
        let mut status = [0 as c_int; STATUS_ROOM];
        // SAFETY: the array has room for more than any version writes.
        self.check(unsafe { (self.api.status)(status.as_mut_ptr(), id) })?;
        Ok(status)
    }

    /// Looks at whether the force is on, and switches it on if it was this program or the watchdog
    /// that switched it off and no force is sent: `idle` is what the driver had seen of the cuts
    /// before. What the user has switched off at the device stays off.
    fn look_at_force(&mut self, id: c_char, idle: Option<Seen>) -> Result<(), Fault> {
        let status = self.status(id)?;
        if status[STATUS_RESET] == 0 {
            return Err(Fault::NotCalibrated);
        }
        self.off = status[STATUS_FORCE] == 0;
        let Some(seen) = idle else { return Ok(()) };
        let cause = status[STATUS_FORCE_OFF_CAUSE];
        // Older versions of the library do not tell the cause.
        let ours = matches!(cause, CAUSE_WATCHDOG | CAUSE_SOFTWARE) || (cause == 0 && seen.cut);
        if self.off && ours {
            // The force counts as off until the next look.
            // SAFETY: all arguments are plain values.
            self.check(unsafe { (self.api.enable)(1, id) })?;
        }
        self.switch.link.answer(seen);
        Ok(())
    }
}

impl HapticDevice for ForceDimension {
    fn info(&self) -> DeviceInfo {
        self.info.clone()
    }

    fn stop_handle(&self) -> Option<Arc<dyn StopHandle>> {
        Some(self.switch.clone())
    }

    fn calibration(&mut self) -> Calibration {
        let Some(id) = self.id else { return Calibration::Needed("connect the device") };
        if self.status(id).is_ok_and(|status| status[STATUS_RESET] != 0) {
            Calibration::Ready
        } else {
            Calibration::Needed(
                "initialize the device with its maker's HapticInit, move the handle to all its end stops, or let it find them (`auto_init`)",
            )
        }
    }

    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        let Some(id) = self.id else {
            scheduler.wait();
            return Err(Fault::Gone);
        };
        // A force that is switched on again must begin at zero, whoever switches it on.
        let seen = self.switch.link.seen();
        let idle = self.off || self.renewal.has_lapsed() || seen.cut;
        let wrench = if idle { &Wrench::ZERO } else { wrench };
        let [fx, fy, fz] = to_device(wrench.force);
        let [tx, ty, tz] = to_device(wrench.torque);
        // SAFETY: all arguments are plain values.
        let set = unsafe { (self.api.wrench)(fx, fy, fz, tx, ty, tz, id) };
        // A call that itself took too long has lost its force as well.
        let late = self.renewal.renew() || self.switch.link.seen().cut;
        scheduler.wait();
        let sent = self.check(set);
        if idle || late || sent.is_err() || self.exchanges.is_multiple_of(STATUS_EVERY) {
            self.look_at_force(id, idle.then_some(seen))?;
        }
        if !self.off {
            // A force that is refused because it is switched off at the device is no error.
            sent?;
        }
        self.exchanges = self.exchanges.wrapping_add(1);
        let force_on = !(idle || late || self.off);
        self.off |= late;
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
            force_on,
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
