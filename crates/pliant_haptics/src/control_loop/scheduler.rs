//! Timing: a clock that threads share, a scheduler to absolute times, and a virtual scheduler for
//! tests.

use crate::{Period, Scheduler};

/// Monotonic clock in seconds since its creation. All copies agree. On Linux and Android it counts
/// on while the machine is suspended, so that a wake-up ends a long period.
#[derive(Debug, Clone, Copy)]
pub struct LoopClock {
    origin: imp::Stamp,
}

impl LoopClock {
    /// Creates a clock that starts at 0.
    pub fn start() -> Self {
        Self { origin: imp::now() }
    }

    /// Returns the seconds since the start.
    pub fn now(&self) -> f64 {
        imp::since(self.origin)
    }
}

/// Scheduler on the machine's clock.
///
/// The scheduler sleeps to absolute times, so that lateness does not accumulate. It skips whole
/// periods if it is late by more than one period.
#[derive(Debug)]
pub struct RealScheduler {
    clock: LoopClock,
    period: f64,
    next: f64,
    last: Period,
}

impl RealScheduler {
    /// Creates periods of `1 / rate` seconds on `clock`, starting at the present time.
    pub fn new(clock: LoopClock, rate: f64) -> Self {
        let now = clock.now();
        Self { clock, period: 1.0 / rate, next: now, last: Period { now, ..Period::default() } }
    }
}

impl Scheduler for RealScheduler {
    fn wait(&mut self) -> Period {
        self.next += self.period;
        let mut now = self.clock.now();
        let mut missed = 0;
        if now > self.next + self.period {
            let behind = ((now - self.next) / self.period).floor();
            missed = behind.min(f64::from(u32::MAX)) as u32;
            self.next += behind * self.period;
        }
        if now < self.next {
            imp::sleep_until(self.clock.origin, self.next);
            now = self.clock.now();
        }
        self.last = Period { now, dt: now - self.last.now, late: (now - self.next).max(0.0), missed };
        self.last
    }

    fn last(&self) -> Period {
        self.last
    }

    fn note(&mut self) -> Period {
        let now = self.clock.now();
        let dt = now - self.last.now;
        let missed = (dt / self.period - 0.5).floor().clamp(0.0, f64::from(u32::MAX)) as u32;
        self.next = now;
        self.last = Period { now, dt, late: (dt - self.period).max(0.0), missed };
        self.last
    }
}

/// Scheduler in virtual time. Every period has its exact length, or the length that a test sets.
#[derive(Debug, Clone)]
pub struct VirtualScheduler {
    period: f64,
    gap: f64,
    last: Period,
}

impl VirtualScheduler {
    /// Creates periods of `1 / rate` seconds.
    pub fn new(rate: f64) -> Self {
        Self { period: 1.0 / rate, gap: 0.0, last: Period::default() }
    }

    /// Makes the next period longer by `seconds`, like a debugger's breakpoint.
    pub fn stall(&mut self, seconds: f64) {
        self.gap += seconds;
    }

    /// Returns the seconds since the start.
    pub fn now(&self) -> f64 {
        self.last.now
    }
}

impl Scheduler for VirtualScheduler {
    fn wait(&mut self) -> Period {
        let late = std::mem::take(&mut self.gap);
        let dt = self.period + late;
        let missed = (late / self.period) as u32;
        self.last = Period { now: self.last.now + dt, dt, late, missed };
        self.last
    }

    fn last(&self) -> Period {
        self.last
    }

    fn note(&mut self) -> Period {
        self.wait()
    }
}

#[cfg(any(target_os = "linux", target_os = "android", target_os = "freebsd"))]
mod imp {
    use rustix::{
        io::Errno,
        thread::clock_nanosleep_absolute,
        time::{ClockId, Timespec, clock_gettime},
    };

    pub(super) type Stamp = Timespec;

    /// `CLOCK_MONOTONIC` of Linux does not count the time for which the machine is suspended. Miri
    /// knows no other.
    #[cfg(all(any(target_os = "linux", target_os = "android"), not(miri)))]
    const CLOCK: ClockId = ClockId::Boottime;
    #[cfg(any(target_os = "freebsd", miri))]
    const CLOCK: ClockId = ClockId::Monotonic;

    /// The seconds for which a test pretends that the machine was suspended, as the clock counts
    /// them.
    #[cfg(all(test, any(target_os = "linux", target_os = "android")))]
    fn suspended() -> i64 {
        if CLOCK == ClockId::Boottime { super::SUSPENDED.get() } else { 0 }
    }
    #[cfg(not(all(test, any(target_os = "linux", target_os = "android"))))]
    const fn suspended() -> i64 {
        0
    }

    pub(super) fn now() -> Stamp {
        let mut now = clock_gettime(CLOCK);
        now.tv_sec += suspended();
        now
    }

    pub(super) fn since(origin: Stamp) -> f64 {
        let t = now();
        (t.tv_sec - origin.tv_sec) as f64 + (t.tv_nsec - origin.tv_nsec) as f64 * 1e-9
    }

    pub(super) fn sleep_until(origin: Stamp, seconds: f64) {
        let whole = seconds.floor();
        let mut at = origin;
        at.tv_sec += whole as i64 - suspended();
        at.tv_nsec += ((seconds - whole) * 1e9) as i64;
        if at.tv_nsec >= 1_000_000_000 {
            at.tv_nsec -= 1_000_000_000;
            at.tv_sec += 1;
        }
        // A signal ends the sleep early. With an absolute time, the call can simply be repeated.
        while clock_nanosleep_absolute(CLOCK, &at) == Err(Errno::INTR) {}
    }
}

