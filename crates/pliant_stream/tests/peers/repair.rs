//! Bodies that differ between peers are noticed and repaired, and false states are not believed.

use pliant_modal::{ContactState, GrabConfig};
use pliant_stream::emulator::LinkConfig;
use pliant_stream::peer::{LateInputRepair, PeerEvent, PeerSession, PeerSessionConfig};
use pliant_stream::wire::{Datagram, HeldAt, InputTick, Inputs, PeerBodyState, PeerMessage, StateCheck};
use pliant_stream::{BodyId, Channel, PeerId, StepSettings, UserId};

use super::mesh::{Mesh, greeted};
use super::support::{bar, loose_bar};
use super::{BODY, MS, OTHER, S};

/// The state check of a body that agrees.
fn agreeing(p: &PeerSession, body: BodyId) -> StateCheck {
    let tick = p.confirmed();
    let value = pliant_stream::codec::checksum::checksum(tick, p.state_at(body, tick).unwrap()) as f32;
    StateCheck { body, tick, value }
}

/// Delivers inputs of the peer with the lowest number. Returns whether `p` then requests its state.
fn asks(p: &mut PeerSession, tick: u16, sequence: u16, check: Option<StateCheck>) -> bool {
    let ticks = vec![InputTick { tick: p.tick(), ..Default::default() }];
    let datagram = Datagram::Inputs(Inputs { now: p.tick(), ahead: None, ticks, check });
    p.on_datagram(25 * MS * u32::from(tick), PeerId(1), &datagram.encode(sequence));
    let mut asked = false;
    while let Some(out) = p.poll_output() {
        asked |= out.channel == Channel::Message
            && PeerMessage::decode(&out.bytes) == Ok(PeerMessage::StateRequest);
    }
    asked
}

#[test]
fn a_body_that_differs_is_noticed_beside_one_that_agrees() {
    let mut p = PeerSession::new(PeerSessionConfig { user: UserId(2), ..Default::default() }).unwrap();
    for body in [BODY, OTHER] {
        p.add_body(body, bar(4, 0.05), &StepSettings::default()).unwrap();
    }
    greeted(&mut p);
    let mut asked = false;
    for tick in 1..=40_u16 {
        p.update(25 * MS * u32::from(tick));
        let check = match tick {
            0..10 => None,
            // The first body agrees each time, and the second never does.
            _ if tick % 2 == 0 => Some(agreeing(&p, BODY)),
            _ => Some(StateCheck { value: 1e3, ..agreeing(&p, OTHER) }),
        };
        asked |= asks(&mut p, tick, tick, check);
    }
    assert!(asked, "the lowest number was asked for its state");
}

#[test]
fn a_body_that_differs_beside_one_that_agrees_is_repaired() {
    let mut mesh = Mesh::new(2, &LinkConfig { delay: 20 * MS, ..Default::default() }, 9);
    // The second body is free. What once pushed it on one machine only drives it away for ever.
    mesh.other = Some(loose_bar(8, 0.05));
    mesh.tamper = |from, to, bytes| {
        let inputs = match Datagram::decode(&bytes) {
            Ok((sequence, Datagram::Inputs(inputs))) if (from, to) == (0, 1) => Some((sequence, inputs)),
            _ => None,
        };
        let Some((sequence, mut inputs)) = inputs else { return bytes };
        for tick in inputs.ticks.iter_mut().filter(|tick| (200..208).contains(&tick.tick)) {
            let (grab, vertex, radius, hold) = (99, 66, 0.05, GrabConfig::default());
            tick.held.push(HeldAt { body: OTHER, grab, vertex, radius, target: [1.0, 0.5, 0.0], hold });
        }
        Datagram::Inputs(inputs).encode(sequence)
    };
    for k in 0..2 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(6 * S);
    let (far, bent) = mesh.other_apart(0, 1);
    assert!(far > 0.05 && bent > 1e-4, "the bodies must be apart: {far} m, {bent}");
    assert_eq!(mesh.agree(0, 1), 0.0, "the first body agrees all the time");
    mesh.run(12 * S);
    let (after, after_bent) = mesh.other_apart(0, 1);
    println!("{far:.3} m apart after the fault, {after:.1e} m and {after_bent:.1e} after the repair");
    assert!(after < 1e-12 && after_bent < 1e-12, "{after} m, {after_bent}");
    assert!(mesh.agree(0, 1) < 1e-9, "{}", mesh.agree(0, 1));
    let resynced = |e: &&(usize, PeerEvent)| **e == (1, PeerEvent::Resynced { from: UserId(1) });
    assert_eq!(mesh.events.iter().filter(resynced).count(), 1, "{:?}", mesh.events);
}

