//! The queues between the application and the network thread, in all orders of the steps of two
//! threads (loom). A wake-up that is lost is a thread that waits for ever, which loom reports.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

#[expect(dead_code, reason = "the models use a part")]
#[path = "../src/transport/queue.rs"]
mod queue;

mod carrier {
    use std::time::Instant;

    use bytes::Bytes;
    use pliant_stream::{DisconnectReason, PeerId};

    /// What the queues carry, without what they do not look at.
    #[derive(Debug)]
    #[expect(dead_code, reason = "the queues carry what they do not read")]
    pub enum Event {
        Connected { peer: PeerId },
        Datagram { peer: PeerId, at: Instant, bytes: Bytes },
        Message { peer: PeerId, bytes: Bytes },
        Closed { peer: PeerId, reason: DisconnectReason },
    }
}

mod sync {
    use std::future::{Future, poll_fn};
    use std::task::{Poll, Waker};

    pub(super) use loom::sync::{Arc, Mutex, MutexGuard};

    /// Tokio's `Notify` as its documentation describes it for one waiter: a notification that finds
    /// nobody waiting is kept, once.
    #[derive(Debug, Default)]
    pub(super) struct Notify(Mutex<(bool, Option<Waker>)>);

    impl Notify {
        pub(super) fn notify_one(&self) {
            let mut state = self.0.lock().unwrap();
            state.0 = true;
            let waker = state.1.take();
            drop(state);
            waker.into_iter().for_each(Waker::wake);
        }

        pub(super) fn notified(&self) -> impl Future<Output = ()> {
            poll_fn(|context| {
                let mut state = self.0.lock().unwrap();
                if std::mem::take(&mut state.0) {
                    return Poll::Ready(());
                }
                state.1 = Some(context.waker().clone());
                Poll::Pending
            })
        }
    }
}

use std::future::Future;
use std::pin::pin;
use std::task::{Context, Poll, Wake, Waker};
use std::time::Instant;

use bytes::Bytes;
use carrier::Event;
use loom::sync::{Arc, Condvar, Mutex};
use loom::thread;
use pliant_stream::{DisconnectReason, PeerId};
use queue::{Inbox, Next, Outbox};

const PEER: PeerId = PeerId(1);

/// A thread that sleeps until it is woken.
struct Sleeper(Mutex<bool>, Condvar);

impl Wake for Sleeper {
    fn wake(self: std::sync::Arc<Self>) {
        *self.0.lock().unwrap() = true;
        self.1.notify_one();
    }
}

fn block_on<T>(future: impl Future<Output = T>) -> T {
    let sleeper = std::sync::Arc::new(Sleeper(Mutex::new(false), Condvar::new()));
    let waker = Waker::from(sleeper.clone());
    let mut future = pin!(future);
    loop {
        if let Poll::Ready(done) = future.as_mut().poll(&mut Context::from_waker(&waker)) {
            return done;
        }
        let mut woken = sleeper.0.lock().unwrap();
        while !*woken {
            woken = sleeper.1.wait(woken).unwrap();
        }
        *woken = false;
    }
}

fn one(n: u8) -> Bytes {
    Bytes::copy_from_slice(&[n])
}

#[test]
fn each_datagram_is_sent_or_counted_as_dropped() {
    loom::model(|| {
        let outbox = Arc::new(Outbox::default());
        let app = Arc::clone(&outbox);
        // Room for one: each newer one drops the one that waits.
        let app = thread::spawn(move || (1..=2).map(|n| app.push_datagram(one(n), 1)).sum::<u64>());
        let mut sent = Vec::new();
        while sent.last() != Some(&2) {
            assert_eq!(block_on(outbox.first_datagram_len()), 1);
            sent.push(outbox.pop_datagram().unwrap()[0]);
        }
        let dropped = app.join().unwrap();
        assert!(sent.is_sorted(), "{sent:?}");
        assert_eq!(dropped + sent.len() as u64, 2, "{sent:?} and {dropped} dropped");
    });
}

