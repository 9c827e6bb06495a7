//! Entities that sit on the surface of a body.

use bevy::{
    math::{DMat3, DQuat, DVec3},
    prelude::*,
};
use pliant_modal::ModalModel;

use crate::{BodyError, BodyState, VisualState, step::Refusals};

/// Lets an entity sit on the surface of a body and follow it: a hat, a lamp, a source of sound.
///
/// The plugin writes translation and rotation of the entity's `Transform` in every frame, from the
/// state of the body that is shown in this frame, before transforms are propagated. The scale stays
/// as it is. The entity's y axis is the normal of the surface, and its x axis is that of the body,
/// laid into the surface at rest and then moved with the material. The entity may have a parent,
/// also the body itself. It follows remote bodies too, such as those of a guest.
///
/// If the body is despawned, the entity stays where it is and loses this component. The same
/// happens with a place that the body does not have. Either is reported once
/// ([`BodyRefused`](crate::BodyRefused)).
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_body::{ModalBody, SurfaceAnchor};
/// fn setup(mut commands: Commands, assets: Res<AssetServer>) {
///     let body = commands.spawn(ModalBody::new(assets.load("pip.modal"))).id();
///     // On top of the body, half a meter above its origin.
///     commands.spawn((SurfaceAnchor::nearest(body, Vec3::new(0.0, 0.5, 0.0)), Transform::default()));
/// }
/// ```
#[derive(Component, FromTemplate, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
#[require(Transform)]
pub struct SurfaceAnchor {
    /// The body.
    #[entities]
    pub body: Entity,
    /// The place on its surface.
    pub place: SurfacePlace,
}

impl Default for SurfaceAnchor {
    /// Follows no body.
    fn default() -> Self {
        Self { body: Entity::PLACEHOLDER, place: SurfacePlace::default() }
    }
}

/// A place on the surface of a body.
#[derive(Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub enum SurfacePlace {
    /// The place nearest to this point at rest, m, axes of the body. The plugin replaces it by the
    /// place that it finds.
    Nearest(Vec3),
    /// A place in a triangle.
    In {
        /// Index of the triangle in the surface of the model.
        triangle: u32,
        /// Weights of its three corners, with the sum 1.
        weights: Vec3,
    },
}

impl Default for SurfacePlace {
    /// The place nearest to the origin.
    fn default() -> Self {
        Self::Nearest(Vec3::ZERO)
    }
}

impl SurfaceAnchor {
    /// Sits at the place of the surface that is nearest to `point` at rest (m, axes of the body).
    pub fn nearest(body: Entity, point: Vec3) -> Self {
        Self { body, place: SurfacePlace::Nearest(point) }
    }
}

/// Axes of a triangle: tangent, normal and the direction across both. The tangent goes from the
/// first corner to the second. `None` for a triangle without area.
fn axes([a, b, c]: &[DVec3; 3]) -> Option<DMat3> {
    let tangent = (b - a).try_normalize()?;
    let normal = tangent.cross(c - a).try_normalize()?;
    Some(DMat3::from_cols(tangent, normal, tangent.cross(normal)))
}

/// Axes of an entity that sits on a triangle at rest: y along the normal and x nearest to the
/// body's own, or to its z axis where x is the normal.
fn resting_axes(triangle: &DMat3) -> DMat3 {
    let normal = triangle.y_axis;
    let x = if normal.x.abs() < 0.99 { DVec3::X } else { DVec3::Z };
    let x = x.reject_from_normalized(normal).normalize();
    DMat3::from_cols(x, normal, x.cross(normal))
}

/// The surface of a body that is shown in this frame.
struct VisualSurface<'a> {
    model: &'a ModalModel,
    warps: bool,
    visual: &'a VisualState,
    /// Coordinates that draw the surface.
    q: &'a [f64],
}

