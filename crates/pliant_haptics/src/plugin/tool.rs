//! Tools: the representation of devices in the world, and the grabs that they hold.

use bevy::{
    math::{DQuat, DVec3},
    prelude::*,
};
use pliant_body::{BodyState, Driven, Grab, GrabOf, TouchProbe, VisualState};
use pliant_modal::Patch;

use super::{DeviceId, HapticButton, HapticDevices};
use crate::ToolMap;

/// Stiffness of the spring of a ball whose coupling has no limit, N/m.
const STIFFEST: f64 = 1e5;

/// The tool of a device.
///
/// The entity's transform places the center of the device's workspace in the world and turns it.
/// The transform's scale has no effect, see [`motion_scale`](Self::motion_scale).
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
#[require(Transform, ToolPose)]
pub struct HapticTool {
    /// The device.
    pub device: DeviceId,
    /// World meters per meter of the hand, above 0. Default: `1.0`.
    pub motion_scale: f64,
    /// Additional scale of the force at the hand, beyond the motion scale, 0 or more. Default:
    /// `1.0`.
    pub force_scale: f64,
    /// Force axes that the hand gets, device axes. Default: all.
    pub force_axes: [bool; 3],
    /// Torque axes that the hand gets, device axes. Default: all.
    pub torque_axes: [bool; 3],
    /// Mass of the tool at the hand, kg. Default: `0.0`.
    pub mass: f64,
    /// Buttons (as bits) that detach the tool from the hand while they are down. Default: none.
    pub clutch: u32,
    /// Whether the loop steps a copy of the held body itself. This gives finer forces that do not
    /// depend on the simulation's rate. Default: `false`.
    pub modal: bool,
}

impl Default for HapticTool {
    /// The tool of no device, with default settings.
    fn default() -> Self {
        Self::new(DeviceId::default())
    }
}

impl HapticTool {
    /// Creates the tool of `device` with default settings.
    pub fn new(device: DeviceId) -> Self {
        Self {
            device,
            motion_scale: 1.0,
            force_scale: 1.0,
            force_axes: [true; 3],
            torque_axes: [true; 3],
            mass: 0.0,
            clutch: 0,
            modal: false,
        }
    }

    fn map(&self, place: &GlobalTransform) -> ToolMap {
        let (_, rotation, translation) = place.to_scale_rotation_translation();
        ToolMap {
            origin: translation.as_dvec3().into(),
            rotation: rotation.as_dquat().normalize().to_array(),
            motion_scale: self.motion_scale,
            force_scale: self.force_scale,
            force_axes: self.force_axes,
            torque_axes: self.torque_axes,
            mass: self.mass,
            clutch: self.clutch,
        }
    }
}

/// Lets a tool touch bodies and obstacles with a ball at the tool point while it holds nothing, or
/// with another shape that turns with the hand ([`ProbeShape`](pliant_body::ProbeShape)).
///
/// The plugin adds a [`TouchProbe`] to the tool's entity and writes it.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
#[require(TouchProbe { enabled: false, ..default() })]
pub struct ToolTouch {
    /// Radius of the ball or of the shape's rounding, m of the world, above 0. Default: `0.01`.
    pub radius: f64,
    /// Coefficient of friction, 0 to 10. At a body the geometric mean with that of the body counts.
    /// Default: `0.5`.
    pub friction: f64,
}

impl Default for ToolTouch {
    fn default() -> Self {
        let TouchProbe { radius, friction, .. } = TouchProbe::default();
        Self { radius, friction }
    }
}

/// Pose and force of a tool in the last tick.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub struct ToolPose {
    /// Position of the tool point, m, world axes.
    pub position: DVec3,
    /// Velocity of the tool point, m/s, world axes.
    pub velocity: DVec3,
    /// Orientation of the tool.
    pub orientation: DQuat,
    /// The force on the hand, N, device axes.
    pub force: DVec3,
    /// The gain of the force, 0 to 1.
    pub gain: f64,
    /// Whether the clutch detaches the tool from the hand.
    pub clutched: bool,
    /// Buttons that are down.
    pub buttons: u32,
}

