//! Two and three apps that hold one body over real QUIC on loopback.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod support;

use std::collections::BTreeMap;
use std::time::Duration;

use bevy::math::{DQuat, DVec3};
use bevy::prelude::*;
use bytes::Bytes;
use pliant_body::{
    BodyState, Driven, Grab, GrabForce, GrabOf, ModalAsset, PliantSystems, PliantTick, ShownState,
};
use pliant_net::transport::{Emulation, Endpoint, Event, JoinOptions, PeerId};
use pliant_net::{
    BodyLeft, GrabRefused, GuestState, HandOf, Holding, HostConfig, JoinConfig, NetGuest, NetStats,
    RemoteBody, SeenHands, SharedBody, User, UserLeft, UserLink,
};
use pliant_stream::UserId;
use pliant_stream::emulator::Preset;
use support::{MIDDLE, TIP, alone, bar, guest, host, messages, only, patch_at_rest, run_for, run_until};

/// A place `y` and `z` (m, of the model) beside the middle of the bar's section at `x`, in the world of [`support::host`].
fn beside(x: f64, y: f64, z: f64) -> DVec3 {
    DVec3::Y + DQuat::from_rotation_z(0.5) * (2.0 * DVec3::new(x, y, z))
}

fn state(app: &App, body: Entity) -> &BodyState {
    app.world().get::<BodyState>(body).unwrap()
}

fn size(q: &[f64]) -> f64 {
    q.iter().map(|q| q * q).sum::<f64>().sqrt()
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    size(&a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<_>>())
}

fn state_of(app: &App) -> GuestState {
    app.world().resource::<NetGuest>().state().clone()
}

/// Waits for the body on a guest.
fn arrival(host: &mut App, guest: &mut App) -> Entity {
    let mut found = None;
    run_until(&mut [host, guest], 5.0, "the body arrives", |apps| {
        found = only::<RemoteBody>(apps[1]).filter(|&body| apps[1].world().get::<ShownState>(body).is_some());
        found.is_some()
    });
    found.unwrap()
}

