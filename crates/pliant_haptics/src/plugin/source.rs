//! Pointer and gamepad as hands. They move a [`Positioned`](crate::Positioned) device, and the
//! force is only drawn.

use std::cmp::Reverse;

use bevy::{
    ecs::system::SystemParam,
    math::{DQuat, DVec3},
    picking::{
        backend::{PointerHits, ray::RayMap},
        pointer::PointerId,
    },
    prelude::*,
};
use pliant_body::SurfaceHit;

use super::{HapticDevices, HapticTool, ToolGrabs, ToolPose};
use crate::PositionedHandle;

/// Lets the pointer move its tool.
///
/// While the tool holds nothing, it lies on the surface under the pointer. While it holds
/// something, it moves in the plane that faces the camera. The left, right and middle buttons are
/// 0, 1 and 2. A scene with a [`PointerGrabPlugin`](pliant_body::PointerGrabPlugin) must disable
/// that plugin (`PointerGrab::enabled`), or both grab the body.
#[derive(Component, Debug, Clone)]
pub struct PointerSource {
    handle: PositionedHandle,
    /// The camera of the view. Default: the front-most active camera of the window with a body
    /// under the pointer. If there is none, the previous camera stays.
    pub camera: Option<Entity>,
    /// The camera that last showed a body under the pointer.
    through: Option<Entity>,
}

impl PointerSource {
    /// Creates the component for the device that `handle` moves.
    pub fn new(handle: PositionedHandle) -> Self {
        Self { handle, camera: None, through: None }
    }
}

/// System sets of the pointer's tools, in `PreUpdate` after the input of the frame.
///
/// A user interface that takes the pointer should gate the `Press` set and no other, so that held
/// patches are always released:
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
    /// A button that goes down in the scene belongs to the tools until it comes up.
    Press,
    /// The tools follow the pointer, with the buttons that belong to them.
    Move,
}

/// The pointer buttons that went down in the scene and are still down. The left, right and middle
/// buttons are the lowest bits.
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

/// Lets a gamepad move its tool. The left stick moves the tool right and away, the right stick up.
/// The buttons South, East, West, North and the triggers are 0 to 5.
#[cfg(feature = "gamepad")]
#[derive(Component, Debug, Clone)]
pub struct GamepadSource {
    handle: PositionedHandle,
    /// The gamepad's entity. Default: the first gamepad.
    pub gamepad: Option<Entity>,
    /// Speed at full deflection, m/s of the device. Default: `0.15`.
    pub speed: f64,
    place: DVec3,
}

#[cfg(feature = "gamepad")]
impl GamepadSource {
    /// Creates the component for the device that `handle` moves.
    pub fn new(handle: PositionedHandle) -> Self {
        Self { handle, gamepad: None, speed: 0.15, place: DVec3::ZERO }
    }
}

/// What Bevy's picking knows of the mouse in this frame.
#[derive(SystemParam)]
pub(crate) struct Mouse<'w, 's> {
    rays: Option<Res<'w, RayMap>>,
    hits: Option<Res<'w, Messages<PointerHits>>>,
    cameras: Query<'w, 's, (&'static Camera, &'static GlobalTransform)>,
}

impl Mouse<'_, '_> {
    /// The cameras in whose viewport the pointer is, front-most (highest order) first, with the ray
    /// through the pointer and the direction of the view.
    fn rays(&self) -> Vec<(Entity, Ray3d, Dir3)> {
        let mut rays: Vec<_> = self
            .rays
            .iter()
            .flat_map(|rays| rays.iter())
            .filter(|(id, _)| id.pointer == PointerId::Mouse)
            .filter_map(|(id, ray)| {
                let (camera, place) = self.cameras.get(id.camera).ok()?;
                Some((Reverse(camera.order), id.camera, *ray, place.forward()))
            })
            .collect();
        rays.sort_by_key(|(order, camera, ..)| (*order, *camera));
        rays.into_iter().map(|(_, camera, ray, forward)| (camera, ray, forward)).collect()
    }

    /// The nearest point of a body under the pointer, through the front-most camera that has one
    /// there, or through `camera`.
    fn hit(&self, camera: Option<Entity>) -> Option<(Entity, Vec3)> {
        let groups = self.hits.as_ref()?.iter_current_update_messages();
        groups
            .filter(|group| group.pointer == PointerId::Mouse)
            .flat_map(|group| group.picks.iter().map(|(_, hit)| (group.order, hit)))
            .filter(|(_, hit)| camera.is_none_or(|camera| camera == hit.camera))
            .filter(|(_, hit)| hit.extra_as::<SurfaceHit>().is_some())
            .min_by(|(a, x), (b, y)| b.total_cmp(a).then(x.depth.total_cmp(&y.depth)))
            .and_then(|(_, hit)| Some((hit.camera, hit.position?)))
    }
}

pub(crate) fn point(
    buttons: Option<Res<ButtonInput<MouseButton>>>,
    mut taken: ResMut<PointerButtons>,
    devices: Res<HapticDevices>,
    mouse: Mouse,
    mut tools: Query<(&HapticTool, &mut PointerSource, &ToolPose, &GlobalTransform, Option<&ToolGrabs>)>,
) {
    let bits = taken.0 & bits(|button| buttons.as_ref().is_some_and(|b| b.pressed(button)));
    taken.set_if_neq(PointerButtons(bits));
    if tools.is_empty() {
        return;
    }
    let rays = mouse.rays();
    for (tool, mut source, pose, place, held) in &mut tools {
        let Some(status) = devices.get(tool.device) else { continue };
        let tick = &status.report.tick;
        let at = DVec3::from(tick.position);
        let holds = held.is_some_and(|held| !held.entities().is_empty());
        let hit = if holds { None } else { mouse.hit(source.camera) };
        if let Some((camera, _)) = hit {
            source.through = Some(camera);
        }
        let under = |wanted: Entity| rays.iter().find(|(camera, ..)| *camera == wanted);
        // Until a body was under the pointer, any camera will do.
        let front = match source.camera {
            None => source.through.and_then(under).or_else(|| rays.first()),
            Some(wanted) => under(wanted),
        };
        let plane = || {
            let (_, ray, forward) = front?;
            let distance = ray.intersect_plane(pose.position.as_vec3(), InfinitePlane3d::new(*forward))?;
            Some(ray.get_point(distance))
        };
        let Some(wanted) = hit.map(|(_, point)| point).or_else(plane) else {
            // The pointer is outside the window, the tool is behind the camera, or the view is
            // along the tool's plane. There is no position, but the buttons still count.
            source.handle.set_buttons(bits);
            continue;
        };
        // The motion is relative to the tool's position, so that an origin shifted by a clutch or a
        // jump does not matter.
        let turn: DQuat = place.rotation().as_dquat().normalize();
        let way = turn.inverse() * (wanted.as_dvec3() - DVec3::from(tick.tool)) / tool.motion_scale;
        source.handle.set((at + way).into(), bits);
    }
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
            // The gamepad was unplugged, perhaps during a grab, so none of its buttons is down.
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
        // A long frame must not cause a leap.
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
