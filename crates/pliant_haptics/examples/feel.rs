//! Feel a baked body with whatever device there is; no window, figures in the terminal.
//!
//! `cargo run --release -p pliant_haptics --example feel -- BODY.modal [virtual | inverse | touch | omega] [SECONDS] [modal]`
//!
//! The tool holds the vertex farthest along x. A virtual hand moves it in a circle of 2 cm; a real one does what it likes. The force of a real device
//! begins at a tenth: raise `force_scale` once you trust it.

use std::{error::Error, f64::consts::TAU, sync::Arc, time::Duration};

use pliant_haptics::{
    ForceDimension, Hand, HapticDevice, HapticLoop, HeldGrab, Inverse, LoopConfig, ModalLocal, ModelWriter,
    OpenHaptics, ToolMap, VirtualConfig, VirtualDevice, VirtualHandle,
};
use pliant_modal::{Body, BodyConfig, GrabConfig, ModalModel, Patch};

/// Steps of the simulation a second.
const RATE: f64 = 120.0;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let path = arguments.first().ok_or("which body? give the path of a .modal file")?;
    let seconds: f64 = arguments.iter().find_map(|a| a.parse().ok()).unwrap_or(10.0);
    let modal = arguments.iter().any(|a| a == "modal");
    let model = Arc::new(ModalModel::read(path)?);

    let mut hand: Option<VirtualHandle> = None;
    let kind = arguments.get(1).map_or("virtual", String::as_str);
    let device: Box<dyn HapticDevice> = match kind {
        "inverse" => Box::new(Inverse::open(Default::default())?),
        "touch" => Box::new(OpenHaptics::open(Default::default())?),
        "omega" => Box::new(ForceDimension::open(Default::default())?),
        _ => {
            let device = VirtualDevice::new(VirtualConfig::touch(), Hand::FIRM)?;
            hand = Some(device.handle());
            Box::new(device)
        }
    };

    let mut body = Body::new(model.clone(), BodyConfig { step: 1.0 / RATE, ..BodyConfig::default() })?;
    let positions = model.surface().positions();
    let farthest =
        (0..positions.len()).max_by(|&a, &b| positions[a][0].total_cmp(&positions[b][0])).unwrap_or(0);
    let patch = Patch::around(model.surface(), farthest as u32, 0.06 * model.size())?;
    let probe = body.grab(&patch, GrabConfig::default())?;
    let origin = body.grab_position(probe)?;
    body.release(probe);

    let force_scale = if hand.is_some() { 1.0 } else { 0.1 };
    let tool = ToolMap { origin, force_scale, ..ToolMap::default() };
    let mut running = HapticLoop::start(device, LoopConfig { tool, modal, ..LoopConfig::default() })?;
    let coupling = *running.coupling();
    println!("{}: {coupling}", running.info().name);
    let id = body.grab(&patch, coupling.grab_config(tool.motion_scale, tool.force_scale))?;
    let held = [HeldGrab { id, offset: [0.0; 3] }];
    if modal {
        running.set_modal(Some(Box::new(ModalLocal::new(&body, &held, 1.0, running.rate())?)));
    }

    let mut writer = ModelWriter::new();
    let steps = (seconds * RATE) as u64;
    for step in 0..steps {
        let t = step as f64 / RATE;
        if let Some(hand) = &hand {
            hand.set_target([0.02 * (TAU * 0.5 * t).sin(), 0.02 * (1.0 - (TAU * 0.5 * t).cos()), 0.0]);
        }
        let report = *running.report();
        body.set_target(id, report.tick.tool)?;
        body.step()?;
        running.publish(|word| writer.write(&body, &held, &coupling, 1.0, report.tick.now, word))?;
        for event in running.events() {
            println!("{t:7.2} s  {event:?}");
        }
        if step % (RATE as u64 / 4) == 0 {
            let f = report.tick.wrench.force;
            println!(
                "{t:7.2} s  force {:6.2} {:6.2} {:6.2} N  gain {:.2}  available {:.1} mJ  {:.0} Hz  late p99 {:.0} us",
                f[0],
                f[1],
                f[2],
                report.tick.gain,
                report.tick.port.available * 1e3,
                report.rate,
                report.lateness.percentile(0.99) * 1e6
            );
        }
        let next = (step + 1) as f64 / RATE;
        std::thread::sleep(Duration::from_secs_f64((next - running.now()).max(0.0)));
    }
    let report = running.report();
    println!(
        "{} periods, {} left out; late p50 {:.0}, p99 {:.0}, p99.9 {:.0} us; work p99.9 {:.1} us; real-time {}",
        report.ticks,
        report.missed,
        report.lateness.percentile(0.5) * 1e6,
        report.lateness.percentile(0.99) * 1e6,
        report.lateness.percentile(0.999) * 1e6,
        report.work.percentile(0.999) * 1e6,
        report.realtime
    );
    Ok(())
}
