//! Tetrahedral meshes.

use nalgebra::Vector3;

use crate::{
    MeshError, Surface,
    surface::{bounds, check_indices, check_positions},
};

/// Fraction of its longest edge cubed below which six times a tetrahedron's volume counts as zero.
const FLAT: f64 = 1e-12;

/// Mesh of linear tetrahedra.
///
/// The nodes a, b, c, d of each tetrahedron are positively oriented: (b - a) x (c - a) . (d -
/// a) > 0. The fields are public, so they may be inconsistent. Call [`TetMesh::check`] first if in
/// doubt: the other methods panic on a node index that is out of range.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TetMesh {
    /// Node positions, m.
    pub nodes: Vec<[f64; 3]>,
    /// Node indices of the tetrahedra, four each.
    pub tets: Vec<[u32; 4]>,
}

/// Shape quality of the tetrahedra of a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub struct Quality {
    /// Smallest angle between two faces of one tetrahedron, degrees.
    pub min_dihedral_deg: f64,
    /// Largest angle between two faces of one tetrahedron, degrees.
    pub max_dihedral_deg: f64,
    /// Smallest volume of a tetrahedron, m^3.
    pub min_volume: f64,
    /// Largest volume of a tetrahedron, m^3.
    pub max_volume: f64,
}

impl TetMesh {
    /// Checks for finite nodes, valid indices, at least one tetrahedron and positive volumes.
    ///
    /// # Errors
    /// Returns [`MeshError::Empty`], [`MeshError::NotFinite`], [`MeshError::Index`] or
    /// [`MeshError::FlatTet`].
    pub fn check(&self) -> Result<(), MeshError> {
        check_positions("node", &self.nodes)?;
        if self.tets.is_empty() {
            return Err(MeshError::Empty { what: "tetrahedron" });
        }
        check_indices("tetrahedron", &self.tets, self.nodes.len())?;
        for (tet, &nodes) in self.tets.iter().enumerate() {
            let corners = self.corners(nodes);
            let volume = signed_volume(corners);
            // This form of the comparison also refuses an overflow to infinity or NaN.
            let sound = volume.is_finite() && 6.0 * volume > FLAT * longest_edge(corners).powi(3);
            if !sound {
                return Err(MeshError::FlatTet {
                    tet,
                    nodes,
                    volume,
                    at: (corners.iter().sum::<Vector3<f64>>() / 4.0).into(),
                });
            }
        }
        Ok(())
    }

    /// Returns the total volume, m^3.
    pub fn volume(&self) -> f64 {
        self.tets.iter().map(|&t| signed_volume(self.corners(t))).sum()
    }

    /// Returns the lowest and highest corner of the box around the nodes, m, or zeros when there
    /// are no nodes.
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        bounds(&self.nodes)
    }

    /// Returns the surface of all faces that belong to one tetrahedron only, and the node of each
    /// of its vertices.
    ///
    /// The faces are counter-clockwise seen from outside. The vertices keep the order of the nodes.
    pub fn boundary(&self) -> (Surface, Vec<u32>) {
        let mut faces: Vec<([u32; 3], [u32; 3])> = self
            .tets
            .iter()
            .flat_map(|&[a, b, c, d]| [[b, c, d], [a, d, c], [a, b, d], [a, c, b]])
            .map(|face| {
                let mut key = face;
                key.sort_unstable();
                (key, face)
            })
            .collect();
        faces.sort_unstable();
        let triangles: Vec<[u32; 3]> =
            faces.chunk_by(|a, b| a.0 == b.0).filter(|same| same.len() == 1).map(|same| same[0].1).collect();
        let mut nodes: Vec<u32> = triangles.iter().flatten().copied().collect();
        nodes.sort_unstable();
        nodes.dedup();
        let mut vertex_of = vec![u32::MAX; self.nodes.len()];
        for (vertex, &node) in nodes.iter().enumerate() {
            vertex_of[node as usize] = vertex as u32;
        }
        let surface = Surface {
            positions: nodes.iter().map(|&n| self.nodes[n as usize]).collect(),
            triangles: triangles.iter().map(|t| t.map(|n| vertex_of[n as usize])).collect(),
            uvs: None,
        };
        (surface, nodes)
    }

    /// Returns the smallest and largest dihedral angle and volume over all tetrahedra. All values
    /// are NaN when there are none.
    pub fn quality(&self) -> Quality {
        let mut quality = Quality {
            min_dihedral_deg: f64::NAN,
            max_dihedral_deg: f64::NAN,
            min_volume: f64::NAN,
            max_volume: f64::NAN,
        };
        for &tet in &self.tets {
            let corners = self.corners(tet);
            for angle in dihedral_angles_deg(corners) {
                // The NaN start values vanish, because f64::min and max return the other operand
                // when one is NaN.
                quality.min_dihedral_deg = quality.min_dihedral_deg.min(angle);
                quality.max_dihedral_deg = quality.max_dihedral_deg.max(angle);
            }
            let volume = signed_volume(corners);
            quality.min_volume = quality.min_volume.min(volume);
            quality.max_volume = quality.max_volume.max(volume);
        }
        quality
    }

    /// Drops nodes that no tetrahedron uses. The other nodes keep their order.
    pub fn drop_unused_nodes(&mut self) {
        let mut used = vec![false; self.nodes.len()];
        for &n in self.tets.iter().flatten() {
            used[n as usize] = true;
        }
        if used.iter().all(|&u| u) {
            return;
        }
        let mut kept = Vec::with_capacity(self.nodes.len());
        let mut new_index = vec![u32::MAX; self.nodes.len()];
        for (old, &p) in self.nodes.iter().enumerate().filter(|(n, _)| used[*n]) {
            new_index[old] = kept.len() as u32;
            kept.push(p);
        }
        self.nodes = kept;
        for n in self.tets.iter_mut().flatten() {
            *n = new_index[*n as usize];
        }
    }

    /// Turns tetrahedra that are inside out by exchanging their last two nodes.
    ///
    /// Many file writers do not keep one orientation.
    pub fn orient(&mut self) {
        for tet in 0..self.tets.len() {
            if signed_volume(self.corners(self.tets[tet])) < 0.0 {
                self.tets[tet].swap(2, 3);
            }
        }
    }

    pub(crate) fn corners(&self, tet: [u32; 4]) -> [Vector3<f64>; 4] {
        tet.map(|n| Vector3::from(self.nodes[n as usize]))
    }
}

