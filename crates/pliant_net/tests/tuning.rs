//! A body whose settings change while it is shared, and sessions that are left.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod support;

use std::time::Duration;

use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_body::{BodyState, Grab, GrabForce, GrabOf, ModalBody, ShownState};
use pliant_net::{
    BodyArrived, BodyLeft, GuestState, HandOf, HostConfig, JoinConfig, NetGuest, NetHost, RemoteBody,
    UserLeft,
};
use support::{TIP, alone, guest, host, messages, only, run_for, run_until};

fn arrival(host: &mut App, guest: &mut App) -> Entity {
    let mut found = None;
    run_until(&mut [host, guest], 5.0, "the body arrives", |apps| {
        found = only::<RemoteBody>(apps[1]).filter(|&body| apps[1].world().get::<ShownState>(body).is_some());
        found.is_some()
    });
    found.unwrap()
}

fn closed(app: &App) -> Option<String> {
    match app.world().resource::<NetGuest>().state() {
        GuestState::Closed { reason } => Some(reason.clone()),
        _ => None,
    }
}

#[test]
fn a_guest_follows_a_body_that_its_host_makes_stiffer_and_keeps_its_hand_on_it() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    let mut guest = guest(&invite, JoinConfig::default());
    let there = arrival(&mut host, &mut guest);
    let own = guest.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 2.4, 0.4)), GrabOf(there))).id();
    run_until(&mut [&mut host, &mut guest], 3.0, "the hand takes hold", |apps| {
        only::<HandOf>(apps[0]).is_some()
    });
    run_for(&mut [&mut host, &mut guest], 1.5);
    let hand = only::<HandOf>(&mut host).unwrap();
    let soft = guest.world().get::<GrabForce>(own).unwrap().force.length();

    // A slider that is dragged: another number in every frame, and only the last of them counts.
    for step in 0..40 {
        host.world_mut().get_mut::<ModalBody>(body).unwrap().stiffness_scale =
            1.0 + 3.0 * f64::from(step) / 39.0;
        run_for(&mut [&mut host, &mut guest], 0.01);
    }
    run_for(&mut [&mut host, &mut guest], 2.5);
    assert_eq!(guest.world().get::<ModalBody>(there).unwrap().stiffness_scale, 4.0);
    assert_eq!(messages::<BodyArrived>(&guest).len(), 1, "the same body all along");
    assert!(messages::<BodyLeft>(&guest).is_empty());
    assert_eq!(only::<HandOf>(&mut host), Some(hand), "the same hand all along");
    let truth = host.world().get::<BodyState>(body).unwrap();
    assert_eq!(truth.body().config().stiffness_scale, 4.0);
    let shown = guest.world().get::<ShownState>(there).unwrap().q();
    let size = truth.body().q().iter().map(|q| q * q).sum::<f64>().sqrt();
    let off = truth.body().q().iter().zip(shown).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    assert!(size > 0.05 && off < 0.02 * size, "{off} of {size}");
    // The hand pulls as far: against springs that are all four times as stiff.
    let stiff = guest.world().get::<GrabForce>(own).unwrap().force.length();
    let true_force = host.world().get::<GrabForce>(hand).unwrap().force.length();
    assert!((stiff / true_force - 1.0).abs() < 0.02, "felt {stiff} N, truly {true_force} N");
    assert!((stiff / soft - 4.0).abs() < 0.4, "{soft} N, then {stiff} N");
}

#[test]
fn a_guest_that_leaves_is_gone_at_once_and_does_not_come_back() {
    let _alone = alone();
    let (mut host, invite, _) = host(HostConfig::default());
    let mut guest = guest(&invite, JoinConfig::default());
    let there = arrival(&mut host, &mut guest);
    guest.world_mut().resource_mut::<NetGuest>().leave();
    run_until(&mut [&mut host, &mut guest], 2.0, "both ends know", |apps| {
        closed(apps[1]).is_some() && !messages::<UserLeft>(apps[0]).is_empty()
    });
    assert_eq!(closed(&guest).as_deref(), Some("left"));
    assert_eq!(messages::<UserLeft>(&host)[0].reason, "left");
    run_for(&mut [&mut host, &mut guest], 1.0);
    assert_eq!(host.world().resource::<NetHost>().guests().count(), 0);
    assert!(guest.world().get_entity(there).is_ok(), "the body stands as it was last seen");
}

#[test]
fn a_host_that_ends_its_session_sends_everybody_away_and_lets_nobody_in() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    let join = || JoinConfig { rejoin: Duration::ZERO, ..JoinConfig::default() };
    let mut guest = support::guest(&invite, join());
    arrival(&mut host, &mut guest);
    host.world_mut().resource_mut::<NetHost>().end();
    assert!(host.world().resource::<NetHost>().has_ended());
    run_until(&mut [&mut host, &mut guest], 3.0, "the guest is away", |apps| closed(apps[1]).is_some());
    let mut late = support::guest(&invite, join());
    run_until(&mut [&mut host, &mut late], 5.0, "the next one is refused", |apps| closed(apps[1]).is_some());
    assert_eq!(host.world().resource::<NetHost>().guests().count(), 0);
    assert!(host.world().get::<BodyState>(body).is_some(), "its body goes on");
}
