//! Tetrahedral meshes from files of any supported kind.

use std::path::Path;

use pliant_bake::Paint;
use pliant_mesh::{Repair, StuffOptions, TetMesh, io};

use crate::{LabError, progress::Progress};

/// Default number of tetrahedra for a surface or a scene.
const DEFAULT_TETS: usize = 10_000;

/// Share of a surface's volume that a fill may lose without a warning.
const VOLUME_LOSS: f64 = 0.02;

/// What a file was filled with.
pub struct Filled {
    /// The tetrahedra.
    pub mesh: TetMesh,
    /// The repair of a defective surface.
    pub repair: Option<Repair>,
    /// What is painted on the surface.
    pub paint: Option<Paint>,
}

/// Returns the tetrahedra that a file holds, or fills the file's shape with about `tets` tetrahedra
/// (default: 10,000).
///
/// If a defective surface was repaired, the repair is reported as a warning and returned. A fill so
/// coarse that it rounds off much of a surface is reported as a warning.
///
/// # Errors
/// Returns [`LabError::Mesh`] when the file cannot be read or filled, [`LabError::Bake`] when what
/// is painted is out of range, or [`LabError::TetsGiven`]
/// when `tets` is given for a file that already holds tetrahedra.
pub fn fill(input: &Path, tets: Option<usize>, progress: &mut dyn Progress) -> Result<Filled, LabError> {
    progress.report("read", 0.0);
    let (read, paint) = Paint::read(input)?;
    // Before the long work.
    paint.as_ref().map_or(Ok(()), Paint::check)?;
    if tets.is_some() && matches!(read, io::Input::Tets(_)) {
        return Err(LabError::TetsGiven(input.to_path_buf()));
    }
    let options = StuffOptions::with_target(tets.unwrap_or(DEFAULT_TETS));
    let enclosed = if let io::Input::Surface(surface) = &read { surface.volume().abs() } else { 0.0 };
    let (mesh, repair) = read.into_tets(&options, &mut |share| progress.report("mesh", f64::from(share)))?;
    if let Some(repair) = repair {
        progress.warn(&format!("{} was mended: {repair}", input.display()));
        // The volume of a defective surface does not measure the fill, because of holes and parts
        // that count twice.
        return Ok(Filled { mesh, repair: Some(repair), paint });
    }
    let filled = mesh.volume();
    if filled < (1.0 - VOLUME_LOSS) * enclosed {
        progress.warn(&format!(
            "the tetrahedra hold {filled:.6e} m^3 of the {enclosed:.6e} m^3 that {} encloses: edges and thin parts are \
             rounded away; more --tets keep more",
            input.display()
        ));
    }
    Ok(Filled { mesh, repair: None, paint })
}
