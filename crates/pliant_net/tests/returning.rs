//! Tests of guests and hosts that leave or fail, and come back.

use crate::support;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_body::{BodyState, Grab, GrabForce, GrabOf, ModalAsset, ModalBody, VisualState};
use pliant_modal::ModalModel;
use pliant_net::transport::Limits;
use pliant_net::{
    Access, BodyArrived, BodyLeft, DisconnectReason, Emulation, Grant, GuestState, HandOf, HostConfig,
    HostOptions, Identity, Invite, JoinConfig, JoinOptions, NetGuest, NetHost, NetPlugin, NetStats,
    SessionClosed, SessionJoined, SessionLost, SharedBody, Token, User, UserJoined,
};
use pliant_stream::UserId;
use pliant_stream::emulator::{LinkConfig, Loss};
use support::{
    TIP, alone, app, arrival, bar, body_of, guest, host, messages, must, only, rests, run_frames, run_until,
    wait_for,
};

fn state_of(app: &App) -> GuestState {
    app.world().resource::<NetGuest>().state().clone()
}

fn is_in(app: &App) -> bool {
    matches!(state_of(app), GuestState::In { .. })
}

/// A link that loses all packets in both directions.
fn cut() -> Option<Emulation> {
    let link = LinkConfig { loss: Loss::Random(1.0), ..LinkConfig::default() };
    Some(Emulation { outgoing: link.clone(), incoming: link, seed: 1 })
}

fn quick(limits: Limits, idle_timeout: Duration) -> Limits {
    Limits { idle_timeout, keep_alive: Duration::from_millis(200), ..limits }
}

/// Creates a host and a guest with the given timeout.
fn quick_pair(idle_timeout: Duration) -> (App, Entity, App) {
    let session = pliant_stream::HostSessionConfig { idle_timeout, ..Default::default() };
    let limits = quick(Limits::host(), idle_timeout);
    let transport = HostOptions { limits, ..HostOptions::default() };
    let (host, invite, body) = host(HostConfig { session, transport, ..HostConfig::default() });
    let limits = quick(Limits::guest(), idle_timeout);
    let transport = JoinOptions { limits, ..JoinOptions::default() };
    let guest = guest(&invite, JoinConfig { transport, name: "Ann".into(), ..JoinConfig::default() });
    (host, body, guest)
}

/// Checks that the guest shows the host's body correctly, at rest in a hand.
fn is_right(apps: &[&mut App], body: Entity, there: Entity, within: f64) -> Result<(), String> {
    let truth = apps[0].world().get::<BodyState>(body).unwrap().body().q();
    let size = truth.iter().fold(0.0_f64, |size, q| size.max(q.abs()));
    must!(size > 0.05 && rests(apps[0], body, size), "{truth:?}");
    let off = apart(apps[0], body, apps[1], there);
    must!(off < within, "the picture is off by {off}");
    Ok(())
}

/// Returns the largest difference of the guest's visual state from the host's body, as a part of
/// the body's largest coordinate.
fn apart(host: &App, body: Entity, guest: &App, there: Entity) -> f64 {
    let truth = host.world().get::<BodyState>(body).unwrap().body().q();
    let shown = guest.world().get::<VisualState>(there).unwrap().q();
    let size = truth.iter().fold(1e-9_f64, |size, q| size.max(q.abs()));
    truth.iter().zip(shown).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) / size
}

