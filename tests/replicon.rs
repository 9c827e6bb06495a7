//! Tests a session on the channels of bevy_replicon, over renet and loopback, at 9 % loss.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs, reason = "a failed test should panic")]

#[path = "../examples/replicon/pair.rs"]
mod pair;
#[path = "../examples/replicon/ride.rs"]
mod ride;

use std::{
    path::Path,
    time::{Duration, Instant},
};

use bevy::{math::DVec3, prelude::*};
use bevy_replicon::prelude::ClientState;
use pair::Pair;
use pliant::{
    modal::ModalModel,
    net::{
        CarrierPort, DisconnectReason, HandOf, HostConfig, JoinConfig, NetStats, RemoteBody, SessionClosed,
        SessionState, SharedBody, User, UserLeft, transport::Limits,
    },
    prelude::*,
    stream::emulator::{LinkConfig, Loss},
};

/// Longest time to wait for what must happen.
const PATIENCE: Duration = Duration::from_secs(300);

impl Pair {
    fn run_until<T>(&mut self, awaited: &str, mut look: impl FnMut(&mut App, &mut App) -> Option<T>) -> T {
        let begin = Instant::now();
        loop {
            self.update();
            if let Some(found) = look(&mut self.server, &mut self.client) {
                return found;
            }
            assert!(begin.elapsed() < PATIENCE, "not within {PATIENCE:?}: {awaited}");
            std::thread::sleep(Duration::from_millis(4));
        }
    }

    fn host(&mut self) {
        let carrier = self.server.world().resource::<CarrierPort>().host(Limits::host());
        self.server.world_mut().commands().host_session_over(carrier, HostConfig::default());
    }

    fn join(&mut self) {
        let carrier = self.client.world().resource::<CarrierPort>().join(ride::SERVER, Limits::guest());
        self.client.world_mut().commands().join_session_over(carrier, JoinConfig::default());
    }
}

fn state(app: &App) -> SessionState {
    *app.world().resource::<SessionState>()
}

fn body_of(app: &mut App) -> Option<Entity> {
    let mut bodies = app.world_mut().query_filtered::<Entity, (With<RemoteBody>, With<BodyState>)>();
    bodies.iter(app.world()).next()
}

fn users(app: &mut App) -> usize {
    app.world_mut().query::<&User>().iter(app.world()).count()
}

/// The reasons for which sessions have ended and users have left.
#[derive(Resource, Default)]
struct Ends(Vec<DisconnectReason>);

#[test]
fn two_apps_of_replicon_hold_a_body_at_9_percent_loss() {
    let loss = Loss::Random(0.09);
    let link = LinkConfig { loss, delay: Duration::from_millis(98), ..LinkConfig::default() };
    let mut pair = Pair::new(&link).unwrap();
    let keep_users = |mut left: MessageReader<UserLeft>, mut ends: ResMut<Ends>| {
        ends.0.extend(left.read().map(|left| left.reason));
    };
    pair.server.init_resource::<Ends>().add_systems(Update, keep_users);
    let keep_ends = |closed: On<SessionClosed>, mut ends: ResMut<Ends>| ends.0.push(closed.reason);
    pair.client.init_resource::<Ends>().add_observer(keep_ends);
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/pip.modal");
    let model = ModalModel::read(path).unwrap();
    let positions = model.surface().positions().to_vec();
    let world = pair.server.world_mut();
    let body = world.resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model));
    world.spawn((ModalBody::new(body), SharedBody::named("pip")));

    pair.run_until("replicon connects", |_, client| {
        (*client.world().resource::<State<ClientState>>() == ClientState::Connected).then_some(())
    });
    pair.host();
    pair.join();
    let begin = Instant::now();
    let there = pair.run_until("the body arrives, with its model", |_, client| body_of(client));
    println!("the body has arrived after {:.1} s", begin.elapsed().as_secs_f64());

    let highest = (0..positions.len()).max_by(|&a, &b| positions[a][1].total_cmp(&positions[b][1])).unwrap();
    let at_rest = DVec3::from_array(positions[highest].map(f64::from));
    let grab = Grab::new(highest as u32, 0.1, at_rest + DVec3::new(0.1, 0.0, 0.05));
    let grab = pair.client.world_mut().spawn((grab, GrabOf(there))).id();
    let force = pair.run_until("the guest feels what the host computes", |server, client| {
        let mut felt = server.world_mut().query::<(&HandOf, &GrabForce)>();
        let felt = felt.single(server.world()).ok()?.1.force;
        let own = client.world().get::<GrabForce>(grab)?.force;
        (felt.length() > 0.1 && own.distance(felt) < 0.02 * felt.length()).then_some(felt.length())
    });
    let begin = Instant::now();
    pair.run_until("ten seconds", |_, _| (begin.elapsed() > Duration::from_secs(10)).then_some(()));
    let stats = *pair.client.world().resource::<NetStats>();
    let [lost, sent] = pair.relay.lost();
    println!(
        "{force:.2} N; {lost} of {sent} packets lost; {:.1} % of the datagrams, round trip {:?}",
        100.0 * stats.loss_in,
        stats.round_trip
    );
    // Four standard deviations of a share of 9 % in 1,000 are 3.6 %.
    assert!(sent > 1000 && (lost as f64 / sent as f64 - 0.09).abs() < 0.036, "{lost} of {sent}");
    assert!((0.03..0.2).contains(&stats.loss_in) && stats.rejected == 0, "{stats:?}");

    // The guest leaves and comes back, and stays in the game.
    pair.client.world_mut().commands().leave_session();
    pair.run_until("the guest has left", |server, _| (users(server) == 1).then_some(()));
    assert_eq!(pair.server.world().resource::<Ends>().0, [DisconnectReason::Left]);
    pair.join();
    pair.run_until("it is back", |_, client| body_of(client));

    // The host ends the session and hosts the next one in the same frame.
    pair.server.world_mut().commands().leave_session();
    pair.host();
    pair.run_until("the guest knows that it is over", |server, client| {
        (state(server) == SessionState::Hosting && state(client) == SessionState::Idle).then_some(())
    });
    assert_eq!(pair.client.world().resource::<Ends>().0, [DisconnectReason::Left; 2]);
    pair.join();
    pair.run_until("it is in the next one", |_, client| body_of(client));
    let connected = pair.client.world().resource::<State<ClientState>>();
    assert_eq!(*connected, ClientState::Connected, "replicon has never noticed");
}
