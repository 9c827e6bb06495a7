//! Hosts a session and plays in it.
//!
//! The host prints an invite for `join`. The host and the guests pull the body with the mouse.
//!
//! What to learn here: the component [`SharedBody`] shares a body with the session. The grabs of
//! the host are ordinary grabs. Guests are entities.
//!
//! ```sh
//! cargo run --release --example host
//! cargo run --release --example host -- --bind 0.0.0.0:4433 --key host.key --tokens   # N in the window: another network
//! ```

#[path = "../session/mod.rs"]
mod session;
#[path = "../stage/mod.rs"]
mod stage;

use std::error::Error;

use bevy::prelude::*;
use clap::Parser;
use pliant::net::transport::Limits;
use pliant::net::{HandOf, NetStats, SharedBody, User, UserLink, Yourself};
use pliant::prelude::*;
use pliant::stream::emulator::Preset;

/// Hosts a session and plays in it.
#[derive(Parser, Debug)]
struct Options {
    #[command(flatten)]
    stage: stage::Options,

    #[command(flatten)]
    serve: session::serve::Serve,
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::parse();
    let stage = stage::Stage::with("host", options.stage)
        .real_time()
        .key("left mouse: pull the body")
        .key("N: another network");
    session::end_on_terminate();
    // A hundred bots of `join` connect from one machine.
    let limits = Limits { per_address: 256, ..Limits::host() };
    let net = options.serve.open("host", limits)?;
    App::new()
        .add_plugins(stage)
        .add_plugins((PliantPlugins::default(), net))
        .insert_resource(Time::<Fixed>::from_hz(40.0))
        .insert_resource(Network(options.serve.network))
        .add_systems(Startup, setup)
        .add_systems(FixedUpdate, session::play.before(PliantSystems::Input))
        .add_systems(Update, (change_network, draw_hands, read_out))
        .run();
    Ok(())
}

fn setup(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut materials: ResMut<Assets<StandardMaterial>>,
    unattended: Option<Res<stage::Unattended>>,
) {
    let mut body = commands.spawn((
        ModalBody::new(assets.load("pip.modal")),
        SharedBody::named(session::BODY),
        MeshMaterial3d(materials.add(Color::srgb(0.95, 0.50, 0.36))),
    ));
    if unattended.is_some() {
        body.insert(session::Script::of(0));
    }
}

#[derive(Resource)]
struct Network(Option<Preset>);

/// Changes the emulated network of the running session when N is pressed.
fn change_network(
    keys: Option<Res<ButtonInput<KeyCode>>>,
    mut network: ResMut<Network>,
    host: Option<Res<pliant::net::NetHost>>,
) {
    let (Some(keys), Some(host)) = (keys, host) else { return };
    if keys.just_pressed(KeyCode::KeyN) {
        let all = Preset::ALL;
        let next = network.0.map_or(0, |now| all.iter().position(|one| *one == now).map_or(0, |at| at + 1));
        network.0 = all.get(next).copied();
        host.set_emulation(session::emulation(network.0, 1));
    }
}

/// Draws the hands of the guests, each in the color of its user.
fn draw_hands(hands: Query<(&Grab, &GrabForce, &HandOf)>, users: Query<&User>, mut gizmos: Gizmos) {
    for (grab, felt, of) in &hands {
        let Ok(user) = users.get(of.0) else { continue };
        stage::draw_hand(&mut gizmos, grab.target, Some(felt.point), -felt.force, user.color);
    }
}

fn read_out(
    stats: Res<NetStats>,
    network: Res<Network>,
    users: Query<(&User, Option<&UserLink>), Without<Yourself>>,
    mut readout: ResMut<stage::Readout>,
) {
    let mut lines = vec![format!(
        "network {}, {:.0} kbit/s out",
        network.0.map_or("as it is", Preset::name),
        stats.bytes_out_per_s * 8e-3
    )];
    lines.extend(users.iter().map(|(user, link)| {
        let link = link.copied().unwrap_or_default();
        format!(
            "{:12} {:6.1} ms {:5.1} % lost",
            user.name,
            link.round_trip.as_secs_f64() * 1e3,
            link.loss_out.max(link.loss_in) * 100.0
        )
    }));
    let text = lines.join("\n");
    if readout.0 != text {
        readout.0 = text;
    }
}