#[test]
fn a_guest_sees_holds_and_feels_the_hosts_body() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    let mut guest = guest(&invite, JoinConfig { name: "Ann\n".into(), ..JoinConfig::default() });
    let there = arrival(&mut host, &mut guest);

    // The body is whole, moved by the host, and where the host has it.
    assert_eq!(state(&guest, there).model().hash(), bar().hash());
    assert_eq!(guest.world().get::<Driven>(there), Some(&Driven::Remote));
    assert_eq!(guest.world().get::<SharedBody>(there).unwrap().name, "bar");
    let place = host.world().get::<Transform>(body).unwrap();
    assert!(guest.world().get::<Transform>(there).unwrap().translation.distance(place.translation) < 1e-6);
    assert_eq!(state_of(&guest), GuestState::In { user: UserId(1) });
    let users: Vec<String> = {
        let mut query = host.world_mut().query::<&User>();
        query.iter(host.world()).map(|user| user.name.clone()).collect()
    };
    assert!(users.contains(&"Ann".to_string()), "{users:?}");

    // The host pulls the tip aside and holds it there: the guest sees the same shape.
    let at_host = host.world_mut().spawn((Grab::new(TIP, 0.3, beside(0.9, 0.3, 0.2)), GrabOf(body))).id();
    run_for(&mut [&mut host, &mut guest], 2.0);
    let truth = state(&host, body).body().q().to_vec();
    assert!(size(&truth) > 0.1, "the tip is far aside: {truth:?}");
    let shown = guest.world().get::<ShownState>(there).unwrap().q();
    let off = distance(&truth, shown) / size(&truth);
    assert!(off < 0.01, "shown {shown:?}, true {truth:?}");
    // And where the host's hand is.
    let seen = &guest.world().get::<SeenHands>(there).unwrap().0;
    assert_eq!((seen.len(), seen[0].user, seen[0].vertex), (1, UserId::HOST, TIP));
    assert!(seen[0].target.distance(beside(0.9, 0.3, 0.2)) < 1e-3, "{seen:?}");
    let force = host.world().get::<GrabForce>(at_host).unwrap().force;
    assert!(seen[0].reaction.distance(force) < 0.02 * force.length(), "{seen:?}, {force}");

    // The guest takes hold of the middle: the host's body has a second hand on it, and the guest feels what the host computes.
    let grab = guest.world_mut().spawn((Grab::new(MIDDLE, 0.3, beside(0.5, 0.0, -0.1)), GrabOf(there))).id();
    run_for(&mut [&mut host, &mut guest], 0.5);
    guest.world_mut().get_mut::<Grab>(grab).unwrap().target = beside(0.5, 0.1, -0.2);
    run_for(&mut [&mut host, &mut guest], 2.0);
    let (user, hand, held, felt) = {
        let mut query = host.world_mut().query::<(&HandOf, &Grab, &GrabForce)>();
        let (of, grab, force) = query.single(host.world()).unwrap();
        (of.0, grab.target, grab.vertex, *force)
    };
    assert_eq!(host.world().get::<User>(user).unwrap().name, "Ann");
    assert_eq!(held, MIDDLE);
    assert!(hand.distance(beside(0.5, 0.1, -0.2)) < 1e-3, "{hand}, not {}", beside(0.5, 0.1, -0.2));
    let own = guest.world().get::<GrabForce>(grab).unwrap();
    assert!(felt.force.length() > 1.0, "the body resists: {felt:?}");
    assert!(own.force.distance(felt.force) < 0.02 * felt.force.length(), "felt {own:?}, true {felt:?}");
    assert!(own.point.distance(felt.point) < 1e-3, "patch at {own:?}, truly at {felt:?}");
    assert_eq!(
        guest.world().get::<SeenHands>(there).unwrap().0.len(),
        1,
        "the own hand is not among the others'"
    );

    let stats = *guest.world().resource::<NetStats>();
    assert!(stats.shown > 100 && stats.rejected == 0 && stats.bytes_in > 1000, "{stats:?}");
    assert!(
        stats.loss_in < 0.02 && !stats.round_trip.is_zero() && stats.round_trip.as_millis() < 60,
        "{stats:?}"
    );
    assert_eq!(host.world().resource::<NetStats>().peers, 1);
    assert!(host.world().get::<UserLink>(user).is_some());

    // Letting go reaches the host; so does leaving, which takes the user and what it holds away.
    guest.world_mut().despawn(grab);
    run_until(&mut [&mut host, &mut guest], 3.0, "the hand lets go", |apps| {
        only::<HandOf>(apps[0]).is_none()
    });
    guest.world_mut().spawn((Grab::new(MIDDLE, 0.3, DVec3::ZERO), GrabOf(there)));
    run_until(&mut [&mut host, &mut guest], 3.0, "the hand takes hold again", |apps| {
        only::<HandOf>(apps[0]).is_some()
    });
    drop(guest);
    run_until(&mut [&mut host], 3.0, "the guest has left", |apps| !messages::<UserLeft>(apps[0]).is_empty());
    assert!(only::<HandOf>(&mut host).is_none(), "nobody holds on");
    assert_eq!(messages::<UserLeft>(&host)[0].name, "Ann");
}

