//! What the motors do while a driver's call hangs, while force is switched off at the device, after
//! a stall, and when the process dies or is stopped. The fake libraries model the firmware.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
#![cfg(all(feature = "vendor", unix))]
#![allow(unsafe_code, reason = "the fake libraries are steered through C functions")]

use std::{
    ffi::c_int,
    path::Path,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use fakes::{ONE_HD, dhd, fake, hd, motor, open_fake, place, rise};
use game::{FOREVER, Game, PROMISED, best, hang_dhd, seconds_to_drop, seconds_to_zero, servo};
use libloading::Library;
use pliant_haptics::{
    Fault, ForceDimension, ForceDimensionConfig, LoopEvent, LoopState, OpenHaptics, Wrench,
};

#[path = "rig/fakes.rs"]
#[macro_use]
mod fakes;
#[path = "rig/game.rs"]
mod game;
#[path = "rig/machine.rs"]
mod machine;

#[test]
fn force_dimension_hangs() {
    for (name, options) in [("firmware", &[][..]), ("supervisor", &["-DWITHOUT_WATCHDOG"][..])] {
        let path = fake("dhd", &format!("hang_{name}"), options);
        let library = open_fake(&path);
        place(&library, [0.0, 0.005, 0.0], 0.0);
        let mut game = Game::start(ForceDimension::open(dhd(&path)).unwrap());
        best(&format!("Force Dimension, {name}"), || {
            game.pull(&library);
            hang_dhd(&library, true);
            let took = seconds_to_zero(|| motor(&library));
            // The force does not come back while the call hangs, and then it comes back by the
            // ramp.
            std::thread::sleep(Duration::from_millis(100));
            let late = motor(&library);
            let report = game.publish();
            assert_eq!(report.state, LoopState::Hung);
            assert!(matches!(report.tick.fault, Some(Fault::Hung(t)) if t > 0.05), "{:?}", report.tick.fault);
            assert_eq!(report.tick.wrench, Wrench::ZERO);
            assert!(game.running.events().any(|e| matches!(e, LoopEvent::Fault(Fault::Hung(_)))));
            rise(&library);
            hang_dhd(&library, false);
            game.pull(&library);
            assert_eq!(late, 0.0);
            let rise = rise(&library);
            assert!(rise < 0.02, "comes back by the ramp, not by a kick of {rise} N");
            took
        });
    }
}

#[test]
fn open_haptics_hangs() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    // The servo lives and only our call is lost, or the servo is stuck with everything.
    for (name, mode) in [("call lost", 3), ("servo stuck", 2)] {
        let path = fake("hd", &format!("hang_{mode}"), &[]);
        let library = open_fake(&path);
        place(&library, [5.0, 0.0, 0.0], 0.0);
        let mut game = Game::start(OpenHaptics::open(hd(&path)).unwrap());
        best(&format!("OpenHaptics, {name}"), || {
            game.pull(&library);
            servo(&library, mode);
            let took = seconds_to_zero(|| motor(&library));
            std::thread::sleep(Duration::from_millis(50));
            let late = motor(&library);
            rise(&library);
            servo(&library, 0);
            game.pull(&library);
            assert_eq!(late, 0.0);
            let rise = rise(&library);
            assert!(rise < 0.02, "comes back by the ramp, not by a kick of {rise} N");
            took
        });
    }
}

#[test]
fn the_emergency_stop_works_while_a_call_hangs() {
    let path = fake("dhd", "hang_estop", &["-DWITHOUT_WATCHDOG"]);
    let library = open_fake(&path);
    place(&library, [0.0, 0.005, 0.0], 0.0);
    let mut game = Game::start(ForceDimension::open(dhd(&path)).unwrap());
    let stop = game.running.stop_switch();
    best("Force Dimension, emergency stop", || {
        game.pull(&library);
        hang_dhd(&library, true);
        stop.press();
        let took = seconds_to_zero(|| motor(&library));
        hang_dhd(&library, false);
        for _ in 0..50 {
            game.publish();
            std::thread::sleep(Duration::from_millis(2));
            assert_eq!(motor(&library), 0.0, "it is latched, also when the call has returned");
        }
        rise(&library);
        assert!(game.running.reset_stop());
        game.pull(&library);
        assert!(rise(&library) < 0.02, "by the ramp");
        took
    });
}

