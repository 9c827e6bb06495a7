//! The paper's figures 6 to 9: shape and force at a hand over networks and under scheduled losses.

use std::{fmt::Write, sync::Arc, time::Duration};

use pliant_modal::ModalModel;
use pliant_stream::{
    Predict, RecoveryConfig,
    emulator::{LinkConfig, Loss, Preset},
    wire::AccelerationCoding,
};

use super::{
    plot::{Axes, Figure, Series},
    tables::body,
};
use crate::{
    LabError,
    experiment::{Experiment, Metrics, TrackPoint},
};

/// The paper's step, s.
const STEP: f64 = 0.025;
/// Ticks after which the paper's figures answer a NACK, and over which they take an error out.
const LATE: u16 = 50;
/// Values beyond this share of the largest true value are drawn at it, %.
const DRAWN: f64 = 150.0;

/// What is alike in all of these figures, and what the default has and the paper's ways do not.
const ALIKE: &str = "The body has linear elasticity, and the hands have no tremor. The paper's ways have no repeats and no playout delay here, as in the paper. The default repeats each tick in the next three frames and shows it one tick later. A tick that is lost alone therefore arrives in time.";

/// A figure of the paper: its number, its title and its lines.
struct Course {
    number: u8,
    title: &'static str,
    lines: Vec<(String, Metrics)>,
    /// What is the same as in the paper, and what is not.
    words: &'static str,
}

