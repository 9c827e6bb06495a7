//! Changes of the held patches during a grab: other grabs, another copy of the body, another
//! device. The force is neither cut nor does it jump.

use crate::rig;

use std::sync::{
    Arc,
    atomic::{AtomicU32, Ordering},
};

use pliant_haptics::{
    Cycle, DeviceInfo, Fault, HandModel, HapticDevice, LocalModel, LoopConfig, LoopCore, LoopEvent,
    LoopState, ModalLocal, SafetyConfig, Sample, Scheduler, ToolContact, VirtualConfig, VirtualDevice,
    VirtualScheduler, Wrench,
};
use pliant_modal::{BodyConfig, StepSettings};
use rig::scene::{Scene, SceneConfig};

/// Creates a scene in which a firm hand has dragged the block to the side and holds it there.
fn holding(modal: bool, pull: f64) -> Scene {
    let hand = HandModel::FIRM;
    let mut scene = Scene::new(SceneConfig { young: 1e5, modes: 12, hand, modal, ..SceneConfig::default() });
    scene.run(0.4);
    for k in 1..=200 {
        scene.hand.set_target([pull * f64::from(k) / 200.0, 0.0, 0.0]);
        scene.tick();
    }
    scene.run(0.3);
    assert!(scene.force() > 0.8, "there is a force to lose: {} N", scene.force());
    scene.largest_step = 0.0;
    scene
}

/// Returns the smallest and largest force over `seconds`, N.
fn range(scene: &mut Scene, seconds: f64) -> [f64; 2] {
    (0..(seconds * 1000.0) as usize).fold([f64::INFINITY, 0.0f64], |[low, high], _| {
        scene.tick();
        [low.min(scene.force()), high.max(scene.force())]
    })
}

#[test]
fn a_new_copy_of_the_body_takes_over_without_letting_go() {
    for modal in [false, true] {
        let mut scene = holding(modal, 0.02);
        let before = scene.force();
        // The copy changes ten times in a quarter of a second, as it does while a user drags a
        // slider.
        for _ in 0..10 {
            let copy = ModalLocal::new(&scene.body, &[scene.held], 1.0, 1000.0).unwrap();
            scene.cycle.set_modal(Some(Box::new(copy)));
            let [low, high] = range(&mut scene, 0.025);
            assert!(low > 0.9 * before && high < 1.1 * before, "{low} to {high} N of {before}");
        }
        // The last change goes back to the proxy.
        scene.cycle.set_modal(None);
        let [low, high] = range(&mut scene, 0.4);
        assert!(low > 0.9 * before && high < 1.1 * before, "{low} to {high} N of {before}");
    }
}

#[test]
fn a_stiffer_body_is_felt_as_one_little_by_little() {
    let mut scene = holding(true, 0.01);
    let before = scene.force();
    let stiffer = BodyConfig {
        settings: StepSettings { stiffness_scale: 4.0, ..scene.body.config().settings },
        ..scene.body.config().clone()
    };
    scene.body.reconfigure(stiffer).unwrap();
    let copy = ModalLocal::new(&scene.body, &[scene.held], 1.0, 1000.0).unwrap();
    scene.cycle.set_modal(Some(Box::new(copy)));
    let [low, _] = range(&mut scene, 0.5);
    let after = scene.force();
    assert!(
        low > 0.8 * before && after > 1.05 * before && after < 3.0,
        "{before} N, {low} N at least, then {after} N"
    );
    let slew = SafetyConfig::for_device(&VirtualConfig::touch().info(), 1000.0).slew.unwrap();
    assert!(scene.largest_step < 0.25 * slew * 1e-3, "a step of {} N", scene.largest_step);
}

fn spring(key: u64, proxy: [f64; 3], k: f64) -> ToolContact {
    ToolContact {
        key,
        proxy,
        stiffness: [[k, 0.0, 0.0], [0.0, k, 0.0], [0.0, 0.0, k]],
        ..ToolContact::default()
    }
}

/// Runs a hand at rest for `ticks` periods with `contacts`, at 100 local model updates per second.
/// Returns the force along x at the end and its largest change in a tick, N.
fn felt_force(core: &mut LoopCore, local: &mut LocalModel, contacts: &[ToolContact], ticks: u64) -> [f64; 2] {
    local.count = contacts.len();
    local.contacts[..contacts.len()].copy_from_slice(contacts);
    let mut step = 0.0f64;
    for k in 0..ticks {
        let (last, now) = (*core.last(), core.last().now + 1e-3);
        local.tick += u64::from(k % 10 == 0);
        local.period = 0.01;
        let sample = Sample { sequence: Some((now * 1e3).round() as u64), ..Sample::default() };
        let wrench = core.tick(now, 1e-3, &sample, local);
        step = step.max((wrench.force[0] - last.wrench.force[0]).abs());
    }
    [core.last().wrench.force[0], step]
}

