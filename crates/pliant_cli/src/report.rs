//! The command `pliant report`: the cost and the errors of the method, measured on this machine.

use std::path::PathBuf;

use clap::Args;
use pliant_lab::report::{Part, ReportSettings, write};

use crate::{CliError, output, progress::Bar};

/// The name that stands for all parts.
const ALL: &str = "all";

#[derive(Args, Debug)]
#[command(
    after_help = "The parts table-2, table-2-repair and default measure a bunny and an armadillo of the Stanford 3D Scanning Repository (https://graphics.stanford.edu/data/3Dscanrep/), which has PLY files. The committed figures are of reconstructions that were decimated and rescaled to closed OBJ files of 3,301 and 14,587 vertices; the report has their SHA-256. Any closed surface of these names will do, and the figures are then others. They may be redistributed with acknowledgement and not commercially, so that they are not shipped."
)]
pub(crate) struct ReportArgs {
    /// Only one part: elements, modes, steps, warp, precision, frames, network, front, elasticity,
    /// contact, table-2, table-2-repair, table-3, courses, default
    #[arg(long, default_value = ALL)]
    only: String,
    /// Fewer points and shorter timings: within ten minutes on two cores
    #[arg(long)]
    quick: bool,
    /// Folder of the closed surfaces bunny.obj and armadillo.obj (see below); the own body stands
    /// in for one that is missing
    #[arg(long, value_name = "DIR", default_value = "models")]
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

impl ReportArgs {
    fn parts(&self) -> Result<Vec<Part>, CliError> {
        if self.only == ALL {
            return Ok(Part::ALL.to_vec());
        }
        Part::by_name(&self.only).map(|part| vec![part]).ok_or_else(|| CliError::Unknown {
            what: "--only",
            got: self.only.clone(),
            expected: format!("{}, {ALL}", Part::ALL.map(Part::name).join(", ")),
        })
    }
}

pub(crate) fn run(args: &ReportArgs) -> Result<(), CliError> {
    let settings = ReportSettings {
        parts: args.parts()?,
        quick: args.quick,
        models: args.models.clone(),
        own: args.own.clone(),
    };
    let report = write(&args.output, &settings, &mut Bar::new())?;
    if args.json {
        return output::print_json(&report);
    }
    output::print(&format!("{} in {:.0} s", args.output.join("report.md").display(), report.seconds))
}
