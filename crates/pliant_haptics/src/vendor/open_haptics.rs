//! 3D Systems devices (Touch, Touch X, Omni, Premium) through OpenHaptics' HDAPI, `libHD.so` or
//! `hd.dll`, version 3.
//!
//! The library's own servo thread does the timing of the loop: each exchange schedules one callback
//! and waits for it. The device axes already are Bevy's (x right, y up, z toward the user). Lengths
//! are in millimeters, forces in newtons.
//!
//! HDAPI takes work for its servo thread from any thread, so the supervisor schedules a callback
//! that sends no force and switches the force output off. If the servo does not run it in 10 ms,
//! the supervisor stops the scheduler. It makes both calls on threads of their own, because each of
//! them may hang as well. HDAPI has no call that sets the time of the hardware's own
//! watchdog. The maker's example `ErrorHandling` says that the hardware "needs frequent updates to
//! stay alive"; how long it waits is not published.
//!
//! Constants and layouts are those of `hdDefines.h` of OpenHaptics 3 (build 3.00.66): `HDErrorInfo`
//! is `HDerror` (unsigned 32 bit) at 0, `int` at 4 and `HHD` (unsigned 32 bit) at 8; `HDboolean` is
//! an unsigned char; `HDulong` is `unsigned long`, of 8 bytes on Linux and 4 on Windows.

mod info;
mod scheduler;
mod servo;
#[cfg(test)]
mod tests;

use std::ffi::{CString, c_char, c_int, c_uchar, c_uint, c_ulong, c_ushort, c_void};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use libloading::Library;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};

use super::{VendorError, functions, load, text};
use crate::{
    Calibration, DeviceInfo, Fault, HapticDevice, Pacing, Sample, Scheduler, StopHandle, Wrench,
    control_loop::sync,
    device::{link::Link, renewal::Renewal},
};
use info::{describe, read_info};
use servo::{HdForceSwitch, HdStop, PRIORITY, SCHEDULER, ScheduledFrame, servo, soon, turn_to_open};

/// Handle of a device.
type Handle = c_uint;
const INVALID: Handle = 0xFFFF_FFFF;

/// `HDErrorInfo`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
struct ErrorInfo {
    code: c_uint,
    internal: c_int,
    device: Handle,
}

const _: () = assert!(size_of::<ErrorInfo>() == 12, "HDErrorInfo is three 32-bit words");
const _: () = assert!(
    std::mem::offset_of!(ErrorInfo, code) == 0
        && std::mem::offset_of!(ErrorInfo, internal) == 4
        && std::mem::offset_of!(ErrorInfo, device) == 8,
    "errorCode, internalErrorCode, hHD"
);

// These values come from hdDefines.h.
const CURRENT_SAFETY_SWITCH: c_uint = 0x2001;
const CURRENT_BUTTONS: c_uint = 0x2000;
const CURRENT_POSITION: c_uint = 0x2050;
const CURRENT_VELOCITY: c_uint = 0x2051;
const CURRENT_TRANSFORM: c_uint = 0x2052;
const VERSION: c_uint = 0x2500;
const DEVICE_MODEL_TYPE: c_uint = 0x2501;
const DEVICE_SERIAL_NUMBER: c_uint = 0x2504;
const USABLE_WORKSPACE_DIMENSIONS: c_uint = 0x2551;
const CALIBRATION_STYLE: c_uint = 0x2555;
const NOMINAL_MAX_STIFFNESS: c_uint = 0x2602;
const NOMINAL_MAX_FORCE: c_uint = 0x2603;
const NOMINAL_MAX_CONTINUOUS_FORCE: c_uint = 0x2604;
const NOMINAL_MAX_DAMPING: c_uint = 0x2609;
const CURRENT_FORCE: c_uint = 0x2700;
const FORCE_OUTPUT: c_uint = 0x4000;
const CALIBRATION_OK: c_uint = 0x5000;
const CALIBRATION_NEEDS_UPDATE: c_uint = 0x5001;
const CALIBRATION_AUTO: c_int = 1 << 1;
const CALIBRATION_INKWELL: c_int = 1 << 2;
const BAD_HANDLE: c_uint = 0x0104;
/// Most errors that are taken from the library's stack at once.
const MAX_ERRORS: usize = 256;

type Callback = unsafe extern "system" fn(*mut c_void) -> c_uint;

