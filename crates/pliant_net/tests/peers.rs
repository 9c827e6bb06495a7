//! Tests of three equal apps over real QUIC.

use crate::support;

use std::sync::Arc;
use std::time::Duration;

use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_body::{FixedObstacles, Grab, GrabForce, GrabOf, Impulse, ModalAsset, ModalBody, VisualState};
use pliant_modal::{Body, FixedObstacle, FixedShape, ModalModel, StepSettings};
use pliant_net::transport::Limits;
use pliant_net::{
    Emulation, HostOptions, Invite, NetPeer, NetPlugin, NetStats, PeerConfig, PeerState, RemoteHands,
    SharedBody, User, UserLeft,
};
use pliant_stream::DisconnectReason;
use pliant_stream::emulator::{LinkConfig, Loss, Preset};
use support::{MIDDLE, TIP, alone, app, bar, messages, must, run_frames, run_until};

fn peer(name: &str, join: Option<Invite>) -> (App, Entity) {
    placed(PeerConfig { name: name.into(), join, ..PeerConfig::default() })
}

fn placed(config: PeerConfig) -> (App, Entity) {
    let x = config.name.len() as f32;
    let mut app = app(NetPlugin::peer(config).unwrap());
    let handle = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
    // Each app places its body elsewhere.
    let place = Transform::from_xyz(0.0, x, 0.0);
    let body = app.world_mut().spawn((ModalBody::new(handle), SharedBody::named("bar"), place)).id();
    (app, body)
}

/// Creates a peer with a timeout of three seconds, within which a busy machine also sends
/// something.
fn quick_peer(name: &str, join: Option<Invite>) -> (App, Entity) {
    let limits = Limits {
        idle_timeout: Duration::from_secs(3),
        keep_alive: Duration::from_millis(200),
        handshake: Duration::from_secs(4),
        ..Limits::host()
    };
    let transport = HostOptions { limits, ..HostOptions::default() };
    placed(PeerConfig { name: name.into(), join, transport, ..PeerConfig::default() })
}

fn users(app: &mut App) -> Vec<String> {
    let mut query = app.world_mut().query::<&User>();
    let mut names: Vec<String> = query.iter(app.world()).map(|user| user.name.clone()).collect();
    names.sort();
    names
}

fn q(app: &App, body: Entity) -> Vec<f64> {
    app.world().get::<VisualState>(body).unwrap().q().to_vec()
}

/// Returns whether the body is at rest where the hands pull it.
fn still(app: &App, body: Entity) -> bool {
    let net = app.world().resource::<NetPeer>();
    let played = net.session().unwrap().body(net.body_of(body).unwrap()).unwrap();
    played.visual().v.iter().all(|v| v.abs() < 0.02)
}

/// Checks that the others show the same shape as the first one, which must be bent.
fn agree(shapes: &[Vec<f64>], within: f64) -> Result<(), String> {
    must!(shapes[0].iter().any(|q| q.abs() > 0.01), "the body is bent: {shapes:?}");
    must!(shapes[1..].iter().all(|other| apart(&shapes[0], other) < within), "{shapes:?}");
    Ok(())
}

fn apart(a: &[f64], b: &[f64]) -> f64 {
    let size = a.iter().fold(1e-9_f64, |size, q| size.max(q.abs()));
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) / size
}

#[test]
fn a_peers_impulse_acts_at_all_peers_alike() {
    let _quiet = alone();
    let (mut first, body) = peer("a", None);
    run_until(&mut [&mut first], "the first begins", |apps| {
        matches!(apps[0].world().resource::<NetPeer>().state(), PeerState::In { .. })
    });
    let invite = first.world().resource::<NetPeer>().invite();
    let (mut second, there) = peer("bb", Some(invite));
    run_until(&mut [&mut first, &mut second], "both are in", |apps| {
        let state = apps[1].world().resource::<NetPeer>().state();
        matches!(state, PeerState::In { .. }) && users(apps[0]).len() == 2
    });
    run_frames(&mut [&mut first, &mut second], 30);
    second.world_mut().write_message(Impulse {
        body: there,
        vertex: TIP,
        impulse: DVec3::new(0.0, 1.5, -0.5),
    });
    run_until(&mut [&mut first, &mut second], "the same motion at both", |apps| {
        let [a, b] = [(0, body), (1, there)].map(|(k, entity)| {
            let net = apps[k].world().resource::<NetPeer>();
            (net.session().unwrap(), net.body_of(entity).unwrap())
        });
        let tick = a.0.confirmed().min(b.0.confirmed());
        let (x, y) = (a.0.state_at(a.1, tick).unwrap(), b.0.state_at(b.1, tick).unwrap());
        must!(x.q.iter().any(|q| q.abs() > 0.01), "not struck yet: {x:?}");
        assert_eq!(x, y, "the same to the bit");
        Ok(())
    });
}

