//! Peers tell each other with whom they are connected, so that two that have lost each other find
//! each other again.

use crate::support;

use std::time::Duration;

use pliant_stream::peer::{PeerEvent, PeerSession, PeerSessionConfig};
use pliant_stream::wire::PeerMessage;
use pliant_stream::{BodyId, Channel, DisconnectReason, PeerId, StepSettings, StreamError, UserId};
use support::bar;

const S: Duration = Duration::from_secs(1);

fn peer(user: u16) -> PeerSession {
    let config = PeerSessionConfig { user: UserId(user), founds: true, ..Default::default() };
    let mut peer = PeerSession::new(config).unwrap();
    peer.add_body(BodyId(1), bar(40, 0.05), &StepSettings::default()).unwrap();
    peer
}

/// Brings the messages of one peer to another, and returns how many tell of others. Those for
/// connections from 10 on are for somebody else.
fn deliver(now: Duration, from: &mut PeerSession, to: &mut PeerSession, name: PeerId) -> usize {
    let mut lists = 0;
    while let Some(output) = from.poll_output() {
        if output.channel == Channel::Message && output.peer.0 < 10 {
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
        deliver(Duration::ZERO, &mut first, &mut second, one);
        deliver(Duration::ZERO, &mut second, &mut first, two);
    }
    let mut lists = Vec::new();
    for half in 1..20 {
        let now = half * S / 2;
        let list = if half < 8 { vec![name(2)] } else { vec![name(2), name(3), name(4)] };
        first.introduce(&list).unwrap();
        first.update(now);
        second.update(now);
        lists.push(deliver(now, &mut first, &mut second, one));
        deliver(now, &mut second, &mut first, two);
    }
    assert_eq!(lists.iter().sum::<usize>(), 2, "{lists:?}");
    let lists = introduced(&mut second);
    assert_eq!(lists.len(), 1, "the first list has nobody whom the second lacks: {lists:?}");
    assert_eq!(lists[0], [name(3), name(4)]);
}

#[test]
fn who_has_left_and_comes_back_is_told_of_again_under_the_same_list() {
    let (mut first, mut second, mut third) = (peer(1), peer(2), peer(3));
    let (one, two) = (PeerId(1), PeerId(2));
    first.connect(Duration::ZERO, two, None, 1200).unwrap();
    second.accept(Duration::ZERO, one, 1200).unwrap();
    for _ in 0..2 {
        deliver(Duration::ZERO, &mut first, &mut second, one);
        deliver(Duration::ZERO, &mut second, &mut first, two);
    }
    let list = [2, 3].map(|user| (UserId(user), String::new()));
    let mut lists = Vec::new();
    for round in 1..5_u64 {
        let now = 21 * S / 10 * round as u32;
        // The third is there anew each time, under another connection.
        let three = PeerId(10 + round);
        first.connect(now, three, None, 1200).unwrap();
        third.accept(now, one, 1200).unwrap();
        for _ in 0..2 {
            while let Some(output) = first.poll_output() {
                if output.channel == Channel::Message && output.peer == three {
                    third.on_message(now, one, &output.bytes);
                }
            }
            while let Some(output) = third.poll_output() {
                if output.channel == Channel::Message {
                    first.on_message(now, three, &output.bytes);
                }
            }
        }
        assert_eq!(first.user_of(three), Some(UserId(3)));
        // The app hears of the end and of the beginning in one look, and its list is as before.
        first.introduce(&list).unwrap();
        first.update(now);
        second.update(now);
        lists.push(deliver(now, &mut first, &mut second, one));
        deliver(now, &mut second, &mut first, two);
        first.disconnect(three, DisconnectReason::Lost);
        third.disconnect(one, DisconnectReason::Lost);
        third.introduce(&[]).unwrap();
    }
    assert_eq!(lists, [1; 4], "each time it comes, the second is told");
}

#[test]
fn lists_in_a_flood_are_left_out_and_long_addresses_refused() {
    let (mut first, mut second) = (peer(1), peer(2));
    let (one, two) = (PeerId(1), PeerId(2));
    first.connect(Duration::ZERO, two, None, 1200).unwrap();
    second.accept(Duration::ZERO, one, 1200).unwrap();
    for _ in 0..2 {
        deliver(Duration::ZERO, &mut first, &mut second, one);
        deliver(Duration::ZERO, &mut second, &mut first, two);
    }
    let list = PeerMessage::Others { others: vec![(7, "seven".into()), (2, "itself".into())] }.encode();
    for k in 0..1000u32 {
        second.on_message(S + k * Duration::from_millis(2), one, &list);
    }
    let lists = introduced(&mut second);
    assert!((4..=5).contains(&lists.len()), "two a second for two seconds: {}", lists.len());
    assert!(lists.iter().all(|others| *others == [(UserId(7), "seven".to_owned())]), "{lists:?}");
    let long = first.introduce(&[(UserId(3), "x".repeat(513))]);
    assert!(matches!(long, Err(StreamError::Config { what: "address", .. })), "{long:?}");
}
