//! The machine that runs the measurements.

/// Pins this thread to one core while the value lives. Threads that are started meanwhile stay on
/// that core, too. On systems other than Linux, or where pinning is refused, nothing changes.
pub(crate) struct Pinned {
    #[cfg(target_os = "linux")]
    before: Option<rustix::thread::CpuSet>,
}

impl Pinned {
    pub(crate) fn new() -> Self {
        // The pool's threads start with its first use. Started later, all of them would stay here,
        // and what is baked after that would have one core.
        rayon::join(|| (), || ());
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

/// What git says in the current directory. `None` if there is no git or it fails.
fn git(arguments: &[&str]) -> Option<String> {
    let output = std::process::Command::new("git").args(arguments).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Words on the commit that is checked out where the program runs. Empty outside a checkout of this
/// project, whose commit would say nothing about the program, and without git.
fn commit() -> String {
    let of_this = git(&["rev-parse", "--verify", "--quiet", "HEAD:crates/pliant_lab/src/machine.rs"]);
    let Some(commit) = of_this.and_then(|_| git(&["rev-parse", "--short", "HEAD"])) else {
        return String::new();
    };
    // Files are only looked at, so that no lock of another git is in the way.
    let status = git(&["--no-optional-locks", "status", "--porcelain", "--untracked-files=no"]);
    let changed = if status.is_some_and(|status| has_code(&status)) { " (changed)" } else { "" };
    format!(" at commit {}{changed}", commit.trim())
}

/// Returns whether a short status of git has a file of Rust or of Cargo.
fn has_code(status: &str) -> bool {
    let mut paths = status.lines().flat_map(|line| line.split(" -> "));
    paths.any(|path| {
        [".rs", ".toml", "Cargo.lock"].iter().any(|kind| path.trim_end_matches('"').ends_with(*kind))
    })
}

/// A line that says when, in which time, by which command, from which commit and on which machine
/// something was made. `load` is that at the start, `seeds` the words on them.
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
    // What takes less than half a second would take none.
    let seconds = if seconds < 9.95 { format!("{seconds:.1}") } else { format!("{seconds:.0}") };
    format!(
        "*Made on {y:04}-{m:02}-{d:02} in {seconds} s by `{command}`: Pliant {}{}, {cores} cores{}, {} {}, {}. {seeds}.{load}{}*",
        env!("CARGO_PKG_VERSION"),
        commit(),
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

    #[test]
    fn a_changed_program_is_told_from_a_changed_page() {
        assert!(super::has_code(" M docs/report/report.md\n M crates/pliant_lab/src/lib.rs\n"));
        assert!(super::has_code("M  Cargo.toml\n"));
        assert!(super::has_code(" M Cargo.lock\n"));
        assert!(super::has_code("R  a.rs -> b.txt\n"));
        assert!(super::has_code(" M \"crates/\\303\\244.rs\"\n"));
        assert!(!super::has_code(" M docs/report/report.md\n M docs/report/a-bar-pull.csv\n"));
        assert!(!super::has_code(""));
    }

    #[test]
    fn a_short_time_has_a_decimal() {
        let made = |seconds| super::made("command", seconds, "No seed", None);
        assert!(made(0.32).contains(" in 0.3 s by `command`: Pliant "), "{}", made(0.32));
        assert!(made(9.94).contains(" in 9.9 s by ") && made(9.96).contains(" in 10 s by "));
        assert!(made(75.4).contains(" in 75 s by "));
    }
}
