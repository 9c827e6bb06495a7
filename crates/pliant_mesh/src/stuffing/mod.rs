//! Isosurface stuffing: fills any closed surface with tetrahedra of good angles.
//!
//! The method is the uniform form of F. Labelle and J. R. Shewchuk, *Isosurface Stuffing: Fast
//! Tetrahedral Meshes with Good Dihedral Angles*, ACM Trans. Graphics 26(3), 2007. A body-centered
//! cubic lattice covers the shape, lattice points near the surface are moved onto it, and a few
//! stencils cut the tetrahedra that cross the surface.

mod fit;
mod lattice;
mod manifold;
mod stencil;
mod thin;

use std::collections::HashMap;

use lattice::{Lattice, LatticeSide};
use nalgebra::Vector3;
use stencil::{StencilNode, fill};

use crate::{MeshError, TetMesh, sdf::SignedDistance, tets::signed_volume};

/// Bounds of all angles between two faces of a tetrahedron that [`stuff`] makes, degrees.
pub const DIHEDRAL_BOUNDS_DEG: [f64; 2] = [10.7, 164.8];

/// Bounds of the angles where the tetrahedra had to be fitted to thin parts, degrees.
pub const FITTED_BOUNDS_DEG: [f64; 2] = [5.0, 175.0];

/// Error of the volume above which the tetrahedra are fitted to the shape, as a fraction.
pub const VOLUME_TOLERANCE: f64 = 0.02;

/// Largest deviation of [`stuff`] from the wanted number of tetrahedra, as a fraction of this
/// number.
pub const COUNT_TOLERANCE: f64 = 0.05;

const MAX_TETS: usize = 100_000_000;

/// Options of [`stuff`].
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct StuffOptions {
    /// Wanted number of tetrahedra, met within [`COUNT_TOLERANCE`]. Default: 10,000.
    pub target_tets: usize,
    /// Pieces to keep if the mesh is not connected. Default: [`Parts::Largest`].
    pub parts: Parts,
}

impl Default for StuffOptions {
    fn default() -> Self {
        Self { target_tets: 10_000, parts: Parts::Largest }
    }
}

impl StuffOptions {
    /// Returns the default options with this number of tetrahedra.
    pub fn with_target(target_tets: usize) -> Self {
        Self { target_tets, ..Self::default() }
    }
}

/// Selection among the pieces of a mesh that have no face in common.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Parts {
    /// Keeps the piece with the largest volume.
    ///
    /// Where a shape is thinner than the lattice, small fragments separate from it. They would be
    /// bodies of their own.
    #[default]
    Largest,
    /// Keeps all pieces.
    All,
}

/// Fills a shape with about `options.target_tets` tetrahedra.
///
/// The boundary of the mesh is a closed manifold whose nodes lie on the surface. All dihedral
/// angles lie within [`DIHEDRAL_BOUNDS_DEG`]. Features thinner than the lattice are lost, and sharp
/// edges are rounded by up to a cell.
///
/// Where this loses more than [`VOLUME_TOLERANCE`] of a shape whose volume is known (see
/// [`SignedDistance::extent`]), the lattice fills the shape inflated by about half a cell instead,
/// and the mesh is then fitted to the shape. The volume is within the tolerance, thin parts and
/// sharp edges stay, and dihedral angles lie within [`FITTED_BOUNDS_DEG`]. Some nodes lie off the
/// surface by a part of a cell, where going onto it would flatten a tetrahedron.
///
/// The same shape and options give the same mesh to the bit, for any number of threads. `progress`
/// receives the completed fraction from 0 to 1 from time to time.
///
/// # Errors
/// Returns [`MeshError::Parameter`] when the count is 0 or too large or the shape's box is not
/// finite, and [`MeshError::Empty`] when nothing is inside. Returns [`MeshError::TetCount`] when no
/// lattice gives a number close enough to the wanted one, which happens for a few hundred
/// tetrahedra. Returns [`MeshError::TooThin`] when so many tetrahedra cannot keep the volume of a
/// thin shape. Returns [`MeshError::Dihedral`] when no position of the lattice gives good angles.
/// No field that causes this error is known.
pub fn stuff(
    sdf: &dyn SignedDistance,
    options: &StuffOptions,
    progress: &mut dyn FnMut(f32),
) -> Result<TetMesh, MeshError> {
    let target = options.target_tets;
    if !(1..=MAX_TETS).contains(&target) {
        return Err(MeshError::parameter("number of tetrahedra", format!("1 to {MAX_TETS}"), target));
    }
    let [low, high] = sdf.bounds().map(Vector3::from);
    let size = high - low;
    if !size.iter().all(|s| s.is_finite() && *s > 0.0) {
        return Err(MeshError::parameter(
            "box around the shape",
            "finite, of positive size",
            format!("{:?} to {:?}", sdf.bounds()[0], sdf.bounds()[1]),
        ));
    }
    thin::fill(sdf, options, progress)
}

