//! Cuts of the force that hang themselves, that come late, or that come while another device of the
//! same library is being opened or closed. The fake libraries model the firmware.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
#![cfg(all(feature = "vendor", unix))]
#![allow(unsafe_code, reason = "the fake libraries are steered through C functions")]

use std::{
    ffi::{c_int, c_uint},
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU32, Ordering},
        mpsc,
    },
    time::{Duration, Instant},
};

use fakes::{ONE_HD, dhd, fake, hd, motor, open_fake, place, rise};
use game::{FOREVER, Game, best, hang_dhd, seconds_to_drop, seconds_to_zero, servo};
use libloading::Library;
use pliant_haptics::{
    DeviceInfo, Fault, ForceDimension, HapticDevice, LoopClock, LoopState, OpenHaptics, RealScheduler,
    Sample, Scheduler, StopHandle, VirtualConfig, Wrench,
};

#[path = "rig/fakes.rs"]
#[macro_use]
mod fakes;
#[path = "rig/game.rs"]
mod game;
#[path = "rig/machine.rs"]
mod machine;

/// A fake 3D Systems device whose hand is 5 mm to the right.
fn hd_at_5_mm(test: &str) -> (PathBuf, Library) {
    let path = fake("hd", test, &[]);
    let library = open_fake(&path);
    place(&library, [5.0, 0.0, 0.0], 0.0);
    (path, library)
}

/// Waits until `symbol` of the fake says 1.
macro_rules! wait_for {
    ($library:expr, $symbol:literal) => {
        machine::until($symbol, || {
            std::thread::sleep(Duration::from_millis(1));
            if call!($library, $symbol, fn() -> c_int,) == 1 { Ok(()) } else { Err("not yet") }
        })
    };
}

#[test]
fn a_scheduler_that_hangs_with_all_its_calls_loses_its_force() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let (path, library) = hd_at_5_mm("locked");
    let mut game = Game::start(OpenHaptics::open(hd(&path)).unwrap());
    best("OpenHaptics, every call hangs", || {
        game.pull(&library);
        servo(&library, 4);
        let took = seconds_to_zero(|| motor(&library));
        rise(&library);
        servo(&library, 0);
        game.pull(&library);
        let rise = rise(&library);
        assert!(rise < 0.02, "comes back by the ramp, not by a kick of {rise} N");
        took
    });
}

#[test]
fn calls_that_all_hang_hold_up_no_stop_no_drop_and_no_other_device() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let (hd_path, hd_library) = hd_at_5_mm("all_hang");
    let dhd_path = fake("dhd", "all_hang", &["-DWITHOUT_WATCHDOG"]);
    let dhd_library = open_fake(&dhd_path);
    place(&dhd_library, [0.0, 0.005, 0.0], 0.0);
    let mut hung = Game::start(OpenHaptics::open(hd(&hd_path)).unwrap());
    let mut other = Game::start(ForceDimension::open(dhd(&dhd_path)).unwrap());
    hung.pull(&hd_library);
    // Even the call that stops the scheduler hangs. The force is then the hardware's matter.
    call!(hd_library, "fake_stop_hangs", fn(c_int), 1);
    servo(&hd_library, 4);
    wait_for!(hd_library, "fake_in_stop");
    let begun = Instant::now();
    hung.running.emergency_stop();
    let pressed = begun.elapsed().as_secs_f64();
    best("Force Dimension beside an OpenHaptics whose calls hang", || {
        other.pull(&dhd_library);
        hang_dhd(&dhd_library, true);
        let took = seconds_to_zero(|| motor(&dhd_library));
        hang_dhd(&dhd_library, false);
        took
    });
    let took = seconds_to_drop(hung);
    println!("OpenHaptics whose calls all hang: stop pressed in {pressed:.6} s, dropped after {took:?} s");
    assert!(pressed < 0.1 && took.is_some_and(|t| t <= 1.0), "{pressed} s, {took:?} s");
    call!(hd_library, "fake_stop_hangs", fn(c_int), 0);
    servo(&hd_library, 0);
    machine::until("the device is closed", || {
        std::thread::sleep(Duration::from_millis(1));
        if call!(hd_library, "fake_open", fn() -> c_int,) == 0 { Ok(()) } else { Err("still open") }
    });
}

