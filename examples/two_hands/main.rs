//! Two haptic devices on one body: each hand feels the other through the body.
//!
//! What to learn here: two devices are two entries in [`HapticDevices`], each with its own device
//! loop, and two tools. The left hand pulls and releases; the right hand holds still and feels the
//! pull.
//!
//! ```sh
//! cargo run --release --example two_hands
//! cargo run --release --example two_hands -- --left inverse --right touch
//! cargo run --release --example two_hands -- --headless --seconds 10
//! ```

#[path = "../feel/device.rs"]
mod device;
#[path = "../feel/plot.rs"]
mod plot;
#[path = "../stage/mod.rs"]
mod stage;

use std::error::Error;

use bevy::{math::DVec3, prelude::*};
use clap::Parser;
use pliant::{
    haptics::{
        DeviceId, ForceArrow, HapticDevice, HapticDevices, HapticSystems, HapticTool, HapticsPlugin, ToolGrip,
    },
    prelude::*,
};

use device::{Grip, Kind, Mover};
use plot::{Trace, Traces};
use stage::{Readout, Stage};

/// Ticks of the simulation per second.
const RATE: f64 = 120.0;

/// The hands: where they grab, and their colors.
const SIDES: [(&str, Vec3, Color); 2] = [
    ("left", Vec3::new(-1.0, 0.55, 0.0), Color::srgb(0.30, 0.65, 1.0)),
    ("right", Vec3::new(1.0, 0.55, 0.0), Color::srgb(0.95, 0.35, 0.3)),
];

/// Two haptic devices on one body.
#[derive(Parser, Debug)]
struct Arguments {
    #[command(flatten)]
    stage: stage::Options,

    /// The device in the left hand.
    #[arg(long, value_enum, default_value_t = Kind::Virtual)]
    left: Kind,

    /// The device in the right hand.
    #[arg(long, value_enum, default_value_t = Kind::Virtual)]
    right: Kind,

    /// Let each device loop step its own copy of the body, at device rate.
    #[arg(long)]
    modal: bool,
}

/// The two hands, left first.
#[derive(Resource)]
struct Hands {
    hands: [(DeviceId, Mover, f64); 2],
    modal: bool,
}

fn main() -> AppExit {
    match run(Arguments::parse()) {
        Ok(exit) => exit,
        Err(error) => {
            eprintln!("two_hands: {error}");
            AppExit::from_code(2)
        }
    }
}

fn run(options: Arguments) -> Result<AppExit, Box<dyn Error>> {
    let picture = options.stage.screenshot.is_some();
    let stage =
        Stage::with("two hands", options.stage).real_time().picture_at(8.5).key("left mouse: a third hand");
    let mut app = App::new();
    app.add_plugins((stage, PliantPlugins::default(), HapticsPlugin::default(), plot::plugin));
    let mut add = |kind: Kind| -> Result<(DeviceId, Mover, f64), Box<dyn Error>> {
        if matches!(kind, Kind::Pointer | Kind::Gamepad) {
            return Err("a hand here is a device: virtual, inverse, touch, force-dimension or auto".into());
        }
        let opened = device::open(kind, Grip::Firm)?;
        let config = device::loop_config(&opened.device, options.modal, picture);
        let force_scale = if opened.device.info().simulated { 1.0 } else { 0.1 };
        let id = app.world_mut().resource_mut::<HapticDevices>().add(opened.device, config)?;
        Ok((id, opened.mover, force_scale))
    };
    let hands = [add(options.left)?, add(options.right)?];
    let traces = hands.iter().zip(SIDES).map(|((id, ..), (.., color))| Trace::new(*id, color)).collect();
    app.insert_resource(Time::<Fixed>::from_hz(RATE))
        .insert_resource(Traces { top: 6.0, traces })
        .insert_resource(Hands { hands, modal: options.modal })
        .add_systems(Startup, spawn)
        .add_systems(FixedUpdate, play.before(HapticSystems::Move))
        .add_systems(Update, (hold_out, read_out.after(plot::gather)));
    Ok(app.run())
}

fn spawn(mut commands: Commands, assets: Res<AssetServer>, mut materials: ResMut<Assets<StandardMaterial>>) {
    commands.spawn((
        ModalBody::new(assets.load("pip.modal")),
        MeshMaterial3d(materials.add(StandardMaterial {
            base_color: Color::srgb(0.62, 0.78, 0.45),
            perceptual_roughness: 0.42,
            ..default()
        })),
    ));
}

/// Spawns a tool on either side of the body once it exists.
fn hold_out(
    mut commands: Commands,
    hands: Res<Hands>,
    bodies: Query<(&BodyState, &GlobalTransform), Added<BodyState>>,
) {
    let Ok((state, place)) = bodies.single() else { return };
    for ((device, _, force_scale), (side, toward, color)) in hands.hands.iter().zip(SIDES) {
        let along = |p: &&[f32; 3]| Vec3::from(**p).dot(toward);
        let positions = state.model().surface().positions();
        let Some(farthest) = positions.iter().max_by(|a, b| along(a).total_cmp(&along(b))) else { return };
        commands.spawn((
            Name::new(side),
            HapticTool { modal: hands.modal, force_scale: *force_scale, ..HapticTool::new(*device) },
            ToolGrip::default(),
            ForceArrow { radius: 0.02 * state.model().size() as f32, tool: color, color, ..default() },
            Transform::from_translation(place.transform_point(Vec3::from(*farthest))),
        ));
    }
}

/// Makes both hands grab and pull apart; the left hand moves its arm, the right hand holds still.
fn play(
    time: Res<Time>,
    hands: Res<Hands>,
    tools: Query<(), With<HapticTool>>,
    mut since: Local<Option<f64>>,
) {
    if tools.is_empty() {
        return;
    }
    let now = time.elapsed_secs_f64();
    let t = now - *since.get_or_insert(now);
    let smooth = |t: f64| {
        let t = t.clamp(0.0, 1.0);
        t * t * (3.0 - 2.0 * t)
    };
    for (i, (_, mover, _)) in hands.hands.iter().enumerate() {
        let Mover::Script(hand) = mover else { continue };
        // A button counts only after the device loop has seen it open.
        hand.set_buttons(u32::from(t > 0.5));
        let away = DVec3::new(if i == 0 { -0.06 } else { 0.06 }, 0.03, 0.02);
        let swing = if i == 0 { 0.65 + 0.35 * (2.2 * t).sin() } else { 1.0 };
        hand.set_target((away * swing * smooth((t - 1.0) / 1.5)).into());
    }
}

fn read_out(
    hands: Res<Hands>,
    devices: Res<HapticDevices>,
    traces: Res<Traces>,
    mut readout: ResMut<Readout>,
) {
    readout.0.clear();
    for (((id, ..), (side, ..)), trace) in hands.hands.iter().zip(SIDES).zip(&traces.traces) {
        let Some(status) = devices.get(*id) else { continue };
        let report = &status.report;
        let [x, y, z] = report.tick.wrench.force;
        readout.0 += &format!(
            "{side:>5}: {}, {:?}\n       force {:+.2} {:+.2} {:+.2} N, largest {:.2} N, step {:.3} N\n       loop {:.0} Hz, late p99 {:.0} us\n",
            status.info.name,
            report.state,
            x,
            y,
            z,
            trace.largest,
            trace.largest_step,
            report.rate,
            report.lateness.percentile(0.99) * 1e6,
        );
    }
}
