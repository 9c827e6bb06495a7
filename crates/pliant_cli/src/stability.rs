//! The command `pliant stability`: stiff, extreme and unfair cases, each with its bound and its
//! margin.

use std::{fmt::Write, path::PathBuf};

use clap::Args;
use pliant_lab::stability::{self, StabilityReport, StabilitySettings};

use crate::{CliError, output, progress::Bar};

#[derive(Args, Debug)]
pub(crate) struct StabilityArgs {
    /// Only cases whose group or name contains this text
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
    /// Number of threads [default: one per core]
    #[arg(long)]
    threads: Option<usize>,
    /// Prints one line of JSON
    #[arg(long)]
    json: bool,
    /// Writes the table as a page in Markdown, too
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

pub(crate) fn run(args: &StabilityArgs) -> Result<(), CliError> {
    let settings = StabilitySettings { only: args.only.clone(), threads: args.threads };
    if let Some(path) = &args.output {
        output::check_folder(path)?;
    }
    let report = stability::run(&settings, &mut Bar::new())?;
    if report.cases.is_empty() {
        let got = args.only.clone().unwrap_or_default();
        let expected = "a text that the name or the group of a case holds".to_owned();
        return Err(CliError::Unknown { what: "--only", got, expected });
    }
    if let Some(path) = &args.output {
        std::fs::write(path, report.page())
            .map_err(|source| CliError::Output { path: path.clone(), source })?;
    }
    if args.json {
        output::print_json(&report)?
    } else {
        output::print(&table(&report))?
    }
    match report.broken() {
        0 => Ok(()),
        broken => Err(CliError::Unstable { broken, of: report.cases.len() }),
    }
}

fn table(report: &StabilityReport) -> String {
    let mut text = String::new();
    let mut group = "";
    for case in &report.cases {
        // Writing to a string cannot fail.
        if case.group != group {
            group = case.group;
            let _ = writeln!(text, "{group}");
        }
        let verdict = match (case.passed, case.known_limit) {
            (true, _) if case.limit_gone => "GONE",
            (true, _) => "ok",
            (false, Some(_)) => "limit",
            (false, None) => "FAILS",
        };
        let margin = if case.margin >= 1e6 { "> 1e6".to_owned() } else { format!("{:.3}", case.margin) };
        let _ = writeln!(text, "  {verdict:<6} {margin:>10}  {:<58} {}", case.name, case.bound);
        if let Some(why) = case.known_limit {
            let _ = writeln!(text, "                     known limit: {why}");
        }
        if case.limit_gone {
            let _ = writeln!(
                text,
                "                     was listed as a known limit and passes: the list is out of date"
            );
        }
        if let Some(plain) = &case.plain {
            let _ = writeln!(text, "                     {}: {plain}", case.papers_way());
        }
    }
    let passed = report.cases.iter().filter(|c| c.passed).count();
    let known = report.cases.iter().filter(|c| c.known_limit.is_some()).count();
    let _ = write!(
        text,
        "{passed} of {} cases keep their bounds, {known} are known limits; {:.0} s",
        report.cases.len(),
        report.seconds
    );
    text
}