#[test]
fn a_device_that_is_being_opened_does_not_hold_up_the_cut_of_another() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let (opening_path, opening_library) = hd_at_5_mm("slow_opening");
    let (path, library) = hd_at_5_mm("beside_opening");
    let mut opening = Game::start(OpenHaptics::open(hd(&opening_path)).unwrap());
    opening.pull(&opening_library);
    // The real library has one scheduler for all devices, and it runs.
    call!(library, "hdStartScheduler", fn(),);
    let mut game = Game::start(OpenHaptics::open(hd(&path)).unwrap());
    game.pull(&library);
    // The other device goes, and hangs as it comes back.
    call!(opening_library, "fake_init_hangs", fn(c_int), 1);
    call!(opening_library, "fake_error", fn(c_uint), 0x104);
    game.until("the other device is being opened", |_| {
        opening.publish();
        call!(opening_library, "fake_in_init", fn() -> c_int,) == 1
    });
    game.pull(&library);
    servo(&library, 2);
    let took = seconds_to_zero(|| motor(&library));
    call!(opening_library, "fake_error", fn(c_uint), 0);
    call!(opening_library, "fake_init_hangs", fn(c_int), 0);
    servo(&library, 0);
    println!("OpenHaptics, stuck while another device is being opened: zero after {:.1} ms", 1e3 * took);
    assert!(took < FOREVER, "the force is still on after {took:.3} s");
}

#[test]
fn a_device_that_hangs_as_it_is_closed_does_not_hang_who_opens_another() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let (closing_path, closing_library) = hd_at_5_mm("hangs_closing");
    let (path, library) = hd_at_5_mm("beside_closing");
    let mut closing = Game::start(OpenHaptics::open(hd(&closing_path)).unwrap());
    closing.pull(&closing_library);
    call!(closing_library, "fake_stop_hangs", fn(c_int), 1);
    let dropped = seconds_to_drop(closing);
    wait_for!(closing_library, "fake_in_stop");
    let (sender, receiver) = mpsc::channel();
    let config = hd(&path);
    std::thread::spawn(move || sender.send(OpenHaptics::open(config).map(drop)));
    let opened = receiver.recv_timeout(Duration::from_secs(5));
    call!(closing_library, "fake_stop_hangs", fn(c_int), 0);
    println!("OpenHaptics: dropped after {dropped:?} s; another is opened meanwhile: {opened:?}");
    assert!(dropped.is_some_and(|t| t <= 1.0), "{dropped:?} s");
    assert!(matches!(opened, Ok(Err(_))), "who opens another is told in time: {opened:?}");
    machine::until("it is opened when the first is closed", || {
        std::thread::sleep(Duration::from_millis(1));
        OpenHaptics::open(hd(&path)).map(drop)
    });
    assert_eq!(call!(library, "fake_open", fn() -> c_int,), 0);
}

#[test]
fn no_force_is_sent_while_the_call_that_cuts_it_hangs() {
    let path = fake("dhd", "off_hangs", &["-DWITHOUT_WATCHDOG"]);
    let library = open_fake(&path);
    place(&library, [0.0, 0.005, 0.0], 0.0);
    let mut game = Game::start(ForceDimension::open(dhd(&path)).unwrap());
    game.pull(&library);
    call!(library, "fake_off_hangs", fn(c_int), 1);
    hang_dhd(&library, true);
    wait_for!(library, "fake_in_off");
    // The driver answers again, and the call that should cut its force does not.
    hang_dhd(&library, false);
    game.until("the driver sends no force", |_| motor(&library) == 0.0);
    let mut force = 0.0f64;
    for _ in 0..50 {
        game.publish();
        std::thread::sleep(Duration::from_millis(2));
        force = force.max(motor(&library));
    }
    let state = game.publish().state;
    rise(&library);
    call!(library, "fake_off_hangs", fn(c_int), 0);
    println!("Force Dimension, its cut hangs: {state:?}, {force} N meanwhile");
    assert_eq!((state, force), (LoopState::ForceOff, 0.0));
    game.pull(&library);
    assert!(rise(&library) < 0.02, "by the ramp");
}

