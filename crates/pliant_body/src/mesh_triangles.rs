//! Triangles of the engine's meshes.

use bevy::{
    mesh::{Indices, PrimitiveTopology, VertexAttributeValues},
    prelude::*,
};

/// Positions and triangles of a mesh, in the mesh's own space.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshTriangles {
    /// Positions of the vertices, m.
    pub positions: Vec<[f32; 3]>,
    /// Vertices of the triangles.
    pub triangles: Vec<[u32; 3]>,
}

impl MeshTriangles {
    /// Reads the triangles of a mesh. Indices are not checked.
    ///
    /// # Errors
    /// Returns what was expected, if the positions are not three `f32`, if only the renderer keeps
    /// them, or if the mesh is no list of triangles.
    pub fn of(mesh: &Mesh) -> Result<Self, &'static str> {
        let positions = match mesh.try_attribute(Mesh::ATTRIBUTE_POSITION) {
            Ok(VertexAttributeValues::Float32x3(positions)) => positions.clone(),
            _ => return Err("positions of three f32 that the main world keeps"),
        };
        if mesh.primitive_topology() != PrimitiveTopology::TriangleList {
            return Err("a list of triangles");
        }
        let indices: Vec<u32> = match mesh.try_indices() {
            Ok(Indices::U16(indices)) => indices.iter().map(|&i| u32::from(i)).collect(),
            Ok(Indices::U32(indices)) => indices.clone(),
            Err(_) => (0..positions.len() as u32).collect(),
        };
        Ok(Self { positions, triangles: indices.as_chunks::<3>().0.to_vec() })
    }
}
