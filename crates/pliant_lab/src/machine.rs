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
