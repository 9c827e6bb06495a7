//! A device's ball, finger or box presses and strokes Pip, without gripping, and slides off onto
//! the floor.
//!
//! What to learn here: [`ToolTouch`] on a tool gives it a ball, and [`ProbeShape`] beside it
//! another shape. It touches every body and, with the contact plugin, every [`Obstacle`]; the
//! device's loop closes the contact 1,000 times a second. [`ProbeState`] tells where the tool is,
//! how it is turned and what it touches. A [`ToolGrip`] beside it grips while the button is down.
//!
//! ```sh
//! cargo run --release --example touch                   # the mouse is the hand; the force is shown
//! cargo run --release --example touch -- --device auto  # what is plugged in, at a tenth of its force
//! cargo run --release --example touch -- --tool finger  # a capsule; or a box
//! cargo run --release --example touch -- --headless     # a simulated device in a simulated hand
//! ```

#[path = "feel/device.rs"]
mod device;
mod stage;

use std::error::Error;

use bevy::{math::DVec3, prelude::*};
use clap::{Parser, ValueEnum};
use pliant::{
    haptics::{
        DeviceId, ForceArrow, GamepadSource, HapticDevice, HapticDevices, HapticSystems, HapticTool,
        HapticsPlugin, PointerSource, ToolGrip, ToolPose, ToolTouch,
    },
    prelude::*,
};

use device::{Grip, Kind, Mover, Opened};
use stage::{Readout, Stage, Unattended};

/// Ticks of the simulation per second.
const RATE: f64 = 120.0;

/// Radius of the ball, and of the rounding of the other shapes, m.
const RADIUS: f64 = 0.012;

/// The end of the finger, from its tip on, and half of the edges of the box without its rounding,
/// m.
const FINGER: DVec3 = DVec3::new(0.0, 0.04, 0.03);
const HALF: DVec3 = DVec3::new(0.02, 0.004, 0.01);

/// What a tool touches with.
#[derive(ValueEnum, Debug, Clone, Copy, PartialEq, Eq)]
enum Tip {
    Ball,
    Finger,
    Box,
}

/// A device's ball, finger or box presses and strokes Pip.
#[derive(Parser, Debug)]
struct Arguments {
    #[command(flatten)]
    stage: stage::Options,

    /// What touches.
    #[arg(long, value_enum, default_value_t = Tip::Ball)]
    tool: Tip,

    /// The device that holds the tool. Default: the mouse; without a window, the simulated device.
    #[arg(long, value_enum)]
    device: Option<Kind>,

    /// How the simulated hand holds the simulated device.
    #[arg(long, value_enum, default_value_t = Grip::Firm)]
    grip: Grip,
}

#[derive(Resource)]
struct Scene {
    device: DeviceId,
    mover: Mover,
    kind: Kind,
    force_scale: f64,
    tip: Tip,
}

/// The picture of the tool.
#[derive(Component)]
struct Drawn;

fn main() -> AppExit {
    match run(Arguments::parse()) {
        Ok(exit) => exit,
        Err(error) => {
            eprintln!("touch: {error}");
            AppExit::from_code(2)
        }
    }
}

fn run(options: Arguments) -> Result<AppExit, Box<dyn Error>> {
    let picture = options.stage.screenshot.is_some();
    let stage = Stage::with("touch", options.stage).real_time().picture_at(3.0);
    let mut app = App::new();
    app.add_plugins((stage.key("left mouse: grip"), PliantPlugins::default(), HapticsPlugin::default()));
    let attended = app.world().get_resource::<Unattended>().is_none();
    let kind = options.device.unwrap_or(if attended { Kind::Pointer } else { Kind::Virtual });
    let Opened { device, mover } = device::open(kind, options.grip)?;
    let force_scale = if device.info().simulated { 1.0 } else { 0.1 };
    let config = device::loop_config(&device, false, picture);
    let id = app.world_mut().resource_mut::<HapticDevices>().add(device, config)?;
    app.insert_resource(Time::<Fixed>::from_hz(RATE))
        .insert_resource(Scene { device: id, mover, kind, force_scale, tip: options.tool })
        .add_systems(Startup, place)
        .add_systems(FixedUpdate, play.before(HapticSystems::Move))
        .add_systems(Update, (hold_out, draw, write));
    Ok(app.run())
}

