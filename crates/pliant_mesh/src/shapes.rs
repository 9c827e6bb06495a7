//! Structured meshes of simple bodies, with six tetrahedra per cell.

use nalgebra::Vector3;

use crate::{MeshError, TetMesh};

/// Largest number of cells: 6e7 tetrahedra, about 1.5 GB of mesh.
const MAX_CELLS: u128 = 10_000_000;

/// Half the edge, in radii, of the cube that the center of a ball maps to.
///
/// The value keeps the cells about equal in size and all dihedral angles of a ball between 30 and
/// 112 degrees.
const SPHERE_CORE: f64 = 0.7;

/// Makes a rectangular bar with one corner at the origin and its edges along the axes.
///
/// The bar has `cells` cells along x, y and z over `size` meters. `bar([20, 3, 3], ..)` has the
/// 1,080 tetrahedra of the paper's bar. Each cell is divided into Kuhn's six tetrahedra around its
/// diagonal, and all cells are divided alike.
///
/// # Errors
/// Returns [`MeshError::Parameter`] when a count is 0, when there are more than ten million cells,
/// or when a size is not positive and finite.
pub fn bar(cells: [usize; 3], size: [f64; 3]) -> Result<TetMesh, MeshError> {
    for length in size {
        check_length("size", length)?;
    }
    grid(cells, |_, _| false, |t| [t[0] * size[0], t[1] * size[1], t[2] * size[2]])
}

/// Makes a cube of edge `side` meters with one corner at the origin and `cells` cells along each
/// edge.
///
/// # Errors
/// Returns the errors of [`bar`].
pub fn cube(cells: usize, side: f64) -> Result<TetMesh, MeshError> {
    bar([cells; 3], [side; 3])
}

/// Makes a ball of `radius` meters around the origin.
///
/// The ball is a cube of `cells` cells along each edge whose concentric cubes are mapped onto
/// spheres. Boundary nodes lie on the sphere to rounding. The cells are divided along diagonals
/// that point away from the center. No tetrahedron then has two faces on the sphere where an edge
/// of the cube was (such faces would be nearly coplanar).
///
/// # Errors
/// Returns the errors of [`bar`].
pub fn sphere(cells: usize, radius: f64) -> Result<TetMesh, MeshError> {
    check_length("radius", radius)?;
    grid(
        [cells; 3],
        |_, cell| 2 * cell + 1 < cells,
        |t| {
            let p = Vector3::from(t.map(|x| 2.0 * x - 1.0));
            let r = p.amax();
            if r == 0.0 {
                return [0.0; 3];
            }
            // Equal angles instead of equal lengths along the cube's faces give cells of similar
            // size on the sphere.
            let on_sphere = (p / r).map(|x| (x * std::f64::consts::FRAC_PI_4).tan()).normalize();
            // The map is a cube at the center and a sphere at the surface, with a smooth transition
            // between them.
            (radius * r * (r * on_sphere + (1.0 - r) * SPHERE_CORE * p / r)).into()
        },
    )
}

fn check_length(name: &'static str, length: f64) -> Result<(), MeshError> {
    if length.is_finite() && length > 0.0 {
        Ok(())
    } else {
        Err(MeshError::parameter(name, "a positive length in m", length))
    }
}