#[test]
fn a_stop_that_cannot_be_reset_while_a_call_hangs_stays_pressed() {
    let path = fake("dhd", "hang_reset", &["-DWITHOUT_WATCHDOG"]);
    let library = open_fake(&path);
    place(&library, [0.0, 0.005, 0.0], 0.0);
    let mut game = Game::start(ForceDimension::open(dhd(&path)).unwrap());
    game.pull(&library);
    hang_dhd(&library, true);
    game.running.emergency_stop();
    seconds_to_zero(|| motor(&library));
    // The app goes on, and its commands wait until the queue is full.
    while game.running.set_tool(Default::default()) {}
    assert!(!game.running.reset_stop(), "the queue is full");
    assert!(game.running.stop_switch().is_pressed(), "the stop stays pressed");
    hang_dhd(&library, false);
    for _ in 0..50 {
        game.publish();
        std::thread::sleep(Duration::from_millis(2));
        assert_eq!(motor(&library), 0.0, "it is latched, also when the call has returned");
    }
    assert!(game.running.reset_stop());
    game.pull(&library);
}

#[test]
fn the_emergency_stop_ends_a_drive_to_the_reference() {
    let path = fake("dhd", "drive", &["-DWITH_DRD"]);
    let library = open_fake(&path);
    place(&library, [0.0, 0.005, 0.0], 0.0);
    let device = ForceDimension::open(ForceDimensionConfig { auto_init: true, ..dhd(&path) }).unwrap();
    let mut game = Game::start(device);
    game.pull(&library);
    // The device goes, comes back without its reference, and drives through its workspace.
    call!(library, "fake_slow_drive", fn(c_int), 1);
    call!(library, "fake_gone", fn(c_int), 1);
    call!(library, "fake_reset", fn(c_int), 0);
    game.until("the device counts as lost", |report| report.state == LoopState::Lost);
    call!(library, "fake_gone", fn(c_int), 0);
    let drives = || call!(library, "fake_driving", fn() -> c_int,) == 1;
    game.until("it drives", |_| drives());
    game.running.emergency_stop();
    let took = seconds_to_zero(|| f64::from(drives()));
    println!("Force Dimension: the drive ends {:.1} ms after the emergency stop", 1e3 * took);
    call!(library, "fake_slow_drive", fn(c_int), 0);
    assert!(took < 4.0 * PROMISED, "{took} s");
}

/// Starts a game on a device that finds its reference by itself, and takes the device away. When
/// the device is there again, it needs its reference, and drives until somebody ends the drive.
fn lost_before_a_drive(test: &str) -> (Library, Game) {
    let path = fake("dhd", test, &["-DWITH_DRD"]);
    let library = open_fake(&path);
    place(&library, [0.0, 0.005, 0.0], 0.0);
    let device = ForceDimension::open(ForceDimensionConfig { auto_init: true, ..dhd(&path) }).unwrap();
    let mut game = Game::start(device);
    game.pull(&library);
    call!(library, "fake_slow_drive", fn(c_int), 1);
    call!(library, "fake_gone", fn(c_int), 1);
    call!(library, "fake_reset", fn(c_int), 0);
    game.until("the device counts as lost", |report| report.state == LoopState::Lost);
    (library, game)
}

fn slow_open(library: &Library, open: f64, start: f64) {
    call!(library, "fake_slow_open", fn(f64, f64), open, start);
}

/// Returns the number of drives so far, and whether the device drives now.
fn drives(library: &Library) -> (c_int, bool) {
    (call!(library, "fake_drives", fn() -> c_int,), call!(library, "fake_driving", fn() -> c_int,) == 1)
}