/// The losses of the paper's figures 8 and 9.
fn losses() -> [(&'static str, Vec<u64>); 3] {
    let mut random: Vec<u64> = (0..22u64).map(|k| 135 + (k * 7919 + 31) % 311).collect();
    random.sort_unstable();
    [
        ("22 lost at random from tick 135", random),
        ("12 lost in a row from tick 140", (140..152).collect()),
        ("one in 50 lost from tick 135, 11 in all", (0..11).map(|k| 135 + 50 * k).collect()),
    ]
}

fn listed(lost: &[u64]) -> LinkConfig {
    let (delay, loss) = (Duration::from_millis(10), Loss::Listed(lost.to_vec()));
    LinkConfig { delay, loss, ..LinkConfig::default() }
}

/// Runs a policy. A stream of accelerations has the paper's integrator at both ends and plain
/// numbers. NACKs are answered `late` ticks later.
fn run(
    model: &Arc<ModalModel>,
    link: LinkConfig,
    mut recovery: RecoveryConfig,
    late: u16,
) -> Result<Metrics, LabError> {
    recovery.coding = AccelerationCoding::F64;
    let mut e = Experiment::new(model.clone(), link, recovery);
    e.use_the_papers_integrator();
    e.resend_after = Duration::from_secs_f64(f64::from(late) * STEP);
    (e.seconds, e.keep_track) = (18.5, true);
    e.hands.iter_mut().for_each(|h| h.tremor = 0.0);
    Ok(e.run()?)
}

/// The paper's figures 6 to 9.
pub(super) fn courses() -> Result<Vec<Figure>, LabError> {
    let model = body()?;
    let run = |link: LinkConfig, recovery, late| run(&model, link, recovery, late);
    let paper = RecoveryConfig::paper();
    let mut networks = Vec::new();
    for (preset, name) in [
        (Preset::Paper1, "9 % lost, 2 Mb/s, 196 ms"),
        (Preset::Paper2, "6 % lost, 4 Mb/s, 120 ms"),
        (Preset::Paper3, "3 % lost, 10 Mb/s, 60 ms"),
        (Preset::Paper4, "0 % lost, 100 Mb/s, 20 ms"),
    ] {
        networks.push((format!("paper, {name}"), run(LinkConfig::preset(preset), paper, 0)?));
    }
    let worst = LinkConfig::preset(Preset::Paper1);
    networks.push(("default, 9 % lost, 2 Mb/s, 196 ms".into(), run(worst, RecoveryConfig::default(), 0)?));
    let [(_, random), ..] = losses();
    let mut prediction = Vec::new();
    let uncompensated = RecoveryConfig { nack: false, ..paper };
    for (name, recovery) in [
        ("predicted and compensated", paper),
        ("predicted, not compensated", uncompensated),
        ("not predicted, compensated", RecoveryConfig::paper_with(Predict::Zero, LATE)),
        ("not predicted, not compensated", RecoveryConfig::none()),
        ("default", RecoveryConfig::default()),
    ] {
        prediction.push((name.to_owned(), run(listed(&random), recovery, LATE)?));
    }
    let mut compensation = Vec::new();
    for (name, recovery) in [
        ("compensated in 50 steps", paper),
        ("compensated in 1 step", RecoveryConfig::paper_with(Predict::Linear, 1)),
        ("default", RecoveryConfig::default()),
    ] {
        compensation
            .push((format!("{name}, answered 50 ticks later"), run(listed(&random), recovery, LATE)?));
        compensation.push((format!("{name}, answered at once"), run(listed(&random), recovery, 0)?));
    }
    let mut kinds = Vec::new();
    for (name, lost) in losses() {
        kinds.push((format!("paper, {name}"), run(listed(&lost), paper, LATE)?));
        kinds.push((format!("default, {name}"), run(listed(&lost), RecoveryConfig::default(), LATE)?));
    }
    let all = [
        Course {
            number: 6,
            title: "the four networks",
            lines: networks,
            words: "The losses and bandwidths of the four networks are those of the paper, and so is the round trip of the first. The paper gives the other three round trips only in a figure, so 120, 60 and 20 ms are assumed. Our networks are emulated. NACKs are answered at once.",
        },
        Course {
            number: 7,
            title: "with and without prediction and compensation",
            lines: prediction,
            words: "Lost accelerations are predicted by the paper's line through the last two, or counted as zero, and are compensated over 50 ticks when they arrive, or never. The losses are the 22 at random of figure 8.",
        },
        Course {
            number: 8,
            title: "compensation in 1 and in 50 steps",
            lines: compensation,
            words: "The paper's case: 22 ticks are lost at random from tick 135, and are compensated in 1 or in 50 steps, about 50 ticks later. The ticks themselves are ours, as the paper does not list them. The lines that are answered at once are not in the paper.",
        },
        Course {
            number: 9,
            title: "random, burst and pattern",
            lines: kinds,
            words: "The paper's three cases: 22 ticks lost at random from tick 135, 12 in a row from tick 140, and one in 50 from tick 135, 11 in all. They are compensated in 50 steps, 50 ticks later.",
        },
    ];
    Ok(all.iter().flat_map(|course| [figure(course, false), figure(course, true)]).collect())
}

/// A figure of the displacement at the hand, or of its force: what was shown, and below it what was
/// shown less the true value.
fn figure(course: &Course, force: bool) -> Figure {
    let pair = |t: &TrackPoint| if force { t.reaction } else { t.displacement };
    let largest = course.lines.iter().flat_map(|(_, f)| &f.track).map(|t| pair(t)[0].abs());
    let largest = largest.fold(1e-12, f64::max);
    let share = |value: f64| (100.0 * value / largest).clamp(-DRAWN, DRAWN);
    let real = |t: &TrackPoint| share(pair(t)[0]);
    let shown = |t: &TrackPoint| share(pair(t)[1]);
    let off = |t: &TrackPoint| 100.0 * (pair(t)[1] - pair(t)[0]) / largest;
    // The hands move by the host's clock, and a guest joins later where the path is longer.
    let first = course.lines.iter().filter_map(|(_, f)| Some(f.track.first()?.tick)).min().unwrap_or(0);
    let points = |f: &Metrics, value: &dyn Fn(&TrackPoint) -> f64| {
        f.track.iter().map(|t| ((t.tick - first) as f64, value(t))).collect::<Vec<_>>()
    };
    // All of the paper's hosts move alike, so that one true line stands for all: the one that
    // begins first. The default's host has another integrator.
    let earliest = course
        .lines
        .iter()
        .min_by_key(|(name, f)| (name.starts_with("default"), f.track.first().map_or(u64::MAX, |t| t.tick)));
    let truth = earliest.map(|(_, f)| Series::new("true", points(f, &real)).broad());
    let lines = |of: &dyn Fn(&TrackPoint) -> f64| {
        course.lines.iter().map(|(name, f)| Series::new(name.clone(), points(f, of))).collect::<Vec<_>>()
    };
    let what = if force { "force" } else { "shape" };
    let mut words = format!("{} {ALIKE} ", course.words);
    if force {
        words.push_str("The figure shows the force on the first hand along its largest reach, and below it, for each line with its own scale, what was shown less what was true. Lines that hide each other above agree. *True* is of the paper's host; that of the default has the exact step and moves a little otherwise, and each line is compared with its own host.");
    } else {
        words.push_str("The figure shows the displacement at the first hand along its largest reach, and below it, for each line with its own scale, what was shown less what was true. Lines that hide each other above agree. *True* is of the paper's host; that of the default has the exact step and moves a little otherwise, and each line is compared with its own host. What is not as in the paper: the body (a bar of 60 modes), the paths of the hands (two that circle slowly), and the frames (plain numbers, but in our datagrams). *Anywhere* is at some 48 vertices of the surface.\n\n| line | largest error of the shape at the hand % | anywhere % | at the end % | shape, rms / rms of the motion % | largest error of the force at the hand % | force, rms / rms of the force % |\n| --- | --- | --- | --- | --- | --- | --- |\n");
        for (name, f) in &course.lines {
            // By the largest true value of all lines, as in the plots.
            let most = |of: &dyn Fn(&TrackPoint) -> [f64; 2]| {
                let all = course.lines.iter().flat_map(|(_, f)| &f.track).map(of);
                let scale = all.fold(1e-12, |m: f64, p| m.max(p[0].abs()));
                100.0 * f.track.iter().map(of).fold(0.0, |m: f64, p| m.max((p[1] - p[0]).abs())) / scale
            };
            // Writing to a string cannot fail.
            let _ = writeln!(
                words,
                "| {name} | {:.3} | {:.3} | {:.1e} | {:.4} | {:.3} | {:.4} |",
                most(&|t| t.displacement),
                f.max_percent,
                f.end_percent,
                f.rms_of_motion_percent,
                most(&|t| t.reaction),
                f.force_rms_of_force_percent,
            );
        }
    }
    if course.lines.iter().flat_map(|(_, f)| &f.track).any(|t| shown(t).abs() >= DRAWN) {
        let _ = write!(words, "\n\nAbove, values beyond {DRAWN:.0} % are drawn at {DRAWN:.0} %.");
    }
    let unit = format!("% of the largest {}", if force { "force" } else { "displacement" });
    let drawn = |file: String, title: String, y: &str, series| Figure {
        file,
        title,
        x: "tick".into(),
        y: format!("{y}, {unit}"),
        axes: Axes::Linear,
        series,
        reference_error: None,
        words: String::new(),
        below: None,
    };
    let file = format!("paper-{}-{what}", course.number);
    let title = format!("Paper's figure {}, {what}: {}", course.number, course.title);
    let error = drawn(
        format!("{file}-error"),
        format!("What was shown less what was true, {unit}, each with its own scale"),
        "shown - true",
        lines(&off),
    );
    let series = truth.into_iter().chain(lines(&shown)).collect();
    Figure { words, below: Some(Box::new(error)), ..drawn(file, title, "shown at the hand", series) }
}
