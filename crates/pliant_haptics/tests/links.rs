//! What the drivers share with those who cut their force, in all orders of their steps (loom): the
//! connection of a device, the scheduler of 3D Systems' library and its frames.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
#![allow(unsafe_code, reason = "a frame is touched as the driver touches it")]

#[path = "../src/device/link.rs"]
mod link;
#[path = "../src/vendor/open_haptics/scheduler.rs"]
mod scheduler;

mod sync {
    pub(crate) use loom::sync::atomic::{AtomicU8, Ordering};
    pub(crate) use loom::sync::{Mutex, MutexGuard};
    pub(crate) use std::sync::PoisonError;
}

use link::Link;
use loom::cell::UnsafeCell;
use loom::sync::Arc;
use loom::sync::atomic::AtomicBool;
use loom::thread;
use scheduler::{SharedScheduler, Turn};
use sync::{Mutex, Ordering};

/// The firmware of a device whose library does not tell why the force is off. Forces are small
/// numbers, and a rise by more than one at once is a kick.
#[derive(Default)]
struct Firmware {
    on: bool,
    sent: u32,
    exerted: u32,
}

impl Firmware {
    fn exert(&mut self) {
        let force = if self.on { self.sent } else { 0 };
        assert!(force <= self.exerted + 1, "a kick from {} to {force}", self.exerted);
        self.exerted = force;
    }

    fn send(&mut self, force: u32) {
        self.sent = force;
        self.exert();
    }

    fn enable(&mut self, on: bool) {
        self.on = on;
        self.exert();
    }
}

/// The steps of Force Dimension's driver in an exchange, without its regular looks at the status.
struct Driver {
    link: Arc<Link<u8>>,
    device: Arc<Mutex<Firmware>>,
    off: bool,
    force: u32,
}

/// The whole force.
const WHOLE: u32 = 3;

impl Driver {
    fn exchange(&mut self) {
        let seen = self.link.seen();
        let idle = self.off || seen.cut;
        self.device.lock().unwrap().send(if idle { 0 } else { self.force });
        let late = self.link.seen().cut;
        if idle || late {
            self.off = !self.device.lock().unwrap().on;
            if idle {
                if self.off && seen.cut {
                    self.device.lock().unwrap().enable(true);
                }
                self.link.answer(seen);
            }
        }
        let exerts = !(idle || late || self.off);
        self.off |= late;
        // The loop's ramp.
        self.force = if exerts { WHOLE.min(self.force + 1) } else { 1 };
    }
}

#[test]
fn a_force_that_was_cut_comes_back_from_zero_and_comes_back() {
    loom::model(|| {
        let (link, device) = (Arc::new(Link::new()), Arc::new(Mutex::new(Firmware::default())));
        assert!(link.begin() && link.open(7));
        *device.lock().unwrap() = Firmware { on: true, sent: WHOLE, exerted: WHOLE };
        let mut driver = Driver { link: link.clone(), device: device.clone(), off: false, force: WHOLE };
        let motors = device.clone();
        let cutter = thread::spawn(move || {
            let cut = link.cut().expect("it is open");
            motors.lock().unwrap().enable(false);
            drop(cut);
        });
        driver.exchange();
        driver.exchange();
        cutter.join().unwrap();
        for _ in 0..5 {
            driver.exchange();
        }
        let device = device.lock().unwrap();
        assert_eq!((device.on, device.exerted), (true, WHOLE), "the force stays off");
        assert!(!driver.link.seen().cut);
    });
}

#[test]
fn no_force_is_sent_while_a_cut_acts() {
    loom::model(|| {
        let link = Arc::new(Link::new());
        assert!(link.begin() && link.open(7));
        let acts = Arc::new(Mutex::new(false));
        let (other, acting) = (link.clone(), acts.clone());
        let cutter = thread::spawn(move || {
            let cut = other.cut().expect("it is open");
            *acting.lock().unwrap() = true;
            // The call of the library.
            *acting.lock().unwrap() = false;
            drop(cut);
        });
        for _ in 0..2 {
            let acts = *acts.lock().unwrap();
            let seen = link.seen();
            link.answer(seen);
            assert!(!acts || seen.cut, "a force beside a cut that acts");
        }
        cutter.join().unwrap();
        link.answer(link.seen());
        assert!(!link.seen().cut, "a cut is answered once");
    });
}

/// Opens a device again while it is cut at once by `cut`, which tells `world` what it acts on: the
/// number of the connection that the library has open, or 0.
fn reopened(cut: impl Fn(&Link<u8>, &Mutex<u8>) + Copy + Send + Sync + 'static) {
    loom::model(move || {
        let (link, world) = (Arc::new(Link::new()), Arc::new(Mutex::new(1)));
        assert!(link.begin() && link.open(1));
        let (other, theirs) = (link.clone(), world.clone());
        let cutter = thread::spawn(move || cut(&other, &theirs));
        link.close();
        *world.lock().unwrap() = 0;
        let reopen = || {
            let begun = link.begin();
            if begun {
                *world.lock().unwrap() = 2;
                link.open(2);
            }
            begun
        };
        let begun = reopen();
        cutter.join().unwrap();
        assert!(begun || reopen(), "nothing acts any more");
        link.answer(link.seen());
        assert!(!link.seen().cut, "the force comes back");
    });
}

/// Acts on what the library has open.
fn act(device: u8, world: &Mutex<u8>) {
    let open = *world.lock().unwrap();
    assert!(open == device || open == 0, "a cut of connection {device} acts on connection {open}");
}

