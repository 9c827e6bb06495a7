//! A character walks in circles and hops. Its ears and the jelly on its tray wobble with it, and a
//! cherry sits on the jelly.
//!
//! What to learn here: an anchored body that is the child of anything feels how that moves
//! ([`Inertia`]). [`RideOn`] finds the bone it belongs to by name, and [`SurfaceAnchor`] lets
//! another entity sit on its surface. The character is moved once per frame, as a character
//! controller does.
//!
//! ```sh
//! cargo run --release --example walk
//! cargo run --release --example walk -- --stiff    # without inertia, for comparison
//! ```

mod stage;

use std::f32::consts::TAU;

use bevy::prelude::*;
use clap::Parser;
use pliant::prelude::*;
use stage::{Look, Readout, Stage};

#[derive(Parser)]
struct Options {
    /// Let the bodies follow the character without inertia.
    #[arg(long)]
    stiff: bool,
    #[command(flatten)]
    stage: stage::Options,
}

/// Radius of the circle, m, and speed on it, m/s.
const CIRCLE: f32 = 0.4;
const SPEED: f32 = 0.7;

/// Time between two hops, time in the air, s, and the height of a hop, m.
const EVERY: f32 = 2.0;
const IN_AIR: f32 = 0.45;
const HEIGHT: f32 = 0.25;

fn main() -> AppExit {
    let options = Options::parse();
    App::new()
        .add_plugins(
            Stage::with("walk", options.stage)
                .key("left mouse: pull an ear")
                .key("I: inertia on and off")
                .key("T: teleport")
                .look(Look { middle: Vec3::new(0.0, 0.36, 0.0), distance: 1.7, yaw: 0.4, pitch: 0.2 })
                .picture_at(2.2),
        )
        .add_plugins(PliantPlugins::default())
        .insert_resource(Feels(if options.stiff { 0.0 } else { 1.0 }))
        .init_resource::<Swing>()
        .add_systems(Startup, spawn)
        .add_systems(Update, (walk, teleport, switch, write).chain())
        .run()
}

/// Factor of all bodies' inertia.
#[derive(Resource)]
struct Feels(f32);

#[derive(Component)]
struct Character;

/// A leg, and half a turn for the left one.
#[derive(Component)]
struct Leg(f32);

fn spawn(
    mut commands: Commands,
    feels: Res<Feels>,
    assets: Res<AssetServer>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    let mut matte =
        |color: Color| materials.add(StandardMaterial { perceptual_roughness: 0.6, ..color.into() });
    let (blue, pale) = (matte(Color::srgb(0.30, 0.42, 0.58)), matte(Color::srgb(0.88, 0.86, 0.80)));
    let (rose, red) = (matte(Color::srgb(0.95, 0.50, 0.36)), matte(Color::srgb(0.80, 0.06, 0.14)));
    let dark = matte(Color::srgb(0.10, 0.11, 0.14));
    let character = commands.spawn((Character, Transform::default(), Visibility::default())).id();
    // The parts of the character: their size, and their place below the part that they belong to.
    let mut part = |name: &str, parent: Entity, skin: &Handle<StandardMaterial>, size: Vec3, at: Vec3| {
        let mesh = Mesh3d(meshes.add(Cuboid::from_size(size)));
        let name = Name::new(name.to_owned());
        let place = Transform::from_translation(at);
        commands.spawn((name, mesh, MeshMaterial3d(skin.clone()), place, ChildOf(parent))).id()
    };
    let trunk = part("Trunk", character, &blue, Vec3::new(0.16, 0.2, 0.11), Vec3::new(0.0, 0.26, 0.0));
    let head = part("Head", trunk, &pale, Vec3::new(0.19, 0.14, 0.15), Vec3::new(0.0, 0.17, 0.0));
    for side in [-1.0, 1.0] {
        part("Eye", head, &dark, Vec3::new(0.025, 0.035, 0.01), Vec3::new(0.045 * side, 0.01, 0.078));
        part("Arm", trunk, &blue, Vec3::new(0.035, 0.035, 0.2), Vec3::new(0.1 * side, 0.02, 0.09));
    }
    part("Tray", trunk, &dark, Vec3::new(0.26, 0.012, 0.22), Vec3::new(0.0, 0.04, 0.24));
    let legs = [-1.0, 1.0].map(|side| {
        part("Leg", trunk, &dark, Vec3::new(0.05, 0.17, 0.06), Vec3::new(0.045 * side, -0.175, 0.0))
    });
    for (leg, phase) in legs.into_iter().zip([0.0, TAU / 2.0]) {
        commands.entity(leg).insert(Leg(phase));
    }

    let inertia = Inertia(feels.0);
    for side in [-1.0, 1.0] {
        let mut ear = ModalBody::new(assets.load("bud.modal"));
        ear.settings.gravity = [0.0, -9.81, 0.0];
        ear.settings.stiffness_scale = 2.5;
        commands.spawn((
            ear,
            inertia,
            MeshMaterial3d(rose.clone()),
            RideOn { root: character, name: "Head".into() },
            Transform::from_xyz(0.06 * side, 0.07, 0.0)
                .with_rotation(Quat::from_rotation_z(-0.3 * side))
                .with_scale(Vec3::splat(0.75)),
        ));
    }
    let mut jelly = ModalBody::new(assets.load("jelly-soft.modal"));
    jelly.settings.gravity = [0.0, -9.81, 0.0];
    let jelly = commands
        .spawn((
            jelly,
            inertia,
            MeshMaterial3d(materials.add(StandardMaterial {
                base_color_texture: Some(assets.load("jelly.png")),
                perceptual_roughness: 0.3,
                ..default()
            })),
            RideOn { root: character, name: "Tray".into() },
            Transform::from_xyz(0.0, 0.006, 0.0),
        ))
        .id();
    // The cherry sits on the rim of the jelly, and its y axis points away from it.
    let cherry = SurfaceAnchor::nearest(jelly, Vec3::new(0.0, 0.2, 0.0));
    commands.spawn((cherry, Visibility::default())).with_child((
        Mesh3d(meshes.add(Sphere::new(0.022))),
        MeshMaterial3d(red),
        Transform::from_xyz(0.0, 0.015, 0.0),
    ));
}

