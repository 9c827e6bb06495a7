//! Figure f: ways of repair over networks, with equal settings and with the best of each.

use std::{fmt::Write, sync::Arc, time::Duration};

use pliant_modal::{Integrator, ModalModel};
use pliant_stream::{
    Newmark, Playout, Policy, Predict, RecoveryConfig,
    emulator::{LinkConfig, Loss, Preset},
    peer::LateInputRepair,
};

use super::{
    plot::{Figure, Series},
    tables::body,
};
use crate::{
    LabError,
    experiment::{Experiment, Metrics},
    machine::{self, Pinned},
    progress::Progress,
};

/// The step, s.
const STEP: f64 = 0.025;
/// Playout delay (ticks) and repeats of the table in which all ways have the same.
const EQUAL: (u8, u8) = (1, 3);

/// A way of repair.
#[derive(Clone, Copy)]
struct RepairScheme {
    name: &'static str,
    recovery: RecoveryConfig,
    between_peers: Option<LateInputRepair>,
}

/// The ways of repair, without the names that differ from another one only by playout delay and
/// repeats.
fn schemes() -> Vec<RepairScheme> {
    let scheme = |name, recovery| RepairScheme { name, recovery, between_peers: None };
    let peers = |name, repair| RepairScheme {
        between_peers: Some(repair),
        ..scheme(name, RecoveryConfig::default())
    };
    vec![
        scheme("default", RecoveryConfig::default()),
        scheme("force-driven", RecoveryConfig::by_name("force-driven").unwrap_or_default()),
        scheme("paper", RecoveryConfig::paper()),
        scheme("paper-zero", RecoveryConfig::paper_with(Predict::Zero, 50)),
        scheme("paper-hold", RecoveryConfig::paper_with(Predict::Hold, 50)),
        scheme("none", RecoveryConfig::none()),
        peers("peers, rollback", LateInputRepair::Rollback),
        peers("peers, compensate", LateInputRepair::Compensate),
    ]
}

/// The paper's four networks, and its worst one with jitter and with bursts.
fn paths() -> Vec<(&'static str, LinkConfig)> {
    let worst = || LinkConfig::preset(Preset::Paper1);
    let jitter = |ms| LinkConfig { jitter: Duration::from_millis(ms), ..worst() };
    let bursts = |mean| {
        let loss = Loss::gilbert(0.09, mean, Duration::from_secs_f64(STEP));
        LinkConfig { loss, ..worst() }
    };
    vec![
        ("paper-1", worst()),
        ("paper-2", LinkConfig::preset(Preset::Paper2)),
        ("paper-3", LinkConfig::preset(Preset::Paper3)),
        ("paper-4", LinkConfig::preset(Preset::Paper4)),
        ("paper-1, jitter 10 ms", jitter(10)),
        ("paper-1, jitter 30 ms", jitter(30)),
        ("paper-1, bursts of 4", bursts(4.0)),
        ("paper-1, bursts of 12", bursts(12.0)),
    ]
}

/// A way of repair over a path with a playout delay (ticks) and repeats.
fn experiment(
    model: &Arc<ModalModel>,
    scheme: &RepairScheme,
    link: &LinkConfig,
    (delay, repeats): (u8, u8),
    seconds: f64,
) -> Experiment {
    let recovery = RecoveryConfig { playout: Playout::Fixed(delay), repeats, ..scheme.recovery };
    let mut made = Experiment::new(model.clone(), link.clone(), recovery);
    made.peer_repeats = repeats.into();
    // The paper's streams have the paper's integrator at both ends.
    if !matches!(recovery.policy, Policy::ForceDriven { .. }) {
        made.integrator = Integrator::Newmark;
        made.newmark = Newmark::average(STEP);
    }
    made.seconds = seconds;
    made
}

fn run(scheme: &RepairScheme, made: &Experiment) -> Result<Metrics, LabError> {
    Ok(match scheme.between_peers {
        Some(repair) => made.run_peers(repair)?,
        None => made.run()?,
    })
}

/// Runs an experiment several times for its processor time. The first run fills the caches, and the
/// shortest of the others is the time of the work itself. All runs give the same metrics.
fn timed(scheme: &RepairScheme, mut made: Experiment) -> Result<Metrics, LabError> {
    made.cpu_clock = Some(machine::thread_time);
    let mut f = run(scheme, &made)?;
    f.cpu_us_per_tick = f64::INFINITY;
    for _ in 0..3 {
        f.cpu_us_per_tick = f.cpu_us_per_tick.min(run(scheme, &made)?.cpu_us_per_tick);
    }
    Ok(f)
}

const COLUMNS: &str = "| network | repair | playout ticks, repeats | rms % | rms / rms of the motion % | largest % | ticks missing | force, rms / rms of the force % | without tremor: force % | shown delay ms | kbit/s | processor us a tick |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n";

