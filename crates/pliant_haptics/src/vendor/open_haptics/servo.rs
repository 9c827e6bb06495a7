//! What runs on the library's servo thread: the frames of the loop, and the supervisor's cut.

use std::ffi::{c_int, c_uchar, c_uint, c_ushort, c_void};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use libloading::Library;

use super::{
    CURRENT_BUTTONS, CURRENT_FORCE, CURRENT_POSITION, CURRENT_SAFETY_SWITCH, CURRENT_TRANSFORM,
    CURRENT_VELOCITY, ErrorInfo, FORCE_OUTPUT, Handle, INVALID, OpenHapticsApi,
};
use crate::StopHandle;

pub(super) const PRIORITY: c_ushort = u16::MAX / 2;

const MAX_PRIORITY: c_ushort = u16::MAX;

const CALLBACK_DONE: c_uint = 0;

/// Time that the servo thread has to run the supervisor's callback.
const SERVO_PATIENCE: Duration = Duration::from_millis(10);

/// The library's scheduler, of which a process has one.
pub(super) struct ServoScheduler {
    /// Number of open devices. The scheduler starts with the first device and stops with the last.
    pub(super) open: usize,
    pub(super) running: bool,
}

pub(super) static SCHEDULER: Mutex<ServoScheduler> = Mutex::new(ServoScheduler { open: 0, running: false });

/// Switches the force off from another thread.
pub(super) struct HdForceSwitch {
    pub(super) api: OpenHapticsApi,
    /// The open device, or [`INVALID`].
    pub(super) handle: AtomicU32,
    pub(super) cut: AtomicBool,
    /// Whether the servo thread has run the last cut.
    pub(super) obeyed: AtomicBool,
    /// The library stays loaded as long as this value can call it.
    pub(super) _library: Arc<Library>,
}

/// Sends no force and switches the force output off, on the servo thread.
///
/// # Safety
/// `data` is one count of an `Arc<HdForceSwitch>`, which this function takes over.
unsafe extern "system" fn cut_force(data: *mut c_void) -> c_uint {
    // SAFETY: the caller passes the count over.
    let switch = unsafe { Arc::from_raw(data.cast_const().cast::<HdForceSwitch>()) };
    let device = switch.handle.load(Ordering::Acquire);
    if device != INVALID {
        let api = switch.api;
        // SAFETY: as in `servo`.
        unsafe {
            (api.begin)(device);
            (api.set_double)(CURRENT_FORCE, [0.0f64; 3].as_ptr());
            (api.end)(device);
            (api.disable)(FORCE_OUTPUT);
            let _ = api.drain();
        }
    }
    switch.obeyed.store(true, Ordering::Release);
    CALLBACK_DONE
}

/// The handle that the loop's supervisor gets.
pub(super) struct HdStop(pub(super) Arc<HdForceSwitch>);

impl StopHandle for HdStop {
    fn cut(&self) {
        let switch = &self.0;
        switch.cut.store(true, Ordering::Release);
        if switch.handle.load(Ordering::Acquire) == INVALID {
            return;
        }
        switch.obeyed.store(false, Ordering::Release);
        let data = Arc::into_raw(switch.clone()).cast_mut().cast();
        // SAFETY: the callback takes over the count. A scheduler that never runs it leaves the few
        // bytes of one count behind.
        unsafe { (switch.api.post)(cut_force, data, MAX_PRIORITY) };
        let posted = Instant::now();
        while !switch.obeyed.load(Ordering::Acquire) {
            if posted.elapsed() >= SERVO_PATIENCE {
                // The servo is dead or stuck, and with it every device of this process. A thread
                // that holds the lock hangs in a call of the library itself.
                let was_running = SCHEDULER.try_lock().is_ok_and(|mut s| std::mem::take(&mut s.running));
                if was_running {
                    // SAFETY: the function takes nothing.
                    unsafe { (switch.api.stop)() };
                }
                return;
            }
            std::thread::sleep(Duration::from_micros(500));
        }
    }
}

/// Input and output of a callback. The device keeps it at one place in memory, because a scheduler
/// that is stuck may run the callback late.
pub(super) struct ScheduledFrame {
    pub(super) switch: Arc<HdForceSwitch>,
    pub(super) device: Handle,
    pub(super) force: [f64; 3],
    /// Whether the force is to be zero, because it comes back or ends.
    pub(super) idle: bool,
    /// Whether the force output is to be switched off after the frame.
    pub(super) leave: bool,
    /// The safety switch in the frame before, and then in this one.
    pub(super) held: Option<bool>,
    /// Whether an open safety switch means that the force is off.
    pub(super) was_held: bool,
    /// Whether the callback has run at all.
    pub(super) ran: bool,
    /// Whether the force was sent as it was given.
    pub(super) force_on: bool,
    pub(super) position: [f64; 3],
    pub(super) velocity: [f64; 3],
    /// Transform, column-major, millimeters.
    pub(super) transform: [f64; 16],
    pub(super) buttons: c_int,
    pub(super) error: ErrorInfo,
}

/// Runs one frame on the library's servo thread: writes the force and reads the state.
///
/// # Safety
/// `data` is a `ScheduledFrame` that nothing else accesses until this function has returned.
pub(super) unsafe extern "system" fn servo(data: *mut c_void) -> c_uint {
    // SAFETY: `OpenHaptics::frame` passes its own frame and waits.
    let frame = unsafe { &mut *data.cast::<ScheduledFrame>() };
    let api = frame.switch.api;
    frame.ran = true;
    // SAFETY: the calls and the lengths of their arrays are those of the header, and the calls lie
    // between begin and end, as the header requires. The frame makes its device the current one.
    unsafe {
        (api.begin)(frame.device);
        let error = api.drain();
        let mut held: c_uchar = 0;
        (api.get_boolean)(CURRENT_SAFETY_SWITCH, &raw mut held);
        // A device without the switch answers with an error, which is no fault.
        let held = (api.drain().code == 0).then_some(held != 0);
        let taken = held == Some(true) && frame.held == Some(false);
        let released = held == Some(false) && frame.was_held;
        frame.held = held;
        let cut = frame.switch.cut.load(Ordering::Acquire);
        let enabled = (api.is_enabled)(FORCE_OUTPUT) != 0;
        frame.force_on = !(frame.idle || cut || !enabled || taken || released);
        let force = if frame.force_on { frame.force } else { [0.0; 3] };
        (api.set_double)(CURRENT_FORCE, force.as_ptr());
        (api.get_double)(CURRENT_POSITION, frame.position.as_mut_ptr());
        (api.get_double)(CURRENT_VELOCITY, frame.velocity.as_mut_ptr());
        (api.get_double)(CURRENT_TRANSFORM, frame.transform.as_mut_ptr());
        (api.get_integer)(CURRENT_BUTTONS, &raw mut frame.buttons);
        (api.end)(frame.device);
        let later = api.drain();
        frame.error = if error.code == 0 { later } else { error };
        if frame.leave {
            (api.disable)(FORCE_OUTPUT);
        } else if (cut || !enabled) && frame.error.code == 0 {
            // The supervisor or the library has switched the force off. It comes back at zero.
            (api.enable)(FORCE_OUTPUT);
            frame.switch.cut.store(false, Ordering::Release);
        }
    }
    CALLBACK_DONE
}
