//! Hold and feel a body with a haptic device: the mouse, a gamepad, a simulated or a real device.
//!
//! What to learn here: a device is added to [`HapticDevices`]. A tool is an entity with a
//! [`HapticTool`], whose transform places the device's workspace in the scene. A [`ToolGrip`] grabs
//! while a button is down. The device loop runs at 1 kHz on its own thread and computes the force
//! from the local model, which the simulation updates 120 times per second. The plot shows every
//! period of the device loop.
//!
//! ```sh
//! cargo run --release --example feel                            # the mouse is the hand; the force is shown
//! cargo run --release --example feel -- --device auto           # what is plugged in, at a tenth of its force
//! cargo run --release --example feel -- --headless --seconds 10 # a simulated device in a simulated hand, and how well the loop keeps its time
//! ```

mod device;
mod plot;
#[path = "../stage/mod.rs"]
mod stage;

use std::{error::Error, fs::File, io::BufReader, io::BufWriter, path::PathBuf};

use bevy::{math::DVec3, prelude::*};
use clap::Parser;
use pliant::{
    haptics::{
        Coupling, DeviceId, Fault, ForceArrow, GamepadSource, HapticDevice, HapticDevices, HapticSystems,
        HapticTool, HapticsPlugin, LoopReport, PointerSource, Recorder, Replay, ToolGrip, ToolPose,
    },
    prelude::*,
};

use device::{Grip, Kind, Mover, Opened};
use plot::{Trace, Traces};
use stage::{Readout, Stage, Unattended};

/// Ticks of the simulation per second.
const RATE: f64 = 120.0;

/// Hold and feel a body with a haptic device.
#[derive(Parser, Debug)]
struct Arguments {
    #[command(flatten)]
    stage: stage::Options,

    /// The device that holds the body. Default: the mouse; without a window, the simulated device.
    #[arg(long, value_enum)]
    device: Option<Kind>,

    /// How the simulated hand holds the simulated device.
    #[arg(long, value_enum, default_value_t = Grip::Firm)]
    grip: Grip,

    /// Let the device loop step its own copy of the body, at device rate.
    #[arg(long)]
    modal: bool,

    /// Force in the hand per force in the world, N/N. Default: 1; on a real device 0.1, until you
    /// trust it.
    #[arg(long)]
    force_scale: Option<f64>,

    /// The body: a file under assets/.
    #[arg(long, default_value = "pip.modal")]
    body: String,

    /// Record the samples of the device, one per millisecond, to this file.
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,

    /// Play such a file instead of using a device.
    #[arg(long, value_name = "FILE", conflicts_with = "device")]
    replay: Option<PathBuf>,
}

#[derive(Resource)]
struct Scene {
    device: DeviceId,
    mover: Mover,
    kind: Kind,
    modal: bool,
    force_scale: f64,
    body: String,
    recorder: Option<Recorder<BufWriter<File>>>,
}

fn main() -> AppExit {
    match run(Arguments::parse()) {
        Ok(exit) => exit,
        Err(error) => {
            eprintln!("feel: {error}");
            AppExit::from_code(2)
        }
    }
}

fn run(options: Arguments) -> Result<AppExit, Box<dyn Error>> {
    let picture = options.stage.screenshot.is_some();
    let mut stage = Stage::with("feel it", options.stage).real_time().picture_at(8.5);
    for key in ["left mouse: hold", "E, R: emergency stop, reset"] {
        stage = stage.key(key);
    }
    let mut app = App::new();
    app.add_plugins((stage, PliantPlugins::default(), HapticsPlugin::default(), plot::plugin));
    let attended = app.world().get_resource::<Unattended>().is_none();

    let kind = options.device.unwrap_or(if attended { Kind::Pointer } else { Kind::Virtual });
    let Opened { device, mover } = match &options.replay {
        Some(file) => {
            let device = Replay::read(BufReader::new(File::open(file)?))?.repeating();
            Opened { device: Box::new(device), mover: Mover::Nobody }
        }
        None => device::open(kind, options.grip)?,
    };
    let info = device.info();
    let recorder = match &options.record {
        Some(file) => Some(Recorder::new(BufWriter::new(File::create(file)?), &info)?),
        None => None,
    };
    let force_scale = options.force_scale.unwrap_or(if info.simulated { 1.0 } else { 0.1 });
    let config = device::loop_config(&device, options.modal, picture);
    let id = app.world_mut().resource_mut::<HapticDevices>().add(device, config)?;
    app.insert_resource(Time::<Fixed>::from_hz(RATE))
        .insert_resource(Traces {
            top: info.peak_force.ceil().min(6.0),
            traces: vec![Trace::new(id, Color::srgb(0.95, 0.35, 0.3))],
        })
        .insert_resource(Scene {
            device: id,
            mover,
            kind,
            modal: options.modal,
            force_scale,
            body: options.body,
            recorder,
        })
        .add_systems(Startup, spawn)
        .add_systems(FixedUpdate, play.before(HapticSystems::Move))
        .add_systems(Update, (hold_out, read_out.after(plot::gather)))
        // The stop keys work even if the panel has the keyboard.
        .add_systems(PreUpdate, stop_keys.after(bevy::input::InputSystems).before(stage::SceneKeys));
    Ok(app.run())
}