functions! {
    /// HDAPI, as hd.h, hdDevice.h and hdScheduler.h declare it.
    struct OpenHapticsApi {
        init = "hdInitDevice": fn(*const c_char) -> Handle;
        close = "hdDisableDevice": fn(Handle);
        make_current = "hdMakeCurrentDevice": fn(Handle);
        begin = "hdBeginFrame": fn(Handle);
        end = "hdEndFrame": fn(Handle);
        enable = "hdEnable": fn(c_uint);
        disable = "hdDisable": fn(c_uint);
        is_enabled = "hdIsEnabled": fn(c_uint) -> c_uchar;
        get_boolean = "hdGetBooleanv": fn(c_uint, *mut c_uchar);
        get_double = "hdGetDoublev": fn(c_uint, *mut f64);
        set_double = "hdSetDoublev": fn(c_uint, *const f64);
        get_integer = "hdGetIntegerv": fn(c_uint, *mut c_int);
        get_string = "hdGetString": fn(c_uint) -> *const c_char;
        get_error = "hdGetError": fn() -> ErrorInfo;
        check_calibration = "hdCheckCalibration": fn() -> c_uint;
        update_calibration = "hdUpdateCalibration": fn(c_uint);
        start = "hdStartScheduler": fn();
        stop = "hdStopScheduler": fn();
        set_rate = "hdSetSchedulerRate": fn(c_ulong);
        run = "hdScheduleSynchronous": fn(Callback, *mut c_void, c_ushort);
        post = "hdScheduleAsynchronous": fn(Callback, *mut c_void, c_ushort) -> c_ulong;
    }
}

impl OpenHapticsApi {
    /// Takes all errors from the library's stack, which returns the newest first, and returns the
    /// oldest, which is the cause of the others. A bad handle goes before everything else.
    ///
    /// # Safety
    /// The library is loaded.
    unsafe fn drain(&self) -> ErrorInfo {
        let mut cause = ErrorInfo::default();
        for _ in 0..MAX_ERRORS {
            // SAFETY: the function takes nothing and keeps nothing.
            let error = unsafe { (self.get_error)() };
            if error.code == 0 {
                break;
            }
            if cause.code != BAD_HANDLE {
                cause = error;
            }
        }
        cause
    }
}

/// Choice of the device and of the library.
#[derive(Debug, Clone, PartialEq)]
pub struct OpenHapticsConfig {
    /// Path of the library. With `None` the library is searched by its usual names. Default:
    /// `None`.
    pub library: Option<PathBuf>,
    /// Name of the device in the vendor's setup. With `None` the default device is used. Default:
    /// `None`.
    pub device: Option<String>,
    /// Rate of the library's servo thread, Hz: 500 or 1000 on most devices. Default: 1000.
    pub rate: f64,
}

impl Default for OpenHapticsConfig {
    fn default() -> Self {
        Self { library: None, device: None, rate: 1000.0 }
    }
}

/// A 3D Systems device.
pub struct OpenHaptics {
    api: OpenHapticsApi,
    config: OpenHapticsConfig,
    handle: Option<Handle>,
    info: DeviceInfo,
    switch: Arc<HdForceSwitch>,
    renewal: Renewal,
    /// Whether the last force was sent too late, so that the next one must be zero.
    late: bool,
    /// The stylus' safety switch in the last frame: whether a hand holds it. `None` on devices
    /// without such a switch.
    held: Option<bool>,
    /// Whether the switch has ever been seen closed. What an open one means before is not known.
    was_held: bool,
    frame: Arc<ScheduledFrame>,
    /// Whether the scheduler did not run the last frame. The frame is its own from then on, because
    /// it may run it at any time, and the device gets another one when it is opened again.
    dead: bool,
}

impl OpenHaptics {
    /// Loads the library and opens the device. The forces are enabled, and they are zero until the
    /// loop runs.
    ///
    /// # Errors
    /// Returns an error if there is no library, if it lacks a function of version 3 or is older, or
    /// if there is no device.
    pub fn open(config: OpenHapticsConfig) -> Result<Self, VendorError> {
        let names =
            if cfg!(windows) { &["hd.dll"][..] } else { &["libHD.so", "libHD.so.3", "libHD.so.3.4"][..] };
        let (library, path) = load(config.library.as_ref(), names)?;
        let api = OpenHapticsApi::from(&library, &path)?;
        let mut device = Self::closed(api, Arc::new(library), config);
        device.connect()?;
        // SAFETY: the library returns a static string.
        let version = unsafe { text((api.get_string)(VERSION)) };
        if version.split('.').next().and_then(|n| n.parse::<u32>().ok()).is_some_and(|major| major < 3) {
            return Err(VendorError::Version { library: path, found: version, needed: "3" });
        }
        Ok(device)
    }

