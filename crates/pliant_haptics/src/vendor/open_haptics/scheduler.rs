//! What the threads of a process share of the library's scheduler, of which there is one: whether
//! it runs, and whose turn it is to touch a frame.
//!
//! The test `links` reads this file with loom's types in the place of `sync`, and runs all orders
//! of the threads. The library is not called while the mutex is locked, so that who stops the
//! scheduler waits for no other device.

use super::sync::{AtomicU8, Mutex, MutexGuard, Ordering, PoisonError};

/// The scheduler, as the devices of a process share it.
#[derive(Debug, Default)]
pub(crate) struct SharedScheduler(Mutex<State>);

#[derive(Debug, Default)]
struct State {
    /// Number of open devices. The scheduler starts with the first device and stops with the last.
    open: usize,
    phase: Phase,
}

#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
enum Phase {
    #[default]
    Stopped,
    Running,
    /// A thread is starting or stopping it, and may hang there.
    Changing,
}

impl SharedScheduler {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a device, after the scheduler was started by `start` if it does not run. Returns `None`
    /// and does nothing while another thread is starting or stopping the scheduler.
    ///
    /// # Errors
    /// Returns the error of `start`.
    pub(crate) fn enter<E>(&self, start: impl FnOnce() -> Result<(), E>) -> Option<Result<(), E>> {
        let mut state = self.lock();
        if state.phase == Phase::Changing {
            return None;
        }
        if state.phase == Phase::Stopped {
            state.phase = Phase::Changing;
            drop(state);
            let started = start();
            state = self.lock();
            if let Err(error) = started {
                state.phase = Phase::Stopped;
                return Some(Err(error));
            }
            state.phase = Phase::Running;
        }
        state.open += 1;
        Some(Ok(()))
    }

    /// Takes a device away, and stops the scheduler by `stop` after the last one.
    pub(crate) fn leave(&self, stop: impl FnOnce()) {
        let mut state = self.lock();
        state.open = state.open.saturating_sub(1);
        if state.open == 0 {
            self.halt(state, stop);
        }
    }

    /// Stops the scheduler by `stop` if it runs, and with it the force of every device.
    pub(crate) fn stop(&self, stop: impl FnOnce()) {
        self.halt(self.lock(), stop);
    }

    fn halt(&self, mut state: MutexGuard<'_, State>, stop: impl FnOnce()) {
        if state.phase == Phase::Running {
            state.phase = Phase::Changing;
            drop(state);
            stop();
            self.lock().phase = Phase::Stopped;
        }
    }
}

/// Whose turn it is to touch a frame: that of the loop's thread or that of the servo thread, which
/// may run a frame late.
#[derive(Debug, Default)]
pub(crate) struct Turn(AtomicU8);

/// The loop's thread waits for the servo thread to begin.
const ASKED: u8 = 1;
const RUNNING: u8 = 2;
const DONE: u8 = 3;
/// The frame is never run, and never touched again.
const GIVEN_UP: u8 = 4;

impl Turn {
    /// Gives the frame to the servo thread.
    pub(crate) fn ask(&self) {
        self.0.store(ASKED, Ordering::Release);
    }

    /// Begins the servo thread's turn. Returns `false` if the loop's thread has given the frame up.
    pub(crate) fn begin(&self) -> bool {
        self.0.compare_exchange(ASKED, RUNNING, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }

    /// Ends the servo thread's turn.
    pub(crate) fn end(&self) {
        self.0.store(DONE, Ordering::Release);
    }

    /// Takes the frame back. If the result is `false`, the frame was not run to its end. It is
    /// given up, and the loop's thread must not touch it again.
    pub(crate) fn take(&self) -> bool {
        let turn = self.0.compare_exchange(ASKED, GIVEN_UP, Ordering::AcqRel, Ordering::Acquire);
        turn == Err(DONE)
    }
}
