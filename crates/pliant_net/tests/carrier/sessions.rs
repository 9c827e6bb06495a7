//! Whole sessions ride on another netcode.

use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_body::{Grab, GrabForce, GrabOf, ModalAsset, ModalBody};
use pliant_net::transport::{CarrierPort, Limits, RemotePath};
use pliant_net::{
    DisconnectReason, HandOf, HostConfig, JoinConfig, NetGuest, NetHost, NetPlugin, NetStats, PeerConfig,
    Role, SessionClosed, SessionCommands, SessionState, SharedBody, User, UserLeft,
};

use super::network::{CLIENT, Network, Party, ROOM, SERVER, name};
use super::support::{self, TIP, alone, app, bar, body_of, messages, must, only};

pub(super) fn state(app: &App) -> SessionState {
    *app.world().resource::<SessionState>()
}

#[test]
fn a_session_rides_on_another_netcode_at_9_percent_loss() {
    let _alone = alone();
    let (mut ann, mut bob) = (app(NetPlugin::default()), app(NetPlugin::default()));
    let mut network = Network::new();
    let (server, client) = (network.server.clone(), network.client.clone());
    let handle = ann.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
    ann.world_mut().spawn((ModalBody::new(handle), SharedBody::named("bar")));

    // Joined before anybody hosts: the guest tries until somebody does.
    bob.world_mut().commands().join_session_over(client.join(SERVER, Limits::guest()), JoinConfig::default());
    network.run_until(&mut [&mut ann, &mut bob], "nobody hosts", |apps| {
        let guest = apps[1].world().get_resource::<NetGuest>()?;
        let reason = DisconnectReason::Silent;
        (*guest.state() == pliant_net::GuestState::Lost { reason }).then_some(())
    });
    ann.world_mut().commands().host_session_over(server.host(Limits::host()), HostConfig::default());
    // The model has to cross, too.
    let there = network.run_until(&mut [&mut ann, &mut bob], "the body arrives", |apps| body_of(apps[1]));
    assert_eq!((state(&ann), state(&bob)), (SessionState::Hosting, SessionState::Joined));
    assert!(ann.world().resource::<NetHost>().invite().is_none());

    let target = DVec3::new(1.0, 0.3, 0.2);
    let grab = bob.world_mut().spawn((Grab::new(TIP, 0.3, target), GrabOf(there))).id();
    let force = network.run_until(&mut [&mut ann, &mut bob], "Bob feels what Ann computes", |apps| {
        let mut query = apps[0].world_mut().query::<(&HandOf, &GrabForce)>();
        let felt = query.single(apps[0].world()).map_err(|error| error.to_string())?.1.force;
        let own = apps[1].world().get::<GrabForce>(grab).ok_or("none")?.force;
        must!(felt.length() > 1.0 && own.distance(felt) < 0.02 * felt.length(), "{own}, truly {felt}");
        Ok(felt.length())
    });
    let begin = support::tick(&ann);
    network.run_until(&mut [&mut ann, &mut bob], "ten seconds", |apps| support::tick(apps[0]) > begin + 400);
    let stats = *bob.world().resource::<NetStats>();
    let lost = network.datagrams[0].counts();
    println!(
        "{force:.2} N; {} of {} datagrams to the guest lost, which counts {:.1} %; {:.0} bytes/s in, round trip {:?}",
        lost.lost,
        lost.sent,
        100.0 * stats.loss_in,
        stats.bytes_in_per_s,
        stats.round_trip
    );
    // Four standard deviations of a share of 9 % in 400 are 5.7 %.
    let share = lost.lost as f64 / lost.sent as f64;
    assert!(lost.sent > 300 && (share - 0.09).abs() < 0.06, "{lost:?}");
    assert!(stats.loss_in > 0.02 && stats.loss_in < 0.2 && stats.rejected == 0, "{stats:?}");

    bob.world_mut().commands().leave_session();
    network.run_until(&mut [&mut ann, &mut bob], "Bob has left", |apps| {
        only::<HandOf>(apps[0]).is_none() && messages::<UserLeft>(apps[0]).len() == 1
    });
    assert_eq!(messages::<UserLeft>(&ann)[0].reason, DisconnectReason::Left);
    bob.world_mut().commands().join_session_over(client.join(SERVER, Limits::guest()), JoinConfig::default());
    network.run_until(&mut [&mut ann, &mut bob], "he is back", |apps| body_of(apps[1]));

    // Ann leaves and hosts again in the same frame. What is left of the old session comes first.
    ann.world_mut().commands().leave_session();
    ann.world_mut().commands().host_session_over(server.host(Limits::host()), HostConfig::default());
    network.run_until(&mut [&mut ann, &mut bob], "Bob knows that it is over", |apps| {
        state(apps[0]) == SessionState::Hosting && state(apps[1]) == SessionState::Idle
    });
    let over: Vec<_> = messages::<SessionClosed>(&bob).into_iter().map(|closed| closed.reason).collect();
    assert_eq!(over, [DisconnectReason::Left; 2], "once his own doing, once hers");
    bob.world_mut().commands().join_session_over(client.join(SERVER, Limits::guest()), JoinConfig::default());
    network.run_until(&mut [&mut ann, &mut bob], "he is in the next one", |apps| body_of(apps[1]));

    // The netcode loses him.
    server.disconnected(CLIENT, DisconnectReason::Lost);
    client.disconnected(SERVER, DisconnectReason::Lost);
    network.run_until(&mut [&mut ann, &mut bob], "they have lost each other", |apps| {
        let mut users = apps[0].world_mut().query::<&User>();
        users.iter(apps[0].world()).count() == 1 && state(apps[1]) == SessionState::Lost
    });
    network.connect();
    network.run_until(&mut [&mut ann, &mut bob], "he joins again by himself", |apps| {
        state(apps[1]) == SessionState::Joined
    });
}

