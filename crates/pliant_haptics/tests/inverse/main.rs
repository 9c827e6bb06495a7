//! The Inverse against a fake service. The service is strict and refuses everything that the
//! vendor's documentation does not allow.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
#![cfg(feature = "inverse")]

mod losses;
mod service;

#[path = "../rig/machine.rs"]
mod machine;

use std::time::{Duration, Instant};

use pliant_haptics::{
    Cycle, Fault, HapticDevice, HapticLoop, Inverse, InverseConfig, InverseError, LocalModel, LoopConfig,
    LoopEvent, RealScheduler, SafetyConfig, Sample, Spelling, StaleConfig, VirtualScheduler, Wrench,
};

use service::Service;

fn pacing() -> RealScheduler {
    RealScheduler::new(pliant_haptics::LoopClock::start(), 1000.0)
}

fn second(config: InverseConfig) -> InverseConfig {
    InverseConfig { device: Some("049D".into()), ..config }
}

#[test]
fn both_spellings_and_the_axes() {
    for (new, want) in [(true, Spelling::Vector), (false, Spelling::Values)] {
        let service = Service::start(new);
        assert_eq!(Inverse::list(&service.config()).unwrap(), ["04BA", "049D"]);
        service.desk().position = [0.01, 0.02, 0.03];
        service.desk().buttons = true;
        let mut device = Inverse::open(second(service.config())).unwrap();
        assert_eq!(device.spelling(), want);
        // A force of 1 N right, 2 N up, 3 N toward the user is (1, -3, 2) for the service.
        let sample =
            device.exchange(&Wrench { force: [1.0, 2.0, 3.0], ..Wrench::ZERO }, &mut pacing()).unwrap();
        assert_eq!(service.desk().forces, [[1.0, -3.0, 2.0]]);
        assert_eq!(sample.position, [0.01, 0.03, -0.02]);
        assert_eq!(sample.velocity, Some([0.1, 0.3, -0.2]));
        assert_eq!(sample.orientation, [0.5, 0.5, -0.5, 0.5]);
        assert_eq!(sample.buttons, 0b101);
        drop(device);
        assert_eq!(service.desk().forces.last(), Some(&[0.0, -0.0, 0.0]), "the last word is no force");
        assert_eq!(service.desk().refused, [""; 0]);
    }
}

#[test]
fn a_wrong_guess_is_put_right() {
    // These services use another field name than their inventory suggests. They refuse the first
    // command and accept the second.
    for (inventory, new, want) in [(true, false, Spelling::Values), (false, true, Spelling::Vector)] {
        let service = Service::speaking(inventory, new);
        let mut device = Inverse::open(second(service.config())).unwrap();
        assert!(device.exchange(&Wrench { force: [1.0, 0.0, 0.0], ..Wrench::ZERO }, &mut pacing()).is_ok());
        assert_eq!(device.spelling(), want);
        assert_eq!(service.desk().forces, [[1.0, -0.0, 0.0]]);
        assert_eq!(service.desk().refused.len(), 1);
    }
    // The user's setting applies, whether it is right or wrong.
    let service = Service::start(true);
    let config = InverseConfig { spelling: Some(Spelling::Values), ..second(service.config()) };
    let mut device = Inverse::open(config).unwrap();
    assert!(device.exchange(&Wrench::ZERO, &mut pacing()).is_err());
    assert_eq!(device.spelling(), Spelling::Values);
}

