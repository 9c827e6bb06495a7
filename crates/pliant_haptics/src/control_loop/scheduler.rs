//! Timing: a clock that threads share, a scheduler to absolute times, and a virtual scheduler for
//! tests.

use crate::{Period, Scheduler};

/// Monotonic clock in seconds since its creation. All copies agree.
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

    pub(super) fn now() -> Stamp {
        clock_gettime(ClockId::Monotonic)
    }

    pub(super) fn since(origin: Stamp) -> f64 {
        let t = now();
        (t.tv_sec - origin.tv_sec) as f64 + (t.tv_nsec - origin.tv_nsec) as f64 * 1e-9
    }

    pub(super) fn sleep_until(origin: Stamp, seconds: f64) {
        let whole = seconds.floor();
        let mut at = origin;
        at.tv_sec += whole as i64;
        at.tv_nsec += ((seconds - whole) * 1e9) as i64;
        if at.tv_nsec >= 1_000_000_000 {
            at.tv_nsec -= 1_000_000_000;
            at.tv_sec += 1;
        }
        // A signal ends the sleep early. With an absolute time, the call can simply be repeated.
        while clock_nanosleep_absolute(ClockId::Monotonic, &at) == Err(Errno::INTR) {}
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
}
