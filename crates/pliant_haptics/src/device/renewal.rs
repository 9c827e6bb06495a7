//! Whether the force was renewed in time.

use std::time::{Duration, Instant};

/// Longest time without a renewal for which a force counts as still on. After this time the
/// device's own watchdog may have switched the force off.
pub(crate) const LAPSE: Duration = Duration::from_millis(20);

/// The time of the last command that carried a force.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Renewal(Option<Instant>);

impl Renewal {
    /// Returns whether the last renewal is too old, so that the next force must be zero.
    pub(crate) fn has_lapsed(&self) -> bool {
        self.0.is_some_and(|at| at.elapsed() > LAPSE)
    }

    /// Registers a command that has gone out, and returns whether it came too late.
    pub(crate) fn renew(&mut self) -> bool {
        let late = self.has_lapsed();
        self.0 = Some(Instant::now());
        late
    }
}