#[test]
fn the_loop_feels_a_spring_through_it() {
    let service = Service::start(true);
    service.desk().position = [0.004, 0.0, 0.0];
    let device = Inverse::open(second(service.config())).unwrap();
    let mut cycle = Cycle::new(device, LoopConfig::default()).unwrap();
    // In virtual time an answer is in time, however long a busy machine takes for it.
    let mut scheduler = VirtualScheduler::new(1000.0);
    let mut events: Vec<LoopEvent> = Vec::new();
    let mut model = LocalModel { count: 1, period: 0.01, ..LocalModel::default() };
    model.contacts[0].stiffness = [[100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 100.0]];
    let mut step = |cycle: &mut Cycle<Inverse>, events: &mut Vec<LoopEvent>| {
        model.tick += 1;
        cycle.step(&mut scheduler, &model, events);
        cycle.core().last().wrench.force[0]
    };
    for _ in 0..400 {
        step(&mut cycle, &mut events);
    }
    assert_eq!((cycle.core().last().gain, cycle.core().last().fault), (1.0, None), "after the ramp");
    let force = cycle.core().last().wrench.force;
    assert!((force[0] + 0.4).abs() < 1e-3, "100 N/m over 4 mm: {force:?}");
    // The device disappears in the middle of the grab and comes back by itself.
    service.desk().hang_up = true;
    let lost = (0..200).any(|_| {
        step(&mut cycle, &mut events);
        events.contains(&LoopEvent::Lost)
    });
    assert!(lost, "{events:?}");
    service.desk().hang_up = false;
    let returned = (0..10_000).any(|_| {
        step(&mut cycle, &mut events);
        events.contains(&LoopEvent::Returned)
    });
    assert!(returned, "{events:?}");
    let (mut largest, mut last) = (0.0f64, cycle.core().last().wrench.force[0]);
    for _ in 0..400 {
        let force = step(&mut cycle, &mut events);
        largest = largest.max(last - force);
        last = force;
    }
    // 0.4 N in 300 ms are 1.3 mN per period.
    assert!(last < -0.3 && largest < 0.002, "comes back by the ramp: {last} N, steps of {largest} N");
    assert_eq!(service.desk().refused, [""; 0]);
}

#[test]
fn nonsense_and_silence() {
    let service = Service::start(true);
    let config = second(service.config());
    let mut device = Inverse::open(config.clone()).unwrap();
    let mut scheduler = pacing();
    assert!(device.exchange(&Wrench::ZERO, &mut scheduler).is_ok());
    for (nonsense, want) in [
        ("not json", Fault::Malformed),
        ("{\"inverse3\": 3}", Fault::Gone),
        ("{\"inverse3\": []}", Fault::Gone),
        ("{\"inverse3\": [{\"device_id\": \"049D\", \"state\": {}}]}", Fault::Malformed),
        (
            "{\"inverse3\": [{\"device_id\": \"049D\", \"state\": {\"cursor_position\": {\"x\": \"a\"}}}]}",
            Fault::Malformed,
        ),
    ] {
        service.desk().say = Some(nonsense.into());
        assert_eq!(device.exchange(&Wrench::ZERO, &mut scheduler).unwrap_err(), want, "{nonsense}");
    }
    service.desk().say = None;
    drop(device);
    let mut device = hasty(&service);
    assert!(answer(&mut device).position[0].abs() < 1e-9);
    service.desk().mute = true;
    assert_eq!(device.exchange(&Wrench::ZERO, &mut scheduler).unwrap_err(), Fault::Timeout(HASTE));
    drop(device);
    service.desk().mute = false;
    let missing = Inverse::open(InverseConfig { device: Some("FFFF".into()), ..config });
    assert!(
        matches!(missing, Err(InverseError::NoDevice { ref found, .. }) if found.len() == 2),
        "{missing:?}"
    );
    let nobody = machine::Nobody::new();
    let nobody = Inverse::open(InverseConfig { address: nobody.address.clone(), ..InverseConfig::default() });
    assert!(matches!(nobody, Err(InverseError::Connect { .. })), "{nobody:?}");
}

/// Timeout for tests that wait until it expires, s.
const HASTE: f64 = 0.2;

/// Opens a device with the timeout [`HASTE`]. A busy service may need more than one try.
fn hasty(service: &Service) -> Inverse {
    let config = InverseConfig { timeout: HASTE, ..second(service.config()) };
    machine::until("a connection in time", || Inverse::open(config.clone()))
}

