//! Tests that a scene of live bodies can be saved as Bevy saves worlds, and goes on from there.

use std::time::{Duration, Instant};

use bevy::{
    ecs::{entity::EntityHashMap, reflect::AppTypeRegistry},
    math::DVec3,
    prelude::*,
    time::TimeUpdateStrategy,
    transform::TransformPlugin,
    world_serialization::serde::WorldDeserializer,
};
use pliant::{
    bake::{BakeConfig, Material, bake},
    mesh::shapes,
    modal::State,
    prelude::*,
};
use serde::de::DeserializeSeed;

const ASSETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets");

/// Returns an app whose every frame is one step, unless time is paused.
fn app(assets: &str) -> App {
    let mut app = App::new();
    app.add_plugins((
        MinimalPlugins,
        AssetPlugin { file_path: assets.into(), ..default() },
        TransformPlugin,
        PliantPlugins::default(),
    ))
    .insert_resource(Time::<Fixed>::from_hz(60.0))
    .insert_resource(TimeUpdateStrategy::FixedTimesteps(1));
    app.finish();
    app.cleanup();
    // Time begins in the second frame.
    (0..2).for_each(|_| app.update());
    app
}

fn pause(app: &mut App, is_paused: bool) {
    let mut time = app.world_mut().resource_mut::<Time<Virtual>>();
    if is_paused { time.pause() } else { time.unpause() }
}

/// Runs frames in which time stands still, until this many bodies are there.
fn wait_for_bodies(app: &mut App, count: usize) {
    pause(app, true);
    let begun = Instant::now();
    let mut bodies = app.world_mut().query::<&BodyState>();
    while bodies.iter(app.world()).count() < count {
        assert!(begun.elapsed() < Duration::from_secs(300), "the bodies are not there");
        std::thread::sleep(Duration::from_millis(2));
        app.update();
    }
    app.update();
    pause(app, false);
}

/// Finds an entity by its name, which it also has in the loaded world.
fn named(app: &mut App, name: &str) -> Entity {
    let world = app.world_mut();
    let mut names = world.query::<(Entity, &Name)>();
    names.iter(world).find(|(_, of)| of.as_str() == name).map(|(entity, _)| entity).unwrap()
}

fn spawn(app: &mut App, name: &str, model: &str, at: Vec3, settings: fn(&mut ModalBody)) {
    let mut body = ModalBody::new(app.world().resource::<AssetServer>().load(model.to_owned()));
    body.settings.gravity = [0.0, -9.81, 0.0];
    settings(&mut body);
    app.world_mut().spawn((Name::new(name.to_owned()), body, Transform::from_translation(at)));
}

/// Spawns a hand at the vertex of the body that is farthest along `toward`.
fn hold(app: &mut App, name: &str, body: &str, toward: Vec3) {
    let body = named(app, body);
    let state = app.world().get::<BodyState>(body).unwrap();
    let positions = state.model().surface().positions();
    let along = |vertex: usize| Vec3::from(positions[vertex]).dot(toward);
    let vertex = (0..positions.len()).max_by(|a, b| along(*a).total_cmp(&along(*b))).unwrap();
    let place = app.world().get::<Transform>(body).unwrap().translation;
    let at = (place + Vec3::from(positions[vertex])).as_dvec3();
    let grab = Grab::new(vertex as u32, 0.06 * state.model().size(), at);
    app.world_mut().spawn((Name::new(name.to_owned()), grab, GrabOf(body)));
}

/// Moves the hands as they move at this tick, and steps once.
fn step(app: &mut App, hands: &[&str], tick: u32) {
    for (k, name) in hands.iter().enumerate() {
        let hand = named(app, name);
        let phase = 0.07 * f64::from(tick) + k as f64;
        // Columns of held patches that a hand has left are made anew beside the frames, and when
        // these come depends on the clock. A gentle hand does not leave them.
        let size = if *name == "gentle" { 2e-4 } else { 1e-3 };
        let way = size * DVec3::new(phase.sin(), 0.7 * (1.3 * phase).cos(), (0.6 * phase).sin());
        app.world_mut().get_mut::<Grab>(hand).unwrap().target += way;
    }
    app.update();
}

/// State of every body, and force on every hand.
fn results(app: &mut App, bodies: &[&str], hands: &[&str]) -> (Vec<State>, Vec<GrabForce>) {
    let bodies: Vec<Entity> = bodies.iter().map(|name| named(app, name)).collect();
    let hands: Vec<Entity> = hands.iter().map(|name| named(app, name)).collect();
    let state = |body| app.world().get::<BodyState>(body).unwrap().body().state().clone();
    let force = |hand| *app.world().get::<GrabForce>(hand).unwrap();
    (bodies.into_iter().map(state).collect(), hands.into_iter().map(force).collect())
}

/// Saves all entities of a world and the number of the tick, as text.
fn save(app: &App) -> String {
    let world = app.world();
    let registry = world.resource::<AppTypeRegistry>().read();
    let entities = world.archetypes().iter().flat_map(|archetype| archetype.entities());
    let saved = DynamicWorldBuilder::from_world(world, &registry)
        .deny_all_resources()
        .allow_resource::<PliantTick>()
        .extract_entities(entities.map(|entity| entity.id()))
        .extract_resources()
        .remove_empty_entities()
        .build();
    saved.serialize(&registry).unwrap()
}

