//! The report on the method's cost and errors, measured on this machine: tables, CSV, SVG, PNG and
//! text.

mod contact;
mod courses;
mod elasticity;
mod frames;
mod front;
mod networks;
mod physics;
mod plot;
mod tables;
mod warp;
mod work;

use std::{
    fmt::Write,
    path::{Path, PathBuf},
    time::Instant,
};

use serde::Serialize;

use crate::{LabError, experiment::Experiment, machine, progress::Progress};
use plot::{Axes, Figure};

/// A part of the report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Elements and mesh size.
    Elements,
    /// Number of modes.
    Modes,
    /// Integrator and step.
    Steps,
    /// The warp against a nonlinear solution.
    Warp,
    /// Half precision of the basis.
    Precision,
    /// Quantized frames.
    Frames,
    /// Recovery policies on the paper's networks.
    Network,
    /// All settings together, for choosing one.
    Front,
    /// Linear and reduced elasticity, by error and run time.
    Elasticity,
    /// Contacts with known answers.
    Contact,
    /// The paper's table 2.
    Table2,
    /// The paper's table 2 with compensation and without.
    Table2Repair,
    /// The paper's networks and the data sent over them.
    Table3,
    /// The paper's figures 6 to 9.
    Courses,
    /// The default at run time, in words.
    Default,
}

impl Part {
    /// All parts, in the order of the report.
    pub const ALL: [Self; 15] = [
        Self::Elements,
        Self::Modes,
        Self::Steps,
        Self::Warp,
        Self::Precision,
        Self::Frames,
        Self::Network,
        Self::Front,
        Self::Elasticity,
        Self::Contact,
        Self::Table2,
        Self::Table2Repair,
        Self::Table3,
        Self::Courses,
        Self::Default,
    ];

    /// The name of the part: lower case, such as `table-2`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Elements => "elements",
            Self::Modes => "modes",
            Self::Steps => "steps",
            Self::Warp => "warp",
            Self::Precision => "precision",
            Self::Frames => "frames",
            Self::Network => "network",
            Self::Front => "front",
            Self::Elasticity => "elasticity",
            Self::Contact => "contact",
            Self::Table2 => "table-2",
            Self::Table2Repair => "table-2-repair",
            Self::Table3 => "table-3",
            Self::Courses => "courses",
            Self::Default => "default",
        }
    }

    /// Returns the part with this name.
    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|part| part.name() == name)
    }

    fn title(self) -> &'static str {
        match self {
            Self::Elements => "a. Elements and mesh size",
            Self::Modes => "b. Modes kept",
            Self::Steps => "c. Integrator and step",
            Self::Warp => "d. Warp against a nonlinear solution",
            Self::Precision => "e1. Precision",
            Self::Frames => "e2. Quantized frames",
            Self::Network => "f. Network",
            Self::Front => "g. All together",
            Self::Elasticity => "h. Elasticity",
            Self::Contact => "i. Contact",
            Self::Table2 => "The paper's table 2",
            Self::Table2Repair => "The paper's table 2 with compensation",
            Self::Table3 => "The paper's networks and what crosses them (its table 3)",
            Self::Courses => "The paper's figures 6, 7, 8 and 9",
            Self::Default => "The default at run time, in words",
        }
    }

    /// Returns whether the figures of the part are of linear elasticity, and need to say so.
    fn is_linear(self) -> bool {
        matches!(
            self,
            Self::Modes
                | Self::Steps
                | Self::Warp
                | Self::Precision
                | Self::Frames
                | Self::Network
                | Self::Front
        )
    }
}

/// Settings of the report.
#[derive(Debug, Clone)]
pub struct ReportSettings {
    /// Parts to write, in this order.
    pub parts: Vec<Part>,
    /// Use fewer points and shorter timings.
    pub quick: bool,
    /// Folder of the surfaces bunny.obj and armadillo.obj. The project's own body stands in for one
    /// that is not there.
    pub models: PathBuf,
    /// The project's own body: a surface or a scene.
    pub own: PathBuf,
}

