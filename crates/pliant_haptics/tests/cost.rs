//! Cost of a tick: no allocation ever and little time, and the behavior of the loop on its own
//! thread.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
#![allow(unsafe_code, reason = "counting allocations needs a global allocator")]

mod rig;

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
    hint::black_box,
    sync::Arc,
    time::Duration,
};

use pliant_haptics::{
    HandModel, HapticLoop, Histogram, LoopEvent, LoopState, MAX_PLANES, VirtualConfig, VirtualDevice,
};
use rig::{
    machine,
    scene::{Scene, SceneConfig},
    valley::{VALLEY, valley},
    world::{DOWN, RADIUS, UP, World},
};

struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: every call goes on to the system's allocator unchanged. The counter is a plain
// thread-local cell without a destructor.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|n| n.set(n.get() + 1));
        // SAFETY: the caller guarantees the conditions.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        ALLOCATIONS.with(|n| n.set(n.get() + 1));
        // SAFETY: the caller guarantees the conditions.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// Returns the CPU time of this thread, s. With compilers running at the same time, this clock
/// still measures only the loop.
#[cfg(any(target_os = "linux", target_os = "android", target_os = "freebsd"))]
fn cpu_time() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
}

#[cfg(not(any(target_os = "linux", target_os = "android", target_os = "freebsd")))]
fn cpu_time() -> f64 {
    use std::{sync::OnceLock, time::Instant};
    static START: OnceLock<Instant> = OnceLock::new();
    START.get_or_init(Instant::now).elapsed().as_secs_f64()
}

/// Number of different periods. Every round runs each of them once.
const PERIODS: usize = 4000;
const ROUNDS: usize = 10;

/// Counts allocations and deallocations in [`PERIODS`] of the loop with local model updates in
/// between.
///
/// The function lowers `least`, the work time of each period including the simulated device, s, and
/// `yardstick`, the time of [`multiply_and_add`], s.
fn ticks(modal: bool, least: &mut [f64], yardstick: &mut f64) -> u64 {
    let mut scene = Scene::new(SceneConfig { modal, hand: HandModel::LIGHT, ..SceneConfig::default() });
    scene.hand.set_target([0.01, 0.01, 0.0]);
    scene.run(0.2);
    let mut events = Vec::with_capacity(1024);
    let mut locals = Vec::new();
    for _ in 0..64 {
        scene.tick();
        locals.push(scene.model.clone());
    }
    let before = ALLOCATIONS.with(Cell::get);
    for (k, least) in least.iter_mut().enumerate() {
        let local = &mut locals[k / 8 % 64];
        local.tick = 1_000_000 + (k / 8) as u64;
        local.stamp = scene.scheduler.now();
        let begun = cpu_time();
        scene.cycle.step(&mut scene.scheduler, local, &mut events as &mut Vec<LoopEvent>);
        *least = least.min(cpu_time() - begun);
        if k % 100 == 0 {
            let begun = cpu_time();
            multiply_and_add();
            *yardstick = yardstick.min(cpu_time() - begun);
        }
    }
    ALLOCATIONS.with(Cell::get) - before
}

/// Runs ten thousand multiplications and additions, each of which depends on the previous one. They
/// take about 17 us.
#[inline(never)]
fn multiply_and_add() {
    let mut x = black_box(0.5f64);
    let (factor, term) = black_box((0.999, 0.001));
    for _ in 0..10_000 {
        x = x * factor + term;
    }
    black_box(x);
}

/// Returns p99.9 of a period's work, as a multiple of the time of [`multiply_and_add`] in the same
/// run.
///
/// The ratio removes the speed of the machine and its other load. In virtual time a period does the
/// same work in every round, so its least time is the time that it needs.
fn work(modal: bool) -> f64 {
    let (mut least, mut yardstick) = (vec![f64::INFINITY; PERIODS], f64::INFINITY);
    for _ in 0..ROUNDS {
        assert_eq!(ticks(modal, &mut least, &mut yardstick), 0);
    }
    let mut work = Histogram::default();
    least.into_iter().for_each(|seconds| work.add(seconds));
    let p999 = work.percentile(0.999);
    println!(
        "modal {modal}: the loop's own work p99.9 {:.1} us; yardstick {:.1} us",
        p999 * 1e6,
        yardstick * 1e6
    );
    p999 / yardstick
}

#[test]
fn the_loop_allocates_nothing_and_takes_as_long_as_twenty_thousand_multiplications_at_most() {
    let work = work(false);
    assert!(work <= 2.0, "{work} times ten thousand multiplications and additions");
}

#[test]
fn the_modal_loop_allocates_nothing_and_takes_as_long_as_sixty_thousand() {
    let work = work(true);
    assert!(work <= 6.0, "{work} times ten thousand multiplications and additions");
}

