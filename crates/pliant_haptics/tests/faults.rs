//! Faults of a device, a driver, a game or a network. The force fades, never kicks, and comes back
//! by the ramp.

use crate::rig;

use std::{
    cell::Cell,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU32, Ordering},
    },
    time::Duration,
};

use pliant_haptics::{
    Calibration, Cycle, DeviceInfo, Fault, HandModel, HapticDevice, HapticLoop, LoopConfig, LoopEvent,
    LoopReport, LoopState, PassivityConfig, SafetyConfig, SafetyError, Sample, Scheduler, StaleConfig,
    StartError, ThermalConfig, VelocityCutConfig, VirtualConfig, VirtualDevice, VirtualScheduler, Wrench,
};
use rig::{
    Rig, machine,
    scene::{Scene, SceneConfig},
};

/// Creates a scene in which a firm hand has dragged the block 2 cm to the side and holds it there.
fn holding() -> Scene {
    let mut scene =
        Scene::new(SceneConfig { young: 1e5, modes: 12, hand: HandModel::FIRM, ..SceneConfig::default() });
    scene.run(0.4);
    for k in 1..=200 {
        scene.hand.set_target([0.02 * f64::from(k) / 200.0, 0.0, 0.0]);
        scene.tick();
    }
    scene.run(0.3);
    assert!(scene.force() > 0.8, "there is a force to lose: {} N", scene.force());
    scene.largest_step = 0.0;
    scene.events.clear();
    scene
}

fn slew_per_tick() -> f64 {
    SafetyConfig::for_device(&VirtualConfig::touch().info(), 1000.0).slew.unwrap() * 1e-3
}

fn has(scene: &Scene, wanted: impl Fn(&Fault) -> bool) -> bool {
    scene.events.iter().any(|e| matches!(e, LoopEvent::Fault(f) if wanted(f)))
}

#[test]
fn device_gone_in_the_middle_of_a_grab_and_back() {
    let mut scene = holding();
    scene.hand.set_buttons(1);
    scene.run(0.01);
    assert!(scene.events.contains(&LoopEvent::Pressed(0)));
    scene.hand.set_gone(true);
    scene.run(0.5);
    assert_eq!(scene.cycle.report().state, LoopState::Lost);
    assert_eq!(scene.force(), 0.0);
    assert!(scene.events.contains(&LoopEvent::Lost));
    assert!(
        scene.events.contains(&LoopEvent::Released(0)),
        "nobody presses a button on a device that is gone"
    );
    scene.hand.set_gone(false);
    scene.run(1.0);
    assert_eq!(scene.cycle.report().state, LoopState::Running);
    assert!(scene.events.contains(&LoopEvent::Returned));
    assert_eq!(scene.cycle.core().last().buttons, 0, "held since before it came back: not believed");
    scene.run(1.0);
    assert!(scene.force() > 0.5, "and it can be felt again: {:?}", scene.cycle.core().last());
    assert!(scene.largest_step <= slew_per_tick() * 1.000_001, "and nothing kicks: {}", scene.largest_step);
}

#[test]
fn frozen_samples() {
    let mut scene = holding();
    scene.hand.set_frozen(true);
    scene.run(0.1);
    assert!(has(&scene, |f| matches!(f, Fault::Frozen(_))));
    assert_eq!(scene.force(), 0.0);
    scene.hand.set_frozen(false);
    scene.run(1.0);
    assert!(scene.force() > 0.5 && scene.largest_step <= slew_per_tick() * 1.000_001);
}

