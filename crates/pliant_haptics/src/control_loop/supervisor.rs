//! The supervisor of a loop: a thread of its own that cuts the force while a call of the driver
//! hangs.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering},
    },
    time::Duration,
};

use crate::{LoopClock, StopHandle, StopSwitch};

/// Time without a sign of life after which the force is cut, s. A force is then at zero 35 ms after
/// the hang, with room for a machine that wakes the supervisor late.
const HANG: f64 = 0.025;
/// The same after the emergency stop was pressed, s.
const HANG_WHEN_STOPPED: f64 = 0.010;
/// Interval of the checks.
const CHECK: Duration = Duration::from_millis(5);

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

/// What the loop's thread, its supervisor and the app share about the loop's life.
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
}

/// Marks the loop's thread as over when it is dropped, in whatever way the thread ends.
pub(crate) struct Done(pub(crate) Arc<Heartbeat>);

impl Drop for Done {
    fn drop(&mut self) {
        self.0.done.store(true, Ordering::Release);
    }
}

/// Cuts the force by `handle` whenever the loop gives no sign of life in time. Returns soon after
/// the loop's thread has ended.
pub(crate) fn supervise(
    heartbeat: &Heartbeat,
    handle: &dyn StopHandle,
    stop: &StopSwitch,
    clock: LoopClock,
    name: &str,
) {
    while !heartbeat.done.load(Ordering::Acquire) {
        std::thread::sleep(CHECK);
        let (silent, cut) = heartbeat.silence(clock.now());
        let armed = heartbeat.is(Phase::Armed);
        // A device that is being opened may take its time, unless it is to stop.
        let hangs = if stop.is_pressed() {
            silent > HANG_WHEN_STOPPED && !heartbeat.is(Phase::Safe)
        } else {
            silent > HANG && armed
        };
        if hangs && !cut && !heartbeat.done.load(Ordering::Acquire) {
            heartbeat.cut.store(true, Ordering::Release);
            handle.cut();
            if armed {
                tracing::error!(
                    device = name,
                    "the driver has not answered for {silent:.3} s: its force was cut"
                );
            }
        }
    }
}
