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

/// Returns the meshes, or `None` while one of them is being loaded.
pub(super) fn loaded<'a>(
    handles: &[Handle<Mesh>],
    meshes: Option<&'a Assets<Mesh>>,
    server: Option<&AssetServer>,
) -> Result<Option<Vec<&'a Mesh>>, BakeBodyError> {
    let mut found = Vec::with_capacity(handles.len());
    for handle in handles {
        match meshes.and_then(|meshes| meshes.get(handle)) {
            Some(mesh) => found.push(mesh),
            None => {
                return match server.and_then(|server| server.get_load_state(handle)) {
                    Some(LoadState::Failed(error)) => Err(BakeBodyError::Load(error.to_string())),
                    _ => Ok(None),
                };
            }
        }
    }
    Ok(Some(found))
}

pub(super) fn triangles(mesh: &Mesh) -> Result<MeshTriangles, BakeBodyError> {
    MeshTriangles::of(mesh).map_err(|expected| BakeBodyError::UnusableMesh { expected })
}

/// Replaces the handles of meshes by their surface, and adds what is painted on it. Returns `None`
/// while a mesh is being loaded.
pub(super) fn resolve(
    request: &BakeRequest,
    meshes: Option<&Assets<Mesh>>,
    server: Option<&AssetServer>,
) -> Result<Option<BakeRequest>, BakeBodyError> {
    let BakeShape::Meshes(handles) = &request.shape else { return Ok(Some(request.clone())) };
    let Some(meshes) = loaded(handles, meshes, server)? else { return Ok(None) };
    let mut surface = Surface::default();
    let mut uvs = Values::new([0.0; 2]);
    let mut paint = [ATTRIBUTE_STIFFNESS, ATTRIBUTE_DENSITY, ATTRIBUTE_ANCHOR]
        .map(|attribute| (attribute, Values::new(f64::NAN)));
    for mesh in meshes {
        let MeshTriangles { positions, triangles } = triangles(mesh)?;
        let (first, count) = (surface.positions.len() as u32, positions.len());
        surface.positions.extend(positions.iter().map(|p| p.map(f64::from)));
        // Numbers beyond the vertices are refused by the bake.
        surface.triangles.extend(triangles.iter().map(|t| t.map(|v| v.saturating_add(first))));
        match mesh.try_attribute(Mesh::ATTRIBUTE_UV_0) {
            Ok(VertexAttributeValues::Float32x2(of)) => uvs.add(of.iter().copied(), count),
            _ => uvs.miss(count),
        }
        for (attribute, values) in &mut paint {
            match mesh.try_attribute(*attribute) {
                Ok(VertexAttributeValues::Float32(of)) => values.add(of.iter().map(|&x| f64::from(x)), count),
                _ => values.miss(count),
            }
        }
    }
    surface.uvs = Some(uvs.all).filter(|_| uvs.any);
    let mut config = request.config.clone();
    if config.paint.is_none() {
        let painted = paint.map(|(_, values)| if values.any { values.all } else { Vec::new() });
        config.paint = Paint::of_values(&surface, painted);
    }
    Ok(Some(BakeRequest { shape: surface.into(), config, ..request.clone() }))
}

/// The values of an attribute on several meshes, some of which may not have it.
struct Values<T> {
    any: bool,
    all: Vec<T>,
    missing: T,
}

impl<T: Copy> Values<T> {
    fn new(missing: T) -> Self {
        Self { any: false, all: Vec::new(), missing }
    }

    fn add(&mut self, values: impl Iterator<Item = T>, count: usize) {
        let end = self.all.len() + count;
        self.all.extend(values.take(count));
        self.all.resize(end, self.missing);
        self.any = true;
    }

    fn miss(&mut self, count: usize) {
        self.all.resize(self.all.len() + count, self.missing);
    }
}
