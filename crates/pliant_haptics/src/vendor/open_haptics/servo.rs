//! What runs on the library's servo thread: the frames of the loop, and the supervisor's cut.

use std::ffi::{c_int, c_uchar, c_uint, c_ushort, c_void};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError, TryLockError};
use std::time::{Duration, Instant};

use libloading::Library;

use super::scheduler::{SharedScheduler, Turn};
use super::{
    CURRENT_BUTTONS, CURRENT_FORCE, CURRENT_POSITION, CURRENT_SAFETY_SWITCH, CURRENT_TRANSFORM,
    CURRENT_VELOCITY, ErrorInfo, FORCE_OUTPUT, Handle, INVALID, OpenHapticsApi,
};
use crate::control_loop::supervisor::beside;
use crate::{StopHandle, device::link::Link};

pub(super) const PRIORITY: c_ushort = u16::MAX / 2;

const MAX_PRIORITY: c_ushort = u16::MAX;

const CALLBACK_DONE: c_uint = 0;

/// Time that the servo thread has to run the supervisor's callback, and the library to stop it.
const SERVO_PATIENCE: Duration = Duration::from_millis(10);
/// Time that a thread waits for another one that opens or closes a device.
const OPEN_PATIENCE: Duration = Duration::from_secs(1);

pub(super) static SCHEDULER: LazyLock<SharedScheduler> = LazyLock::new(SharedScheduler::default);

/// Held while a device is opened or closed, which the library does for one at a time. No cut waits
/// for it.
static OPENING: Mutex<()> = Mutex::new(());

/// Tries every half millisecond, for as long as `patience`.
fn within<T>(patience: Duration, mut attempt: impl FnMut() -> Option<T>) -> Option<T> {
    let begun = Instant::now();
    loop {
        let result = attempt();
        if result.is_some() || begun.elapsed() >= patience {
            return result;
        }
        std::thread::sleep(Duration::from_micros(500));
    }
}

/// Tries for as long as a thread waits for another device.
pub(super) fn soon<T>(attempt: impl FnMut() -> Option<T>) -> Option<T> {
    within(OPEN_PATIENCE, attempt)
}

/// Waits until no other thread opens or closes a device, but not for one that hangs.
pub(super) fn turn_to_open() -> Option<MutexGuard<'static, ()>> {
    soon(|| match OPENING.try_lock() {
        Ok(turn) => Some(turn),
        Err(TryLockError::Poisoned(poisoned)) => Some(poisoned.into_inner()),
        Err(TryLockError::WouldBlock) => None,
    })
}

/// Switches the force off from another thread.
pub(super) struct HdForceSwitch {
    pub(super) api: OpenHapticsApi,
    pub(super) link: Link<Handle>,
    /// Whether a thread is scheduling a cut, and may hang there.
    pub(super) posting: AtomicBool,
    /// The library stays loaded as long as this value can call it.
    pub(super) _library: Arc<Library>,
}

/// A cut that the servo thread is to make.
struct CutOrder {
    switch: Arc<HdForceSwitch>,
    /// The connection that it is for.
    number: u64,
    /// Whether the servo thread has run it.
    obeyed: AtomicBool,
}

/// Sends no force and switches the force output off, on the servo thread.
///
/// # Safety
/// `data` is one count of an `Arc<CutOrder>`, which this function takes over.
unsafe extern "system" fn cut_force(data: *mut c_void) -> c_uint {
    // SAFETY: the caller passes the count over.
    let order = unsafe { Arc::from_raw(data.cast_const().cast::<CutOrder>()) };
    // A scheduler that was stuck may run it late, when the device has been opened again.
    if let Some(cut) = order.switch.link.act(order.number) {
        let api = order.switch.api;
        // SAFETY: as in `servo`.
        unsafe {
            (api.begin)(cut.device);
            (api.set_double)(CURRENT_FORCE, [0.0f64; 3].as_ptr());
            (api.end)(cut.device);
            (api.disable)(FORCE_OUTPUT);
            let _ = api.drain();
        }
    }
    order.obeyed.store(true, Ordering::Release);
    CALLBACK_DONE
}

