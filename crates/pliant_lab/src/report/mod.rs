//! `pliant report`: what the method costs and what it is off by, remade on this machine: tables, CSV, SVG, PNG and the words for them.

mod frames;
mod front;
mod physics;
mod plot;
mod tables;
mod warp;
mod work;

use std::{fmt::Write, path::PathBuf, time::Instant};

use clap::Args;
use serde::Serialize;

use crate::{CliError, machine, output, progress::Bar};
use plot::Figure;

const PARTS: [&str; 13] = [
    "elements",
    "modes",
    "steps",
    "warp",
    "precision",
    "frames",
    "network",
    "front",
    "table-2",
    "table-3",
    "courses",
    "default",
    "all",
];

#[derive(Args, Debug)]
pub(crate) struct ReportArgs {
    /// Only one part: elements, modes, steps, warp, precision, frames, network, front, table-2, table-3, courses, default
    #[arg(long, default_value = "all")]
    only: String,
    /// Fewer points and shorter timings: within ten minutes on two cores
    #[arg(long)]
    quick: bool,
    /// Surfaces that are measured when they are there: bunny.obj, armadillo.obj
    #[arg(long, value_name = "DIR", default_value = "../shared/models")]
    models: PathBuf,
    /// The project's own body: a surface or a scene
    #[arg(long, value_name = "FILE", default_value = "assets/pip.ron")]
    own: PathBuf,
    /// The folder to write
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Prints one line of JSON: the parts, their files and seconds
    #[arg(long)]
    json: bool,
}

#[derive(Serialize, Debug)]
struct Part {
    name: &'static str,
    files: Vec<String>,
    seconds: f64,
}

#[derive(Serialize, Debug)]
struct Told {
    parts: Vec<Part>,
    seconds: f64,
}

pub(crate) fn run(args: &ReportArgs) -> Result<(), CliError> {
    if !PARTS.contains(&args.only.as_str()) {
        return Err(CliError::Unknown { what: "--only", got: args.only.clone(), expected: PARTS.join(", ") });
    }
    std::fs::create_dir_all(&args.output)?;
    let began = Instant::now();
    let mut text = heading();
    let load = machine::load();
    let mut told = Told { parts: Vec::new(), seconds: 0.0 };
    let mut bar = Bar::new();
    for name in PARTS.into_iter().filter(|p| *p != "all" && (args.only == "all" || args.only == *p)) {
        bar.report(name, 0.0);
        let start = Instant::now();
        let (figures, words) = part(name, args, &mut bar)?;
        let mut files = Vec::new();
        let _ = writeln!(text, "\n## {}\n", title(name));
        for figure in &figures {
            plot::write(&args.output, figure)?;
            let _ = writeln!(text, "![{}]({}.svg)\n\n{}", figure.title, figure.file, figure.words);
            if let Some(error) = figure.reference_error {
                let _ = writeln!(text, "The reference itself is off by about {error:.1e}.");
            }
            let _ = writeln!(text, "\n{}", rows(figure));
            files.extend(["csv", "svg", "png"].map(|e| format!("{}.{e}", figure.file)));
        }
        let _ = writeln!(text, "{words}");
        told.parts.push(Part { name, files, seconds: start.elapsed().as_secs_f64() });
    }
    drop(bar);
    told.seconds = began.elapsed().as_secs_f64();
    let _ = writeln!(
        text,
        "\nMade in {:.0} s by `pliant report{}`. {}",
        told.seconds,
        if args.quick { " --quick" } else { "" },
        quiet(load, machine::load()),
    );
    std::fs::write(args.output.join("report.md"), text)?;
    if args.json {
        return output::print_json(&told);
    }
    output::print(&format!("{} in {:.0} s", args.output.join("report.md").display(), told.seconds))
}

fn title(part: &str) -> &'static str {
    match part {
        "elements" => "a. Elements and mesh size",
        "modes" => "b. Modes kept",
        "steps" => "c. Integrator and step",
        "warp" => "d. Warp against a nonlinear solution",
        "precision" => "e. Precision",
        "frames" => "e. Quantised frames",
        "network" => "f. Network",
        "front" => "g. All together",
        "table-2" => "The paper's table 2",
        "table-3" => "The paper's networks and what crosses them (its table 3)",
        "courses" => "The paper's figures 7, 8 and 9",
        _ => "The default at run time, in words",
    }
}