#[test]
fn over_the_papers_first_network_the_shape_stays_right() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    let emulation = Some(Emulation::preset(Preset::Paper1, 3));
    let transport = JoinOptions { emulation, ..JoinOptions::default() };
    let mut guest = guest(&invite, JoinConfig { transport, models: vec![bar()], ..JoinConfig::default() });
    let there = arrival(&mut host, &mut guest);
    let remote = *guest.world().get::<RemoteBody>(there).unwrap();

    // Around where the patch is at rest: this bar does not stretch.
    let [x, y, z] = patch_at_rest(TIP, 0.3);
    host.world_mut().spawn((Grab::new(TIP, 0.3, beside(x, y, z)), GrabOf(body)));
    // Moved once a tick, as a hand that is read in the fixed loop is.
    let drag = move |tick: Res<PliantTick>, mut grab: Single<&mut Grab>| {
        let t = tick.0 as f64 / 40.0;
        grab.target = beside(x, y + 0.12 * (2.1 * t).sin(), z + 0.1 * (3.3 * t).sin());
    };
    host.add_systems(FixedUpdate, drag.before(PliantSystems::Input));
    let (mut truth, mut shown) = (BTreeMap::new(), BTreeMap::new());
    let start = std::time::Instant::now();
    run_until(&mut [&mut host, &mut guest], 20.0, "six seconds of dragging", |apps| {
        let tick = apps[0].world().resource::<PliantTick>().0;
        truth.insert(tick, state(apps[0], body).body().q().to_vec());
        let net = apps[1].world().resource::<NetGuest>();
        if let Some((tick, state)) = net.shown(remote) {
            shown.entry(tick).or_insert_with(|| state.q.clone());
        }
        start.elapsed().as_secs_f64() > 6.0
    });
    let stats = *guest.world().resource::<NetStats>();
    let largest = truth.values().map(|q| size(q)).fold(0.0, f64::max);
    let errors: Vec<f64> =
        shown.iter().filter_map(|(tick, q)| Some(distance(truth.get(tick)?, q) / largest)).collect();
    let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    let max = errors.iter().copied().fold(0.0, f64::max);
    println!("{} ticks, rms {:.3} %, max {:.2} %, {stats:?}", errors.len(), 100.0 * rms, 100.0 * max);
    assert!(errors.len() > 60, "{} ticks seen", errors.len());
    // The path as the emulator was told: 9 % and 196 ms.
    assert!((0.03..0.18).contains(&stats.loss_in), "{stats:?}");
    assert!((190..300).contains(&stats.round_trip.as_millis()), "{stats:?}");
    // Measured 0.05-0.2 % and 0.3-1 %; a busy machine delays frames, which is loss of another kind.
    assert!(rms < 0.01 && max < 0.05, "rms {rms}, max {max}: {stats:?}");
    assert_eq!(stats.dropped.send_queue_full, 0);
}

/// What the host's hand feels, by tick.
#[derive(Resource, Default)]
struct Pulls(BTreeMap<u64, DVec3>);

#[test]
fn a_guests_hand_over_the_papers_first_network_does_not_jerk() {
    let _alone = alone();
    let (mut host, invite, _) = host(HostConfig::default());
    let transport =
        JoinOptions { emulation: Some(Emulation::preset(Preset::Paper1, 5)), ..JoinOptions::default() };
    let mut guest = guest(&invite, JoinConfig { transport, models: vec![bar()], ..JoinConfig::default() });
    let there = arrival(&mut host, &mut guest);
    let [x, y, z] = patch_at_rest(TIP, 0.3);
    let own = guest.world_mut().spawn((Grab::new(TIP, 0.3, beside(x, y, z)), GrabOf(there))).id();
    let drag = move |time: Res<Time>, mut grab: Single<&mut Grab>| {
        let t = time.elapsed_secs_f64();
        grab.target = beside(x, y + 0.12 * (2.1 * t).sin(), z + 0.1 * (3.3 * t).sin());
    };
    guest.add_systems(FixedUpdate, drag.before(PliantSystems::Input));
    run_until(&mut [&mut host, &mut guest], 5.0, "the hand takes hold", |apps| {
        only::<HandOf>(apps[0]).is_some()
    });
    let grab = only::<HandOf>(&mut host).unwrap();
    run_for(&mut [&mut host, &mut guest], 1.0);
    // Every tick of the host, also where a late frame steps two of them.
    host.init_resource::<Pulls>();
    let keep = move |tick: Res<PliantTick>, forces: Query<&GrabForce>, mut pulls: ResMut<Pulls>| {
        pulls.0.insert(tick.0, forces.get(grab).unwrap().force);
    };
    host.add_systems(FixedUpdate, keep.after(PliantSystems::Publish));
    let mut felt: Vec<(f64, DVec3)> = Vec::new();
    let start = std::time::Instant::now();
    run_until(&mut [&mut host, &mut guest], 20.0, "five seconds of dragging", |apps| {
        let (now, force) =
            (start.elapsed().as_secs_f64(), apps[1].world().get::<GrabForce>(own).unwrap().force);
        if felt.last().is_none_or(|last| last.1 != force) {
            felt.push((now, force));
        }
        now > 5.0
    });
    let truth: Vec<(f64, DVec3)> = host
        .world()
        .resource::<Pulls>()
        .0
        .iter()
        .map(|(&tick, &force)| (tick as f64 / 40.0, force))
        .collect();
    // A force that flips its sign at each step gives 4; 0.1 here on a machine that has the time.
    let ringing = |forces: &[(f64, DVec3)]| {
        let most = forces.iter().map(|f| f.1.length()).fold(0.0, f64::max);
        // Steps that follow each other: on a busy machine an app may miss its time, and a longer step is a larger difference.
        let even = forces.windows(3).filter(|f| f.windows(2).all(|pair| pair[1].0 - pair[0].0 < 0.04));
        let mut jerks: Vec<f64> = even.map(|f| (f[0].1 - 2.0 * f[1].1 + f[2].1).length()).collect();
        assert!(jerks.len() > 60, "{} steps that follow each other", jerks.len());
        jerks.sort_by(f64::total_cmp);
        // Of twenty the largest is left out.
        jerks[jerks.len() * 19 / 20] / most
    };
    println!("at the host {:.3}, at the guest {:.3}", ringing(&truth), ringing(&felt));
    assert!(
        ringing(&truth) < 0.8 && ringing(&felt) < 0.8,
        "at the host {}, at the guest {}",
        ringing(&truth),
        ringing(&felt)
    );
}

