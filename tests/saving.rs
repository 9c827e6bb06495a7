//! Tests that a scene of live bodies can be saved as Bevy saves worlds, and goes on from there.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "a failed test should panic")]

use std::time::{Duration, Instant};

use bevy::{
    ecs::{entity::EntityHashMap, reflect::AppTypeRegistry},
    math::DVec3,
    prelude::*,
    time::TimeUpdateStrategy,
    transform::TransformPlugin,
    world_serialization::serde::WorldDeserializer,
};
use pliant::{modal::State, prelude::*};
use serde::de::DeserializeSeed;

const ASSETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets");

/// Returns an app whose every frame is one step, unless time is paused.
fn app() -> App {
    let mut app = App::new();
    app.add_plugins((
        MinimalPlugins,
        AssetPlugin { file_path: ASSETS.into(), ..default() },
        TransformPlugin,
        PliantPlugins::default(),
    ))
    .insert_resource(Time::<Fixed>::from_hz(60.0))
    .insert_resource(TimeUpdateStrategy::FixedTimesteps(1));
    app.finish();
    app.cleanup();
    app.update();
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

/// Names the entity, so that it is found again in the loaded world.
fn named(app: &mut App, name: &str) -> Entity {
    let world = app.world_mut();
    let mut names = world.query::<(Entity, &Name)>();
    names.iter(world).find(|(_, of)| of.as_str() == name).map(|(entity, _)| entity).unwrap()
}

fn spawn(app: &mut App, name: &str, model: &str, at: Vec3, settings: fn(&mut ModalBody)) -> Entity {
    let mut body = ModalBody::new(app.world().resource::<AssetServer>().load(model.to_owned()));
    body.settings.gravity = [0.0, -9.81, 0.0];
    settings(&mut body);
    app.world_mut().spawn((Name::new(name.to_owned()), body, Transform::from_translation(at))).id()
}

/// Spawns a hand at the vertex of the body that is farthest along `toward`.
fn hold(app: &mut App, name: &str, body: &str, toward: Vec3) {
    let body = named(app, body);
    let state = app.world().get::<BodyState>(body).unwrap();
    let positions = state.model().surface().positions();
    let along = |vertex: usize| Vec3::from(positions[vertex]).dot(toward);
    let vertex = (0..positions.len()).max_by(|a, b| along(*a).total_cmp(&along(*b))).unwrap() as u32;
    let place = app.world().get::<Transform>(body).unwrap().translation;
    let at = (place + Vec3::from(positions[vertex as usize])).as_dvec3();
    let radius = 0.06 * state.model().size();
    app.world_mut().spawn((Name::new(name.to_owned()), Grab::new(vertex, radius, at), GrabOf(body)));
}

const BODIES: [&str; 3] = ["anchored", "creeping", "free"];
const HANDS: [&str; 3] = ["left", "right", "throwing"];

/// A scene with anchored, viscoelastic and free bodies, and hands on all of them.
fn scene() -> App {
    let mut app = app();
    spawn(&mut app, "anchored", "pip.modal", Vec3::ZERO, |_| ());
    spawn(&mut app, "creeping", "bud.modal", Vec3::X, |body| {
        body.settings.relaxation = Some(Relaxation { ratio: 0.5, time: 0.3 });
    });
    spawn(&mut app, "free", "jack.modal", Vec3::new(3.0, 1.0, 0.0), |_| ());
    wait_for_bodies(&mut app, BODIES.len());
    hold(&mut app, "left", "anchored", Vec3::NEG_X);
    hold(&mut app, "right", "creeping", Vec3::Y);
    hold(&mut app, "throwing", "free", Vec3::Z);
    app
}

/// Moves the hands as they are at this tick, and steps once.
fn step(app: &mut App, tick: u32) {
    for (k, name) in HANDS.into_iter().enumerate() {
        let hand = named(app, name);
        let phase = 0.07 * f64::from(tick) + k as f64;
        let way = 1e-3 * DVec3::new(phase.sin(), 0.7 * (1.3 * phase).cos(), (0.6 * phase).sin());
        app.world_mut().get_mut::<Grab>(hand).unwrap().target += way;
    }
    app.update();
}

/// State of every body, and force on every hand.
fn results(app: &mut App) -> (Vec<State>, Vec<GrabForce>) {
    let bodies = BODIES.map(|name| named(app, name));
    let hands = HANDS.map(|name| named(app, name));
    let state = |body| app.world().get::<BodyState>(body).unwrap().body().state().clone();
    let force = |hand| *app.world().get::<GrabForce>(hand).unwrap();
    (bodies.map(state).into(), hands.map(force).into())
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
fn load(text: &str) -> App {
    let mut app = app();
    let server = app.world().resource::<AssetServer>().clone();
    let registry = app.world().resource::<AppTypeRegistry>().clone();
    let mut from = ron::de::Deserializer::from_str(text).unwrap();
    let reader = WorldDeserializer { type_registry: &registry.read(), load_from_path: &mut &server };
    let saved = reader.deserialize(&mut from).unwrap();
    saved.write_to_world(app.world_mut(), &mut EntityHashMap::default()).unwrap();
    app
}

#[test]
fn a_saved_and_loaded_scene_goes_on_bit_for_bit() {
    let mut scene = scene();
    (0..97).for_each(|tick| step(&mut scene, tick));
    let text = save(&scene);
    let mut loaded = load(&text);
    wait_for_bodies(&mut loaded, BODIES.len());
    assert_eq!(results(&mut loaded).0, results(&mut scene).0, "the states that were saved");
    for tick in 97..697 {
        step(&mut scene, tick);
        step(&mut loaded, tick);
        assert_eq!(results(&mut loaded), results(&mut scene), "tick {tick}");
    }
    let tick = |app: &App| *app.world().resource::<PliantTick>();
    assert_eq!(tick(&loaded), tick(&scene));
    // Something has moved.
    let (states, forces) = results(&mut scene);
    assert!(states.iter().all(|state| state.v.iter().any(|v| v.abs() > 1e-4)));
    assert!(forces.iter().all(|force| force.force.length() > 1e-2));
}
