//! Surfaces and painted values of the engine's meshes.

use bevy::{
    asset::LoadState,
    mesh::{MeshVertexAttribute, VertexAttributeValues, VertexFormat},
    prelude::*,
};
use pliant_bake::Paint;
use pliant_mesh::Surface;

use super::{BakeBodyError, BakeRequest, BakeShape};
use crate::MeshTriangles;

/// Factor of Young's modulus at a vertex, painted in a modeler: an `f32` of 1e-6 to 1e6.
///
/// It is read from the attribute `_STIFFNESS` of glTF files when Bevy's `GltfPlugin` knows it:
/// `add_custom_vertex_attribute("STIFFNESS", ATTRIBUTE_STIFFNESS)`.
pub const ATTRIBUTE_STIFFNESS: MeshVertexAttribute =
    MeshVertexAttribute::new("Stiffness", 0x5049_4e54_0001, VertexFormat::Float32);

/// Factor of the density at a vertex, an `f32` of 1e-3 to 1e3. In glTF: `_DENSITY`.
pub const ATTRIBUTE_DENSITY: MeshVertexAttribute =
    MeshVertexAttribute::new("Density", 0x5049_4e54_0002, VertexFormat::Float32);

/// Weight of the anchor at a vertex, an `f32`. The body is fixed where it is above 1/2. In glTF:
/// `_ANCHOR`.
pub const ATTRIBUTE_ANCHOR: MeshVertexAttribute =
    MeshVertexAttribute::new("Anchor", 0x5049_4e54_0003, VertexFormat::Float32);

/// Replaces the handle of a mesh by its surface, and adds what is painted on it. Returns `None`
/// while the mesh is being loaded.
pub(super) fn resolve(
    request: &BakeRequest,
    meshes: Option<&Assets<Mesh>>,
    server: Option<&AssetServer>,
) -> Result<Option<BakeRequest>, BakeBodyError> {
    let BakeShape::Mesh(handle) = &request.shape else { return Ok(Some(request.clone())) };
    let Some(mesh) = meshes.and_then(|meshes| meshes.get(handle)) else {
        let state = server.and_then(|server| server.get_load_state(handle));
        return match state {
            Some(LoadState::Failed(error)) => Err(BakeBodyError::Load(error.to_string())),
            _ => Ok(None),
        };
    };
    let refused = |expected| BakeBodyError::UnusableMesh { expected };
    let MeshTriangles { positions, triangles } = MeshTriangles::of(mesh).map_err(refused)?;
    let uvs = match mesh.try_attribute(Mesh::ATTRIBUTE_UV_0) {
        Ok(VertexAttributeValues::Float32x2(uvs)) => Some(uvs.clone()),
        _ => None,
    };
    let positions = positions.iter().map(|p| p.map(f64::from)).collect();
    let surface = Surface { positions, triangles, uvs };
    let painted = |attribute: MeshVertexAttribute| match mesh.try_attribute(attribute) {
        Ok(VertexAttributeValues::Float32(values)) => values.iter().map(|&x| f64::from(x)).collect(),
        _ => Vec::new(),
    };
    let mut config = request.config.clone();
    let [stiffness, density, anchored] =
        [ATTRIBUTE_STIFFNESS, ATTRIBUTE_DENSITY, ATTRIBUTE_ANCHOR].map(painted);
    if config.paint.is_none() && [&stiffness, &density, &anchored].iter().any(|values| !values.is_empty()) {
        config.paint = Some(Paint { surface: surface.clone(), stiffness, density, anchored });
    }
    Ok(Some(BakeRequest { shape: surface.into(), config, ..request.clone() }))
}