#[test]
fn copies_of_one_datagram_are_one_disagreement() {
    let mut p = PeerSession::new(PeerSessionConfig { user: UserId(2), ..Default::default() }).unwrap();
    p.add_body(BODY, bar(4, 0.05), &StepSettings::default()).unwrap();
    greeted(&mut p);
    for tick in 1..=20_u16 {
        p.update(25 * MS * u32::from(tick));
        let wrong = StateCheck { value: 1e3, ..agreeing(&p, BODY) };
        let check = (tick > 10).then_some(wrong);
        // From the eleventh datagram on, the network repeats that datagram.
        let asked = asks(&mut p, tick, tick.min(11), check);
        assert!(!asked, "tick {tick}");
    }
    assert_eq!(p.stats(PeerId(1)).unwrap().datagrams_in, 11);
}

#[test]
fn a_liar_is_not_believed_by_the_lowest_and_cannot_harm() {
    let mut mesh = Mesh::new(2, &LinkConfig { delay: 20 * MS, ..Default::default() }, 9);
    for k in 0..2 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(5 * S);
    // Peer 2 (number 2) lies to peer 1 about its state, hundreds of times.
    let p = mesh.peers[0].as_mut().unwrap();
    for s in 0..500_u16 {
        let check = Some(StateCheck { body: BODY, tick: p.confirmed(), value: 1e6 });
        let lie = Datagram::Inputs(Inputs { now: 1, ahead: Some(500.0), ticks: Vec::new(), check });
        p.on_datagram(mesh.now, PeerId(1), &lie.encode(s));
    }
    mesh.run(8 * S);
    assert!(!mesh.events.iter().any(|e| matches!(e, (0, PeerEvent::Resynced { .. }))));
    assert_eq!(mesh.agree(0, 1), 0.0);
}

#[test]
fn a_state_that_nobody_asked_for_is_not_taken() {
    // The higher number lies to the lower, and the lower to the higher.
    for (liar, victim) in [(1, 0), (0, 1)] {
        let mut mesh = Mesh::new(2, &LinkConfig { delay: 20 * MS, ..Default::default() }, 9);
        for k in 0..2 {
            mesh.start(k, LateInputRepair::Rollback, true);
        }
        mesh.run(5 * S);
        let p = mesh.peers[victim].as_mut().unwrap();
        let body = PeerBodyState {
            body: BODY.0,
            q: vec![5.0; 40],
            v: vec![5.0; 40],
            a: vec![0.0; 40],
            z: Vec::new(),
            force: vec![0.0; 40],
            frame: None,
            pulls: Vec::new(),
            contacts: ContactState::default(),
            s: Vec::new(),
            shapes: Vec::new(),
        };
        let tick = p.confirmed();
        let lie = PeerMessage::State { tick, now: p.tick(), more: false, bodies: vec![body] }.encode();
        let before = p.body(BODY).unwrap().live().q.clone();
        for _ in 0..50 {
            p.on_message(mesh.now, PeerId(liar), &lie);
        }
        assert_eq!(p.body(BODY).unwrap().live().q, before);
        mesh.run(8 * S);
        assert!(!mesh.events.iter().any(|e| matches!(e.1, PeerEvent::Resynced { .. })), "{:?}", mesh.events);
        assert_eq!(mesh.agree(0, 1), 0.0);
    }
}

#[test]
fn the_lowest_number_is_believed_when_it_was_asked() {
    let mut mesh = Mesh::new(2, &LinkConfig { delay: 20 * MS, ..Default::default() }, 9);
    for k in 0..2 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(5 * S);
    // Checks of the lowest number disagree. The peer requests its state, receives it, and the state
    // is the same as before.
    let p = mesh.peers[1].as_mut().unwrap();
    for s in 0..3_u16 {
        let check = Some(StateCheck { body: BODY, tick: p.confirmed(), value: 1e6 });
        let inputs = Datagram::Inputs(Inputs { now: p.tick(), ahead: None, ticks: Vec::new(), check });
        p.on_datagram(mesh.now, PeerId(0), &inputs.encode(s));
    }
    mesh.run(8 * S);
    let resynced = |e: &&(usize, PeerEvent)| e.1 == PeerEvent::Resynced { from: UserId(1) };
    assert_eq!(mesh.events.iter().filter(resynced).count(), 1, "{:?}", mesh.events);
    assert!(mesh.agree(0, 1) < 1e-9, "{}", mesh.agree(0, 1));
}
