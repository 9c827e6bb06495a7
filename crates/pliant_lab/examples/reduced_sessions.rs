//! Prints what reduced elasticity with the own shapes of held patches costs a session: shown error,
//! bytes and processor time beside the linear body in the same run, and the work of the device loop
//! at 1 kHz with each as its local model.
//!
//! `cargo run --release -p pliant_lab --example reduced_sessions [seconds]`
#![allow(clippy::print_stdout, reason = "an example prints its results")]

use std::error::Error;
use std::sync::Arc;
use std::time::Duration;

use pliant_bake::{BakeConfig, Material, bake};
use pliant_haptics::{
    Cycle, HandModel, HeldGrab, Histogram, LocalModel, LoopConfig, LoopEvent, ModalLocal, ModelWriter,
    ToolMap, VirtualConfig, VirtualDevice, VirtualScheduler,
};
use pliant_lab::experiment::{Experiment, HandScript, Metrics};
use pliant_mesh::shapes;
use pliant_modal::{Body, BodyConfig, Elasticity, GrabConfig, ModalModel, Patch, StepSettings};
use pliant_stream::RecoveryConfig;
use pliant_stream::emulator::{LinkConfig, Loss, Preset};
use pliant_stream::peer::LateInputRepair;

type Outcome<T> = Result<T, Box<dyn Error>>;

/// The clock of the thread, so that other load on the machine does not count.
#[cfg(target_os = "linux")]
fn clock() -> Duration {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Duration::new(now.tv_sec.unsigned_abs(), now.tv_nsec.unsigned_abs() as u32)
}

#[cfg(not(target_os = "linux"))]
fn clock() -> Duration {
    use std::{sync::OnceLock, time::Instant};
    static BEGAN: OnceLock<Instant> = OnceLock::new();
    BEGAN.get_or_init(Instant::now).elapsed()
}

/// A bar of .4 m by .08 m by .08 m, clamped at one end.
fn bar() -> Outcome<Arc<ModalModel>> {
    let config = BakeConfig {
        modes: 40,
        material: Some(Material::NeoHookean),
        anchors: vec!["x<1e-9".parse()?],
        ..BakeConfig::default()
    };
    let mesh = shapes::bar([10, 2, 2], [0.4, 0.08, 0.08])?;
    Ok(Arc::new(bake(&mesh, None, &config, &mut |_, _| ())?.model))
}

/// One hand that leads a corner of the end by up to `reach` of the size. The radius is the same in
/// the single precision of the network.
fn hands(model: &ModalModel, reach: f64) -> Vec<HandScript> {
    let mut hands = Experiment::default_hands(model);
    hands.truncate(1);
    for hand in &mut hands {
        hand.radius = 0.0625 * 0.5;
        hand.reach = [0.1 * reach, reach, 0.8 * reach].map(|r| r * model.size());
    }
    hands
}

fn paths() -> Vec<(&'static str, LinkConfig)> {
    let worst = || LinkConfig::preset(Preset::Paper1);
    let step = Duration::from_millis(25);
    let bursts = |burst| LinkConfig { loss: Loss::gilbert(0.09, burst, step), ..worst() };
    let jitter = |link| LinkConfig { jitter: Duration::from_millis(30), ..link };
    vec![
        ("paper-1", worst()),
        ("paper-1, bursts of 4", bursts(4.0)),
        ("paper-1, bursts of 12", bursts(12.0)),
        ("paper-1, bursts of 4, jitter 30 ms", jitter(bursts(4.0))),
    ]
}

#[derive(Clone, Copy)]
struct Kind {
    name: &'static str,
    elasticity: Elasticity,
    held_shapes: bool,
}

const KINDS: [Kind; 3] = [
    Kind { name: "linear", elasticity: Elasticity::Linear, held_shapes: false },
    Kind { name: "reduced", elasticity: Elasticity::Reduced, held_shapes: false },
    Kind { name: "reduced, own shapes", elasticity: Elasticity::Reduced, held_shapes: true },
];

fn row(path: &str, kind: Kind, f: &Metrics, linear: f64) {
    println!(
        "| {path} | {} | {:.4} | {:.3} | {:.3} | {:.2} | {:.1} | {:+.1} % | {:.0} |",
        kind.name,
        f.rms_percent,
        f.max_percent,
        f.force_rms_percent,
        f.force_scale,
        f.bytes_per_frame,
        100.0 * (f.bytes_per_frame / linear - 1.0),
        f.cpu_us_per_tick
    );
}

/// Seeds of the paths. All runs of a row are pooled.
const SEEDS: [u64; 3] = [1, 2, 3];

/// Means of the runs, and the largest of what is the largest.
fn pooled(runs: &[Metrics]) -> Metrics {
    let mean = |of: fn(&Metrics) -> f64| runs.iter().map(of).sum::<f64>() / runs.len() as f64;
    let root = |of: fn(&Metrics) -> f64| {
        (runs.iter().map(|f| of(f).powi(2)).sum::<f64>() / runs.len() as f64).sqrt()
    };
    let most = |of: fn(&Metrics) -> f64| runs.iter().map(of).fold(0.0, f64::max);
    Metrics {
        rms_percent: root(|f| f.rms_percent),
        max_percent: most(|f| f.max_percent),
        force_rms_percent: root(|f| f.force_rms_percent),
        force_scale: most(|f| f.force_scale),
        bytes_per_frame: mean(|f| f.bytes_per_frame),
        cpu_us_per_tick: mean(|f| f.cpu_us_per_tick),
        ..Metrics::default()
    }
}

