//! Bodies from the nodes of a glTF scene.

use bevy::prelude::*;

use super::{
    BakeBodyError, BakeFailed, BakeProgress, BakeRequest, BakeSettings,
    from_mesh::{loaded, triangles},
};
use crate::ModalBody;

/// Makes a body of this node of a spawned glTF scene: the entity whose children have the meshes of
/// the node's primitives. Needs [`BakePlugin`](crate::BakePlugin).
///
/// The primitives are baked as one body ([`BakeRequest::meshes`]), which replaces this component by
/// a [`BakeRequest`] and a [`ModalBody`]. The children keep their materials and draw their part of
/// the surface (`SurfacePart`, feature `render`). Until the bake is done they draw what they drew.
/// A skin of the node then ends: the body is baked as the mesh was modeled, and its entity stays
/// where it is in the scene.
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_body::BakeNode;
/// fn bake(mut commands: Commands, nodes: Query<(Entity, &Name), Added<Name>>) {
///     for (node, _) in nodes.iter().filter(|(_, name)| name.as_str() == "Jelly") {
///         commands.entity(node).insert(BakeNode::default());
///     }
/// }
/// ```
///
/// What [`BakeSettings`] lack, such as a limit of the sites of a very large surface, a
/// [`BakeRequest`] has.
///
/// Its settings are plain data, so that an inspector shows them, and a level editor such as
/// Skein for Blender puts the component on a node: `pliant_body::bake::node::BakeNode`.
#[derive(Component, Reflect, Debug, Default, Clone, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct BakeNode {
    /// How the body is made. Anchors and regions are in the space of the mesh.
    pub settings: BakeSettings,
}

pub(super) fn bake_nodes(
    mut commands: Commands,
    (meshes, server): (Option<Res<Assets<Mesh>>>, Option<Res<AssetServer>>),
    nodes: Query<(NameOrEntity, &BakeNode, Option<&Children>)>,
    drawn: Query<(Entity, &Mesh3d)>,
) {
    for (name, node, children) in &nodes {
        let entity = name.entity;
        let (parts, handles): (Vec<_>, Vec<_>) = children
            .map_or(&[][..], |children| &**children)
            .iter()
            .filter_map(|&child| drawn.get(child).ok())
            .map(|(child, mesh)| (child, mesh.0.clone()))
            .unzip();
        let config = node.settings.config();
        let counts = loaded(&handles, meshes.as_deref(), server.as_deref()).and_then(|meshes| {
            let Some(meshes) = meshes else { return Ok(None) };
            if meshes.is_empty() {
                return Err(BakeBodyError::UnusableMesh { expected: "a node whose children have meshes" });
            }
            let count = |mesh: &&Mesh| Ok(triangles(mesh)?.triangles.len() as u32);
            meshes.iter().map(count).collect::<Result<Vec<u32>, BakeBodyError>>().map(Some)
        });
        match counts.and_then(|counts| Ok((counts, config?))) {
            Ok((None, _)) => {}
            Ok((Some(counts), config)) => {
                give_parts(&mut commands, &parts, &counts);
                let tets = node.settings.tets;
                let request = BakeRequest { tets, config, ..BakeRequest::meshes(handles) };
                commands
                    .entity(entity)
                    .try_remove::<BakeNode>()
                    .try_insert_if_new(ModalBody::default())
                    .try_insert(request);
            }
            Err(error) => {
                error!("{name}: {error}");
                let progress = BakeProgress::Failed { reason: error.to_string() };
                commands.entity(entity).try_remove::<BakeNode>().try_insert(progress);
                commands.trigger(BakeFailed { entity, error });
            }
        }
    }
}

/// Gives each child the triangles that its mesh has in the body's surface.
#[cfg(feature = "render")]
fn give_parts(commands: &mut Commands, parts: &[Entity], counts: &[u32]) {
    let mut first = 0;
    for (part, count) in parts.iter().zip(counts) {
        commands.entity(*part).try_insert(crate::SurfacePart { triangles: first..first + count });
        first += count;
    }
}

#[cfg(not(feature = "render"))]
fn give_parts(_: &mut Commands, _: &[Entity], _: &[u32]) {}