#[test]
fn a_network_that_is_away_for_longer_than_the_timeout_costs_the_time_and_nothing_else() {
    let _alone = alone();
    let (mut host, body, mut guest) = quick_pair(Duration::from_secs(3));
    let there = arrival(&mut host, &mut guest);
    let user = match state_of(&guest) {
        GuestState::In { user } => user,
        other => panic!("{other:?}"),
    };
    let own = guest.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 2.4, 0.4)), GrabOf(there))).id();
    run_until(&mut [&mut host, &mut guest], "the hand takes hold", |apps| only::<HandOf>(apps[0]).is_some());

    guest.world().resource::<NetGuest>().set_emulation(cut());
    let cut_at = Instant::now();
    run_until(&mut [&mut host, &mut guest], "both ends notice", |apps| {
        matches!(state_of(apps[1]), GuestState::Lost { .. }) && only::<HandOf>(apps[0]).is_none()
    });
    let noticed = cut_at.elapsed().as_secs_f64();
    // The last packet arrived a little before the cut. The loopback tests check, by the order of
    // two timeouts, that the timeout is not longer than set.
    assert!(noticed > 2.0, "the timeout is 3 s, noticed after {noticed} s");
    assert_eq!(messages::<SessionLost>(&guest).len(), 1);
    assert!(guest.world().get_entity(there).is_ok() && guest.world().get_entity(own).is_ok());
    // The host's body continues without the guest's hand.
    host.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(0.9, 2.8, -0.3)), GrabOf(body)));
    run_until(&mut [&mut host, &mut guest], "the picture is of the past", |apps| {
        let off = apart(apps[0], body, apps[1], there);
        must!(off > 0.1 && is_right(apps, body, there, f64::INFINITY).is_ok(), "off by {off}");
        Ok(())
    });

    guest.world().resource::<NetGuest>().set_emulation(None);
    let back_at = Instant::now();
    run_until(&mut [&mut host, &mut guest], "the guest is back, hand and all", |apps| {
        is_in(apps[1]) && only::<HandOf>(apps[0]).is_some()
    });
    println!("noticed after {noticed:.2} s, back {:.2} s after the network", back_at.elapsed().as_secs_f64());
    assert_eq!(state_of(&guest), GuestState::In { user }, "the same user");
    assert!(messages::<SessionJoined>(&guest).iter().any(|joined| joined.reconnected && joined.user == user));
    assert!(messages::<UserJoined>(&host).iter().any(|joined| joined.back && joined.name == "Ann"));
    run_until(&mut [&mut host, &mut guest], "the picture is right, and is felt again", |apps| {
        is_right(apps, body, there, 0.05)?;
        let felt = apps[1].world().get::<GrabForce>(own).unwrap().force.length();
        must!(felt > 0.1, "{felt} N");
        Ok(())
    });
    assert_eq!(body_of(&mut guest), Some(there), "the body is on the entity that it was on");
    assert!(messages::<BodyLeft>(&guest).is_empty());
}

#[test]
fn guests_wait_for_a_host_that_is_started_anew() {
    let _alone = alone();
    let key = Identity::generate().unwrap().to_pkcs8();
    let config = |bind: SocketAddr| HostConfig {
        transport: HostOptions {
            bind,
            identity: Some(Identity::from_pkcs8(&key).unwrap()),
            ..HostOptions::default()
        },
        name: "Hanna".into(),
        ..HostConfig::default()
    };
    let (mut first, invite, _) = host(config("127.0.0.1:0".parse().unwrap()));
    let address = SocketAddr::from(([127, 0, 0, 1], invite.port));
    let mut guest = guest(&invite, JoinConfig::default());
    let there = arrival(&mut first, &mut guest);
    drop(first);
    run_until(&mut [&mut guest], "the guest hears of it", |apps| {
        matches!(state_of(apps[0]), GuestState::Lost { .. })
    });
    assert!(guest.world().get_entity(there).is_ok(), "what it saw is still there");
    let (mut second, _, body) = host(config(address));
    let restarted = Instant::now();
    run_until(&mut [&mut second, &mut guest], "the guest is back", |apps| body_of(apps[1]) == Some(there));
    println!("back {:.2} s after the host", restarted.elapsed().as_secs_f64());
    second.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(0.9, 2.8, -0.3)), GrabOf(body)));
    run_until(&mut [&mut second, &mut guest], "the picture is right, and the host's name is known", |apps| {
        is_right(apps, body, there, 0.02)?;
        let mut users = apps[1].world_mut().query::<&User>();
        let host_user = users.iter(apps[1].world()).find(|user| user.id == UserId::HOST);
        must!(host_user.is_some_and(|user| user.name == "Hanna"));
        Ok(())
    });
    assert!(messages::<SessionClosed>(&guest).is_empty());
}

