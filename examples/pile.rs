//! Fifty soft jacks fall onto each other and onto avian's crates, and the crates give way.
//!
//! What to learn here: with the feature `contact-avian` every collider of avian is an obstacle, and
//! a dynamic rigid body is pushed by what it pushes. Nothing but both plugins is needed.
//!
//! ```sh
//! cargo run --release --example pile
//! cargo run --release --example pile -- --headless --seconds 10    # prints the time of a step
//! ```

mod stage;

use std::{
    collections::VecDeque,
    time::{Duration, Instant},
};

use avian3d::prelude::{Collider, ColliderDensity, LinearVelocity, PhysicsPlugins, RigidBody};
use bevy::{color::Mix, prelude::*};
use pliant::prelude::*;
use stage::{Look, Readout, Stage};

const BODIES: usize = 50;

/// Number of steps whose time is shown.
const STEPS: usize = 600;

fn main() -> AppExit {
    App::new()
        .add_plugins(
            Stage::new("pile")
                .key("left mouse: hold a jack")
                .key("R: drop them again")
                .look(Look { middle: Vec3::new(0.0, 0.4, 0.0), distance: 4.2, yaw: 0.4, pitch: 0.35 })
                .picture_at(3.0),
        )
        .add_plugins((PliantPlugins::default(), PhysicsPlugins::default()))
        .insert_resource(BodyGravity::EARTH)
        .init_resource::<Steps>()
        .add_systems(Startup, (place, drop_all))
        .add_systems(FixedFirst, |mut steps: ResMut<Steps>| steps.begun = Some(Instant::now()))
        .add_systems(FixedLast, |mut steps: ResMut<Steps>| {
            let Some(begun) = steps.begun.take() else { return };
            if steps.took.len() >= STEPS {
                steps.took.pop_front();
            }
            steps.took.push_back(begun.elapsed());
        })
        .add_systems(Update, (again, write))
        .run()
}

/// What the last fixed steps of both engines took.
#[derive(Resource, Default)]
struct Steps {
    begun: Option<Instant>,
    took: VecDeque<Duration>,
}

/// What falls.
#[derive(Component)]
struct Falls;

fn place(mut commands: Commands) {
    // The stage draws the floor.
    commands.spawn((RigidBody::Static, Collider::half_space(Vec3::Y), Transform::default()));
}

fn drop_all(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    let edge = 0.3;
    let (cube, wood) = (meshes.add(Cuboid::from_length(edge)), materials.add(Color::srgb(0.62, 0.47, 0.33)));
    for index in 0..8u8 {
        let at = Vec3::new(f32::from(index % 4) * 0.45 - 0.675, 0.151, f32::from(index / 4) * 0.5 - 0.25);
        commands.spawn((
            Falls,
            RigidBody::Dynamic,
            // As light as a box of cardboard with something in it.
            (Collider::cuboid(edge, edge, edge), ColliderDensity(60.0)),
            (Mesh3d(cube.clone()), MeshMaterial3d(wood.clone())),
            Transform::from_translation(at),
        ));
    }
    let (warm, cool) = (Color::srgb(0.95, 0.50, 0.36), Color::srgb(0.42, 0.66, 0.58));
    let jack = assets.load("jack.modal");
    for index in 0..BODIES {
        let (layer, place) = (index / 10, index % 10);
        let at = Vec3::new(
            (place % 5) as f32 * 0.36 - 0.72 + 0.05 * (layer % 2) as f32,
            0.7 + 0.4 * layer as f32,
            (place / 5) as f32 * 0.4 - 0.2,
        );
        let turned = Quat::from_euler(EulerRot::YXZ, 0.9 * index as f32, 0.4 * index as f32, 0.2);
        let color = warm.mix(&cool, index as f32 / BODIES as f32);
        commands.spawn((
            Falls,
            ModalBody::new(jack.clone()),
            TouchBodies,
            MeshMaterial3d(materials.add(StandardMaterial { perceptual_roughness: 0.45, ..color.into() })),
            Transform::from_translation(at).with_rotation(turned),
        ));
    }
}

fn again(
    keys: Res<ButtonInput<KeyCode>>,
    mut commands: Commands,
    falling: Query<Entity, With<Falls>>,
    assets: Res<AssetServer>,
    meshes: ResMut<Assets<Mesh>>,
    materials: ResMut<Assets<StandardMaterial>>,
) {
    if keys.just_pressed(KeyCode::KeyR) {
        falling.iter().for_each(|entity| commands.entity(entity).despawn());
        drop_all(commands, assets, meshes, materials);
    }
}

fn write(
    mut readout: ResMut<Readout>,
    steps: Res<Steps>,
    bodies: Query<(&BodyContacts, &BodyState)>,
    crates: Query<(Entity, &LinearVelocity), (With<RigidBody>, With<Falls>)>,
) {
    let places: usize = bodies.iter().map(|(contacts, _)| contacts.0.len()).sum();
    let resting = bodies.iter().filter(|(_, state)| state.is_resting()).count();
    let pushed =
        crates.iter().filter(|(entity, _)| bodies.iter().any(|(contacts, _)| contacts.touches(*entity)));
    let fastest = crates.iter().map(|(_, velocity)| velocity.length()).fold(0.0, f32::max);
    let mut took: Vec<Duration> = steps.took.iter().copied().collect();
    took.sort_unstable();
    let share = |share: f64| {
        let index = (share * took.len().saturating_sub(1) as f64) as usize;
        took.get(index).map_or(0.0, |took| 1e3 * took.as_secs_f64())
    };
    readout.0 = format!(
        "contacts            {places:4}\n\
         crates touched      {:4}   fastest {fastest:.2} m/s\n\
         a step         p50 {:5.2} ms, p99 {:5.2} ms\n\
         at rest             {resting:4} of {}",
        pushed.count(),
        share(0.5),
        share(0.99),
        bodies.iter().len(),
    );
}
