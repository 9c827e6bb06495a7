//! A floppy bar under its own weight and a creature that is pulled by an ear: with linear
//! elasticity on the left, and with reduced elasticity on the right.
//!
//! What to learn here: a model that was baked with a material has both ([`Elasticity`]), and a
//! field of the body's settings chooses. Linear elasticity costs less, and is meant for crowds and
//! for small deformations. Bent far, a linear bar becomes longer and bends the wrong way, and a
//! hand that leads an ear away feels another force. [`Elasticity::Reduced`] is the default.
//!
//! ```sh
//! cargo run --release --example elasticity
//! ```

mod stage;

use std::{error::Error, sync::Arc};

use bevy::{math::DVec3, prelude::*};
use clap::Parser;
use pliant::{
    bake::BakeConfig,
    body::{BakePlugin, BakeProgress, BakeRequest, Elasticity},
    mesh::{TetMesh, shapes},
    modal::Damping,
    prelude::*,
};
use stage::{Look, Readout, Stage};

/// Length and thickness of the bar, m.
const BAR: [f64; 2] = [0.3, 0.03];

/// Where the walls stand, and how high the bars are fixed in them, m.
const WALL: f32 = 0.72;
const HEIGHT: f32 = 0.36;

/// Way of a pulled ear, m, and the time that it takes, s.
const WAY: DVec3 = DVec3::new(0.12, 0.10, 0.0);
const SLOWLY: f64 = 1.0;

/// A floppy bar and a pulled ear, with linear and with reduced elasticity.
#[derive(Parser)]
struct Options {
    /// Tetrahedra of the creature.
    #[arg(long, default_value_t = 6_000)]
    tets: usize,
    #[command(flatten)]
    stage: stage::Options,
}

fn main() -> AppExit {
    match run(Options::parse()) {
        Ok(exit) => exit,
        Err(error) => {
            eprintln!("elasticity: {error}");
            AppExit::from_code(2)
        }
    }
}

fn run(options: Options) -> Result<AppExit, Box<dyn Error>> {
    let [length, side] = BAR;
    let bar = Arc::new(shapes::bar([24, 2, 2], [length, side, side])?);
    let exit = App::new()
        .add_plugins(
            Stage::with("elasticity", options.stage)
                .key("left mouse: pull a body")
                .look(Look { middle: Vec3::new(0.0, 0.2, 0.0), distance: 1.25, yaw: 0.0, pitch: 0.12 })
                .picture_at(6.0),
        )
        .add_plugins((PliantPlugins::default(), BakePlugin::default()))
        .insert_resource(BodyGravity::EARTH)
        .insert_resource(Shapes { bar, tets: options.tets })
        .add_systems(Startup, spawn)
        .add_systems(FixedUpdate, (take_hold, pull).chain().before(PliantSystems::Input))
        .add_systems(Update, write)
        .run();
    Ok(exit)
}

#[derive(Resource)]
struct Shapes {
    bar: Arc<TetMesh>,
    tets: usize,
}

/// What is measured of a body.
#[derive(Component, Clone, Copy, PartialEq)]
enum Kind {
    Bar,
    Creature,
}

fn spawn(
    mut commands: Commands,
    shapes: Res<Shapes>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    let wall = meshes.add(Cuboid::new(0.02, 0.5, 0.14));
    let stone = materials.add(Color::srgb(0.55, 0.56, 0.58));
    let bar = BakeConfig {
        name: "bar".into(),
        young: 1e5,
        poisson: 0.4,
        damping: Damping::Ratio(0.2),
        anchors: "x<0.001".parse().into_iter().collect(),
        ..default()
    };
    let creature = BakeConfig {
        name: "creature".into(),
        young: 4e4,
        poisson: 0.45,
        density: 150.0,
        damping: Damping::Ratio(0.1),
        anchors: "y<0.02".parse().into_iter().collect(),
        ..default()
    };
    for (elasticity, side, color) in [
        (Elasticity::Linear, -1.0, Color::srgb(0.62, 0.64, 0.70)),
        (Elasticity::Reduced, 1.0, Color::srgb(0.95, 0.50, 0.36)),
    ] {
        let material =
            materials.add(StandardMaterial { base_color: color, perceptual_roughness: 0.45, ..default() });
        let body = |what: &str| {
            let mut body = ModalBody::default();
            body.settings.elasticity = elasticity;
            (Name::new(format!("{what}, {elasticity}")), body, MeshMaterial3d(material.clone()))
        };
        commands.spawn((
            Mesh3d(wall.clone()),
            MeshMaterial3d(stone.clone()),
            Transform::from_xyz(side * (WALL + 0.01), 0.25, 0.0),
        ));
        // The bar of the right side leaves its wall to the left.
        let turned = if side > 0.0 { Quat::from_rotation_y(std::f32::consts::PI) } else { Quat::IDENTITY };
        let middle = turned * Vec3::new(0.0, 0.0, -0.5 * BAR[1] as f32);
        commands.spawn((
            Kind::Bar,
            body("bar"),
            BakeRequest { config: bar.clone(), ..BakeRequest::new(TetMesh::clone(&shapes.bar).into()) },
            Transform::from_translation(Vec3::new(side * WALL, HEIGHT, 0.0) + middle).with_rotation(turned),
        ));
        commands.spawn((
            Kind::Creature,
            body("ear"),
            BakeRequest {
                tets: shapes.tets,
                config: creature.clone(),
                ..BakeRequest::file(format!("{}/pip.ron", stage::ASSETS))
            },
            Transform::from_xyz(side * 0.22, 0.0, 0.0),
        ));
    }
}

