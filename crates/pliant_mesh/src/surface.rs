//! Triangle surfaces.

use nalgebra::Vector3;

use crate::MeshError;

/// Triangles in space: the skin of a body, or the shape that is to be filled with tetrahedra.
///
/// Triangles are counter-clockwise seen from outside. The fields are open; whoever is not sure that they are consistent
/// calls [`Surface::check`] first: the other methods panic on a vertex index that is out of range.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Surface {
    /// Vertex positions in m.
    pub positions: Vec<[f64; 3]>,
    /// Three vertex indices each.
    pub triangles: Vec<[u32; 3]>,
    /// Texture coordinates, one per position, when the source had any.
    pub uvs: Option<Vec<[f32; 2]>>,
}

impl Surface {
    /// Finite coordinates, indices in range, one texture coordinate per position, at least one triangle.
    ///
    /// # Errors
    /// [`MeshError::Empty`], [`MeshError::NotFinite`], [`MeshError::Index`] or [`MeshError::Parameter`].
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

    /// Enclosed volume in m^3 by the divergence theorem; negative when the surface is inside out.
    /// It means nothing when the surface is open.
    pub fn volume(&self) -> f64 {
        // Relative to a vertex of the surface, so that a far-away body loses no digits.
        let origin = self.positions.first().copied().map_or_else(Vector3::zeros, Vector3::from);
        self.corners().map(|[a, b, c]| (a - origin).cross(&(b - origin)).dot(&(c - origin)) / 6.0).sum()
    }

    /// Area in m^2.
    pub fn area(&self) -> f64 {
        self.corners().map(|[a, b, c]| 0.5 * (b - a).cross(&(c - a)).norm()).sum()
    }

    /// Lowest and highest corner of the box around the vertices, in m; zeros when there are none.
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        bounds(&self.positions)
    }

    /// Vertices - edges + triangles of what the triangles use: 2 for anything like a sphere, 0 for a torus.
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

    /// How many pieces there are that have no vertex in common.
    pub(crate) fn part_count(&self) -> usize {
        let mut parts = Connected::new(self.positions.len());
        for t in &self.triangles {
            parts.join(t[0], t[1]);
            parts.join(t[0], t[2]);
        }
        let mut roots: Vec<u32> = self.triangles.iter().map(|t| parts.of(t[0])).collect();
        roots.sort_unstable();
        roots.dedup();
        roots.len()
    }

    pub(crate) fn corners(&self) -> impl Iterator<Item = [Vector3<f64>; 3]> + '_ {
        self.triangles.iter().map(|t| t.map(|v| Vector3::from(self.positions[v as usize])))
    }
}

/// Which nodes hang together, as trees that point to a node of the part.
pub(crate) struct Connected(Vec<u32>);

impl Connected {
    pub(crate) fn new(nodes: usize) -> Self {
        Self((0..nodes as u32).collect())
    }

    pub(crate) fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.of(a), self.of(b));
        // The lower number leads, so that the result depends on the mesh only.
        self.0[a.max(b) as usize] = a.min(b);
    }

    /// The node that stands for the part of `node`.
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