#[test]
fn simulation_late_by_a_second() {
    let mut scene = holding();
    scene.silent = true;
    let before = scene.force();
    // The last update is at most one step (8.3 ms) old. The fade begins 30 ms after the update, and
    // the force is zero 50 ms after it.
    scene.run(0.020);
    assert!(scene.force() > 0.9 * before);
    scene.run(0.031);
    assert_eq!(scene.force(), 0.0, "50 ms after the last command");
    assert!(has(&scene, |f| matches!(f, Fault::Stale(_))));
    scene.run(0.95);
    scene.silent = false;
    scene.run(0.05);
    assert!(scene.force() < 0.3 * before, "it comes back by ramp");
    scene.run(0.5);
    assert!(scene.force() > 0.9 * before, "and whole: {} of {before}", scene.force());
    assert!(scene.largest_step <= slew_per_tick() * 1.000_001);
    assert!(scene.events.contains(&LoopEvent::Clear));
}

#[test]
fn breakpoint_in_the_whole_process() {
    let mut scene = holding();
    scene.scheduler.stall(3.0);
    scene.tick();
    assert!(has(&scene, |f| matches!(f, Fault::Stalled(t) if *t > 2.9)));
    scene.run(1.0);
    assert!(
        scene.force() > 0.5 && scene.largest_step <= slew_per_tick() * 1.000_001,
        "{}",
        scene.largest_step
    );
    assert_eq!(scene.cycle.report().missed, 3000);
}

/// A hand that is where the test says, without motors.
struct At(Arc<Mutex<Sample>>);

impl HapticDevice for At {
    fn info(&self) -> DeviceInfo {
        VirtualConfig::touch().info()
    }
    fn exchange(&mut self, _: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        scheduler.wait();
        let mut sample = self.0.lock().unwrap();
        sample.sequence = sample.sequence.map(|n| n + 1);
        Ok(*sample)
    }
    fn safe_stop(&mut self) {}
}

/// Runs a loop with a spring of 200 N/m whose hand is 5 mm away, and makes `change` after a second.
/// Returns the force before the change, the largest force in the next 50 ms, the largest rise of
/// the force in a period from then on, N, and the loop.
fn after(change: impl FnOnce(&mut Sample, &mut VirtualScheduler)) -> ([f64; 3], Cycle<At>) {
    let hand = Arc::new(Mutex::new(Sample { sequence: Some(0), ..Sample::at([0.005, 0.0, 0.0]) }));
    let mut cycle = Cycle::new(At(hand.clone()), LoopConfig::default()).unwrap();
    let mut rig = Rig::bare(VirtualConfig::default(), HandModel::NONE);
    let mut scheduler = VirtualScheduler::new(1000.0);
    let mut change = Some(change);
    let (mut before, mut peak, mut rise, mut last) = (0.0, 0.0f64, 0.0f64, 0.0);
    for k in 0..3000 {
        rig.spring(200.0, 0.0);
        if k == 1000 {
            before = last;
            if let Some(change) = change.take() {
                change(&mut hand.lock().unwrap(), &mut scheduler);
            }
        }
        cycle.step(&mut scheduler, &rig.model, &mut ());
        let force = cycle.core().last().wrench.force[0].abs();
        if k >= 1000 {
            rise = rise.max(force - last);
            if k < 1050 {
                peak = peak.max(force);
            }
        }
        last = force;
    }
    ([before, peak, rise], cycle)
}

#[test]
fn a_hitch_of_the_loop_is_no_kick() {
    // The last one is a machine that was suspended.
    for late in [0.010f64, 0.015, 0.030, 0.1, 0.3, 1.0, 3600.0] {
        // Meanwhile the hand moves on at 0.5 m/s, by 1 cm at most.
        let ([before, peak, rise], cycle) = after(|hand, scheduler| {
            hand.position[0] += (0.5 * late).min(0.01);
            scheduler.stall(late);
        });
        let wanted = -cycle.core().last().wanted[0];
        let force = -cycle.core().last().wrench.force[0];
        println!(
            "late by {late} s: {before:.3} N before, at most {peak:.3} N within 50 ms, rises by at most \
             {rise:.4} N a period, {force:.3} N of {wanted:.3} in the end"
        );
        assert!((before - 1.0).abs() < 1e-6, "{before}");
        assert!(peak <= before * 1.000_001, "late by {late} s: {peak} N after {before}");
        // The ramp brings the peak force of 3.3 N in 0.3 s.
        assert!(rise <= 3.3 / 0.3 * 1e-3 * 1.000_001, "late by {late} s: {rise} N at once");
        assert!(force > 0.99 * wanted, "and it all comes back: {force} of {wanted} N");
    }
}

