//! The command `pliant watch-page`: writes the page that shows a published session in a browser.

use std::path::PathBuf;

use clap::Args;

use crate::{CliError, output};

/// The files of the page. `page/README.md` says what they are made from.
const FILES: [(&str, &[u8]); 3] = [
    ("index.html", include_bytes!("../page/static/index.html")),
    ("watch.js", include_bytes!("../page/static/watch.js")),
    ("licenses.txt", include_bytes!("../page/static/licenses.txt")),
];

#[derive(Args, Debug)]
#[command(
    after_help = "The files are static: any web server serves them. A host that publishes its session (feature watch) prints the link, which names the relay and the session."
)]
pub(crate) struct WatchPageArgs {
    /// The folder, made if it is not there
    #[arg(value_name = "DIR")]
    folder: PathBuf,
}

pub(crate) fn run(args: &WatchPageArgs) -> Result<(), CliError> {
    let failed = |source| CliError::Page { path: args.folder.clone(), source };
    std::fs::create_dir_all(&args.folder).map_err(failed)?;
    for (name, contents) in FILES {
        let path = args.folder.join(name);
        let failed = |source| CliError::Page { path: path.clone(), source };
        // A web server that is already there never serves half a file.
        let beside = args.folder.join(format!(".{name}.new"));
        std::fs::write(&beside, contents).map_err(failed)?;
        std::fs::rename(&beside, &path).map_err(failed)?;
        output::print(&format!("{}, {} bytes", path.display(), contents.len()))?;
    }
    Ok(())
}
