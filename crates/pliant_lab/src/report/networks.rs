//! Figure f: ways of repair over networks, with equal settings and with the best of each.

use std::{fmt::Write, sync::Arc, time::Duration};

use pliant_modal::ModalModel;
use pliant_stream::{
    Playout, Predict, RecoveryConfig,
    emulator::{LinkConfig, Loss, Preset},
    peer::LateInputRepair,
};

use super::{
    plot::{Axes, Figure, Series},
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

/// Jitters (ms) and mean lengths of bursts (ticks) that each of the paper's networks gets.
const JITTERS: [u64; 2] = [10, 30];
const BURSTS: [f64; 2] = [4.0, 12.0];

/// An emulated path.
struct Path {
    name: String,
    link: LinkConfig,
    /// Loss of the paper's network as it is, %: the axis of a figure.
    loss: Option<f64>,
    /// Jitter, ms, and mean length of a burst, ticks, where the worst network has them: the axes of
    /// two figures.
    jitter: Option<f64>,
    burst: Option<f64>,
    /// Whether each way's best settings are searched for here: on the four networks as they are,
    /// and on the worst one with jitter and bursts.
    search: bool,
}

/// The paper's four networks, and then each of them with jitter and, if it loses anything, with
/// bursts; the short form has only the worst one with them.
fn paths(quick: bool) -> Vec<Path> {
    let mut all = Vec::new();
    let networks = [Preset::Paper1, Preset::Paper2, Preset::Paper3, Preset::Paper4];
    for preset in networks {
        let worst = preset == Preset::Paper1;
        let (jitter, burst) = (worst.then_some(0.0), worst.then_some(1.0));
        let (name, link) = (preset.name().into(), LinkConfig::preset(preset));
        let loss = Some(match link.loss {
            Loss::Random(lost) => 100.0 * lost,
            _ => 0.0,
        });
        all.push(Path { name, link, loss, jitter, burst, search: true });
    }
    for preset in networks.into_iter().filter(|preset| !quick || *preset == Preset::Paper1) {
        let worst = preset == Preset::Paper1;
        for ms in JITTERS {
            let link = LinkConfig { jitter: Duration::from_millis(ms), ..LinkConfig::preset(preset) };
            let name = format!("{}, jitter {ms} ms", preset.name());
            let jitter = worst.then_some(ms as f64);
            all.push(Path { name, link, loss: None, jitter, burst: None, search: worst });
        }
        let Loss::Random(lost) = LinkConfig::preset(preset).loss else { continue };
        for mean in BURSTS {
            let loss = Loss::gilbert(lost, mean, Duration::from_secs_f64(STEP));
            let link = LinkConfig { loss, ..LinkConfig::preset(preset) };
            let name = format!("{}, bursts of {mean:.0}", preset.name());
            let burst = worst.then_some(mean);
            all.push(Path { name, link, loss: None, jitter: None, burst, search: worst });
        }
    }
    all
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
    made.use_the_papers_integrator();
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

/// The least and the largest error of the shape, % of the motion, with the seed of the experiment
/// and the next ones, `seeds` in all.
fn spread(
    scheme: &RepairScheme,
    made: &Experiment,
    first: &Metrics,
    seeds: u64,
) -> Result<[f64; 2], LabError> {
    let mut both = [first.rms_of_motion_percent; 2];
    for more in 1..seeds {
        let made = Experiment { seed: made.seed + more, ..made.clone() };
        let error = run(scheme, &made)?.rms_of_motion_percent;
        both = [both[0].min(error), both[1].max(error)];
    }
    Ok(both)
}

const COLUMNS: &str = "| network | repair | playout ticks, repeats | rms % | rms / rms of the motion % | largest % | ticks missing | force, rms / rms of the force % | without tremor: rms / rms of the motion % | without tremor: force % | shown delay ms | kbit/s | processor us a tick | rms / rms of the motion of several seeds, least % | most % |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n";

fn row(
    out: &mut String,
    path: &str,
    scheme: &RepairScheme,
    (delay, repeats): (u8, u8),
    f: &Metrics,
    calm: &Metrics,
    [least, most]: [f64; 2],
) {
    let settings = match scheme.between_peers {
        Some(_) => format!("0, {repeats}"),
        None => format!("{delay}, {repeats}"),
    };
    // Writing to a string cannot fail.
    let _ = writeln!(
        out,
        "| {path} | {} | {settings} | {:.4} | {:.4} | {:.2} | {} | {:.4} | {:.4} | {:.4} | {:.0} | {:.1} | {:.1} | {least:.4} | {most:.4} |",
        scheme.name,
        f.rms_percent,
        f.rms_of_motion_percent,
        f.max_percent,
        f.missing,
        f.force_rms_of_force_percent,
        calm.rms_of_motion_percent,
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
    let (seconds, seeds) = if quick { (20.0, 2) } else { (60.0, 6) };
    let (schemes, paths) = (schemes(), paths(quick));
    let (mut equal, mut best) = (COLUMNS.to_owned(), COLUMNS.to_owned());
    let mut points = vec![[const { Vec::new() }; 4]; schemes.len()];
    let without_tremor = |mut made: Experiment| {
        made.hands.iter_mut().for_each(|hand| hand.tremor = 0.0);
        made
    };
    let (delays, repeats): (&[u8], &[u8]) =
        if quick { (&[1, 4], &[3]) } else { (&[0, 1, 2, 4], &[0, 1, 3, 7]) };
    for (done, Path { name: path, link, loss, jitter, burst, search }) in paths.iter().enumerate() {
        for (index, scheme) in schemes.iter().enumerate() {
            progress.report(
                "network",
                (done * schemes.len() + index) as f64 / (paths.len() * schemes.len()) as f64,
            );
            let made = |settings| experiment(&model, scheme, link, settings, seconds);
            let measured = |out: &mut String, settings| -> Result<Metrics, LabError> {
                let f = timed(scheme, made(settings))?;
                let calm = run(scheme, &without_tremor(made(settings)))?;
                let spread = spread(scheme, &made(settings), &f, seeds)?;
                row(out, path, scheme, settings, &f, &calm, spread);
                Ok(f)
            };
            let f = measured(&mut equal, EQUAL)?;
            let error = f.rms_of_motion_percent.max(1e-5);
            let at = [*loss, loss.map(|_| f.cpu_us_per_tick), *jitter, *burst];
            for (points, x) in points[index].iter_mut().zip(at) {
                points.extend(x.map(|x| (x, error)));
            }
            if !search {
                continue;
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
            measured(&mut best, least.1)?;
        }
    }
    let text = format!(
        "All ways with a playout delay of {} tick and {} repeats (peers have no playout delay):\n\n{equal}\n\
         Each way with the playout delay ({}) and the repeats ({}) that give it the smallest error of the shape over this network, smaller ones where that costs less than a hundredth. They were searched for on the paper's networks, and on the worst one with jitter and bursts:\n\n{best}\n\
         *rms* and *largest* are shares of the largest displacement, *rms / rms of the motion* is the error as a share of the rms of the true displacement, and so for the force. The true shape has all modes, and shapes are compared at some 48 vertices of the surface. A tick that is not shown in time counts with the picture and the forces that are shown instead, and a force that is not shown counts as zero. The hands have a tremor of 9.3 and 11.7 Hz, which nothing can predict; two columns are without it. The *shown delay* is from the host's step to the showing of its tick. Peers show their own step at once, before they know all targets, and are compared with what all agree on under rollback; so is compensation, which leaves each peer with a state of its own. `none` and the paper's policies stream accelerations, with average acceleration at both ends as in the paper. Jitter is an extra delay with an exponential distribution of this mean, and may change the order. Bursts are those of a Gilbert-Elliott path that loses as much as the network does; the last network loses nothing and has none. Each run is {seconds:.0} s of a session of two hands at the host, between peers one at each. The last two columns are of {seeds} seeds of the network, the first of which is that of all other columns.\n",
        EQUAL.0,
        EQUAL.1,
        list(delays),
        list(repeats),
    );
    let words = "Each line is a way of repair, over the loss of the paper's four networks, whose round trips differ, too (196, 120, 60 and 20 ms from the worst to the best). All have the same playout delay of one tick and the same three repeats, but peers have no playout delay. The table has what each sends.";
    let time = "The figure shows the same error over the processor time of a tick at the receiver, with a point for each network. The time includes decoding, correcting and stepping 60 modes, and between peers also the peer's own hands. It is the time of the thread itself on one core, the shortest of three runs. Differences below a fifth mean nothing.";
    let jitter = "The figure shows the paper's worst network (9 % loss, 196 ms) without jitter, and with an extra delay of exponential distribution whose mean is 10 and 30 ms. All have the same playout delay and repeats.";
    let burst = "The figure shows the same network by the mean length of a burst: 1 is random loss, and 4 and 12 are bursts of a Gilbert-Elliott path. The loss is 9 % in all cases.";
    let figures = [
        ("f-network", "loss on the paper's four networks", "loss, %", Axes::LogarithmicError, words),
        (
            "f-network-time",
            "the paper's four networks: time",
            "processor time of a tick, us",
            Axes::Logarithmic,
            time,
        ),
        ("f-network-jitter", "jitter", "jitter, ms", Axes::LogarithmicError, jitter),
        ("f-network-bursts", "bursts", "mean length of a burst, ticks", Axes::Logarithmic, burst),
    ];
    let figures = figures.into_iter().enumerate().map(|(which, (file, title, x, axes, words))| Figure {
        file: file.into(),
        title: format!("Ways of repair: {title}"),
        x: x.into(),
        y: "shown error, rms, % of the rms of the motion".into(),
        axes,
        series: schemes
            .iter()
            .zip(&points)
            .map(|(scheme, p)| {
                let series = Series::new(scheme.name, p[which].clone());
                // The times of a way hardly differ from network to network.
                if file == "f-network-time" { series.scattered() } else { series }
            })
            .collect(),
        reference_error: None,
        words: words.into(),
        below: None,
    });
    Ok((figures.collect(), text))
}

fn list(values: &[u8]) -> String {
    values.iter().map(u8::to_string).collect::<Vec<_>>().join(", ")
}
