//! Drags a block with the virtual Touch: body stiffness, grip, simulation rate and network delay against what the hand feels.
//!
//! `cargo run --release -p pliant_haptics --example stability_table [modal] [premium | omega | slippery]`
//!
//! `slippery` is the Touch without any friction: the hardest case.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "an experiment may stop at a surprise")]

#[path = "../tests/rig/mod.rs"]
mod rig;

use pliant_haptics::{Hand, VirtualConfig};
use rig::scene::{SceneConfig, drag};

fn main() {
    let modal = std::env::args().any(|a| a == "modal");
    let device = std::env::args().find_map(|a| match a.as_str() {
        "premium" => Some(VirtualConfig::premium()),
        "omega" => Some(VirtualConfig::omega3()),
        "slippery" => Some(VirtualConfig { name: "slippery Touch", friction: 0.0, ..VirtualConfig::touch() }),
        _ => None,
    });
    let device = device.unwrap_or_else(VirtualConfig::touch);
    println!("device: {}", device.name);
    println!("local model: {}", if modal { "modal, stepped by the loop" } else { "proxy" });
    println!(
        "speed at the end mm/s (a star: it does not calm down) / most energy beyond what was put in, mJ / largest force step, % of the limit"
    );
    let mut bad = 0;
    for round_trip in [0.0, 0.196] {
        for (name, hand) in Hand::PRESETS {
            println!("\nhand {name}, round trip {:.0} ms", round_trip * 1e3);
            println!("{:>8} {:>22} {:>22} {:>22} {:>22}", "E, Pa", "40 Hz", "120 Hz", "240 Hz", "1000 Hz");
            for young in [1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11] {
                print!("{young:8.0e}");
                for simulation in [40.0, 120.0, 240.0, 1000.0] {
                    let device = device.clone();
                    let d = drag(SceneConfig {
                        device,
                        young,
                        hand,
                        simulation,
                        round_trip,
                        modal,
                        ..SceneConfig::default()
                    });
                    let star = if d.oscillates() { "*" } else { " " };
                    let ok = !d.oscillates() && d.given <= 5e-3 && d.step[0] <= d.step[1] * 1.000_001;
                    bad += u32::from(!ok);
                    let cell = format!(
                        "{:.1}{star}/{:.2}/{:.0}",
                        d.speeds[1] * 1e3,
                        d.given * 1e3,
                        100.0 * d.step[0] / d.step[1]
                    );
                    print!(" {cell:>22}");
                }
                println!();
            }
        }
    }
    println!("\n{bad} cells break a promise");
}