#[test]
fn a_number_is_given_to_nobody_else_also_after_the_host_was_started_anew() {
    let _alone = alone();
    let server = Identity::generate().unwrap().to_pkcs8();
    let start = |bind: SocketAddr, known| {
        let identity = Some(Identity::from_pkcs8(&server).unwrap());
        let transport = HostOptions { bind, identity, ..HostOptions::default() };
        host(HostConfig { transport, known, ..HostConfig::default() })
    };
    let join = |invite: &Invite, name: &str| {
        guest(invite, JoinConfig { name: name.into(), models: vec![bar()], ..JoinConfig::default() })
    };
    let (mut first, invite, _) = start("127.0.0.1:0".parse().unwrap(), Vec::new());
    let address = SocketAddr::from(([127, 0, 0, 1], invite.port));
    let mut ann = join(&invite, "Ann");
    run_until(&mut [&mut first, &mut ann], "Ann is in", |apps| is_in(apps[1]));
    let mut bob = join(&invite, "Bob");
    run_until(&mut [&mut first, &mut ann, &mut bob], "Bob is in", |apps| is_in(apps[2]));
    assert_eq!(state_of(&ann), GuestState::In { user: UserId(1) });
    assert_eq!(state_of(&bob), GuestState::In { user: UserId(2) });
    let known: Vec<_> = first.world().resource::<NetHost>().known().collect();
    assert_eq!(known.len(), 2);
    drop(first);
    run_until(&mut [&mut ann, &mut bob], "they hear of it", |apps| {
        apps.iter().all(|app| matches!(state_of(app), GuestState::Lost { .. }))
    });

    // A new guest joins first, and the earlier guests come back later.
    let (mut second, invite, _) = start(address, known);
    let mut new = join(&invite, "Cy");
    run_until(&mut [&mut second, &mut new], "Cy is in", |apps| is_in(apps[1]));
    assert_eq!(state_of(&new), GuestState::In { user: UserId(3) }, "1 and 2 are Ann's and Bob's");
    run_until(&mut [&mut second, &mut new, &mut ann, &mut bob], "Ann and Bob are back", |apps| {
        is_in(apps[2]) && is_in(apps[3])
    });
    assert_eq!(state_of(&ann), GuestState::In { user: UserId(1) });
    assert_eq!(state_of(&bob), GuestState::In { user: UserId(2) });
    assert!(messages::<UserJoined>(&second).iter().filter(|joined| joined.back).count() == 2);
}

#[test]
fn two_of_one_token_are_two_users() {
    let _alone = alone();
    let token = Token::generate().unwrap();
    // The grant expires in an hour of the host's clock. The guest's clock is never used.
    let access =
        Access::Tokens(vec![Grant::hold(token).until(SystemTime::now() + Duration::from_secs(3600))]);
    let transport = HostOptions { access, ..HostOptions::default() };
    let (mut host, invite, _) = host(HostConfig { transport, ..HostConfig::default() });
    assert_eq!(invite.token, Some(token));
    let join = |name: &str| {
        guest(&invite, JoinConfig { name: name.into(), models: vec![bar()], ..JoinConfig::default() })
    };
    let (mut one, mut two) = (join("one"), join("two"));
    run_until(&mut [&mut host, &mut one, &mut two], "both have the body", |apps| {
        body_of(apps[1]).is_some() && body_of(apps[2]).is_some()
    });
    let numbers = [state_of(&one), state_of(&two)];
    assert!(numbers[0] != numbers[1], "{numbers:?}");
    // Both guests hold the body, and the host does not confuse their hands.
    for app in [&mut one, &mut two] {
        let there = body_of(app).unwrap();
        app.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 2.4, 0.4)), GrabOf(there)));
    }
    run_until(&mut [&mut host, &mut one, &mut two], "two hands of two users", |apps| {
        let mut hands = apps[0].world_mut().query::<&HandOf>();
        let of: Vec<Entity> = hands.iter(apps[0].world()).map(|hand| hand.0).collect();
        of.len() == 2 && of[0] != of[1]
    });
    // One guest leaves. The other one, with the same token, stays and keeps its grab.
    drop(one);
    run_until(&mut [&mut host, &mut two], "one has left", |apps| {
        apps[0].world().resource::<NetHost>().guests().count() == 1
    });
    assert!(is_in(&two) && only::<HandOf>(&mut host).is_some());
}

