//! Shapes with parts that are thinner than the lattice: they are filled inflated, then fitted.

use super::{Inflation, StuffOptions, VOLUME_TOLERANCE, fill_lattice, fit::fit};
use crate::{
    MeshError, TetMesh,
    sdf::{Extent, SignedDistance},
};

/// Distances by which the shape is inflated, in cells, in the order of the attempts.
///
/// The lattice has no hole where the inflated shape is at least 1.2 cells thick. Thinner shapes
/// need more, and narrow slits close with more. The last one is for shapes that are thick on the
/// whole.
const INFLATIONS: [f64; 4] = [0.45, 0.6, 0.75, 0.25];
/// Number of attempts to reach the wanted number of tetrahedra with each of them.
const ATTEMPTS: usize = 12;
/// Fraction of the volume that a fitted mesh may miss without a further attempt.
const GOOD: f64 = 0.05;
/// Mean thickness, in cells, below which the shape itself is not filled: the lattice would lose it.
const THINNEST: f64 = 1.0;

/// Shape that is larger than another one by a distance (m) on all sides.
pub(super) struct Inflated<'a> {
    pub(super) sdf: &'a dyn SignedDistance,
    pub(super) by: f64,
}

impl SignedDistance for Inflated<'_> {
    fn distance(&self, p: [f64; 3]) -> f64 {
        self.sdf.distance(p) - self.by
    }

    fn bounds(&self) -> [[f64; 3]; 2] {
        let [low, high] = self.sdf.bounds();
        [low.map(|x| x - self.by), high.map(|x| x + self.by)]
    }
}

/// Fills a shape, and fits the mesh to it where the lattice alone loses volume.
pub(super) fn fill(
    sdf: &dyn SignedDistance,
    options: &StuffOptions,
    progress: &mut dyn FnMut(f32),
) -> Result<TetMesh, MeshError> {
    let known = sdf.extent().filter(|e| [e.volume, e.area].iter().all(|x| *x > 0.0 && x.is_finite()));
    let Some(extent) = known else {
        let mesh = fill_lattice(sdf, options, None, progress)?;
        progress(1.0);
        return Ok(mesh);
    };
    let target = options.target_tets;
    let error = |mesh: &TetMesh| (mesh.volume() / extent.volume - 1.0).abs();
    let mut plain = None;
    let mut inflations = INFLATIONS.as_slice();
    if 2.0 * extent.volume >= THINNEST * first_cell(&extent, 0.0, target) * extent.area {
        let found = fill_lattice(sdf, options, None, &mut |share| progress(0.5 * share));
        if let Ok(mesh) = &found
            && error(mesh) <= VOLUME_TOLERANCE
        {
            progress(1.0);
            return found;
        }
        plain = Some(found);
    } else {
        inflations = &INFLATIONS[..3];
    }
    // The fraction of the volume that the mesh misses, and the mesh.
    let mut best: Option<(f64, TetMesh)> = None;
    let mut refused = None;
    for (attempt, &by) in inflations.iter().enumerate() {
        progress(0.5 + 0.5 * attempt as f32 / inflations.len() as f32);
        let inflation = Inflation { by, cell: first_cell(&extent, by, target), attempts: ATTEMPTS };
        match fill_lattice(sdf, options, Some(inflation), &mut |_| ()) {
            Ok(mut mesh) => {
                let missed = fit(&mut mesh, sdf, extent.volume) / extent.volume;
                let missed = missed.max(error(&mesh));
                if best.as_ref().is_none_or(|b| missed < b.0) {
                    best = Some((missed, mesh));
                }
                if missed <= GOOD {
                    break;
                }
            }
            Err(error) => refused = refused.or(Some(error)),
        }
    }
    progress(1.0);
    match (best, plain, refused) {
        (Some((_, mesh)), ..) if error(&mesh) <= VOLUME_TOLERANCE => {
            mesh.check()?;
            Ok(mesh)
        }
        (_, Some(plain), _) => plain,
        (Some((_, mesh)), ..) => Err(MeshError::TooThin { tets: target, error: error(&mesh) }),
        (None, None, Some(error)) => Err(error),
        (None, None, None) => Err(MeshError::Empty { what: "tetrahedron inside the shape" }),
    }
}

/// Returns the size of the cells that give about `target` tetrahedra, twelve a cell, in a shape
/// that is inflated by `by` cells.
fn first_cell(extent: &Extent, by: f64, target: usize) -> f64 {
    let wanted = target as f64 / 12.0;
    let mut cell = (extent.volume / wanted).cbrt();
    for _ in 0..20 {
        cell = 0.5 * (cell + ((extent.volume + by * cell * extent.area) / wanted).cbrt());
    }
    cell
}
