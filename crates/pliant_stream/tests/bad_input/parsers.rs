//! Every parser reads any bytes without a panic, and what it reads is within its bounds.

use std::sync::OnceLock;
use std::time::Duration;

use pliant_modal::{
    ContactMemory, ContactState, FixedObstacle, FixedShape, GrabConfig, HeldPlace, ModalModel,
};
use pliant_stream::emulator::{Loss, PathTrace};
use pliant_stream::wire::{
    BodyInfo, Datagram, GuestMessage, HeldAt, HostMessage, ImpulseAt, InputTick, Inputs, PeerBodyState,
    PeerMessage, PeerShapes, TargetEntry, Targets,
};
use pliant_stream::{StepSettings, StreamError, Surroundings};
use proptest::prelude::*;

use super::samples::{around, contacts, places, real_inputs, samples};
use super::support::direct::{BODY, random};

proptest! {
    #![proptest_config(ProptestConfig { cases: 4000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_read_without_panic(bytes in proptest::collection::vec(any::<u8>(), 0..1500)) {
        parse_all(&bytes);
    }

    #[test]
    fn damaged_inputs_are_read_without_panic(
        which in any::<proptest::sample::Index>(),
        damage in proptest::collection::vec((any::<u16>(), any::<u8>()), 1..6),
        cut in any::<u16>(),
    ) {
        let mut bytes = which.get(real()).clone();
        for (at, value) in damage {
            let len = bytes.len();
            bytes[usize::from(at) % len] = value;
        }
        let keep = if cut % 3 == 0 { usize::from(cut) % bytes.len() } else { bytes.len() };
        parse_all(&bytes[..keep]);
    }
}

fn real() -> &'static Vec<Vec<u8>> {
    static REAL: OnceLock<Vec<Vec<u8>>> = OnceLock::new();
    REAL.get_or_init(real_inputs)
}

/// Runs every parser of external bytes and returns how many could read `bytes`. A value that was
/// read must be writable and readable again.
fn parse_all(bytes: &[u8]) -> u32 {
    let mut read = 0;
    if let Ok((sequence, d)) = Datagram::decode(bytes) {
        read += 1;
        let again = Datagram::decode(&d.encode(sequence)).expect("what was read can be written");
        if let (Datagram::Rigids(one), (other, Datagram::Rigids(two))) = (&d, &again) {
            assert_eq!((one.tick, one.poses.len(), sequence), (two.tick, two.poses.len(), *other));
            for ((id, a), (again, b)) in one.poses.iter().zip(&two.poses) {
                assert_eq!((id, a.position, a.linear, a.angular), (again, b.position, b.linear, b.angular));
                let dot: f64 = (0..4).map(|k| a.rotation[k] * b.rotation[k]).sum();
                assert!(dot.abs() > 1.0 - 1e-11, "{:?} and {:?}", a.rotation, b.rotation);
            }
        } else if !matches!(&d, Datagram::Frame(f) if f.pose.is_some()) {
            // (Reading normalizes a rotation to a unit quaternion, so its last bit may differ the
            // second time.)
            assert_eq!(again, (sequence, d));
        }
    }
    if let Ok(m) = GuestMessage::decode(bytes) {
        read += 1;
        assert_eq!(GuestMessage::decode(&m.encode()), Ok(m));
    }
    if let Ok(m) = HostMessage::decode(bytes) {
        read += 1;
        assert_eq!(HostMessage::decode(&m.encode()), Ok(m));
    }
    if let Ok(m) = PeerMessage::decode(bytes) {
        read += 1;
        assert_eq!(PeerMessage::decode(&m.encode()), Ok(m));
    }
    if let Ok(text) = std::str::from_utf8(bytes) {
        read += u32::from(PathTrace::parse(text).is_ok());
        read += u32::from(Loss::parse(text, 1, Duration::from_millis(25)).is_ok());
    }
    read + u32::from(ModalModel::from_bytes(bytes).is_ok())
}

#[test]
fn every_datagram_reads_back_as_it_was_written() {
    for (k, d) in samples().into_iter().enumerate() {
        let bytes = d.encode(k as u16 * 9000);
        let (sequence, back) = Datagram::decode(&bytes).unwrap();
        assert_eq!(sequence, k as u16 * 9000);
        assert_eq!(back, d);
        if let Datagram::Frame(f) = &d {
            assert_eq!(f.bytes() + 3, bytes.len(), "the announced size is the size");
        }
        for cut in 0..bytes.len() {
            assert!(Datagram::decode(&bytes[..cut]).is_err(), "datagram {k} cut to {cut}");
        }
        let mut long = bytes.clone();
        long.push(0);
        assert!(Datagram::decode(&long).is_err(), "a byte too many");
    }
}

