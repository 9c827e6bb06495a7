//! Writes the deformed surface into the mesh asset on the CPU.
//!
//! Writing allocates nothing once its buffers have grown. Bevy then copies the mesh for its render
//! world.

use bevy::{camera::primitives::Aabb, math::Vec3A, mesh::VertexAttributeValues, prelude::*};
use pliant_modal::{HeldShapes, ModalModel, Precision};

use super::topology::Topology;

/// Buffers that are reused for all bodies and frames.
#[derive(Default)]
pub(super) struct Scratch {
    q: Vec<f32>,
    positions: Vec<[f32; 3]>,
    /// Places of the drawn vertices and sums of the normals, in registers of four.
    placed: Vec<Vec3A>,
    normals: Vec<Vec3A>,
}

/// A shape to write.
pub(super) struct Shape<'a> {
    /// Modal coordinates.
    pub q: &'a [f64],
    pub warped: bool,
    /// The own shapes of held patches, with their coordinates.
    pub held: Option<(&'a HeldShapes, &'a [f64])>,
}

/// The vertices of a mesh, taken out of it so that several meshes can be written at once.
pub(super) struct Vertices {
    positions: Vec<[f32; 3]>,
    normals: Vec<[f32; 3]>,
    /// None if the mesh has no tangents for the topology.
    tangents: Option<Vec<[f32; 4]>>,
}

impl Vertices {
    /// Takes the vertices of a mesh that was made for `topology`. Returns `None` for a mesh that
    /// was replaced by one of another topology, which is left alone.
    pub fn take(mesh: &mut Mesh, topology: &Topology) -> Option<Self> {
        let count = topology.source.len();
        // Both are there before one is taken.
        float3(mesh, Mesh::ATTRIBUTE_NORMAL.id, count)?;
        let positions = std::mem::take(float3(mesh, Mesh::ATTRIBUTE_POSITION.id, count)?);
        let normals = std::mem::take(float3(mesh, Mesh::ATTRIBUTE_NORMAL.id, count)?);
        let tangents = match mesh.try_attribute_mut(Mesh::ATTRIBUTE_TANGENT.id) {
            Ok(VertexAttributeValues::Float32x4(values)) if values.len() == topology.tangents.len() => {
                Some(std::mem::take(values))
            }
            _ => None,
        };
        Some(Self { positions, normals, tangents })
    }

    /// Gives the vertices back to the mesh they are from.
    pub fn give(self, mesh: &mut Mesh) {
        for (id, values) in
            [(Mesh::ATTRIBUTE_POSITION.id, self.positions), (Mesh::ATTRIBUTE_NORMAL.id, self.normals)]
        {
            if let Some(place) = float3(mesh, id, 0) {
                *place = values;
            }
        }
        if let (Some(values), Ok(VertexAttributeValues::Float32x4(place))) =
            (self.tangents, mesh.try_attribute_mut(Mesh::ATTRIBUTE_TANGENT.id))
        {
            *place = values;
        }
    }

    /// Writes positions (m, body axes), area-weighted normals and, for a textured surface, tangents
    /// of a shape. The basis is read in `precision`. Returns the bounds.
    pub fn write(
        &mut self,
        model: &ModalModel,
        precision: Precision,
        topology: &Topology,
        shape: &Shape<'_>,
        scratch: &mut Scratch,
    ) -> Aabb {
        let Scratch { q: coordinates, positions, placed, normals } = scratch;
        coordinates.clear();
        coordinates.extend(shape.q.iter().map(|&q| q as f32));
        positions.resize(model.surface().positions().len(), [0.0; 3]);
        model.basis_in(precision).reconstruct(coordinates, shape.warped, positions);
        if let Some((shapes, s)) = shape.held {
            shapes.add_to(s, positions);
        }

        let (mut low, mut high) = (Vec3A::INFINITY, Vec3A::NEG_INFINITY);
        placed.clear();
        placed.extend(self.positions.iter_mut().zip(&topology.source).map(|(drawn, &source)| {
            *drawn = positions[source as usize];
            let place = Vec3A::from(*drawn);
            low = low.min(place);
            high = high.max(place);
            place
        }));

        // The cross product of two edges is the face normal times twice the area, so the sum
        // weights each normal by its area.
        normals.clear();
        normals.resize(topology.normals, Vec3A::ZERO);
        for triangle in &topology.triangles {
            let [a, b, c] = triangle.map(|v| placed[v as usize]);
            let face = (b - a).cross(c - a);
            for &v in triangle {
                normals[topology.normal[v as usize] as usize] += face;
            }
        }
        for normal in normals.iter_mut() {
            let squared = normal.length_squared();
            *normal = if squared > 1e-30 && squared < 1e30 {
                *normal / squared.sqrt()
            } else {
                // Division by the largest component comes first, because the square of a tiny
                // triangle's area would vanish in single precision.
                (*normal / normal.abs().max_element()).normalize_or(Vec3A::Y)
            };
        }
        for (drawn, &normal) in self.normals.iter_mut().zip(&topology.normal) {
            *drawn = normals[normal as usize].into();
        }
        if let Some(drawn) = &mut self.tangents {
            for ((drawn, tangent), &normal) in drawn.iter_mut().zip(&topology.tangents).zip(&topology.normal)
            {
                *drawn = tangent.of(positions, normals[normal as usize].into());
            }
        }
        Aabb::from_min_max(low.into(), high.into())
    }
}

fn float3(
    mesh: &mut Mesh,
    id: bevy::mesh::MeshVertexAttributeId,
    length: usize,
) -> Option<&mut Vec<[f32; 3]>> {
    match mesh.try_attribute_mut(id) {
        Ok(VertexAttributeValues::Float32x3(values)) if values.len() == length => Some(values),
        _ => None,
    }
}