/// The tool that holds a [`Grab`]. The plugin then writes the grab's target, stiffness and
/// relaxation.
#[derive(Component, FromTemplate, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
#[relationship(relationship_target = ToolGrabs)]
pub struct HeldBy(#[entities] pub Entity);

impl Default for HeldBy {
    /// Held by no tool.
    fn default() -> Self {
        Self(Entity::PLACEHOLDER)
    }
}

/// The grabs of a tool, oldest first. The first [`MAX_CONTACTS`](crate::MAX_CONTACTS) exert a
/// force. All of them are despawned with the tool.
#[derive(Component, Reflect, Debug, Default)]
#[reflect(Component, Debug, Default)]
#[relationship_target(relationship = HeldBy, linked_spawn)]
pub struct ToolGrabs(Vec<Entity>);

impl ToolGrabs {
    /// Returns the grabs' entities, oldest first.
    pub fn entities(&self) -> &[Entity] {
        &self.0
    }
}

/// Position on the tool at which a grab is held, m from the tool point, tool axes. Default: the
/// tool point.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub struct ToolOffset(pub DVec3);

/// Lets a tool grab the nearest body while a button is down.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub struct ToolGrip {
    /// The button, from 0. Default: `0`.
    pub button: u32,
    /// Maximum distance of a surface from the tool point, m. Default: `0.02`.
    pub reach: f64,
    /// Radius of the patch as a part of the model's size. Default: `0.06`.
    pub radius: f64,
}

impl Default for ToolGrip {
    fn default() -> Self {
        Self { button: 0, reach: 0.02, radius: 0.06 }
    }
}

/// Way of a workspace between two frames beyond which its tool is put elsewhere and not carried, m.
const JUMP: f64 = 0.05;

/// Sends the workspace transforms to the loops.
pub(crate) fn place(
    mut devices: ResMut<HapticDevices>,
    tools: Query<(NameOrEntity, &HapticTool, &GlobalTransform)>,
) {
    for (name, tool, place) in &tools {
        let Some(entry) = devices.entry(tool.device) else { continue };
        let map = tool.map(place);
        if entry.map == Some(map) {
            continue;
        }
        if !map.is_valid() {
            warn!("{name}: a tool needs finite numbers and a positive motion scale; it stays as it was");
        } else if !entry.running.get().set_tool(map) {
            // The queue of the loop is full, so the next frame retries.
            continue;
        }
        let jumps = |old: &ToolMap| DVec3::from(old.origin).distance(map.origin.into()) > JUMP;
        if entry.map.as_ref().is_none_or(jumps) {
            entry.placed = None;
        }
        entry.map = Some(map);
    }
}

/// Before a tick: moves the tools and the targets of their grabs to the hands.
pub(crate) fn update_tools(
    mut devices: ResMut<HapticDevices>,
    mut tools: Query<(&HapticTool, &mut ToolPose, Option<&ToolGrabs>)>,
    mut grabs: Query<(&mut Grab, Option<&ToolOffset>)>,
) {
    for (tool, mut pose, held) in &mut tools {
        let Some(entry) = devices.entry(tool.device) else { continue };
        entry.status.report = *entry.running.get().report();
        let tick = &entry.status.report.tick;
        entry.seen = tick.now;
        if entry.map.is_some() && entry.placed.is_none() && tick.now > 0.0 {
            entry.placed = Some(tick.now);
        }
        pose.set_if_neq(ToolPose {
            position: tick.tool.into(),
            velocity: tick.tool_velocity.into(),
            orientation: DQuat::from_array(tick.tool_orientation),
            force: tick.wrench.force.into(),
            gain: tick.gain,
            clutched: tick.clutched,
            buttons: tick.buttons,
        });
        let config = entry.status.coupling.grab_config(tool.motion_scale, tool.force_scale);
        for &grab in held.map_or(&[][..], ToolGrabs::entities) {
            let Ok((mut grab, offset)) = grabs.get_mut(grab) else { continue };
            let offset = offset.map_or(DVec3::ZERO, |o| o.0);
            let target = pose.position + pose.orientation * offset;
            let wanted = Grab { target, stiffness: config.stiffness, relaxation: config.relaxation, ..*grab };
            grab.set_if_neq(wanted);
        }
    }
}

