//! Parts of a surface that are drawn with materials of their own.
//!
//! A part has the vertices of the whole surface, so that normals and tangents are the same on both
//! sides of its border, and only its own triangles.

use std::ops::Range;

use bevy::{
    camera::{primitives::Aabb, visibility::NoAutoAabb},
    mesh::{Indices, skinning::SkinnedMesh},
    prelude::*,
};

use super::{DrawnSurface, gpu::GpuShape};

/// Draws some triangles of a body's surface, with the material of its own entity. The entity is a
/// child of the body.
///
/// The body itself gets no material then. Every part writes the vertices of the whole surface, so a
/// body with three parts costs as much drawing as four. [`BakeNode`](crate::BakeNode) makes the
/// parts of a model. Where the entity had a mesh, it is replaced as soon as the body is there.
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_body::{ModalBody, SurfacePart};
/// # fn spawn(mut commands: Commands, body: ModalBody, beak: Handle<StandardMaterial>, skin: Handle<StandardMaterial>) {
/// commands.spawn((body, children![
///     (SurfacePart { triangles: 0..300 }, MeshMaterial3d(beak)),
///     (SurfacePart { triangles: 300..u32::MAX }, MeshMaterial3d(skin)),
/// ]));
/// # }
/// ```
#[derive(Component, Reflect, Debug, Default, Clone, PartialEq, Eq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
#[require(Transform, Visibility)]
pub struct SurfacePart {
    /// The drawn triangles, numbered as in the surface of the model. Those that it does not have
    /// are left out.
    pub triangles: Range<u32>,
}

/// What is drawn of a part.
#[derive(Component)]
pub(super) struct DrawnPart {
    triangles: Range<u32>,
    /// The mesh of the whole surface, and the number of its state.
    whole: AssetId<Mesh>,
    version: u64,
    computed: bool,
    mesh: Handle<Mesh>,
}

pub(super) fn draw_parts(
    mut commands: Commands,
    mut meshes: ResMut<Assets<Mesh>>,
    bodies: Query<(&DrawnSurface, &Aabb, Option<Ref<GpuShape>>)>,
    mut parts: Query<
        (Entity, &SurfacePart, &ChildOf, Option<&mut DrawnPart>, Option<&mut Aabb>, Option<&mut GpuShape>),
        Without<DrawnSurface>,
    >,
) {
    for (entity, part, of, mut drawn, aabb, own) in &mut parts {
        let Ok((body, bounds, shape)) = bodies.get(of.parent()) else { continue };
        let same =
            drawn.as_ref().is_some_and(|drawn| drawn.whole == body.mesh && drawn.triangles == part.triangles);
        let mesh = match &mut drawn {
            Some(drawn) if same => {
                let moved = drawn.version != body.version || drawn.computed != body.computed;
                (drawn.version, drawn.computed) = (body.version, body.computed);
                if moved && !body.computed {
                    follow(&mut meshes, body.mesh, &drawn.mesh);
                }
                drawn.mesh.clone()
            }
            _ => {
                let Some(mesh) = meshes.get(body.mesh).map(|whole| cut(whole, body, &part.triangles)) else {
                    continue;
                };
                let mesh = meshes.add(mesh);
                commands
                    .entity(entity)
                    .try_insert((
                        Mesh3d(mesh.clone()),
                        DrawnPart {
                            triangles: part.triangles.clone(),
                            whole: body.mesh,
                            version: body.version,
                            computed: body.computed,
                            mesh: mesh.clone(),
                        },
                        *bounds,
                        NoAutoAabb,
                    ))
                    // The part moves with the body, not with bones.
                    .try_remove::<(SkinnedMesh, bevy::camera::visibility::DynamicSkinnedMeshBounds)>();
                mesh
            }
        };
        if let Some(mut aabb) = aabb {
            aabb.set_if_neq(*bounds);
        }
        match (shape, own) {
            (Some(shape), Some(mut own)) => {
                if shape.is_changed() || !same {
                    own.clone_from(&shape);
                    own.mesh = mesh.id();
                }
            }
            (Some(shape), None) => {
                commands.entity(entity).try_insert(GpuShape { mesh: mesh.id(), ..(*shape).clone() });
            }
            (None, Some(_)) => {
                commands.entity(entity).try_remove::<GpuShape>();
            }
            (None, None) => {}
        }
    }
}

/// Returns the mesh of the whole surface with the triangles of a part.
fn cut(whole: &Mesh, body: &DrawnSurface, part: &Range<u32>) -> Mesh {
    let all = &body.drawing.topology.triangles;
    let end = (part.end as usize).min(all.len());
    let triangles = all.get((part.start as usize).min(end)..end).unwrap_or_default();
    let indices = triangles.iter().flatten().copied().collect();
    whole.clone().with_inserted_indices(Indices::U32(indices))
}

/// Copies the vertices of the whole surface to a part.
fn follow(meshes: &mut Assets<Mesh>, whole: AssetId<Mesh>, part: &Handle<Mesh>) {
    let moving = [Mesh::ATTRIBUTE_POSITION, Mesh::ATTRIBUTE_NORMAL, Mesh::ATTRIBUTE_TANGENT];
    let Some(whole) = meshes.get(whole) else { return };
    let values = moving.map(|attribute| whole.try_attribute(attribute).ok().cloned());
    let Some(mut part) = meshes.get_mut(part) else { return };
    for (attribute, values) in moving.into_iter().zip(values) {
        if let Some(values) = values {
            part.insert_attribute(attribute, values);
        }
    }
}
