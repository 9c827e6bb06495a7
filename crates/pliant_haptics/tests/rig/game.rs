//! A game on a fake device that hangs, and how long its force stays on.
#![allow(dead_code, reason = "every test uses its own part of it")]

use std::{
    ffi::c_int,
    sync::mpsc,
    time::{Duration, Instant},
};

use libloading::Library;
use pliant_haptics::{HapticDevice, HapticLoop, LoopConfig, LoopReport, SafetyConfig, StaleConfig};

use super::{fakes::motor, machine};

/// Longest time from a hang to a force of zero, s.
pub const PROMISED: f64 = 0.050;
/// Time after which a force that is still there counts as left on, s.
pub const FOREVER: f64 = 1.0;

/// Settings of a real device whose simulation may be late by 0.2 s, because the machine is busy.
pub fn config(device: &dyn HapticDevice) -> LoopConfig {
    let stale = Some(StaleConfig { patience: 0.2, limit: 0.25 });
    let safety = SafetyConfig { stale, ..SafetyConfig::for_device(&device.info(), 1000.0) };
    LoopConfig { safety: Some(safety), ..LoopConfig::default() }
}

/// A running loop and the game that publishes a spring of 200 N/m to the center.
pub struct Game {
    pub running: HapticLoop,
    tick: u64,
}

impl Game {
    pub fn start(device: impl HapticDevice + 'static) -> Self {
        let config = config(&device);
        Self { running: HapticLoop::start(device, config).unwrap(), tick: 0 }
    }

    pub fn publish(&mut self) -> LoopReport {
        self.tick += 1;
        self.running.publish(|model| {
            (model.tick, model.period, model.count) = (self.tick, 0.01, 1);
            model.contacts[0].stiffness = [[200.0, 0.0, 0.0], [0.0, 200.0, 0.0], [0.0, 0.0, 200.0]];
        });
        *self.running.report()
    }

    /// Publishes every 2 ms until `so`.
    #[track_caller]
    pub fn until(&mut self, what: &str, mut so: impl FnMut(&LoopReport) -> bool) {
        machine::until(what, || {
            let report = self.publish();
            std::thread::sleep(Duration::from_millis(2));
            if so(&report) { Ok(()) } else { Err(Box::new((report.state, report.tick))) }
        });
    }

    /// Waits for the whole force of 1 N on the motors.
    pub fn pull(&mut self, library: &Library) {
        self.until("1 N on the motors", |_| (motor(library) - 1.0).abs() < 1e-3);
    }
}

/// Returns the time from now to a force of zero on the motors, s, at most [`FOREVER`].
pub fn seconds_to_zero(motor: impl Fn() -> f64) -> f64 {
    let begun = Instant::now();
    while motor() > 0.0 && begun.elapsed().as_secs_f64() < FOREVER {
        std::thread::sleep(Duration::from_micros(200));
    }
    begun.elapsed().as_secs_f64()
}

/// Runs `round` up to five times and returns the shortest time, because a busy machine may wake
/// every thread late. No round may leave the force on.
#[track_caller]
pub fn best(what: &str, mut round: impl FnMut() -> f64) -> f64 {
    let mut times = Vec::new();
    while times.len() < 5 && times.last().is_none_or(|t| *t > PROMISED) {
        let took = round();
        times.push(took);
        assert!(took < FOREVER, "{what}: the force is still on after {took:.3} s");
    }
    let best = times.iter().copied().fold(f64::INFINITY, f64::min);
    println!("{what}: force zero {:.1} ms after the hang", 1e3 * best);
    assert!(best <= PROMISED, "{what}: {times:?} s");
    best
}

pub fn hang_dhd(library: &Library, on: bool) {
    call!(library, "fake_hang", fn(c_int), c_int::from(on));
    if on {
        machine::until("the call hangs", || {
            std::thread::sleep(Duration::from_micros(100));
            if call!(library, "fake_hung", fn() -> c_int,) == 1 { Ok(()) } else { Err("it returns") }
        });
    }
}

/// Sets what the fake's servo does: 0 is alive, 1 dead, 2 stuck, 3 stuck in the caller's call only,
/// 4 stuck in every call that schedules something.
pub fn servo(library: &Library, mode: c_int) {
    call!(library, "fake_servo", fn(c_int), mode);
    if mode >= 2 {
        machine::until("the call hangs", || {
            std::thread::sleep(Duration::from_micros(100));
            if call!(library, "fake_hung", fn() -> c_int,) == 1 { Ok(()) } else { Err("it returns") }
        });
    }
}

/// Drops `game` on another thread, and returns the time that the drop took, s, if it was at most 5.
pub fn seconds_to_drop(game: Game) -> Option<f64> {
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        let begun = Instant::now();
        drop(game);
        let _ = sender.send(begun.elapsed().as_secs_f64());
    });
    receiver.recv_timeout(Duration::from_secs(5)).ok()
}
