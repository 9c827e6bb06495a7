//! A mobile: soft jacks hang from a beam and carry balls of avian on their arms.
//!
//! What to learn here: an [`Attachment`] ties a place of a soft body's surface to a point of a
//! rigid body, as a ball joint. Both give way, and [`AttachmentForce`] has the force. At rest each
//! attachment holds the weight of all that hangs below it; the table shows both.
//!
//! ```sh
//! cargo run --release --example mobile
//! ```

mod stage;

use avian3d::prelude::{Collider, ColliderDensity, ComputedMass, PhysicsPlugins, RigidBody};
use bevy::prelude::*;
use pliant::prelude::*;
use stage::{Look, Readout, Stage};

const GRAVITY: f64 = 9.81;

/// Distance of a jack's upper and lower end, and of the ends of its arms, from its middle, m.
const END: f32 = 0.142;
const ARM: f32 = 0.205;

/// Distance between a jack's end and what hangs from it, m.
const BELOW: f32 = 0.03;

fn main() -> AppExit {
    App::new()
        .add_plugins(
            Stage::new("mobile")
                .key("left mouse: pull a jack")
                .look(Look { middle: Vec3::new(0.0, 0.85, 0.0), distance: 2.2, yaw: 0.35, pitch: 0.08 })
                .picture_at(3.0),
        )
        .add_plugins((PliantPlugins::default(), PhysicsPlugins::default()))
        .insert_resource(BodyGravity::EARTH)
        .add_systems(Startup, spawn)
        .add_systems(Update, write)
        .run()
}

/// The attachment that holds a jack, and what hangs below it.
#[derive(Component)]
struct Holds {
    jacks: Vec<Entity>,
    rigids: Vec<Entity>,
}

fn spawn(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    let mut matte =
        |color: Color| materials.add(StandardMaterial { perceptual_roughness: 0.5, ..color.into() });
    let (wood, slate) = (matte(Color::srgb(0.62, 0.47, 0.33)), matte(Color::srgb(0.30, 0.42, 0.58)));
    let colors =
        [Color::srgb(0.95, 0.50, 0.36), Color::srgb(0.86, 0.68, 0.34), Color::srgb(0.42, 0.66, 0.58)]
            .map(matte);
    let beam = Vec3::new(0.8, 0.05, 0.08);
    let mut above = commands
        .spawn((
            (RigidBody::Static, Collider::cuboid(beam.x, beam.y, beam.z)),
            (Mesh3d(meshes.add(Cuboid::from_size(beam))), MeshMaterial3d(wood)),
            Transform::from_xyz(0.0, 1.5, 0.0),
        ))
        .id();
    // Where a point of what is above holds the next jack: in its axes and in the world.
    let (mut point, mut height) = (Vec3::new(0.0, -0.5 * beam.y, 0.0), 1.5 - 0.5 * beam.y);
    let (mut jacks, mut rigids, mut holds) = (Vec::new(), Vec::new(), Vec::new());
    for (level, color) in colors.into_iter().enumerate() {
        let middle = height - END;
        let jack = commands
            .spawn((
                ModalBody::new(assets.load("jack.modal")),
                MeshMaterial3d(color),
                Transform::from_xyz(0.0, middle, 0.0),
            ))
            .id();
        let held = commands.spawn(Attachment::new(jack, END * Vec3::Y, above, point)).id();
        holds.push((held, jacks.len(), rigids.len()));
        jacks.push(jack);
        let radius = 0.028 - 0.004 * level as f32;
        let drop = radius + BELOW;
        let (ball, cord) = (meshes.add(Sphere::new(radius)), meshes.add(Cylinder::new(0.003, drop)));
        let mut hang = |commands: &mut Commands, end: Vec3| {
            let at = Vec3::new(0.0, middle, 0.0) + end - drop * Vec3::Y;
            let rigid = commands
                .spawn((
                    (RigidBody::Dynamic, Collider::sphere(radius), ColliderDensity(400.0)),
                    (Mesh3d(ball.clone()), MeshMaterial3d(slate.clone())),
                    Transform::from_translation(at),
                ))
                .with_child((
                    (Mesh3d(cord.clone()), MeshMaterial3d(slate.clone())),
                    Transform::from_xyz(0.0, 0.5 * drop, 0.0),
                ))
                .id();
            commands.spawn(Attachment::new(jack, end, rigid, drop * Vec3::Y));
            rigids.push(rigid);
            rigid
        };
        hang(&mut commands, ARM * Vec3::X);
        hang(&mut commands, -ARM * Vec3::X);
        // The next jack hangs from a ball below this one.
        above = hang(&mut commands, -END * Vec3::Y);
        if level < 2 {
            let below = Transform::from_xyz(0.0, -0.5 * drop, 0.0);
            commands.entity(above).with_child((Mesh3d(cord), MeshMaterial3d(slate.clone()), below));
        }
        point = -drop * Vec3::Y;
        height = middle - END - 2.0 * drop;
    }
    for (held, jack, rigid) in holds {
        let (jacks, rigids) = (jacks[jack..].to_vec(), rigids[rigid..].to_vec());
        commands.entity(held).insert(Holds { jacks, rigids });
    }
}

fn write(
    mut readout: ResMut<Readout>,
    holds: Query<(&Holds, &AttachmentForce)>,
    bodies: Query<&BodyState>,
    masses: Query<&ComputedMass>,
) {
    readout.0 = "the attachment of a jack holds\n".into();
    let mut holding = 0;
    for (below, force) in &holds {
        let soft = below.jacks.iter().filter_map(|jack| bodies.get(*jack).ok());
        let rigid = below.rigids.iter().filter_map(|rigid| masses.get(*rigid).ok());
        let mass = soft.map(|state| state.model().mass()).sum::<f64>()
            + rigid.map(|mass| f64::from(mass.value())).sum::<f64>();
        readout.0 += &format!("{:6.3} N of {:6.3} N below it\n", force.0.y, GRAVITY * mass);
        holding += usize::from((force.0.y / (GRAVITY * mass) - 1.0).abs() < 0.2);
    }
    readout.0 += &format!("within a fifth: {holding} of {}", holds.iter().len());
}
