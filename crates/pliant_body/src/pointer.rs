//! Dragging bodies with the pointer.

use bevy::{input::InputSystems, math::DVec3, prelude::*};
use pliant_modal::Patch;

use crate::{Grab, GrabOf, PointerHit, UnderPointer};

/// Lets the pointer drag bodies.
///
/// A press on the deformed surface grabs the body. A drag moves the target in the plane that faces
/// the camera and contains the pressed point. Releasing the button releases the body. The plugin
/// makes an ordinary [`Grab`], on remote bodies too.
///
/// An interface that needs the pointer should disable only the press set, so that a drag always
/// ends:
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
    /// Whether the pointer can grab. `false` also releases a grabbed body. Default: `true`.
    pub enabled: bool,
    /// Button that grabs. Default: the left button.
    pub button: MouseButton,
    /// Radius of the patch as a fraction of the model's size (its largest extent). Default: `0.06`.
    pub radius: f64,
    /// Color of the target and of the line to it. A fully transparent color draws nothing. Default:
    /// a warm yellow.
    pub color: Color,
}

impl Default for PointerGrab {
    fn default() -> Self {
        Self { enabled: true, button: MouseButton::Left, radius: 0.06, color: Color::srgb(1.0, 0.85, 0.25) }
    }
}

/// The system sets that make, move and release pointer grabs, in `PreUpdate` after the frame's
/// input.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub enum PointerGrabSystems {
    /// A press on a body makes a grab.
    Press,
    /// The target tracks the pointer. Releasing the button despawns the grab.
    Drag,
}

/// Marks a grab that the pointer made, and defines the plane in which its target moves.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Clone, PartialEq)]
pub struct PointerHeld {
    /// The camera through which the pointer grabbed.
    pub camera: Entity,
    /// A point of the plane: the pressed point of the surface, m, world axes.
    pub hit: Vec3,
    /// Offset from the pointer's position in the plane to the target, m. The middle of the patch is
    /// rarely exactly under the pointer.
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
        // While the pointer is outside the window, the target stays at its last position.
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
