//! Tetrahedra out of a file, whatever it holds.

use std::path::Path;

use pliant_mesh::{Repair, StuffOptions, TetMesh, io};

use crate::{LabError, progress::Progress};

/// Tetrahedra that a surface or a scene is filled with unless told otherwise.
const DEFAULT_TETS: usize = 10_000;

/// Share of a surface's volume that a fill may lose in silence.
const VOLUME_LOSS: f64 = 0.02;

/// The tetrahedra that a file holds, or that its shape is filled with: about as many as `tets`, or
/// 10,000. What was mended of a dirty surface is a warning and is returned; a fill so coarse that
/// it rounds much of a surface away is a warning.
///
/// # Errors
/// [`LabError::Mesh`], or [`LabError::TetsGiven`] where `tets` is given for a file that has its own.
pub fn fill(
    input: &Path,
    tets: Option<usize>,
    progress: &mut dyn Progress,
) -> Result<(TetMesh, Option<Repair>), LabError> {
    progress.report("read", 0.0);
    let read = io::read(input)?;
    if tets.is_some() && matches!(read, io::Input::Tets(_)) {
        return Err(LabError::TetsGiven(input.to_path_buf()));
    }
    let options = StuffOptions::with_target(tets.unwrap_or(DEFAULT_TETS));
    let enclosed = if let io::Input::Surface(surface) = &read { surface.volume().abs() } else { 0.0 };
    let (mesh, repair) = read.into_tets(&options, &mut |share| progress.report("mesh", f64::from(share)))?;
    if let Some(repair) = repair {
        progress.warn(&format!("{} was mended: {repair}", input.display()));
        // What a dirty surface encloses is no measure of the fill: holes, and parts that are counted twice.
        return Ok((mesh, Some(repair)));
    }
    let filled = mesh.volume();
    if filled < (1.0 - VOLUME_LOSS) * enclosed {
        progress.warn(&format!(
            "the tetrahedra hold {filled:.6e} m^3 of the {enclosed:.6e} m^3 that {} encloses: edges and thin parts are \
             rounded away; more --tets keep more",
            input.display()
        ));
    }
    Ok((mesh, None))
}