#[test]
fn an_update_that_is_not_a_number() {
    let mut scene = holding();
    for _ in 0..40 {
        scene.tick();
        let mut bad = scene.model.clone();
        bad.tick += 1_000_000;
        bad.contacts[0].proxy[1] = f64::NAN;
        let good = std::mem::replace(&mut scene.model, bad);
        scene.cycle.step(&mut scene.scheduler, &scene.model, &mut scene.events);
        scene.model = good;
        assert!(scene.cycle.core().last().wrench.force.iter().all(|x| x.is_finite()));
    }
    assert!(has(&scene, |f| *f == Fault::BadModel));
    assert!(scene.force() < 1e-6);
    scene.run(1.0);
    assert!(scene.force() > 0.5);
}

#[test]
fn emergency_stop_is_latched() {
    let mut scene = holding();
    scene.cycle.emergency_stop();
    scene.tick();
    assert_eq!(scene.force(), 0.0, "at once");
    assert_eq!(scene.cycle.report().state, LoopState::Stopped);
    scene.run(2.0);
    assert_eq!(scene.force(), 0.0);
    scene.cycle.reset_stop();
    scene.largest_step = 0.0;
    scene.run(1.0);
    assert!(scene.force() > 0.5 && scene.largest_step <= slew_per_tick() * 1.000_001);
}

/// A device that falsifies its samples as the test demands.
struct Liar {
    inner: VirtualDevice,
    lie: Cell<Lie>,
}

#[derive(Clone, Copy, PartialEq)]
enum Lie {
    None,
    NotANumber,
    Elsewhere,
    Wild,
    Error,
    ErrorAtOnce,
}

impl HapticDevice for Liar {
    fn info(&self) -> DeviceInfo {
        self.inner.info()
    }
    fn calibration(&mut self) -> Calibration {
        self.inner.calibration()
    }
    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        if self.lie.get() == Lie::ErrorAtOnce {
            return Err(Fault::Driver(7));
        }
        let sample = self.inner.exchange(wrench, scheduler)?;
        match self.lie.get() {
            Lie::NotANumber => Ok(Sample { position: [f64::NAN; 3], ..sample }),
            Lie::Elsewhere => {
                let [x, y, z] = sample.position;
                Ok(Sample { position: [x + 1.0, y, z], ..sample })
            }
            Lie::Wild => Ok(Sample { velocity: Some([0.0, 1e200, 0.0]), ..sample }),
            Lie::Error => Err(Fault::Driver(0x301)),
            _ => Ok(sample),
        }
    }
    fn safe_stop(&mut self) {
        self.inner.safe_stop();
    }
    fn reopen(&mut self) -> Result<(), Fault> {
        if matches!(self.lie.get(), Lie::Error | Lie::ErrorAtOnce) { Err(Fault::Gone) } else { Ok(()) }
    }
}

