//! Ten soft jacks and eight crates fall at a host, and every guest sees the same pile.
//!
//! What to learn here: [`SharedBody`] shares a soft body and [`SharedRigid`] a rigid one, whatever
//! moves it. A guest has no physics engine: its crates follow the host's. Everybody may pull at the
//! jacks, and so move the crates.
//!
//! ```sh
//! cargo run --release --example shared_pile                          # prints an invite
//! cargo run --release --example shared_pile -- --join "pliant://…"   # elsewhere
//! cargo run --release --example shared_pile -- --network paper-1     # a network that loses 9 %
//! ```

#[path = "session/mod.rs"]
mod session;
mod stage;

use std::error::Error;

use avian3d::prelude::{Collider, ColliderDensity, PhysicsPlugins, RigidBody};
use bevy::{color::Mix, prelude::*};
use clap::Parser;
use pliant::net::transport::Limits;
use pliant::net::{
    BodyArrived, Invite, JoinConfig, NetGuest, NetHost, NetPlugin, NetStats, RemoteBody, RemoteHands,
    RemoteRigid, RigidArrived, SharedBody, SharedRigid, color_of,
};
use pliant::prelude::*;
use stage::{Look, Readout, Stage};

const JACKS: usize = 10;
const CRATES: usize = 8;
/// Length of a crate's edges, m.
const EDGE: f32 = 0.3;

/// Hosts a pile, or joins one.
#[derive(Parser, Debug)]
struct Options {
    #[command(flatten)]
    stage: stage::Options,

    /// The invite that a host has printed. Without it this app is a host.
    #[arg(long)]
    join: Option<Invite>,

    #[command(flatten)]
    serve: session::serve::Serve,
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::parse();
    let stage = Stage::with("shared_pile", options.stage)
        .real_time()
        .key("left mouse: pull a jack")
        .look(Look { middle: Vec3::new(0.0, 0.3, 0.0), distance: 3.4, yaw: 0.4, pitch: 0.35 })
        .picture_at(12.0);
    session::end_on_terminate();
    let mut app = App::new();
    app.add_plugins(stage).insert_resource(BodyGravity::EARTH).add_systems(Update, write);
    match &options.join {
        None => {
            let net = options.serve.open("host", Limits::host())?;
            app.add_plugins((PliantPlugins::default(), PhysicsPlugins::default(), net));
            app.add_systems(Startup, drop_all);
        }
        Some(invite) => {
            let net = NetPlugin::join(invite, JoinConfig::default())?;
            app.add_plugins((PliantPlugins::default(), net));
            app.add_observer(paint_jack).add_observer(paint_crate).add_systems(Update, draw_hands);
        }
    }
    session::ended(&app.run())
}

/// The host's scene. The stage draws the floor.
fn drop_all(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    commands.spawn((RigidBody::Static, Collider::half_space(Vec3::Y), Transform::default()));
    for index in 0..CRATES {
        let at = Vec3::new((index % 4) as f32 * 0.45 - 0.675, 0.151, (index / 4) as f32 * 0.5 - 0.25);
        commands.spawn((
            SharedRigid::named(format!("crate {index}")),
            RigidBody::Dynamic,
            (Collider::cuboid(EDGE, EDGE, EDGE), ColliderDensity(60.0)),
            crate_look(&mut meshes, &mut materials),
            Transform::from_translation(at),
        ));
    }
    for index in 0..JACKS {
        let (layer, place) = (index / 5, index % 5);
        let at = Vec3::new(place as f32 * 0.36 - 0.72, 0.8 + 0.5 * layer as f32, 0.1 * layer as f32);
        let turned = Quat::from_euler(EulerRot::YXZ, 0.9 * index as f32, 0.4 * index as f32, 0.2);
        commands.spawn((
            SharedBody::named(format!("jack {index}")),
            ModalBody::new(assets.load("jack.modal")),
            TouchBodies,
            MeshMaterial3d(materials.add(jack_color(index))),
            Transform::from_translation(at).with_rotation(turned),
        ));
    }
}

fn crate_look(
    meshes: &mut Assets<Mesh>,
    materials: &mut Assets<StandardMaterial>,
) -> (Mesh3d, MeshMaterial3d<StandardMaterial>) {
    (
        Mesh3d(meshes.add(Cuboid::from_length(EDGE))),
        MeshMaterial3d(materials.add(Color::srgb(0.62, 0.47, 0.33))),
    )
}

fn jack_color(index: usize) -> StandardMaterial {
    let (warm, cool) = (Color::srgb(0.95, 0.50, 0.36), Color::srgb(0.42, 0.66, 0.58));
    let color = warm.mix(&cool, index as f32 / JACKS as f32);
    StandardMaterial { perceptual_roughness: 0.45, ..color.into() }
}

/// The number at the end of a name.
fn number(name: &str) -> usize {
    name.rsplit(' ').next().and_then(|number| number.parse().ok()).unwrap_or(0)
}

/// A jack has arrived at a guest, with its mesh.
fn paint_jack(
    jack: On<BodyArrived>,
    mut commands: Commands,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    let color = materials.add(jack_color(number(&jack.name)));
    commands.entity(jack.entity).insert(MeshMaterial3d(color));
}

/// A crate has arrived at a guest. What it looks like is up to the game.
fn paint_crate(
    arrived: On<RigidArrived>,
    mut commands: Commands,
    mut meshes: ResMut<Assets<Mesh>>,
    mut materials: ResMut<Assets<StandardMaterial>>,
) {
    commands.entity(arrived.entity).insert(crate_look(&mut meshes, &mut materials));
}

/// Draws the hands of the others, each in the color of its user.
fn draw_hands(bodies: Query<&RemoteHands>, mut gizmos: Gizmos) {
    for hand in bodies.iter().flat_map(|seen| &seen.0) {
        stage::draw_hand(&mut gizmos, hand.target, None, -hand.reaction, color_of(hand.user));
    }
}

fn write(
    mut readout: ResMut<Readout>,
    host: Option<Res<NetHost>>,
    guest: Option<Res<NetGuest>>,
    stats: Res<NetStats>,
    states: Query<&BodyState>,
    jacks: Query<&RemoteBody>,
    crates: Query<&RemoteRigid>,
) {
    if let Some(host) = host {
        let still = states.iter().filter(|state| state.is_resting()).count();
        let resting = host.session().rigids().filter(|(_, resting)| *resting).count();
        readout.0 = format!(
            "guests  {:6}\nsent    {:6.0} kbit/s\nat rest {still:2} of {JACKS} jacks, {resting} of {CRATES} crates",
            stats.peers,
            stats.bytes_out_per_s * 8e-3,
        );
    } else if let Some(session) = guest.as_ref().and_then(|guest| guest.session()) {
        let still = session.bodies().filter(|body| body.is_resting()).count();
        let resting = session.rigids().filter(|rigid| rigid.is_resting()).count();
        readout.0 = format!(
            "round trip {:4.0} ms, {:.0} % lost\nreceived {:6.0} kbit/s\nat rest {still:2} of {} jacks, {resting} of {} crates",
            stats.round_trip.as_secs_f64() * 1e3,
            stats.loss_in * 100.0,
            stats.bytes_in_per_s * 8e-3,
            jacks.iter().len(),
            crates.iter().len(),
        );
    }
}