fn spawn(
    mut commands: Commands,
    scene: Res<Scene>,
    assets: Res<AssetServer>,
    mut materials: ResMut<Assets<StandardMaterial>>,
    mut pointer: ResMut<PointerGrab>,
) {
    commands.spawn((
        ModalBody::new(assets.load(scene.body.clone())),
        MeshMaterial3d(materials.add(StandardMaterial {
            base_color: Color::srgb(0.95, 0.50, 0.36),
            perceptual_roughness: 0.42,
            ..default()
        })),
    ));
    // If the mouse is not the device, it can grab bodies directly.
    pointer.enabled = scene.kind != Kind::Pointer;
}

/// Spawns the tool once the body exists: the center of the workspace lies on the body's side.
fn hold_out(
    mut commands: Commands,
    scene: Res<Scene>,
    bodies: Query<(&BodyState, &GlobalTransform), Added<BodyState>>,
) {
    let Ok((state, place)) = bodies.single() else { return };
    let toward = Vec3::new(1.0, 0.55, 0.0);
    let along = |p: &&[f32; 3]| Vec3::from(**p).dot(toward);
    let positions = state.model().surface().positions();
    let Some(farthest) = positions.iter().max_by(|a, b| along(a).total_cmp(&along(b))) else { return };
    let size = state.model().size() as f32;
    let mut tool = commands.spawn((
        Name::new("tool"),
        HapticTool { modal: scene.modal, force_scale: scene.force_scale, ..HapticTool::new(scene.device) },
        ToolGrip::default(),
        ForceArrow { radius: 0.02 * size, ..default() },
        Transform::from_translation(place.transform_point(Vec3::from(*farthest))),
    ));
    match (&scene.mover, scene.kind) {
        (Mover::Input(handle), Kind::Pointer) => tool.insert(PointerSource::new(handle.clone())),
        (Mover::Input(handle), _) => tool.insert(GamepadSource::new(handle.clone())),
        _ => &mut tool,
    };
}

/// Moves the simulated hand: it grabs, pulls outward and circles.
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
    // A button counts only after the device loop has seen it open.
    hand.set_buttons(u32::from(t > 0.5));
    let smooth = |t: f64| {
        let t = t.clamp(0.0, 1.0);
        t * t * (3.0 - 2.0 * t)
    };
    let out = smooth((t - 1.0) / 2.0);
    let round = DVec3::new(0.01 * (2.1 * t).sin(), 0.015 * (1.3 * t).sin(), 0.015 * (1.7 * t).cos());
    hand.set_target((out * (DVec3::new(0.085, 0.03, 0.05) + round)).into());
}

fn stop_keys(keys: Option<Res<ButtonInput<KeyCode>>>, mut devices: ResMut<HapticDevices>) {
    let pressed = |key| keys.as_ref().is_some_and(|keys| keys.just_pressed(key));
    if pressed(KeyCode::KeyE) {
        devices.estop();
    }
    if pressed(KeyCode::KeyR) {
        devices.reset_stop();
    }
}

fn read_out(
    mut scene: ResMut<Scene>,
    devices: Res<HapticDevices>,
    mut traces: ResMut<Traces>,
    tools: Query<&ToolPose>,
    mut readout: ResMut<Readout>,
) {
    let Some(status) = devices.get(scene.device) else { return };
    if let Some(recorder) = &mut scene.recorder {
        for record in traces.traces.iter_mut().flat_map(Trace::take_records) {
            if let Err(error) = recorder.write(&record) {
                warn!("the recording ends here: {error}");
                scene.recorder = None;
                break;
            }
        }
    }
    let trace = &traces.traces[0];
    let at = tools.iter().next().map_or(DVec3::ZERO, |pose| pose.position);
    let allowed = status.info.peak_force / 0.005 / 1000.0;
    let Coupling { stiffness, damping, stiffness_limit, .. } = status.coupling;
    readout.0 = format!(
        "{}: {:?}\n\
         coupling     {stiffness:6.0} N/m, {damping:.2} N s/m, limit: {stiffness_limit:?}\n\
         tool           {:+.3} {:+.3} {:+.3} m\n\
         {}\n\
         largest      {:6.2} N, step {:.3} N of {allowed:.2} N allowed",
        status.info.name,
        status.report.state,
        at.x,
        at.y,
        at.z,
        loop_metrics(&status.report),
        trace.largest,
        trace.largest_step,
    );
}

/// Returns the force, the energy, and how well the device loop keeps its time.
fn loop_metrics(report: &LoopReport) -> String {
    let tick = &report.tick;
    let norm = |v: [f64; 3]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let us = |s: f64| s * 1e6;
    let late = |p| us(report.lateness.percentile(p));
    let faults: u32 = report.faults.iter().sum();
    let fault = tick.fault.map_or_else(|| "none now".to_owned(), |fault| fault.to_string());
    format!(
        "force        {:6.2} N of {:.2} N wanted, gain {:.2}\n\
         energy       {:6.1} mJ put in, {:.1} given, {:.1} available\n\
         loop         {:6.0} Hz, {} of {} periods left out, real-time: {}\n\
         late         p50 {:.0}, p99 {:.0}, p99.9 {:.0}, at most {:.0} us\n\
         its own work p50 {:.1}, p99.9 {:.1} us\n\
         faults       {faults} so far ({} of a late simulation), {fault}",
        norm(tick.wrench.force),
        norm(tick.wanted),
        tick.gain,
        1e3 * tick.port.taken,
        1e3 * tick.port.given,
        1e3 * tick.port.available,
        report.rate,
        report.missed,
        report.ticks + report.missed,
        if report.realtime { "yes" } else { "no" },
        late(0.5),
        late(0.99),
        late(0.999),
        us(report.lateness.largest()),
        us(report.work.percentile(0.5)),
        us(report.work.percentile(0.999)),
        report.faults[Fault::Stale(0.0).kind()],
    )
}
