//! The `pliant` program: meshes, bakes and inspects soft bodies.
//!
//! Invalid input ends in one message on stderr and exit code 2. An output file appears completely
//! or not at all. Progress bars go to stderr if stderr is a terminal.
//!
//! These commands start from nothing and end with a body that a guest holds over a network that
//! loses packets:
//!
//! ```sh
//! pliant mesh bar --cells 8,2,2 --size 1,0.2,0.2 -o bar.msh                  # a meter of tetrahedra
//! pliant bake bar.msh --modes 12 --young 1e5 --anchor 'x<0.01' -o bar.modal   # held at one end
//! pliant inspect bar.modal                                                   # its modes, and how exact they are
//! pliant bench step bar.modal                                                # what it costs here
//! pliant pull bar.modal --at 1,0.1,0.1 --radius 0.15 --by 0,0.05,0            # what a hand feels
//! pliant stream --model bar.modal --network paper-1 --seconds 5              # what a guest sees of it
//! ```
//!
//! The test `tests/start.rs` runs these lines. `pliant COMMAND --help` describes all options.

mod arguments;
mod bake;
mod bench;
mod drop;
mod inspect;
mod mesh;
mod output;
mod progress;
mod pull;
mod report;
mod simulate;
mod stability;
mod stream;
mod watch_page;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use pliant_lab::LabError;

/// Soft bodies from meshes: tetrahedra, vibration modes, models.
#[derive(Parser, Debug)]
#[command(name = "pliant", version, about, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Makes tetrahedra from a simple shape, a surface or a scene
    Mesh(mesh::MeshArgs),
    /// Bakes a surface, a scene or tetrahedra into a model
    Bake(bake::BakeArgs),
    /// Shows the content of a model
    Inspect(inspect::InspectArgs),
    /// Measures the cost of a body on this machine
    Bench(bench::BenchArgs),
    /// Pulls a body slowly and prints the force on the hand
    Pull(pull::PullArgs),
    /// Lets a free body fall and prints what happens
    Drop(drop::DropArgs),
    /// Measures the cost and the errors of the method, as tables and plots
    Report(report::ReportArgs),
    /// Simulates sessions under faults and attacks, each drawn from a seed
    Simulate(simulate::SimulateArgs),
    /// Runs stiff, extreme and unfair cases and prints the margin to the bound of each
    Stability(stability::StabilityArgs),
    /// Streams a body over an emulated network and measures the guest's view
    Stream(stream::StreamArgs),
    /// Writes the page that shows a published session in a browser
    WatchPage(watch_page::WatchPageArgs),
}

fn main() -> ExitCode {
    // Clap itself exits with code 2 and its message if the arguments are wrong.
    let done = match Cli::parse().command {
        Command::Mesh(args) => mesh::run(args),
        Command::Bake(args) => bake::run(args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Bench(args) => bench::run(&args),
        Command::Pull(args) => pull::run(&args),
        Command::Drop(args) => drop::run(&args),
        Command::Report(args) => report::run(&args),
        Command::Simulate(args) => simulate::run(&args),
        Command::Stability(args) => stability::run(&args),
        Command::Stream(args) => stream::run(&args),
        Command::WatchPage(args) => watch_page::run(&args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("pliant: {error}");
            ExitCode::from(2)
        }
    }
}

/// The reason why the program stops.
#[derive(Debug, thiserror::Error)]
enum CliError {
    #[error("{0}")]
    Mesh(#[from] pliant_mesh::MeshError),
    #[error("{0}")]
    Bake(#[from] pliant_bake::BakeError),
    #[error("--material: {0}")]
    Material(#[from] pliant_bake::MaterialSyntax),
    #[error("{0}")]
    File(#[from] pliant_modal::FileError),
    #[error("--tets: {0} holds tetrahedra already; expected a surface or a scene, or no --tets")]
    TetsGiven(std::path::PathBuf),
    #[error("--msh-version: expected an output whose name ends in .msh, got {0}")]
    NoMsh(std::path::PathBuf),
    #[error("--threads: expected 1 to {most}, got {got}")]
    Threads { got: usize, most: usize },
    #[error("--output: the folder {0} is not there")]
    NoFolder(std::path::PathBuf),
    #[error("--output: cannot write {path}: {source}")]
    Output { path: std::path::PathBuf, source: std::io::Error },
    #[error("cannot write the page to {path}: {source}")]
    Page { path: std::path::PathBuf, source: std::io::Error },
    #[error("{0}")]
    Stream(#[from] pliant_stream::StreamError),
    #[error("{0}")]
    Lab(LabError),
    #[error("{broken} of {of} cases break their bounds")]
    Unstable { broken: usize, of: usize },
    #[error("{broken} of {of} sessions broke; --from SEED --seeds 1 gives one of them again")]
    Broken { broken: usize, of: u64 },
    #[error("{what}: expected one of {expected}, got '{got}'")]
    Unknown { what: &'static str, got: String, expected: String },
    #[error("{what}: expected {low} to {high}, got {got}")]
    Range { what: &'static str, low: f64, high: f64, got: f64 },
    #[error("cannot print: {0}")]
    Print(#[from] std::io::Error),
}

impl From<LabError> for CliError {
    /// Errors about an option get the program's own message, which names the option.
    fn from(error: LabError) -> Self {
        match error {
            LabError::TetsGiven(path) => Self::TetsGiven(path),
            LabError::Threads { got, most } => Self::Threads { got, most },
            LabError::Write(error) => Self::Print(error),
            other => Self::Lab(other),
        }
    }
}