#[test]
fn what_waits_from_a_connection_before_does_nothing_to_the_next() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let (path, library) = hd_at_5_mm("late_callbacks");
    let mut device = OpenHaptics::open(hd(&path)).unwrap();
    let pull = Wrench { force: [1.0, 0.0, 0.0], ..Wrench::ZERO };
    let mut scheduler = RealScheduler::new(LoopClock::start(), 1000.0);
    let mut pulls = |device: &mut OpenHaptics| {
        machine::until("1 N on the motors", || {
            let sample = device.exchange(&pull, &mut scheduler);
            if motor(&library) == 1.0 { Ok(()) } else { Err(sample) }
        });
    };
    pulls(&mut device);
    // The scheduler returns and keeps the frame and the cut for later.
    call!(library, "fake_servo", fn(c_int), 5);
    let lost = device.exchange(&pull, &mut RealScheduler::new(LoopClock::start(), 1000.0));
    assert_eq!(lost, Err(Fault::NotRun));
    assert_eq!(motor(&library), 0.0, "the scheduler was stopped");
    call!(library, "fake_revive", fn(),);
    device.reopen().unwrap();
    pulls(&mut device);
    let frames = call!(library, "fake_frames", fn() -> std::ffi::c_long,);
    call!(library, "fake_run_waiting", fn(),);
    let more = call!(library, "fake_frames", fn() -> std::ffi::c_long,) - frames;
    println!("OpenHaptics: what waited runs {more} frames on the next connection, {} N", motor(&library));
    assert_eq!((more, motor(&library)), (0, 1.0));
    pulls(&mut device);
}

/// A device whose exchanges and whose first cut hang on demand.
#[derive(Clone, Default)]
struct Hanging(Arc<Hang>);

#[derive(Default)]
struct Hang {
    exchange: AtomicBool,
    in_exchange: AtomicBool,
    cut: AtomicBool,
    cuts: AtomicU32,
}

impl StopHandle for Hanging {
    fn cut(&self) {
        if self.0.cuts.fetch_add(1, Ordering::SeqCst) == 0 {
            while self.0.cut.load(Ordering::SeqCst) {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
    }
}

impl HapticDevice for Hanging {
    fn info(&self) -> DeviceInfo {
        VirtualConfig::touch().info()
    }
    fn exchange(&mut self, _: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        scheduler.wait();
        while self.0.exchange.load(Ordering::SeqCst) {
            self.0.in_exchange.store(true, Ordering::SeqCst);
            std::thread::sleep(Duration::from_millis(1));
        }
        self.0.in_exchange.store(false, Ordering::SeqCst);
        Ok(Sample::default())
    }
    fn safe_stop(&mut self) {}
    fn stop_handle(&self) -> Option<Arc<dyn StopHandle>> {
        Some(Arc::new(self.clone()))
    }
}

#[test]
fn a_cut_that_hangs_does_not_keep_the_next_one_from_coming() {
    let device = Hanging::default();
    let hang = device.0.clone();
    let mut game = Game::start(device);
    hang.cut.store(true, Ordering::SeqCst);
    let mut cuts = Vec::new();
    for _ in 0..2 {
        game.until("the loop runs", |report| {
            report.state == LoopState::Running && !hang.in_exchange.load(Ordering::SeqCst)
        });
        let before = hang.cuts.load(Ordering::SeqCst);
        hang.exchange.store(true, Ordering::SeqCst);
        let begun = Instant::now();
        while hang.cuts.load(Ordering::SeqCst) == before && begun.elapsed().as_secs_f64() < FOREVER {
            game.publish();
            std::thread::sleep(Duration::from_millis(1));
        }
        cuts.push(hang.cuts.load(Ordering::SeqCst) - before);
        hang.exchange.store(false, Ordering::SeqCst);
    }
    println!("cuts in two hangs, the first of which hangs itself: {cuts:?}");
    assert!(cuts.iter().all(|n| *n > 0), "{cuts:?}");
    hang.cut.store(false, Ordering::SeqCst);
}