/// How [`fill_lattice`] inflates the shape, and where it starts.
#[derive(Clone, Copy)]
struct Inflation {
    /// Distance by which the shape is inflated on all sides, in cells.
    by: f64,
    /// Cell of the first attempt, m.
    cell: f64,
    /// Largest number of attempts.
    attempts: usize,
}

/// Fills a shape, or the inflated shape, with about the wanted number of tetrahedra.
fn fill_lattice(
    sdf: &dyn SignedDistance,
    options: &StuffOptions,
    inflation: Option<Inflation>,
    progress: &mut dyn FnMut(f32),
) -> Result<TetMesh, MeshError> {
    let target = options.target_tets;
    let [low, high] = sdf.bounds().map(Vector3::from);
    let size = high - low;
    // The first attempt uses a coarse lattice. The count is about proportional to the cell to the
    // power -3, and two counts give a better estimate of the power.
    let mut cell = inflation.map_or_else(
        || (size.product() / COARSE_CELLS.min(target as f64 / 3.0)).cbrt().min(size.max()),
        |inflation| inflation.cell,
    );
    let attempts = inflation.map_or(MAX_ATTEMPTS, |inflation| inflation.attempts);
    let mut tried: Vec<(f64, usize)> = Vec::new();
    let mut nearest: Option<usize> = None;
    let mut found_angles = None;
    let mut moved = false;
    for attempt in 0..attempts {
        progress(attempt as f32 / (attempt + 2) as f32);
        // Where symmetry makes the count jump (in steps of up to 48), another position of the
        // lattice helps.
        let shift = if attempt < SYMMETRIC_ATTEMPTS && !moved { 0.0 } else { attempt as f64 };
        let shift = SHIFT.map(|s| s * shift % 1.0);
        let (mesh, dropped) = match inflation {
            Some(Inflation { by, .. }) => mesh(&thin::Inflated { sdf, by: by * cell }, cell, shift)?,
            None => mesh(sdf, cell, shift)?,
        };
        let mesh = keep_parts(mesh, options.parts);
        let count = mesh.tets.len();
        if count.abs_diff(target) as f64 <= COUNT_TOLERANCE * target as f64 {
            // A mesh that lost tetrahedra or whose angles exceed the bounds is rejected, because
            // another position of the lattice does better. Bad angles are never accepted.
            let quality = mesh.quality();
            let bad_angles = quality.min_dihedral_deg < DIHEDRAL_BOUNDS_DEG[0]
                || quality.max_dihedral_deg > DIHEDRAL_BOUNDS_DEG[1];
            if !bad_angles && (dropped == 0 || attempt >= PATIENT_ATTEMPTS) {
                mesh.check()?;
                return Ok(mesh);
            }
            if bad_angles {
                found_angles = Some([quality.min_dihedral_deg, quality.max_dihedral_deg]);
            }
            moved = true;
            continue;
        }
        if count > 0 && nearest.is_none_or(|n| count.abs_diff(target) < n.abs_diff(target)) {
            nearest = Some(count);
        }
        tried.push((cell, count));
        if nearest.is_none() && tried.len() == EMPTY_ATTEMPTS {
            break;
        }
        cell = next_cell(&tried, target);
    }
    match (found_angles, nearest) {
        (Some(found), _) => Err(MeshError::Dihedral { found, expected: DIHEDRAL_BOUNDS_DEG }),
        (None, Some(nearest)) => Err(MeshError::TetCount { wanted: target, nearest }),
        (None, None) => Err(MeshError::Empty { what: "tetrahedron inside the shape" }),
    }
}

