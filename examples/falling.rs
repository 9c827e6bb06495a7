//! Soft jacks fall on a floor, a ball, a slope, a turning bar and a ring of triangles, and stay
//! where friction holds them.
//!
//! What to learn here: an [`Obstacle`] is one component with a `Transform`, and bodies touch it. It
//! may move. [`BodyContacts`] on a body tells where it touches and with what force, and observers
//! of [`ContactStarted`] hear each landing.
//!
//! ```sh
//! cargo run --release --example falling
//! ```

mod stage;

use bevy::{color::Mix, math::DVec3, prelude::*};
use pliant::prelude::*;
use stage::{Look, Readout, Stage};

const GRAVITY: [f64; 3] = [0.0, -9.81, 0.0];

fn main() -> AppExit {
    App::new()
        .add_plugins(
            Stage::new("falling")
                .key("left mouse: hold one")
                .key("R: drop them again")
                .look(Look { middle: Vec3::new(0.0, 0.25, 0.0), distance: 2.6, yaw: 0.35, pitch: 0.3 })
                .picture_at(1.6),
        )
        .add_plugins(PliantPlugins::default())
        .init_resource::<Landings>()
        .add_observer(count_landing)
        .add_systems(Startup, (place, drop_jacks))
        .add_systems(FixedUpdate, turn.before(PliantSystems::Input))
        .add_systems(Update, (again, draw, write))
        .run()
}

/// Landings so far, and the largest impulse of one, N s.
#[derive(Resource, Default)]
struct Landings {
    count: u32,
    hardest: f64,
}

/// A bar that turns about the vertical.
#[derive(Component)]
struct Turning;

#[derive(Component)]
struct Jack;

fn place(
    mut commands: Commands,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    // The stage draws the floor.
    commands.spawn(Obstacle::Floor);
    let matte = materials.add(StandardMaterial {
        base_color: Color::srgb(0.44, 0.5, 0.6),
        perceptual_roughness: 0.8,
        ..default()
    });
    commands.spawn((
        Obstacle::Ball { radius: 0.25 },
        Mesh3d(meshes.add(Sphere::new(0.25))),
        MeshMaterial3d(matte.clone()),
        Transform::from_xyz(-0.75, 0.15, -0.1),
    ));
    let half = Vec3::new(0.45, 0.03, 0.3);
    commands.spawn((
        Obstacle::Box { half },
        Mesh3d(meshes.add(Cuboid::from_size(2.0 * half))),
        MeshMaterial3d(matte.clone()),
        Transform::from_xyz(0.75, 0.2, -0.3).with_rotation(Quat::from_rotation_z(0.42)),
    ));
    let (radius, half_length) = (0.04, 0.45);
    let lying = Quat::from_rotation_z(std::f32::consts::FRAC_PI_2);
    commands.spawn((
        Turning,
        Obstacle::Capsule { radius, half_length },
        Mesh3d(meshes.add(Capsule3d::new(radius, 2.0 * half_length))),
        MeshMaterial3d(matte.clone()),
        Transform::from_xyz(0.0, 0.1, 0.45).with_rotation(lying),
    ));
    // Any mesh may be an obstacle, like one that was made in Blender.
    let ring = meshes.add(Torus { minor_radius: 0.06, major_radius: 0.24 });
    commands.spawn((
        Obstacle::Mesh(ring.clone()),
        Mesh3d(ring),
        MeshMaterial3d(matte),
        Transform::from_xyz(-0.2, 0.06, -0.5),
    ));
}

fn drop_jacks(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    let (warm, cool) = (Color::srgb(0.95, 0.50, 0.36), Color::srgb(0.42, 0.66, 0.58));
    let at = [
        [-0.8, 0.9, 0.0],
        [0.85, 0.8, -0.3],
        [0.05, 0.6, 0.45],
        [-0.2, 0.7, -0.5],
        [0.35, 1.0, 0.9],
        [-0.6, 1.1, 0.75],
    ];
    for (index, at) in at.into_iter().enumerate() {
        let mut body = ModalBody::new(assets.load("jack.modal"));
        body.settings.gravity = GRAVITY;
        let turned = Quat::from_euler(EulerRot::YXZ, 0.9 * index as f32, 0.5 + 0.3 * index as f32, 0.2);
        commands.spawn((
            Jack,
            body,
            MeshMaterial3d(materials.add(StandardMaterial {
                perceptual_roughness: 0.45,
                clearcoat: 0.3,
                ..warm.mix(&cool, index as f32 / 5.0).into()
            })),
            Transform::from_translation(at.into()).with_rotation(turned),
        ));
    }
}

fn again(
    keys: Res<ButtonInput<KeyCode>>,
    mut commands: Commands,
    jacks: Query<Entity, With<Jack>>,
    assets: Res<AssetServer>,
    materials: ResMut<Assets<StandardMaterial>>,
) {
    if keys.just_pressed(KeyCode::KeyR) {
        jacks.iter().for_each(|jack| commands.entity(jack).despawn());
        drop_jacks(commands, assets, materials);
    }
}

/// Turns the bar by half a turn in five seconds.
fn turn(time: Res<Time>, mut bars: Query<&mut Transform, With<Turning>>) {
    for mut bar in &mut bars {
        bar.rotate_y(0.628 * time.delta_secs());
    }
}

fn count_landing(landing: On<ContactStarted>, mut landings: ResMut<Landings>) {
    landings.count += 1;
    landings.hardest = landings.hardest.max(landing.impulse.length());
}

/// Draws the force of each contact.
fn draw(mut gizmos: Gizmos, bodies: Query<&BodyContacts>) {
    for contact in bodies.iter().flat_map(|contacts| &contacts.0) {
        let at = contact.point.as_vec3();
        let arrow = (0.01 * contact.force.as_vec3()).clamp_length_max(0.25);
        if arrow.length() > 0.01 {
            gizmos.arrow(at, at + arrow, Color::srgb(0.98, 0.86, 0.25)).with_tip_length(0.015);
        }
    }
}

fn write(mut readout: ResMut<Readout>, landings: Res<Landings>, bodies: Query<(&BodyContacts, &BodyState)>) {
    let places: usize = bodies.iter().map(|(contacts, _)| contacts.0.len()).sum();
    let force: DVec3 = bodies.iter().map(|(contacts, _)| contacts.force()).sum();
    let weight: f64 = bodies.iter().map(|(_, state)| 9.81 * state.model().mass()).sum();
    let deepest =
        bodies.iter().flat_map(|(contacts, _)| &contacts.0).map(|c| c.penetration).fold(0.0, f64::max);
    let resting = bodies.iter().filter(|(_, state)| state.is_resting()).count();
    readout.0 = format!(
        "contacts            {places:4}   deepest {:.2} mm\n\
         force of all      {:6.2} N   weight of all {weight:.2} N\n\
         landings            {:4}   hardest {:.2} N s\n\
         at rest             {resting:4} of {}",
        1e3 * deepest,
        force.y,
        landings.count,
        landings.hardest,
        bodies.iter().len(),
    );
}