fn part(name: &str, args: &ReportArgs, bar: &mut Bar) -> Result<(Vec<Figure>, String), CliError> {
    let quick = args.quick;
    Ok(match name {
        "elements" => (physics::elements(quick)?, String::new()),
        "modes" => (physics::modes(quick)?, String::new()),
        "steps" => (physics::steps(quick)?, String::new()),
        "warp" => (warp::warp(quick)?, String::new()),
        "precision" => (vec![tables::precision()?], String::new()),
        "frames" => (vec![frames::quantised(quick, bar)?], String::new()),
        "network" => tables::networks(quick, bar)?,
        "front" => front::all_together(quick, bar)?,
        "table-2" => {
            (Vec::new(), tables::table_2(&args.models, &args.own, if quick { 0.3 } else { 2.0 }, bar)?)
        }
        "table-3" => (Vec::new(), frames::table_3(quick, bar)?),
        "courses" => (tables::courses()?, String::new()),
        _ => (
            Vec::new(),
            tables::default_setting(
                &args.models,
                &args.own,
                if quick { [12_000, 2_000] } else { [50_000, 12_000] },
                bar,
            )?,
        ),
    })
}

fn rows(figure: &Figure) -> String {
    if !figure.logarithmic {
        return String::new();
    }
    let timed = figure.series.iter().any(|series| !series.late.is_empty());
    let (head, rule) = if timed { (" 99 % |", " --- |") } else { ("", "") };
    let mut out = format!("| line | {} |{head} {} |\n| --- | --- |{rule} --- |\n", figure.x, figure.y);
    // Settings beside each other are many: the words of such a figure hold a table of those that count, the CSV all.
    for series in figure.series.iter().filter(|series| !series.scattered) {
        for (index, (x, y)) in series.points.iter().enumerate() {
            let late = series.late.get(index).map_or(String::new(), |late| format!(" {late:.4} |"));
            let _ = writeln!(out, "| {} | {x:.4} |{late} {y:.2e} |", series.name);
        }
    }
    out
}

/// What else the machine did meanwhile, as far as the system says.
fn quiet(before: Option<f64>, after: Option<f64>) -> String {
    let (Some(before), Some(after)) = (before, after) else { return String::new() };
    format!(
        "The machine's load (programs that want to run, mean over a minute) was {before:.1} when it began and {after:.1} at the end; the report itself is one of them, and bakes take all cores. Above that, times are \
         too long, and ratios within a run are what holds."
    )
}

fn heading() -> String {
    let days = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(0, |since| since.as_secs() / 86_400);
    let [y, m, d] = date(days as i64);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    format!(
        "# What Pliant costs and what it is off by\n\n{y:04}-{m:02}-{d:02}, Pliant {}, {cores} cores{}, {} {}, {}. Times are of one thread kept on one core, medians after a warm-up with the 99th percentile beside them (whiskers in the figures), unless it says otherwise.\n",
        env!("CARGO_PKG_VERSION"),
        match machine::processor() {
            name if name.is_empty() => name,
            name => format!(" of {name}"),
        },
        std::env::consts::ARCH,
        std::env::consts::OS,
        vectors(),
    )
}

/// The widest vectors of this processor that the reconstruction knows.
fn vectors() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        if std::arch::is_x86_feature_detected!("avx512f") {
            return "AVX-512";
        }
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
            return "AVX2";
        }
    }
    "portable vectors"
}

/// Year, month and day (UTC) of a number of days since 1970-01-01 in the Gregorian calendar.
fn date(days: i64) -> [i64; 3] {
    // H. Hinnant, "chrono-compatible low-level date algorithms": eras of 400 years that begin in March.
    let z = days + 719_468;
    let era = z.div_euclid(146_097);
    let day = z.rem_euclid(146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let of_year = day - (365 * year + year / 4 - year / 100);
    let shifted = (5 * of_year + 2) / 153;
    let month = if shifted < 10 { shifted + 3 } else { shifted - 9 };
    [year + era * 400 + i64::from(month <= 2), month, of_year - (153 * shifted + 2) / 5 + 1]
}

#[cfg(test)]
mod tests {
    #[test]
    fn dates_are_those_of_the_calendar() {
        assert_eq!(super::date(0), [1970, 1, 1]);
        assert_eq!(super::date(11_016), [2000, 2, 29]);
        assert_eq!(super::date(20_819), [2027, 1, 1]);
    }
}
