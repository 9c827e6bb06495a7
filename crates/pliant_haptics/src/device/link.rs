//! The connection of a device. The loop's thread opens and closes it, and others cut it at any
//! moment.
//!
//! The test `links` reads this file with loom's mutex in the place of `sync`, and runs all orders
//! of the threads. No driver is called while the mutex is locked, so that a cut waits for none.

use super::sync::{Mutex, MutexGuard, PoisonError};

/// The connection of a device, as its driver and those who cut its force see it.
#[derive(Debug)]
pub(crate) struct Link<T>(Mutex<State<T>>);

#[derive(Debug)]
struct State<T> {
    /// What a cut acts on, while the device is open.
    open: Option<T>,
    /// Number of the connection.
    number: u64,
    /// Number of cuts so far.
    cuts: u64,
    /// Number of cuts that the driver has answered by a force that begins at zero.
    answered: u64,
    /// Number of cuts that act on the device now.
    acting: usize,
}

/// What the driver has seen of the cuts.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seen {
    /// Whether the force must be zero.
    pub(crate) cut: bool,
    /// The cuts that a zero force answers.
    cuts: u64,
}

/// A cut that acts on the device until this value is dropped.
pub(crate) struct Cut<'a, T: Clone> {
    link: &'a Link<T>,
    pub(crate) device: T,
    /// Number of the connection.
    pub(crate) number: u64,
}

impl<T: Clone> Link<T> {
    pub(crate) fn new() -> Self {
        Self(Mutex::new(State { open: None, number: 0, cuts: 0, answered: 0, acting: 0 }))
    }

    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Begins to open the device. What was cut so far is the connection before. Returns `false` and
    /// changes nothing while such a cut still acts, because it could act on the next connection.
    pub(crate) fn begin(&self) -> bool {
        let mut state = self.lock();
        if state.acting > 0 {
            return false;
        }
        state.answered = state.cuts;
        true
    }

    /// Makes `device` what a cut acts on. Returns `false` if there was a cut since the opening
    /// began.
    pub(crate) fn open(&self, device: T) -> bool {
        let mut state = self.lock();
        state.number += 1;
        state.open = Some(device);
        state.cuts == state.answered
    }

    /// Ends the connection. From here on a cut has nothing to act on.
    pub(crate) fn close(&self) -> Option<T> {
        self.lock().open.take()
    }

    /// Marks the force as cut, and returns the device to act on, if it is open.
    pub(crate) fn cut(&self) -> Option<Cut<'_, T>> {
        let mut state = self.lock();
        state.cuts += 1;
        let number = state.number;
        self.act_on(state, number)
    }

    /// Returns the device of the connection with this number, if it is still open.
    pub(crate) fn act(&self, number: u64) -> Option<Cut<'_, T>> {
        self.act_on(self.lock(), number)
    }

    fn act_on(&self, mut state: MutexGuard<'_, State<T>>, number: u64) -> Option<Cut<'_, T>> {
        let device = state.open.clone().filter(|_| state.number == number)?;
        state.acting += 1;
        Some(Cut { link: self, device, number })
    }

    /// Returns whether the force must be zero: it was cut, and the driver has not answered, or a
    /// cut still acts.
    pub(crate) fn seen(&self) -> Seen {
        let state = self.lock();
        // A cut that still acts is answered later.
        let cuts = if state.acting > 0 { state.answered } else { state.cuts };
        Seen { cut: state.cuts != state.answered || state.acting > 0, cuts }
    }

    /// Says that the force was zero since the driver has `seen` the cuts. Later cuts stay
    /// unanswered.
    pub(crate) fn answer(&self, seen: Seen) {
        let mut state = self.lock();
        state.answered = state.answered.max(seen.cuts);
    }
}

impl<T: Clone> Drop for Cut<'_, T> {
    fn drop(&mut self) {
        self.link.lock().acting -= 1;
    }
}
