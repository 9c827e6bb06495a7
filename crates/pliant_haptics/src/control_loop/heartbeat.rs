//! What the loop's thread, its supervisor and the app share about the loop's life.
//!
//! The test `heartbeat` reads this file with loom's atomics in the place of `sync`, and runs all
//! orders of the two threads.

use super::sync::{Arc, AtomicBool, AtomicU8, AtomicU64, Ordering};

/// What the loop's thread does until its next sign of life.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Phase {
    /// No force is sent. A late sign of life is no danger.
    Safe,
    /// A force is sent, and the device has to come back in time.
    Armed,
    /// The device is lost, and the loop tries to open it. That may take its time, and a device may
    /// drive by itself meanwhile.
    Opening,
}

/// The signs of life of a loop.
#[derive(Debug)]
pub(crate) struct Heartbeat {
    /// Time of the last sign of life on the loop's clock, s, as bits.
    beat: AtomicU64,
    /// The [`Phase`].
    phase: AtomicU8,
    /// Whether the force was cut since the last sign of life.
    cut: AtomicBool,
    /// Whether the loop's thread is over.
    done: AtomicBool,
}

impl Heartbeat {
    pub(crate) fn new(now: f64) -> Arc<Self> {
        Arc::new(Self {
            beat: AtomicU64::new(now.to_bits()),
            phase: AtomicU8::new(Phase::Safe as u8),
            cut: AtomicBool::new(false),
            done: AtomicBool::new(false),
        })
    }

    /// Gives a sign of life, and says what comes next. Returns whether the force was cut since the
    /// last sign.
    pub(crate) fn beat(&self, now: f64, phase: Phase) -> bool {
        self.phase.store(phase as u8, Ordering::Relaxed);
        self.beat.store(now.to_bits(), Ordering::Release);
        self.cut.swap(false, Ordering::AcqRel)
    }

    /// Returns the time since the last sign of life, s, and whether the force was cut since.
    pub(crate) fn silence(&self, now: f64) -> (f64, bool) {
        let silent = now - f64::from_bits(self.beat.load(Ordering::Acquire));
        (silent.max(0.0), self.cut.load(Ordering::Acquire))
    }

    pub(crate) fn is(&self, phase: Phase) -> bool {
        self.phase.load(Ordering::Relaxed) == phase as u8
    }

    /// Marks the force as cut. The loop learns of it by its next sign of life.
    pub(crate) fn mark_cut(&self) {
        // A swap, and no store: loom does not order a store against the swap of a sign of life.
        self.cut.swap(true, Ordering::AcqRel);
    }

    pub(crate) fn is_done(&self) -> bool {
        self.done.load(Ordering::Acquire)
    }
}

/// Marks the loop's thread as over when it is dropped, in whatever way the thread ends.
pub(crate) struct Done(pub(crate) Arc<Heartbeat>);

impl Drop for Done {
    fn drop(&mut self) {
        self.0.done.store(true, Ordering::Release);
    }
}
