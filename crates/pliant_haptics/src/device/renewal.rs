//! Whether the force was renewed in time.

use std::time::Duration;

use crate::LoopClock;

/// Longest time without a renewal for which a force counts as still on. After this time the
/// device's own watchdog may have switched the force off.
pub(crate) const LAPSE: Duration = Duration::from_millis(20);

/// The time of the last command that carried a force. The time for which the machine is suspended
/// counts.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Renewal {
    clock: LoopClock,
    last: Option<f64>,
}

impl Default for Renewal {
    fn default() -> Self {
        Self { clock: LoopClock::start(), last: None }
    }
}

impl Renewal {
    /// Returns whether the last renewal is too old, so that the next force must be zero.
    pub(crate) fn has_lapsed(&self) -> bool {
        self.last.is_some_and(|last| self.clock.now() - last > LAPSE.as_secs_f64())
    }

    /// Registers a command that has gone out, and returns whether it came too late.
    pub(crate) fn renew(&mut self) -> bool {
        let late = self.has_lapsed();
        self.last = Some(self.clock.now());
        late
    }
}

#[cfg(all(test, any(target_os = "linux", target_os = "android")))]
mod tests {
    use super::*;
    use crate::control_loop::scheduler::suspend;

    #[test]
    fn a_force_from_before_a_suspend_has_lapsed() {
        let mut renewal = Renewal::default();
        assert!(!renewal.has_lapsed() && !renewal.renew(), "the first command is not late");
        suspend(600);
        assert!(renewal.has_lapsed(), "the next force is zero");
        assert!(renewal.renew(), "also if the machine was suspended while it was sent");
    }
}
