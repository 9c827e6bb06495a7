//! Output of the program, and checks of its output paths.

use std::io::Write;
use std::path::Path;

use pliant_modal::{Material, ModalModel};
use serde::Serialize;

use crate::CliError;

/// The output of `inspect --json`.
#[derive(Debug, Serialize)]
pub(crate) struct Summary {
    tets: usize,
    nodes: usize,
    element: String,
    modes: usize,
    rigid_modes: usize,
    frequencies_hz: Vec<f64>,
    mass_kg: f64,
    surface_vertices: usize,
    bytes: usize,
    hash: String,
    /// Material of the reduced elasticity. Null for linear elasticity only.
    material: Option<Material>,
    cubature_points: usize,
    residual_max: f64,
}

impl Summary {
    pub(crate) fn new(model: &ModalModel) -> Self {
        let info = model.info();
        Self {
            tets: info.tets,
            nodes: info.nodes,
            element: info.element.to_string(),
            modes: model.mode_count(),
            rigid_modes: model.rigid_modes(),
            frequencies_hz: model.omega().iter().map(|omega| omega / std::f64::consts::TAU).collect(),
            mass_kg: model.mass(),
            surface_vertices: model.surface().positions().len(),
            bytes: model.file_bytes(),
            hash: model.hash().to_string(),
            material: model.material(),
            cubature_points: model.parts().reduced.as_ref().map_or(0, |reduced| reduced.points()),
            residual_max: info.residual_max,
        }
    }
}

/// Prints one line of JSON.
pub(crate) fn print_json(value: &impl Serialize) -> Result<(), CliError> {
    let text = serde_json::to_string(value).map_err(std::io::Error::from)?;
    print(&text)
}

/// Prints a text and a line end. A closed pipe is not an error.
pub(crate) fn print(text: &str) -> Result<(), CliError> {
    match writeln!(std::io::stdout().lock(), "{text}") {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()),
    }
}

/// Rejects an output path whose folder is missing, before the long work starts.
pub(crate) fn check_folder(path: &Path) -> Result<(), CliError> {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() && !folder.is_dir() => {
            Err(CliError::NoFolder(folder.to_path_buf()))
        }
        _ => Ok(()),
    }
}

/// The model as a table for people.
pub(crate) fn table(model: &ModalModel) -> String {
    let info = model.info();
    let summary = Summary::new(model);
    let mut rows: Vec<(&str, String)> = Vec::new();
    if !info.name.is_empty() {
        rows.push(("name", plain(&info.name)));
    }
    rows.push(("simulation mesh", format!("{} {}, {} nodes", summary.tets, summary.element, summary.nodes)));
    rows.push(("material", format!("E {} Pa, nu {}, {} kg/m^3", info.young, info.poisson, info.density)));
    if let Some(reduced) = &model.parts().reduced {
        let points = reduced.points();
        rows.push(("elasticity", format!("{}, {points} points, or linear", reduced.material)));
    } else {
        rows.push(("elasticity", "linear".to_owned()));
    }
    rows.push(("damping", damping(info.damping)));
    rows.push((
        "anchors",
        if info.anchors.is_empty() {
            "none: a free body".to_owned()
        } else {
            plain(&info.anchors.join(", "))
        },
    ));
    rows.push(("mass", format!("{:.6} kg", summary.mass_kg)));
    rows.push((
        "surface",
        format!("{} vertices, {} triangles", summary.surface_vertices, model.surface().triangles().len()),
    ));
    rows.push(("modes", format!("{} elastic, {} rigid", summary.modes, summary.rigid_modes)));
    if let (Some(low), Some(high)) = (summary.frequencies_hz.first(), summary.frequencies_hz.last()) {
        rows.push(("frequencies", format!("{low:.4} to {high:.4} Hz")));
    }
    rows.push(("residual", format!("{:.1e}", summary.residual_max)));
    rows.push(("file", format!("{} bytes", summary.bytes)));
    rows.push(("hash", summary.hash));
    let mut text = String::new();
    for (name, value) in rows {
        text.push_str(&format!("{name:<16} {value}\n"));
    }
    text.truncate(text.trim_end().len());
    text
}

/// Escapes text from a file for the terminal: control characters and those that change the writing
/// direction.
fn plain(text: &str) -> String {
    let tricky = |c: char| {
        c.is_control()
            || matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
    };
    text.chars().fold(String::new(), |mut out, c| {
        if tricky(c) {
            out.extend(c.escape_unicode())
        } else {
            out.push(c)
        }
        out
    })
}

fn damping(law: pliant_modal::Damping) -> String {
    match law {
        pliant_modal::Damping::Rayleigh { alpha, beta } => format!("Rayleigh, {alpha} 1/s and {beta} s"),
        pliant_modal::Damping::Ratio(zeta) => format!("{} % of critical", 100.0 * zeta),
        other => format!("{other:?}"),
    }
}