/// Writes a saved world to a new one.
fn load(text: &str, assets: &str) -> App {
    let mut app = app(assets);
    let server = app.world().resource::<AssetServer>().clone();
    let registry = app.world().resource::<AppTypeRegistry>().clone();
    let mut from = ron::de::Deserializer::from_str(text).unwrap();
    let reader = WorldDeserializer { type_registry: &registry.read(), load_from_path: &mut &server };
    let saved = reader.deserialize(&mut from).unwrap();
    saved.write_to_world(app.world_mut(), &mut EntityHashMap::default()).unwrap();
    app
}

/// Runs a scene on, saves it, loads it, and runs both on for 600 ticks.
fn check(scene: &mut App, assets: &str, bodies: &[&str], hands: &[&str]) -> App {
    (0..97).for_each(|tick| step(scene, hands, tick));
    let mut loaded = load(&save(scene), assets);
    wait_for_bodies(&mut loaded, bodies.len());
    let states = |app: &mut App| results(app, bodies, hands).0;
    assert_eq!(states(&mut loaded), states(scene), "the states that were saved");
    for tick in 97..697 {
        step(scene, hands, tick);
        step(&mut loaded, hands, tick);
        assert_eq!(results(&mut loaded, bodies, hands), results(scene, bodies, hands), "tick {tick}");
    }
    let tick = |app: &App| *app.world().resource::<PliantTick>();
    assert_eq!(tick(&loaded), tick(scene));
    // The hands feel something.
    assert!(results(scene, bodies, hands).1.iter().all(|force| force.force.length() > 1e-2));
    loaded
}

/// Anchored, viscoelastic and free bodies with hands on them, and a floor onto which a fourth body
/// falls.
#[test]
fn a_saved_and_loaded_scene_goes_on_bit_for_bit() {
    let bodies = ["anchored", "creeping", "free", "fallen"];
    let mut scene = app(ASSETS);
    spawn(&mut scene, "anchored", "pip.modal", Vec3::ZERO, |_| ());
    spawn(&mut scene, "creeping", "bud.modal", Vec3::X, |body| {
        body.settings.relaxation = Some(Relaxation { ratio: 0.5, time: 0.3 });
    });
    spawn(&mut scene, "free", "jack.modal", Vec3::new(3.0, 1.0, 0.0), |_| ());
    spawn(&mut scene, "fallen", "jack.modal", Vec3::new(6.0, 0.3, 0.0), |_| ());
    scene.world_mut().spawn((Name::new("floor"), Obstacle::Floor));
    wait_for_bodies(&mut scene, bodies.len());
    hold(&mut scene, "left", "anchored", Vec3::NEG_X);
    hold(&mut scene, "right", "creeping", Vec3::Y);
    hold(&mut scene, "throwing", "free", Vec3::Z);
    let mut loaded = check(&mut scene, ASSETS, &bodies, &["left", "right", "throwing"]);
    let touches = |app: &mut App| {
        let (body, floor) = (named(app, "fallen"), named(app, "floor"));
        app.world().get::<BodyContacts>(body).unwrap().touches(floor)
    };
    assert!(touches(&mut scene) && touches(&mut loaded), "the fallen body lies on the floor");
}

#[test]
fn a_body_waits_for_the_shapes_of_its_hands_and_goes_on_bit_for_bit() {
    let config = BakeConfig {
        modes: 20,
        material: Some(Material::NeoHookean),
        anchors: vec!["x<1e-9".parse().unwrap()],
        ..Default::default()
    };
    let mesh = shapes::bar([10, 2, 2], [1.0, 0.1, 0.1]).unwrap();
    let model = bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model;
    let folder = std::env::temp_dir().join(format!("pliant-saving-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    model.write(folder.join("bar.modal")).unwrap();
    let assets = folder.to_str().unwrap();
    let mut scene = app(assets);
    spawn(&mut scene, "bar", "bar.modal", Vec3::ZERO, |body| {
        body.rest_speed = 0.0;
    });
    wait_for_bodies(&mut scene, 1);
    hold(&mut scene, "gentle", "bar", Vec3::X);
    let shapes = |app: &mut App| {
        let body = named(app, "bar");
        app.world().get::<BodyState>(body).unwrap().body().held_shapes().is_some()
    };
    let begun = Instant::now();
    while !shapes(&mut scene) {
        assert!(begun.elapsed() < Duration::from_secs(300), "no shapes are made");
        std::thread::sleep(Duration::from_millis(2));
        scene.update();
    }
    let mut loaded = check(&mut scene, assets, &["bar"], &["gentle"]);
    assert!(shapes(&mut loaded), "the loaded body has the shapes, too");
    std::fs::remove_dir_all(&folder).unwrap();
}

#[derive(Resource, Default)]
struct Received(Vec<String>);

#[test]
fn a_state_of_another_model_is_refused_and_the_body_begins_at_rest() {
    let mut scene = app(ASSETS);
    spawn(&mut scene, "pip", "pip.modal", Vec3::ZERO, |_| ());
    wait_for_bodies(&mut scene, 1);
    (0..30).for_each(|_| scene.update());
    let mut loaded = load(&save(&scene).replace("pip.modal", "bud.modal"), ASSETS);
    loaded.init_resource::<Received>().add_observer(
        |refused: On<BodyRefused>, mut received: ResMut<Received>| {
            received.0.push(refused.error.to_string());
        },
    );
    wait_for_bodies(&mut loaded, 1);
    let received = &loaded.world().resource::<Received>().0;
    assert!(matches!(&received[..], [one] if one.contains("saved state")), "{received:?}");
    let body = named(&mut loaded, "pip");
    assert!(loaded.world().get::<BodyState>(body).unwrap().body().q().iter().all(|q| *q == 0.0));
    (0..30).for_each(|_| loaded.update());
}