#[cfg(not(any(target_os = "linux", target_os = "android", target_os = "freebsd")))]
mod imp {
    use std::time::{Duration, Instant};

    pub(super) type Stamp = Instant;

    /// Time to spin before the end of a sleep. Sleeps on these systems are late by up to a timer
    /// tick.
    const AWAKE: Duration = Duration::from_micros(300);

    pub(super) fn now() -> Stamp {
        Instant::now()
    }

    pub(super) fn since(origin: Stamp) -> f64 {
        origin.elapsed().as_secs_f64()
    }

    pub(super) fn sleep_until(origin: Stamp, seconds: f64) {
        let at = origin + Duration::from_secs_f64(seconds.max(0.0));
        if let Some(left) = at.checked_duration_since(Instant::now())
            && left > AWAKE
        {
            std::thread::sleep(left - AWAKE);
        }
        while Instant::now() < at {
            std::hint::spin_loop();
        }
    }
}

#[cfg(all(test, any(target_os = "linux", target_os = "android")))]
thread_local! {
    /// Seconds for which this thread's machine was suspended.
    static SUSPENDED: std::cell::Cell<i64> = const { std::cell::Cell::new(0) };
}

/// Pretends that the machine was suspended for so long. Among the kernel's clocks, `CLOCK_BOOTTIME`
/// counts it and `CLOCK_MONOTONIC` does not.
#[cfg(all(test, any(target_os = "linux", target_os = "android")))]
pub(crate) fn suspend(seconds: i64) {
    SUSPENDED.set(SUSPENDED.get() + seconds);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn real_periods_do_not_drift_and_missed_ones_are_counted() {
        let clock = LoopClock::start();
        let mut scheduler = RealScheduler::new(clock, 1000.0);
        let start = scheduler.last().now;
        let mut periods = 0;
        for _ in 0..50 {
            periods += 1 + scheduler.wait().missed;
        }
        // The fiftieth period is never early, however late a single wake-up was, and all of the
        // time is accounted for.
        let gone = scheduler.last().now - start;
        assert!(gone >= 0.05 - 1e-9, "{gone}");
        assert!(
            (gone - f64::from(periods) * 1e-3 - scheduler.last().late).abs() < 1e-6,
            "{gone} for {periods}"
        );
        std::thread::sleep(std::time::Duration::from_millis(20));
        assert!(scheduler.wait().missed >= 18);
    }

    #[test]
    fn virtual_time_is_exact() {
        let mut scheduler = VirtualScheduler::new(500.0);
        scheduler.stall(0.1);
        let long = scheduler.wait();
        assert_eq!((long.late, long.missed), (0.1, 50));
        assert!((long.dt - 0.102).abs() < 1e-12 && long.now == long.dt);
        assert_eq!(scheduler.wait().dt, 0.002);
    }

    /// A hand that is held away from the center, and that a suspended machine finds further away.
    #[cfg(any(target_os = "linux", target_os = "android"))]
    struct StillHand(std::sync::Arc<std::sync::Mutex<f64>>);

    #[cfg(any(target_os = "linux", target_os = "android"))]
    impl crate::HapticDevice for StillHand {
        fn info(&self) -> crate::DeviceInfo {
            crate::VirtualConfig::touch().info()
        }
        fn exchange(
            &mut self,
            _: &crate::Wrench,
            scheduler: &mut dyn Scheduler,
        ) -> Result<crate::Sample, crate::Fault> {
            scheduler.wait();
            Ok(crate::Sample::at([*self.0.lock().unwrap(), 0.0, 0.0]))
        }
        fn safe_stop(&mut self) {}
    }

    #[cfg(any(target_os = "linux", target_os = "android"))]
    #[test]
    fn a_machine_that_wakes_up_from_a_suspend_ramps() {
        use crate::{Cycle, Fault, LocalModel, LoopConfig};
        let hand = std::sync::Arc::new(std::sync::Mutex::new(0.005));
        let mut cycle = Cycle::new(StillHand(hand.clone()), LoopConfig::default()).unwrap();
        let mut scheduler = RealScheduler::new(LoopClock::start(), 1000.0);
        let mut model = LocalModel { count: 1, period: 0.01, ..LocalModel::default() };
        model.contacts[0].stiffness = [[200.0, 0.0, 0.0], [0.0, 200.0, 0.0], [0.0, 0.0, 200.0]];
        // A real clock is late on a busy machine, which lets the ramp wait.
        let mut until = |what: &str, look: &mut dyn FnMut(f64, Option<Fault>) -> bool| {
            let reached = (0..60_000).any(|_| {
                model.tick += 1;
                let tick = cycle.step(&mut scheduler, &model, &mut ()).tick;
                look(-tick.wrench.force[0], tick.fault)
            });
            assert!(reached, "never: {what}");
        };
        let mut before = 0.0;
        until("1 N before", &mut |force, _| {
            before = force;
            force > 0.999
        });
        suspend(600);
        *hand.lock().unwrap() = 0.006;
        let (mut last, mut rise, mut first, mut faded) = (before, 0.0f64, None, false);
        until("1.2 N after", &mut |force, fault| {
            rise = rise.max(force - last);
            first.get_or_insert((force, fault));
            faded |= force == 0.0;
            last = force;
            force > 1.19
        });
        println!("{before:.3} N, then {first:?}; it rises by at most {rise:.4} N a period");
        assert!(
            first.is_some_and(
                |(f, fault)| f <= before && matches!(fault, Some(Fault::Stalled(t)) if t > 599.0)
            )
        );
        // The ramp brings the peak force of 3.3 N in 0.3 s, and at most two periods at once.
        assert!(faded && rise < 3.3 / 0.3 * 2e-3 * 1.000_001, "{faded}, {rise} N");
    }
}