#[test]
fn two_connections_of_one_key_are_one_user_the_newer() {
    let _alone = alone();
    let (mut host, invite, _) = host(HostConfig::default());
    let key = Identity::generate().unwrap().to_pkcs8();
    let join = |name: &str| {
        let identity = Some(Identity::from_pkcs8(&key).unwrap());
        let transport = JoinOptions { identity, ..JoinOptions::default() };
        let models = vec![bar()];
        guest(&invite, JoinConfig { transport, name: name.into(), models, ..JoinConfig::default() })
    };
    let mut old = join("old");
    run_until(&mut [&mut host, &mut old], "the first is in", |apps| is_in(apps[1]));
    let mut new = join("new");
    run_until(&mut [&mut host, &mut old, &mut new], "the second is in, the first is out", |apps| {
        is_in(apps[2]) && state_of(apps[1]) == GuestState::Closed { reason: DisconnectReason::Replaced }
    });
    assert_eq!(state_of(&new), GuestState::In { user: UserId(1) }, "under the same number");
    assert_eq!(host.world().resource::<NetHost>().guests().count(), 1);
    // Another guest with its own key is another user.
    let mut other = guest(&invite, JoinConfig { models: vec![bar()], ..JoinConfig::default() });
    run_until(&mut [&mut host, &mut new, &mut other], "another one", |apps| is_in(apps[2]));
    assert_eq!(host.world().resource::<NetHost>().guests().count(), 2);
}

#[test]
fn a_guest_that_is_sent_away_does_not_come_back() {
    let _alone = alone();
    let (mut host, invite, _) = host(HostConfig::default());
    let mut guest = guest(&invite, JoinConfig::default());
    run_until(&mut [&mut host, &mut guest], "the guest is in", |apps| is_in(apps[1]));
    let user = host.world().resource::<NetHost>().guests().next().unwrap();
    assert!(host.world().resource::<NetHost>().key_of(user).is_some());
    assert!(host.world_mut().resource_mut::<NetHost>().kick(user));
    run_until(&mut [&mut host, &mut guest], "it is told", |apps| {
        state_of(apps[1]) == GuestState::Closed { reason: DisconnectReason::Kicked }
    });
    // The time until another guest has joined and has its body is enough for the kicked guest to
    // come back.
    let mut other = support::guest(&invite, JoinConfig::default());
    run_until(&mut [&mut host, &mut other, &mut guest], "another one joins", |apps| body_of(apps[1]));
    run_frames(&mut [&mut host, &mut other, &mut guest], 100);
    assert_eq!(host.world().resource::<NetHost>().guests().count(), 1);
    assert!(matches!(state_of(&guest), GuestState::Closed { .. }));
    assert!(messages::<BodyArrived>(&guest).len() <= 1);
}

/// Round trip, s. The machine's own time for a join is small beside ten of these.
const ROUND_TRIP: f64 = 0.6;
/// Longest time of a join, s: ten round trips, which is one second at 100 ms.
const JOIN: f64 = 10.0 * ROUND_TRIP;

/// Returns the seconds until a guest shows a body correctly. Guests join until one of them succeeds
/// within `most`, because other work on the machine makes a guest slower, and nothing makes it
/// faster.
fn first_picture(
    host: &mut App,
    body: Entity,
    invite: &Invite,
    models: &[Arc<ModalModel>],
    most: f64,
) -> f64 {
    run_until(&mut [&mut *host], "the host's body rests where it is held", |apps| {
        let truth = apps[0].world().get::<BodyState>(body).unwrap().body().q();
        let size = truth.iter().fold(0.0_f64, |size, q| size.max(q.abs()));
        size > 0.0 && rests(apps[0], body, size)
    });
    wait_for("a right picture in ten round trips and the model's bytes", || {
        let took = one_first_picture(host, body, invite, models.to_vec());
        must!(took < most, "{took} s, not {most} s");
        Ok(took)
    })
}

fn one_first_picture(host: &mut App, body: Entity, invite: &Invite, models: Vec<Arc<ModalModel>>) -> f64 {
    let link = LinkConfig { delay: Duration::from_secs_f64(0.5 * ROUND_TRIP), ..LinkConfig::default() };
    let emulation = Some(Emulation { outgoing: link.clone(), incoming: link, seed: 1 });
    let transport = JoinOptions { emulation, ..JoinOptions::default() };
    let began = Instant::now();
    let mut guest = guest(invite, JoinConfig { transport, models, ..JoinConfig::default() });
    run_until(&mut [host, &mut guest], "the body is shown as it is", |apps| {
        let there = body_of(apps[1])?;
        (apart(apps[0], body, apps[1], there) < 0.05).then_some(())
    });
    began.elapsed().as_secs_f64()
}

