//! Equal peers: every process steps the body, and only the hands are sent.
//!
//! Start this example three times, the second and the third time with the invite that any running
//! peer has printed. There is no host: when a peer leaves, the others play on.
//!
//! ```sh
//! cargo run --release --example peers
//! cargo run --release --example peers -- "pliant://127.0.0.1:50000#…" --network paper-2
//! ```

#[path = "../session/mod.rs"]
mod session;
#[path = "../stage/mod.rs"]
mod stage;

use std::error::Error;
use std::net::SocketAddr;

use bevy::prelude::*;
use clap::Parser;
use pliant::net::{
    HostOptions, Invite, NetPlugin, PeerConfig, RemoteHands, SharedBody, User, UserLink, Yourself, color_of,
};
use pliant::prelude::*;
use pliant::stream::emulator::Preset;

/// Plays among equal peers.
#[derive(Parser, Debug)]
struct Options {
    #[command(flatten)]
    stage: stage::Options,

    /// The invite of a running peer; the first peer has none.
    invite: Option<Invite>,

    /// Your name in the session.
    #[arg(long, default_value = "peer")]
    name: String,

    /// Address to listen on.
    #[arg(long, default_value = "127.0.0.1:0")]
    bind: SocketAddr,

    /// An emulated network under all connections of this peer: none, paper-1 to paper-4, lan, wifi
    /// and others.
    #[arg(long, default_value = "none", value_parser = session::network)]
    network: std::option::Option<Preset>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::parse();
    let stage = stage::Stage::with("peers", options.stage).real_time().key("left mouse: pull the body");
    session::end_on_terminate();
    let number = options.name.bytes().map(u64::from).sum::<u64>();
    let joins = options.invite.is_some();
    let net = NetPlugin::peer(PeerConfig {
        name: options.name,
        join: options.invite,
        transport: HostOptions {
            bind: options.bind,
            emulation: session::emulation(options.network, number),
            ..default()
        },
        ..default()
    })?;
    println!("{}", net.invite().ok_or("no invite")?);
    let mut app = App::new();
    if joins {
        app.world_mut().spawn(stage::Awaited);
    }
    app.add_plugins(stage)
        .add_plugins((PliantPlugins::default(), net))
        .insert_resource(Time::<Fixed>::from_hz(40.0))
        .insert_resource(Number(number))
        .add_systems(Startup, setup)
        .add_systems(FixedUpdate, session::play.before(PliantSystems::Input))
        .add_systems(Update, (draw_hands, read_out, meet))
        .run();
    Ok(())
}

#[derive(Resource)]
struct Number(u64);

fn setup(
    mut commands: Commands,
    assets: Res<AssetServer>,
    mut materials: ResMut<Assets<StandardMaterial>>,
    unattended: Option<Res<stage::Unattended>>,
    number: Res<Number>,
) {
    let mut body = commands.spawn((
        ModalBody::new(assets.load("pip.modal")),
        SharedBody::named(session::BODY),
        MeshMaterial3d(materials.add(Color::srgb(0.95, 0.50, 0.36))),
    ));
    if unattended.is_some() {
        body.insert(session::Script::of(number.0));
    }
}

/// Starts the run once another peer has joined and the session has reached its first tick.
fn meet(
    mut commands: Commands,
    net: Option<Res<pliant::net::NetPeer>>,
    awaited: Query<Entity, With<stage::Awaited>>,
    others: Query<(), (With<UserLink>, Without<Yourself>)>,
) {
    let steps = net.is_some_and(|net| net.session().is_some_and(|session| session.tick() > 0));
    if steps && !others.is_empty() {
        awaited.iter().for_each(|entity| commands.entity(entity).despawn());
    }
}

fn draw_hands(bodies: Query<&RemoteHands>, mut gizmos: Gizmos) {
    for hand in bodies.iter().flat_map(|seen| &seen.0) {
        stage::draw_hand(&mut gizmos, hand.target, None, -hand.reaction, color_of(hand.user));
    }
}

fn read_out(
    net: Option<Res<pliant::net::NetPeer>>,
    users: Query<(&User, &UserLink), Without<Yourself>>,
    mut readout: ResMut<stage::Readout>,
) {
    let Some(net) = net else { return };
    let mut lines: Vec<String> = users
        .iter()
        .map(|(user, link)| format!("{:12} {:6.1} ms", user.name, link.round_trip.as_secs_f64() * 1e3))
        .collect();
    if let Some(session) = net.session() {
        let behind = session.tick().saturating_sub(session.confirmed());
        lines.push(format!("tick {}, {behind} of them still to be confirmed", session.tick()));
    }
    let text = lines.join("\n");
    if readout.0 != text {
        readout.0 = text;
    }
}