#[test]
fn three_peers_ride_on_another_netcode_and_all_feel_one_body() {
    let _alone = alone();
    let mut party = Party::new(3);
    let [mut a, mut b, mut c] = [(); 3].map(|()| app(NetPlugin::default()));
    let mut bodies = Vec::new();
    for app in [&mut a, &mut b, &mut c] {
        let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
        bodies.push(app.world_mut().spawn((ModalBody::new(handle), SharedBody::named("bar"))).id());
    }
    let join = |app: &mut App, port: &CarrierPort, through: Option<usize>| {
        let join = through.map(|peer| CarrierPort::invite_of(name(peer)));
        let config = PeerConfig { join, ..PeerConfig::default() };
        app.world_mut().commands().join_peers_over(port.mesh(Limits::host()), config);
    };
    let users = |app: &mut App| app.world_mut().query::<&User>().iter(app.world()).count();
    join(&mut a, &party.ports[0], None);
    join(&mut b, &party.ports[1], Some(0));
    party.run_until(&mut [&mut a, &mut b, &mut c], "two are together", |apps| {
        users(apps[0]) == 2 && users(apps[1]) == 2
    });
    // The third one joins through the second, which tells it of the first.
    join(&mut c, &party.ports[2], Some(1));
    let all = |apps: &mut [&mut App]| apps.iter_mut().all(|app| users(app) == 3);
    party.run_until(&mut [&mut a, &mut b, &mut c], "all are together", all);

    let target = DVec3::new(1.0, 0.3, 0.2);
    c.world_mut().spawn((Grab::new(TIP, 0.3, target), GrabOf(bodies[2])));
    party.run_until(&mut [&mut a, &mut b, &mut c], "all see the same", |apps| {
        let shown = apps.iter().zip(&bodies).map(|(app, &body)| {
            app.world().get::<pliant_body::VisualState>(body).map_or(0.0, |visual| visual.q()[0])
        });
        let shown: Vec<f64> = shown.collect();
        must!(shown[0].abs() > 0.05, "{shown:?}");
        must!(shown.iter().all(|q| (q / shown[0] - 1.0).abs() < 0.01), "{shown:?}");
        Ok(())
    });

    // The one through whom the third has come leaves, and the others go on.
    b.world_mut().commands().leave_session();
    party.run_until(&mut [&mut a, &mut b, &mut c], "two go on", |apps| {
        users(apps[0]) == 2 && users(apps[2]) == 2 && state(apps[1]) == SessionState::Idle
    });
    for app in [&a, &c] {
        assert_eq!(messages::<UserLeft>(app)[0].reason, DisconnectReason::Left);
    }
    join(&mut b, &party.ports[1], Some(2));
    party.run_until(&mut [&mut a, &mut b, &mut c], "it comes back", all);

    // One whose netcode has lost another finds it again.
    let lost = DisconnectReason::Lost;
    party.ports[0].disconnected(2, lost);
    party.ports[2].disconnected(0, lost);
    party.run_until(&mut [&mut a, &mut b, &mut c], "they have lost each other", |apps| users(apps[0]) == 2);
    for (one, other) in [(0, 2), (2, 0)] {
        let path = RemotePath { key: name(other), role: Role::Hold, max_datagram: ROOM };
        party.ports[one].connected(other as u64, path);
    }
    party.run_until(&mut [&mut a, &mut b, &mut c], "they are together again", all);

    // Nobody is there by that key.
    b.world_mut().commands().leave_session();
    join(&mut b, &party.ports[1], Some(9));
    party.run_until(&mut [&mut b], "nobody is there", |apps| {
        !messages::<pliant_net::SessionFailed>(apps[0]).is_empty()
    });
}