#[test]
fn not_a_number_is_refused_by_name() {
    let d = Datagram::Targets(Targets {
        entries: vec![TargetEntry { grab: 1, input: 2, target: [0.0, f64::NAN, 0.0] }],
    });
    assert_eq!(Datagram::decode(&d.encode(0)).unwrap_err(), StreamError::NotFinite { what: "target" });
    let huge = Datagram::Targets(Targets {
        entries: vec![TargetEntry { grab: 1, input: 2, target: [0.0, 1e30, 0.0] }],
    });
    assert!(matches!(Datagram::decode(&huge.encode(0)), Err(StreamError::Invalid { what: "target", .. })));
}

#[test]
fn obstacles_and_contacts_that_are_none_are_refused() {
    let settings = StepSettings::default();
    let added = |around: Surroundings| {
        let info = BodyInfo { body: 1, name: "jack".into(), hash: [7; 32], modes: 9, settings, around };
        HostMessage::decode(&HostMessage::BodyAdded(info).encode())
    };
    added(around()).unwrap();
    let ball = |radius| FixedObstacle { shape: FixedShape::Ball { radius }, ..FixedObstacle::GROUND };
    let many = |count| Surroundings { obstacles: vec![ball(1.0); count], ..around() };
    added(many(256)).unwrap();
    let turned = FixedObstacle { rotation: [0.0, 0.0, 0.0, 2.0], ..ball(1.0) };
    let away = FixedObstacle { position: [0.0, f64::INFINITY, 0.0], ..ball(1.0) };
    for bad in [ball(f64::NAN), ball(-1.0), ball(1e9), turned, away] {
        assert!(added(Surroundings { obstacles: vec![bad], ..around() }).is_err(), "{bad:?}");
    }
    assert!(added(many(257)).is_err());
    assert!(added(Surroundings { friction: f64::NAN, ..around() }).is_err());

    let memory = contacts().memory[0];
    let state = |contacts: ContactState| {
        let zero = || vec![0.0; 4];
        let (q, v, a, z, force) = (zero(), zero(), zero(), Vec::new(), zero());
        let (pulls, s, shapes) = (Vec::new(), Vec::new(), Vec::new());
        let body = PeerBodyState { body: 1, q, v, a, z, force, frame: None, pulls, contacts, s, shapes };
        PeerMessage::decode(&PeerMessage::State { tick: 7, now: 9, more: false, bodies: vec![body] }.encode())
    };
    state(contacts()).unwrap();
    let places = |count| (0..count).map(|site| ContactMemory { site, ..memory }).collect();
    state(ContactState { memory: places(1024), ..contacts() }).unwrap();
    for bad in [
        ContactState { memory: places(1025), ..contacts() },
        ContactState { memory: vec![memory; 2], ..contacts() },
        ContactState { memory: vec![ContactMemory { force: [f64::NAN; 3], ..memory }], ..contacts() },
        ContactState { memory: vec![ContactMemory { toward: [2.0, 0.0, 0.0], ..memory }], ..contacts() },
        ContactState { memory: vec![ContactMemory { leads: Some(-1.0), ..memory }], ..contacts() },
        ContactState { weight: 2.0, ..contacts() },
        ContactState { lost: -1.0, ..contacts() },
    ] {
        assert!(state(bad.clone()).is_err(), "{bad:?}");
    }
}

