//! Tests of bodies whose settings change while they are shared, and of sessions that end
//! deliberately.

use crate::support;

use std::time::Duration;

use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_body::{BodyState, Grab, GrabForce, GrabOf, ModalBody, VisualState};
use pliant_net::transport::Limits;
use pliant_net::{
    BodyArrived, BodyLeft, HandOf, HostConfig, JoinConfig, JoinOptions, NetHost, SessionClosed,
    SessionCommands, SessionFailed, SessionLost, SessionState, UserLeft,
};
use pliant_stream::DisconnectReason;
use support::{
    TIP, alone, arrival, body_of, guest, host, messages, must, only, rests, run_frames, run_until,
};

fn closed(app: &App) -> Option<DisconnectReason> {
    messages::<SessionClosed>(app).last().map(|closed| closed.reason)
}

fn state(app: &App) -> SessionState {
    *app.world().resource::<SessionState>()
}

#[test]
fn a_guest_follows_a_body_that_its_host_makes_stiffer_and_keeps_its_hand_on_it() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    let mut guest = guest(&invite, JoinConfig::default());
    let there = arrival(&mut host, &mut guest);
    let own = guest.world_mut().spawn((Grab::new(TIP, 0.3, DVec3::new(1.2, 2.4, 0.4)), GrabOf(there))).id();
    let hand = run_until(&mut [&mut host, &mut guest], "the hand takes hold", |apps| only::<HandOf>(apps[0]));
    // The force that the guest displays must match the host's force, once the body rests and the
    // guest shows it correctly.
    let felt_at_rest = |apps: &mut [&mut App]| {
        let truth = apps[0].world().get::<BodyState>(body).unwrap().body().q();
        let shown = apps[1].world().get::<VisualState>(there).unwrap().q();
        let size = truth.iter().map(|q| q * q).sum::<f64>().sqrt();
        let off = truth.iter().zip(shown).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        must!(size > 0.05 && off < 0.02 * size, "{off} of {size}");
        must!(rests(apps[0], body, size), "it still moves");
        let felt = apps[1].world().get::<GrabForce>(own).unwrap().force.length();
        let true_force = apps[0].world().get::<GrabForce>(hand).unwrap().force.length();
        must!((felt / true_force - 1.0).abs() < 0.02, "felt {felt} N, truly {true_force} N");
        Ok(felt)
    };
    let soft = run_until(&mut [&mut host, &mut guest], "the guest feels the soft body", felt_at_rest);

    // Dragging a slider changes the value in every frame, and only the last value counts.
    for step in 0..40 {
        host.world_mut().get_mut::<ModalBody>(body).unwrap().settings.stiffness_scale =
            1.0 + 3.0 * f64::from(step) / 39.0;
        run_frames(&mut [&mut host, &mut guest], 1);
    }
    // The hand pulls as far as before, against springs that are all four times as stiff.
    run_until(&mut [&mut host, &mut guest], "the guest feels the stiff body", |apps| {
        must!(apps[1].world().get::<ModalBody>(there).unwrap().settings.stiffness_scale == 4.0);
        must!(
            apps[0].world().get::<BodyState>(body).unwrap().body().config().settings.stiffness_scale == 4.0
        );
        let stiff = felt_at_rest(apps)?;
        must!((stiff / soft - 4.0).abs() < 0.4, "{soft} N, then {stiff} N");
        Ok(())
    });
    assert_eq!(messages::<BodyArrived>(&guest).len(), 1, "the same body all along");
    assert!(messages::<BodyLeft>(&guest).is_empty());
    assert_eq!(only::<HandOf>(&mut host), Some(hand), "the same hand all along");
}

#[test]
fn a_guest_that_leaves_is_gone_at_once_and_does_not_come_back() {
    let _alone = alone();
    let (mut host, invite, _) = host(HostConfig::default());
    let mut guest = guest(&invite, JoinConfig::default());
    let there = arrival(&mut host, &mut guest);
    guest.world_mut().commands().leave_session();
    run_until(&mut [&mut host, &mut guest], "both ends know", |apps| {
        closed(apps[1]).is_some() && !messages::<UserLeft>(apps[0]).is_empty()
    });
    assert_eq!(closed(&guest), Some(DisconnectReason::Left));
    assert_eq!(messages::<UserLeft>(&host)[0].reason, DisconnectReason::Left);
    // The time until another guest has joined and has its body is enough for the first guest to
    // come back.
    let mut other = support::guest(&invite, JoinConfig::default());
    run_until(&mut [&mut host, &mut other, &mut guest], "another one joins", |apps| body_of(apps[1]));
    run_frames(&mut [&mut host, &mut other, &mut guest], 100);
    assert_eq!(host.world().resource::<NetHost>().guests().count(), 1);
    assert_eq!((closed(&guest), state(&guest)), (Some(DisconnectReason::Left), SessionState::Idle));
    assert!(guest.world().get_entity(there).is_err(), "the session's body is gone");
}

#[test]
fn a_host_that_ends_its_session_sends_everybody_away_and_lets_nobody_in() {
    let _alone = alone();
    let (mut host, invite, body) = host(HostConfig::default());
    let mut guest = support::guest(&invite, JoinConfig::default());
    arrival(&mut host, &mut guest);
    host.world_mut().commands().leave_session();
    // The goodbye of the session says that nobody is to wait for this host, unlike the end of the
    // connection.
    run_until(&mut [&mut host, &mut guest], "the guest is away", |apps| closed(apps[1]));
    assert_eq!((closed(&guest), state(&guest)), (Some(DisconnectReason::Left), SessionState::Idle));
    assert!(messages::<SessionLost>(&guest).is_empty());
    let limits = Limits { handshake: Duration::from_secs(1), ..Limits::guest() };
    let transport = JoinOptions { limits, ..JoinOptions::default() };
    let config = JoinConfig { rejoin: Duration::ZERO, transport, ..JoinConfig::default() };
    let mut late = support::guest(&invite, config);
    run_until(&mut [&mut host, &mut late], "the next one does not get in", |apps| {
        !messages::<SessionFailed>(apps[1]).is_empty()
    });
    assert_eq!((state(&host), state(&late)), (SessionState::Idle, SessionState::Idle));
    assert!(host.world().get::<BodyState>(body).is_some(), "its body goes on");
}
