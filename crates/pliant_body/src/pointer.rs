//! Dragging of bodies with pointers.

use bevy::{
    camera::RenderTarget,
    math::DVec3,
    picking::{
        PickingSystems,
        backend::ray::RayMap,
        events::{Pointer, Press},
        pointer::{PointerButton, PointerId, PointerLocation, PointerPress},
    },
    prelude::*,
    window::PrimaryWindow,
};
use pliant_modal::Patch;

use crate::{BodyState, Grab, GrabOf, NoPointerGrab, SurfaceHit, VisualState};

/// Lets pointers drag bodies: the mouse, and every finger on a touch screen.
///
/// A press on the deformed surface makes a grab. The target moves in the plane that faces the
/// camera through the point that was hit. The release of the button or of the finger despawns the
/// grab. The grab is an ordinary [`Grab`], also on remote bodies.
///
/// The presses are those of Bevy's picking, so the plugin needs `DefaultPickingPlugins`, which is a
/// part of `DefaultPlugins`. An interface with a picking backend of its own, such as Bevy's UI or
/// egui, covers the bodies behind it.
#[derive(Debug, Default, Clone, Copy)]
pub struct PointerGrabPlugin;

/// Settings of [`PointerGrabPlugin`].
#[derive(Resource, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Resource, Default, Clone, PartialEq)]
pub struct PointerGrab {
    /// `false` stops new grabs and ends those that exist. Default: `true`.
    pub enabled: bool,
    /// The button that grabs. Default: the primary button, which is also a finger's.
    pub button: PointerButton,
    /// Radius of the patch as a fraction of the model's largest extent. Default: `0.06`.
    pub radius: f64,
    /// Color of the target and of the line to it. Default: a warm yellow. Nothing is drawn in a
    /// fully transparent color.
    pub color: Color,
}

impl Default for PointerGrab {
    fn default() -> Self {
        let color = Color::srgb(1.0, 0.85, 0.25);
        Self { enabled: true, button: PointerButton::Primary, radius: 0.06, color }
    }
}

/// The system set that moves and ends pointer grabs, in `PreUpdate` after Bevy's picking.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub struct PointerGrabSystems;

/// Marks a grab that a pointer made.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct PointerHeld {
    /// The pointer that holds the body.
    pub pointer: PointerId,
    /// The camera through which the body was picked.
    pub camera: Entity,
    /// A point of the plane in which the target moves: the point that was hit, m, world axes.
    pub hit: Vec3,
    /// Vector from the pointer's point in the plane to the target, m. It is not zero, because the
    /// middle of the patch is seldom exactly under the pointer.
    pub offset: DVec3,
    /// Radius of the sphere drawn at the target, m.
    pub mark: f32,
}

impl Default for PointerHeld {
    /// The mouse, and no camera.
    fn default() -> Self {
        let (pointer, camera) = (PointerId::default(), Entity::PLACEHOLDER);
        Self { pointer, camera, hit: Vec3::ZERO, offset: DVec3::ZERO, mark: 0.0 }
    }
}

impl Plugin for PointerGrabPlugin {
    fn build(&self, app: &mut App) {
        app.register_type::<PointerGrab>()
            .register_type::<PointerHeld>()
            .init_resource::<PointerGrab>()
            .configure_sets(PreUpdate, PointerGrabSystems.after(PickingSystems::Last))
            .add_observer(press)
            .add_systems(PreUpdate, drag.in_set(PointerGrabSystems).run_if(resource_exists::<RayMap>));
    }

    #[cfg(feature = "render")]
    fn finish(&self, app: &mut App) {
        if app.is_plugin_added::<bevy::gizmos::GizmoPlugin>() {
            app.add_systems(Update, draw);
        }
    }
}

fn press(
    press: On<Pointer<Press>>,
    mut commands: Commands,
    settings: Res<PointerGrab>,
    bodies: Query<(&BodyState, &VisualState, &GlobalTransform), Without<NoPointerGrab>>,
    held: Query<&PointerHeld>,
) {
    let taken = held.iter().any(|held| held.pointer == press.pointer_id);
    if !settings.enabled || press.button != settings.button || taken {
        return;
    }
    // A press on a child of the body bubbles up with a hit that is not the body's.
    let hit = &press.hit;
    let (Some(surface), Some(point)) = (hit.extra_as::<SurfaceHit>(), hit.position) else { return };
    let body = press.original_event_target();
    if body != press.entity {
        return;
    }
    let Ok((state, visual, place)) = bodies.get(body) else { return };
    let radius = settings.radius.max(0.0) * state.model().size();
    let Ok(patch) = Patch::around(state.model().surface(), surface.vertex, radius) else { return };
    let positions = state.positions(visual);
    let middle = place.transform_point(middle_of(&patch, &positions).as_vec3());
    let mark = (0.015 * state.model().size() * state.scale()) as f32;
    let offset = (middle - point).as_dvec3();
    commands.spawn((
        Name::new("pointer grab"),
        Grab::new(surface.vertex, radius, middle.as_dvec3()),
        GrabOf(body),
        PointerHeld { pointer: press.pointer_id, camera: hit.camera, hit: point, offset, mark },
    ));
}

fn middle_of(patch: &Patch, positions: &[[f32; 3]]) -> DVec3 {
    let entries = patch.entries().iter();
    entries.filter_map(|&(v, w)| Some(Vec3::from(*positions.get(v as usize)?).as_dvec3() * w)).sum()
}

fn drag(
    mut commands: Commands,
    settings: Res<PointerGrab>,
    pointers: Query<(&PointerId, &PointerLocation, &PointerPress)>,
    cameras: Query<(&Camera, &RenderTarget, &GlobalTransform)>,
    primary: Query<Entity, With<PrimaryWindow>>,
    mut held: Query<(Entity, &PointerHeld, &mut Grab)>,
) {
    for (entity, pointer, mut grab) in &mut held {
        // The pointer of a finger is despawned when the finger leaves the screen.
        let of = pointers.iter().find(|(id, ..)| **id == pointer.pointer);
        let down = |press: &PointerPress| match settings.button {
            PointerButton::Primary => press.is_primary_pressed(),
            PointerButton::Secondary => press.is_secondary_pressed(),
            PointerButton::Middle => press.is_middle_pressed(),
        };
        let Some((_, location, _)) = of.filter(|(.., press)| settings.enabled && down(press)) else {
            commands.entity(entity).despawn();
            continue;
        };
        // While the pointer is over another window, the target stays where it is.
        let ray = || {
            let (camera, target, place) = cameras.get(pointer.camera).ok()?;
            let location = location.location()?;
            let here = target.normalize(primary.single().ok())?;
            let ray = camera.viewport_to_world(place, location.position).ok()?;
            (here == location.target).then_some((ray, place.forward()))
        };
        let Some((ray, forward)) = ray() else { continue };
        if let Some(distance) = ray.intersect_plane(pointer.hit, InfinitePlane3d::new(forward)) {
            let target = ray.get_point(distance).as_dvec3() + pointer.offset;
            if grab.target != target {
                grab.target = target;
            }
        }
    }
}

#[cfg(feature = "render")]
fn draw(
    mut gizmos: Gizmos<crate::PliantGizmos>,
    settings: Res<PointerGrab>,
    held: Query<(&PointerHeld, &Grab, &crate::GrabForce)>,
) {
    if settings.color.alpha() <= 0.0 {
        return;
    }
    for (pointer, grab, force) in &held {
        let target = grab.target.as_vec3();
        gizmos.sphere(target, pointer.mark, settings.color);
        gizmos.line(force.point.as_vec3(), target, settings.color);
    }
}
