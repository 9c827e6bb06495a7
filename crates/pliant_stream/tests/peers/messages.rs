//! What crosses between peers: any bytes are read, floods are bounded, paths are measured.

use std::time::Duration;

use pliant_modal::GrabConfig;
use pliant_stream::emulator::{LinkConfig, Loss};
use pliant_stream::peer::{LateInputRepair, PeerSession, PeerSessionConfig};
use pliant_stream::wire::{Datagram, HeldAt, InputTick, Inputs, NackRun, PeerMessage, StateCheck};
use pliant_stream::{Channel, PeerId, StepSettings, UserId};
use proptest::prelude::*;

use super::mesh::Mesh;
use super::support::bar;
use super::{BODY, MS, S};

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_read_without_panic(bytes in proptest::collection::vec(any::<u8>(), 0..600), kind in 0_u8..9) {
        let mut bytes = bytes;
        if let Some(first) = bytes.first_mut() {
            *first = kind;
        }
        let _ = Datagram::decode(&bytes);
        let _ = PeerMessage::decode(&bytes);
    }
}

#[test]
fn every_datagram_reads_back_as_it_was_written() {
    let held = vec![HeldAt {
        body: BODY,
        grab: 3,
        vertex: 9,
        radius: 0.25,
        target: [1.0, -2.0, 0.5],
        hold: GrabConfig::default(),
    }];
    let ticks = vec![
        InputTick { tick: 77, held, impulses: Vec::new() },
        InputTick { tick: 76, ..Default::default() },
    ];
    let check = Some(StateCheck { body: BODY, tick: 64, value: 0.5 });
    for d in [
        Datagram::Inputs(Inputs { now: 78, ahead: Some(-1.5), ticks: ticks.clone(), check }),
        Datagram::Inputs(Inputs { now: 78, ahead: None, ticks, check: None }),
        Datagram::InputRequest(vec![NackRun { first: 5, count: 3 }, NackRun { first: 90, count: 64 }]),
    ] {
        let bytes = d.encode(513);
        assert_eq!(Datagram::decode(&bytes).unwrap(), (513, d));
        for cut in 0..bytes.len() {
            assert!(Datagram::decode(&bytes[..cut]).is_err());
        }
    }
}

#[test]
fn ask_floods_are_answered_within_bounds() {
    let mut mesh = Mesh::new(2, &LinkConfig { delay: 20 * MS, ..Default::default() }, 9);
    for k in 0..2 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(5 * S);
    let p = mesh.peers[0].as_mut().unwrap();
    let now = p.tick();
    let ask = Datagram::InputRequest(vec![NackRun { first: now - 100, count: 50 }; 32]);
    let answered = |p: &mut PeerSession, at: Duration| {
        for s in 0..2000_u16 {
            p.on_datagram(at, PeerId(1), &ask.encode(s));
            p.on_message(at, PeerId(1), &PeerMessage::StateRequest.encode());
        }
        let (mut ticks, mut states) = (0, 0);
        p.update(at);
        while let Some(o) = p.poll_output() {
            match (Datagram::decode(&o.bytes), PeerMessage::decode(&o.bytes)) {
                (Ok((_, Datagram::Inputs(Inputs { ticks: t, .. }))), _) if o.channel == Channel::Datagram => {
                    ticks += t.len();
                }
                (_, Ok(PeerMessage::State { .. })) if o.channel == Channel::Message => states += 1,
                _ => {}
            }
        }
        (ticks, states)
    };
    let (ticks, states) = answered(p, mesh.now);
    assert!((1000..=1005).contains(&ticks), "{ticks} ticks for 256,000 questions");
    assert_eq!(states, 1, "one state an update");
    let (ticks, _) = answered(p, mesh.now + 100 * MS);
    assert!((100..=125).contains(&ticks), "{ticks} ticks 0.1 s later: 1,000 a second");
    let states: usize = (0..200).map(|k| answered(p, mesh.now + 100 * MS + k * MS).1).sum();
    assert!((10..=16).contains(&states), "{states} states: 16 at once and two a second");
    mesh.run(8 * S);
    assert_eq!(mesh.agree(0, 1), 0.0, "who is flooded goes on");
}

#[test]
fn what_nobody_fetches_does_not_grow_for_ever() {
    let mut p =
        PeerSession::new(PeerSessionConfig { idle_timeout: 100_000 * S, ..Default::default() }).unwrap();
    p.add_body(BODY, bar(4, 0.05), &StepSettings::default()).unwrap();
    p.connect(Duration::ZERO, PeerId(7), UserId(2), 1200).unwrap();
    for k in 1..=20_000_u32 {
        p.update(k * 25 * MS);
    }
    assert!(p.tick() > 19_000);
    let mut count = 0;
    while p.poll_output().is_some() {
        count += 1;
    }
    assert_eq!(count, 16_384);
}

#[test]
fn peers_tell_how_their_paths_do() {
    let link = LinkConfig { loss: Loss::Random(0.1), delay: 40 * MS, ..Default::default() };
    let mut mesh = Mesh::new(2, &link, 5);
    for k in 0..2 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(40 * S);
    let p = mesh.peers[0].as_mut().unwrap();
    let stats = p.stats(PeerId(1)).unwrap();
    // Some 1,600 datagrams at 10 % loss have a standard deviation of 0.75 %.
    assert!((stats.loss_in - 0.1).abs() < 0.03, "{stats:?}");
    assert!(stats.datagrams_in > 1200 && stats.datagrams_out > 1500, "{stats:?}");
    // Peers update their sessions every 5 ms, so the jitter is about that large.
    assert!(stats.jitter < 10 * MS, "{stats:?}");
    assert_eq!(stats.rejected, 0);
    let before = p.totals();
    p.on_datagram(mesh.now, PeerId(1), b"\x63nonsense");
    p.on_message(mesh.now, PeerId(1), b"\xff\xff\xff\xff");
    let after = p.totals();
    assert_eq!(p.stats(PeerId(1)), None, "who breaks the protocol is gone");
    assert_eq!(after.rejected, before.rejected + 2, "and stays counted");
    assert_eq!(after.datagrams_in, before.datagrams_in);
    assert!(
        p.begin_grab(BODY, 66, 50.0, [0.0; 3], GrabConfig::default()).is_err(),
        "a patch larger than the body"
    );
}