/// Before a tick: leads the probes of the tools that touch. A probe begins where its tool is, and
/// not where a loop says that does not know its workspace yet: it would be caught there. Where a
/// workspace jumps, its probe begins anew.
pub(crate) fn lead_probes(
    mut devices: ResMut<HapticDevices>,
    mut tools: Query<(&HapticTool, &ToolPose, &ToolTouch, Option<&ToolGrabs>, &mut TouchProbe)>,
) {
    for (tool, pose, touch, held, mut probe) in &mut tools {
        let coupling = devices.get(tool.device).map(|status| status.coupling);
        let spring = coupling.map(|c| c.grab_config(tool.motion_scale, tool.force_scale));
        // Without a limit the coupling is infinite. A probe needs a spring.
        let stiffness = spring.map_or(0.0, |spring| spring.stiffness.unwrap_or(STIFFEST));
        let holds = held.is_some_and(|held| !held.entities().is_empty());
        let placed = devices.entry(tool.device).is_some_and(|entry| entry.is_placed());
        probe.set_if_neq(TouchProbe {
            radius: touch.radius,
            target: pose.position,
            rotation: pose.orientation,
            stiffness,
            relaxation: spring.map_or(0.0, |spring| spring.relaxation),
            friction: touch.friction,
            enabled: stiffness > 0.0 && !holds && placed,
        });
    }
}

/// Releases the grabs of a tool whose device was removed, and resets its force.
pub(crate) fn release_removed(
    mut commands: Commands,
    devices: Res<HapticDevices>,
    mut tools: Query<(&HapticTool, &mut ToolPose, Option<&ToolGrabs>)>,
) {
    for (tool, mut pose, held) in &mut tools {
        if devices.get(tool.device).is_some() {
            continue;
        }
        for &grab in held.map_or(&[][..], ToolGrabs::entities) {
            commands.entity(grab).try_despawn();
        }
        let still =
            ToolPose { position: pose.position, orientation: pose.orientation, ..ToolPose::default() };
        pose.set_if_neq(still);
    }
}

/// Grabs the nearest surface within reach on a press, and releases the grabs when the button comes
/// up.
pub(crate) fn grip(
    mut commands: Commands,
    mut buttons: MessageReader<HapticButton>,
    devices: Res<HapticDevices>,
    tools: Query<(Entity, &HapticTool, &ToolGrip, &ToolPose, Option<&ToolGrabs>)>,
    bodies: Query<(Entity, &BodyState, &VisualState, &GlobalTransform, &Driven)>,
) {
    for press in buttons.read() {
        for (tool, held_by, grip, pose, held) in
            tools.iter().filter(|(_, t, g, ..)| t.device == press.device && g.button == press.button)
        {
            if !press.pressed {
                for &grab in held.map_or(&[][..], ToolGrabs::entities) {
                    commands.entity(grab).try_despawn();
                }
                continue;
            }
            let nearest = bodies.iter().filter_map(|(body, state, shown, place, _)| {
                let positions = state.positions(shown);
                let (vertex, distance) = positions
                    .iter()
                    .map(|p| place.transform_point(Vec3::from(*p)).as_dvec3().distance(pose.position))
                    .enumerate()
                    .min_by(|a, b| a.1.total_cmp(&b.1))?;
                let radius = grip.radius.max(0.0) * state.model().size();
                let patch =
                    Patch::around(state.model().surface(), u32::try_from(vertex).ok()?, radius).ok()?;
                let entries = patch.entries().iter();
                let middle: DVec3 = entries
                    .filter_map(|&(v, w)| Some(Vec3::from(*positions.get(v as usize)?).as_dvec3() * w))
                    .sum();
                let middle = place.transform_point(middle.as_vec3()).as_dvec3();
                Some((body, patch.center(), radius, middle, distance))
            });
            let within = nearest.filter(|(.., distance)| *distance <= grip.reach);
            let Some((body, vertex, radius, middle, _)) = within.min_by(|a, b| a.4.total_cmp(&b.4)) else {
                continue;
            };
            // The grab has the device's coupling from the start, so that a peer that steps the body
            // gets it only once.
            let coupling = devices.get(press.device).map(|status| status.coupling);
            let hold = coupling.map(|c| c.grab_config(held_by.motion_scale, held_by.force_scale));
            let hold = hold.unwrap_or_default();
            // The offset puts the target where the patch is, so that the grab moves nothing and
            // exerts no force.
            let offset = pose.orientation.inverse() * (middle - pose.position);
            commands.spawn((
                Name::new("tool grab"),
                Grab {
                    stiffness: hold.stiffness,
                    relaxation: hold.relaxation,
                    ..Grab::new(vertex, radius, middle)
                },
                GrabOf(body),
                HeldBy(tool),
                ToolOffset(offset),
            ));
        }
    }
}
