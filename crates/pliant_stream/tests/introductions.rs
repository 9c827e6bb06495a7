//! Peers tell each other with whom they are connected, so that two that have lost each other find
//! each other again.
#![allow(clippy::unwrap_used, missing_docs, reason = "a failed test should panic")]

mod support;

use std::time::Duration;

use pliant_stream::peer::{PeerEvent, PeerSession, PeerSessionConfig};
use pliant_stream::wire::PeerMessage;
use pliant_stream::{BodyId, Channel, PeerId, StepSettings, StreamError, UserId};
use support::bar;

const S: Duration = Duration::from_secs(1);

fn peer(user: u16) -> PeerSession {
    let config = PeerSessionConfig { user: UserId(user), founds: true, ..Default::default() };
    let mut peer = PeerSession::new(config).unwrap();
    peer.add_body(BodyId(1), bar(40, 0.05), &StepSettings::default()).unwrap();
    peer
}

/// Brings the messages of one peer to another, and returns how many tell of others.
fn tell(now: Duration, from: &mut PeerSession, to: &mut PeerSession, name: PeerId) -> usize {
    let mut lists = 0;
    while let Some(output) = from.poll_output() {
        if output.channel == Channel::Message {
            lists +=
                usize::from(matches!(PeerMessage::decode(&output.bytes), Ok(PeerMessage::Others { .. })));
            to.on_message(now, name, &output.bytes);
        }
    }
    lists
}

fn introduced(peer: &mut PeerSession) -> Vec<Vec<(UserId, String)>> {
    let events = std::iter::from_fn(|| peer.poll_event());
    events
        .filter_map(|event| match event {
            PeerEvent::Introduced { others, .. } => Some(others),
            _ => None,
        })
        .collect()
}

#[test]
fn a_peer_is_told_of_those_that_it_lacks_and_no_more_often_than_they_come() {
    let (mut first, mut second) = (peer(1), peer(2));
    let (one, two) = (PeerId(1), PeerId(2));
    first.connect(Duration::ZERO, two, None, 1200).unwrap();
    let name = |user: u16| (UserId(user), format!("address of {user}"));
    first.introduce(&[name(2)]).unwrap();
    second.accept(Duration::ZERO, one, 1200).unwrap();
    // Who has not said who it is is not heard.
    let early = PeerMessage::Others { others: vec![(5, String::new())] }.encode();
    second.on_message(Duration::ZERO, one, &early);
    assert_eq!(introduced(&mut second), Vec::<Vec<_>>::new());
    for _ in 0..2 {
        tell(Duration::ZERO, &mut first, &mut second, one);
        tell(Duration::ZERO, &mut second, &mut first, two);
    }
    let mut lists = Vec::new();
    for half in 1..20 {
        let now = half * S / 2;
        let list = if half < 8 { vec![name(2)] } else { vec![name(2), name(3), name(4)] };
        first.introduce(&list).unwrap();
        first.update(now);
        second.update(now);
        lists.push(tell(now, &mut first, &mut second, one));
        tell(now, &mut second, &mut first, two);
    }
    assert_eq!(lists.iter().sum::<usize>(), 2, "{lists:?}");
    let told = introduced(&mut second);
    assert_eq!(told.len(), 1, "the first list has nobody whom the second lacks: {told:?}");
    assert_eq!(told[0], [name(3), name(4)]);
}

#[test]
fn lists_in_a_flood_are_left_out_and_long_addresses_refused() {
    let (mut first, mut second) = (peer(1), peer(2));
    let (one, two) = (PeerId(1), PeerId(2));
    first.connect(Duration::ZERO, two, None, 1200).unwrap();
    second.accept(Duration::ZERO, one, 1200).unwrap();
    for _ in 0..2 {
        tell(Duration::ZERO, &mut first, &mut second, one);
        tell(Duration::ZERO, &mut second, &mut first, two);
    }
    let list = PeerMessage::Others { others: vec![(7, "seven".into()), (2, "itself".into())] }.encode();
    for k in 0..1000u32 {
        second.on_message(S + k * Duration::from_millis(2), one, &list);
    }
    let told = introduced(&mut second);
    assert!((4..=5).contains(&told.len()), "two a second for two seconds: {}", told.len());
    assert!(told.iter().all(|others| *others == [(UserId(7), "seven".to_owned())]), "{told:?}");
    let long = first.introduce(&[(UserId(3), "x".repeat(513))]);
    assert!(matches!(long, Err(StreamError::Config { what: "address", .. })), "{long:?}");
}
