//! Tests of the queues, each on one thread.

use std::collections::BTreeMap;
use std::time::Instant;

use bytes::Bytes;

use super::carrier::Event;
use super::queue::*;
use super::{DisconnectReason, PeerId};

fn bytes(n: u8) -> Bytes {
    Bytes::copy_from_slice(&[n])
}

fn left(peer: PeerId) -> Event {
    Event::Closed { peer, reason: DisconnectReason::Silent }
}

#[test]
fn a_full_queue_lets_the_oldest_datagram_go_and_says_so() {
    let outbox = Outbox::default();
    let dropped: u64 = (0..10).map(|n| outbox.push_datagram(bytes(n), 4)).sum();
    assert_eq!(dropped, 6);
    let kept: Vec<_> = std::iter::from_fn(|| outbox.pop_datagram()).map(|b| b[0]).collect();
    assert_eq!(kept, [6, 7, 8, 9]);
}

#[test]
fn a_flood_from_one_peer_does_not_hide_another() {
    let inbox = Inbox::default();
    let now = Instant::now();
    for peer in [PeerId(1), PeerId(2)] {
        inbox.open(peer, left(peer));
        inbox.pop().unwrap();
    }
    let dropped: u64 = (0..1000).map(|n| inbox.push_datagram(PeerId(1), now, bytes(n as u8), 64)).sum();
    assert_eq!(dropped, 1000 - 64);
    inbox.push_datagram(PeerId(2), now, bytes(7), 64);
    let first_two: Vec<_> = (0..2)
        .map(|_| match inbox.pop() {
            Some(Event::Datagram { peer, .. }) => peer.0,
            other => panic!("{other:?}"),
        })
        .collect();
    assert!(first_two.contains(&2), "{first_two:?}");
}

fn from(event: Option<Event>) -> Option<PeerId> {
    event.map(|event| match event {
        Event::Connected { peer, .. }
        | Event::Closed { peer, .. }
        | Event::Message { peer, .. }
        | Event::Datagram { peer, .. } => peer,
    })
}

#[test]
fn a_queue_of_messages_delays_nobody_elses() {
    let inbox = Inbox::default();
    let (stranger, guest) = (PeerId(1), PeerId(2));
    inbox.open(stranger, left(stranger));
    inbox.pop().unwrap();
    let five = Bytes::from_static(&[4, 1, 1, 12, 0]);
    let queued = (0..100_000).filter(|_| inbox.push_message(stranger, five.clone(), 64 << 20).is_ok());
    assert_eq!(queued.count(), 100_000);
    assert!(!inbox.overloaded(), "messages refuse no new guest");
    inbox.open(guest, left(guest));
    inbox.push_message(guest, bytes(0), 64 << 20).unwrap();
    inbox.push_datagram(guest, Instant::now(), bytes(1), 64);
    let turns: Vec<_> = (0..6).map_while(|_| from(inbox.pop())).collect();
    assert_eq!(turns.iter().filter(|peer| **peer == guest).count(), 3, "{turns:?}");
}

#[test]
fn messages_wait_for_the_next_frame_after_enough_work_and_hands_move_on() {
    let inbox = Inbox::default();
    let (first, second) = (PeerId(1), PeerId(2));
    for peer in [first, second] {
        inbox.open(peer, left(peer));
        inbox.pop().unwrap();
    }
    for peer in [first, second, first, second] {
        inbox.push_message(peer, bytes(0), 64 << 20).unwrap();
        inbox.push_datagram(peer, Instant::now(), bytes(1), 64);
    }
    // What is read in each frame, and what each message of it costs.
    for (messages, datagrams, work) in [(1, 4, WORK_IN_A_FRAME), (1, 0, 1 << 40), (2, 0, WORK_IN_A_FRAME / 2)]
    {
        inbox.begin_frame();
        let mut read = (0, 0);
        while let Some(event) = inbox.pop_in_frame() {
            if matches!(event, Event::Message { .. }) {
                inbox.charge(work);
                read.0 += 1;
            } else {
                read.1 += 1;
            }
        }
        assert_eq!(read, (messages, datagrams));
    }
    inbox.begin_frame();
    assert!(inbox.pop_in_frame().is_none());
}

#[test]
fn a_frame_reads_a_share_of_each_peer_and_no_more_than_its_budget() {
    let inbox = Inbox::default();
    let full = Bytes::from(vec![2; 1155]);
    let fill = || {
        for peer in (1..=40).map(PeerId) {
            for _ in 0..64 {
                inbox.push_datagram(peer, Instant::now(), full.clone(), 64);
            }
        }
    };
    for peer in (1..=40).map(PeerId) {
        inbox.open(peer, left(peer));
        inbox.pop().unwrap();
    }
    let mut read = BTreeMap::<PeerId, usize>::new();
    for _ in 0..20 {
        fill();
        inbox.begin_frame();
        let turns: Vec<PeerId> = std::iter::from_fn(|| from(inbox.pop_in_frame())).collect();
        assert!(turns.len() <= READ_IN_A_FRAME / 74 + 1, "{} datagrams in a frame", turns.len());
        turns.into_iter().for_each(|peer| *read.entry(peer).or_default() += 1);
    }
    let (least, most) = (read.values().min().unwrap(), read.values().max().unwrap());
    assert!(read.len() == 40 && most - least <= 1, "{read:?}");
    // Alone, a peer has no more than its share, and the rest comes in the next frame.
    let alone = Inbox::default();
    alone.open(PeerId(1), left(PeerId(1)));
    alone.pop().unwrap();
    for _ in 0..64 {
        alone.push_datagram(PeerId(1), Instant::now(), full.clone(), 64);
    }
    for _ in 0..2 {
        alone.begin_frame();
        let count = std::iter::from_fn(|| alone.pop_in_frame()).count();
        assert!(count > 0 && count <= READ_OF_A_PEER / 74 + 1, "{count}");
    }
    assert_eq!(std::iter::from_fn(|| alone.pop()).count(), 64 - 2 * (READ_OF_A_PEER / 74 + 1));
}

#[test]
fn messages_are_given_back_rather_than_dropped() {
    let inbox = Inbox::default();
    let peer = PeerId(3);
    inbox.open(peer, left(peer));
    let large = Bytes::from(vec![0; 5000]);
    // The first message is accepted whatever its length, and the second waits for room.
    assert!(inbox.push_message(peer, large.clone(), 1000).is_ok());
    assert_eq!(inbox.push_message(peer, large.clone(), 1000).unwrap_err().len(), 5000);
    while inbox.pop().is_some() {}
    assert!(inbox.push_message(peer, large.clone(), 1000).is_ok());
    let outbox = Outbox::default();
    assert!(outbox.push_message(large.clone(), 1000));
    assert!(!outbox.push_message(large.clone(), 1000));
    assert!(matches!(outbox.next(), Some(Next::Message(_))));
    assert!(outbox.push_message(large, 1000));
    // Queued messages go out before the close, and no message is accepted after it.
    outbox.close(DisconnectReason::Full);
    assert!(!outbox.push_message(bytes(0), 1000));
    assert!(matches!(outbox.next(), Some(Next::Message(_))));
    assert!(matches!(outbox.next(), Some(Next::Close(DisconnectReason::Full))));
    assert!(outbox.next().is_none());
}
