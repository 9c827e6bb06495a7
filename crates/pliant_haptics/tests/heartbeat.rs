//! The hand-over between a device loop and its supervisor, in all orders of their steps (loom).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

#[expect(dead_code, reason = "the model uses a part")]
#[path = "../src/control_loop/heartbeat.rs"]
mod heartbeat;

mod sync {
    pub(crate) use loom::sync::Arc;
    pub(crate) use loom::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};
}

use heartbeat::{Done, Heartbeat, Phase};
use sync::{AtomicBool, Ordering};

/// What a supervisor does once, at a time. Returns whether it has cut the force.
fn check(heartbeat: &Heartbeat, now: f64) -> bool {
    let (silent, cut) = heartbeat.silence(now);
    let hangs = silent > 0.5 && heartbeat.is(Phase::Armed) && !cut;
    if hangs {
        heartbeat.mark_cut();
    }
    hangs
}

#[test]
fn no_cut_goes_unnoticed_and_none_is_noticed_twice() {
    loom::model(|| {
        let heartbeat = Heartbeat::new(0.0);
        heartbeat.beat(0.0, Phase::Armed);
        let shared = heartbeat.clone();
        let supervisor =
            loom::thread::spawn(move || u32::from(check(&shared, 1.0)) + u32::from(check(&shared, 2.0)));
        // The loop was late, and goes on while the supervisor looks.
        let mut noticed = u32::from(heartbeat.beat(1.0, Phase::Armed));
        noticed += u32::from(heartbeat.beat(2.0, Phase::Armed));
        let cuts = supervisor.join().unwrap();
        noticed += u32::from(heartbeat.beat(3.0, Phase::Safe));
        assert!(noticed <= cuts, "{noticed} of {cuts} cuts");
        assert!(noticed > 0 || cuts == 0, "{cuts} cuts, and the loop knows of none");
        assert!(!heartbeat.beat(4.0, Phase::Safe), "a cut is told once");
    });
}

#[test]
fn who_sees_a_sign_of_life_sees_what_the_loop_does_since() {
    loom::model(|| {
        let heartbeat = Heartbeat::new(0.0);
        heartbeat.beat(0.0, Phase::Armed);
        let shared = heartbeat.clone();
        let supervisor = loom::thread::spawn(move || {
            let (silent, _) = shared.silence(1.0);
            let armed = shared.is(Phase::Armed);
            assert!(silent > 0.5 || !armed, "silent for {silent} s, and armed: {armed}");
        });
        heartbeat.beat(1.0, Phase::Safe);
        supervisor.join().unwrap();
    });
}

#[test]
fn a_loop_that_is_over_has_done_what_it_did_before() {
    loom::model(|| {
        let heartbeat = Heartbeat::new(0.0);
        let stopped = sync::Arc::new(AtomicBool::new(false));
        let (done, device) = (Done(heartbeat.clone()), stopped.clone());
        let runner = loom::thread::spawn(move || {
            device.store(true, Ordering::Relaxed);
            drop(done);
        });
        if heartbeat.is_done() {
            assert!(stopped.load(Ordering::Relaxed), "over, and its device is not stopped");
        }
        runner.join().unwrap();
        assert!(heartbeat.is_done());
    });
}
