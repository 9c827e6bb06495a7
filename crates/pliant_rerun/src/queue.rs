//! The bounded queue between the app and a worker.
//!
//! The app never waits: a full queue refuses a frame, which counts as dropped. The worker sleeps,
//! so that it wakes a few times a second, and is woken early where the queue fills faster.
//!
//! The test `queue` reads this file with a channel on loom's locks in the place of `sync`, and runs
//! all orders of the two threads.

use std::time::Duration;

use super::sync::{Receiver, RecvTimeoutError, Sender, TryIter, TrySendError, bounded};

/// Makes a queue with room for `room` frames, at least one.
pub(crate) fn queue<T>(room: usize) -> (FrameSender<T>, FrameReceiver<T>) {
    let (frames, inbox) = bounded(room.max(1));
    let (nudge, nudged) = bounded(1);
    let sender = FrameSender { frames: Some(frames), nudge: Some(nudge), dropped: 0 };
    (sender, FrameReceiver { frames: inbox, nudged })
}

/// Why a frame was not accepted.
#[derive(Debug)]
pub(crate) enum Refused<T> {
    /// The queue is full. The frame comes back and counts as dropped.
    Full(T),
    /// The worker has ended.
    Closed,
}

/// The app's end of the queue.
#[derive(Debug)]
pub(crate) struct FrameSender<T> {
    frames: Option<Sender<T>>,
    /// Wakes the worker. Dropping it lets the worker know that no frame follows.
    nudge: Option<Sender<()>>,
    dropped: u64,
}

impl<T> FrameSender<T> {
    /// Offers a frame without waiting.
    ///
    /// # Errors
    /// Returns the frame if the queue is full. A worker that has ended accepts and drops nothing.
    pub fn offer(&mut self, frame: T) -> Result<(), Refused<T>> {
        let Some(frames) = &self.frames else { return Err(Refused::Closed) };
        match frames.try_send(frame) {
            Ok(()) => {
                // The queue fills faster than the worker wakes, so the worker is woken early. It is
                // woken after the frame is in the queue, or it could find nothing and sleep again.
                if frames.capacity().is_some_and(|room| 2 * frames.len() >= room)
                    && let Some(nudge) = &self.nudge
                {
                    // If this channel is full, the worker is already being woken.
                    nudge.try_send(()).ok();
                }
                Ok(())
            }
            Err(TrySendError::Full(frame)) => {
                self.dropped += 1;
                Err(Refused::Full(frame))
            }
            Err(TrySendError::Disconnected(_)) => {
                self.frames = None;
                Err(Refused::Closed)
            }
        }
    }

    /// Whether a frame would not be accepted.
    pub fn is_full(&self) -> bool {
        self.frames.as_ref().is_none_or(Sender::is_full)
    }

    /// Whether the worker is known to have ended, or the queue was closed.
    pub fn is_closed(&self) -> bool {
        self.frames.is_none()
    }

    /// Counts a frame that was not made because there is no room for it.
    pub fn miss(&mut self) {
        self.dropped += 1;
    }

    /// The number of frames that were dropped for lack of room.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Tells the worker that no frame follows. It still reads what waits.
    pub fn close(&mut self) {
        self.frames = None;
        self.nudge = None;
    }
}

/// The worker's end of the queue. Dropping it shows the app that the sink is closed.
#[derive(Debug)]
pub(crate) struct FrameReceiver<T> {
    frames: Receiver<T>,
    nudged: Receiver<()>,
}

impl<T> FrameReceiver<T> {
    /// Sleeps for at most `pause`, and then returns whether frames may follow, and those that wait.
    /// If none follow, they are the last ones.
    pub fn wait(&self, pause: Duration) -> (bool, TryIter<'_, T>) {
        // Asked before the queue is read: who closes has offered all frames before.
        let goes_on = self.nudged.recv_timeout(pause) != Err(RecvTimeoutError::Disconnected);
        (goes_on, self.read())
    }

    /// Takes the frames that wait, oldest first.
    pub fn read(&self) -> TryIter<'_, T> {
        self.frames.try_iter()
    }
}