/// The edge of a box in a valley, with as many planes as the loop has room for.
#[test]
fn a_loop_that_touches_sixteen_planes_allocates_nothing() {
    let corners: Vec<[f64; 3]> = (0..8)
        .map(|n| [[0.0, 0.0], [0.01, 0.01], [-0.01, 0.01], [0.0, 0.02]][n % 4])
        .zip([-0.01; 4].into_iter().chain([0.01; 4]))
        .map(|([x, y], z)| [x, y, z])
        .collect();
    let at = [0.0, VALLEY + RADIUS * (2f64.sqrt() - 1.0), 0.0];
    let (model, hand) = (Arc::new(valley(2e4)), HandModel::LIGHT);
    let mut world = World::above(at, Some(model), 60.0, VirtualConfig::touch(), hand);
    world.probe.set_corners(&corners).unwrap();
    world.lead(UP, DOWN, 0.5, |_| {});
    world.lead(DOWN, DOWN, 0.5, |_| {});
    let mut local = world.model.clone();
    assert_eq!(local.planes().len(), MAX_PLANES);
    let mut events: Vec<LoopEvent> = Vec::with_capacity(1024);
    let (mut work, mut yardstick) = (Histogram::default(), f64::INFINITY);
    let before = ALLOCATIONS.with(Cell::get);
    for k in 0..PERIODS {
        if k % 16 == 0 {
            local.tick += 1;
            local.stamp = world.scheduler.now();
        }
        let begun = cpu_time();
        world.cycle.step(&mut world.scheduler, &local, &mut events);
        work.add(cpu_time() - begun);
        if k % 100 == 0 {
            let begun = cpu_time();
            multiply_and_add();
            yardstick = yardstick.min(cpu_time() - begun);
        }
    }
    assert_eq!(ALLOCATIONS.with(Cell::get) - before, 0);
    assert!(world.force()[1] > 0.1, "{:?}", world.force());
    let [half, most] = [0.5, 0.99].map(|share| 1e6 * work.percentile(share));
    println!("16 planes: p50 {half:.1} us, p99 {most:.1} us; yardstick {:.1} us", yardstick * 1e6);
}

#[test]
fn on_its_own_thread() {
    let device = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM).unwrap();
    let hand = device.handle();
    hand.set_target([0.01, 0.0, 0.0]);
    let mut running = HapticLoop::start(device, machine::patient()).unwrap();
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
    let mut events = Vec::new();
    // The closure publishes local model updates until the condition holds. A busy machine stutters,
    // so the test waits instead of counting periods.
    let mut until = |running: &mut HapticLoop, what: &str, so: &mut dyn FnMut(&mut HapticLoop) -> bool| {
        machine::until(what, || {
            tick += 1;
            spring(running, tick);
            std::thread::sleep(Duration::from_millis(10));
            events.extend(running.events());
            let seen = (running.report().state, running.report().tick);
            if so(running) { Ok(()) } else { Err(Box::new(seen)) }
        });
    };
    let pushes = |running: &mut HapticLoop| running.report().tick.wrench.force[0] < -0.1;
    until(&mut running, "the first periods", &mut |running| running.report().ticks > 0);
    let first = *running.report();
    until(&mut running, "a second and a thousand periods, and it pushes back", &mut |running| {
        let report = running.report();
        report.tick.now > first.tick.now + 1.0 && report.ticks > first.ticks + 1000 && pushes(running)
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
    // The loop never runs faster than its rate, and missing periods appear as lateness. The sum
    // over a hundred percentiles is an upper bound of the total lateness. A period that would begin
    // when the next one is almost due merges with the next one.
    let (ticks, due) = ((report.ticks - first.ticks) as f64, 1000.0 * (report.tick.now - first.tick.now));
    let late: f64 = (1..=100).map(|p| report.lateness.percentile(0.01 * f64::from(p))).sum();
    let late = 1000.0 * 0.01 * report.ticks as f64 * late;
    assert!(ticks <= due + 2.0, "{ticks} periods of {due}");
    assert!(
        2.0 * ticks + report.missed as f64 + late + 2.0 >= due,
        "{ticks} periods of {due}, late by {late}"
    );
    running.emergency_stop();
    until(&mut running, "it stops", &mut |running| {
        let report = running.report();
        report.state == LoopState::Stopped && report.tick.wrench.force == [0.0; 3]
    });
    assert!(running.reset_stop());
    until(&mut running, "it runs again", &mut |running| {
        running.report().state == LoopState::Running && pushes(running)
    });
    assert!(running.set_recording(true));
    let mut records = 0;
    until(&mut running, "a thousand periods are written down", &mut |running| {
        records += running.records().count();
        records >= 1000
    });
    assert!(
        events.iter().any(|e| matches!(e, LoopEvent::Fault(pliant_haptics::Fault::EmergencyStop))),
        "{events:?}"
    );
    // Without local model updates, the force fades after the two seconds for which this loop waits.
    machine::until("no force", || {
        std::thread::sleep(Duration::from_millis(5));
        let tick = running.report().tick;
        if tick.wrench.force == [0.0; 3] { Ok(()) } else { Err(Box::new(tick)) }
    });
    // A loop that does not stop when it is dropped would never stop, so the test fails at the
    // limit.
    let drops = std::thread::spawn(move || drop(running));
    machine::until("stopped when dropped", || {
        std::thread::sleep(Duration::from_millis(5));
        if drops.is_finished() { Ok(()) } else { Err("still running") }
    });
    drops.join().unwrap();
}
