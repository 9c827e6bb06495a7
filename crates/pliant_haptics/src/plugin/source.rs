//! Pointer and gamepad as hands: they move a [`Positioned`](crate::Positioned) device, and the force is shown where nobody can feel it.

use bevy::{
    camera::{NormalizedRenderTarget, RenderTarget},
    math::{DQuat, DVec3},
    prelude::*,
    window::PrimaryWindow,
};
use pliant_body::{BodyState, NoPointerGrab, ShownState, pick_surface};

use super::{HapticDevices, HapticTool, ToolGrabs, ToolPose};
use crate::PositionedHandle;

/// On a tool: the pointer moves it.
///
/// With its hands empty the tool lies on the surface under the pointer; holding something, it moves in the plane that faces the camera. The left, right and middle buttons are 0, 1 and 2. A scene with a
/// [`PointerGrabPlugin`](pliant_body::PointerGrabPlugin) switches that off (`PointerGrab::enabled`), or both take hold.
#[derive(Component, Debug, Clone)]
pub struct PointerSource {
    handle: PositionedHandle,
    /// The camera that is looked through. Default: the front-most active one that shows the window.
    pub camera: Option<Entity>,
}

impl PointerSource {
    /// For the device that `handle` moves.
    pub fn new(handle: PositionedHandle) -> Self {
        Self { handle, camera: None }
    }
}

/// How the pointer moves tools, in `PreUpdate` after the input of the frame. An interface that wants the pointer for itself gates the press and only the
/// press, so that what is held is always let go:
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_haptics::PointerToolSystems;
/// # #[derive(Resource)] struct PanelWantsPointer(bool);
/// # let mut app = App::new();
/// app.configure_sets(PreUpdate, PointerToolSystems::Press.run_if(|panel: Res<PanelWantsPointer>| !panel.0));
/// ```
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub enum PointerToolSystems {
    /// A button that goes down in the scene is the tools' until it comes up.
    Press,
    /// The tools follow the pointer, with the buttons that are theirs.
    Move,
}

/// The pointer's buttons that went down in the scene and are held still, the left, right and middle one in the lowest bits.
#[derive(Resource, Default, PartialEq)]
pub(crate) struct PointerButtons(u32);

const POINTER_BUTTONS: [MouseButton; 3] = [MouseButton::Left, MouseButton::Right, MouseButton::Middle];

fn bits(is: impl Fn(MouseButton) -> bool) -> u32 {
    POINTER_BUTTONS.into_iter().enumerate().fold(0, |bits, (i, b)| bits | u32::from(is(b)) << i)
}

pub(crate) fn press(buttons: Option<Res<ButtonInput<MouseButton>>>, mut taken: ResMut<PointerButtons>) {
    let pressed = bits(|button| buttons.as_ref().is_some_and(|b| b.just_pressed(button)));
    taken.set_if_neq(PointerButtons(taken.0 | pressed));
}

/// On a tool: a gamepad moves it. The left stick moves right and away, the right stick up; buttons South, East, West, North and the triggers are 0 to 5.
#[cfg(feature = "gamepad")]
#[derive(Component, Debug, Clone)]
pub struct GamepadSource {
    handle: PositionedHandle,
    /// The gamepad's entity. Default: the first there is.
    pub gamepad: Option<Entity>,
    /// Speed at full deflection, m/s of the device. Default: `0.15`.
    pub speed: f64,
    place: DVec3,
}

#[cfg(feature = "gamepad")]
impl GamepadSource {
    /// For the device that `handle` moves.
    pub fn new(handle: PositionedHandle) -> Self {
        Self { handle, gamepad: None, speed: 0.15, place: DVec3::ZERO }
    }
}

