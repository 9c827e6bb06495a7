//! The device that a scene asks for.

use bevy::{math::DVec3, prelude::*};

use super::hands::vertex_of;
use super::locate::Step::Field;
use super::spawn::{self, PartOf, SceneBody, SceneClock, SceneSource};
use super::{DeviceEntry, Grip, Like, Motion, SceneError, SceneErrorKind, SceneFile, TouchEntry};
use crate::body::{BodyState, PointerGrab};
use crate::haptics::{
    DeviceId, HandModel, HapticDevice, HapticDevices, HapticTool, LoopConfig, PointerSource, Positioned,
    PositionedHandle, SafetyConfig, StaleConfig, ToolGrip, VirtualConfig, VirtualDevice, VirtualHandle,
};

/// The tool of a scene's device, which is placed once the body that it begins at exists.
#[derive(Component, Debug)]
pub(super) struct SceneTool {
    device: DeviceId,
    mover: Mover,
    on: TouchEntry,
    force_scale: f64,
    modal: bool,
    placed: bool,
    refused: bool,
}

#[derive(Debug)]
enum Mover {
    Script { handle: VirtualHandle, motion: Motion, from: f64, until: Option<f64> },
    Pointer(PositionedHandle),
}

/// Opens the device and spawns its tool.
pub(super) fn add(
    world: &mut World,
    instance: Entity,
    file: &SceneFile,
    entry: &DeviceEntry,
) -> Result<(), SceneError> {
    let failed = |kind, message: String| file.error(&[Field("device")], kind, message);
    let mut patient = None;
    let (device, mover, on, force_scale, modal): (Box<dyn HapticDevice>, _, _, _, _) = match entry {
        DeviceEntry::Virtual { like, grip, on, motion, from, until, force_scale, modal, patience } => {
            patient = *patience;
            let config = match like {
                Like::Touch => VirtualConfig::touch(),
                Like::Omni => VirtualConfig::omni(),
                Like::Premium => VirtualConfig::premium(),
                Like::Omega3 => VirtualConfig::omega3(),
            };
            let hand = match grip {
                Grip::Firm => HandModel::FIRM,
                Grip::Light => HandModel::LIGHT,
                Grip::Loose => HandModel::LOOSE,
            };
            let device = VirtualDevice::new(config, hand).map_err(|error| {
                failed(SceneErrorKind::Open, format!("the device cannot be opened: {error}"))
            })?;
            let mover =
                Mover::Script { handle: device.handle(), motion: motion.clone(), from: *from, until: *until };
            (Box::new(device), mover, on.clone(), *force_scale, *modal)
        }
        DeviceEntry::Pointer { on, force_scale } => {
            let device = Positioned::new("pointer");
            let mover = Mover::Pointer(device.handle());
            (Box::new(device), mover, on.clone(), *force_scale, false)
        }
    };
    let Some(mut devices) = world.get_resource_mut::<HapticDevices>() else {
        let message = "this scene asks for a device, and this app has no `HapticsPlugin`";
        return Err(failed(SceneErrorKind::Feature, message.into()));
    };
    let mut config = LoopConfig { modal, ..LoopConfig::default() };
    if let Some(patience) = patient {
        let stale = Some(StaleConfig { patience, limit: patience + 1.0 });
        config.safety = Some(SafetyConfig { stale, ..SafetyConfig::for_device(&device.info(), config.rate) });
    }
    let device = devices
        .add(device, config)
        .map_err(|error| failed(SceneErrorKind::Open, format!("the device cannot be started: {error}")))?;
    // The mouse either drives the device or grabs bodies, not both.
    if matches!(mover, Mover::Pointer(_))
        && let Some(mut pointer) = world.get_resource_mut::<PointerGrab>()
    {
        pointer.enabled = false;
    }
    world.spawn((
        Name::new("tool"),
        SceneTool { device, mover, on, force_scale, modal, placed: false, refused: false },
        SceneSource { file: file.clone(), path: vec![Field("device"), Field("on")] },
        PartOf(instance),
    ));
    Ok(())
}

/// Removes the device of a despawned tool.
pub(super) fn close(
    gone: On<Remove, SceneTool>,
    tools: Query<&SceneTool>,
    devices: Option<ResMut<HapticDevices>>,
) {
    if let (Ok(tool), Some(mut devices)) = (tools.get(gone.entity), devices) {
        devices.remove(tool.device);
    }
}

/// Before a tick, places the tools at their patches and moves the simulated hands.
pub(super) fn play(
    mut commands: Commands,
    time: Res<Time>,
    clocks: Query<&SceneClock>,
    bodies: Query<(&Name, &PartOf, &BodyState, &GlobalTransform), With<SceneBody>>,
    mut tools: Query<(Entity, &mut SceneTool, &PartOf, &SceneSource)>,
) {
    for (entity, mut tool, part, source) in &mut tools {
        let Some(t) = clocks.get(part.0).ok().and_then(|clock| clock.at(time.elapsed_secs_f64())) else {
            continue;
        };
        if !tool.placed {
            let body = bodies.iter().find(|(name, of, ..)| of.0 == part.0 && name.as_str() == tool.on.body);
            let Some((_, _, state, place)) = body.filter(|_| !tool.refused) else { continue };
            match vertex_of(&tool.on.patch, state.model()) {
                Ok(vertex) => {
                    let at = state.model().surface().positions()[vertex as usize];
                    put(
                        &mut commands,
                        entity,
                        &tool,
                        place.transform_point(Vec3::from(at)),
                        state.model().size(),
                    );
                    tool.placed = true;
                }
                Err(problem) => {
                    tool.refused = true;
                    let message = format!("the device cannot begin at `{}`: {problem}", tool.on.body);
                    let path = [source.path.as_slice(), &[Field("patch")]].concat();
                    let error = source.file.error(&path, SceneErrorKind::Asset, message);
                    let instance = part.0;
                    commands.queue(move |world: &mut World| spawn::fail(world, instance, error));
                }
            }
        }
        let Mover::Script { handle, motion, from, until } = &tool.mover else { continue };
        let down = t >= *from && until.is_none_or(|until| t < until);
        handle.set_buttons(u32::from(down));
        let way = if down { motion.at(t - from) } else { DVec3::ZERO };
        handle.set_target(way.into());
    }
}

fn put(commands: &mut Commands, entity: Entity, tool: &SceneTool, at: Vec3, size: f64) {
    let mut put = commands.entity(entity);
    put.insert((
        HapticTool { modal: tool.modal, force_scale: tool.force_scale, ..HapticTool::new(tool.device) },
        ToolGrip::default(),
        Transform::from_translation(at),
    ));
    #[cfg(feature = "render")]
    put.insert(crate::haptics::ForceArrow { radius: 0.02 * size as f32, ..default() });
    #[cfg(not(feature = "render"))]
    let _ = size;
    if let Mover::Pointer(handle) = &tool.mover {
        put.insert(PointerSource::new(handle.clone()));
    }
}