/// Number of cells of the first lattice.
const COARSE_CELLS: f64 = 6000.0;
const MAX_ATTEMPTS: usize = 40;
/// Number of attempts that reject a mesh that lost tetrahedra to keep its boundary a manifold.
const PATIENT_ATTEMPTS: usize = 12;
/// Number of attempts with ever smaller cells in a box that seems empty.
const EMPTY_ATTEMPTS: usize = 7;
const SYMMETRIC_ATTEMPTS: usize = 6;
/// Shifts that cover the cell evenly: powers of the inverse plastic number.
const SHIFT: [f64; 3] = [0.819_172_513, 0.671_043_606, 0.549_700_478];

/// Returns the cell size that should give the wanted count, estimated from the attempts so far.
fn next_cell(tried: &[(f64, usize)], target: usize) -> f64 {
    let log = |count: usize| (count as f64).ln();
    match *tried {
        [] => f64::NAN,
        [.., (cell, 0)] => cell / 2.0,
        [.., (x0, y0), (x1, y1)] if tried.len() < SYMMETRIC_ATTEMPTS && y0 > 0 && y0 != y1 => {
            let power = (log(y1) - log(y0)) / (x1.ln() - x0.ln());
            x1 * ((log(target) - log(y1)) / power.clamp(-6.0, -2.0)).exp()
        }
        // Counts that jump (parts join and separate as the cell changes) give no power.
        [.., (cell, count)] => cell * (count as f64 / target as f64).cbrt(),
    }
}

/// Makes a manifold of all tetrahedra of the lattice for one cell size. Returns the number of
/// tetrahedra that were dropped for this.
fn mesh(sdf: &dyn SignedDistance, cell: f64, shift: [f64; 3]) -> Result<(TetMesh, usize), MeshError> {
    let lattice = Lattice::new(sdf, cell, shift)?;
    let mut mesh = TetMesh::default();
    let mut index_of: HashMap<u64, u32> = HashMap::new();
    // These flags mark points on the surface, where unconnected pieces may touch.
    let mut on_surface = Vec::new();
    lattice.for_each_tet(|corners| {
        fill(corners, corners.map(|p| lattice.side(p)), |nodes| {
            let found = nodes.map(|node| {
                let key = match node {
                    StencilNode::Point(p) => lattice.point_key(p)?,
                    StencilNode::Cut(a, b) => lattice.edge_key(a, b)?,
                };
                if let Some(&index) = index_of.get(&key) {
                    return Some(index);
                }
                let (position, on) = match node {
                    StencilNode::Point(p) => (lattice.position(p), lattice.side(p) == LatticeSide::On),
                    StencilNode::Cut(a, b) => (lattice.cut(a, b)?, true),
                };
                let index = mesh.nodes.len() as u32;
                mesh.nodes.push(position.into());
                on_surface.push(on);
                index_of.insert(key, index);
                Some(index)
            });
            if let [Some(a), Some(b), Some(c), Some(d)] = found {
                let tet = [a, b, c, d];
                let turned = signed_volume(mesh.corners(tet)) < 0.0;
                mesh.tets.push(if turned { [a, b, d, c] } else { tet });
            }
        });
    });
    let dropped = manifold::part_contacts(&mut mesh, &mut on_surface);
    Ok((mesh, dropped))
}

fn keep_parts(mut mesh: TetMesh, parts: Parts) -> TetMesh {
    if parts == Parts::Largest {
        manifold::keep_largest_part(&mut mesh);
    }
    mesh.drop_unused_nodes();
    mesh
}

#[cfg(test)]
mod tests;
