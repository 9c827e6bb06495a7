//! The body under the pointer, across all cameras of a window.

use std::cmp::Reverse;

use bevy::{
    camera::{NormalizedRenderTarget, RenderTarget, visibility::RenderLayers},
    ecs::system::SystemParam,
    prelude::*,
    window::PrimaryWindow,
};

use crate::{BodyState, NoPointerGrab, SurfaceHit, VisualState, pick_surface};

type Cameras<'w, 's> = Query<
    'w,
    's,
    (Entity, &'static Camera, &'static RenderTarget, &'static GlobalTransform, Option<&'static RenderLayers>),
>;

/// The components of a body that the pointer query reads.
type Touchable = (
    Entity,
    &'static BodyState,
    &'static VisualState,
    &'static GlobalTransform,
    Option<&'static InheritedVisibility>,
    Option<&'static RenderLayers>,
);

/// The cameras that show a window, and the bodies under its pointer.
///
/// A window may show several cameras on top of each other, for example a scene and an interface
/// without bodies. No single camera can therefore answer the query, and the cameras are tried in
/// turn.
#[derive(SystemParam)]
pub struct UnderPointer<'w, 's> {
    cameras: Cameras<'w, 's>,
    windows: Query<'w, 's, &'static Window>,
    primary: Query<'w, 's, Entity, With<PrimaryWindow>>,
    bodies: Query<'w, 's, Touchable, Without<NoPointerGrab>>,
}

/// A body under the pointer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointerHit {
    /// The camera that sees the body under the pointer.
    pub camera: Entity,
    /// The ray from that camera through the pointer, world axes, m.
    pub ray: Ray3d,
    /// The body's entity.
    pub body: Entity,
    /// The intersection with the drawn surface: `distance` along `ray`, m, and `point` in the
    /// body's axes.
    pub hit: SurfaceHit,
}

impl UnderPointer<'_, '_> {
    /// Returns the ray through the pointer, anywhere in the camera's window, and the camera's
    /// transform.
    ///
    /// Returns `None` for a camera that does not show a window, and while the pointer is outside
    /// the window.
    pub fn through(&self, camera: Entity) -> Option<(Ray3d, &GlobalTransform)> {
        let (_, camera, target, place, _) = self.cameras.get(camera).ok()?;
        Some((camera.viewport_to_world(place, self.cursor(target)?).ok()?, place))
    }

    /// Returns the active cameras whose viewport contains the pointer, each with the ray through
    /// it.
    ///
    /// The front-most camera (highest order) comes first.
    pub fn rays(&self) -> impl Iterator<Item = (Entity, Ray3d)> {
        let mut cameras: Vec<_> = self
            .cameras
            .iter()
            .filter(|(_, camera, target, ..)| {
                let inside =
                    |cursor| camera.logical_viewport_rect().is_some_and(|view| view.contains(cursor));
                camera.is_active && self.cursor(target).is_some_and(inside)
            })
            .map(|(entity, camera, ..)| (Reverse(camera.order), entity))
            .collect();
        cameras.sort_unstable();
        cameras.into_iter().filter_map(|(_, camera)| Some((camera, self.through(camera)?.0)))
    }

    /// Returns the nearest body under the pointer, through the front-most camera that sees a body
    /// there.
    ///
    /// A camera sees the bodies that share its [`RenderLayers`]. `camera` restricts the query to
    /// one camera. Hidden bodies and bodies with [`NoPointerGrab`] are ignored.
    pub fn body(&self, camera: Option<Entity>) -> Option<PointerHit> {
        self.rays().filter(|(entity, _)| camera.is_none_or(|camera| camera == *entity)).find_map(
            |(camera, ray)| {
                let layers = self.cameras.get(camera).ok().and_then(|(.., layers)| layers);
                let (body, hit) = self.nearest(&ray, layers.unwrap_or_default())?;
                Some(PointerHit { camera, ray, body, hit })
            },
        )
    }

    /// Returns the state, the visual state and the transform of a body that may be under the
    /// pointer.
    pub(crate) fn shape(&self, body: Entity) -> Option<(&BodyState, &VisualState, &GlobalTransform)> {
        let (_, state, shown, place, ..) = self.bodies.get(body).ok()?;
        Some((state, shown, place))
    }

    fn nearest(&self, ray: &Ray3d, layers: &RenderLayers) -> Option<(Entity, SurfaceHit)> {
        let seen = self.bodies.iter().filter(|(.., visible, on)| {
            visible.is_none_or(|visible| visible.get()) && layers.intersects(on.unwrap_or_default())
        });
        let hits = seen.filter_map(|(entity, state, shown, place, ..)| {
            let inverse = place.affine().inverse();
            // The direction keeps its world length in the body's axes, so that distances along the
            // ray are comparable between bodies.
            let origin = inverse.transform_point3(ray.origin).as_dvec3();
            let direction = inverse.transform_vector3(*ray.direction).as_dvec3();
            let positions = state.positions_at(shown.q());
            let triangles = state.model().surface().triangles();
            Some((entity, pick_surface(&positions, triangles, origin.into(), direction.into())?))
        });
        hits.min_by(|a, b| a.1.distance.total_cmp(&b.1.distance))
    }

    /// Returns the position of the pointer in the window of `target`, logical pixels.
    fn cursor(&self, target: &RenderTarget) -> Option<Vec2> {
        let NormalizedRenderTarget::Window(window) = target.normalize(self.primary.single().ok())? else {
            return None;
        };
        self.windows.get(window.entity()).ok()?.cursor_position()
    }
}
