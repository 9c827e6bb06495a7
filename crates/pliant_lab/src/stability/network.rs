//! Sessions over bad networks in virtual time: the default recovery must stay within its bounds.
//! The results of the paper's recovery and of none stand beside it, with the default's repeats and
//! playout delay and the paper's integrator. They have no bound.

use std::time::Duration;

use pliant_stream::{
    RecoveryConfig,
    emulator::{LinkConfig, Loss, Preset},
    peer::LateInputRepair,
};

use super::{Bound, Case, CaseOutcome, Expected, bodies::BarBody};
use crate::LabError;
use crate::experiment::{Experiment, Metrics};

/// One tick at 40 Hz.
const TICK: Duration = Duration::from_millis(25);

const RMS: &str = "shown error, rms, % of the largest displacement";
const LARGEST: &str = "shown error, largest, % of the largest displacement";
const TICKS: &str = "ticks missing";

const SILENT: &str = "the line says nothing for longer than a guest goes on by guessing (`GuestSessionConfig::stall_after`): then the picture stands still until the next frame, and is as far off as the hands have gone meanwhile";

/// Name of the group.
pub(super) const GROUP: &str = "network";

pub(super) fn cases(out: &mut Vec<Case>) {
    // The design allows 0.2 and 3 % on the paper's first network.
    for preset in Preset::ALL {
        let name = format!("{}, 30 s at 40 Hz", preset.name());
        let max = if preset == Preset::Satellite { 2.0 } else { 1.0 };
        out.push(Case::new(GROUP, name, move || guest(&LinkConfig::preset(preset), 40.0, 0.05, max)));
    }
    let on_first = |loss: Loss| LinkConfig { loss, ..LinkConfig::preset(Preset::Paper1) };
    let losses = [
        ("12 in a row", on_first(Loss::Burst { first: 140, count: 12 }), 0.2, 5.0),
        ("40 in a row", on_first(Loss::Burst { first: 140, count: 40 }), 1.0, 25.0),
        ("one in 50", on_first(Loss::Every { first: 135, every: 50 }), 0.005, 0.05),
        ("9 % in bursts of 4", on_first(Loss::gilbert(0.09, 4.0, TICK)), 0.2, 4.0),
        ("9 % in bursts of 12", on_first(Loss::gilbert(0.09, 12.0, TICK)), 2.0, 20.0),
        ("30 % at random", on_first(Loss::Random(0.3)), 0.1, 1.0),
    ];
    for (name, link, rms, max) in losses {
        let case = Case::new(GROUP, format!("{name}, 196 ms"), move || guest(&link, 40.0, rms, max));
        out.push(match name {
            "40 in a row" => case.limited(
                SILENT,
                Expected::Measured(&[(RMS, 1.18, 1.32), (LARGEST, 38.0, 42.5), (TICKS, 18.0, 20.0)]),
            ),
            "9 % in bursts of 12" => {
                case.limited(SILENT, Expected::Measured(&[(LARGEST, 30.0, 33.5), (TICKS, 15.0, 17.0)]))
            }
            _ => case,
        });
    }
    for rate in [120.0, 1000.0] {
        let name = format!("paper-1, 10 s at {rate} Hz");
        out.push(Case::new(GROUP, name, move || guest(&LinkConfig::preset(Preset::Paper1), rate, 0.01, 0.2)));
    }
    for preset in [Preset::Paper1, Preset::Paper4, Preset::Wifi] {
        let name = format!("{}, peers that step again", preset.name());
        out.push(Case::new(GROUP, name, move || peers(&LinkConfig::preset(preset))));
    }
}

fn experiment(link: &LinkConfig, rate: f64, recovery: RecoveryConfig) -> Result<Experiment, LabError> {
    let model = BarBody { modes: 30, zeta: 0.05, ..BarBody::default() }.bake()?;
    let mut experiment = Experiment::new(model, link.clone(), recovery);
    experiment.rate = rate;
    experiment.seconds = if rate > 40.0 { 10.0 } else { 30.0 };
    Ok(experiment)
}

fn guest(link: &LinkConfig, rate: f64, rms: f64, max: f64) -> Result<CaseOutcome, LabError> {
    let made = experiment(link, rate, RecoveryConfig::default())?;
    let ticks = made.rate * made.seconds;
    let ours = made.run()?;
    // What differs is the repair, and not how often a frame is sent and how late it is shown.
    let RecoveryConfig { repeats, playout, .. } = RecoveryConfig::default();
    let beside = |recovery: RecoveryConfig| {
        let mut made = experiment(link, rate, RecoveryConfig { repeats, playout, ..recovery })?;
        made.use_the_papers_integrator();
        made.run().map_err(LabError::from)
    };
    let paper = beside(RecoveryConfig::paper())?;
    let bare = beside(RecoveryConfig::none())?;
    Ok(CaseOutcome::of(vec![
        Bound::new(RMS, ours.rms_percent, rms),
        Bound::new(LARGEST, ours.max_percent, max),
        // Counts the ticks that were not shown in time, or all ticks if nothing was shown at all.
        // Two may fall on the edges of the measured time.
        Bound::new(TICKS, missing(&ours, ticks), 2.0),
        // The reaction must be about as smooth as without loss, or within the bound of every
        // dragged body here.
        Bound::new("ringing of the reaction", ours.force_ringing, (1.2 * ours.true_ringing).max(0.1)),
    ])
    .beside(format!("{}; without repair {}", words(&paper), words(&bare))))
}

/// Number of ticks that were shown late or never.
fn missing(f: &Metrics, ticks: f64) -> f64 {
    (f.missing as f64).max(ticks - f.ticks as f64)
}

fn words(f: &Metrics) -> String {
    format!("rms {:.3} %, largest {:.1} %", f.rms_percent, f.max_percent)
}

fn peers(link: &LinkConfig) -> Result<CaseOutcome, LabError> {
    let f = experiment(link, 40.0, RecoveryConfig::default())?.run_peers(LateInputRepair::Rollback)?;
    Ok(CaseOutcome::of(vec![
        Bound::new(RMS, f.rms_percent, 0.25),
        // A peer with steps of 25 ms that wakes every 5 ms is on time or one wake-up late.
        Bound::new("ticks missing of 1,200", missing(&f, 1200.0), 12.0),
    ]))
}