    /// A device that is not open yet.
    fn closed(api: OpenHapticsApi, library: Arc<Library>, config: OpenHapticsConfig) -> Self {
        let switch =
            HdForceSwitch { api, link: Link::new(), posting: AtomicBool::new(false), _library: library };
        let switch = Arc::new(switch);
        Self {
            api,
            handle: None,
            info: describe(&config),
            config,
            frame: ScheduledFrame::new(switch.clone()),
            switch,
            renewal: Renewal::default(),
            late: false,
            held: None,
            was_held: false,
            dead: false,
        }
    }

    fn connect(&mut self) -> Result<(), VendorError> {
        let name = self.config.device.as_deref().map(CString::new).transpose().map_err(|_| {
            VendorError::Device { what: "the device's name", code: 0, text: "has a zero in it".into() }
        })?;
        let api = self.api;
        let refused = |what, code: c_uint, text: &str| VendorError::Device {
            what,
            code: code.into(),
            text: text.into(),
        };
        const BUSY: &str = "another thread opens or closes a device, or cuts its force, and hangs";
        let _turn = turn_to_open().ok_or_else(|| refused("hdInitDevice", 0, BUSY))?;
        if !self.switch.link.begin() {
            return Err(refused("hdDisable", 0, BUSY));
        }
        // SAFETY: the name is a C string, or null for the default device. The rest follows the
        // order of the vendor's examples.
        let handle = unsafe {
            let handle = (api.init)(name.as_ref().map_or(std::ptr::null(), |n| n.as_ptr()));
            let error = api.drain();
            if handle == INVALID || error.code != 0 {
                return Err(refused("hdInitDevice", error.code, ""));
            }
            (api.make_current)(handle);
            self.info = read_info(&api, &self.config);
            (api.enable)(FORCE_OUTPUT);
            let error = api.drain();
            if error.code != 0 {
                (api.close)(handle);
                return Err(refused("hdEnable", error.code, ""));
            }
            handle
        };
        let start = || {
            // SAFETY: all arguments are plain values.
            let error = unsafe {
                (api.set_rate)(self.config.rate.clamp(100.0, 8000.0) as c_ulong);
                // A rate that the device does not support is an error that keeps the old rate.
                let _ = api.drain();
                (api.start)();
                api.drain()
            };
            if error.code == 0 { Ok(()) } else { Err(refused("hdStartScheduler", error.code, "")) }
        };
        let started = soon(|| SCHEDULER.enter(start));
        if let Err(error) = started.unwrap_or_else(|| Err(refused("hdStartScheduler", 0, BUSY))) {
            // SAFETY: nobody uses the handle after this.
            unsafe { (api.close)(handle) };
            return Err(error);
        }
        self.handle = Some(handle);
        if std::mem::take(&mut self.dead) {
            // The scheduler may still run the frame before.
            self.frame = ScheduledFrame::new(self.switch.clone());
        }
        (self.renewal, self.late, self.held) = (Renewal::default(), false, None);
        self.switch.link.open(handle);
        Ok(())
    }

    fn disconnect(&mut self) {
        let Some(handle) = self.handle else { return };
        let left = !matches!(self.frame([0.0; 3], true), Err(Fault::NotRun));
        self.switch.link.close();
        self.handle = None;
        // A device is closed in any case, also if another one hangs.
        let _turn = turn_to_open();
        // SAFETY: this value owns the handle and does not use it again.
        unsafe {
            if !left {
                (self.api.make_current)(handle);
                (self.api.disable)(FORCE_OUTPUT);
            }
            SCHEDULER.leave(|| (self.api.stop)());
            (self.api.close)(handle);
            let _ = self.api.drain();
        }
    }

