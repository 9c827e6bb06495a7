//! What device, servo thread and supervisor pass to each other by pointers, over a library whose
//! functions are written here, so that Miri can run it.
#![cfg(unix)]

use std::sync::atomic::{AtomicPtr, AtomicU32, Ordering};
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};
use std::thread;

use super::*;

/// One at a time: the scheduler belongs to the process.
static ONE: Mutex<()> = Mutex::new(());

/// It is never dropped, because there is no library to unload.
static LIBRARY: LazyLock<Arc<Library>> = LazyLock::new(|| {
    // SAFETY: no function is looked up in it, and it is not unloaded.
    Arc::new(unsafe { libloading::os::unix::Library::from_raw(std::ptr::null_mut()) }.into())
});

/// Whether the scheduler takes callbacks and runs none of them.
static STUCK: AtomicBool = AtomicBool::new(false);

/// Callbacks that the scheduler has not run.
static LATE: Mutex<Vec<(Callback, AtomicPtr<c_void>)>> = Mutex::new(Vec::new());

/// Threads of cuts.
static POSTED: Mutex<Vec<thread::JoinHandle<()>>> = Mutex::new(Vec::new());

/// The last force, N, and whether the force output is on.
static MOTORS: Mutex<([f64; 3], bool)> = Mutex::new(([0.0; 3], false));

static STOPS: AtomicU32 = AtomicU32::new(0);

fn motors() -> MutexGuard<'static, ([f64; 3], bool)> {
    MOTORS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Runs a callback on a thread of its own, as the servo thread does, or keeps it.
fn take(callback: Callback, data: *mut c_void) -> Option<thread::JoinHandle<()>> {
    let data = AtomicPtr::new(data);
    if STUCK.load(Ordering::Acquire) {
        LATE.lock().unwrap().push((callback, data));
        return None;
    }
    // SAFETY: the device guarantees that the callback may run with this data.
    Some(thread::spawn(move || assert_eq!(unsafe { callback(data.into_inner()) }, 0)))
}

/// Runs what a stuck scheduler has kept, as one that comes back does.
fn run_late() -> usize {
    STUCK.store(false, Ordering::Release);
    let late = std::mem::take(&mut *LATE.lock().unwrap());
    let count = late.len();
    for (callback, data) in late {
        take(callback, data.into_inner()).unwrap().join().unwrap();
    }
    count
}

unsafe extern "system" fn init(_: *const c_char) -> Handle {
    3
}
unsafe extern "system" fn with_handle(_: Handle) {}
unsafe extern "system" fn enable(_: c_uint) {
    motors().1 = true;
}
unsafe extern "system" fn disable(_: c_uint) {
    motors().1 = false;
}
unsafe extern "system" fn is_enabled(_: c_uint) -> c_uchar {
    motors().1.into()
}
unsafe extern "system" fn get_boolean(_: c_uint, to: *mut c_uchar) {
    // SAFETY: the caller passes one number.
    unsafe { to.write(1) };
}
unsafe extern "system" fn get_double(what: c_uint, to: *mut f64) {
    let count = match what {
        CURRENT_TRANSFORM => 16,
        USABLE_WORKSPACE_DIMENSIONS => 6,
        CURRENT_POSITION | CURRENT_VELOCITY => 3,
        _ => 1,
    };
    for k in 0..count {
        // SAFETY: the caller passes as many numbers as the header says.
        unsafe { to.add(k).write(if k % 5 == 0 { 1.0 } else { 0.0 }) };
    }
}
unsafe extern "system" fn set_double(_: c_uint, from: *const f64) {
    // SAFETY: the caller passes a force.
    motors().0 = std::array::from_fn(|k| unsafe { from.add(k).read() });
}
unsafe extern "system" fn get_integer(_: c_uint, to: *mut c_int) {
    // SAFETY: the caller passes one number.
    unsafe { to.write(5) };
}
unsafe extern "system" fn get_string(_: c_uint) -> *const c_char {
    c"3.0".as_ptr()
}
unsafe extern "system" fn get_error() -> ErrorInfo {
    ErrorInfo::default()
}
unsafe extern "system" fn check_calibration() -> c_uint {
    CALIBRATION_OK
}
unsafe extern "system" fn update_calibration(_: c_uint) {}
unsafe extern "system" fn start() {}
unsafe extern "system" fn stop() {
    STOPS.fetch_add(1, Ordering::AcqRel);
}
unsafe extern "system" fn set_rate(_: c_ulong) {}
unsafe extern "system" fn run(callback: Callback, data: *mut c_void, _: c_ushort) {
    if let Some(servo) = take(callback, data) {
        servo.join().unwrap();
    }
}
unsafe extern "system" fn post(callback: Callback, data: *mut c_void, _: c_ushort) -> c_ulong {
    POSTED.lock().unwrap().extend(take(callback, data));
    1
}