type Cameras<'w, 's> =
    Query<'w, 's, (Entity, &'static Camera, &'static RenderTarget, &'static GlobalTransform)>;

/// The ray under the pointer, and the camera it goes through.
fn ray(
    wanted: Option<Entity>,
    cameras: &Cameras,
    windows: &Query<&Window>,
    primary: Option<Entity>,
) -> Option<(Ray3d, Dir3)> {
    let mut sorted: Vec<_> = cameras
        .iter()
        .filter(|(entity, camera, ..)| camera.is_active && wanted.is_none_or(|wanted| wanted == *entity))
        .collect();
    sorted.sort_by_key(|&(entity, camera, ..)| (std::cmp::Reverse(camera.order), entity));
    sorted.into_iter().find_map(|(_, camera, target, place)| {
        let NormalizedRenderTarget::Window(window) = target.normalize(primary)? else { return None };
        let cursor = windows.get(window.entity()).ok()?.cursor_position()?;
        camera.logical_viewport_rect()?.contains(cursor).then_some(())?;
        Some((camera.viewport_to_world(place, cursor).ok()?, place.forward()))
    })
}

pub(crate) fn point(
    buttons: Option<Res<ButtonInput<MouseButton>>>,
    mut taken: ResMut<PointerButtons>,
    devices: Res<HapticDevices>,
    cameras: Cameras,
    windows: Query<&Window>,
    primary: Query<Entity, With<PrimaryWindow>>,
    tools: Query<(&HapticTool, &PointerSource, &ToolPose, &GlobalTransform, Option<&ToolGrabs>)>,
    bodies: Query<(&BodyState, &ShownState, &GlobalTransform), Without<NoPointerGrab>>,
) {
    let bits = taken.0 & bits(|button| buttons.as_ref().is_some_and(|b| b.pressed(button)));
    taken.set_if_neq(PointerButtons(bits));
    for (tool, source, pose, place, held) in &tools {
        let Some(status) = devices.get(tool.device) else { continue };
        let tick = &status.report.tick;
        let at = DVec3::from(tick.position);
        let Some((ray, facing)) = ray(source.camera, &cameras, &windows, primary.single().ok()) else {
            // Outside the window the hand waits where it is; its buttons still come up.
            source.handle.set_buttons(bits);
            continue;
        };
        let holds = held.is_some_and(|held| !held.entities().is_empty());
        let hit = if holds { None } else { surface_under(&ray, &bodies) };
        let plane = || {
            let distance = ray.intersect_plane(pose.position.as_vec3(), InfinitePlane3d::new(facing))?;
            Some(ray.get_point(distance))
        };
        let Some(wanted) = hit.or_else(plane) else { continue };
        // From where the tool is to where it is wanted, so that a clutch or a jump that moved the origin does not matter.
        let turn: DQuat = place.rotation().as_dquat().normalize();
        let way = turn.inverse() * (wanted.as_dvec3() - DVec3::from(tick.tool)) / tool.motion_scale;
        source.handle.set((at + way).into(), bits);
    }
}

/// The nearest surface point under the pointer.
fn surface_under(
    ray: &Ray3d,
    bodies: &Query<(&BodyState, &ShownState, &GlobalTransform), Without<NoPointerGrab>>,
) -> Option<Vec3> {
    let hits = bodies.iter().filter_map(|(state, shown, place)| {
        let inverse = place.affine().inverse();
        // The direction keeps its length in the body's axes, so that distances along it compare between bodies.
        let origin = inverse.transform_point3(ray.origin).as_dvec3();
        let direction = inverse.transform_vector3(*ray.direction).as_dvec3();
        let positions = state.positions_at(shown.q());
        let triangles = state.model().surface().triangles();
        Some(pick_surface(&positions, triangles, origin.into(), direction.into())?.distance)
    });
    Some(ray.get_point(hits.min_by(f64::total_cmp)? as f32))
}

#[cfg(feature = "gamepad")]
pub(crate) fn steer(
    time: Res<Time<Real>>,
    devices: Res<HapticDevices>,
    gamepads: Query<(Entity, &bevy::input::gamepad::Gamepad)>,
    mut tools: Query<(&HapticTool, &mut GamepadSource)>,
) {
    use bevy::input::gamepad::{GamepadAxis, GamepadButton};
    const BUTTONS: [GamepadButton; 6] = [
        GamepadButton::South,
        GamepadButton::East,
        GamepadButton::West,
        GamepadButton::North,
        GamepadButton::LeftTrigger2,
        GamepadButton::RightTrigger2,
    ];
    for (tool, mut source) in &mut tools {
        let wanted = source.gamepad;
        let Some((_, pad)) =
            gamepads.iter().filter(|(e, _)| wanted.is_none_or(|w| w == *e)).min_by_key(|(e, _)| *e)
        else {
            // Pulled out in the middle of a grab: nobody presses its buttons any more.
            source.handle.set_buttons(0);
            continue;
        };
        let Some(status) = devices.get(tool.device) else { continue };
        let axis = |axis| f64::from(pad.get(axis).unwrap_or(0.0));
        let way = DVec3::new(
            axis(GamepadAxis::LeftStickX),
            axis(GamepadAxis::RightStickY),
            -axis(GamepadAxis::LeftStickY),
        );
        // A frame that took long is not made up for by a leap.
        let moved = way * source.speed * time.delta_secs_f64().min(0.1);
        if moved.is_finite() {
            let [low, high] = status.info.workspace.map(DVec3::from);
            source.place = (source.place + moved).clamp(low, high);
        }
        let bits = BUTTONS.into_iter().enumerate().filter(|(_, b)| pad.pressed(*b));
        let bits = bits.fold(0u32, |bits, (i, _)| bits | 1 << i);
        source.handle.set(source.place.into(), bits);
    }
}
