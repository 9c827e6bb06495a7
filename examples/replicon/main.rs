//! A session on the channels of bevy_replicon, over renet: two apps on loopback, and a relay
//! between them that loses packets.
//!
//! What to learn here:
//!
//! - A game's netcode carries the session: there is no second connection, and no second port.
//! - `ride.rs` is all that it takes: four messages of replicon, and the systems that bring them to
//!   the app's `CarrierPort`. It knows nothing of renet, so that any backend will do.
//! - Host and guest are begun over the port's carriers by commands, any number of times.
//!
//! ```sh
//! cargo run --release -p pliant_examples --no-default-features --features replicon --example replicon
//! ```

mod pair;
mod ride;

use std::error::Error;
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use bevy::math::DVec3;
use bevy::prelude::*;
use clap::Parser;
use pliant::modal::ModalModel;
use pliant::net::transport::Limits;
use pliant::net::{CarrierPort, HostConfig, JoinConfig, NetStats, RemoteBody, SharedBody};
use pliant::prelude::*;
use pliant::stream::emulator::{LinkConfig, Loss};

/// Two apps hold one body over bevy_replicon.
#[derive(Parser, Debug)]
struct Options {
    /// Share of the packets that are lost in each direction, 0 to 1.
    #[arg(long, default_value_t = 0.09)]
    loss: f64,

    /// Time that a packet takes, ms.
    #[arg(long, default_value_t = 98)]
    delay: u64,

    /// End after this many seconds.
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
}

fn main() -> ExitCode {
    match run(&Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("replicon: {error}");
            ExitCode::from(2)
        }
    }
}

fn run(options: &Options) -> Result<(), Box<dyn Error>> {
    let loss = Loss::Random(options.loss);
    let link = LinkConfig { loss, delay: Duration::from_millis(options.delay), ..LinkConfig::default() };
    let mut pair = pair::Pair::new(&link)?;

    // The server hosts a body, and the client joins as soon as replicon has connected.
    let model = ModalModel::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/pip.modal"))?;
    let world = pair.server.world_mut();
    let body = world.resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model));
    world.spawn((ModalBody::new(body), SharedBody::named("pip")));
    let carrier = world.resource::<CarrierPort>().host(Limits::host());
    world.commands().host_session_over(carrier, HostConfig::default());
    let world = pair.client.world_mut();
    let carrier = world.resource::<CarrierPort>().join(ride::SERVER, Limits::guest());
    world.commands().join_session_over(carrier, JoinConfig::default());
    pair.client.add_systems(Update, hold);

    let (began, mut printed) = (Instant::now(), 0);
    while began.elapsed().as_secs_f64() < options.seconds {
        pair.update();
        std::thread::sleep(Duration::from_millis(4));
        if began.elapsed().as_secs() > printed {
            printed = began.elapsed().as_secs();
            print_forces(&mut pair, printed);
        }
    }
    Ok(())
}

/// Takes hold of the body when it has arrived, and moves the hand in a circle.
fn hold(
    bodies: Query<(Entity, &BodyState), With<RemoteBody>>,
    mut hands: Query<&mut Grab>,
    time: Res<Time>,
    mut commands: Commands,
) {
    let Ok((body, state)) = bodies.single() else { return };
    let positions = state.model().surface().positions();
    let highest = (0..positions.len()).max_by(|&a, &b| positions[a][1].total_cmp(&positions[b][1]));
    let Some(vertex) = highest else { return };
    let (at_rest, turn) = (DVec3::from_array(positions[vertex].map(f64::from)), time.elapsed_secs_f64());
    let target = at_rest + 0.1 * DVec3::new(turn.cos(), 0.0, turn.sin());
    match hands.single_mut() {
        Ok(mut hand) => hand.target = target,
        Err(_) => _ = commands.spawn((Grab::new(vertex as u32, 0.1, target), GrabOf(body))),
    }
}

fn print_forces(pair: &mut pair::Pair, second: u64) {
    let forces = [&mut pair.server, &mut pair.client].map(|app| {
        let mut forces = app.world_mut().query::<&GrabForce>();
        forces.iter(app.world()).next().map_or(0.0, |force| force.force.length())
    });
    let stats = *pair.client.world().resource::<NetStats>();
    let [lost, sent] = pair.relay.lost();
    println!(
        "{second:3} s: the guest feels {:.2} N, {:.2} N at the host; {lost} of {sent} packets lost, \
         {:.1} % of the session's datagrams",
        forces[1],
        forces[0],
        100.0 * stats.loss_in
    );
}