#[test]
fn a_turned_body_hangs_among_peers_as_it_does_alone() {
    let _quiet = alone();
    let bud = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/bud.modal");
    let bud = Arc::new(ModalModel::read(bud).unwrap());
    let turn = Quat::from_rotation_x(std::f32::consts::FRAC_PI_2);
    let settings = StepSettings { gravity: [0.0, -9.81, 0.0], ..StepSettings::default() };
    // The same body steps alone until it hangs still, both turned and upright.
    let hung = |turn: Quat| {
        let mut body = Body::new(bud.clone(), settings.into()).unwrap();
        body.set_pose([0.0; 3], turn.as_dquat().normalize().into()).unwrap();
        for _ in 0..3000 {
            body.step().unwrap();
        }
        body.q().to_vec()
    };
    let (alone, upright) = (hung(turn), hung(Quat::IDENTITY));
    assert!(apart(&alone, &upright) > 0.5, "{alone:?}, {upright:?}");

    let mut app = app(NetPlugin::peer(PeerConfig { name: "a".into(), ..PeerConfig::default() }).unwrap());
    let model = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bud));
    let body = ModalBody { settings, ..ModalBody::new(model) };
    let place = Transform::from_rotation(turn);
    let entity = app.world_mut().spawn((body, SharedBody::named("bud"), place)).id();
    run_until(&mut [&mut app], "it hangs", |apps| {
        let net = apps[0].world().resource::<NetPeer>();
        must!(matches!(net.state(), PeerState::In { .. }));
        let shown = q(apps[0], entity);
        must!(shown.len() == alone.len() && apart(&alone, &shown) < 0.01, "{shown:?}, {alone:?}");
        must!(still(apps[0], entity));
        Ok(())
    });
}

/// A peer with a free body over a floor. Each machine lists the obstacles in another order.
fn faller(name: &str, join: Option<Invite>, turned: bool) -> (App, Entity) {
    let jack = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/jack.modal");
    let jack = Arc::new(ModalModel::read(jack).unwrap());
    let low = f64::from(jack.surface().bounds()[0][1]) - 0.05;
    let mut app = app(NetPlugin::peer(PeerConfig { name: name.into(), join, ..default() }).unwrap());
    app.add_observer(move |added: On<Insert, FixedObstacles>, mut bodies: Query<&mut FixedObstacles>| {
        let floor = FixedObstacle { position: [0.0, low, 0.0], ..FixedObstacle::GROUND };
        let ball = FixedObstacle { shape: FixedShape::Ball { radius: 0.1 }, position: [9.0; 3], ..floor };
        let rotation = [0.0, 0.0, 0.0, -1.0];
        let list = if turned { vec![FixedObstacle { rotation, ..ball }, floor] } else { vec![floor, ball] };
        bodies.get_mut(added.entity).unwrap().obstacles = list;
    });
    let model = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(jack));
    let settings = StepSettings { gravity: [0.0, -9.81, 0.0], ..StepSettings::default() };
    let body = ModalBody { settings, ..ModalBody::new(model) };
    let entity = app.world_mut().spawn((body, SharedBody::named("jack"))).id();
    (app, entity)
}

#[test]
fn a_free_body_of_peers_falls_onto_the_floor_that_both_have() {
    let _quiet = alone();
    let (mut a, body_a) = faller("a", None, false);
    run_until(&mut [&mut a], "the first begins", |apps| {
        matches!(apps[0].world().resource::<NetPeer>().state(), PeerState::In { .. })
    });
    let invite = a.world().resource::<NetPeer>().invite();
    let (mut b, body_b) = faller("b", Some(invite), true);
    let bodies = [body_a, body_b];
    run_until(&mut [&mut a, &mut b], "it lies on the floor of both", |apps| {
        let mut centers = Vec::new();
        for app in apps.iter() {
            let net = app.world().resource::<NetPeer>();
            must!(matches!(net.state(), PeerState::In { .. }), "{:?}", net.state());
            let Some(session) = net.session() else { return Err("no session".into()) };
            let Some(id) = net.body_of(bodies[centers.len()]) else { return Err("no body".into()) };
            let Some(played) = session.body(id) else { return Err("no body".into()) };
            assert_eq!(played.surroundings().obstacles.len(), 2);
            let frame = played.live().frame;
            must!(session.tick() > 200 && frame.velocity().iter().all(|v| v.abs() < 0.01), "it moves");
            centers.push(frame.center());
        }
        let apart = (0..3).map(|k| (centers[0][k] - centers[1][k]).abs()).fold(0.0, f64::max);
        must!(apart < 1e-3 && centers[0][1].abs() < 1.0, "{centers:?}");
        Ok(())
    });
}

