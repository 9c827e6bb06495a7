//! Whole sessions over emulated paths, against the bars of the design.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod support;

use std::time::Duration;

use pliant_stream::emulator::{LinkConfig, Loss, Preset};
use pliant_stream::experiment::{Experiment, Figures};
use pliant_stream::{Newmark, RecoveryConfig};
use support::bar;

fn show(name: &str, f: &Figures) {
    println!(
        "{name:<14} ticks {} lost {} guessed {} recovered {} rms {:.4}% max {:.3}% end {:.2e}% hidden {:.2e}% force {:.3}% ring {:.4} ({:.4}) h2f {:.0} delay {:.1} recover {:.0}ms bytes {:.0} {:.1}kbit/s nacks {} {:?}",
        f.ticks,
        f.lost,
        f.guessed,
        f.recovered,
        f.rms_percent,
        f.max_percent,
        f.end_percent,
        f.hidden_end_percent,
        f.force_rms_percent,
        f.force_ringing,
        f.true_ringing,
        f.hand_to_force_ms,
        f.shown_delay_ms,
        f.recover_ms,
        f.bytes_per_frame,
        f.kbit_s,
        f.nacks,
        f.counts
    );
}

#[test]
fn all_policies() {
    for (net, link) in [
        ("perfect", LinkConfig { delay: Duration::from_millis(20), ..Default::default() }),
        ("paper-1", LinkConfig::preset(Preset::Paper1)),
        (
            "burst",
            LinkConfig { loss: Loss::Burst { first: 140, count: 12 }, ..LinkConfig::preset(Preset::Paper1) },
        ),
        (
            "gilbert",
            LinkConfig {
                loss: Loss::gilbert(0.09, 4.0, Duration::from_millis(25)),
                ..LinkConfig::preset(Preset::Paper1)
            },
        ),
        (
            "every50",
            LinkConfig { loss: Loss::Every { first: 135, every: 50 }, ..LinkConfig::preset(Preset::Paper1) },
        ),
    ] {
        println!("== {net}");
        for name in RecoveryConfig::NAMES {
            let mut e = Experiment::new(bar(120, 0.05), link.clone(), RecoveryConfig::by_name(name).unwrap());
            e.seconds = 60.0;
            let f = e.run().unwrap();
            show(name, &f);
        }
    }
}
