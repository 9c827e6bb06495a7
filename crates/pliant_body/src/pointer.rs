//! Dragging bodies with the pointer.

use bevy::{input::InputSystems, math::DVec3, prelude::*};
use pliant_modal::Patch;

use crate::{Grab, GrabOf, PointerHit, UnderPointer};

/// Lets the pointer drag bodies: press on the deformed surface, drag in the plane that faces the camera through the place that was hit,
/// let go to release. The grab it makes is an ordinary [`Grab`], on remote bodies too.
///
/// An interface that wants the pointer for itself gates the press and only the press, so that a drag always ends:
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_body::PointerGrabSystems;
/// # #[derive(Resource)] struct PanelWantsPointer(bool);
/// # let mut app = App::new();
/// app.configure_sets(PreUpdate, PointerGrabSystems::Press.run_if(|panel: Res<PanelWantsPointer>| !panel.0));
/// ```
#[derive(Debug, Default, Clone, Copy)]
pub struct PointerGrabPlugin;

/// Settings of [`PointerGrabPlugin`].
#[derive(Resource, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Resource, Default, Clone, PartialEq)]
pub struct PointerGrab {
    /// Off: nothing is grabbed, and what is held is let go. Default: `true`.
    pub enabled: bool,
    /// The button that grabs. Default: the left one.
    pub button: MouseButton,
    /// Radius of the patch as a part of the model's size (its largest extent). Default: `0.06`.
    pub radius: f64,
    /// Color of the target and of the line to it. Default: a warm yellow; nothing is drawn when it is fully transparent.
    pub color: Color,
}

impl Default for PointerGrab {
    fn default() -> Self {
        Self { enabled: true, button: MouseButton::Left, radius: 0.06, color: Color::srgb(1.0, 0.85, 0.25) }
    }
}

/// Where pointer grabs are made, moved and let go, in `PreUpdate` after the input of the frame.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub enum PointerGrabSystems {
    /// A press on a body makes a grab.
    Press,
    /// The target follows the pointer; the button going up despawns the grab.
    Drag,
}

/// On a grab that the pointer made: the plane its target moves in.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Clone, PartialEq)]
pub struct PointerHeld {
    /// The camera that was looked through.
    pub camera: Entity,
    /// A point of the plane: where the surface was hit, m, in world axes.
    pub hit: Vec3,
    /// From the pointer's place in the plane to the target, m: the middle of the patch is seldom right under the pointer.
    pub offset: DVec3,
    /// Radius of the sphere drawn at the target, m.
    pub mark: f32,
}

impl Plugin for PointerGrabPlugin {
    fn build(&self, app: &mut App) {
        app.register_type::<PointerGrab>()
            .register_type::<PointerHeld>()
            .init_resource::<PointerGrab>()
            .configure_sets(
                PreUpdate,
                (PointerGrabSystems::Press, PointerGrabSystems::Drag).chain().after(InputSystems),
            )
            .add_systems(
                PreUpdate,
                (press.in_set(PointerGrabSystems::Press), drag.in_set(PointerGrabSystems::Drag)),
            );
    }

    #[cfg(feature = "render")]
    fn finish(&self, app: &mut App) {
        if app.is_plugin_added::<bevy::gizmos::GizmoPlugin>() {
            app.add_systems(Update, draw);
        }
    }
}

fn press(
    mut commands: Commands,
    settings: Res<PointerGrab>,
    buttons: Option<Res<ButtonInput<MouseButton>>>,
    pointer: UnderPointer,
    held: Query<(), With<PointerHeld>>,
) {
    let pressed = buttons.is_some_and(|buttons| buttons.just_pressed(settings.button));
    if !pressed || !settings.enabled || !held.is_empty() {
        return;
    }
    let Some(PointerHit { camera, ray, body, hit }) = pointer.body(None) else { return };
    let Some((state, shown, transform)) = pointer.shape(body) else { return };
    let positions = state.positions_at(shown.q());
    let radius = settings.radius.max(0.0) * state.model().size();
    let Ok(patch) = Patch::around(state.model().surface(), hit.vertex, radius) else { return };
    let middle = transform.transform_point(middle_of(&patch, &positions).as_vec3());
    let point = ray.get_point(hit.distance as f32);
    let mark = (0.015 * state.model().size() * state.scale()) as f32;
    commands.spawn((
        Name::new("pointer grab"),
        Grab::new(hit.vertex, radius, middle.as_dvec3()),
        GrabOf(body),
        PointerHeld { camera, hit: point, offset: (middle - point).as_dvec3(), mark },
    ));
}

fn middle_of(patch: &Patch, positions: &[[f32; 3]]) -> DVec3 {
    let entries = patch.entries().iter();
    entries.filter_map(|&(v, w)| Some(Vec3::from(*positions.get(v as usize)?).as_dvec3() * w)).sum()
}

fn drag(
    mut commands: Commands,
    settings: Res<PointerGrab>,
    buttons: Option<Res<ButtonInput<MouseButton>>>,
    cameras: UnderPointer,
    mut held: Query<(Entity, &PointerHeld, &mut Grab)>,
) {
    let down = settings.enabled && buttons.is_some_and(|buttons| buttons.pressed(settings.button));
    for (entity, pointer, mut grab) in &mut held {
        if !down {
            commands.entity(entity).despawn();
            continue;
        }
        // Outside the window the target waits at its last place.
        let Some((ray, camera)) = cameras.through(pointer.camera) else { continue };
        let facing = InfinitePlane3d::new(camera.forward());
        if let Some(distance) = ray.intersect_plane(pointer.hit, facing) {
            let target = ray.get_point(distance).as_dvec3() + pointer.offset;
            if grab.target != target {
                grab.target = target;
            }
        }
    }
}

#[cfg(feature = "render")]
fn draw(
    mut gizmos: Gizmos,
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