#[test]
fn three_peers_hold_one_body_and_agree_and_one_that_goes_is_missed_by_nobody() {
    let _alone = alone();
    let (mut a, body_a) = peer("a", None);
    run_until(&mut [&mut a], "the first begins", |apps| {
        matches!(apps[0].world().resource::<NetPeer>().state(), PeerState::In { .. })
    });
    let invite = a.world().resource::<NetPeer>().invite();
    let (mut b, body_b) = peer("bb", Some(invite.clone()));
    run_until(&mut [&mut a, &mut b], "the second is in", |apps| users(apps[1]).len() == 2);
    // The third peer joins through the second one, which sends it the first one's invite.
    let through = b.world().resource::<NetPeer>().invite();
    let (mut c, body_c) = peer("ccc", Some(through));
    run_until(&mut [&mut a, &mut b, &mut c], "all know all", |apps| {
        apps.iter_mut().all(|app| users(app) == ["a", "bb", "ccc"])
    });
    // One of them is on the paper's third network, with 3 % loss and 60 ms.
    c.world_mut().resource_mut::<NetPeer>().set_emulation(Some(Emulation::preset(Preset::Paper3, 7)));

    let hold = |app: &mut App, body: Entity, vertex: u32, x: f64, up: f64| {
        let place = app.world().get::<Transform>(body).unwrap().translation.as_dvec3();
        app.world_mut().spawn((Grab::new(vertex, 0.3, place + DVec3::new(x, up, 0.1)), GrabOf(body))).id()
    };
    let of_a = hold(&mut a, body_a, TIP, 0.9, 0.2);
    let of_c = hold(&mut c, body_c, MIDDLE, 0.5, -0.1);
    let before = run_until(&mut [&mut a, &mut b, &mut c], "one shape, two hands", |apps| {
        let shapes = [q(apps[0], body_a), q(apps[1], body_b), q(apps[2], body_c)];
        agree(&shapes, 0.01)?;
        let forces =
            [(0, of_a), (2, of_c)].map(|(at, hand)| *apps[at].world().get::<GrabForce>(hand).unwrap());
        must!(forces.iter().all(|felt| felt.force.length() > 0.1), "{forces:?}");
        let hands = |at: usize, body| apps[at].world().get::<RemoteHands>(body).unwrap().0.len();
        must!(hands(1, body_b) == 2, "the one without a hand sees both");
        must!(hands(0, body_a) == 1 && hands(2, body_c) == 1, "who holds sees the other");
        must!(still(apps[0], body_a), "it still moves");
        Ok(shapes[0].clone())
    });

    // The second peer, through which the third one joined, leaves. The others continue together.
    drop(b);
    run_until(&mut [&mut a, &mut c], "both notice", |apps| {
        apps.iter().all(|app| messages::<UserLeft>(app).iter().any(|left| left.name == "bb"))
    });
    a.world_mut().get_mut::<Grab>(of_a).unwrap().target.z -= 0.3;
    run_until(&mut [&mut a, &mut c], "one shape, another one", |apps| {
        let shapes = [q(apps[0], body_a), q(apps[1], body_c)];
        must!(apart(&shapes[0], &before) > 0.1, "{before:?} before, {shapes:?}");
        must!(still(apps[0], body_a), "it still moves");
        agree(&shapes, 0.01)
    });
    c.world_mut().despawn(of_c);
    run_until(&mut [&mut a, &mut c], "the hand is let go of everywhere", |apps| {
        apps[0].world().get::<RemoteHands>(body_a).unwrap().0.is_empty()
    });
}

/// A link that loses all packets in both directions.
fn cut() -> Option<Emulation> {
    let link = LinkConfig { loss: Loss::Random(1.0), ..LinkConfig::default() };
    Some(Emulation { outgoing: link.clone(), incoming: link, seed: 1 })
}