/// The handle that the loop's supervisor gets.
pub(super) struct HdStop(pub(super) Arc<HdForceSwitch>);

impl StopHandle for HdStop {
    fn cut(&self) {
        let switch = &self.0;
        // The servo thread acts on the device, later.
        let Some(number) = switch.link.cut().map(|cut| cut.number) else { return };
        let order = Arc::new(CutOrder { switch: switch.clone(), number, obeyed: AtomicBool::new(false) });
        if !switch.posting.swap(true, Ordering::AcqRel) {
            let order = order.clone();
            beside(move || {
                let switch = &order.switch;
                let data = Arc::into_raw(order.clone()).cast_mut().cast();
                // SAFETY: the callback takes over the count. A scheduler that never runs it leaves
                // the few bytes of one count behind.
                unsafe { (switch.api.post)(cut_force, data, MAX_PRIORITY) };
                switch.posting.store(false, Ordering::Release);
            });
        }
        let is_obeyed = || order.obeyed.load(Ordering::Acquire).then_some(());
        if within(SERVO_PATIENCE, is_obeyed).is_none() {
            // The servo is dead or stuck, and with it every device of this process.
            let switch = switch.clone();
            // SAFETY: the function takes nothing.
            let stop = beside(move || SCHEDULER.stop(|| unsafe { (switch.api.stop)() }));
            within(SERVO_PATIENCE, || stop.as_ref().is_none_or(|s| s.is_finished()).then_some(()));
        }
    }
}

/// A callback of the servo thread. Each has a count of its own of it, because a scheduler that is
/// stuck may run the callback when the device is gone.
pub(super) struct ScheduledFrame {
    pub(super) switch: Arc<HdForceSwitch>,
    /// Whether the servo thread may touch `data`.
    pub(super) turn: Turn,
    data: Mutex<FrameData>,
}

/// Input and output of a callback.
pub(super) struct FrameData {
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
    /// Whether the force was sent as it was given.
    pub(super) force_on: bool,
    pub(super) position: [f64; 3],
    pub(super) velocity: [f64; 3],
    /// Transform, column-major, millimeters.
    pub(super) transform: [f64; 16],
    pub(super) buttons: c_int,
    pub(super) error: ErrorInfo,
}

impl ScheduledFrame {
    pub(super) fn new(switch: Arc<HdForceSwitch>) -> Arc<Self> {
        let data = FrameData {
            device: INVALID,
            force: [0.0; 3],
            idle: true,
            leave: false,
            held: None,
            was_held: false,
            force_on: false,
            position: [f64::NAN; 3],
            velocity: [0.0; 3],
            transform: [0.0; 16],
            buttons: 0,
            error: ErrorInfo::default(),
        };
        Arc::new(Self { switch, turn: Turn::default(), data: Mutex::new(data) })
    }

    /// The data, for whoever's turn it is, so that nobody waits for it.
    pub(super) fn data(&self) -> MutexGuard<'_, FrameData> {
        self.data.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Runs one frame on the library's servo thread: writes the force and reads the state. A frame that
/// was given up does nothing.
///
/// # Safety
/// `data` is one count of an `Arc<ScheduledFrame>`, which this function takes over.
pub(super) unsafe extern "system" fn servo(data: *mut c_void) -> c_uint {
    // SAFETY: the caller passes the count over.
    let scheduled = unsafe { Arc::from_raw(data.cast_const().cast::<ScheduledFrame>()) };
    if !scheduled.turn.begin() {
        return CALLBACK_DONE;
    }
    let mut data = scheduled.data();
    let frame = &mut *data;
    let switch = &scheduled.switch;
    let api = switch.api;
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
        let seen = switch.link.seen();
        let enabled = (api.is_enabled)(FORCE_OUTPUT) != 0;
        frame.force_on = !(frame.idle || seen.cut || !enabled || taken || released);
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
        } else if (seen.cut || !enabled) && frame.error.code == 0 {
            // The supervisor or the library has switched the force off. It comes back at zero.
            (api.enable)(FORCE_OUTPUT);
            switch.link.answer(seen);
        }
    }
    drop(data);
    scheduled.turn.end();
    CALLBACK_DONE
}