/// Looks at a device for some of the loop's attempts to open it. Returns the number of drives that
/// begin, and the time for which the device drives, s.
fn driven(game: &mut Game, library: &Library) -> (c_int, f64) {
    let (before, begun) = (drives(library).0, Instant::now());
    let (mut last, mut driven) = (begun, 0.0);
    while begun.elapsed().as_secs_f64() < 2.5 {
        game.publish();
        std::thread::sleep(Duration::from_millis(1));
        let now = Instant::now();
        if drives(library).1 {
            driven += (now - last).as_secs_f64();
        }
        last = now;
    }
    // A drive that nobody ends must not outlast the test.
    call!(library, "fake_slow_drive", fn(c_int), 0);
    (drives(library).0 - before, driven)
}

/// Resets the stop, and waits until the device has driven to its reference and pulls.
fn drives_again(game: &mut Game, library: &Library) {
    slow_open(library, 0.0, 0.0);
    call!(library, "fake_slow_drive", fn(c_int), 0);
    let before = drives(library).0;
    assert!(game.running.reset_stop());
    game.pull(library);
    assert_eq!(drives(library), (before + 1, false), "the reset lets it drive once");
}

#[test]
fn a_latched_emergency_stop_drives_no_device_that_comes_back() {
    for (name, open) in [("opens at once", 0.0), ("opens slowly", 0.04)] {
        let (library, mut game) = lost_before_a_drive(&format!("latched_{}", 1e3 * open));
        game.running.emergency_stop();
        // The loop sees the stop before it sees the device.
        std::thread::sleep(Duration::from_millis(50));
        slow_open(&library, open, 0.0);
        call!(library, "fake_gone", fn(c_int), 0);
        let (count, time) = driven(&mut game, &library);
        println!("Force Dimension, stopped, {name}: {count} drives in 2.5 s, {:.1} ms long", 1e3 * time);
        assert_eq!(count, 0, "{name}: a stopped device drives for {time:.3} s");
        drives_again(&mut game, &library);
    }
}

#[test]
fn an_emergency_stop_while_a_device_is_opened_prevents_its_drive() {
    // The stop comes while the device is being opened, or when its drive is about to begin.
    for (name, open, start, allowed) in [("opening", 0.3, 0.0, 0), ("about to drive", 0.0, 0.3, 1)] {
        let (library, mut game) = lost_before_a_drive(&format!("opening_{allowed}"));
        slow_open(&library, open, start);
        call!(library, "fake_gone", fn(c_int), 0);
        game.until("it is being opened", |_| call!(library, "fake_opening", fn() -> c_int,) == 1);
        game.running.emergency_stop();
        let (count, time) = driven(&mut game, &library);
        println!("Force Dimension, stopped while {name}: {count} drives, {:.1} ms long", 1e3 * time);
        assert!(count <= allowed, "{name}: {count} drives");
        assert!(time < 4.0 * PROMISED, "{name}: it drives for {time:.3} s");
        drives_again(&mut game, &library);
    }
}

#[test]
fn a_hung_device_is_dropped_within_a_second() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let dhd_path = fake("dhd", "hang_drop", &["-DWITHOUT_WATCHDOG"]);
    let dhd_library = open_fake(&dhd_path);
    place(&dhd_library, [0.0, 0.005, 0.0], 0.0);
    let mut game = Game::start(ForceDimension::open(dhd(&dhd_path)).unwrap());
    game.pull(&dhd_library);
    hang_dhd(&dhd_library, true);
    let took = seconds_to_drop(game);
    println!("Force Dimension: dropped after {took:?} s");
    assert!(took.is_some_and(|t| t <= 1.0), "Force Dimension: {took:?} s");
    assert_eq!(motor(&dhd_library), 0.0);
    hang_dhd(&dhd_library, false);

    let hd_path = fake("hd", "hang_drop", &[]);
    let hd_library = open_fake(&hd_path);
    place(&hd_library, [5.0, 0.0, 0.0], 0.0);
    let mut game = Game::start(OpenHaptics::open(hd(&hd_path)).unwrap());
    game.pull(&hd_library);
    servo(&hd_library, 2);
    let took = seconds_to_drop(game);
    println!("OpenHaptics: dropped after {took:?} s");
    assert!(took.is_some_and(|t| t <= 1.0), "OpenHaptics: {took:?} s");
    assert_eq!(motor(&hd_library), 0.0);
    servo(&hd_library, 0);
    // The thread that was left behind closes the device as soon as its call returns.
    for (name, library) in [("Force Dimension", &dhd_library), ("OpenHaptics", &hd_library)] {
        machine::until(name, || {
            std::thread::sleep(Duration::from_millis(1));
            if call!(library, "fake_open", fn() -> c_int,) == 0 { Ok(()) } else { Err("still open") }
        });
    }
}