/// Exchanges until an answer comes in time. As the loop does, the function reopens a device that is
/// gone.
fn answer(device: &mut Inverse) -> Sample {
    machine::until("an answer in time", || {
        let answer = device.exchange(&Wrench::ZERO, &mut pacing());
        answer.inspect_err(|_| {
            let _ = device.reopen();
        })
    })
}

/// A running loop and the game that publishes a spring of 200 N/m to the center.
struct Game {
    running: HapticLoop,
    tick: u64,
}

impl Game {
    /// Starts the loop on a device whose simulation may be late by 0.2 s.
    fn start(config: InverseConfig) -> Self {
        let device = Inverse::open(config).unwrap();
        let stale = Some(StaleConfig { patience: 0.2, limit: 0.25 });
        let safety = SafetyConfig { stale, ..SafetyConfig::for_device(&device.info(), 1000.0) };
        let config = LoopConfig { safety: Some(safety), ..LoopConfig::default() };
        Self { running: HapticLoop::start(device, config).unwrap(), tick: 0 }
    }

    fn publish(&mut self) {
        self.tick += 1;
        self.running.publish(|model| {
            (model.tick, model.period, model.count) = (self.tick, 0.01, 1);
            model.contacts[0].stiffness = [[200.0, 0.0, 0.0], [0.0, 200.0, 0.0], [0.0, 0.0, 200.0]];
        });
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Waits for 1 N on the motors, while `step` lets time pass.
fn pulled(service: &Service, mut step: impl FnMut()) {
    machine::until("1 N on the motors", || {
        step();
        let force = service.desk().motor;
        if (force - 1.0).abs() < 1e-3 { Ok(()) } else { Err(force) }
    });
}

/// Makes the service hold its next answer back, and waits until it does.
fn hold_back(service: &Service) {
    service.desk().late = true;
    machine::until("an answer is held back", || {
        std::thread::sleep(Duration::from_micros(200));
        if service.desk().held { Ok(()) } else { Err("no command has come") }
    });
}

/// Returns the time from now to a force of zero on the motors, s, at most 1.
fn seconds_to_zero(service: &Service) -> f64 {
    let begun = Instant::now();
    while service.desk().motor > 0.0 && begun.elapsed().as_secs_f64() < 1.0 {
        std::thread::sleep(Duration::from_micros(200));
    }
    begun.elapsed().as_secs_f64()
}

#[test]
fn a_service_that_does_not_answer_loses_its_force() {
    let service = Service::start(true);
    service.desk().position = [0.005, 0.0, 0.0];
    let mut game = Game::start(second(service.config()));
    let mut times = Vec::new();
    while times.len() < 5 && times.last().is_none_or(|t| *t > 0.05) {
        pulled(&service, || game.publish());
        hold_back(&service);
        times.push(seconds_to_zero(&service));
        service.desk().late = false;
        assert!(times.iter().all(|t| *t < 1.0), "the force is still on after {times:?} s");
    }
    println!("Inverse: force zero after {times:?} s, {} commands for it", service.desk().zeros);
    assert!(times.iter().any(|t| *t <= 0.05), "{times:?} s");
    // A device that hangs is dropped in time as well.
    pulled(&service, || game.publish());
    hold_back(&service);
    let begun = Instant::now();
    drop(game);
    let took = begun.elapsed().as_secs_f64();
    println!("Inverse: dropped after {took:.3} s");
    assert!(took <= 1.0, "{took} s");
    assert!(seconds_to_zero(&service) < 1.0, "no force is left behind");
    // What a service does with the force of a closed connection is not published.
    let zeros = service.desk().zeros;
    assert_eq!(zeros, times.len() + 1, "each connection ends with a command without a force");
    service.desk().late = false;
}

/// The game in a process of its own, for [`a_process_that_dies`].
#[test]
#[ignore = "is run by another test, in a process of its own"]
fn a_game() {
    let Ok(address) = std::env::var("PLIANT_TEST_SERVICE") else { return };
    let [end, seen] =
        ["PLIANT_TEST_END", "PLIANT_TEST_SEEN"].map(|name| std::env::var(name).unwrap_or_default());
    let mut game = Game::start(second(InverseConfig { address, timeout: 10.0, ..InverseConfig::default() }));
    while !std::path::Path::new(&seen).exists() {
        game.publish();
    }
    match end.as_str() {
        "panic" => panic!("the game's own bug, on purpose"),
        "exit" => std::process::exit(0),
        _ => std::process::abort(),
    }
}

#[test]
fn a_process_that_dies() {
    for end in ["KILL", "panic", "exit", "abort"] {
        let service = Service::start(true);
        service.desk().position = [0.005, 0.0, 0.0];
        let seen = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("inverse_{end}.seen"));
        let _ = std::fs::remove_file(&seen);
        let mut child = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "a_game", "--ignored", "--nocapture"])
            .env("PLIANT_TEST_SERVICE", &service.address)
            .env("PLIANT_TEST_END", end)
            .env("PLIANT_TEST_SEEN", &seen)
            // A backtrace takes a quarter of a second before the unwinding begins.
            .env("RUST_BACKTRACE", "0")
            .stdout(std::process::Stdio::null())
            .stderr(std::process::Stdio::null())
            .spawn()
            .unwrap();
        pulled(&service, || std::thread::sleep(Duration::from_millis(1)));
        let begun = if end == "KILL" {
            child.kill().unwrap();
            Instant::now()
        } else {
            std::fs::write(&seen, "").unwrap();
            let written = Instant::now();
            // The game ends up to one of its rounds later. The time below counts from its end.
            if end == "panic" {
                written
            } else {
                child.wait().unwrap();
                Instant::now()
            }
        };
        while service.desk().ended == 0 && begun.elapsed().as_secs_f64() < 5.0 {
            std::thread::sleep(Duration::from_micros(200));
        }
        let took = begun.elapsed().as_secs_f64();
        child.wait().unwrap();
        let last = service.desk().forces.last().map(|f| f.map(f64::abs).iter().sum::<f64>());
        println!("Inverse, {end}: closed after {:.1} ms, {last:?} N was sent last", 1e3 * took);
        // The system closes the connection. That a real service then lets go of the force is
        // assumed, and only a panic that unwinds says so by its last command.
        assert!(took < 0.2, "{end}: {took} s");
        assert!(end != "panic" || last == Some(0.0), "{end}: {last:?}");
        assert_eq!(service.desk().refused, [""; 0], "{end}: no command was sent in part");
    }
}