#[test]
fn joining_takes_less_than_ten_round_trips_and_the_models_bytes() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    host.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 2.4, 0.4)), GrabOf(body)));
    let cached = first_picture(&mut host, body, &invite, &[bar()], JOIN);
    // The default rate of a host, which also carries models, is 1 MB/s.
    let bytes = bar().file_bytes() as f64;
    let sent = first_picture(&mut host, body, &invite, &[], JOIN + bytes / 1e6);
    println!("first right picture after {cached:.2} s, after {sent:.2} s with a model of {bytes} bytes");
}

#[test]
fn joining_the_shipped_body_takes_less_than_ten_round_trips_and_the_models_bytes() {
    let _alone = alone();
    let file = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal"));
    let model = Arc::new(ModalModel::read(file).unwrap());
    let net = NetPlugin::host(HostConfig::default()).unwrap();
    let invite = net.invite().unwrap().clone();
    let mut host = app(net);
    let handle = host.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(model.clone()));
    let body = host.world_mut().spawn((ModalBody::new(handle), SharedBody::named("pip"))).id();
    let positions = model.surface().positions();
    let top = (0..positions.len()).max_by(|&a, &b| positions[a][1].total_cmp(&positions[b][1])).unwrap();
    let at = Vec3::from(positions[top]).as_dvec3() + DVec3::new(0.04, 0.0, 0.02);
    host.world_mut().spawn((Grab::new(top as u32, 0.03, at), GrabOf(body)));
    let cached = first_picture(&mut host, body, &invite, std::slice::from_ref(&model), JOIN);
    let bytes = model.file_bytes() as f64;
    let sent = first_picture(&mut host, body, &invite, &[], JOIN + bytes / 1e6);
    println!("the shipped body: after {cached:.2} s, after {sent:.2} s with a model of {bytes} bytes");
    assert!(sent > 0.8 * bytes / 1e6, "{sent} s: faster than the rate cap");
}

#[test]
fn bodies_stay_while_a_host_that_was_lost_twice_is_waited_for() {
    let _alone = alone();
    // The timeout is short, because after a return the bodies are only awaited for five seconds.
    let (mut host, _, mut guest) = quick_pair(Duration::from_secs(1));
    let there = arrival(&mut host, &mut guest);
    let lost = |app: &App| matches!(state_of(app), GuestState::Lost { .. });
    // A body at rest may arrive through messages alone, and a busy machine takes a while to send
    // anything else.
    run_until(&mut [&mut host, &mut guest], "a datagram", |apps| {
        apps[1].world().resource::<NetStats>().datagrams_in > 0
    });
    guest.world().resource::<NetGuest>().set_emulation(cut());
    run_until(&mut [&mut host, &mut guest], "it is lost", |apps| lost(apps[1]));
    guest.world().resource::<NetGuest>().set_emulation(None);
    run_until(&mut [&mut host, &mut guest], "it is back", |apps| is_in(apps[1]));
    // The connection fails again while the bodies of the first session are still awaited.
    guest.world().resource::<NetGuest>().set_emulation(cut());
    run_until(&mut [&mut host, &mut guest], "it is lost again", |apps| lost(apps[1]));
    let since = Instant::now();
    run_until(&mut [&mut host, &mut guest], "that time is over", |_| {
        since.elapsed() > Duration::from_secs(6)
    });
    assert!(lost(&guest));
    assert!(guest.world().get_entity(there).is_ok(), "what was there stays as it was last seen");
    assert!(messages::<BodyLeft>(&guest).is_empty());
    // Counts never fall, even with the third connection.
    let before = *guest.world().resource::<NetStats>();
    assert!(before.datagrams_in > 0 && before.bytes_in > 0, "{before:?}");
    guest.world().resource::<NetGuest>().set_emulation(None);
    run_until(&mut [&mut host, &mut guest], "it is back for good", |apps| {
        is_in(apps[1]) && body_of(apps[1]).is_some()
    });
    assert_eq!(body_of(&mut guest), Some(there));
    let after = *guest.world().resource::<NetStats>();
    assert!(after.datagrams_in >= before.datagrams_in && after.bytes_in >= before.bytes_in, "{after:?}");
}