fn row(
    out: &mut String,
    path: &str,
    scheme: &RepairScheme,
    (delay, repeats): (u8, u8),
    f: &Metrics,
    calm: &Metrics,
) {
    let settings = match scheme.between_peers {
        Some(_) => format!("0, {repeats}"),
        None => format!("{delay}, {repeats}"),
    };
    // Writing to a string cannot fail.
    let _ = writeln!(
        out,
        "| {path} | {} | {settings} | {:.4} | {:.4} | {:.2} | {} | {:.4} | {:.4} | {:.0} | {:.1} | {:.1} |",
        scheme.name,
        f.rms_percent,
        f.rms_of_motion_percent,
        f.max_percent,
        f.missing,
        f.force_rms_of_force_percent,
        calm.force_rms_of_force_percent,
        f.visual_delay_ms,
        f.kbit_s,
        f.cpu_us_per_tick
    );
}

/// Every way of repair over every path: with the same playout delay and repeats, and with those
/// that are best for it.
pub(super) fn networks(quick: bool, progress: &mut dyn Progress) -> Result<(Vec<Figure>, String), LabError> {
    let model = body()?;
    // Pin the thread after the bake, whose threads would otherwise stay on this core. The thread's
    // own clock leaves out other load on the machine.
    let _pinned = Pinned::new();
    let seconds = if quick { 20.0 } else { 60.0 };
    let (schemes, paths) = (schemes(), paths());
    let (mut equal, mut best) = (COLUMNS.to_owned(), COLUMNS.to_owned());
    let mut points = vec![[Vec::new(), Vec::new()]; schemes.len()];
    let without_tremor = |mut made: Experiment| {
        made.hands.iter_mut().for_each(|hand| hand.tremor = 0.0);
        made
    };
    let (delays, repeats): (&[u8], &[u8]) =
        if quick { (&[1, 4], &[3]) } else { (&[0, 1, 2, 4], &[0, 1, 3, 7]) };
    for (done, (path, link)) in paths.iter().enumerate() {
        for (index, scheme) in schemes.iter().enumerate() {
            progress.report(
                "network",
                (done * schemes.len() + index) as f64 / (paths.len() * schemes.len()) as f64,
            );
            let made = |settings| experiment(&model, scheme, link, settings, seconds);
            let f = timed(scheme, made(EQUAL))?;
            row(&mut equal, path, scheme, EQUAL, &f, &run(scheme, &without_tremor(made(EQUAL)))?);
            // The first four paths are the paper's networks, which are drawn.
            if done < 4 {
                let error = f.rms_of_motion_percent.max(1e-5);
                points[index][0].push((f.kbit_s, error));
                points[index][1].push((f.cpu_us_per_tick, error));
            }
            let mut least = (f64::INFINITY, EQUAL);
            let own_delay = if scheme.between_peers.is_some() { &delays[..1] } else { delays };
            for &delay in own_delay {
                for &repeats in repeats {
                    let error = run(scheme, &made((delay, repeats)))?.rms_of_motion_percent;
                    // A longer delay or more repeats have to gain at least a hundredth.
                    if error < 0.99 * least.0 {
                        least = (error, (delay, repeats));
                    }
                }
            }
            let f = timed(scheme, made(least.1))?;
            row(&mut best, path, scheme, least.1, &f, &run(scheme, &without_tremor(made(least.1)))?);
        }
    }
    let text = format!(
        "All ways with a playout delay of {} tick and {} repeats (peers have no playout delay):\n\n{equal}\n\
         Each way with the playout delay ({}) and the repeats ({}) that give it the smallest error of the shape over this network, smaller ones where that costs less than a hundredth:\n\n{best}\n\
         *rms* and *largest* are shares of the largest displacement, *rms / rms of the motion* is the error as a share of the rms of the true displacement, and so for the force. The true shape has all modes. A tick that is not shown in time counts with the picture and the forces that are shown instead, and a force that is not shown counts as zero. The hands have a tremor of 9.3 and 11.7 Hz, which nothing can predict; one column is without it. The *shown delay* is from the host's step to the showing of its tick. Peers show their own step at once, before they know all targets, and are compared with what all agree on under rollback; so is compensation, which leaves each peer with a state of its own. `none` and the paper's policies stream accelerations, with average acceleration at both ends as in the paper. Bursts are those of a Gilbert-Elliott path with 9 % loss.\n",
        EQUAL.0,
        EQUAL.1,
        list(delays),
        list(repeats),
    );
    let words = "Each line is a way of repair, and its points are the paper's four networks (9, 6, 3 and 0 % loss). Lower and further left is better. All have the same playout delay of one tick and the same three repeats, but peers have no playout delay.";
    let time = "The figure shows the same error over the processor time of a tick at the receiver. The time includes decoding, correcting and stepping 60 modes, and between peers also the peer's own hands. It is the time of the thread itself on one core, the shortest of three runs.";
    let figures = [
        ("f-network", "bytes", "down, kbit/s", words),
        ("f-network-time", "time", "processor time of a tick, us", time),
    ];
    let figures = figures.into_iter().enumerate().map(|(which, (file, title, x, words))| Figure {
        file: file.into(),
        title: format!("Ways of repair on the paper's four networks: {title}"),
        x: x.into(),
        y: "shown error, rms, % of the rms of the motion".into(),
        logarithmic: true,
        series: schemes
            .iter()
            .zip(&points)
            .map(|(scheme, p)| Series::new(scheme.name, p[which].clone()))
            .collect(),
        reference_error: None,
        words: words.into(),
    });
    Ok((figures.collect(), text))
}

fn list(values: &[u8]) -> String {
    values.iter().map(u8::to_string).collect::<Vec<_>>().join(", ")
}
