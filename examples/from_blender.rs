//! A model from Blender becomes a soft body, with what was painted on it: here a bird with a stiff
//! beak, a light crown and fixed feet.
//!
//! What to learn here: [`BakeNode`] makes a body of a glTF node, and keeps its materials. The
//! [page](../docs/blender.md) has the steps in Blender.
//!
//! ```sh
//! cargo run --release --example from_blender                   # assets/bird.glb
//! cargo run --release --example from_blender -- MODEL.glb      # yours
//! ```

mod stage;

use std::{
    path::{Path, PathBuf},
    time::Instant,
};

use bevy::{
    asset::LoadState,
    gltf::{GltfExtras, GltfPlugin},
    math::DVec3,
    prelude::*,
    world_serialization::{WorldAsset, WorldAssetRoot},
};
use clap::Parser;
use pliant::{
    body::{
        ATTRIBUTE_ANCHOR, ATTRIBUTE_DENSITY, ATTRIBUTE_STIFFNESS, BakeFailed, BakeNode, BakePlugin,
        BakeSettings,
    },
    prelude::*,
};
use stage::{Awaited, Readout, Stage};

/// Makes soft bodies of the nodes of a glTF file that have the custom property `stiffness`.
#[derive(Parser, Debug)]
struct Options {
    #[command(flatten)]
    stage: stage::Options,

    /// The model, as Blender exports it (.glb or .gltf). Default: the bird in the project's assets.
    model: Option<PathBuf>,

    /// Approximate number of tetrahedra of a body.
    #[arg(long, default_value_t = 5000)]
    tets: usize,
}

#[derive(Resource)]
struct Bake {
    file: String,
    scene: Handle<WorldAsset>,
    tets: usize,
    begun: Instant,
    /// Bodies that are there, and the time until the last one was, s.
    bodies: (usize, f64),
    /// Nodes that are to be bodies.
    asked: usize,
    /// Frames since the file was read.
    frames: u32,
    wrong: Vec<String>,
}

fn main() -> AppExit {
    let options = Options::parse();
    let model = options.model.unwrap_or_else(|| Path::new(stage::ASSETS).join("bird.glb"));
    let (folder, file) = (model.parent(), model.file_name());
    let folder = folder.filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let (Ok(folder), Some(file)) = (folder.canonicalize(), file) else {
        eprintln!("from_blender: there is no {}", model.display());
        return AppExit::from_code(2);
    };
    // Bevy's glTF plugin needs the names of the painted attributes, without their underscore.
    let gltf = GltfPlugin::default()
        .add_custom_vertex_attribute("ANCHOR", ATTRIBUTE_ANCHOR)
        .add_custom_vertex_attribute("STIFFNESS", ATTRIBUTE_STIFFNESS)
        .add_custom_vertex_attribute("DENSITY", ATTRIBUTE_DENSITY);
    let folder = AssetPlugin { file_path: folder.to_string_lossy().into_owned(), ..default() };
    let stage = Stage::with("from_blender", options.stage).real_time().key("left mouse: pull the body");
    let bake = Bake {
        file: file.to_string_lossy().into_owned(),
        scene: Handle::default(),
        tets: options.tets,
        begun: Instant::now(),
        bodies: (0, 0.0),
        asked: 0,
        frames: 0,
        wrong: Vec::new(),
    };
    App::new()
        .add_plugins(stage.build().set(gltf).set(folder))
        .add_plugins((PliantPlugins::default(), BakePlugin::default()))
        .insert_resource(bake)
        .add_systems(Startup, |mut commands: Commands, assets: Res<AssetServer>, mut bake: ResMut<Bake>| {
            bake.scene = assets.load(GltfAssetLabel::Scene(0).from_asset(bake.file.clone()));
            commands.spawn((WorldAssetRoot(bake.scene.clone()), Awaited));
        })
        .add_systems(Update, (bake_what_says_so, write))
        .add_systems(FixedUpdate, nudge.before(PliantSystems::Input))
        .add_observer(|failed: On<BakeFailed>, mut bake: ResMut<Bake>| {
            bake.wrong.push(format!("no body: {}", failed.error));
        })
        .run()
}

fn bake_what_says_so(
    mut commands: Commands,
    nodes: Query<(Entity, &GltfExtras), Added<GltfExtras>>,
    mut bake: ResMut<Bake>,
) {
    for (node, extras) in nodes.iter().filter(|(_, extras)| extras.value.contains("stiffness")) {
        let settings = BakeSettings { tets: bake.tets, ..default() };
        match (BakeNode { settings }).with_extras(&extras.value) {
            Ok(made) => {
                bake.asked += 1;
                commands.entity(node).insert(made);
            }
            Err(error) => bake.wrong.push(format!("no body: {error}")),
        }
    }
}

/// Every two seconds the highest point of each body gets a push.
fn nudge(
    time: Res<Time>,
    bodies: Query<(Entity, &BodyState)>,
    mut impulses: MessageWriter<Impulse>,
    mut count: Local<u32>,
) {
    let rounds = (time.elapsed_secs() / 2.0) as u32;
    if rounds == *count {
        return;
    }
    *count = rounds;
    let turn = DVec3::new(1.0, 0.0, 0.4) * if rounds.is_multiple_of(2) { 1.0 } else { -1.0 };
    for (body, state) in &bodies {
        let positions = state.model().surface().positions();
        let top = (0..positions.len()).max_by(|&a, &b| positions[a][1].total_cmp(&positions[b][1]));
        let impulse = turn * (0.15 * state.model().mass());
        impulses.write(Impulse { body, vertex: top.unwrap_or(0) as u32, impulse });
    }
}

fn write(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut bake: ResMut<Bake>,
    bodies: Query<&BodyState>,
    awaited: Query<Entity, With<Awaited>>,
    mut readout: ResMut<Readout>,
) {
    let bake = &mut *bake;
    if bodies.iter().len() > bake.bodies.0 {
        bake.bodies = (bodies.iter().len(), bake.begun.elapsed().as_secs_f64());
    }
    if let LoadState::Failed(error) = assets.load_state(&bake.scene)
        && bake.wrong.is_empty()
    {
        // What follows the first line is for those who mend the loader.
        let text = error.to_string();
        bake.wrong.push(format!("no model: {}", text.lines().next().unwrap_or_default()));
    }
    bake.frames += u32::from(assets.is_loaded_with_dependencies(&bake.scene));
    if bake.frames == 60 && bake.asked == 0 && bake.wrong.is_empty() {
        let text = "no body: no object has the custom property `stiffness`, or the export left them out";
        bake.wrong.push(text.into());
    }
    if bake.bodies.0 > 0 || !bake.wrong.is_empty() {
        awaited.iter().for_each(|entity| _ = commands.entity(entity).remove::<Awaited>());
    }
    let mut lines = bake.wrong.clone();
    if bake.bodies.0 > 0 {
        let coordinates: usize = bodies.iter().map(|state| state.model().mode_count()).sum();
        let mass: f64 = bodies.iter().map(|state| state.model().mass()).sum();
        let (count, took) = bake.bodies;
        lines.push(format!(
            "baked in    {took:.1} s\nbodies      {count}\nmass        {mass:.2} kg\ncoordinates {coordinates}"
        ));
    } else if lines.is_empty() {
        lines.push(format!("{} is being baked", bake.file));
    }
    let text = lines.join("\n");
    if readout.0 != text {
        readout.0 = text;
    }
}
