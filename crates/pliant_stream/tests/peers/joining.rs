//! How peers join, get their numbers, and are turned away.

use std::time::Duration;

use pliant_modal::{FixedObstacle, FixedShape};
use pliant_stream::emulator::{LinkConfig, Preset};
use pliant_stream::peer::{LateInputRepair, PeerEvent, PeerSession, PeerSessionConfig};
use pliant_stream::wire::{PROTOCOL_VERSION, PeerMessage};
use pliant_stream::{Channel, DisconnectReason, PeerId, StepSettings, StreamError, Surroundings, UserId};

use super::mesh::Mesh;
use super::support::{bar, loose_bar};
use super::{BODY, MS, S, floor};

fn lone(user: UserId, founds: bool) -> PeerSession {
    let address = format!("address of {}", user.0);
    let mut p = PeerSession::new(PeerSessionConfig { user, founds, address, ..Default::default() }).unwrap();
    p.add_body(BODY, bar(4, 0.05), &StepSettings::default()).unwrap();
    p
}

/// Delivers the messages of `from`, which `to` knows as `peer`. Returns their number.
fn deliver(from: &mut PeerSession, to: &mut PeerSession, peer: PeerId) -> usize {
    let messages = std::iter::from_fn(|| from.poll_output()).filter(|out| out.channel == Channel::Message);
    messages.map(|out| to.on_message(100 * MS, peer, &out.bytes)).count()
}

#[test]
fn peers_among_other_obstacles_are_turned_away_and_bad_ones_are_refused() {
    let new = |around: &Surroundings| {
        let mut peer = PeerSession::new(PeerSessionConfig::default()).unwrap();
        peer.add_body(BODY, loose_bar(2, 0.05), &StepSettings::default()).unwrap();
        peer.set_surroundings(BODY, around.clone()).map(|()| peer.scene())
    };
    let ground = new(&floor()).unwrap();
    assert_eq!(new(&floor()).unwrap(), ground);
    assert_ne!(new(&Surroundings::default()).unwrap(), ground);
    assert_ne!(new(&Surroundings { friction: 0.4, ..floor() }).unwrap(), ground);
    let with = |shape, count| Surroundings {
        obstacles: vec![FixedObstacle { shape, ..FixedObstacle::GROUND }; count],
        ..Surroundings::default()
    };
    assert!(new(&with(FixedShape::Plane, 256)).is_ok());
    assert!(matches!(new(&with(FixedShape::Plane, 257)), Err(StreamError::Full { limit: 256, .. })));
    for bad in [
        with(FixedShape::Ball { radius: f64::NAN }, 1),
        with(FixedShape::Box { half: [1.0, -1.0, 1.0], round: 0.0 }, 1),
        with(FixedShape::Capsule { radius: 1e300, half_length: 1.0 }, 1),
        Surroundings { friction: f64::NAN, ..floor() },
        Surroundings { friction: 11.0, ..floor() },
    ] {
        assert!(matches!(new(&bad), Err(StreamError::Model(_))), "{bad:?}");
    }
}

#[test]
fn peers_with_other_settings_are_turned_away() {
    let link = LinkConfig { delay: 20 * MS, ..Default::default() };
    let mut mesh = Mesh::new(2, &link, 3);
    mesh.start(0, LateInputRepair::Rollback, true);
    mesh.settings.stiffness_scale = 2.0;
    mesh.start(1, LateInputRepair::Rollback, true);
    mesh.run(S);
    let turned = |k: usize| {
        let away = |e: &(usize, PeerEvent)| matches!(e, (at, PeerEvent::TurnedAway { reason: DisconnectReason::SceneMismatch, .. }) if *at == k);
        mesh.events.iter().any(away)
    };
    assert!(turned(0) && turned(1), "{:?}", mesh.events);
}

#[test]
fn late_joiner_takes_the_state_of_another_and_follows() {
    let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper2), 5);
    mesh.start(0, LateInputRepair::Rollback, true);
    mesh.start(1, LateInputRepair::Rollback, true);
    mesh.run(10 * S);
    mesh.start(2, LateInputRepair::Rollback, false);
    mesh.run(20 * S);
    assert!(mesh.events.contains(&(2, PeerEvent::Started)));
    assert!(mesh.agree(0, 2) < 1e-9, "{}", mesh.agree(0, 2));
    assert!(mesh.agree(0, 1) < 1e-9);
    let late = mesh.peers[2].as_ref().unwrap();
    assert_eq!(late.body(BODY).unwrap().grabs().len(), 3, "all three hold on");
}

#[test]
fn those_who_come_before_the_first_step_get_a_state_too() {
    let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Lan), 5);
    for peer in 0..3 {
        mesh.start(peer, LateInputRepair::Rollback, peer == 0);
    }
    mesh.run(3 * S);
    let ticks: Vec<u64> = mesh.peers.iter().flatten().map(PeerSession::tick).collect();
    assert!(ticks.iter().all(|tick| tick.abs_diff(120) <= 2), "{ticks:?}");
    let confirmed: Vec<u64> = mesh.peers.iter().flatten().map(PeerSession::confirmed).collect();
    assert!(confirmed.iter().all(|tick| *tick > 110), "{confirmed:?}");
    assert_eq!(mesh.agree(0, 1), 0.0);
    assert_eq!(mesh.agree(0, 2), 0.0);
}

