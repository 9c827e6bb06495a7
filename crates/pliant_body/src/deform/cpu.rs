//! Writes the deformed surface into the mesh asset on the CPU.
//!
//! The code allocates nothing once its buffers have grown. Bevy then copies the mesh for its render
//! world.

use bevy::{camera::primitives::Aabb, mesh::VertexAttributeValues, prelude::*};
use pliant_modal::{HeldShapes, ModalModel, Precision};

use super::topology::Topology;

/// Buffers that are reused for all bodies and frames.
#[derive(Default)]
pub(super) struct Scratch {
    q: Vec<f32>,
    positions: Vec<[f32; 3]>,
    normals: Vec<Vec3>,
}

/// A shape to write.
pub(super) struct Shape<'a> {
    /// Modal coordinates.
    pub q: &'a [f64],
    pub warped: bool,
    /// The own shapes of held patches, with their coordinates.
    pub held: Option<(&'a HeldShapes, &'a [f64])>,
}

/// Writes positions (m, body axes), area-weighted normals and, for a textured surface, tangents of
/// a shape into `mesh`.
///
/// The basis is read in `precision`. `mesh` must have been made for `topology`. Returns the bounds.
/// Returns `None` for a mesh that was replaced by one of another topology, which is left alone.
pub(super) fn write(
    model: &ModalModel,
    precision: Precision,
    topology: &Topology,
    shape: &Shape<'_>,
    mesh: &mut Mesh,
    scratch: &mut Scratch,
) -> Option<Aabb> {
    let Scratch { q: coordinates, positions, normals } = scratch;
    coordinates.clear();
    coordinates.extend(shape.q.iter().map(|&q| q as f32));
    positions.resize(model.surface().positions().len(), [0.0; 3]);
    model.basis_in(precision).reconstruct(coordinates, shape.warped, positions);
    if let Some((shapes, s)) = shape.held {
        shapes.add_to(s, positions);
    }

    let drawn = float3(mesh, Mesh::ATTRIBUTE_POSITION.id, topology.source.len())?;
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for (drawn, &source) in drawn.iter_mut().zip(&topology.source) {
        *drawn = positions[source as usize];
        low = low.min(Vec3::from(*drawn));
        high = high.max(Vec3::from(*drawn));
    }

    // The cross product of two edges is the face normal times twice the area, so the sum weights
    // each normal by its area.
    normals.clear();
    normals.resize(topology.normals, Vec3::ZERO);
    for triangle in &topology.triangles {
        let [a, b, c] = triangle.map(|v| Vec3::from(drawn[v as usize]));
        let face = (b - a).cross(c - a);
        for &v in triangle {
            normals[topology.normal[v as usize] as usize] += face;
        }
    }
    for normal in normals.iter_mut() {
        // Division by the largest component comes first, because the square of a tiny triangle's
        // area would vanish in single precision.
        *normal = (*normal / normal.abs().max_element()).normalize_or(Vec3::Y);
    }
    let drawn = float3(mesh, Mesh::ATTRIBUTE_NORMAL.id, topology.source.len())?;
    for (drawn, &normal) in drawn.iter_mut().zip(&topology.normal) {
        *drawn = normals[normal as usize].into();
    }
    if let Ok(VertexAttributeValues::Float32x4(drawn)) = mesh.try_attribute_mut(Mesh::ATTRIBUTE_TANGENT.id)
        && drawn.len() == topology.tangents.len()
    {
        for ((drawn, tangent), &normal) in drawn.iter_mut().zip(&topology.tangents).zip(&topology.normal) {
            *drawn = tangent.of(positions, normals[normal as usize]);
        }
    }
    Some(Aabb::from_min_max(low, high))
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