fn open() -> OpenHaptics {
    let api = OpenHapticsApi {
        init,
        close: with_handle,
        make_current: with_handle,
        begin: with_handle,
        end: with_handle,
        enable,
        disable,
        is_enabled,
        get_boolean,
        get_double,
        set_double,
        get_integer,
        get_string,
        get_error,
        check_calibration,
        update_calibration,
        start,
        stop,
        set_rate,
        run,
        post,
    };
    let mut device = OpenHaptics::closed(api, LIBRARY.clone(), OpenHapticsConfig::default());
    device.connect().unwrap();
    device
}

fn join_cuts() {
    POSTED.lock().unwrap().drain(..).for_each(|cut| cut.join().unwrap());
}

fn exchange(device: &mut OpenHaptics, force: f64) -> Result<Sample, Fault> {
    device.frame([force, 0.0, 0.0], false)
}

#[test]
fn the_servo_and_the_supervisor_share_a_device() {
    let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    let mut device = open();
    assert_eq!(device.info.name, "3.0");
    let sample = exchange(&mut device, 1.0).unwrap();
    assert_eq!((sample.position, sample.buttons, sample.force_on), ([1e-3, 0.0, 0.0], 5, true));
    assert_eq!(*motors(), ([1.0, 0.0, 0.0], true));
    let handle = device.stop_handle().unwrap();
    let supervisor = thread::spawn(move || handle.cut());
    for _ in 0..4 {
        exchange(&mut device, 1.0).unwrap();
    }
    supervisor.join().unwrap();
    exchange(&mut device, 1.0).unwrap();
    device.stop_handle().unwrap().cut();
    join_cuts();
    assert_eq!(*motors(), ([0.0; 3], false));
    assert!(!exchange(&mut device, 1.0).unwrap().force_on, "it comes back at zero");
    // One that comes late is zero, too. Under Miri, each does.
    assert!(cfg!(miri) || (0..100).any(|_| exchange(&mut device, 1.0).unwrap().force_on));
    drop(Box::new(device));
    join_cuts();
    assert_eq!(*motors(), ([0.0; 3], false));
}

#[test]
fn a_callback_that_runs_after_its_device_is_gone_touches_nothing_of_others() {
    let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    let mut device = open();
    exchange(&mut device, 1.0).unwrap();
    STUCK.store(true, Ordering::Release);
    let stops = STOPS.load(Ordering::Acquire);
    assert_eq!(exchange(&mut device, 1.0).unwrap_err(), Fault::NotRun);
    // On a thread of its own.
    while STOPS.load(Ordering::Acquire) == stops {
        thread::sleep(std::time::Duration::from_millis(1));
    }
    drop(Box::new(device));
    assert_eq!(run_late(), 2, "the frame and the cut");
    assert!(!motors().1, "the force output is off");
}

#[test]
fn a_callback_that_runs_after_its_device_was_opened_again_does_not_change_the_next_frame() {
    let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    let mut device = open();
    STUCK.store(true, Ordering::Release);
    assert_eq!(exchange(&mut device, 1.0).unwrap_err(), Fault::NotRun);
    STUCK.store(false, Ordering::Release);
    device.reopen().unwrap();
    // One that was stuck in a call of its own runs beside the next.
    let late = thread::spawn(run_late);
    for _ in 0..4 {
        exchange(&mut device, 0.0).unwrap();
    }
    assert_eq!(late.join().unwrap(), 2);
    drop(device);
    join_cuts();
}