#[test]
fn a_grab_in_the_place_of_another_comes_by_a_ramp() {
    let new = || LoopCore::new(VirtualConfig::touch().info(), LoopConfig::default()).unwrap();
    let (mut core, mut local) = (new(), LocalModel::default());
    let [first, _] = felt_force(&mut core, &mut local, &[spring(1, [0.0, 0.0, 0.0], 200.0)], 600);
    assert_eq!(first, 0.0);
    // Another grab is 5 mm away, which gives 1 N. The force must rise over the 300 ms of the ramp
    // and not within a tick. The proxy must start at its own position and not at that of the first
    // grab.
    let [half, step] = felt_force(&mut core, &mut local, &[spring(2, [5e-3, 0.0, 0.0], 200.0)], 150);
    assert!((half - 0.5).abs() < 0.02, "half of it after half of the ramp: {half} N");
    assert!(step < 1.5 / 300.0, "a step of {step} N");
    let [whole, _] = felt_force(&mut core, &mut local, &[spring(2, [5e-3, 0.0, 0.0], 200.0)], 600);
    assert!((whole - 1.0).abs() < 0.02, "{whole} N");
    // A second grab beside it has a ramp of its own, and the force of the first grab does not
    // change.
    let both = [spring(3, [5e-3, 0.0, 0.0], 100.0), spring(2, [5e-3, 0.0, 0.0], 200.0)];
    let [now, step] = felt_force(&mut core, &mut local, &both, 1);
    assert!((now - whole).abs() < 0.01, "{now} N after {whole} N");
    let [both, further] = felt_force(&mut core, &mut local, &both, 900);
    assert!((both - 1.5).abs() < 0.03 && step.max(further) < 1.0 / 300.0, "{both} N, {step} N");
    // A new position of the same grab is not a new grab. The proxy moves there within one update
    // interval.
    let (mut core, mut local) = (new(), LocalModel::default());
    felt_force(&mut core, &mut local, &[spring(1, [0.0; 3], 200.0)], 600);
    let [moved, _] = felt_force(&mut core, &mut local, &[spring(1, [2e-3, 0.0, 0.0], 200.0)], 20);
    assert!((moved - 0.4).abs() < 0.01, "{moved} N");
}

/// A device that another device can replace when it comes back.
struct Changeling {
    inner: VirtualDevice,
    /// The present device: 0 for the first one, 1 for one like it, 2 for a weaker one.
    which: Arc<AtomicU32>,
}

impl HapticDevice for Changeling {
    fn info(&self) -> DeviceInfo {
        let info = self.inner.info();
        match self.which.load(Ordering::Relaxed) {
            0 => info,
            1 => DeviceInfo { serial: "another".into(), ..info },
            _ => DeviceInfo { serial: "weaker".into(), max_stiffness: 100.0, ..info },
        }
    }
    fn exchange(&mut self, wrench: &Wrench, scheduler: &mut dyn Scheduler) -> Result<Sample, Fault> {
        self.inner.exchange(wrench, scheduler)
    }
    fn safe_stop(&mut self) {
        self.inner.safe_stop();
    }
    fn reopen(&mut self) -> Result<(), Fault> {
        self.inner.reopen()
    }
}

#[test]
fn another_device_gets_the_copy_or_it_is_handed_back() {
    let scene = holding(true, 0.01);
    for (which, gets_it) in [(0, true), (1, true), (2, false)] {
        let inner = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM).unwrap();
        let (hand, now) = (inner.handle(), Arc::new(AtomicU32::new(0)));
        let device = Changeling { inner, which: now.clone() };
        let mut cycle = Cycle::new(device, LoopConfig::default()).unwrap();
        let copy = ModalLocal::new(&scene.body, &[scene.held], 1.0, 1000.0).unwrap();
        assert!(cycle.set_modal(Some(Box::new(copy))).is_none());
        let (mut scheduler, mut events) = (VirtualScheduler::new(1000.0), Vec::<LoopEvent>::new());
        let mut run = |cycle: &mut Cycle<Changeling>| {
            for _ in 0..1500 {
                cycle.step(&mut scheduler, &LocalModel::default(), &mut events);
            }
            cycle.report().state
        };
        assert_eq!(run(&mut cycle), LoopState::Running);
        hand.set_gone(true);
        assert_eq!(run(&mut cycle), LoopState::Lost);
        now.store(which, Ordering::Relaxed);
        hand.set_gone(false);
        assert_eq!(run(&mut cycle), LoopState::Running);
        assert_eq!(cycle.core().info().max_stiffness, if gets_it { 400.0 } else { 100.0 });
        assert_eq!((cycle.has_modal(), cycle.take_trash().is_some()), (gets_it, !gets_it), "device {which}");
    }
}
