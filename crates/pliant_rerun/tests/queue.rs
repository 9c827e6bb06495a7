//! The queue between the app and a worker, in all orders of the steps of two threads (loom). A
//! wake-up that is lost is a worker that sleeps for ever, which loom reports.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

#[expect(dead_code, reason = "the models use a part")]
#[path = "../src/queue.rs"]
mod queue;

/// A bounded channel of crossbeam as its documentation describes it, on loom's locks.
mod sync {
    use std::collections::VecDeque;
    use std::time::Duration;

    pub(crate) use crossbeam_channel::{RecvTimeoutError, TrySendError};
    use loom::sync::{Arc, Condvar, Mutex, MutexGuard};

    #[derive(Debug)]
    struct State<T> {
        waiting: VecDeque<T>,
        /// Whether each end is still there.
        sends: bool,
        receives: bool,
    }

    #[derive(Debug)]
    struct Channel<T> {
        room: usize,
        state: Mutex<State<T>>,
        changed: Condvar,
    }

    impl<T> Channel<T> {
        fn lock(&self) -> MutexGuard<'_, State<T>> {
            self.state.lock().unwrap()
        }
    }

    #[derive(Debug)]
    pub(crate) struct Sender<T>(Arc<Channel<T>>);

    #[derive(Debug)]
    pub(crate) struct Receiver<T>(Arc<Channel<T>>);

    pub(crate) fn bounded<T>(room: usize) -> (Sender<T>, Receiver<T>) {
        let state = State { waiting: VecDeque::new(), sends: true, receives: true };
        let channel = Arc::new(Channel { room, state: Mutex::new(state), changed: Condvar::new() });
        (Sender(channel.clone()), Receiver(channel))
    }

    impl<T> Sender<T> {
        pub(crate) fn try_send(&self, item: T) -> Result<(), TrySendError<T>> {
            let mut state = self.0.lock();
            if !state.receives {
                return Err(TrySendError::Disconnected(item));
            }
            if state.waiting.len() >= self.0.room {
                return Err(TrySendError::Full(item));
            }
            state.waiting.push_back(item);
            self.0.changed.notify_one();
            Ok(())
        }

        pub(crate) fn len(&self) -> usize {
            self.0.lock().waiting.len()
        }

        pub(crate) fn capacity(&self) -> Option<usize> {
            Some(self.0.room)
        }

        pub(crate) fn is_full(&self) -> bool {
            self.len() >= self.0.room
        }
    }

    impl<T> Drop for Sender<T> {
        fn drop(&mut self) {
            self.0.lock().sends = false;
            self.0.changed.notify_one();
        }
    }

    pub(crate) struct TryIter<'a, T>(&'a Receiver<T>);

    impl<T> Iterator for TryIter<'_, T> {
        type Item = T;

        fn next(&mut self) -> Option<T> {
            self.0.0.lock().waiting.pop_front()
        }
    }

    impl<T> Receiver<T> {
        pub(crate) fn try_iter(&self) -> TryIter<'_, T> {
            TryIter(self)
        }

        /// A timeout of [`Duration::MAX`] never ends. Any other is over at once, which together
        /// with the orders of the threads is any time.
        pub(crate) fn recv_timeout(&self, timeout: Duration) -> Result<T, RecvTimeoutError> {
            let mut state = self.0.lock();
            loop {
                if let Some(item) = state.waiting.pop_front() {
                    return Ok(item);
                }
                if !state.sends {
                    return Err(RecvTimeoutError::Disconnected);
                }
                if timeout < Duration::MAX {
                    return Err(RecvTimeoutError::Timeout);
                }
                state = self.0.changed.wait(state).unwrap();
            }
        }
    }

    impl<T> Drop for Receiver<T> {
        fn drop(&mut self) {
            let mut state = self.0.lock();
            state.receives = false;
            state.waiting.clear();
        }
    }
}

use std::time::Duration;

use loom::thread;
use queue::{FrameReceiver, Refused, queue};

/// Reads until the app closes the queue. A worker sleeps until it is woken, however long.
fn read_all(worker: &FrameReceiver<u64>) -> Vec<u64> {
    let mut all = Vec::new();
    loop {
        let (goes_on, frames) = worker.wait(Duration::MAX);
        all.extend(frames);
        if !goes_on {
            return all;
        }
    }
}

#[test]
fn each_frame_is_read_or_counted_as_dropped() {
    loom::model(|| {
        let (mut app, worker) = queue(1);
        let app = thread::spawn(move || {
            let accepted = (1..=2).filter(|n| app.offer(*n).is_ok()).count();
            app.close();
            (accepted, app.dropped())
        });
        let all = read_all(&worker);
        let (accepted, dropped) = app.join().unwrap();
        assert!(all.is_sorted() && all.len() == accepted, "{all:?} of {accepted}");
        assert_eq!(dropped + all.len() as u64, 2, "{all:?} and {dropped} dropped");
    });
}

#[test]
fn no_more_frames_wait_than_there_is_room() {
    loom::model(|| {
        // The worker looks once, at any time, and takes one of the frames.
        let (mut app, worker) = queue(2);
        let worker = thread::spawn(move || (worker.read().next().is_some(), worker));
        let accepted = (1..=4).filter(|n| app.offer(*n).is_ok()).count();
        let (took, worker) = worker.join().unwrap();
        assert!(accepted <= 2 + usize::from(took), "{accepted} accepted");
        assert_eq!(accepted as u64 + app.dropped(), 4);
        assert_eq!(worker.read().count() + usize::from(took), accepted);
    });
}

#[test]
fn a_queue_that_is_half_full_wakes_a_worker_that_would_sleep_for_ever() {
    loom::model(|| {
        let (mut app, worker) = queue(4);
        let app = thread::spawn(move || {
            (1..=2).for_each(|n| app.offer(n).unwrap());
            app
        });
        let mut all = Vec::new();
        while all.len() < 2 {
            all.extend(worker.wait(Duration::MAX).1);
        }
        assert_eq!(all, [1, 2]);
        drop(app.join().unwrap());
    });
}

#[test]
fn a_close_wakes_the_worker_and_loses_nothing() {
    loom::model(|| {
        let (mut app, worker) = queue(4);
        let app = thread::spawn(move || {
            app.offer(1).unwrap();
            app.close();
            // Its end comes later: the close alone wakes the worker.
            app
        });
        let all = read_all(&worker);
        let mut app = app.join().unwrap();
        assert_eq!(all, [1]);
        assert!(app.is_closed() && matches!(app.offer(2), Err(Refused::Closed)));
    });
}

#[test]
fn a_worker_that_ends_is_noticed_and_costs_no_drops() {
    loom::model(|| {
        let (mut app, worker) = queue(1);
        let worker = thread::spawn(move || {
            worker.wait(Duration::ZERO).1.next();
            drop(worker);
        });
        let mut full = 0;
        for n in 1..=2 {
            full += u64::from(matches!(app.offer(n), Err(Refused::Full(_))));
        }
        worker.join().unwrap();
        assert!(matches!(app.offer(3), Err(Refused::Closed)) && app.is_closed() && app.is_full());
        assert_eq!(app.dropped(), full);
    });
}