const COLUMNS: &str = "| network | elasticity | rms % | largest % | force rms % | largest force N | bytes a datagram | beside linear | processor us a tick |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- |";

fn sessions(model: &Arc<ModalModel>, seconds: f64) -> Outcome<()> {
    let between = |title: &str, guest_hand: bool, peers: bool| -> Outcome<()> {
        println!("\n{title}\n\n{COLUMNS}");
        for (path, link) in paths() {
            let mut linear = f64::NAN;
            for kind in KINDS {
                let experiment = Experiment {
                    elasticity: kind.elasticity,
                    held_shapes: kind.held_shapes,
                    hands: hands(model, 0.1),
                    seconds,
                    guest_hand,
                    cpu_clock: Some(clock),
                    ..Experiment::new(model.clone(), link.clone(), RecoveryConfig::default())
                };
                let runs = SEEDS.map(|seed| {
                    let experiment = Experiment { seed, ..experiment.clone() };
                    if peers { experiment.run_peers(LateInputRepair::Rollback) } else { experiment.run() }
                });
                let f = pooled(&runs.into_iter().collect::<Result<Vec<_>, _>>()?);
                if kind.elasticity == Elasticity::Linear {
                    linear = f.bytes_per_frame;
                }
                row(path, kind, &f, linear);
            }
        }
        Ok(())
    };
    between("Host and guest", false, false)?;
    between("Host and guest, whose predicted hand holds the same patch (for its time only)", true, false)?;
    between("Two peers", false, true)
}

/// The device loop at 1 kHz: a virtual device is led by up to a tenth of the body and back while
/// the loop steps its own copy.
fn device(model: &Arc<ModalModel>, kind: Kind) -> Outcome<()> {
    const RATE: f64 = 1000.0;
    const EVERY: usize = 8;
    let settings = StepSettings { elasticity: kind.elasticity, ..StepSettings::default() };
    let step = EVERY as f64 / RATE;
    let mut body = Body::new(model.clone(), BodyConfig { step, settings, ..BodyConfig::default() })?;
    let vertex = hands(model, 0.1)[0].vertex;
    let patch = Patch::around(model.surface(), vertex, 0.0625 * 0.5)?;
    let probe = body.grab(&patch, GrabConfig::default())?;
    let origin = body.grab_position(probe)?;
    body.release(probe);
    let device = VirtualDevice::new(VirtualConfig::touch(), HandModel::LIGHT)?;
    let hand = device.handle();
    let tool = ToolMap { origin, ..ToolMap::default() };
    let mut cycle =
        Cycle::new(device, LoopConfig { rate: RATE, modal: true, tool, ..LoopConfig::default() })?;
    let id = body.grab(&patch, cycle.core().coupling().grab_config(1.0, 1.0))?;
    let held = HeldGrab { key: 0, id, offset: [0.0; 3] };
    let mut scheduler = VirtualScheduler::new(RATE);
    let mut writer = ModelWriter::new();
    let mut update = LocalModel::default();
    let mut events: Vec<LoopEvent> = Vec::new();
    let (mut work, mut copies) = (Histogram::default(), Histogram::default());
    let mut own = None;
    let mut largest = 0.0f64;
    for period in 0..20_000_usize {
        let t = period as f64 / RATE;
        hand.set_target([0.0, 0.03 * (1.3 * t).sin(), 0.02 * (0.9 * t).sin()]);
        if period % EVERY == 0 {
            let (seen, tool) = (cycle.core().last().now, cycle.core().last().tool);
            if seen > 0.0 {
                body.set_target(id, tool)?;
            }
            if kind.held_shapes {
                body.make_held_shapes()?;
            }
            body.step()?;
            let shapes = body.held_shapes().map(Arc::as_ptr);
            if period == 0 || own != shapes {
                let begun = clock();
                let copy = ModalLocal::new(&body, &[held], 1.0, RATE)?;
                cycle.set_modal(Some(Box::new(copy)));
                copies.add((clock() - begun).as_secs_f64());
                own = shapes;
            }
            writer.write(&body, &[held], cycle.core().coupling(), 1.0, seen, &mut update)?;
        }
        let begun = clock();
        cycle.step(&mut scheduler, &update, &mut events);
        work.add((clock() - begun).as_secs_f64());
        events.clear();
        let force = cycle.core().last().wrench.force;
        largest = largest.max(force.iter().map(|x| x * x).sum::<f64>().sqrt());
    }
    let us = |h: &Histogram, p| 1e6 * h.percentile(p);
    println!(
        "| {} | {:.0} | {:.0} | {:.0} | {:.0} | {:.2} |",
        kind.name,
        us(&work, 0.5),
        us(&work, 0.99),
        us(&work, 0.999),
        us(&copies, 1.0),
        largest
    );
    Ok(())
}

fn main() -> Outcome<()> {
    let seconds = std::env::args().nth(1).map_or(Ok(20.0), |text| text.parse())?;
    let model = bar()?;
    println!("{} modes, {} tetrahedra", model.mode_count(), model.info().tets);
    println!("\nThe device loop at 1 kHz\n");
    println!(
        "| local model | work p50 us | p99 us | p99.9 us | longest making of a copy us | largest force N |"
    );
    println!("| --- | --- | --- | --- | --- | --- |");
    for kind in KINDS {
        device(&model, kind)?;
    }
    sessions(&model, seconds)
}
