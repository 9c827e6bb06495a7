//! Peers with so many bodies that a state of all of them does not fit into one message.

use crate::support;

use std::time::Duration;

use pliant_modal::GrabConfig;
use pliant_stream::peer::{PeerEvent, PeerSession, PeerSessionConfig};
use pliant_stream::wire::PeerMessage;
use pliant_stream::{BodyId, Channel, MAX_MESSAGE, PeerId, StepSettings, StreamError, UserId};
use support::bar;

const MODES: usize = 60;

/// A peer with a number of bodies.
fn peer(user: u16, bodies: u16, founds: bool) -> PeerSession {
    let config = PeerSessionConfig { user: UserId(user), founds, ..Default::default() };
    let mut peer = PeerSession::new(config).unwrap();
    let (model, settings) = (bar(MODES, 0.05), StepSettings::default());
    (1..=bodies).for_each(|id| peer.add_body(BodyId(id), model.clone(), &settings).unwrap());
    peer
}

/// Brings all that one peer sends to another. Returns the sizes of its messages, bytes.
fn bring(now: Duration, from: &mut PeerSession, to: &mut PeerSession, name: PeerId) -> Vec<usize> {
    bring_but(now, from, to, name, |_| false)
}

/// The same, but messages may be altered, and some are lost.
fn bring_but(
    now: Duration,
    from: &mut PeerSession,
    to: &mut PeerSession,
    name: PeerId,
    mut is_lost: impl FnMut(&mut PeerMessage) -> bool,
) -> Vec<usize> {
    let mut sizes = Vec::new();
    while let Some(out) = from.poll_output() {
        match out.channel {
            Channel::Datagram => to.on_datagram(now, name, &out.bytes),
            Channel::Message => {
                let mut message = PeerMessage::decode(&out.bytes).unwrap();
                if !is_lost(&mut message) {
                    let bytes = message.encode();
                    sizes.push(bytes.len());
                    to.on_message(now, name, &bytes);
                }
            }
        }
    }
    sizes
}

#[test]
fn a_peer_joins_a_session_of_a_thousand_bodies() {
    let (one, two) = (PeerId(1), PeerId(2));
    for bodies in [1, 140, 1000] {
        let (mut first, mut second) = (peer(1, bodies, true), peer(2, bodies, false));
        let held = [1, bodies / 2 + 1, bodies].map(BodyId);
        for body in held {
            // At the end of the bar, ten centimeters away.
            first.begin_grab(body, 66, 0.05, [1.0, 0.08, 0.18], GrabConfig::default()).unwrap();
        }
        let mut now = Duration::ZERO;
        for _ in 0..40 {
            now += Duration::from_millis(25);
            first.update(now);
        }
        first.connect(now, two, UserId(2), 1200).unwrap();
        second.connect(now, one, UserId(1), 1200).unwrap();
        let mut sizes = Vec::new();
        for _ in 0..20 {
            now += Duration::from_millis(25);
            first.update(now);
            second.update(now);
            sizes.extend(bring(now, &mut first, &mut second, one));
            bring(now, &mut second, &mut first, two);
        }
        let events: Vec<PeerEvent> = std::iter::from_fn(|| second.poll_event()).collect();
        let largest = sizes.iter().copied().max().unwrap();
        println!("{bodies} bodies: {} messages, the largest of {largest} bytes", sizes.len());
        assert!(largest <= MAX_MESSAGE, "{bodies} bodies: a message of {largest} bytes");
        assert!(events.contains(&PeerEvent::Started), "{bodies} bodies: {events:?}");
        let tick = first.confirmed().min(second.confirmed());
        for id in held {
            let [a, b] = [&first, &second].map(|peer| peer.state_at(id, tick).unwrap().q.clone());
            let off = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            let size = a.iter().fold(0.0_f64, |most, q| most.max(q.abs()));
            assert!(off < 1e-9 && size > 1e-2, "{bodies} bodies, {id}, tick {tick}: {off:e} of {size}");
        }
    }
}

#[test]
fn a_state_is_taken_with_its_last_message_and_of_one_tick_only() {
    let (one, two) = (PeerId(1), PeerId(2));
    let (mut first, mut second) = (peer(1, 300, true), peer(2, 300, false));
    let mut now = Duration::from_secs(1);
    first.update(now);
    first.connect(now, two, UserId(2), 1200).unwrap();
    second.connect(now, one, UserId(1), 1200).unwrap();
    let started = |peer: &mut PeerSession| {
        std::iter::from_fn(|| peer.poll_event()).any(|event| event == PeerEvent::Started)
    };
    let (mut sizes, mut lost) = (Vec::new(), None);
    for _ in 0..20 {
        now += Duration::from_millis(25);
        first.update(now);
        let last = |message: &mut PeerMessage| {
            let is_last = matches!(message, PeerMessage::State { more: false, .. });
            if is_last {
                lost = Some(message.clone());
            }
            is_last
        };
        sizes.extend(bring_but(now, &mut first, &mut second, one, last));
        bring(now, &mut second, &mut first, two);
    }
    assert_eq!(sizes.iter().filter(|bytes| **bytes > 100_000).count(), 2, "{sizes:?}");
    assert!(!started(&mut second), "the last message is missing");
    // The end of a state of another tick does not complete it, although it has all that is missing.
    let Some(PeerMessage::State { tick, now: theirs, bodies, .. }) = lost else { panic!("no state") };
    let other = PeerMessage::State { tick: tick + 1, now: theirs + 1, more: false, bodies };
    let before = second.stats(one).unwrap().rejected;
    second.on_message(now, one, &other.encode());
    assert!(!started(&mut second), "the other bodies are of another tick");
    assert_eq!(second.stats(one).unwrap().rejected, before + 1);
}

#[test]
fn all_bodies_together_have_their_most_coordinates_and_no_more() {
    let (model, settings) = (bar(4096, 0.05), StepSettings::default());
    let mut peer = PeerSession::new(PeerSessionConfig::default()).unwrap();
    (1..=128).for_each(|id| peer.add_body(BodyId(id), model.clone(), &settings).unwrap());
    let full = Err(StreamError::Full { what: "coordinates of all bodies", limit: 524_288 });
    assert_eq!(peer.add_body(BodyId(129), bar(1, 0.05), &settings), full);
}

#[test]
fn a_state_of_other_coordinates_than_the_bodys_is_dropped() {
    let (one, two) = (PeerId(1), PeerId(2));
    let cut: [fn(&mut PeerMessage) -> bool; 2] = [
        |_| false,
        |message| {
            if let PeerMessage::State { bodies, .. } = message {
                let body = &mut bodies[0];
                for values in [&mut body.q, &mut body.v, &mut body.a, &mut body.force] {
                    values.pop();
                }
            }
            false
        },
    ];
    let outcomes = cut.map(|alter| {
        let (mut first, mut second) = (peer(1, 2, true), peer(2, 2, false));
        let mut now = Duration::from_secs(1);
        first.update(now);
        first.connect(now, two, UserId(2), 1200).unwrap();
        second.connect(now, one, UserId(1), 1200).unwrap();
        for _ in 0..20 {
            now += Duration::from_millis(25);
            first.update(now);
            bring_but(now, &mut first, &mut second, one, alter);
            bring(now, &mut second, &mut first, two);
        }
        let started = std::iter::from_fn(|| second.poll_event()).any(|event| event == PeerEvent::Started);
        (started, second.stats(one).unwrap().rejected)
    });
    assert_eq!(outcomes, [(true, 0), (false, 1)]);
}