/// Runs a spring of 200 N/m that a firm hand stretches by 1 cm, with `lie` for `ticks` periods and
/// without it before and after.
fn run_with(lie: Lie, ticks: usize) -> (Cycle<Liar>, Vec<LoopEvent>, f64, f64) {
    let device = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM).unwrap();
    let hand = device.handle();
    hand.set_target([0.014, 0.0, 0.0]);
    let mut cycle =
        Cycle::new(Liar { inner: device, lie: Cell::new(Lie::None) }, LoopConfig::default()).unwrap();
    let mut rig = Rig::bare(VirtualConfig::default(), HandModel::NONE);
    let mut scheduler = VirtualScheduler::new(1000.0);
    let mut events = Vec::new();
    let (mut last, mut step) = ([0.0f64; 3], 0.0f64);
    let mut lowest = f64::INFINITY;
    for k in 0..4000 + ticks {
        let lying = (1000..1000 + ticks).contains(&k);
        cycle.device().lie.set(if lying { lie } else { Lie::None });
        rig.spring(200.0, 0.0);
        cycle.step(&mut scheduler, &rig.model, &mut events);
        let force = cycle.core().last().wrench.force;
        step = step.max((0..3).map(|i| (force[i] - last[i]).powi(2)).sum::<f64>().sqrt());
        last = force;
        if lying {
            lowest = lowest.min(force[0].abs());
        }
    }
    (cycle, events, lowest, step)
}

#[test]
fn not_a_number_from_the_device() {
    let (cycle, events, lowest, step) = run_with(Lie::NotANumber, 60);
    assert!(events.contains(&LoopEvent::Fault(Fault::NotFinite)));
    assert_eq!(lowest, 0.0, "faded within 60 ms");
    assert!(cycle.core().last().wrench.force[0] < -1.0, "and back: {:?}", cycle.core().last().wrench);
    assert!(step <= slew_per_tick() * 1.000_001, "{step}");
}

#[test]
fn a_velocity_that_overflows() {
    // The velocity is finite, but its square is not. Both one such sample and many are tested.
    for ticks in [1, 60] {
        let (mut cycle, events, lowest, step) = run_with(Lie::Wild, ticks);
        assert!(events.iter().any(|e| matches!(e, LoopEvent::Fault(Fault::TooFast(v)) if *v == 1e200)));
        assert!(lowest.is_finite() && (ticks == 1 || lowest == 0.0), "faded: {lowest} N");
        assert!(cycle.core().last().wrench.force[0] < -1.0, "and back: {:?}", cycle.core().last().wrench);
        assert!(step <= slew_per_tick() * 1.000_001, "{step}");
        cycle.emergency_stop();
        cycle.step(&mut VirtualScheduler::new(1000.0), &pliant_haptics::LocalModel::default(), &mut ());
        assert_eq!(cycle.core().last().wrench, Wrench::ZERO);
    }
}

#[test]
fn a_jump_of_a_meter() {
    let (cycle, events, lowest, step) = run_with(Lie::Elsewhere, 500);
    assert!(events.iter().any(|e| matches!(e, LoopEvent::Fault(Fault::Jump(d)) if (d - 1.0).abs() < 0.01)));
    assert!(lowest < 1e-9);
    assert!(step <= slew_per_tick() * 1.000_001, "{step}");
    // The new position was taken over without moving the tool, so the spring was never stretched by
    // 1 m.
    let tool = cycle.core().last().tool;
    assert!(tool[0].abs() < 0.02, "{tool:?}");
}

#[test]
fn a_driver_that_fails_each_tick() {
    for lie in [Lie::Error, Lie::ErrorAtOnce] {
        let (cycle, events, lowest, step) = run_with(lie, 1500);
        assert!(events.iter().any(|e| matches!(e, LoopEvent::Fault(Fault::Driver(_)))));
        assert!(events.contains(&LoopEvent::Lost), "after 100 ms it counts as lost");
        assert!(events.contains(&LoopEvent::Returned));
        assert_eq!(lowest, 0.0);
        assert!(cycle.core().last().wrench.force[0] < -1.0);
        assert!(step <= slew_per_tick() * 1.000_001, "and nothing kicks, going or coming back: {step}");
        let of_kind = cycle.report().faults[Fault::Driver(0).kind()];
        assert!(
            of_kind >= 1 && events.len() < 20,
            "told when it changes, not each tick: {} events",
            events.len()
        );
    }
}

