//! `pliant stability`: a matrix of stiff, extreme and unfair cases, each with the bound that it has to keep and the margin that it keeps it by.
//!
//! A bound is a number measured against a limit. The margin is `limit / measured` of the tightest bound of a case, cut at a million million: 1 just
//! holds, 10 holds ten times over. Where hands pull, the paper's plain scheme ([`plain`]) runs through the same script, and what it did stands beside.

mod bodies;
mod device;
mod hands;
mod inputs;
mod material;
mod motion;
mod network;
mod plain;

use std::{fmt::Write, time::Instant};

use clap::Args;
use rayon::prelude::*;
use serde::Serialize;

use crate::{CliError, output, progress::Bar};

#[derive(Args, Debug)]
pub(crate) struct StabilityArgs {
    /// Only cases whose group or name holds this text
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
    /// One case in eight, for the tests of the project: seconds
    #[arg(long)]
    short: bool,
    /// Threads to use [default: one a core]
    #[arg(long)]
    threads: Option<usize>,
    /// Prints one line of JSON
    #[arg(long)]
    json: bool,
}

/// A number that must stay at or below a limit.
#[derive(Serialize, Debug, Clone, Copy)]
struct Bound {
    what: &'static str,
    measured: f64,
    limit: f64,
}

impl Bound {
    fn new(what: &'static str, measured: f64, limit: f64) -> Self {
        Self { what, measured: measured.abs(), limit }
    }

    /// `limit / measured`; 0 for what is not finite.
    fn margin(&self) -> f64 {
        const MOST: f64 = 1e12;
        if !self.measured.is_finite() {
            0.0
        } else if self.measured * MOST <= self.limit {
            MOST
        } else {
            self.limit / self.measured
        }
    }

    fn text(&self) -> String {
        format!("{} {:.3e} <= {:.3e}", self.what, self.measured, self.limit)
    }
}

/// What a case came to.
#[derive(Debug, Default)]
struct Outcome {
    bounds: Vec<Bound>,
    /// What the paper's plain scheme did with the same script.
    plain: Option<String>,
}

impl Outcome {
    fn of(bounds: Vec<Bound>) -> Self {
        Self { bounds, plain: None }
    }
}

/// One case of the matrix.
struct Case {
    group: &'static str,
    name: String,
    /// Why it does not keep its bound, where that is known and lies in the method.
    known_limit: Option<&'static str>,
    run: Box<dyn Fn() -> Result<Outcome, CliError> + Send + Sync>,
}

impl Case {
    fn new(
        group: &'static str,
        name: String,
        run: impl Fn() -> Result<Outcome, CliError> + Send + Sync + 'static,
    ) -> Self {
        Self { group, name, known_limit: None, run: Box::new(run) }
    }
}

/// A case as it is told.
#[derive(Serialize, Debug)]
struct Told {
    name: String,
    group: &'static str,
    passed: bool,
    margin: f64,
    /// The tightest of the bounds.
    bound: String,
    bounds: Vec<Bound>,
    known_limit: Option<&'static str>,
    plain: Option<String>,
    seconds: f64,
}

#[derive(Serialize, Debug)]
struct Report {
    cases: Vec<Told>,
    seconds: f64,
}

/// All cases, in the order in which they are told.
fn all() -> Vec<Case> {
    let mut cases = Vec::new();
    material::cases(&mut cases);
    motion::cases(&mut cases);
    hands::cases(&mut cases);
    inputs::cases(&mut cases);
    network::cases(&mut cases);
    device::cases(&mut cases);
    cases
}