#[test]
fn one_at_a_time_means_one_at_a_time() {
    let _alone = alone();
    let (mut host, invite, _) = host(HostConfig { holding: Holding::OneAtATime, ..HostConfig::default() });
    let mut first = guest(&invite, JoinConfig::default());
    let body = arrival(&mut host, &mut first);
    let mut second = guest(&invite, JoinConfig { models: vec![bar()], ..JoinConfig::default() });
    let other = arrival(&mut host, &mut second);
    let held = first.world_mut().spawn((Grab::new(TIP, 0.2, DVec3::Y), GrabOf(body))).id();
    run_until(&mut [&mut host, &mut first], 3.0, "the first holds", |apps| only::<HandOf>(apps[0]).is_some());
    let refused = second.world_mut().spawn((Grab::new(TIP, 0.2, DVec3::Y), GrabOf(other))).id();
    run_until(&mut [&mut host, &mut first, &mut second], 3.0, "the second is refused", |apps| {
        messages::<GrabRefused>(apps[2]) == [GrabRefused { entity: refused }]
    });
    first.world_mut().despawn(held);
    run_until(&mut [&mut host, &mut first], 3.0, "the first lets go", |apps| {
        only::<HandOf>(apps[0]).is_none()
    });
    second.world_mut().despawn(refused);
    second.world_mut().spawn((Grab::new(TIP, 0.2, DVec3::Y), GrabOf(other)));
    run_until(&mut [&mut host, &mut second], 3.0, "the second holds", |apps| {
        only::<HandOf>(apps[0]).is_some()
    });
}

#[test]
fn bodies_that_go_and_hosts_that_end_are_told() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    // One that does not wait for a host that has gone.
    let mut guest = guest(&invite, JoinConfig { rejoin: Duration::ZERO, ..JoinConfig::default() });
    // The app has made an entity for the body itself.
    let own = guest.world_mut().spawn((SharedBody::named("bar"), Transform::from_xyz(5.0, 0.0, 0.0))).id();
    let there = arrival(&mut host, &mut guest);
    assert_eq!(there, own);
    assert_eq!(
        guest.world().get::<Transform>(own).unwrap().translation.x,
        5.0,
        "placed by its app, not by the host"
    );

    host.world_mut().despawn(body);
    run_until(&mut [&mut host, &mut guest], 3.0, "the body has left", |apps| {
        !messages::<BodyLeft>(apps[1]).is_empty()
    });
    assert!(guest.world().get::<RemoteBody>(own).is_none());
    assert!(guest.world().get_entity(own).is_ok(), "the app's own entity stays");

    drop(host);
    run_until(&mut [&mut guest], 3.0, "the end of the host", |apps| {
        matches!(state_of(apps[0]), GuestState::Closed { .. })
    });
    run_for(&mut [&mut guest], 0.1);
}