#[test]
fn peers_that_have_lost_everybody_find_each_other_again_and_one_that_comes_late_finds_all() {
    let _alone = alone();
    let (mut a, body_a) = quick_peer("a", None);
    run_until(&mut [&mut a], "the first begins", |apps| {
        matches!(apps[0].world().resource::<NetPeer>().state(), PeerState::In { .. })
    });
    let invite = a.world().resource::<NetPeer>().invite();
    let (mut b, body_b) = quick_peer("bb", Some(invite.clone()));
    let (mut c, body_c) = quick_peer("ccc", Some(invite.clone()));
    run_until(&mut [&mut a, &mut b, &mut c], "all know all", |apps| {
        apps.iter_mut().all(|app| users(app) == ["a", "bb", "ccc"])
    });
    let number = |app: &App| app.world().resource::<NetPeer>().state().clone();
    let numbers = [number(&a), number(&b), number(&c)];
    let all_a = a.world().get::<Transform>(body_a).unwrap().translation.as_dvec3();
    let of_a =
        a.world_mut().spawn((Grab::new(TIP, 0.3, all_a + DVec3::new(0.9, 0.2, 0.1)), GrabOf(body_a))).id();
    run_until(&mut [&mut a, &mut b, &mut c], "one shape", |apps| {
        agree(&[q(apps[0], body_a), q(apps[1], body_b), q(apps[2], body_c)], 0.02)
    });

    // Every connection fails, and each peer continues alone.
    for app in [&mut a, &mut b, &mut c] {
        app.world_mut().resource_mut::<NetPeer>().set_emulation(cut());
    }
    run_until(&mut [&mut a, &mut b, &mut c], "each is alone", |apps| {
        apps.iter_mut().all(|app| users(app).len() == 1)
    });
    a.world_mut().get_mut::<Grab>(of_a).unwrap().target.z -= 0.3;
    run_until(&mut [&mut a, &mut b, &mut c], "they go different ways", |apps| {
        let (qa, qb) = (q(apps[0], body_a), q(apps[1], body_b));
        must!(apart(&qa, &qb) > 0.3, "{qa:?}, {qb:?}");
        Ok(())
    });

    for app in [&mut a, &mut b, &mut c] {
        app.world_mut().resource_mut::<NetPeer>().set_emulation(None);
    }
    let up = std::time::Instant::now();
    run_until(&mut [&mut a, &mut b, &mut c], "all know all again", |apps| {
        apps.iter_mut().all(|app| users(app) == ["a", "bb", "ccc"])
    });
    println!("together again {:.2} s after the lines", up.elapsed().as_secs_f64());
    assert_eq!([number(&a), number(&b), number(&c)], numbers, "all are who they were");
    run_until(&mut [&mut a, &mut b, &mut c], "one shape again", |apps| {
        agree(&[q(apps[0], body_a), q(apps[1], body_b), q(apps[2], body_c)], 0.02)
    });
    println!("one shape again {:.2} s after the lines", up.elapsed().as_secs_f64());

    // One more peer joins afterwards through the third one, and gets the users, the shape and the
    // hand.
    let through = c.world().resource::<NetPeer>().invite();
    let (mut d, body_d) = quick_peer("dddd", Some(through));
    run_until(&mut [&mut a, &mut b, &mut c, &mut d], "all know the late one, and it them", |apps| {
        apps.iter_mut().all(|app| users(app) == ["a", "bb", "ccc", "dddd"])
    });
    run_until(&mut [&mut a, &mut b, &mut c, &mut d], "it has the shape", |apps| {
        let seen = apps[3].world().get::<RemoteHands>(body_d).is_some_and(|hands| hands.0.len() == 1);
        must!(seen, "it sees the hand");
        agree(&[q(apps[0], body_a), q(apps[3], body_d)], 0.02)
    });
    // A peer that says goodbye is not tracked as lost, not even when its connection ends.
    drop(d);
    run_until(&mut [&mut a, &mut b, &mut c], "it has left, and its connections are over", |apps| {
        apps.iter_mut()
            .all(|app| users(app) == ["a", "bb", "ccc"] && app.world().resource::<NetStats>().peers == 2)
    });
    run_frames(&mut [&mut a, &mut b, &mut c], 20);
    assert!([&a, &b, &c].iter().all(|app| app.world().resource::<NetPeer>().looked_for() == 0));
}

