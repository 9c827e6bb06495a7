//! Drags a body with a virtual device and prints a Markdown table: body stiffness, grip, simulation
//! rate and round trip against the resulting forces.
//!
//! `cargo run --release -p pliant_haptics --example drag_table -- [BODY.modal] [modal] [touch |
//! premium | omega | slippery] [summary]`
//!
//! Without a body, the example drags a block whose modes are known in closed form. A body is scaled
//! to 15 cm, gets each stiffness in turn, and is dragged by its top. `slippery` is the Touch
//! without any friction, which is the hardest case. `summary` prints the last line only.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "an experiment may stop at a surprise")]

#[path = "../tests/rig/mod.rs"]
mod rig;

use std::{process::ExitCode, sync::Arc};

use pliant_haptics::{HandModel, VirtualConfig};
use pliant_modal::ModalModel;
use rig::scene::{SceneConfig, Subject, drag};

const STIFFNESSES: [f64; 9] = [1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11];
const RATES: [f64; 4] = [40.0, 120.0, 240.0, 1000.0];

fn main() -> ExitCode {
    let mut modal = false;
    let mut summary = false;
    let mut device = VirtualConfig::touch();
    let mut subject = Subject::Block;
    let mut name = "block".to_owned();
    for argument in std::env::args().skip(1) {
        match argument.as_str() {
            "modal" => modal = true,
            "summary" => summary = true,
            "touch" => device = VirtualConfig::touch(),
            "premium" => device = VirtualConfig::premium(),
            "omega" => device = VirtualConfig::omega3(),
            "slippery" => {
                device = VirtualConfig {
                    name: "virtual Touch without friction",
                    friction: 0.0,
                    ..VirtualConfig::touch()
                };
            }
            path => match ModalModel::read(path) {
                Ok(model) => {
                    name = model.info().name.clone();
                    subject = Subject::Baked(Arc::new(model));
                }
                Err(error) => {
                    eprintln!("drag_table: {path}: {error}");
                    return ExitCode::from(2);
                }
            },
        }
    }
    let kind = if modal { "modal" } else { "proxy" };
    let (mut bad, mut worst) = (0, [0.0f64; 3]);
    for round_trip in [0.0, 0.196] {
        let mut of_trip = [0.0f64; 3];
        for (grip, hand) in HandModel::PRESETS {
            if !summary {
                println!(
                    "\n{name}, {}, {kind} model, hand {grip}, round trip {:.0} ms:\n",
                    device.name,
                    round_trip * 1e3
                );
                println!("| E, Pa | 40 Hz | 120 Hz | 240 Hz | 1000 Hz |\n| --- | --- | --- | --- | --- |");
            }
            for young in STIFFNESSES {
                let mut row = format!("| {young:.0e} |");
                for simulation in RATES {
                    let (device, subject) = (device.clone(), subject.clone());
                    let config = SceneConfig {
                        subject,
                        device,
                        young,
                        hand,
                        simulation,
                        round_trip,
                        modal,
                        ..SceneConfig::default()
                    };
                    let d = drag(config);
                    let star = if d.oscillates() { "*" } else { "" };
                    let metrics = [d.speeds[1] * 1e3, d.given * 1e3, 100.0 * d.step[0] / d.step[1]];
                    bad += u32::from(!d.keeps_its_promises());
                    row += &format!(" {:.1}{star} / {:.2} / {:.0} |", metrics[0], metrics[1], metrics[2]);
                    of_trip.iter_mut().zip(metrics).for_each(|(worst, x)| *worst = worst.max(x));
                }
                if !summary {
                    println!("{row}");
                }
            }
        }
        if !summary {
            println!();
        }
        println!(
            "| {name} | {} | {kind} | {:.0} ms | {:.1} | {:.2} | {:.0} |",
            device.name,
            round_trip * 1e3,
            of_trip[0],
            of_trip[1],
            of_trip[2]
        );
        worst.iter_mut().zip(of_trip).for_each(|(worst, x)| *worst = worst.max(x));
    }
    eprintln!(
        "{bad} cells break a promise; worst {:.1} mm/s, {:.2} mJ, {:.0} % of the slew limit",
        worst[0], worst[1], worst[2]
    );
    if bad == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