#[test]
fn shapes_of_held_patches_that_are_none_are_refused() {
    let shapes = |from, places: Vec<HeldPlace>| {
        PeerMessage::decode(&PeerMessage::Shapes { body: 1, from, places }.encode())
    };
    shapes(0, places(1)).unwrap();
    shapes(1 << 40, places(4)).unwrap();
    let one = places(1)[0];
    let [x, y, z] =
        [f64::NAN, f64::INFINITY, 1e300].map(|bad| HeldPlace { displacement: [0.0, bad, 0.0], ..one });
    let [r, s] = [f64::NAN, -1.0].map(|radius| HeldPlace { radius, ..one });
    for bad in [x, y, z, r, s] {
        assert!(shapes(5, vec![bad]).is_err(), "{bad:?}");
    }
    assert!(shapes(5, Vec::new()).is_err() && shapes(5, places(5)).is_err());
    assert!(shapes(1 << 48, places(1)).is_err());

    let state = |shapes: Vec<PeerShapes>, s: Vec<f64>| {
        let zero = || vec![0.0; 4];
        let (q, v, a, z, force) = (zero(), zero(), zero(), Vec::new(), zero());
        let (pulls, contacts) = (Vec::new(), ContactState::default());
        let body = PeerBodyState { body: 1, q, v, a, z, force, frame: None, pulls, contacts, s, shapes };
        PeerMessage::decode(&PeerMessage::State { tick: 7, now: 9, more: false, bodies: vec![body] }.encode())
    };
    let sets = |count: u64| (1..=count).map(|from| PeerShapes { from, places: places(2) }).collect();
    state(sets(16), vec![0.5; 40]).unwrap();
    assert!(state(sets(17), Vec::new()).is_err());
    let mut twice: Vec<PeerShapes> = sets(2);
    twice[1].from = 1;
    assert!(state(twice, Vec::new()).is_err());
    assert!(state(vec![PeerShapes { from: 3, places: vec![x] }], Vec::new()).is_err());
    assert!(state(sets(1), vec![f64::NAN]).is_err() && state(sets(1), vec![0.0; 5000]).is_err());
}

/// A datagram of a peer with `held` hands and `impulses` at one tick, which says that it has one
/// more of either, and has the bytes for it.
fn one_too_many(held: usize, impulses: usize) -> [Vec<u8>; 3] {
    let hand = |grab| HeldAt {
        body: BODY,
        grab,
        vertex: 9,
        radius: 0.25,
        target: [1.0, -2.0, 0.5],
        hold: GrabConfig::default(),
    };
    let held: Vec<HeldAt> = (0..held as u16).map(hand).collect();
    let impulses = vec![ImpulseAt { body: BODY, vertex: 8, impulse: [0.5, 0.0, -2.0] }; impulses];
    let (hands, struck) = (25 * held.len(), 18 * impulses.len());
    let ticks = vec![InputTick { tick: 9, held, impulses }];
    let right = Datagram::Inputs(Inputs { now: 9, ahead: None, ticks, check: None }).encode(1);
    // The last byte tells that no checksum follows. Before it are the impulses with their number,
    // and before these the hands with theirs.
    let impulses_at = right.len() - 1 - struck;
    let hands_at = impulses_at - 1 - hands;
    let more = |at: usize, bytes: usize| {
        let mut wrong = right.clone();
        wrong[at - 1] += 1;
        let copy = wrong[at..at + bytes].to_vec();
        wrong.splice(at..at, copy);
        wrong
    };
    [more(hands_at, 25), more(impulses_at, 18), right]
}

#[test]
fn no_peer_has_more_than_sixteen_hands_and_eight_impulses_at_a_tick() {
    let read = |bytes: &[u8]| match Datagram::decode(bytes) {
        Ok((_, Datagram::Inputs(inputs))) => Ok((inputs.ticks[0].held.len(), inputs.ticks[0].impulses.len())),
        Ok(other) => panic!("{other:?}"),
        Err(error) => Err(error),
    };
    let [hand, impulse, right] = one_too_many(15, 7);
    assert_eq!([&right, &hand, &impulse].map(|bytes| read(bytes)), [Ok((15, 7)), Ok((16, 7)), Ok((15, 8))]);
    let [hand, impulse, right] = one_too_many(16, 8);
    assert_eq!(read(&right), Ok((16, 8)));
    let refused = |bytes: &[u8], name: &str| match read(bytes) {
        Err(StreamError::Invalid { what, .. }) => assert_eq!(what, name),
        other => panic!("{name}: {other:?}"),
    };
    refused(&hand, "held count");
    refused(&impulse, "impulse count");
}

#[test]
#[ignore = "a minute: a million damaged inputs through every parser"]
fn a_million_damaged_inputs_are_read_without_panic() {
    let real = real_inputs();
    let (mut state, mut read) = (0x9E37_79B9_7F4A_7C15, 0_u32);
    for _ in 0..1_000_000 {
        let mut bytes = real[(random(&mut state) % real.len() as u64) as usize].clone();
        for _ in 0..=random(&mut state) % 4 {
            let at = random(&mut state) as usize % bytes.len();
            bytes[at] = random(&mut state) as u8;
        }
        if random(&mut state).is_multiple_of(5) {
            bytes.truncate(random(&mut state) as usize % (bytes.len() + 1));
        }
        read += parse_all(&bytes);
    }
    println!("1,000,000 damaged inputs of {} kinds: {read} readings succeeded, none panicked", real.len());
    assert!(read > 100_000, "the damage must leave some of it readable: {read}");
}
