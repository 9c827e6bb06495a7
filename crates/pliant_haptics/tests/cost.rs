//! What a tick costs: no allocation, ever; and its time, on its own thread and beside it.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
#![allow(unsafe_code, reason = "counting allocations needs a global allocator")]

mod rig;

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
    time::{Duration, Instant},
};

use pliant_haptics::{
    Hand, HapticLoop, Histogram, LoopConfig, LoopEvent, LoopReport, LoopState, VirtualConfig, VirtualDevice,
};
use rig::scene::{Scene, SceneConfig};

struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: every call goes on to the system's allocator unchanged; the counter is a plain thread-local cell without a destructor.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|n| n.set(n.get() + 1));
        // SAFETY: as the caller promised.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        ALLOCATIONS.with(|n| n.set(n.get() + 1));
        // SAFETY: as the caller promised.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// The processor's time of this thread, s: a test beside compilers is to measure the loop, not them.
#[cfg(any(target_os = "linux", target_os = "android", target_os = "freebsd"))]
fn cpu_time() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
}

#[cfg(not(any(target_os = "linux", target_os = "android", target_os = "freebsd")))]
fn cpu_time() -> f64 {
    use std::sync::OnceLock;
    static START: OnceLock<Instant> = OnceLock::new();
    START.get_or_init(Instant::now).elapsed().as_secs_f64()
}

/// Allocations and deallocations in `ticks` of the loop, with words of the simulation coming in between; and p99.9 of a period's work, the
/// simulated device's with it, s.
fn ticks(modal: bool, ticks: usize) -> (u64, f64) {
    let mut scene = Scene::new(SceneConfig { modal, hand: Hand::LIGHT, ..SceneConfig::default() });
    scene.hand.set_target([0.01, 0.01, 0.0]);
    scene.run(0.2);
    let mut events = Vec::with_capacity(1024);
    let mut words = Vec::new();
    for _ in 0..64 {
        scene.tick();
        words.push(scene.model.clone());
    }
    let before = ALLOCATIONS.with(Cell::get);
    let mut work = Histogram::default();
    for k in 0..ticks {
        let word = &mut words[k / 8 % 64];
        word.tick = 1_000_000 + (k / 8) as u64;
        word.stamp = scene.pace.now();
        let begun = cpu_time();
        scene.cycle.step(&mut scene.pace, word, &mut events as &mut Vec<LoopEvent>);
        work.add(cpu_time() - begun);
    }
    let allocations = ALLOCATIONS.with(Cell::get) - before;
    (allocations, work.percentile(0.999))
}

/// The best of a few runs: what another process on the core has done to the caches is not the loop's work.
fn best(modal: bool, limit: f64) -> f64 {
    let mut best = f64::INFINITY;
    for _ in 0..10 {
        let (allocations, p999) = ticks(modal, 4000);
        assert_eq!(allocations, 0);
        best = best.min(p999);
        if best <= limit {
            break;
        }
    }
    best
}

#[test]
fn the_loop_allocates_nothing_and_takes_fifty_microseconds_at_most() {
    let p999 = best(false, 50e-6);
    println!("proxy model: the loop's own work p99.9 {:.1} us", p999 * 1e6);
    assert!(p999 <= 50e-6, "{p999} s");
}

#[test]
fn the_modal_loop_allocates_nothing_and_takes_a_hundred_and_fifty() {
    let p999 = best(true, 150e-6);
    println!("modal model of 60 modes: the loop's own work p99.9 {:.1} us", p999 * 1e6);
    assert!(p999 <= 150e-6, "{p999} s");
}

#[test]
fn on_its_own_thread() {
    let device = VirtualDevice::new(VirtualConfig::touch(), Hand::FIRM).unwrap();
    let hand = device.handle();
    hand.set_target([0.01, 0.0, 0.0]);
    let mut running = HapticLoop::start(device, LoopConfig::default()).unwrap();
    let spring = |running: &mut HapticLoop, tick: u64| {
        let stamp = running.now();
        running.publish(|model| {
            model.tick = tick;
            model.stamp = stamp;
            model.period = 0.01;
            model.count = 1;
            model.contacts[0].stiffness = [[200.0, 0.0, 0.0], [0.0, 200.0, 0.0], [0.0, 0.0, 200.0]];
        });
    };
    let mut tick = 0;
    // Words of the simulation until it is so; a busy machine stutters, so what must come is waited for.
    let mut until = |running: &mut HapticLoop, what: &str, so: &dyn Fn(&LoopReport) -> bool| {
        for _ in 0..1000 {
            tick += 1;
            spring(running, tick);
            std::thread::sleep(Duration::from_millis(10));
            if so(running.report()) {
                return;
            }
        }
        panic!("never: {what}: {:?}", running.report().tick);
    };
    until(&mut running, "runs for a second and pushes back", &|r| {
        r.tick.now > 1.0 && r.tick.wrench.force[0] < -0.1
    });
    let report = *running.report();
    println!(
        "{} periods at {:.0} Hz, {} left out; late by p50 {:.0} us, p99 {:.0} us, p99.9 {:.0} us, at most {:.0} us; work p99.9 {:.1} us; real-time {}",
        report.ticks,
        report.rate,
        report.missed,
        report.lateness.percentile(0.5) * 1e6,
        report.lateness.percentile(0.99) * 1e6,
        report.lateness.percentile(0.999) * 1e6,
        report.lateness.largest() * 1e6,
        report.work.percentile(0.999) * 1e6,
        report.realtime,
    );
    assert!(report.ticks > 100, "it runs: {} periods in a second", report.ticks);
    running.emergency_stop();
    until(&mut running, "stops", &|r| r.state == LoopState::Stopped && r.tick.wrench.force == [0.0; 3]);
    assert!(running.reset_stop());
    until(&mut running, "runs again", &|r| r.state == LoopState::Running && r.tick.wrench.force[0] < -0.1);
    assert!(running.set_recording(true));
    until(&mut running, "a few more periods", &|r| r.ticks > report.ticks + 1000);
    assert!(running.records().count() > 5);
    let events: Vec<_> = running.events().collect();
    assert!(
        events.iter().any(|e| matches!(e, LoopEvent::Fault(pliant_haptics::Fault::EmergencyStop))),
        "{events:?}"
    );
    // The simulation is silent: no force after 50 ms, plus what the machine takes to run the loop at all.
    let silent = Instant::now();
    while running.report().tick.wrench.force != [0.0; 3] {
        assert!(silent.elapsed() < Duration::from_secs(5), "{:?}", running.report().tick);
        std::thread::sleep(Duration::from_millis(5));
    }
    let start = Instant::now();
    drop(running);
    assert!(start.elapsed() < Duration::from_secs(1), "stops when dropped");
}
