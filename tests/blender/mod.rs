//! A model as Blender exports it, from its file to a body.

use bevy::{
    app::{PluginsState, ScheduleRunnerPlugin},
    gltf::{GltfAssetLabel, GltfExtras, GltfPlugin},
    prelude::*,
    render::{RenderPlugin, settings::WgpuSettings},
    time::TimeUpdateStrategy,
    window::ExitCondition,
    winit::WinitPlugin,
    world_serialization::WorldAssetRoot,
};
use pliant::{
    body::{ATTRIBUTE_ANCHOR, ATTRIBUTE_STIFFNESS, BakeNode, BakePlugin, BakeSettings},
    prelude::*,
};

/// Returns an app that loads the scene of `bud.glb` and bakes its nodes that say so.
pub fn app(draws: bool) -> App {
    let mut app = empty(draws, |app| {
        app.add_systems(Update, bake_what_says_so);
    });
    let scene = app.world().resource::<AssetServer>().load(GltfAssetLabel::Scene(0).from_asset("bud.glb"));
    app.world_mut().spawn(WorldAssetRoot(scene));
    app
}

/// Returns an app that reads and bakes models, with what `add` adds.
pub fn empty(draws: bool, add: impl FnOnce(&mut App)) -> App {
    let gltf = GltfPlugin::default()
        .add_custom_vertex_attribute("STIFFNESS", ATTRIBUTE_STIFFNESS)
        .add_custom_vertex_attribute("ANCHOR", ATTRIBUTE_ANCHOR);
    let mut plugins = DefaultPlugins
        .set(WindowPlugin { primary_window: None, exit_condition: ExitCondition::DontExit, ..default() })
        .set(AssetPlugin {
            file_path: format!("{}/../../tests/blender", env!("CARGO_MANIFEST_DIR")),
            ..default()
        })
        .set(gltf)
        .disable::<WinitPlugin>();
    if !draws {
        let nothing = WgpuSettings { backends: None, ..default() };
        plugins = plugins.set(RenderPlugin { render_creation: nothing.into(), ..default() });
    }
    let mut app = App::new();
    app.add_plugins(plugins)
        .add_plugins((ScheduleRunnerPlugin::run_once(), PliantPlugins::default(), BakePlugin { cache: None }))
        .insert_resource(Time::<Fixed>::from_hz(40.0))
        .insert_resource(TimeUpdateStrategy::FixedTimesteps(1));
    add(&mut app);
    while app.plugins_state() == PluginsState::Adding {
        bevy::tasks::tick_global_task_pools_on_main_thread();
    }
    app.finish();
    app.cleanup();
    app
}

fn bake_what_says_so(
    mut commands: Commands,
    nodes: Query<(Entity, &GltfExtras), Added<GltfExtras>>,
) -> Result {
    for (node, extras) in nodes.iter().filter(|(_, extras)| extras.value.contains("stiffness")) {
        // What is looked at is where parts and vertices go, for which linear elasticity suffices.
        let settings = BakeSettings { tets: 4_000, material: "linear".into(), modes: 12, ..default() };
        commands.entity(node).insert(BakeNode { settings }.with_extras(&extras.value)?);
    }
    Ok(())
}

/// Runs frames until the body is there.
pub fn body(app: &mut App) -> Entity {
    let mut bodies = app.world_mut().query_filtered::<Entity, With<BodyState>>();
    for _ in 0..60_000 {
        app.update();
        if let Ok(body) = bodies.single(app.world()) {
            return body;
        }
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    panic!("no body has come");
}