#[test]
fn open_haptics_with_a_dead_scheduler() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let path = fake("hd", "dead", &[]);
    let library = open_fake(&path);
    place(&library, [5.0, 0.0, 0.0], 0.0);
    let mut game = Game::start(OpenHaptics::open(hd(&path)).unwrap());
    game.pull(&library);
    rise(&library);
    servo(&library, 1);
    let took = seconds_to_zero(|| motor(&library));
    println!("OpenHaptics, dead scheduler: force zero after {:.1} ms", 1e3 * took);
    assert!(took < 4.0 * PROMISED, "{took} s");
    let mut seen = Vec::new();
    game.until("the device counts as lost", |report| {
        seen.extend(report.tick.fault);
        report.state == LoopState::Lost
    });
    println!("faults of a dead scheduler: {:?}", seen.first());
    assert!(!seen.contains(&Fault::NotFinite), "the fault is the driver's: {seen:?}");
    servo(&library, 0);
    game.pull(&library);
    assert!(rise(&library) < 0.02, "by the ramp");
}

/// Switches the force off at the device for 0.1 s and on again. Returns the largest rise of the
/// motors' force.
fn off_and_on(game: &mut Game, library: &Library, mut switch: impl FnMut(bool)) -> f64 {
    game.pull(library);
    switch(false);
    for _ in 0..50 {
        game.publish();
        std::thread::sleep(Duration::from_millis(2));
    }
    assert_eq!(game.publish().state, LoopState::ForceOff);
    rise(library);
    switch(true);
    game.pull(library);
    rise(library)
}

#[test]
fn force_switched_off_and_on_at_the_device_ramps() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    let path = fake("dhd", "switch", &[]);
    let library = open_fake(&path);
    place(&library, [0.0, 0.005, 0.0], 0.0);
    let mut game = Game::start(ForceDimension::open(dhd(&path)).unwrap());
    let rise = off_and_on(&mut game, &library, |on| {
        call!(library, "fake_user_off", fn(c_int), c_int::from(!on));
    });
    println!("Force Dimension: the force rises by at most {rise:.4} N at once");
    assert!(rise < 0.02, "Force Dimension: a kick of {rise} N");
    drop(game);

    let path = fake("hd", "switch", &[]);
    let library = open_fake(&path);
    place(&library, [5.0, 0.0, 0.0], 0.0);
    call!(library, "fake_safety_switch", fn(c_int), 1);
    let mut game = Game::start(OpenHaptics::open(hd(&path)).unwrap());
    let rise = off_and_on(&mut game, &library, |on| {
        call!(library, "fake_safety_switch", fn(c_int), c_int::from(on));
    });
    println!("OpenHaptics: the force rises by at most {rise:.4} N at once");
    assert!(rise < 0.02, "OpenHaptics: a kick of {rise} N");
}

#[test]
fn a_calibration_that_is_lost_is_noticed() {
    let path = fake("dhd", "uncalibrated", &[]);
    let library = open_fake(&path);
    place(&library, [0.0, 0.005, 0.0], 0.0);
    let mut game = Game::start(ForceDimension::open(dhd(&path)).unwrap());
    game.pull(&library);
    call!(library, "fake_reset", fn(c_int), 0);
    let begun = Instant::now();
    while motor(&library) > 0.0 && begun.elapsed().as_secs_f64() < FOREVER {
        game.publish();
        std::thread::sleep(Duration::from_millis(2));
    }
    assert_eq!(motor(&library), 0.0, "positions of a device that has lost its reference are not believed");
    game.until("it waits", |report| report.state == LoopState::Calibrating);
    rise(&library);
    call!(library, "fake_reset", fn(c_int), 1);
    game.pull(&library);
    assert!(rise(&library) < 0.02, "by the ramp");
}

