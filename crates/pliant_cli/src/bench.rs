//! The command `pliant bench step`: cost of a body on this machine, next to the memory bandwidth
//! limit measured in the same run.

use std::{path::PathBuf, sync::Arc};

use clap::{Args, Subcommand};
use pliant_lab::bench::{Cost, Percentiles, measure};
use pliant_modal::{ModalModel, Precision};

use crate::{CliError, output};

#[derive(Args, Debug)]
pub(crate) struct BenchArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand, Debug)]
enum What {
    /// Measures steps with one grab that pulls, and reconstructions of the whole surface
    Step {
        /// The model
        #[arg(value_name = "X.modal")]
        model: PathBuf,
        /// Seconds for each of the measurements
        #[arg(long, default_value_t = 1.0)]
        seconds: f64,
        /// Reconstruct from a basis in half precision
        #[arg(long)]
        half: bool,
        /// Prints one line of JSON
        #[arg(long)]
        json: bool,
    },
}

pub(crate) fn run(args: &BenchArgs) -> Result<(), CliError> {
    let What::Step { model, seconds, half, json } = &args.what;
    if !(0.01..=600.0).contains(seconds) {
        return Err(CliError::Range { what: "--seconds", low: 0.01, high: 600.0, got: *seconds });
    }
    let precision = if *half { Precision::Half } else { Precision::Single };
    let cost = measure(Arc::new(ModalModel::read(model)?), *seconds, precision)?;
    if *json { output::print_json(&cost) } else { output::print(&text(&cost)) }
}

fn text(cost: &Cost) -> String {
    let times = |t: &Percentiles| format!("{:.2} us (99 %: {:.2}, 99.9 %: {:.2})", t.p50, t.p99, t.p999);
    format!(
        "body               {} modes, {} surface vertices\n\
         step, one grab     {}\n\
         reconstruction     {}\n\
         both, as a frame   {}\n\
         bytes moved        {}\n\
         bandwidth          {:.1} GB/s, {:.0} % of the {:.1} GB/s of the fastest pass over as many bytes",
        cost.modes,
        cost.surface_vertices,
        times(&cost.step_us),
        times(&cost.reconstruct_us),
        times(&cost.frame_us),
        cost.bytes,
        cost.bandwidth_gb_s,
        100.0 * cost.bandwidth_gb_s / cost.bandwidth_limit_gb_s,
        cost.bandwidth_limit_gb_s
    )
}
