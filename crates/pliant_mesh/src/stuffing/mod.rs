//! Isosurface stuffing: tetrahedra with good angles inside any closed surface.
//!
//! F. Labelle and J. R. Shewchuk, *Isosurface Stuffing: Fast Tetrahedral Meshes with Good Dihedral Angles*, ACM Trans.
//! Graphics 26(3), 2007, the uniform form: a body-centered cubic lattice is laid over the shape, lattice points near the
//! surface are pulled onto it, and the tetrahedra that cross it are cut by a handful of stencils.

mod lattice;
mod manifold;
mod stencil;

use std::collections::HashMap;

use lattice::{Lattice, Side};
use nalgebra::Vector3;
use stencil::{Node, fill};

use crate::{MeshError, TetMesh, sdf::SignedDistance, tets::signed_volume};

/// Every angle between two faces of a tetrahedron that [`stuff`] makes lies between these, degrees.
pub const DIHEDRAL_BOUNDS_DEG: [f64; 2] = [10.7, 164.8];

/// [`stuff`] comes this close to the wanted number of tetrahedra, as a share of it.
pub const COUNT_TOLERANCE: f64 = 0.05;

const MAX_TETS: usize = 100_000_000;

/// What [`stuff`] should make.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct StuffOptions {
    /// Wanted number of tetrahedra, met within [`COUNT_TOLERANCE`]. Default: 10,000.
    pub target_tets: usize,
    /// What to do with pieces that do not hang together. Default: [`Parts::Largest`].
    pub parts: Parts,
}

impl Default for StuffOptions {
    fn default() -> Self {
        Self { target_tets: 10_000, parts: Parts::Largest }
    }
}

impl StuffOptions {
    /// Defaults but for the number of tetrahedra.
    pub fn with_target(target_tets: usize) -> Self {
        Self { target_tets, ..Self::default() }
    }
}

/// Pieces of a mesh that have no face in common.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Parts {
    /// Keep the piece with the largest volume. Where a shape is thinner than the lattice crumbs break off: they would
    /// be bodies of their own.
    #[default]
    Largest,
    /// Keep all.
    All,
}

/// Fills a shape with about `options.target_tets` tetrahedra.
///
/// The boundary of the mesh is a closed manifold whose nodes lie on the surface; all dihedral angles lie within
/// [`DIHEDRAL_BOUNDS_DEG`]. Features thinner than the lattice are lost, sharp edges are rounded by up to a cell.
/// The same shape and options give the same mesh to the bit, whatever the number of threads.
/// `progress` is told a share from 0 to 1 now and then.
///
/// # Errors
/// [`MeshError::Parameter`] when the count is 0 or too large or the shape's box is not finite;
/// [`MeshError::TetCount`] when no lattice gives a number close enough to the wanted one (it happens for a
/// few hundred tetrahedra); [`MeshError::Dihedral`] when no place of the lattice gives good angles (a field so wild
/// was not seen yet); [`MeshError::Empty`] when nothing is inside.
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
    // A look at a coarse lattice first; then the count goes about with the cell to the power -3, and two
    // counts tell the power better.
    let mut cell = (size.product() / COARSE_CELLS.min(target as f64 / 3.0)).cbrt().min(size.max());
    let mut tried: Vec<(f64, usize)> = Vec::new();
    let mut nearest: Option<usize> = None;
    let mut found_angles = None;
    let mut moved = false;
    for attempt in 0..MAX_ATTEMPTS {
        progress(attempt as f32 / (attempt + 2) as f32);
        // Where symmetry makes the count jump (it goes in steps of up to 48) another place of the lattice helps.
        let shift = if attempt < SYMMETRIC_ATTEMPTS && !moved { 0.0 } else { attempt as f64 };
        let (mesh, dropped) = mesh(sdf, cell, SHIFT.map(|s| s * shift % 1.0))?;
        let mesh = keep_parts(mesh, options.parts);
        let count = mesh.tets.len();
        if count.abs_diff(target) as f64 <= COUNT_TOLERANCE * target as f64 {
            // A mesh that lost tetrahedra, or whose angles go beyond the bounds, is set aside: another place of
            // the lattice does better. Angles are never let through.
            let quality = mesh.quality();
            let bad_angles = quality.min_dihedral_deg < DIHEDRAL_BOUNDS_DEG[0]
                || quality.max_dihedral_deg > DIHEDRAL_BOUNDS_DEG[1];
            if !bad_angles && (dropped == 0 || attempt >= PATIENT_ATTEMPTS) {
                mesh.check()?;
                progress(1.0);
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

/// Cells of the first lattice.
const COARSE_CELLS: f64 = 6000.0;
const MAX_ATTEMPTS: usize = 40;
/// For so many attempts a mesh is refused that lost tetrahedra to keep its boundary a manifold.
const PATIENT_ATTEMPTS: usize = 12;
/// The cell is halved as often to find something in a box that seems empty.
const EMPTY_ATTEMPTS: usize = 7;
const SYMMETRIC_ATTEMPTS: usize = 6;
/// Steps that cover the cell evenly: powers of the inverse plastic number.
const SHIFT: [f64; 3] = [0.819_172_513, 0.671_043_606, 0.549_700_478];

/// The cell at which the count should come out right, from what was tried.
fn next_cell(tried: &[(f64, usize)], target: usize) -> f64 {
    let log = |count: usize| (count as f64).ln();
    match *tried {
        [] => f64::NAN,
        [.., (cell, 0)] => cell / 2.0,
        [.., (x0, y0), (x1, y1)] if tried.len() < SYMMETRIC_ATTEMPTS && y0 > 0 && y0 != y1 => {
            let power = (log(y1) - log(y0)) / (x1.ln() - x0.ln());
            x1 * ((log(target) - log(y1)) / power.clamp(-6.0, -2.0)).exp()
        }
        // Counts that jump (parts join and part as the cell changes) tell no power.
        [.., (cell, count)] => cell * (count as f64 / target as f64).cbrt(),
    }
}

/// All tetrahedra of the lattice with one size of cell, as a manifold, and how many were dropped to make it one.
fn mesh(sdf: &dyn SignedDistance, cell: f64, shift: [f64; 3]) -> Result<(TetMesh, usize), MeshError> {
    let lattice = Lattice::new(sdf, cell, shift)?;
    let mut mesh = TetMesh::default();
    let mut index_of: HashMap<u64, u32> = HashMap::new();
    // Points on the surface, where pieces may touch that do not hang together.
    let mut on_surface = Vec::new();
    lattice.for_each_tet(|corners| {
        fill(corners, corners.map(|p| lattice.side(p)), |nodes| {
            let found = nodes.map(|node| {
                let key = match node {
                    Node::Point(p) => lattice.point_key(p)?,
                    Node::Cut(a, b) => lattice.edge_key(a, b)?,
                };
                if let Some(&index) = index_of.get(&key) {
                    return Some(index);
                }
                let (position, on) = match node {
                    Node::Point(p) => (lattice.position(p), lattice.side(p) == Side::On),
                    Node::Cut(a, b) => (lattice.cut(a, b)?, true),
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
