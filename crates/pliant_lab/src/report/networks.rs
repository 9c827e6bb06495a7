//! Figure f: ways of repair over networks, with equal settings and with the best of each.

use std::{fmt::Write, sync::Arc, time::Duration};

use pliant_modal::ModalModel;
use pliant_stream::{
    Playout, Policy, Predict, RecoveryConfig,
    emulator::{LinkConfig, Loss, Preset},
    peer::{LateInputRepair, PeerSessionConfig},
};
use rayon::prelude::*;

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
/// Playout delay, ticks, and repeats of the table in which all ways have the same.
pub(super) const EQUAL: (u8, u8) = (1, 3);
/// The first seed of the search for each way's best settings. What is shown has other seeds, those
/// from [`Experiment::SEED`] on.
const SEARCH_SEED: u64 = 101;

/// A way of repair.
#[derive(Clone, Copy)]
struct RepairScheme {
    name: &'static str,
    recovery: RecoveryConfig,
    between_peers: Option<LateInputRepair>,
    /// Whether its best settings are searched for. Another blend alone is no other way.
    search: bool,
}

impl RepairScheme {
    /// Ticks over which it blends a correction, 0 if it never corrects.
    fn blend(&self) -> u16 {
        match (self.recovery.policy, self.between_peers) {
            (_, Some(_)) => PeerSessionConfig::default().blend_ticks,
            (Policy::Paper { blend_ticks, .. } | Policy::ForceDriven { blend_ticks }, None) => blend_ticks,
            (Policy::None, None) => 0,
        }
    }

    /// The settings that all ways have alike, with its own blend.
    fn equal(&self) -> Settings {
        Settings {
            delay: if self.between_peers.is_some() { 0 } else { EQUAL.0 },
            repeats: EQUAL.1,
            blend: self.blend(),
        }
    }
}

/// What is chosen for a way of repair.
#[derive(Clone, Copy, PartialEq)]
struct Settings {
    /// Playout delay, ticks. Peers have none.
    delay: u8,
    repeats: u8,
    /// Ticks over which a correction is blended.
    blend: u16,
}

/// The ways of repair, without the names that differ from another one only by playout delay and
/// repeats.
fn schemes() -> Vec<RepairScheme> {
    let scheme = |name, recovery| RepairScheme { name, recovery, between_peers: None, search: true };
    let paper = |name, predict| scheme(name, RecoveryConfig::paper_with(predict, 50));
    let in_one = |name, predict| RepairScheme {
        search: false,
        ..scheme(name, RecoveryConfig::paper_with(predict, 1))
    };
    let peers = |name, repair| RepairScheme {
        between_peers: Some(repair),
        ..scheme(name, RecoveryConfig::default())
    };
    vec![
        scheme("default", RecoveryConfig::default()),
        scheme("force-driven", RecoveryConfig::by_name("force-driven").unwrap_or_default()),
        paper("paper", Predict::Linear),
        in_one("paper, 1 step", Predict::Linear),
        paper("paper-zero", Predict::Zero),
        in_one("paper-zero, 1 step", Predict::Zero),
        paper("paper-hold", Predict::Hold),
        in_one("paper-hold, 1 step", Predict::Hold),
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
    /// The figure of the error by playout delay, if it has one.
    by_delay: Option<usize>,
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
        all.push(Path { name, link, loss, jitter, burst, by_delay: worst.then_some(0), search: true });
    }
    for preset in networks.into_iter().filter(|preset| !quick || *preset == Preset::Paper1) {
        let worst = preset == Preset::Paper1;
        for ms in JITTERS {
            let link = LinkConfig { jitter: Duration::from_millis(ms), ..LinkConfig::preset(preset) };
            let name = format!("{}, jitter {ms} ms", preset.name());
            let jitter = worst.then_some(ms as f64);
            all.push(Path { name, link, loss: None, jitter, burst: None, by_delay: None, search: worst });
        }
        let Loss::Random(lost) = LinkConfig::preset(preset).loss else { continue };
        for mean in BURSTS {
            let loss = Loss::gilbert(lost, mean, Duration::from_secs_f64(STEP));
            let link = LinkConfig { loss, ..LinkConfig::preset(preset) };
            let name = format!("{}, bursts of {mean:.0}", preset.name());
            let burst = worst.then_some(mean);
            let by_delay = (burst == Some(BURSTS[0])).then_some(1);
            all.push(Path { name, link, loss: None, jitter: None, burst, by_delay, search: worst });
        }
    }
    all
}