    /// Runs one frame on the servo thread. With `leave` the force output is switched off after it.
    fn frame(&mut self, force: [f64; 3], leave: bool) -> Result<Sample, Fault> {
        let device = self.handle.ok_or(Fault::Gone)?;
        if self.dead {
            return Err(Fault::NotRun);
        }
        let mut frame = self.frame.data();
        (frame.device, frame.force, frame.leave) = (device, force, leave);
        frame.idle = leave || self.late || self.renewal.has_lapsed();
        (frame.held, frame.was_held) = (self.held, self.was_held);
        (frame.force_on, frame.buttons) = (false, 0);
        (frame.position, frame.velocity, frame.transform) = ([f64::NAN; 3], [0.0; 3], [0.0; 16]);
        frame.error = ErrorInfo::default();
        drop(frame);
        self.frame.turn.ask();
        let count = Arc::into_raw(self.frame.clone()).cast_mut();
        // SAFETY: the callback takes over the count. A scheduler that never runs it leaves the
        // count behind.
        unsafe { (self.api.run)(servo, count.cast(), PRIORITY) };
        let ran = self.frame.turn.take();
        if !ran {
            // The call has returned without having run the callback, and maybe without an error.
            // The motors still have the last force.
            self.dead = true;
            // SAFETY: the library is loaded.
            let _ = unsafe { self.api.drain() };
            HdStop(self.switch.clone()).cut();
            return Err(Fault::NotRun);
        }
        let frame = self.frame.data();
        self.held = frame.held;
        self.was_held |= frame.held == Some(true);
        self.late = self.renewal.renew();
        match frame.error.code {
            0 => {}
            BAD_HANDLE => return Err(Fault::Gone),
            code => return Err(Fault::Driver(code.into())),
        }
        let t = frame.transform;
        let rotation = Matrix3::new(t[0], t[4], t[8], t[1], t[5], t[9], t[2], t[6], t[10]);
        // A device without a gimbal reports no rotation at all.
        let turned = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
        let q = if rotation.determinant() > 0.5 { turned } else { UnitQuaternion::identity() };
        Ok(Sample {
            position: frame.position.map(|x| 1e-3 * x),
            orientation: [q.i, q.j, q.k, q.w],
            velocity: Some(frame.velocity.map(|x| 1e-3 * x)),
            buttons: frame.buttons as u32,
            force_on: frame.force_on && !self.late,
            sequence: None,
        })
    }
}

impl HapticDevice for OpenHaptics {
    fn info(&self) -> DeviceInfo {
        self.info.clone()
    }

    fn stop_handle(&self) -> Option<Arc<dyn StopHandle>> {
        Some(Arc::new(HdStop(self.switch.clone())))
    }

    fn pacing(&self) -> Pacing {
        Pacing::Device(self.config.rate)
    }

    fn calibration(&mut self) -> Calibration {
        let Some(handle) = self.handle else {
            return Calibration::Needed("connect the device");
        };
        // SAFETY: this value owns the open device. The calls below use the current device, which
        // may be another one of this process, so this device is made current first.
        unsafe {
            (self.api.make_current)(handle);
            match (self.api.check_calibration)() {
                CALIBRATION_OK => Calibration::Ready,
                state => {
                    let mut styles: c_int = 0;
                    (self.api.get_integer)(CALIBRATION_STYLE, &raw mut styles);
                    let inkwell = styles & CALIBRATION_INKWELL != 0;
                    if state == CALIBRATION_NEEDS_UPDATE {
                        let style = if inkwell { CALIBRATION_INKWELL } else { CALIBRATION_AUTO };
                        (self.api.update_calibration)(style as c_uint);
                        if (self.api.check_calibration)() == CALIBRATION_OK {
                            let _ = self.api.drain();
                            return Calibration::Ready;
                        }
                    }
                    let _ = self.api.drain();
                    if inkwell {
                        Calibration::Needed("put the stylus into its inkwell")
                    } else {
                        Calibration::Needed("move the handle through its whole workspace")
                    }
                }
            }
        }
    }

    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        let sample = self.frame(wrench.force, false);
        scheduler.note();
        sample
    }

    fn safe_stop(&mut self) {
        if self.handle.is_some() {
            let _ = self.frame([0.0; 3], false);
        }
    }

    fn reopen(&mut self) -> Result<(), Fault> {
        self.disconnect();
        self.connect().map_err(|_| Fault::Gone)
    }
}

impl Drop for OpenHaptics {
    fn drop(&mut self) {
        self.safe_stop();
        self.disconnect();
    }
}

impl std::fmt::Debug for OpenHaptics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("OpenHaptics").field("info", &self.info).finish_non_exhaustive()
    }
}