impl VisualSurface<'_> {
    fn vertex(&self, vertex: u32) -> Option<DVec3> {
        let mut at = DVec3::from(self.model.vertex_position(vertex, self.q, self.warps)?);
        if let Some((shapes, s)) = self.visual.held()
            && let Ok(index) = shapes.vertices().binary_search(&vertex)
        {
            at += DVec3::from(shapes.displacements(s).nth(index)?.map(f64::from));
        }
        Some(at)
    }

    /// Position and rotation of an entity at a place, m, axes of the body. `None` for a place that
    /// the surface does not have, and where its triangle has no area.
    fn place(&self, triangle: u32, weights: Vec3) -> Option<(DVec3, DQuat)> {
        let surface = self.model.surface();
        let corners = surface.triangles().get(triangle as usize)?;
        let rest = corners.map(|v| surface.positions().get(v as usize).map(|p| p.map(f64::from).into()));
        let rest: [DVec3; 3] = [rest[0]?, rest[1]?, rest[2]?];
        let now = [self.vertex(corners[0])?, self.vertex(corners[1])?, self.vertex(corners[2])?];
        let at: DVec3 = now.iter().zip(weights.to_array()).map(|(at, weight)| *at * f64::from(weight)).sum();
        let (then, now) = (axes(&rest)?, axes(&now)?);
        let turned = now * then.transpose() * resting_axes(&then);
        at.is_finite().then(|| (at, DQuat::from_mat3(&turned).normalize()))
    }
}

/// Places the entities that sit on bodies.
pub(crate) fn place_on_surfaces(
    mut commands: Commands,
    mut refusals: Refusals,
    mut q: Local<Vec<f64>>,
    mut places: Local<Vec<(Entity, Transform)>>,
    bodies: Query<(&BodyState, &VisualState)>,
    there: Query<Entity>,
    mut anchors: Query<(NameOrEntity, &mut SurfaceAnchor, Option<&ChildOf>)>,
    mut transforms: ParamSet<(TransformHelper, Query<&mut Transform>)>,
) {
    places.clear();
    let helper = transforms.p0();
    for (name, mut anchor, parent) in &mut anchors {
        let entity = name.entity;
        let mut refuse = |error| {
            refusals.report(&name, entity, error);
            commands.entity(entity).try_remove::<SurfaceAnchor>();
        };
        let Ok((state, visual)) = bodies.get(anchor.body) else {
            // A body whose model is not loaded yet is waited for.
            if !there.contains(anchor.body) {
                refuse(BodyError::NoSurface);
            }
            continue;
        };
        if let SurfacePlace::Nearest(point) = anchor.place {
            let Some((triangle, weights)) = state.model().surface().nearest(point.as_dvec3().into()) else {
                refuse(BodyError::NoSurfacePlace);
                continue;
            };
            anchor.place = SurfacePlace::In { triangle, weights: weights.map(|x| x as f32).into() };
        }
        let SurfacePlace::In { triangle, weights } = anchor.place else { continue };
        visual.draw(&mut q);
        let shown = VisualSurface { model: state.model(), warps: state.warps(), visual, q: &q };
        let surface = state.model().surface();
        if triangle as usize >= surface.triangles().len() || !weights.is_finite() {
            refuse(BodyError::NoSurfacePlace);
            continue;
        }
        // Where the triangle is flat in this frame, the entity stays.
        let Some((at, rotation)) = shown.place(triangle, weights) else { continue };
        let on_body = Transform::from_translation(at.as_vec3()).with_rotation(rotation.as_quat());
        let parent = parent.map(ChildOf::parent);
        let transform = if parent == Some(anchor.body) {
            on_body
        } else {
            let Ok(body) = helper.compute_global_transform(anchor.body) else { continue };
            let whole = body.mul_transform(on_body);
            let above = match parent.map(|parent| helper.compute_global_transform(parent)) {
                Some(Ok(above)) => above,
                Some(Err(_)) => continue,
                None => GlobalTransform::IDENTITY,
            };
            whole.reparented_to(&above)
        };
        if transform.is_finite() {
            places.push((entity, transform));
        }
    }
    let mut targets = transforms.p1();
    for (entity, place) in places.iter() {
        let Ok(mut transform) = targets.get_mut(*entity) else { continue };
        let next = Transform { scale: transform.scale, ..*place };
        transform.set_if_neq(next);
    }
}
