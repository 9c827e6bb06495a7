//! The command `pliant simulate`: whole sessions under faults, in virtual time.

use std::fmt::Write;

use clap::Args;
use pliant_lab::simulate::{FaultKind, SimulateReport, SimulateSettings, simulate};

use crate::{CliError, output, progress::Bar};

#[derive(Args, Debug)]
pub(crate) struct SimulateArgs {
    /// Number of sessions, one for each seed
    #[arg(long, value_name = "N", default_value_t = 50)]
    seeds: u64,
    /// The first seed. Even seeds are a host with guests, odd ones a mesh of peers
    #[arg(long, value_name = "SEED", default_value_t = 1)]
    from: u64,
    /// Prints one line of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &SimulateArgs) -> Result<(), CliError> {
    let settings =
        SimulateSettings { from: args.from, seeds: args.seeds, kinds: &FaultKind::ALL, memory: None };
    let report = simulate(&settings, &mut Bar::new()).map_err(CliError::from)?;
    if args.json {
        output::print_json(&report)?
    } else {
        output::print(&text(&report))?
    }
    match report.failures.len() {
        0 => Ok(()),
        broken => Err(CliError::Broken { broken, of: report.seeds }),
    }
}

fn text(report: &SimulateReport) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    for failure in &report.failures {
        let _ = writeln!(text, "seed {}: {}", failure.seed, failure.what);
        for fault in &failure.schedule {
            let _ = writeln!(text, "    {fault}");
        }
    }
    let faults: Vec<String> = report.faults.iter().map(|(kind, count)| format!("{kind} {count}")).collect();
    let _ = write!(
        text,
        "{} sessions of {:.0} s, {} ticks; faults that took effect: {}, of {} drawn; largest reaction told over the largest true one \
         {:.3}; {:.1} N of a device at most, which rise by {:.3} of the slew limit at most, in {} periods; {} broke; {:.0} s",
        report.seeds,
        report.virtual_seconds / report.seeds.max(1) as f64,
        report.ticks,
        faults.join(", "),
        report.drawn,
        report.largest_share,
        report.largest_force,
        report.largest_rise,
        report.device_periods,
        report.failures.len(),
        report.seconds
    );
    text
}
