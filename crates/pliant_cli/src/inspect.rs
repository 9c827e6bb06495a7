//! The command `pliant inspect`.

use std::path::PathBuf;

use clap::Args;
use pliant_modal::ModalModel;

use crate::CliError;
use crate::output::{self, Summary};

#[derive(Args, Debug)]
pub(crate) struct InspectArgs {
    /// The model
    #[arg(value_name = "X.modal")]
    input: PathBuf,
    /// Prints one line of JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: &InspectArgs) -> Result<(), CliError> {
    let model = ModalModel::read(&args.input)?;
    if args.json { output::print_json(&Summary::new(&model)) } else { output::print(&output::table(&model)) }
}
