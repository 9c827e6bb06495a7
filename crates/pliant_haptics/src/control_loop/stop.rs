//! The emergency stop: any thread presses it, the app resets it, and the loop latches it.
//!
//! The test `stop` reads this file with loom's atomics in the place of `sync`, and runs all orders
//! of the threads.

use super::sync::{Arc, AtomicBool, Ordering};

/// Presses the emergency stop of a loop, from any thread.
#[derive(Debug, Clone)]
pub struct StopSwitch(Arc<AtomicBool>);

impl StopSwitch {
    pub(crate) fn new() -> Self {
        Self(Arc::new(AtomicBool::new(false)))
    }

    /// Cuts the force from the loop's next period on, or within 15 ms by the supervisor if the
    /// driver does not answer. The stop is latched until
    /// [`HapticLoop::reset_stop`](crate::HapticLoop::reset_stop).
    pub fn press(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Returns whether the stop is pressed.
    pub fn is_pressed(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }

    /// Releases the switch, and notifies the loop to unlatch by `notify`. Returns `false` and
    /// changes nothing if the loop's queue has no room for it.
    pub(crate) fn reset(&self, has_room: bool, notify: impl FnOnce() -> bool) -> bool {
        if !has_room {
            return false;
        }
        // Released first: a loop that received the command before would find the switch pressed,
        // and latch again.
        self.0.store(false, Ordering::Release);
        notify()
    }

    /// Lets the loop obey its commands, and then latches a pressed switch, so that a press takes
    /// precedence over a reset that is still in the queue.
    pub(crate) fn obey<T>(&self, by: &mut T, commands: impl FnOnce(&mut T), latch: impl FnOnce(&mut T)) {
        commands(by);
        if self.is_pressed() {
            latch(by);
        }
    }
}