#[test]
fn a_real_device_is_not_run_without_its_safety() {
    let real = || Real(VirtualDevice::new(VirtualConfig::touch(), HandModel::NONE).unwrap());
    let bare = LoopConfig { safety: Some(SafetyConfig::bare()), ..LoopConfig::default() };
    let refused = Cycle::new(real(), bare).err();
    assert!(
        matches!(refused, Some(StartError::Unsafe { reason: SafetyError::Missing(_), .. })),
        "{refused:?}"
    );
    assert!(Cycle::new(real(), LoopConfig::default()).is_ok());
    for rate in [100.0, 1e5, f64::NAN] {
        let config = LoopConfig { rate, ..LoopConfig::default() };
        assert!(matches!(Cycle::new(real(), config), Err(StartError::Rate(_))));
    }
}

/// A virtual Touch that claims to be real.
struct Real(VirtualDevice);

impl HapticDevice for Real {
    fn info(&self) -> DeviceInfo {
        DeviceInfo { simulated: false, ..self.0.info() }
    }
    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        self.0.exchange(wrench, scheduler)
    }
    fn safe_stop(&mut self) {}
}

#[test]
fn limits_that_limit_nothing_are_refused() {
    let real = || Real(VirtualDevice::new(VirtualConfig::touch(), HandModel::NONE).unwrap());
    let full = SafetyConfig::for_device(&real().info(), 1000.0);
    let changes: [(&str, fn(&mut SafetyConfig)); 17] = [
        ("slew", |s| s.slew = Some(1e300)),
        // A force that may hardly change cannot fall either.
        ("slew", |s| s.slew = Some(1e-300)),
        ("ramp", |s| s.ramp = Some(1e-300)),
        ("fade", |s| s.fade = Some(1e-300)),
        ("fade", |s| s.fade = Some(1.0)),
        ("stale.limit", |s| s.stale = Some(StaleConfig { patience: 0.03, limit: 1e9 })),
        ("stale.patience", |s| s.stale = Some(StaleConfig { patience: f64::NAN, limit: 0.05 })),
        ("stale.patience", |s| s.stale = Some(StaleConfig { patience: 0.05, limit: 0.05 })),
        ("velocity.limit", |s| s.velocity = Some(VelocityCutConfig { limit: 1e3, release: 0.5 })),
        ("velocity.release", |s| s.velocity = Some(VelocityCutConfig { limit: 1.0, release: 2.0 })),
        ("passivity.tank", |s| s.passivity = Some(PassivityConfig { tank: 1e3, ..Default::default() })),
        ("passivity.repay", |s| s.passivity = Some(PassivityConfig { repay: 1e3, ..Default::default() })),
        ("passivity.max_damping", |s| {
            s.passivity = Some(PassivityConfig { max_damping: 1e3, ..Default::default() });
        }),
        ("max_damping", |s| s.max_damping = Some(1e300)),
        ("thermal.continuous", |s| {
            s.thermal = Some(ThermalConfig { continuous: 1e3, peak_seconds: 2.0 });
        }),
        ("thermal.peak_seconds", |s| {
            s.thermal = Some(ThermalConfig { continuous: 0.5, peak_seconds: 1e9 });
        }),
        ("peak", |s| s.peak = Some(100.0)),
    ];
    for (what, change) in changes {
        let mut safety = full;
        change(&mut safety);
        let config = LoopConfig { safety: Some(safety), ..LoopConfig::default() };
        let Some(StartError::Unsafe { reason: SafetyError::OutOfBounds { what: named, .. }, .. }) =
            Cycle::new(real(), config).err()
        else {
            panic!("{what}: {safety:?} is accepted");
        };
        assert_eq!(named, what);
    }
}

/// A device whose driver panics on demand.
struct Bomb {
    inner: VirtualDevice,
    panic: Arc<AtomicBool>,
    stopped: Arc<AtomicU32>,
    /// Whether the driver panics once more when it is stopped.
    twice: bool,
}

