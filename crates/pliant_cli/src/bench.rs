//! The commands `pliant bench step` and `pliant bench pile`: cost of a body on this machine, next
//! to the memory bandwidth limit measured in the same run, and of bodies that fall onto each other.

use std::{path::PathBuf, sync::Arc};

use clap::{Args, Subcommand};
use pliant_lab::{
    bench::{Cost, Percentiles, measure},
    pile::{Pile, Piled, pile},
};
use pliant_modal::{Elasticity, ModalModel, Precision};

use crate::{CliError, arguments::elasticity, output};

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
    /// Lets copies of a body fall onto each other on a plane, and measures the ticks
    Pile {
        /// The model, a body without anchors
        #[arg(value_name = "X.modal")]
        model: PathBuf,
        /// Number of bodies
        #[arg(long, default_value_t = 10)]
        count: usize,
        /// Simulated duration, s
        #[arg(long, default_value_t = 4.0, allow_negative_numbers = true)]
        seconds: f64,
        /// Steps per second
        #[arg(long, value_name = "HZ", default_value_t = 60.0, allow_negative_numbers = true)]
        rate: f64,
        /// Elasticity of the bodies: linear or reduced [default: reduced if the model has a
        /// material]
        #[arg(long, value_parser = elasticity)]
        elasticity: Option<Elasticity>,
        /// Prints one line of JSON
        #[arg(long)]
        json: bool,
    },
}

pub(crate) fn run(args: &BenchArgs) -> Result<(), CliError> {
    match &args.what {
        What::Step { model, seconds, half, json } => {
            if !(0.01..=600.0).contains(seconds) {
                return Err(CliError::Range { what: "--seconds", low: 0.01, high: 600.0, got: *seconds });
            }
            let precision = if *half { Precision::Half } else { Precision::Single };
            let cost = measure(Arc::new(ModalModel::read(model)?), *seconds, precision)?;
            if *json { output::print_json(&cost) } else { output::print(&text(&cost)) }
        }
        What::Pile { model, count, seconds, rate, elasticity, json } => {
            let asked = Pile {
                count: *count,
                seconds: *seconds,
                rate: *rate,
                elasticity: *elasticity,
                ..Pile::default()
            };
            let piled = pile(&Arc::new(ModalModel::read(model)?), &asked)?;
            if *json { output::print_json(&piled) } else { output::print(&pile_text(&piled)) }
        }
    }
}

fn times(t: &Percentiles) -> String {
    format!("{:.2} us (99 %: {:.2}, 99.9 %: {:.2})", t.p50, t.p99, t.p999)
}

fn pile_text(piled: &Piled) -> String {
    format!(
        "bodies             {}, {} modes each\n\
         tick               {}\n\
         for each contact   {}\n\
         contacts           {} at most, {} at the end\n\
         energy             rises by {:.1e} of {:.3} J from one tick to the next at most\n\
         at the end         {:.1e} J of motion, penetration {:.1e} of the size\n\
         failed steps       {}",
        piled.bodies,
        piled.modes,
        times(&piled.tick_us),
        times(&piled.contact_us),
        piled.contacts,
        piled.contacts_at_end,
        piled.gain.max(0.0),
        piled.start,
        piled.kinetic_at_end,
        piled.penetration,
        piled.failures,
    )
}

fn text(cost: &Cost) -> String {
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