fn place(
    mut commands: Commands,
    scene: Res<Scene>,
    assets: Res<AssetServer>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
    mut pointer: ResMut<PointerGrab>,
) {
    commands.spawn((
        ModalBody::new(assets.load("pip.modal")),
        MeshMaterial3d(materials.add(StandardMaterial {
            base_color: Color::srgb(0.95, 0.50, 0.36),
            perceptual_roughness: 0.42,
            ..default()
        })),
    ));
    commands.spawn(Obstacle::Floor);
    let radius = RADIUS as f32;
    let (mesh, at) = match scene.tip {
        Tip::Ball => (meshes.add(Sphere::new(radius)), Transform::IDENTITY),
        Tip::Finger => {
            let axis = FINGER.as_vec3();
            let turn = Quat::from_rotation_arc(Vec3::Y, axis.normalize());
            let mesh = meshes.add(Capsule3d::new(radius, axis.length()));
            (mesh, Transform::from_translation(0.5 * axis).with_rotation(turn))
        }
        Tip::Box => {
            (meshes.add(Cuboid::from_size(2.0 * (HALF.as_vec3() + Vec3::splat(radius)))), Transform::IDENTITY)
        }
    };
    let material = materials.add(StandardMaterial {
        base_color: Color::srgb(0.35, 0.55, 0.85),
        perceptual_roughness: 0.3,
        ..default()
    });
    let away = Transform::from_xyz(0.0, -1.0, 0.0);
    commands.spawn((
        Drawn,
        away,
        Visibility::default(),
        children![(Mesh3d(mesh), MeshMaterial3d(material), at)],
    ));
    // If the mouse is not the device, it can grab bodies directly.
    pointer.enabled = scene.kind != Kind::Pointer;
}

/// Spawns the tool once the body exists: the center of the workspace lies above the body's top.
fn hold_out(
    mut commands: Commands,
    scene: Res<Scene>,
    bodies: Query<(&BodyState, &GlobalTransform), Added<BodyState>>,
) {
    let Ok((state, place)) = bodies.single() else { return };
    let positions = state.model().surface().positions();
    let Some(top) = positions.iter().max_by(|a, b| a[1].total_cmp(&b[1])) else { return };
    let (shape, low) = match scene.tip {
        Tip::Ball => (ProbeShape::default(), 0.0),
        Tip::Finger => (ProbeShape::capsule(DVec3::ZERO, FINGER), 0.0),
        Tip::Box => (ProbeShape::cuboid(HALF), HALF.y),
    };
    let above = place.transform_point(Vec3::from(*top)) + Vec3::Y * ((RADIUS + low) as f32 + 0.02);
    let mut tool = commands.spawn((
        Name::new("tool"),
        HapticTool { force_scale: scene.force_scale, ..HapticTool::new(scene.device) },
        ToolTouch { radius: RADIUS, ..default() },
        shape,
        ToolGrip::default(),
        ForceArrow { radius: 0.3 * RADIUS as f32, ..default() },
        Transform::from_translation(above),
    ));
    match (&scene.mover, scene.kind) {
        (Mover::Input(handle), Kind::Pointer) => tool.insert(PointerSource::new(handle.clone())),
        (Mover::Input(handle), _) => tool.insert(GamepadSource::new(handle.clone())),
        _ => &mut tool,
    };
}

/// Moves the simulated hand: it comes down, presses, and strokes to and fro.
fn play(
    time: Res<Time>,
    scene: Res<Scene>,
    tools: Query<(), With<HapticTool>>,
    mut since: Local<Option<f64>>,
) {
    let Mover::Script(hand) = &scene.mover else { return };
    if tools.is_empty() {
        return;
    }
    let now = time.elapsed_secs_f64();
    let t = now - *since.get_or_insert(now);
    let down = 0.032 * (t - 0.5).clamp(0.0, 1.0);
    let stroke = (t - 1.5).max(0.0);
    let side = DVec3::new(0.02 * (1.5 * stroke).sin(), 0.0, 0.01 * (1.1 * stroke).sin());
    hand.set_target((side - down * DVec3::Y).into());
}

/// Draws the tool where it is, and not where the hand is.
fn draw(
    mut drawn: Query<&mut Transform, With<Drawn>>,
    tools: Query<(&ToolPose, &ProbeState)>,
    mut gizmos: Gizmos,
) {
    let Ok((pose, probe)) = tools.single() else { return };
    let at = probe.position().unwrap_or(pose.position).as_vec3();
    for mut drawn in &mut drawn {
        drawn.translation = at;
        drawn.rotation = probe.rotation().unwrap_or(pose.orientation).as_quat();
    }
    gizmos.line(at, pose.position.as_vec3(), Color::srgb(0.98, 0.86, 0.25));
}

fn write(
    mut readout: ResMut<Readout>,
    scene: Res<Scene>,
    devices: Res<HapticDevices>,
    tools: Query<(&ToolPose, &ProbeState)>,
    mut most: Local<(usize, f64)>,
) {
    let (Some(status), Ok((pose, probe))) = (devices.get(scene.device), tools.single()) else { return };
    let touched = probe.contacts().filter(|contact| contact.force != DVec3::ZERO).count();
    let sliding = probe.contacts().filter(|contact| contact.sliding).count();
    *most = (most.0.max(touched), most.1.max(probe.force().length()));
    let deep = probe.position().map_or(0.0, |at| at.distance(pose.position));
    readout.0 = format!(
        "{}: {:?}\n\
         coupling     {:6.0} N/m\n\
         touches      {touched} ({sliding} slide), at most {}\n\
         on the tool  {:6.2} N, at most {:.2} N, {:.1} mN m\n\
         in the hand  {:6.2} N\n\
         stretch      {:6.2} mm",
        status.info.name,
        status.report.state,
        status.coupling.stiffness,
        most.0,
        probe.force().length(),
        most.1,
        1e3 * probe.torque().length(),
        pose.force.length(),
        1e3 * deep,
    );
}
