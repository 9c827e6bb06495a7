//! The command `pliant stream`: measures a session over an emulated network. The session runs in
//! virtual time, so that the same seed gives the same metrics.

use std::{
    fmt::Write,
    path::PathBuf,
    sync::{Arc, OnceLock},
    time::{Duration, Instant},
};

use clap::{Args, ValueEnum};
use pliant_lab::LabError;
use pliant_lab::experiment::{Experiment, Metrics};
use pliant_modal::{Elasticity, ModalModel, Relaxation};
use pliant_stream::{
    Policy, RecoveryConfig,
    emulator::{LinkConfig, Loss, Preset},
    peer::LateInputRepair,
};
use serde::Serialize;

use crate::arguments::elasticity;
use crate::{CliError, output};

#[derive(Args, Debug)]
#[command(
    after_help = "hand_to_force_ms is measured between peers: the longest time from a position of the own hand to the first step whose force has it. With a repair that the guest's own copy answers (default, force-driven) it is not measured, and has no number: that copy answers at its next step. For the others it is reckoned: half the measured round trip, half a step and the measured delay of showing. visual_delay_ms is the mean time from the host's step to the showing of its tick, and between peers the mean age of the newest tick of which all targets are known."
)]
pub(crate) struct StreamArgs {
    /// The body
    #[arg(long, value_name = "X.modal")]
    model: PathBuf,
    /// A network preset: paper-1 to paper-4, lan, wifi, transatlantic, satellite [default: paper-1]
    #[arg(long, conflicts_with = "loss")]
    network: Option<String>,
    /// A loss model on a path without delay: none, 9%, random:22@135, burst:12@140, every:50@135,
    /// gilbert:9%:4
    #[arg(long)]
    loss: Option<String>,
    /// Answers NACKs this many ticks later, as in the paper's figures
    #[arg(long, default_value_t = 0, value_name = "TICKS")]
    resend_after: u32,
    /// The recovery policy: default, none, paper, paper-zero, paper-hold, paper-repeats,
    /// force-driven. Without this option and without --json: all of them in one table
    #[arg(long)]
    recovery: Option<String>,
    /// Ticks over which the paper's compensation is blended
    #[arg(long, value_name = "TICKS")]
    blend: Option<u16>,
    /// Steps a second
    #[arg(long, default_value_t = 40.0, value_name = "HZ")]
    rate: f64,
    /// Measured time, s
    #[arg(long, default_value_t = 60.0)]
    seconds: f64,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Elasticity of the body: linear or reduced
    #[arg(long, default_value = "linear", value_parser = elasticity)]
    elasticity: Elasticity,
    /// A material that relaxes, such as 0.5:0.4: the share of the stiffness that relaxes, and the
    /// time for it, s
    #[arg(long, value_name = "RATIO:TIME", value_parser = relaxation)]
    relax: Option<Relaxation>,
    /// Who steps the body: only the host, or every peer
    #[arg(long, value_enum, default_value_t = NetTopology::Cs)]
    topology: NetTopology,
    /// Prints one line of JSON
    #[arg(long)]
    json: bool,
}

/// Parses a material such as `0.5:0.4`.
fn relaxation(words: &str) -> Result<Relaxation, String> {
    let expected = "expected RATIO:TIME, such as 0.5:0.4";
    let (ratio, time) = words.split_once(':').ok_or(expected)?;
    let number = |word: &str| word.trim().parse::<f64>().map_err(|_| expected.to_owned());
    let made = Relaxation { ratio: number(ratio)?, time: number(time)? };
    made.check().map_err(|e| e.to_string())?;
    Ok(made)
}

/// Which side steps the body.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
enum NetTopology {
    /// Client-server: guests track the host.
    Cs,
    /// Peer-to-peer: every peer steps, and only targets are sent.
    P2p,
}

/// The metrics of one run.
#[derive(Serialize, Debug)]
struct StreamMetrics {
    /// The policy's name is for the table only. A caller of `--json` has named the policy.
    #[serde(skip)]
    recovery: String,
    ticks: u64,
    lost: u64,
    recovered: u64,
    rms_percent: f64,
    max_percent: f64,
    end_percent: f64,
    force_rms_percent: f64,
    force_ringing: f64,
    hand_to_force_ms: f64,
    visual_delay_ms: f64,
    recover_ms: f64,
    bytes_per_frame: f64,
    kbit_s: f64,
    cpu_us_per_tick: f64,
    hash: String,
}

impl StreamMetrics {
    fn new(recovery: &str, metrics: &Metrics) -> Self {
        Self {
            recovery: recovery.into(),
            ticks: metrics.ticks,
            lost: metrics.lost,
            recovered: metrics.recovered,
            rms_percent: metrics.rms_percent,
            max_percent: metrics.max_percent,
            end_percent: metrics.end_percent,
            force_rms_percent: metrics.force_rms_percent,
            force_ringing: metrics.force_ringing,
            hand_to_force_ms: metrics.hand_to_force_ms,
            visual_delay_ms: metrics.visual_delay_ms,
            recover_ms: metrics.recover_ms,
            bytes_per_frame: metrics.bytes_per_frame,
            kbit_s: metrics.kbit_s,
            cpu_us_per_tick: metrics.cpu_us_per_tick,
            hash: format!("{:016x}", metrics.hash),
        }
    }
}