/// Returns the signed volume, m^3: positive when (b - a) x (c - a) . (d - a) > 0.
pub(crate) fn signed_volume([a, b, c, d]: [Vector3<f64>; 4]) -> f64 {
    (b - a).cross(&(c - a)).dot(&(d - a)) / 6.0
}

fn longest_edge(c: [Vector3<f64>; 4]) -> f64 {
    [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
        .iter()
        .map(|&(i, j)| (c[i] - c[j]).norm())
        .fold(0.0, f64::max)
}

/// Returns the six inner angles between the faces, degrees.
pub(crate) fn dihedral_angles_deg(c: [Vector3<f64>; 4]) -> [f64; 6] {
    // The angle at edge (i, j) lies between the components of the two other edges that are normal
    // to this edge.
    [(0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2), (1, 2, 0, 3), (1, 3, 0, 2), (2, 3, 0, 1)].map(
        |(i, j, k, l)| {
            let edge = c[j] - c[i];
            let m = edge.cross(&(c[k] - c[i]));
            let n = edge.cross(&(c[l] - c[i]));
            m.cross(&n).norm().atan2(m.dot(&n)).to_degrees()
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn corner() -> TetMesh {
        TetMesh {
            nodes: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            tets: vec![[0, 1, 2, 3]],
        }
    }

    #[test]
    fn the_corner_tetrahedron_has_its_textbook_values() {
        let mesh = corner();
        mesh.check().unwrap();
        assert!((mesh.volume() - 1.0 / 6.0).abs() < 1e-15);
        let quality = mesh.quality();
        assert!((quality.min_dihedral_deg - (1.0 / 3.0_f64.sqrt()).acos().to_degrees()).abs() < 1e-12);
        assert!((quality.max_dihedral_deg - 90.0).abs() < 1e-12);
        let (surface, nodes) = mesh.boundary();
        assert_eq!(nodes, [0, 1, 2, 3]);
        assert!((surface.volume() - 1.0 / 6.0).abs() < 1e-15, "faces point outwards");
    }

    #[test]
    fn bad_meshes_are_refused_by_name() {
        let mut mesh = corner();
        mesh.tets[0] = [0, 2, 1, 3];
        assert!(matches!(mesh.check(), Err(MeshError::FlatTet { tet: 0, .. })));
        mesh.orient();
        mesh.check().unwrap();

        mesh.nodes[3] = [0.3, 0.3, 0.0];
        assert!(matches!(mesh.check(), Err(MeshError::FlatTet { .. })));
        mesh.nodes[3] = [0.0, f64::NAN, 1.0];
        assert!(matches!(mesh.check(), Err(MeshError::NotFinite { what: "node", index: 3, .. })));
        mesh.nodes[3] = [0.0, 0.0, 1e300];
        assert!(mesh.check().is_err(), "an overflowing volume is not a volume");

        let mut mesh = corner();
        mesh.tets.push([0, 1, 2, 4]);
        assert!(matches!(mesh.check(), Err(MeshError::Index { element: 1, index: 4, count: 4, .. })));
        mesh.tets.clear();
        assert!(matches!(mesh.check(), Err(MeshError::Empty { .. })));
        assert!(mesh.quality().min_dihedral_deg.is_nan());
    }

    #[test]
    fn unused_nodes_are_dropped_and_the_others_keep_their_order() {
        let mut mesh = corner();
        mesh.nodes.insert(1, [9.0; 3]);
        mesh.tets = vec![[0, 2, 3, 4]];
        mesh.drop_unused_nodes();
        assert_eq!(mesh, corner());
    }
}
