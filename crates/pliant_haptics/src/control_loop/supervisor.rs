//! The supervisor of a loop: a thread of its own that cuts the force while a call of the driver
//! hangs.

use std::{sync::Arc, thread::JoinHandle, time::Duration};

use super::heartbeat::{Heartbeat, Phase};
use crate::{LoopClock, StopHandle, StopSwitch};

/// Time without a sign of life after which the force is cut, s. A force is then at zero 35 ms after
/// the hang, with room for a machine that wakes the supervisor late.
const HANG: f64 = 0.025;
/// The same after the emergency stop was pressed, s.
const HANG_WHEN_STOPPED: f64 = 0.010;
/// Interval of the checks.
const CHECK: Duration = Duration::from_millis(5);
/// Most cuts of a device that may hang at once.
const HUNG_CUTS: usize = 4;

/// Runs `call`, which may never return, on a thread of its own. If there is none, it runs here.
pub(crate) fn beside(call: impl Fn() + Clone + Send + 'static) -> Option<JoinHandle<()>> {
    let thread = std::thread::Builder::new().name("pliant cut".into()).spawn(call.clone());
    if thread.is_err() {
        call();
    }
    thread.ok()
}

/// Cuts the force by `handle` whenever the loop gives no sign of life in time. Returns soon after
/// the loop's thread has ended, also if a cut itself hangs.
pub(crate) fn supervise(
    heartbeat: &Heartbeat,
    handle: &Arc<dyn StopHandle>,
    stop: &StopSwitch,
    clock: LoopClock,
    name: &str,
) {
    let mut cuts = Vec::new();
    while !heartbeat.is_done() {
        std::thread::sleep(CHECK);
        let (silent, cut) = heartbeat.silence(clock.now());
        let armed = heartbeat.is(Phase::Armed);
        // A device that is being opened may take its time, unless it is to stop.
        let hangs = if stop.is_pressed() {
            silent > HANG_WHEN_STOPPED && !heartbeat.is(Phase::Safe)
        } else {
            silent > HANG && armed
        };
        // A cut before a device is open, or before its drive begins, ends nothing. Hence it is
        // repeated while the device is being opened.
        if hangs && (!cut || !armed) && !heartbeat.is_done() {
            heartbeat.mark_cut();
            cuts.retain(|cut: &JoinHandle<()>| !cut.is_finished());
            if cuts.len() < HUNG_CUTS {
                let handle = handle.clone();
                cuts.extend(beside(move || handle.cut()));
            }
            if armed {
                tracing::error!(
                    device = name,
                    "the driver has not answered for {silent:.3} s: its force was cut"
                );
            }
        }
    }
}
