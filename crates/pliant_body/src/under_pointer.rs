//! What lies under the pointer, through whichever camera sees a body there.

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

/// A body as the pointer sees it.
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
/// A window may show several cameras, one over the other: the scene, and over it an interface that has no body in it. So no camera alone
/// answers for the pointer; they are asked in turn.
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
    /// The camera that it is seen through.
    pub camera: Entity,
    /// From that camera through the pointer, world axes, m.
    pub ray: Ray3d,
    /// The body's entity.
    pub body: Entity,
    /// Where its surface as it is shown is hit: `distance` along `ray`, m, and `point` in the body's axes.
    pub hit: SurfaceHit,
}

impl UnderPointer<'_, '_> {
    /// The ray through the pointer of the camera's window, wherever in it the pointer is, and the camera's place. `None` for a camera that shows
    /// no window, and while the pointer is outside of it.
    pub fn through(&self, camera: Entity) -> Option<(Ray3d, &GlobalTransform)> {
        let (_, camera, target, place, _) = self.cameras.get(camera).ok()?;
        Some((camera.viewport_to_world(place, self.cursor(target)?).ok()?, place))
    }

    /// The active cameras in whose viewport the pointer is, front-most (highest order) first, with the ray through it.
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

    /// The nearest body under the pointer, through the front-most camera that has one there: a camera sees the bodies whose [`RenderLayers`] it
    /// shares. `camera` asks that one only. Hidden bodies and those with [`NoPointerGrab`] are passed through.
    pub fn body(&self, camera: Option<Entity>) -> Option<PointerHit> {
        self.rays().filter(|(entity, _)| camera.is_none_or(|camera| camera == *entity)).find_map(
            |(camera, ray)| {
                let layers = self.cameras.get(camera).ok().and_then(|(.., layers)| layers);
                let (body, hit) = self.nearest(&ray, layers.unwrap_or_default())?;
                Some(PointerHit { camera, ray, body, hit })
            },
        )
    }

    /// The shape of a body that may be under the pointer, and its place.
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
            // The direction keeps its length in the body's axes, so that distances along it compare between bodies.
            let origin = inverse.transform_point3(ray.origin).as_dvec3();
            let direction = inverse.transform_vector3(*ray.direction).as_dvec3();
            let positions = state.positions_at(shown.q());
            let triangles = state.model().surface().triangles();
            Some((entity, pick_surface(&positions, triangles, origin.into(), direction.into())?))
        });
        hits.min_by(|a, b| a.1.distance.total_cmp(&b.1.distance))
    }

    /// Where in the window that `target` is the pointer stands, logical pixels.
    fn cursor(&self, target: &RenderTarget) -> Option<Vec2> {
        let NormalizedRenderTarget::Window(window) = target.normalize(self.primary.single().ok())? else {
            return None;
        };
        self.windows.get(window.entity()).ok()?.cursor_position()
    }
}
