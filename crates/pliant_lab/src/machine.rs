//! The machine that runs the measurements.

/// Pins this thread to one core while the value lives. Threads that are started meanwhile stay on
/// that core, too. On systems other than Linux, or where pinning is refused, nothing changes.
pub(crate) struct Pinned {
    #[cfg(target_os = "linux")]
    before: Option<rustix::thread::CpuSet>,
}

impl Pinned {
    pub(crate) fn new() -> Self {
        #[cfg(target_os = "linux")]
        {
            use rustix::thread::{CpuSet, sched_getaffinity, sched_getcpu, sched_setaffinity};
            let before = sched_getaffinity(None).ok();
            let mut one = CpuSet::new();
            one.set(sched_getcpu());
            let pinned = before.is_some() && sched_setaffinity(None, &one).is_ok();
            Self { before: before.filter(|_| pinned) }
        }
        #[cfg(not(target_os = "linux"))]
        Self {}
    }
}

impl Drop for Pinned {
    fn drop(&mut self) {
        #[cfg(target_os = "linux")]
        if let Some(before) = &self.before {
            // Restoring the thread's previous set of cores should not fail.
            let _ = rustix::thread::sched_setaffinity(None, before);
        }
    }
}

/// CPU time of this thread. On systems other than Linux, the time since the first call.
pub(crate) fn thread_time() -> std::time::Duration {
    #[cfg(target_os = "linux")]
    {
        let now = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
        std::time::Duration::new(now.tv_sec.unsigned_abs(), now.tv_nsec.unsigned_abs() as u32)
    }
    #[cfg(not(target_os = "linux"))]
    {
        static BEGAN: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
        BEGAN.get_or_init(std::time::Instant::now).elapsed()
    }
}

/// Number of runnable programs, mean over a minute. `None` if the system does not report it.
pub(crate) fn load() -> Option<f64> {
    std::fs::read_to_string("/proc/loadavg").ok()?.split(' ').next()?.parse().ok()
}

/// The CPU's name. Empty if the system does not report it.
pub(crate) fn processor() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let line = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    line.map_or(String::new(), |(_, name)| name.trim().to_owned())
}

/// A line that says when, in which time, by which command and on which machine something was made.
/// `load` is that at the start, `seeds` the words on them.
pub(crate) fn made(command: &str, seconds: f64, seeds: &str, load: Option<f64>) -> String {
    let days = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(0, |since| since.as_secs() / 86_400);
    let [y, m, d] = date(days as i64);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let load = match (load, self::load()) {
        (Some(before), Some(after)) => format!(" Load {before:.1} at the start and {after:.1} at the end."),
        _ => String::new(),
    };
    format!(
        "*Made on {y:04}-{m:02}-{d:02} in {seconds:.0} s by `{command}`: Pliant {}, {cores} cores{}, {} {}, {}. {seeds}.{load}{}*",
        env!("CARGO_PKG_VERSION"),
        match processor() {
            name if name.is_empty() => name,
            name => format!(" of {name}"),
        },
        std::env::consts::ARCH,
        std::env::consts::OS,
        vectors(),
        if cfg!(debug_assertions) { " A build that checks itself, so that times are too long." } else { "" },
    )
}

/// The widest vector instructions of this CPU that the reconstruction supports.
fn vectors() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        if std::arch::is_x86_feature_detected!("avx512f") {
            return "AVX-512";
        }
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
            return "AVX2";
        }
    }
    "portable vectors"
}

/// Year, month and day (UTC) of a number of days since 1970-01-01 in the Gregorian calendar.
fn date(days: i64) -> [i64; 3] {
    // H. Hinnant, "chrono-compatible low-level date algorithms": eras of 400 years that begin in
    // March.
    let z = days + 719_468;
    let era = z.div_euclid(146_097);
    let day = z.rem_euclid(146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let of_year = day - (365 * year + year / 4 - year / 100);
    let shifted = (5 * of_year + 2) / 153;
    let month = if shifted < 10 { shifted + 3 } else { shifted - 9 };
    [year + era * 400 + i64::from(month <= 2), month, of_year - (153 * shifted + 2) / 5 + 1]
}

#[cfg(test)]
mod tests {
    #[test]
    fn dates_are_those_of_the_calendar() {
        assert_eq!(super::date(0), [1970, 1, 1]);
        assert_eq!(super::date(11_016), [2000, 2, 29]);
        assert_eq!(super::date(20_819), [2027, 1, 1]);
    }
}