impl HapticDevice for Bomb {
    fn info(&self) -> DeviceInfo {
        self.inner.info()
    }
    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        // A loop that went on would have the device back.
        assert!(!self.panic.swap(false, Ordering::AcqRel), "the driver's own bug, on purpose");
        self.inner.exchange(wrench, scheduler)
    }
    fn safe_stop(&mut self) {
        self.inner.safe_stop();
        self.stopped.fetch_add(1, Ordering::AcqRel);
        assert!(!self.twice, "and another one, on purpose");
    }
}

#[test]
fn a_driver_that_panics() {
    for twice in [false, true] {
        let inner = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM).unwrap();
        let hand = inner.handle();
        hand.set_target([0.014, 0.0, 0.0]);
        let (panic, stopped) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU32::new(0)));
        let bomb = Bomb { inner, panic: panic.clone(), stopped: stopped.clone(), twice };
        let mut running = HapticLoop::start(bomb, machine::patient()).unwrap();
        let mut tick = 0;
        let mut received: Vec<LoopEvent> = Vec::new();
        let mut until = |running: &mut HapticLoop,
                         received: &mut Vec<LoopEvent>,
                         what: &str,
                         so: &dyn Fn(&LoopReport) -> bool| {
            machine::until(what, || {
                tick += 1;
                running.publish(|model| {
                    (model.tick, model.period, model.count) = (tick, 0.01, 1);
                    model.contacts[0].stiffness = [[200.0, 0.0, 0.0], [0.0, 200.0, 0.0], [0.0, 0.0, 200.0]];
                });
                std::thread::sleep(Duration::from_millis(10));
                received.extend(running.events());
                let report = running.report();
                if so(report) { Ok(()) } else { Err(Box::new((report.state, report.tick))) }
            });
        };
        until(&mut running, &mut received, "a force", &|r| r.tick.wrench.force[0] < -0.5);
        hand.set_buttons(1);
        until(&mut running, &mut received, "a force and a button", &|r| {
            r.tick.wrench.force[0] < -0.5 && r.tick.buttons == 1
        });
        assert_eq!(running.report().state, LoopState::Running);
        panic.store(true, Ordering::Release);
        until(&mut running, &mut received, "the end", &|r| r.state == LoopState::Ended);
        received.extend(running.events());
        let report = *running.report();
        assert_eq!(report.tick.wrench, Wrench::ZERO, "nobody is told of a force that is not there");
        assert_eq!((report.tick.gain, report.tick.buttons, report.rate), (0.0, 0, 0.0));
        assert_eq!(report.tick.fault, Some(Fault::Panicked));
        assert_eq!(report.faults[Fault::Panicked.kind()], 1);
        assert!(stopped.load(Ordering::Acquire) >= 1, "and the device was told to let go");
        let last: Vec<_> = received.iter().rev().take(3).rev().copied().collect();
        assert_eq!(
            last,
            [LoopEvent::Released(0), LoopEvent::Fault(Fault::Panicked), LoopEvent::Lost],
            "{received:?}"
        );
        // The events are sent only once, and the state is final.
        received.clear();
        until(&mut running, &mut received, "another look", &|_| true);
        assert_eq!(received, []);
        assert_eq!(running.report().state, LoopState::Ended);
    }
}

/// The app panics beside a device that works. The loop ends with its [`HapticLoop`], and leaves no
/// force to the device's own watchdog.
#[test]
fn an_app_that_panics_ends_its_loop() {
    let inner = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM).unwrap();
    let stopped = Arc::new(AtomicU32::new(0));
    let bomb = Bomb { inner, panic: Arc::default(), stopped: stopped.clone(), twice: false };
    let app = std::thread::spawn(move || {
        let _running = HapticLoop::start(bomb, machine::patient()).unwrap();
        panic!("the app's own bug, on purpose");
    });
    assert!(app.join().is_err());
    assert_eq!(stopped.load(Ordering::Acquire), 1, "the device was told to let go");
}