/// A scripted hand: where it took hold and when, s.
#[derive(Component)]
struct Hand(DVec3, f64);

/// Takes hold of the creature's ear on the right.
fn take_hold(
    mut commands: Commands,
    time: Res<Time>,
    bodies: Query<(Entity, &Kind, &BodyState, &GlobalTransform), Added<BodyState>>,
) {
    for (body, _, state, place) in bodies.iter().filter(|(_, kind, ..)| **kind == Kind::Creature) {
        let positions = state.model().surface().positions();
        let end = (0..positions.len()).max_by(|&a, &b| positions[a][0].total_cmp(&positions[b][0]));
        let Some((end, rest)) = end.and_then(|end| Some((end, positions.get(end)?))) else { continue };
        let at = place.transform_point(Vec3::from(*rest)).as_dvec3();
        let hand = Hand(at, time.elapsed_secs_f64());
        commands.spawn((Grab::new(end as u32, 0.02, at), GrabOf(body), hand));
    }
}

/// Leads the ears away and holds them there.
fn pull(time: Res<Time>, mut hands: Query<(&Hand, &mut Grab)>) {
    for (Hand(at, since), mut grab) in &mut hands {
        let share = ((time.elapsed_secs_f64() - since) / SLOWLY).clamp(0.0, 1.0);
        grab.target = at + share * WAY;
    }
}

/// Mean length of the four edges of the bar, m, which is that of its middle.
fn length(rest: &[[f32; 3]], now: &[[f32; 3]]) -> f64 {
    let side = BAR[1] as f32;
    let edge = |y: f32, z: f32| {
        let on = |v: &usize| (rest[*v][1] - y).abs() < 1e-4 && (rest[*v][2] - z).abs() < 1e-4;
        let mut edge: Vec<usize> = (0..rest.len()).filter(on).collect();
        edge.sort_by(|&a, &b| rest[a][0].total_cmp(&rest[b][0]));
        let parts = edge.windows(2).map(|ends| Vec3::from(now[ends[0]]).distance(Vec3::from(now[ends[1]])));
        parts.map(f64::from).sum::<f64>()
    };
    0.25 * [(0.0, 0.0), (side, 0.0), (0.0, side), (side, side)].map(|(y, z)| edge(y, z)).iter().sum::<f64>()
}

fn write(
    bodies: Query<(&Name, &Kind, &BodyState, &VisualState, Option<&Grabs>)>,
    bakes: Query<(&Name, &BakeProgress), Without<BodyState>>,
    forces: Query<&GrabForce>,
    mut readout: ResMut<Readout>,
) {
    let mut text = String::new();
    for (name, kind, state, shown, grabs) in bodies.iter().sort::<&Name>() {
        let rest = state.model().surface().positions();
        text += &match kind {
            Kind::Bar => {
                let longer = length(rest, &state.positions(shown)) / length(rest, rest);
                format!("{name:12}  {longer:5.3} of its length\n")
            }
            Kind::Creature => {
                let hands = grabs.into_iter().flat_map(|grabs| grabs.entities());
                let held: f64 = forces.iter_many(hands).map(|felt| felt.force.length()).sum();
                format!("{name:12}  {held:5.2} N in the hand\n")
            }
        };
    }
    for (name, progress) in bakes.iter().sort::<&Name>() {
        if let BakeProgress::Running { stage, share } = progress {
            text += &format!("{name}: {stage:?} {:3.0} %\n", 100.0 * share);
        }
    }
    readout.0 = text;
}