/// Divides the unit cube into cells of six tetrahedra each. `place` maps the unit cube to space and
/// preserves orientation.
///
/// Where `mirrored(axis, cell)` is true, the diagonal of a cell runs against that axis. The flag
/// depends on one index only, so neighboring cells always agree on the diagonal of their common
/// face.
fn grid(
    cells: [usize; 3],
    mirrored: impl Fn(usize, usize) -> bool,
    place: impl Fn([f64; 3]) -> [f64; 3],
) -> Result<TetMesh, MeshError> {
    let total: u128 = cells.iter().map(|&n| n as u128).fold(1, u128::saturating_mul);
    if total == 0 || total > MAX_CELLS {
        return Err(MeshError::parameter(
            "cells",
            format!("at least 1 along each axis and at most {MAX_CELLS} in all"),
            format!("{} x {} x {}", cells[0], cells[1], cells[2]),
        ));
    }
    let corners = cells.map(|n| n + 1);
    let index = |i: [usize; 3]| ((i[0] * corners[1] + i[1]) * corners[2] + i[2]) as u32;

    let mut nodes = Vec::with_capacity(corners.iter().product());
    for i in 0..corners[0] {
        for j in 0..corners[1] {
            for k in 0..corners[2] {
                let ijk = [i, j, k];
                nodes.push(place(std::array::from_fn(|a| ijk[a] as f64 / cells[a] as f64)));
            }
        }
    }

    // Each entry is an order in which a path along the cell's edges may take the three axes, and
    // whether the order is odd.
    const PATHS: [([usize; 3], bool); 6] = [
        ([0, 1, 2], false),
        ([1, 2, 0], false),
        ([2, 0, 1], false),
        ([0, 2, 1], true),
        ([1, 0, 2], true),
        ([2, 1, 0], true),
    ];
    let mut tets = Vec::with_capacity(6 * total as usize);
    for i in 0..cells[0] {
        for j in 0..cells[1] {
            for k in 0..cells[2] {
                let cell = [i, j, k];
                let mirror: [bool; 3] = std::array::from_fn(|a| mirrored(a, cell[a]));
                let start: [usize; 3] = std::array::from_fn(|a| cell[a] + usize::from(mirror[a]));
                let mirrors_odd = mirror.iter().filter(|&&m| m).count() % 2 == 1;
                for (path, odd) in PATHS {
                    let mut at = start;
                    let mut tet = [index(at); 4];
                    for (step, &axis) in path.iter().enumerate() {
                        at[axis] = if mirror[axis] { cell[axis] } else { cell[axis] + 1 };
                        tet[step + 1] = index(at);
                    }
                    if odd != mirrors_odd {
                        tet.swap(2, 3);
                    }
                    tets.push(tet);
                }
            }
        }
    }
    Ok(TetMesh { nodes, tets })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_s_bar_has_1080_tetrahedra_and_its_volume() {
        let mesh = bar([20, 3, 3], [2.0, 0.3, 0.4]).unwrap();
        mesh.check().unwrap();
        assert_eq!(mesh.tets.len(), 1080);
        assert_eq!(mesh.nodes.len(), 21 * 4 * 4);
        assert!((mesh.volume() - 0.24).abs() < 1e-13, "{}", mesh.volume());
        let (surface, nodes) = mesh.boundary();
        surface.check().unwrap();
        // Each face of a cell has two triangles.
        assert_eq!(surface.triangles.len(), 2 * (4 * 20 * 3 + 2 * 3 * 3));
        assert_eq!(surface.euler_characteristic(), 2);
        assert!((surface.area() - 2.0 * (0.6 + 0.8 + 0.12)).abs() < 1e-12);
        assert!((surface.volume() - 0.24).abs() < 1e-13, "outward and closed");
        assert!(nodes.iter().zip(&surface.positions).all(|(&n, p)| mesh.nodes[n as usize] == *p));
    }

    #[test]
    fn a_kuhn_cube_has_dihedral_angles_of_45_60_and_90_degrees() {
        let quality = cube(2, 0.5).unwrap().quality();
        assert!((quality.min_dihedral_deg - 45.0).abs() < 1e-9);
        assert!((quality.max_dihedral_deg - 90.0).abs() < 1e-9);
        assert!((quality.max_volume - 0.25_f64.powi(3) / 6.0).abs() < 1e-15);
    }

    #[test]
    fn a_ball_s_boundary_lies_on_the_sphere_and_its_elements_are_good() {
        for cells in 1..=13 {
            let radius = 0.35;
            let mesh = sphere(cells, radius).unwrap();
            mesh.check().unwrap();
            let (surface, _) = mesh.boundary();
            assert_eq!(surface.euler_characteristic(), 2);
            assert_eq!(surface.triangles.len(), 12 * cells * cells);
            for p in &surface.positions {
                assert!((Vector3::from(*p).norm() - radius).abs() < 1e-12, "{cells} cells: {p:?}");
            }
            let quality = mesh.quality();
            assert!(quality.min_dihedral_deg > 29.0, "{cells} cells: {quality:?}");
            assert!(quality.max_dihedral_deg < 114.0, "{cells} cells: {quality:?}");
        }
    }

    #[test]
    fn a_ball_s_volume_converges_with_the_square_of_the_cell() {
        let missing = |cells| 1.0 - sphere(cells, 1.0).unwrap().volume() * 0.75 / std::f64::consts::PI;
        let ratio = missing(8) / missing(16);
        assert!((ratio - 4.0).abs() < 0.2, "{ratio}");
    }

    #[test]
    fn what_no_mesh_can_have_is_refused() {
        for cells in [[0, 1, 1], [1, 0, 1], [usize::MAX; 3], [10_000_001, 1, 1]] {
            assert!(matches!(bar(cells, [1.0; 3]), Err(MeshError::Parameter { name: "cells", .. })));
        }
        for size in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(matches!(bar([1; 3], [1.0, size, 1.0]), Err(MeshError::Parameter { name: "size", .. })));
            assert!(matches!(sphere(2, size), Err(MeshError::Parameter { name: "radius", .. })));
        }
    }
}