#[test]
fn no_cut_of_a_connection_acts_on_the_next() {
    reopened(|link, world| {
        if let Some(cut) = link.cut() {
            act(cut.device, world);
        }
    });
}

#[test]
fn no_cut_that_comes_late_acts_on_the_next_connection() {
    reopened(|link, world| {
        let Some((number, device)) = link.cut().map(|cut| (cut.number, cut.device)) else { return };
        // A scheduler that was stuck runs it at any time.
        thread::yield_now();
        if let Some(cut) = link.act(number) {
            assert_eq!(cut.device, device);
            act(device, world);
        }
    });
}

#[test]
fn a_cut_while_a_device_is_opened_and_drives_is_obeyed() {
    loom::model(|| {
        let link = Arc::new(Link::new());
        assert!(link.begin());
        let other = link.clone();
        let cutter = thread::spawn(move || other.cut().map(|cut| cut.device));
        // A device that drives to its reference by itself, and then does not.
        let may_drive = link.open((7, true));
        let may_run = link.open((7, false));
        let cut = cutter.join().unwrap();
        let want = match (may_drive, may_run) {
            (false, false) => None,
            (true, false) => Some((7, true)),
            (true, true) => Some((7, false)),
            (false, true) => panic!("a cut is forgotten"),
        };
        assert_eq!(cut, want, "the drive may begin: {may_drive}, the loop: {may_run}");
        assert!(link.seen().cut, "the first force is zero");
    });
}

#[test]
fn whose_connection_ends_by_a_cut_sees_the_cut() {
    loom::model(|| {
        let link = Arc::new(Link::new());
        let ended = Arc::new(AtomicBool::new(false));
        assert!(link.begin() && link.open(ended.clone()));
        let other = link.clone();
        let cutter = thread::spawn(move || {
            if let Some(cut) = other.cut() {
                cut.device.store(true, Ordering::Relaxed);
            }
        });
        // An exchange fails, and the driver asks itself whether the service has refused it.
        if ended.load(Ordering::Relaxed) {
            assert!(link.seen().cut, "the driver takes the cut for a refusal");
        }
        // Dropped beside it, the connection is ended by one of the two.
        let left = link.close();
        assert!(left.is_some(), "the driver ends its connection itself");
        cutter.join().unwrap();
        assert!(link.cut().is_none(), "nothing is left to act on");
    });
}

/// The library's scheduler. It refuses to be started twice, and to be stopped when it does not run.
#[derive(Default)]
struct Library(Mutex<bool>);

impl Library {
    fn start(&self) -> Result<(), ()> {
        let was = std::mem::replace(&mut *self.0.lock().unwrap(), true);
        assert!(!was, "it is started twice");
        Ok(())
    }

    fn stop(&self) {
        let was = std::mem::replace(&mut *self.0.lock().unwrap(), false);
        assert!(was, "it is stopped and does not run");
    }
}

/// Opens a device. While another thread starts or stops the scheduler, the caller tries again.
fn enter(shared: &SharedScheduler, library: &Library) {
    while shared.enter(|| library.start()).is_none() {
        thread::yield_now();
    }
}

#[test]
fn the_scheduler_runs_for_each_device_that_is_open() {
    loom::model(|| {
        let both = Arc::new((SharedScheduler::default(), Library::default()));
        enter(&both.0, &both.1);
        let theirs = both.clone();
        let leaves = thread::spawn(move || theirs.0.leave(|| theirs.1.stop()));
        enter(&both.0, &both.1);
        leaves.join().unwrap();
        assert!(*both.1.0.lock().unwrap(), "a device is open, and its scheduler does not run");
        both.0.leave(|| both.1.stop());
        assert!(!*both.1.0.lock().unwrap(), "no device is open");
    });
}

#[test]
fn a_cut_that_stops_the_scheduler_stops_it_once_and_it_starts_again() {
    loom::model(|| {
        let both = Arc::new((SharedScheduler::default(), Library::default()));
        enter(&both.0, &both.1);
        let cutters = [(), ()].map(|()| {
            let theirs = both.clone();
            thread::spawn(move || theirs.0.stop(|| theirs.1.stop()))
        });
        both.0.leave(|| both.1.stop());
        enter(&both.0, &both.1);
        for cutter in cutters {
            cutter.join().unwrap();
        }
        // A device that a late cut has stopped is opened again.
        both.0.leave(|| both.1.stop());
        enter(&both.0, &both.1);
        assert!(*both.1.0.lock().unwrap());
    });
}

#[test]
fn a_frame_is_touched_by_one_thread_at_a_time() {
    loom::model(|| {
        let frame = Arc::new((Turn::default(), UnsafeCell::new(1)));
        let given_up = Arc::new(AtomicBool::new(false));
        frame.0.ask();
        let (theirs, gone) = (frame.clone(), given_up.clone());
        let servo = thread::spawn(move || {
            let gone = gone.load(Ordering::Acquire);
            if theirs.0.begin() {
                assert!(!gone, "a frame that was given up runs");
                // SAFETY: loom tells if another thread touches it.
                theirs.1.with_mut(|value| unsafe { *value += 1 });
                theirs.0.end();
            }
        });
        // The call of the library returns at any time.
        if frame.0.take() {
            // SAFETY: loom tells if another thread touches it.
            assert_eq!(frame.1.with(|value| unsafe { *value }), 2);
            // SAFETY: as above. This is the next frame.
            frame.1.with_mut(|value| unsafe { *value = 1 });
        } else {
            given_up.store(true, Ordering::Release);
        }
        servo.join().unwrap();
        assert!(!frame.0.begin(), "a frame runs twice");
    });
}
