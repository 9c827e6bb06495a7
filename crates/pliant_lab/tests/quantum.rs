//! Size and error of quantized frames, and the traffic of a guest's hand.

use crate::support;

use std::time::Duration;

use pliant_lab::experiment::{Experiment, Metrics};
use pliant_stream::RecoveryConfig;
use pliant_stream::emulator::LinkConfig;
use support::bar;

fn run(change: impl Fn(&mut Experiment)) -> Metrics {
    let link = LinkConfig { delay: Duration::from_millis(10), ..Default::default() };
    let mut e = Experiment::new(bar(6, 0.05), link, RecoveryConfig::default());
    e.seconds = 5.0;
    change(&mut e);
    e.run().unwrap()
}

#[test]
fn coarser_steps_take_fewer_bytes_and_show_a_larger_error() {
    let at = |quantum: f64| run(|e| e.quantum = quantum);
    let [fine, usual, coarse] = [2.0f64.powi(-20), 2.0f64.powi(-14), 2.0f64.powi(-8)].map(at);
    assert_eq!(usual.hash, run(|_| ()).hash, "the default is 2^-14");
    let rates = [fine.kbit_s, usual.kbit_s, coarse.kbit_s];
    assert!(rates[0] > rates[1] && rates[1] > rates[2], "{rates:?} kbit/s");
    assert!(fine.rms_percent < usual.rms_percent && 4.0 * usual.rms_percent < coarse.rms_percent);
    // A frame moves the surface by at most half a step in each mode of its slice.
    assert!(coarse.rms_percent < 100.0 * 2.0f64.powi(-8), "{}", coarse.rms_percent);
    // A quantum that is not a number or out of range is replaced or clamped.
    assert_eq!(at(f64::NAN).hash, usual.hash);
    let (clamped, coarsest) = (at(1e9).hash, at(0.1).hash);
    assert!(clamped == coarsest && clamped != coarse.hash, "the largest quantum is 0.1");
}

#[test]
fn a_hand_at_the_guest_says_its_target_every_tick() {
    let idle = run(|_| ());
    let holds = run(|e| e.guest_hand = true);
    // A target has three numbers of at most double precision. It is sent three times, forty times a
    // second.
    let more = holds.kbit_s_up - idle.kbit_s_up;
    assert!((3.0..40.0).contains(&more), "{more} kbit/s for the targets ({} without)", idle.kbit_s_up);
}