pub(crate) fn run(args: &StabilityArgs) -> Result<(), CliError> {
    let began = Instant::now();
    let wanted = |case: &Case| {
        args.only
            .as_ref()
            .is_none_or(|text| case.group.contains(text.as_str()) || case.name.contains(text.as_str()))
    };
    let chosen: Vec<Case> = all()
        .into_iter()
        .enumerate()
        .filter(|(index, case)| wanted(case) && (!args.short || index % 8 == 0))
        .map(|(_, case)| case)
        .collect();
    if chosen.is_empty() {
        let got = args.only.clone().unwrap_or_default();
        let expected = "a text that the name or the group of a case holds".to_owned();
        return Err(CliError::Unknown { what: "--only", got, expected });
    }
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(args.threads.unwrap_or(0).min(64))
        .build()
        .map_err(|_| CliError::Threads { got: args.threads.unwrap_or(0), most: 64 })?;
    let bar = std::sync::Mutex::new((Bar::new(), 0usize));
    let told: Vec<Told> = pool.install(|| {
        chosen
            .par_iter()
            // One case at a time is handed out: they differ a thousandfold in length.
            .with_max_len(1)
            .map(|case| {
                let told = tell(case);
                if let Ok(mut bar) = bar.lock() {
                    bar.1 += 1;
                    let share = bar.1 as f64 / chosen.len() as f64;
                    bar.0.report("stability", share);
                }
                told
            })
            .collect()
    });
    drop(bar);
    let broken = told.iter().filter(|t| !t.passed && t.known_limit.is_none()).count();
    let report = Report { cases: told, seconds: began.elapsed().as_secs_f64() };
    if args.json {
        output::print_json(&report)?
    } else {
        output::print(&table(&report))?
    }
    if broken > 0 { Err(CliError::Unstable { broken, of: report.cases.len() }) } else { Ok(()) }
}

fn tell(case: &Case) -> Told {
    let began = Instant::now();
    let (margin, bound, bounds, plain) = match (case.run)() {
        Ok(outcome) => {
            let tightest = outcome.bounds.iter().min_by(|a, b| a.margin().total_cmp(&b.margin()));
            let margin = tightest.map_or(0.0, Bound::margin);
            let text = tightest.map_or_else(|| "nothing measured".to_owned(), Bound::text);
            (margin, text, outcome.bounds, outcome.plain)
        }
        Err(error) => (0.0, error.to_string(), Vec::new(), None),
    };
    let passed = margin >= 1.0;
    Told {
        name: case.name.clone(),
        group: case.group,
        passed,
        margin,
        bound,
        bounds,
        known_limit: if passed { None } else { case.known_limit },
        plain,
        seconds: began.elapsed().as_secs_f64(),
    }
}

fn table(report: &Report) -> String {
    let mut text = String::new();
    let mut group = "";
    for case in &report.cases {
        // Writing to a string cannot fail.
        if case.group != group {
            group = case.group;
            let _ = writeln!(text, "{group}");
        }
        let verdict = match (case.passed, case.known_limit) {
            (true, _) => "ok",
            (false, Some(_)) => "limit",
            (false, None) => "FAILS",
        };
        let margin = if case.margin >= 1e6 { "> 1e6".to_owned() } else { format!("{:.3}", case.margin) };
        let _ = writeln!(text, "  {verdict:<6} {margin:>10}  {:<58} {}", case.name, case.bound);
        if let Some(why) = case.known_limit {
            let _ = writeln!(text, "                     known limit: {why}");
        }
        if let Some(plain) = &case.plain {
            let _ = writeln!(text, "                     the paper's plain scheme: {plain}");
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_margin_says_how_far_below_its_limit_a_number_is() {
        assert_eq!(Bound::new("x", 0.5, 1.0).margin(), 2.0);
        assert_eq!(Bound::new("x", -2.0, 1.0).margin(), 0.5);
        assert_eq!(Bound::new("x", f64::NAN, 1.0).margin(), 0.0);
        assert_eq!(Bound::new("x", f64::INFINITY, 1.0).margin(), 0.0);
        assert_eq!(Bound::new("x", 0.0, 1.0).margin(), 1e12);
    }

    #[test]
    fn the_matrix_has_at_least_150_cases_with_names_of_their_own() {
        let cases = all();
        assert!(cases.len() >= 150, "{}", cases.len());
        let mut names: Vec<String> = cases.iter().map(|c| format!("{}: {}", c.group, c.name)).collect();
        names.sort();
        names.windows(2).for_each(|w| assert_ne!(w[0], w[1]));
    }

    #[test]
    fn a_case_that_breaks_its_bound_is_told_so() {
        let broken = Case::new("g", "n".into(), || Ok(Outcome::of(vec![Bound::new("x", 3.0, 1.0)])));
        let told = tell(&broken);
        assert!(!told.passed && (told.margin - 1.0 / 3.0).abs() < 1e-12, "{told:?}");
        let failed = Case::new("g", "n".into(), || Err(CliError::Threads { got: 0, most: 1 }));
        assert!(!tell(&failed).passed);
    }
}