/// Time since the first call. The experiment itself owns no clock.
fn clock() -> Duration {
    static BEGAN: OnceLock<Instant> = OnceLock::new();
    BEGAN.get_or_init(Instant::now).elapsed()
}

/// Names of the peer-to-peer repairs.
const REPAIRS: [(&str, LateInputRepair); 2] =
    [("rollback", LateInputRepair::Rollback), ("compensate", LateInputRepair::Compensate)];

pub(crate) fn run(args: &StreamArgs) -> Result<(), CliError> {
    let in_range = |what, value: f64, low, high| {
        if (low..=high).contains(&value) {
            Ok(())
        } else {
            Err(CliError::Range { what, low, high, got: value })
        }
    };
    in_range("--rate", args.rate, 1.0, 2_000.0)?;
    in_range("--seconds", args.seconds, 0.1, 36_000.0)?;
    let model = Arc::new(ModalModel::read(&args.model)?);
    if args.elasticity == Elasticity::Reduced && model.material().is_none() {
        return Err(LabError::NoMaterial.into());
    }
    let names: Vec<&str> = match (&args.recovery, args.topology, args.json) {
        (Some(name), ..) => vec![name.as_str()],
        (None, NetTopology::Cs, true) => vec!["default"],
        (None, NetTopology::P2p, true) => vec![REPAIRS[0].0],
        (None, NetTopology::Cs, false) => RecoveryConfig::NAMES.to_vec(),
        (None, NetTopology::P2p, false) => REPAIRS.iter().map(|(name, _)| *name).collect(),
    };
    let measured = names.iter().map(|name| measure(args, &model, name)).collect::<Result<Vec<_>, _>>()?;
    match (args.json, measured.as_slice()) {
        (true, [one]) => output::print_json(one),
        (true, all) => output::print_json(&all),
        (false, all) => output::print(&table(all)),
    }
}

fn measure(args: &StreamArgs, model: &Arc<ModalModel>, name: &str) -> Result<StreamMetrics, CliError> {
    let step = Duration::from_secs_f64(1.0 / args.rate);
    let link = match (&args.loss, &args.network) {
        (Some(words), _) => {
            LinkConfig { loss: Loss::parse(words, args.seed, step)?, ..LinkConfig::default() }
        }
        (None, network) => {
            let network = network.as_deref().unwrap_or("paper-1");
            let preset = Preset::by_name(network).ok_or_else(|| CliError::Unknown {
                what: "--network",
                got: network.into(),
                expected: Preset::ALL.map(Preset::name).join(", "),
            })?;
            LinkConfig::preset(preset)
        }
    };
    let unknown = |expected: String| CliError::Unknown { what: "--recovery", got: name.into(), expected };
    let metrics = match args.topology {
        NetTopology::Cs => {
            let mut recovery =
                RecoveryConfig::by_name(name).ok_or_else(|| unknown(RecoveryConfig::NAMES.join(", ")))?;
            if let (Some(ticks), Policy::Paper { blend_ticks, .. }) = (args.blend, &mut recovery.policy) {
                *blend_ticks = ticks;
            }
            experiment(args, model, link, recovery, step).run()?
        }
        NetTopology::P2p => {
            let repair = REPAIRS.iter().find(|(known, _)| *known == name).map(|(_, repair)| *repair);
            let repair = repair.ok_or_else(|| unknown(REPAIRS.map(|(name, _)| name).join(", ")))?;
            experiment(args, model, link, RecoveryConfig::default(), step).run_peers(repair)?
        }
    };
    Ok(StreamMetrics::new(name, &metrics))
}

fn experiment(
    args: &StreamArgs,
    model: &Arc<ModalModel>,
    link: LinkConfig,
    recovery: RecoveryConfig,
    step: Duration,
) -> Experiment {
    Experiment {
        rate: args.rate,
        seconds: args.seconds,
        seed: args.seed,
        elasticity: args.elasticity,
        resend_after: step * args.resend_after,
        relaxation: args.relax,
        cpu_clock: Some(clock),
        ..Experiment::new(model.clone(), link, recovery)
    }
}

fn table(all: &[StreamMetrics]) -> String {
    let mut text = format!(
        "{:<14} {:>7} {:>6} {:>9} {:>11} {:>11} {:>11} {:>10} {:>8} {:>9} {:>8} {:>8} {:>7}\n",
        "recovery",
        "ticks",
        "lost",
        "recovered",
        "rms %",
        "max %",
        "end %",
        "force %",
        "ringing",
        "hand ms",
        "late ms",
        "kbit/s",
        "cpu us"
    );
    for t in all {
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{:<14} {:>7} {:>6} {:>9} {:>11.4} {:>11.3} {:>11.2e} {:>10.3} {:>8.3} {:>9} {:>8.0} {:>8.1} {:>7.1}",
            t.recovery,
            t.ticks,
            t.lost,
            t.recovered,
            t.rms_percent,
            t.max_percent,
            t.end_percent,
            t.force_rms_percent,
            t.force_ringing,
            if t.hand_to_force_ms.is_nan() { "-".to_owned() } else { format!("{:.0}", t.hand_to_force_ms) },
            t.visual_delay_ms,
            t.kbit_s,
            t.cpu_us_per_tick
        );
    }
    text.push_str(
        "hand ms is measured between peers, not where an own copy answers (-), and else reckoned; late ms is the age of what is shown (see --help)",
    );
    text
}