#[test]
fn a_guest_that_talks_nonsense_is_sent_away_and_the_others_notice_nothing() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    let mut good = guest(&invite, JoinConfig::default());
    let there = arrival(&mut host, &mut good);
    let bad: Vec<Endpoint> =
        (0..3).map(|_| Endpoint::join(&invite, JoinOptions::default()).unwrap()).collect();
    let rejected = |host: &App| host.world().resource::<NetStats>().rejected;
    assert_eq!(rejected(&host), 0);
    let mut closed = [false; 3];
    let mut state = 1u64;
    run_until(&mut [&mut host, &mut good], 5.0, "nonsense is answered with a goodbye", |_| {
        for (i, endpoint) in bad.iter().enumerate() {
            for _ in 0..20 {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                let noise: Vec<u8> = (0..state >> 56).map(|k| (state >> (k % 56)) as u8 ^ k as u8).collect();
                endpoint.send_datagram(PeerId::HOST, Bytes::from(noise)).ok();
            }
            // Of the session, unreadable; of no kind; a placement, which no guest may send.
            let message = [&b"\x00\xff\xff\xff"[..], b"\x63nonsense", b"\x01\x01\x00"][i];
            endpoint.send_message(PeerId::HOST, Bytes::copy_from_slice(message)).ok();
            while let Some(event) = endpoint.poll() {
                closed[i] |= matches!(event, Event::Closed { .. });
            }
        }
        closed == [true; 3]
    });
    host.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 2.6, 0.3)), GrabOf(body)));
    run_for(&mut [&mut host, &mut good], 1.5);
    // A guest is a few ticks behind, more on a busy machine: when the body is nearly at rest, what it shows is what is true.
    run_until(&mut [&mut host, &mut good], 6.0, "the good guest sees what is true", |apps| {
        let truth = self::state(apps[0], body).body().q();
        let shown = apps[1].world().get::<ShownState>(there).unwrap().q();
        distance(truth, shown) < 0.02 * size(truth) && size(truth) > 0.1
    });
    // What was refused stays counted though those who said it are gone.
    assert!(rejected(&host) >= 3, "{} of the host", rejected(&host));
    assert_eq!(host.world().resource::<NetStats>().peers, 1);
}

#[test]
fn targets_out_of_reach_are_drawn_in() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig { reach: 1.0, ..HostConfig::default() });
    let mut guest = guest(&invite, JoinConfig::default());
    let there = arrival(&mut host, &mut guest);
    guest.world_mut().spawn((Grab::new(TIP, 0.2, DVec3::new(1e8, 0.0, 0.0)), GrabOf(there)));
    run_until(&mut [&mut host, &mut guest], 3.0, "the hand takes hold", |apps| {
        only::<HandOf>(apps[0]).is_some()
    });
    run_for(&mut [&mut host, &mut guest], 0.5);
    let grab = only::<HandOf>(&mut host).unwrap();
    let target = host.world().get::<Grab>(grab).unwrap().target;
    // The bar is 1 m long and shown at twice that; its middle is 1 m from the origin of its entity.
    assert!(target.distance(DVec3::Y) <= 1.0 + 2.0 + 0.1, "{target}");
    assert!(size(state(&host, body).body().q()).is_finite());
    // A second hand with a patch as large as a house is refused.
    let refused = guest.world_mut().spawn((Grab::new(TIP, 50.0, DVec3::Y), GrabOf(there))).id();
    run_until(&mut [&mut host, &mut guest], 3.0, "the patch is refused", |apps| {
        messages::<GrabRefused>(apps[1]) == [GrabRefused { entity: refused }]
    });
}

#[test]
fn the_guests_assets_are_the_cache() {
    let _alone = alone();
    let (mut host, invite, _) = host(HostConfig::default());
    let mut guest = guest(&invite, JoinConfig::default());
    let handle = guest.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(bar()));
    let there = arrival(&mut host, &mut guest);
    assert_eq!(
        guest.world().get::<pliant_body::ModalBody>(there).unwrap().model,
        handle,
        "the loaded asset is used"
    );
    let bytes = guest.world().resource::<NetStats>().bytes_in;
    assert!(bytes < bar().file_bytes() as u64, "{bytes} bytes came, the model has {}", bar().file_bytes());
}