#[test]
fn peers_that_a_third_introduces_find_each_other() {
    let _alone = alone();
    let (mut a, _) = quick_peer("a", None);
    run_until(&mut [&mut a], "the first begins", |apps| {
        matches!(apps[0].world().resource::<NetPeer>().state(), PeerState::In { .. })
    });
    let invite = a.world().resource::<NetPeer>().invite();
    let (mut b, _) = quick_peer("bb", Some(invite));
    run_until(&mut [&mut a, &mut b], "both know each other", |apps| {
        apps.iter_mut().all(|app| users(app) == ["a", "bb"])
    });
    a.world_mut().resource_mut::<NetPeer>().set_emulation(cut());
    run_until(&mut [&mut a, &mut b], "each is alone", |apps| {
        apps.iter_mut().all(|app| users(app).len() == 1)
    });
    // It comes through the second, which does not know where the first is at this time.
    let through = b.world().resource::<NetPeer>().invite();
    let (mut c, _) = quick_peer("ccc", Some(through));
    run_until(&mut [&mut a, &mut b, &mut c], "the third is in", |apps| users(apps[2]) == ["bb", "ccc"]);
    a.world_mut().resource_mut::<NetPeer>().set_emulation(None);
    run_until(&mut [&mut a, &mut b, &mut c], "all know all", |apps| {
        apps.iter_mut().all(|app| users(app) == ["a", "bb", "ccc"])
    });
}

#[test]
fn a_peer_that_steps_the_body_otherwise_is_not_let_in_and_is_told() {
    let _alone = alone();
    let (mut a, _) = peer("a", None);
    run_until(&mut [&mut a], "the first begins", |apps| {
        matches!(apps[0].world().resource::<NetPeer>().state(), PeerState::In { .. })
    });
    let (mut b, body) = peer("bb", Some(a.world().resource::<NetPeer>().invite()));
    b.world_mut().get_mut::<ModalBody>(body).unwrap().settings.stiffness_scale = 2.0;
    run_until(&mut [&mut a, &mut b], "it is told why", |apps| {
        matches!(
            apps[1].world().resource::<NetPeer>().state(),
            PeerState::Closed { reason: DisconnectReason::SceneMismatch }
        )
    });
    assert_eq!(users(&mut a), ["a"]);
}

#[test]
fn a_hand_whose_spring_changes_is_felt_with_the_new_one_by_all() {
    let _alone = alone();
    let (mut a, body_a) = peer("a", None);
    run_until(&mut [&mut a], "the first begins", |apps| {
        matches!(apps[0].world().resource::<NetPeer>().state(), PeerState::In { .. })
    });
    let (mut b, body_b) = peer("bb", Some(a.world().resource::<NetPeer>().invite()));
    run_until(&mut [&mut a, &mut b], "the second is in", |apps| users(apps[1]).len() == 2);
    let place = a.world().get::<Transform>(body_a).unwrap().translation.as_dvec3();
    let grab = Grab::new(TIP, 0.3, place + DVec3::new(0.9, 0.3, 0.0));
    let hand = a.world_mut().spawn((grab, GrabOf(body_a))).id();
    let pulled = |apps: &mut [&mut App]| {
        let shapes = [q(apps[0], body_a), q(apps[1], body_b)];
        agree(&shapes, 0.01)?;
        must!(still(apps[0], body_a), "it still moves");
        Ok(shapes[1][0].abs())
    };
    let firm = run_until(&mut [&mut a, &mut b], "a firm hand", pulled);
    // A soft hand yields.
    a.world_mut().get_mut::<Grab>(hand).unwrap().stiffness = Some(2.0);
    run_until(&mut [&mut a, &mut b], "a soft hand", |apps| {
        let soft = pulled(apps)?;
        must!(soft < 0.5 * firm, "{soft} of {firm}");
        Ok(())
    });
}

#[test]
fn a_peer_with_another_body_is_not_let_in() {
    let _alone = alone();
    let (mut a, _) = peer("a", None);
    run_until(&mut [&mut a], "the first begins", |apps| {
        matches!(apps[0].world().resource::<NetPeer>().state(), PeerState::In { .. })
    });
    let invite = a.world().resource::<NetPeer>().invite();
    let net = NetPlugin::peer(PeerConfig { join: Some(invite), ..PeerConfig::default() }).unwrap();
    let mut other = app(net);
    let handle = other.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
    other.world_mut().spawn((ModalBody::new(handle), SharedBody::named("rod")));
    run_until(&mut [&mut a, &mut other], "it is told why", |apps| {
        matches!(
            apps[1].world().resource::<NetPeer>().state(),
            PeerState::Closed { reason: DisconnectReason::SceneMismatch }
        )
    });
}