#[test]
fn a_peer_under_another_number_than_the_one_it_was_given_is_turned_away() {
    // Under number 1 the peer's state would override all others.
    for claimed in [0, 1, 3, 9] {
        let config = PeerSessionConfig { user: UserId(3), ..Default::default() };
        let mut p = PeerSession::new(config).unwrap();
        p.add_body(BODY, bar(4, 0.05), &StepSettings::default()).unwrap();
        p.connect(Duration::ZERO, PeerId(7), UserId(8), 1200).unwrap();
        let scene = p.scene();
        let hello = |user| PeerMessage::Hello {
            version: PROTOCOL_VERSION,
            user,
            name: "other".into(),
            address: String::new(),
            joining: false,
            scene,
        };
        p.on_message(MS, PeerId(7), &hello(claimed).encode());
        let turned = PeerEvent::TurnedAway { peer: PeerId(7), reason: DisconnectReason::Protocol };
        assert_eq!(p.poll_event(), Some(turned), "as {claimed}");
        // A second, correct hello does not help either.
        p.on_message(MS, PeerId(7), &hello(8).encode());
        assert_eq!((p.poll_event(), p.user_of(PeerId(7))), (None, None));
        p.connect(MS, PeerId(9), UserId(8), 1200).unwrap();
        p.on_message(MS, PeerId(9), &hello(8).encode());
        assert!(matches!(p.poll_event(), Some(PeerEvent::Joined { user: UserId(8), .. })));
        assert_eq!(p.user_of(PeerId(9)), Some(UserId(8)));
    }
    assert!(PeerSession::new(PeerSessionConfig { user: UserId::HOST, ..Default::default() }).is_err());
}

#[test]
fn a_new_peer_is_given_its_number_and_those_who_come_before_wait_for_it() {
    let (mut first, mut new, mut early) =
        (lone(UserId(1), true), lone(UserId::HOST, false), lone(UserId(3), false));
    for k in 0..10 {
        first.update(25 * MS * k);
    }
    while first.poll_output().is_some() {}
    new.connect(Duration::ZERO, PeerId(1), None, 1200).unwrap();
    first.accept(Duration::ZERO, PeerId(2), 1200).unwrap();
    // Another peer was told of the new one before the new one has its number.
    early.connect(Duration::ZERO, PeerId(2), UserId(2), 1200).unwrap();
    new.accept(Duration::ZERO, PeerId(3), 1200).unwrap();
    assert_eq!(deliver(&mut early, &mut new, PeerId(3)), 1);
    // It cannot give the new peer a number either, which has not asked it.
    let mut liar = lone(UserId::HOST, false);
    liar.accept(Duration::ZERO, PeerId(3), 1200).unwrap();
    early.disconnect(PeerId(2), DisconnectReason::Left);
    early.connect(Duration::ZERO, PeerId(2), UserId(2), 1200).unwrap();
    deliver(&mut early, &mut liar, PeerId(3));
    liar.on_message(MS, PeerId(3), &PeerMessage::Welcome { user: 9, others: Vec::new() }.encode());
    let turned = PeerEvent::TurnedAway { peer: PeerId(3), reason: DisconnectReason::Protocol };
    assert_eq!(liar.poll_event(), Some(turned));

    assert_eq!(deliver(&mut new, &mut first, PeerId(2)), 1, "the new peer greets only whom it asks");
    assert_eq!(first.poll_event(), Some(PeerEvent::JoinRequest { peer: PeerId(2) }));
    assert!(first.welcome(PeerId(2), UserId(1), &[]).is_err(), "the first peer's own number");
    let others = [(UserId(3), "there".to_owned())];
    first.welcome(PeerId(2), UserId(2), &others).unwrap();
    assert_eq!(first.user_of(PeerId(2)), Some(UserId(2)));
    first.update(300 * MS);
    assert_eq!(deliver(&mut first, &mut new, PeerId(1)), 3, "hello, welcome and state");
    assert_eq!(new.poll_event(), Some(PeerEvent::Welcomed { user: UserId(2), others: others.to_vec() }));
    assert_eq!((new.user_of(PeerId(1)), new.user_of(PeerId(3))), (Some(UserId(1)), Some(UserId(3))));
    assert!(new.tick() > 0, "it has the state");
    // The peer that waited is answered under the new number.
    assert_eq!(deliver(&mut new, &mut early, PeerId(2)), 1);
    assert_eq!(early.user_of(PeerId(2)), Some(UserId(2)));
}

#[test]
fn a_peer_that_never_says_hello_is_told_of_when_it_goes() {
    let mut p = PeerSession::new(PeerSessionConfig::default()).unwrap();
    p.add_body(BODY, bar(4, 0.05), &StepSettings::default()).unwrap();
    assert!(p.connect(Duration::ZERO, PeerId(7), UserId::HOST, 1200).is_err());
    assert!(p.connect(Duration::ZERO, PeerId(7), UserId(1), 1200).is_err(), "our own");
    p.connect(Duration::ZERO, PeerId(7), UserId(2), 1200).unwrap();
    p.update(9 * S);
    assert_eq!(p.poll_event(), None);
    p.update(11 * S);
    let turned = PeerEvent::TurnedAway { peer: PeerId(7), reason: DisconnectReason::Silent };
    assert_eq!(p.poll_event(), Some(turned));
}