/// A written part.
#[derive(Serialize, Debug, Clone)]
pub struct Written {
    /// Name of the part.
    pub name: &'static str,
    /// Names of the part's files within the folder.
    pub files: Vec<String>,
    /// Time to measure and write the part, s.
    pub seconds: f64,
}

/// The written report.
#[derive(Serialize, Debug, Clone)]
pub struct Report {
    /// The parts, in their order.
    pub parts: Vec<Written>,
    /// Time to measure and write the whole report, s.
    pub seconds: f64,
}

/// Measures, and writes `report.md` with its figures (CSV, SVG and PNG) into a folder. The folder
/// is created if it does not exist. Of a `report.md` that is there already, the parts that are not
/// measured now stay as they are.
///
/// # Errors
/// Returns [`LabError::Write`] or [`LabError::Plot`] for files, and the other errors for
/// measurements that fail.
pub fn write(
    folder: &Path,
    settings: &ReportSettings,
    progress: &mut dyn Progress,
) -> Result<Report, LabError> {
    std::fs::create_dir_all(folder)?;
    let began = Instant::now();
    let page = folder.join("report.md");
    let mut made = Vec::new();
    let mut report = Report { parts: Vec::new(), seconds: 0.0 };
    for &part in &settings.parts {
        progress.report(part.name(), 0.0);
        let (start, load) = (Instant::now(), machine::load());
        let (figures, words) = measure(part, settings, progress)?;
        let mut files = Vec::new();
        let mut text = String::new();
        for figure in &figures {
            plot::write(folder, figure)?;
            let _ = writeln!(
                text,
                "![{}]({}.svg)\n\n{}\n\n{}{}",
                figure.title,
                figure.file,
                figure.data(),
                figure.words,
                if part.is_linear() { LINEAR } else { "" }
            );
            if let Some(error) = figure.reference_error {
                let _ = writeln!(text, "The error of the reference is about {error:.1e}.");
            }
            let _ = writeln!(text, "\n{}", rows(figure));
            files.extend(figure.files());
        }
        let seconds = start.elapsed().as_secs_f64();
        let text = format!("{}\n\n{text}{words}", stamp(part, settings.quick, seconds, load));
        made.push(Section { part, text });
        report.parts.push(Written { name: part.name(), files, seconds });
    }
    report.seconds = began.elapsed().as_secs_f64();
    // Read at the end, so that another run may have written its part meanwhile.
    let mut sections = match std::fs::read_to_string(&page) {
        Ok(text) => Section::all(&text),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Vec::new(),
        Err(error) => return Err(error.into()),
    };
    sections.retain(|section| made.iter().all(|made| made.part != section.part));
    sections.append(&mut made);
    let mut text = HEADING.to_owned();
    for part in Part::ALL {
        for section in sections.iter().filter(|section| section.part == part) {
            let _ = write!(text, "\n## {}\n\n{}\n", part.title(), section.text.trim_end());
        }
    }
    std::fs::write(page, text)?;
    Ok(report)
}

/// A part's text in `report.md`, without its title.
struct Section {
    part: Part,
    text: String,
}

impl Section {
    /// The parts of a page. What has another title is not kept.
    fn all(page: &str) -> Vec<Self> {
        let named = |section: &str| {
            let (title, text) = section.split_once('\n')?;
            let part = Part::ALL.into_iter().find(|part| part.title() == title.trim())?;
            Some(Self { part, text: text.trim().to_owned() })
        };
        page.split("\n## ").skip(1).filter_map(named).collect()
    }
}