/// A way of repair over a path.
fn experiment(
    model: &Arc<ModalModel>,
    scheme: &RepairScheme,
    link: &LinkConfig,
    Settings { delay, repeats, blend: blend_ticks }: Settings,
    seconds: f64,
) -> Experiment {
    let policy = match scheme.recovery.policy {
        Policy::Paper { predict, .. } => Policy::Paper { predict, blend_ticks },
        Policy::ForceDriven { .. } => Policy::ForceDriven { blend_ticks },
        Policy::None => Policy::None,
    };
    let playout = Playout::Fixed(delay);
    let recovery = RecoveryConfig { policy, playout, repeats, ..scheme.recovery };
    let mut made = Experiment::new(model.clone(), link.clone(), recovery);
    made.peer_repeats = repeats.into();
    made.peer_blend_ticks = blend_ticks;
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

/// Runs experiments on all cores.
fn run_all(scheme: &RepairScheme, all: &[Experiment]) -> Result<Vec<Metrics>, LabError> {
    all.par_iter().map(|made| run(scheme, made)).collect()
}

/// An experiment with as many seeds from `first` on.
fn with_seeds(made: Experiment, first: u64, seeds: u64) -> impl Iterator<Item = Experiment> {
    (first..first + seeds).map(move |seed| Experiment { seed, ..made.clone() })
}

/// Runs an experiment several times for its processor time, on one core. The first run fills the
/// caches, and the shortest of the others is the time of the work itself. All runs give the same
/// metrics. The thread's own clock leaves out other load on the machine.
fn timed(scheme: &RepairScheme, mut made: Experiment) -> Result<Metrics, LabError> {
    let _pinned = Pinned::new();
    made.cpu_clock = Some(machine::thread_time);
    let mut f = run(scheme, &made)?;
    f.cpu_us_per_tick = f64::INFINITY;
    for _ in 0..3 {
        f.cpu_us_per_tick = f.cpu_us_per_tick.min(run(scheme, &made)?.cpu_us_per_tick);
    }
    Ok(f)
}

/// What is tried for each way's best settings.
struct Grid {
    delays: &'static [u8],
    repeats: &'static [u8],
    /// Besides the way's own blend.
    blends: &'static [u16],
    /// Sessions of each setting.
    seeds: u64,
}

impl Grid {
    fn of(quick: bool) -> Self {
        if quick {
            Self { delays: &[1, 16], repeats: &[3], blends: &[1], seeds: 2 }
        } else {
            // The library takes no longer delay than 16 ticks and no more repeats than 7.
            Self { delays: &[0, 1, 2, 4, 8, 12, 16], repeats: &[0, 1, 3, 7], blends: &[1, 6, 50], seeds: 3 }
        }
    }

    /// The settings of a way with the smallest error of the shape in the worst of the search's
    /// sessions, and the smallest such error by playout delay.
    fn search(
        &self,
        scheme: &RepairScheme,
        made: impl Fn(Settings) -> Experiment,
    ) -> Result<(Settings, Vec<(f64, f64)>), LabError> {
        let errors = |tried: &[Settings]| -> Result<Vec<f64>, LabError> {
            let all: Vec<Experiment> =
                tried.iter().flat_map(|s| with_seeds(made(*s), SEARCH_SEED, self.seeds)).collect();
            let all = run_all(scheme, &all)?;
            // What is no number is the worst.
            let error = |f: &Metrics| Some(f.rms_of_motion_percent).filter(|e| e.is_finite());
            let worst =
                |f: &[Metrics]| f.iter().map(|f| error(f).unwrap_or(f64::INFINITY)).fold(0.0, f64::max);
            Ok(all.chunks(self.seeds as usize).map(worst).collect())
        };
        // The first settings that are within a hundredth of the best.
        let best = |tried: &[Settings], errors: &[f64]| {
            let least = errors.iter().copied().fold(f64::INFINITY, f64::min);
            let first = errors.iter().position(|error| *error <= 1.01 * least).unwrap_or(0);
            tried.get(first).copied().unwrap_or(scheme.equal())
        };
        let own = scheme.blend();
        let others = self.blends.iter().copied().filter(|blend| own != 0 && *blend != own);
        let blends: Vec<u16> = std::iter::once(own).chain(others).collect();
        let delays = if scheme.between_peers.is_some() { &[0] } else { self.delays };
        let most = self.repeats.last().copied().unwrap_or(EQUAL.1);
        let with_most: Vec<Settings> = delays
            .iter()
            .flat_map(|&delay| blends.iter().map(move |&blend| Settings { delay, repeats: most, blend }))
            .collect();
        let found = errors(&with_most)?;
        let by_delay = with_most.chunks(blends.len()).zip(found.chunks(blends.len()));
        let by_delay = by_delay
            .map(|(at, all)| (f64::from(at[0].delay), all.iter().copied().fold(f64::INFINITY, f64::min)))
            .collect();
        let chosen = best(&with_most, &found);
        let mut fewer: Vec<Settings> =
            self.repeats.iter().map(|&repeats| Settings { repeats, ..chosen }).collect();
        fewer.push(scheme.equal());
        Ok((best(&fewer, &errors(&fewer)?), by_delay))
    }
}

const COLUMNS: &str = "| network | repair | playout ticks, repeats, blend ticks | rms % | rms / rms of the motion % | largest % | ticks missing | force, rms / rms of the force % | without tremor: rms / rms of the motion % | without tremor: force % | shown delay ms | down kbit/s | up kbit/s | processor us a tick | rms / rms of the motion of several seeds, least % | median % | most % |\n| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |\n";

/// A row of a table.
struct Row {
    /// The first seed, timed.
    first: Metrics,
    without_tremor: Metrics,
    /// A session in which the guest holds the body, for what it sends.
    traffic: Metrics,
    /// Errors of the shape of all seeds, % of the motion, the smallest first.
    errors: Vec<f64>,
}

impl Row {
    fn measure(scheme: &RepairScheme, made: &Experiment, seeds: u64) -> Result<Self, LabError> {
        let first = timed(scheme, made.clone())?;
        let mut calm = made.clone();
        calm.hands.iter_mut().for_each(|hand| hand.tremor = 0.0);
        let mut all = vec![calm, Experiment { guest_hand: true, ..made.clone() }];
        all.extend(with_seeds(made.clone(), made.seed + 1, seeds - 1));
        let mut others = run_all(scheme, &all)?.into_iter();
        let [without_tremor, traffic] = [others.next(), others.next()].map(Option::unwrap_or_default);
        let mut errors = vec![first.rms_of_motion_percent];
        errors.extend(others.map(|f| f.rms_of_motion_percent));
        errors.sort_by(f64::total_cmp);
        Ok(Self { first, without_tremor, traffic, errors })
    }

    /// The mean of the two in the middle, if there is no one.
    fn median(&self) -> f64 {
        let [low, high] = [(self.errors.len() - 1) / 2, self.errors.len() / 2];
        0.5 * (self.errors[low] + self.errors[high])
    }

    fn write(&self, out: &mut String, path: &str, scheme: &RepairScheme, settings: Settings) {
        let Self { first: f, without_tremor: calm, traffic, errors } = self;
        let Settings { delay, repeats, blend } = settings;
        let blend = if blend == 0 { "-".to_owned() } else { blend.to_string() };
        // Writing to a string cannot fail.
        let _ = writeln!(
            out,
            "| {path} | {} | {delay}, {repeats}, {blend} | {:.4} | {:.4} | {:.2} | {} | {:.4} | {:.4} | {:.4} | {:.0} | {:.1} | {:.1} | {:.1} | {:.4} | {:.4} | {:.4} |",
            scheme.name,
            f.rms_percent,
            f.rms_of_motion_percent,
            f.max_percent,
            f.missing,
            f.force_rms_of_force_percent,
            calm.rms_of_motion_percent,
            calm.force_rms_of_force_percent,
            f.visual_delay_ms,
            traffic.kbit_s,
            traffic.kbit_s_up,
            f.cpu_us_per_tick,
            errors[0],
            self.median(),
            errors[errors.len() - 1]
        );
    }
}

/// Every way of repair over every path: with the same playout delay and repeats, and with those
/// that are best for it.
pub(super) fn networks(quick: bool, progress: &mut dyn Progress) -> Result<(Vec<Figure>, String), LabError> {
    let model = body()?;
    let (seconds, seeds) = if quick { (20.0, 2) } else { (60.0, 6) };
    let (schemes, paths, grid) = (schemes(), paths(quick), Grid::of(quick));
    let (mut equal, mut best) = (COLUMNS.to_owned(), COLUMNS.to_owned());
    let mut points = vec![[const { Vec::new() }; 6]; schemes.len()];
    for (done, Path { name: path, link, loss, jitter, burst, by_delay, search }) in paths.iter().enumerate() {
        for (index, scheme) in schemes.iter().enumerate() {
            progress.report(
                "network",
                (done * schemes.len() + index) as f64 / (paths.len() * schemes.len()) as f64,
            );
            let made = |settings| experiment(&model, scheme, link, settings, seconds);
            let row = Row::measure(scheme, &made(scheme.equal()), seeds)?;
            row.write(&mut equal, path, scheme, scheme.equal());
            let at = [*loss, loss.map(|_| row.first.cpu_us_per_tick), *jitter, *burst];
            for (points, x) in points[index].iter_mut().zip(at) {
                points.extend(x.map(|x| (x, row.median().max(1e-5))));
            }
            if !(*search && scheme.search) {
                continue;
            }
            let (chosen, errors) = grid.search(scheme, made)?;
            Row::measure(scheme, &made(chosen), seeds)?.write(&mut best, path, scheme, chosen);
            if let (Some(which), None) = (by_delay, scheme.between_peers) {
                points[index][4 + which] = errors;
            }
        }
    }
    let text = tables(&equal, &best, &grid, seconds, seeds);
    let figures = WORDS.into_iter().enumerate().map(|(which, (file, title, x, axes, words))| Figure {
        file: file.into(),
        title: format!("Ways of repair: {title}"),
        x: x.into(),
        y: "shown error, rms, % of the rms of the motion".into(),
        axes,
        series: schemes
            .iter()
            .zip(&points)
            .filter(|(_, p)| !p[which].is_empty())
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

/// The figures: file, title, axis of x, axes and words.
const WORDS: [(&str, &str, &str, Axes, &str); 6] = [
    (
        "f-network",
        "loss on the paper's four networks",
        "loss, %",
        Axes::LogarithmicError,
        "Each line is a way of repair, over the loss of the paper's four networks, whose round trips differ, too (196, 120, 60 and 20 ms from the worst to the best). All have the same playout delay of one tick and the same three repeats, but peers have no playout delay. A point is the median of several seeds. The table has what each sends.",
    ),
    (
        "f-network-time",
        "the paper's four networks: time",
        "processor time of a tick, us",
        Axes::Logarithmic,
        "The figure shows the same error over the processor time of a tick at the receiver, with a point for each network. The time includes decoding, correcting and stepping 60 modes, and between peers also the peer's own hands. It is the time of the thread itself on one core, the shortest of three runs. Differences below a fifth mean nothing.",
    ),
    (
        "f-network-jitter",
        "jitter",
        "jitter, ms",
        Axes::LogarithmicError,
        "The figure shows the paper's worst network (9 % loss, 196 ms) without jitter, and with an extra delay of exponential distribution whose mean is 10 and 30 ms. All have the same playout delay and repeats.",
    ),
    (
        "f-network-bursts",
        "bursts",
        "mean length of a burst, ticks",
        Axes::Logarithmic,
        "The figure shows the same network by the mean length of a burst: 1 is random loss, and 4 and 12 are bursts of a Gilbert-Elliott path. The loss is 9 % in all cases.",
    ),
    (
        "f-network-delay",
        "playout delay on the paper's worst network",
        "playout delay, ticks",
        Axes::LogarithmicError,
        "What a longer playout delay buys on the paper's worst network: each way with the most repeats that are tried and the blend that is best for it at that delay. A point is the worst of the sessions of the search. Once a tick waits for enough repeats, or for a round trip, what was lost arrives in time, and all ways are right. So the smallest error is at a long delay, and the delay is what it costs.",
    ),
    (
        "f-network-delay-bursts",
        "playout delay under bursts",
        "playout delay, ticks",
        Axes::LogarithmicError,
        "The same with bursts of 4 ticks. Here no delay that the library takes makes all ways right.",
    ),
];

/// The text of both tables.
fn tables(equal: &str, best: &str, grid: &Grid, seconds: f64, seeds: u64) -> String {
    let Grid { delays, repeats, blends, seeds: search_seeds } = grid;
    let last = delays.last().copied().unwrap_or_default();
    format!(
        "All ways with a playout delay of {} tick and {} repeats (peers have no playout delay):\n\n{equal}\n\
         Each way with the playout delay ({}), the repeats ({}) and the blend (its own, {}) that give it the smallest error of the shape over this network, smaller ones where that costs less than a hundredth. The delay and the blend are chosen with the most repeats, and then the repeats. What counts is the worst of {search_seeds} sessions with the seeds from {SEARCH_SEED} on, and what is shown are sessions with others. The search is on the paper's networks, and on the worst one with jitter and bursts, not on the other networks with them. A delay of {last} ticks is the longest that the library takes, and 7 repeats are the most:\n\n{best}\n\
         - *rms* and *largest* are shares of the largest displacement, *rms / rms of the motion* is the error as a share of the rms of the true displacement, and so for the force. The true shape has all modes, and shapes are compared at some 48 vertices of the surface.\n\
         - A tick that is not shown in time counts with the picture and the forces that are shown instead, and a force that is not shown counts as zero.\n\
         - The hands have a tremor of 9.3 and 11.7 Hz, which nothing can predict; two columns are without it.\n\
         - The *shown delay* is from the host's step to the showing of its tick. Peers show their own step at once, before they know all targets: theirs is the age of the newest tick whose targets the second peer knows, from the first peer's step on, which is how late it sees the other's hand right.\n\
         - They are compared with what all agree on under rollback; so is compensation, which leaves each peer with a state of its own.\n\
         - `none` and the paper's policies stream accelerations, with average acceleration at both ends as in the paper. `paper-repeats` is not in the tables: it is `paper` with one tick of delay and three repeats, which the first table gives to all and the second tries among others.\n\
         - Jitter is an extra delay with an exponential distribution of this mean, and may change the order. Bursts are those of a Gilbert-Elliott path that loses as much as the network does; the last network loses nothing and has none. Each run is {seconds:.0} s of a session of two hands at the host, between peers one at each.\n\
         - *Down* and *up* are all datagrams of the session, without those of UDP and QUIC, with the same hands: of two hands, the host or the first peer has one and the guest or the second peer the other. Frames have both hands whoever has them, and what a guest sends is measured in a session in which it holds the body. Peers send only targets, down what the first sends and up what the second sends.\n\
         - The last three columns are of {seeds} seeds of the network, the first of which is that of all other columns.\n",
        EQUAL.0,
        EQUAL.1,
        list(delays),
        list(repeats),
        list(blends),
    )
}

fn list<T: ToString>(values: &[T]) -> String {
    values.iter().map(T::to_string).collect::<Vec<_>>().join(", ")
}