#[test]
fn a_cut_while_the_device_is_opened_again_sends_no_force() {
    let service = Service::start(true);
    let mut device = Inverse::open(second(service.config())).unwrap();
    let pull = Wrench { force: [1.0, 0.0, 0.0], ..Wrench::ZERO };
    assert!(device.exchange(&Wrench::ZERO, &mut pacing()).is_ok());
    let stop = device.stop_handle().unwrap();
    service.desk().unfriendly = true;
    let opening = std::thread::spawn(move || {
        let opened = device.reopen();
        (opened, opened.is_ok() && device.exchange(&pull, &mut pacing()).is_ok(), device)
    });
    machine::until("it is being opened", || {
        std::thread::sleep(Duration::from_millis(1));
        if service.desk().waits { Ok(()) } else { Err("nobody has connected") }
    });
    // The emergency stop, for example.
    stop.cut();
    service.desk().unfriendly = false;
    let (opened, sent, mut device) = opening.join().unwrap();
    let motor = service.desk().motor;
    println!("Inverse, cut while it is opened again: {opened:?}, {motor} N");
    assert_eq!((opened, sent, motor), (Err(Fault::Gone), false, 0.0));
    device.reopen().unwrap();
    assert!(device.exchange(&pull, &mut pacing()).is_ok(), "the next connection is not cut");
}