#[test]
fn each_received_datagram_is_read_or_counted_as_dropped() {
    loom::model(|| {
        let inbox = Arc::new(Inbox::default());
        inbox.open(PEER, Event::Connected { peer: PEER });
        inbox.pop().unwrap();
        let (network, at) = (Arc::clone(&inbox), Instant::now());
        let network =
            thread::spawn(move || (1..=3).map(|n| network.push_datagram(PEER, at, one(n), 1)).sum::<u64>());
        let mut read = u64::from(inbox.pop().is_some()) + u64::from(inbox.pop().is_some());
        let dropped = network.join().unwrap();
        while inbox.pop().is_some() {
            read += 1;
        }
        assert_eq!(dropped + read, 3, "{read} read and {dropped} dropped");
    });
}

#[test]
fn a_full_inbox_holds_its_sender_back_and_loses_nothing() {
    loom::model(|| {
        let inbox = Arc::new(Inbox::default());
        let room = inbox.open(PEER, Event::Connected { peer: PEER });
        inbox.pop().unwrap();
        let network = Arc::clone(&inbox);
        let network = thread::spawn(move || {
            for n in 1..=2 {
                block_on(network.put_message(PEER, one(n), 100, &room));
            }
            network.close(PEER, DisconnectReason::Left);
        });
        let mut read = Vec::new();
        loop {
            match inbox.pop() {
                Some(Event::Message { bytes, .. }) => read.push(bytes[0]),
                Some(Event::Closed { .. }) => break,
                Some(other) => panic!("{other:?}"),
                None => thread::yield_now(),
            }
        }
        network.join().unwrap();
        assert_eq!(read, [1, 2]);
        assert!(inbox.pop().is_none());
    });
}

#[test]
fn a_frame_that_ends_early_leaves_no_sender_without_a_turn() {
    loom::model(|| {
        let inbox = Arc::new(Inbox::default());
        inbox.open(PEER, Event::Connected { peer: PEER });
        inbox.pop().unwrap();
        // More than a frame reads of one peer.
        let long = || Bytes::from(vec![0; 16 * queue::READ_OF_A_PEER]);
        let network = Arc::clone(&inbox);
        let network = thread::spawn(move || {
            (0..2).for_each(|_| network.push_message(PEER, long(), usize::MAX).unwrap());
        });
        let mut read = 0;
        for _ in 0..2 {
            inbox.begin_frame();
            while inbox.pop_in_frame().is_some() {
                read += 1;
            }
        }
        network.join().unwrap();
        for _ in 0..3 {
            inbox.begin_frame();
            while inbox.pop_in_frame().is_some() {
                read += 1;
            }
        }
        assert_eq!(read, 2);
    });
}

#[test]
fn after_what_was_queued_comes_the_close_once_and_nothing_else() {
    loom::model(|| {
        let outbox = Arc::new(Outbox::default());
        assert!(outbox.push_message(one(1), 100));
        let app = Arc::clone(&outbox);
        let app = thread::spawn(move || {
            // It has room only if the first one is on its way.
            let queued = app.push_message(one(2), 100);
            app.close(DisconnectReason::Full);
            assert!(!app.push_message(one(3), 1000), "after the close");
            queued
        });
        let mut sent = Vec::new();
        let reason = loop {
            match block_on(outbox.wait_next()) {
                Next::Message(bytes) => sent.push(bytes[0]),
                Next::Close(reason) => break reason,
            }
        };
        let all = if app.join().unwrap() { &[1, 2][..] } else { &[1] };
        assert_eq!((&sent[..], reason), (all, DisconnectReason::Full));
        assert!(outbox.next().is_none() && outbox.message_bytes() == 0);
    });
}

#[test]
fn who_waits_for_the_close_is_woken_with_the_first_reason() {
    loom::model(|| {
        let outbox = Arc::new(Outbox::default());
        let app = Arc::clone(&outbox);
        let app = thread::spawn(move || {
            app.close(DisconnectReason::Full);
            app.close(DisconnectReason::Left);
        });
        assert_eq!(block_on(outbox.closing()), DisconnectReason::Full);
        app.join().unwrap();
        assert!(matches!(outbox.next(), Some(Next::Close(DisconnectReason::Full))));
        assert!(outbox.next().is_none());
    });
}
