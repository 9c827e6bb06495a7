//! Triangle surfaces.

use nalgebra::Vector3;

use crate::MeshError;

/// Triangle surface: the skin of a body, or the shape to fill with tetrahedra.
///
/// Triangles are counter-clockwise seen from outside. The fields are public, so they may be
/// inconsistent. Call [`Surface::check`] first if in doubt: the other methods panic on a vertex
/// index that is out of range.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surface {
    /// Vertex positions, m.
    pub positions: Vec<[f64; 3]>,
    /// Vertex indices of the triangles, three each.
    pub triangles: Vec<[u32; 3]>,
    /// Texture coordinates, one per position, if the source had any.
    pub uvs: Option<Vec<[f32; 2]>>,
}

impl Surface {
    /// Checks for finite coordinates, valid indices, one texture coordinate per position and at
    /// least one triangle.
    ///
    /// # Errors
    /// Returns [`MeshError::Empty`], [`MeshError::NotFinite`], [`MeshError::Index`] or
    /// [`MeshError::Parameter`].
    pub fn check(&self) -> Result<(), MeshError> {
        check_positions("vertex", &self.positions)?;
        if self.triangles.is_empty() {
            return Err(MeshError::Empty { what: "triangle" });
        }
        check_indices("triangle", &self.triangles, self.positions.len())?;
        if let Some(uvs) = &self.uvs {
            if uvs.len() != self.positions.len() {
                return Err(MeshError::parameter(
                    "uvs",
                    format!("one per position, {}", self.positions.len()),
                    uvs.len(),
                ));
            }
            if let Some(index) = uvs.iter().position(|uv| !uv.iter().all(|x| x.is_finite())) {
                return Err(MeshError::NotFinite {
                    what: "texture coordinate",
                    index,
                    found: [f64::from(uvs[index][0]), f64::from(uvs[index][1]), 0.0],
                });
            }
        }
        Ok(())
    }

    /// Returns the enclosed volume by the divergence theorem, m^3.
    ///
    /// The volume is negative when the surface is inside out. It has no meaning when the surface is
    /// open.
    pub fn volume(&self) -> f64 {
        // Coordinates are relative to a vertex of the surface, so that a body far from the origin
        // loses no digits.
        let origin = self.positions.first().copied().map_or_else(Vector3::zeros, Vector3::from);
        self.corners().map(|[a, b, c]| (a - origin).cross(&(b - origin)).dot(&(c - origin)) / 6.0).sum()
    }

    /// Returns the area, m^2.
    pub fn area(&self) -> f64 {
        self.corners().map(|[a, b, c]| 0.5 * (b - a).cross(&(c - a)).norm()).sum()
    }

    /// Returns the lowest and highest corner of the box around the vertices, m, or zeros when there
    /// are no vertices.
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        bounds(&self.positions)
    }

    /// Returns vertices - edges + triangles of the used parts: 2 for a surface like a sphere, 0 for
    /// a torus.
    pub fn euler_characteristic(&self) -> i64 {
        let mut edges: Vec<[u32; 2]> = self
            .triangles
            .iter()
            .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
            .map(|[a, b]| [a.min(b), a.max(b)])
            .collect();
        edges.sort_unstable();
        edges.dedup();
        let mut vertices: Vec<u32> = self.triangles.iter().flatten().copied().collect();
        vertices.sort_unstable();
        vertices.dedup();
        vertices.len() as i64 - edges.len() as i64 + self.triangles.len() as i64
    }

    /// Returns the number of pieces that have no vertex in common.
    pub(crate) fn part_count(&self) -> usize {
        let mut roots = self.parts();
        roots.sort_unstable();
        roots.dedup();
        roots.len()
    }

    /// Returns a number for the piece of each triangle; pieces have no vertex in common.
    pub(crate) fn parts(&self) -> Vec<u32> {
        let mut parts = Connected::new(self.positions.len());
        for t in &self.triangles {
            parts.join(t[0], t[1]);
            parts.join(t[0], t[2]);
        }
        self.triangles.iter().map(|t| parts.of(t[0])).collect()
    }

    pub(crate) fn corners(&self) -> impl Iterator<Item = [Vector3<f64>; 3]> + '_ {
        self.triangles.iter().map(|t| t.map(|v| Vector3::from(self.positions[v as usize])))
    }
}

/// Connected components of nodes, as trees that point to a representative node.
pub(crate) struct Connected(Vec<u32>);

impl Connected {
    pub(crate) fn new(nodes: usize) -> Self {
        Self((0..nodes as u32).collect())
    }

    pub(crate) fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.of(a), self.of(b));
        // The lower index becomes the root, so that the result depends on the mesh only.
        self.0[a.max(b) as usize] = a.min(b);
    }

    /// Returns the node that represents the component of `node`.
    pub(crate) fn of(&mut self, mut node: u32) -> u32 {
        while self.0[node as usize] != node {
            let above = self.0[node as usize];
            self.0[node as usize] = self.0[above as usize];
            node = above;
        }
        node
    }
}

pub(crate) fn bounds(positions: &[[f64; 3]]) -> [[f64; 3]; 2] {
    let Some(first) = positions.first() else {
        return [[0.0; 3]; 2];
    };
    positions.iter().fold([*first; 2], |[mut low, mut high], p| {
        for axis in 0..3 {
            low[axis] = low[axis].min(p[axis]);
            high[axis] = high[axis].max(p[axis]);
        }
        [low, high]
    })
}

pub(crate) fn check_positions(what: &'static str, positions: &[[f64; 3]]) -> Result<(), MeshError> {
    match positions.iter().position(|p| !p.iter().all(|x| x.is_finite())) {
        None => Ok(()),
        Some(index) => Err(MeshError::NotFinite { what, index, found: positions[index] }),
    }
}

pub(crate) fn check_indices<const N: usize>(
    what: &'static str,
    elements: &[[u32; N]],
    count: usize,
) -> Result<(), MeshError> {
    for (element, nodes) in elements.iter().enumerate() {
        if let Some(&index) = nodes.iter().find(|&&n| n as usize >= count) {
            return Err(MeshError::Index { what, element, index: u64::from(index), count });
        }
    }
    Ok(())
}