fn measure(
    part: Part,
    settings: &ReportSettings,
    progress: &mut dyn Progress,
) -> Result<(Vec<Figure>, String), LabError> {
    let ReportSettings { quick, models, own, .. } = settings;
    let quick = *quick;
    Ok(match part {
        Part::Elements => (physics::elements(quick)?, String::new()),
        Part::Modes => (physics::modes(quick)?, String::new()),
        Part::Steps => (physics::steps(quick)?, String::new()),
        Part::Warp => (warp::warp(quick)?, String::new()),
        Part::Precision => (vec![tables::precision()?], String::new()),
        Part::Frames => (vec![frames::quantized(quick, progress)?], String::new()),
        Part::Network => networks::networks(quick, progress)?,
        Part::Front => front::all_together(quick, progress)?,
        Part::Elasticity => elasticity::elasticity(quick)?,
        Part::Contact => contact::contact(quick)?,
        Part::Table2 => {
            let size = if quick { (0.05, 40) } else { (2.0, 1) };
            (Vec::new(), tables::table_2(models, own, size, progress)?)
        }
        Part::Table2Repair => {
            let size = if quick { (2.0, 40) } else { (10.0, 4) };
            (Vec::new(), tables::table_2_repair(models, own, size, progress)?)
        }
        Part::Table3 => (Vec::new(), frames::table_3(quick, progress)?),
        Part::Courses => (courses::courses()?, String::new()),
        Part::Default => {
            let tets = if quick { [2_000, 500] } else { [50_000, 12_000] };
            (Vec::new(), tables::default_setting(models, own, tets, progress)?)
        }
    })
}

fn rows(figure: &Figure) -> String {
    if figure.axes == Axes::Linear || figure.series.iter().all(|series| series.scattered) {
        return String::new();
    }
    let timed = figure.series.iter().any(|series| !series.late.is_empty());
    let (head, rule) = if timed { (" 99 % |", " --- |") } else { ("", "") };
    let mut out = format!("| line | {} |{head} {} |\n| --- | --- |{rule} --- |\n", figure.x, figure.y);
    // Scattered series have many points. The text of such a figure has a table of the important
    // settings, and the CSV has all of them.
    for series in figure.series.iter().filter(|series| !series.scattered) {
        for (index, (x, y)) in series.points.iter().enumerate() {
            let late = series.late.get(index).map_or(String::new(), |late| format!(" {late:.4} |"));
            let _ = writeln!(out, "| {} | {x:.4} |{late} {y:.2e} |", series.name);
        }
    }
    out
}

/// What the text of a figure of linear elasticity ends with.
const LINEAR: &str = " The modal body has linear elasticity, and what is called the default is the default of that: a bake's own is reduced elasticity (figure h).";

const HEADING: &str = "# Cost and accuracy of Pliant\n\nEach part says by which command it was made, when, and on which machine. Unless stated otherwise, times are those of one thread that is pinned to one core. They are medians after a warm-up, with the 99th percentile beside them (whiskers in the figures). The load of a machine is the mean number of runnable programs over a minute. The report itself counts as one, and bakes use all cores. If the load is higher than that, the times are too long, and only ratios within a part are meaningful. Below each figure is its data; the same picture lies beside it as PNG.\n";

/// A line that says how a part was made.
fn stamp(part: Part, quick: bool, seconds: f64, load: Option<f64>) -> String {
    let command = format!("pliant report --only {}{}", part.name(), if quick { " --quick" } else { "" });
    machine::made(&command, seconds, &format!("What is random has the seed {}", Experiment::SEED), load)
}

#[cfg(test)]
mod tests {
    use super::{Part, Section};

    #[test]
    fn every_part_is_found_by_its_own_name() {
        Part::ALL.iter().for_each(|part| assert_eq!(Part::by_name(part.name()), Some(*part)));
        assert_eq!(Part::by_name("all"), None);
    }

    #[test]
    fn parts_of_a_page_are_found_and_others_are_not_kept() {
        let [first, second] = [Part::Network, Part::Table2];
        let page = format!(
            "# Report\n\nwords\n\n## {}\n\none\n\n### not a part\n\n## Another\n\ntwo\n\n## {}\n\nthree\n",
            second.title(),
            first.title()
        );
        let found: Vec<_> = Section::all(&page).into_iter().map(|s| (s.part, s.text)).collect();
        assert_eq!(found, [(second, "one\n\n### not a part".to_owned()), (first, "three".to_owned())]);
    }
}