/// The game in a process of its own, for [`a_process_that_dies_or_is_stopped`].
#[test]
#[ignore = "is run by another test, in a process of its own"]
fn a_game() {
    let Ok(path) = std::env::var("PLIANT_TEST_LIBRARY") else { return };
    let (path, end) = (Path::new(&path), std::env::var("PLIANT_TEST_END").unwrap_or_default());
    let is_hd = path.file_name().is_some_and(|n| n.to_string_lossy().starts_with("libhd"));
    let library = open_fake(path);
    let mut game = if is_hd {
        Game::start(OpenHaptics::open(hd(path)).unwrap())
    } else {
        Game::start(ForceDimension::open(dhd(path)).unwrap())
    };
    game.pull(&library);
    game.until("the parent has seen it", |_| {
        std::env::var("PLIANT_TEST_SEEN").is_ok_and(|p| Path::new(&p).exists())
    });
    match end.as_str() {
        "panic" => panic!("the game's own bug, on purpose"),
        "exit" => std::process::exit(0),
        "abort" => std::process::abort(),
        _ => loop {
            game.publish();
            std::thread::sleep(Duration::from_millis(2));
        },
    }
}

fn signal(child: &Child, name: &str) {
    let done = Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status().unwrap();
    assert!(done.success());
}

#[test]
fn a_process_that_dies_or_is_stopped() {
    let _one = ONE_HD.lock().unwrap_or_else(|e| e.into_inner());
    for source in ["dhd", "hd"] {
        for end in ["KILL", "STOP", "panic", "exit", "abort"] {
            let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
            let state = folder.join(format!("{source}_{end}.state"));
            let seen = folder.join(format!("{source}_{end}.seen"));
            let _ = std::fs::remove_file(&state);
            let _ = std::fs::remove_file(&seen);
            let path = fake(source, &format!("dies_{end}"), &[&format!("-DSTATE=\"{}\"", state.display())]);
            let library = open_fake(&path);
            if source == "hd" {
                place(&library, [5.0, 0.0, 0.0], 0.0);
                // The hardware's own watchdog is a property of the device that nobody has measured.
                call!(library, "fake_hardware_watchdog", fn(f64), 0.02);
            } else {
                place(&library, [0.0, 0.005, 0.0], 0.0);
            }
            let mut child = Command::new(std::env::current_exe().unwrap())
                .args(["--exact", "a_game", "--ignored", "--nocapture"])
                .env("PLIANT_TEST_LIBRARY", &path)
                .env("PLIANT_TEST_END", end)
                .env("PLIANT_TEST_SEEN", &seen)
                // A backtrace takes a quarter of a second before the unwinding begins.
                .env("RUST_BACKTRACE", "0")
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .spawn()
                .unwrap();
            machine::until("the game pulls", || {
                std::thread::sleep(Duration::from_millis(1));
                let f = motor(&library);
                if (f - 1.0).abs() < 1e-3 { Ok(()) } else { Err(f) }
            });
            if matches!(end, "KILL" | "STOP") {
                signal(&child, end);
            } else {
                std::fs::write(&seen, "").unwrap();
                // The game ends up to one of its rounds later. The time below counts from its end.
                if end != "panic" {
                    child.wait().unwrap();
                }
            }
            let took = seconds_to_zero(|| motor(&library));
            println!("{source}, {end}: force zero after {:.1} ms", 1e3 * took);
            if end == "STOP" {
                signal(&child, "CONT");
            }
            let _ = child.kill();
            let _ = child.wait();
            assert!(took < 4.0 * PROMISED, "{source}, {end}: {took} s");
        }
    }
}