/// Walks on a circle and hops. The legs swing.
fn walk(
    time: Res<Time>,
    mut ahead: Local<f32>,
    keys: Res<ButtonInput<KeyCode>>,
    mut characters: Query<&mut Transform, (With<Character>, Without<Leg>)>,
    mut legs: Query<(&mut Transform, &Leg)>,
) {
    if keys.just_pressed(KeyCode::KeyT) {
        *ahead += TAU / 2.0;
    }
    let t = time.elapsed_secs();
    let angle = SPEED / CIRCLE * t + *ahead;
    let stride = TAU * 1.8 * t;
    let hop = (t % EVERY) / IN_AIR;
    let up = if hop < 1.0 { 4.0 * HEIGHT * hop * (1.0 - hop) } else { 0.012 * stride.sin().abs() };
    for mut place in &mut characters {
        place.translation = Vec3::new(CIRCLE * angle.sin(), up, CIRCLE * angle.cos());
        // It looks where it goes, and leans from leg to leg.
        place.rotation =
            Quat::from_rotation_y(angle + TAU / 4.0) * Quat::from_rotation_z(0.05 * stride.sin());
    }
    for (mut leg, Leg(phase)) in &mut legs {
        leg.rotation = Quat::from_rotation_x(if hop < 1.0 { 0.3 } else { 0.6 * (stride + phase).sin() });
    }
}

/// Announces the jump that `T` makes, so that the bodies do not feel it.
fn teleport(
    keys: Res<ButtonInput<KeyCode>>,
    characters: Query<Entity, With<Character>>,
    mut teleports: MessageWriter<Teleport>,
) {
    if keys.just_pressed(KeyCode::KeyT) {
        teleports.write_batch(characters.iter().map(Teleport));
    }
}

fn switch(keys: Res<ButtonInput<KeyCode>>, mut feels: ResMut<Feels>, mut bodies: Query<&mut Inertia>) {
    if keys.just_pressed(KeyCode::KeyI) {
        feels.0 = 1.0 - feels.0;
        bodies.iter_mut().for_each(|mut inertia| inertia.0 = feels.0);
    }
}

/// Largest ways that a vertex has swung from its place at rest so far, m.
#[derive(Resource, Default)]
struct Swing {
    ear: f32,
    jelly: f32,
}

fn write(
    mut readout: ResMut<Readout>,
    mut swing: ResMut<Swing>,
    feels: Res<Feels>,
    bodies: Query<(&BodyState, &VisualState, Has<ChildOf>)>,
) {
    let mut riding = 0;
    for (state, visual, rides) in &bodies {
        riding += usize::from(rides);
        let rest = state.model().surface().positions();
        let now = state.positions(visual);
        let way = |(a, b): (&[f32; 3], &[f32; 3])| Vec3::from(*a).distance(Vec3::from(*b));
        let most = now.iter().zip(rest).map(way).fold(0.0, f32::max) * state.scale() as f32;
        let of = if state.model().info().name == "bud" { &mut swing.ear } else { &mut swing.jelly };
        *of = of.max(most);
    }
    readout.0 = format!(
        "inertia       {:5.1}\n\
         riding        {riding:5}\n\
         ears swing    {:5.1} cm at most\n\
         jelly swings  {:5.1} cm at most",
        feels.0,
        100.0 * swing.ear,
        100.0 * swing.jelly,
    );
}
