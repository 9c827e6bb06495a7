//! Plays a scene file: bodies, hands, a session, a device and a recording, without code.
//!
//! What to learn here: [`SceneFile::read`] reads and checks a file, and [`SceneFilePlugin::open`]
//! adds what the scene asks for. Mistakes are reported with line and column before the window
//! opens. [`SceneFile::check_files`] reports mistakes in the files that the scene names. Mistakes
//! that show later are sent as [`SceneFailed`].
//!
//! ```sh
//! cargo run --release --example scene -- assets/scenes/everything.ron
//! cargo run --release --example scene -- assets/scenes/solo.ron --headless --frames 120
//! cargo run --release --example scene -- --check assets/scenes/*.ron
//! ```

#[path = "../stage/mod.rs"]
mod stage;

use std::path::{Path, PathBuf};

use bevy::{ecs::name::NameOrEntityItem, prelude::*};
use clap::Parser;
#[cfg(feature = "net")]
use pliant::{
    net::{NetStats, User},
    scene::NetworkEntry,
};
use pliant::{
    prelude::*,
    scene::{SceneBody, SceneError, SceneFailed, SceneFile, SceneFilePlugin, ViewEntry},
};

use stage::{Look, Readout, Stage};

/// Plays a scene file.
#[derive(Parser, Debug)]
struct Options {
    #[command(flatten)]
    stage: stage::Options,

    /// Check the files and the files that they name, report mistakes, and play nothing.
    #[arg(long)]
    check: bool,

    /// The scene file; with --check, any number of files.
    #[arg(required = true, value_name = "FILE.ron")]
    files: Vec<PathBuf>,
}

/// Title of the scene.
#[derive(Resource)]
struct Title(String);

fn main() -> AppExit {
    let options = Options::parse();
    let report = |error: &SceneError| {
        eprintln!("{error}");
        AppExit::from_code(2)
    };
    if options.check {
        let right = options.files.iter().filter(|file| read(file).is_some()).count();
        println!("{right} of {} scenes are right", options.files.len());
        return if right == options.files.len() { AppExit::Success } else { AppExit::from_code(2) };
    }
    let [file] = options.files.as_slice() else {
        eprintln!("scene: expected one file to play, got {}", options.files.len());
        return AppExit::from_code(2);
    };
    let Some(file) = read(file) else { return AppExit::from_code(2) };
    let mut stage = Stage::with("a scene from a file", options.stage).picture_at(4.0).key("left mouse: pull");
    let (file, scene) = match SceneFilePlugin::open(file.clone()).map(|scene| (file, scene)) {
        Ok(both) => both,
        Err(error) => return report(&error),
    };
    #[cfg(feature = "net")]
    if let Some(invite) = scene.invite() {
        println!("{invite}");
    }
    let description = file.scene();
    if let Some(view) = description.view {
        stage = stage.look(look(&view));
    }
    // Sessions and devices run on their own threads and in real time.
    if description.network.is_some() || description.device.is_some() {
        stage = stage.real_time();
    }
    let mut app = App::new();
    #[cfg(feature = "net")]
    if matches!(description.network, Some(NetworkEntry::Host { guest: Some(_), .. })) {
        app.world_mut().spawn(stage::Awaited);
        app.add_systems(Update, meet);
    }
    app.add_plugins((stage, PliantPlugins::default(), scene))
        .insert_resource(Title(description.title.clone()))
        .add_systems(Update, (read_out, end_on_failure))
        .run()
}

/// Starts the run once the guest has joined the host's session.
#[cfg(feature = "net")]
fn meet(mut commands: Commands, awaited: Query<Entity, With<stage::Awaited>>, users: Query<(), With<User>>) {
    if users.iter().count() > 1 {
        awaited.iter().for_each(|entity| commands.entity(entity).despawn());
    }
}

/// Returns the scene if it and the files that it names are valid; otherwise prints the errors.
fn read(file: &Path) -> Option<SceneFile> {
    let (scene, wrong) = match SceneFile::read(file) {
        Ok(scene) => {
            let wrong = scene.check_files(stage::ASSETS);
            (Some(scene), wrong)
        }
        Err(error) => (None, vec![error]),
    };
    wrong.iter().for_each(|error| eprintln!("{error}"));
    scene.filter(|_| wrong.is_empty())
}

/// Returns the camera of the stage for the view of the scene.
fn look(view: &ViewEntry) -> Look {
    let [x, y, z] = view.middle.map(|v| v as f32);
    Look {
        middle: Vec3::new(x, y, z),
        distance: view.distance as f32,
        yaw: (view.yaw as f32).to_radians(),
        pitch: (view.pitch as f32).to_radians(),
    }
}

/// Ends the app when a part of the scene has failed; the error is logged with its position.
fn end_on_failure(mut failures: MessageReader<SceneFailed>, mut exit: MessageWriter<AppExit>) {
    if failures.read().count() > 0 {
        exit.write(AppExit::from_code(2));
    }
}

/// Returns the name of a hand. The hands of other users have no name.
fn called(hand: NameOrEntityItem) -> String {
    hand.name.map_or_else(|| "another's hand".to_owned(), ToString::to_string)
}

fn read_out(
    title: Res<Title>,
    bodies: Query<&BodyState, With<SceneBody>>,
    hands: Query<(NameOrEntity, &GrabForce), With<Grab>>,
    #[cfg(feature = "net")] session: (Option<Res<NetStats>>, Query<&User>),
    #[cfg(feature = "haptics")] devices: Option<Res<HapticDevices>>,
    mut readout: ResMut<Readout>,
) {
    let awake = bodies.iter().filter(|body| !body.is_resting()).count();
    let mut lines = vec![format!("{}: {awake} of {} bodies awake", title.0, bodies.iter().count())];
    let mut felt: Vec<(String, f64)> =
        hands.iter().map(|(name, felt)| (called(name), felt.force.length())).collect();
    felt.sort_by(|a, b| a.0.cmp(&b.0));
    lines.extend(felt.iter().take(8).map(|(name, force)| format!("{name:16} {force:6.2} N")));
    #[cfg(feature = "net")]
    if let (Some(stats), users) = &session {
        lines.push(format!(
            "session          {} users, {:.0} kbit/s out, {} messages refused",
            users.iter().count(),
            stats.bytes_out_per_s * 8e-3,
            stats.rejected,
        ));
    }
    #[cfg(feature = "haptics")]
    for (_, status) in devices.iter().flat_map(|devices| devices.iter()) {
        let force = Vec3::from(status.report.tick.wrench.force.map(|newtons| newtons as f32)).length();
        lines
            .push(format!("{:16} {force:6.2} N in the hand, {:.0} Hz", status.info.name, status.report.rate));
    }
    readout.0 = lines.join("\n");
}
