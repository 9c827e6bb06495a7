//! Valid bytes of every kind of external input.

use pliant_modal::{
    ContactMemory, ContactState, FixedObstacle, FixedShape, GrabConfig, HeldPlace, Relaxation,
};
use pliant_stream::codec::quantization::Quanta;
use pliant_stream::wire::{
    AccelerationCoding, Accelerations, BodyInfo, Clock, Datagram, FrameGrab, GuestMessage, HeldAt,
    HostMessage, ImpulseAt, InputTick, Inputs, Nack, NackRun, PeerBodyState, PeerFrame, PeerHandState,
    PeerMessage, PeerShapes, ReceiverReport, Repeat, RepeatGrab, RigidPoses, Slice, SliceEntry,
    SnapshotBytes, StateCheck, TargetEntry, Targets, TickFrame,
};
use pliant_stream::{Newmark, RigidId, RigidState, StepSettings, Surroundings};

use super::support::bar;
use super::support::direct::{BODY, grab};

fn quanta() -> Quanta {
    Quanta::new(&bar(12, 0.05), 12, &Newmark::average(0.025))
}

pub(super) fn quantized(coding: AccelerationCoding, values: &[f64]) -> Accelerations {
    Accelerations::quantize(coding, values, 1e-4, &quanta())
}

fn sliced(payload: u8) -> Slice {
    let entry = |mode, q, v| SliceEntry { mode, q, v, load: 3.0, z: 0.5 * q };
    Slice::quantize(&[entry(3, 1.0, 2.0), entry(9, -0.5, 0.0)], 1e-4, payload == 2, payload == 3, &quanta())
}

pub(super) fn samples() -> Vec<Datagram> {
    let frame = |payload: u8| TickFrame {
        body: BODY,
        tick: 12_345,
        run: 77,
        resting: payload == 3,
        resent: payload == 1,
        displacements: payload == 0,
        part: (payload == 2).then_some((1, 3)),
        grabs: if payload == 0 {
            vec![grab(1), grab(2)]
        } else {
            vec![FrameGrab { displacement: [0.0; 3], ..grab(1) }]
        },
        pose: (payload == 2).then(|| RigidState { position: [1.0, 2.0, 3.0], ..RigidState::default() }),
        accelerations: match payload {
            1 => Some(quantized(AccelerationCoding::Visible, &[1.0, -2.0, 0.25])),
            2 => Some(quantized(AccelerationCoding::F64, &[1.0, -2.0, 0.25])),
            _ => None,
        },
        slice: (payload != 1).then(|| sliced(payload)),
        check: (payload < 2).then_some(0.125),
        repeats: vec![Repeat {
            back: 1,
            grabs: vec![RepeatGrab {
                index: 0,
                reaction: [1.0, 2.0, 3.0],
                displacement: if payload == 0 { [0.5, 0.5, 0.5] } else { [0.0; 3] },
            }],
            accelerations: (payload == 1).then(|| quantized(AccelerationCoding::Visible, &[1.0, 0.0, 0.0])),
        }],
    };
    let report = ReceiverReport { received: 10, highest: 12 };
    vec![
        Datagram::Frame(frame(0)),
        Datagram::Frame(frame(1)),
        Datagram::Frame(frame(2)),
        Datagram::Frame(frame(3)),
        Datagram::Targets(Targets {
            entries: vec![TargetEntry { grab: 1, input: 2, target: [0.5, 0.25, -1.0] }],
        }),
        Datagram::Nack(Nack { body: BODY, runs: vec![NackRun { first: 100, count: 3 }] }),
        Datagram::Ping(Clock { t1: 5, t2: 0, t3: 0, report, round_trip: 200_000 }),
        Datagram::Pong(Clock { t1: 5, t2: 6, t3: 7, report, round_trip: 0 }),
    ]
}

/// What a contact has left.
pub(super) fn contacts() -> ContactState {
    let memory = |site| ContactMemory {
        obstacle: 0,
        site,
        force: [0.0, 2.0, 0.5],
        anchor: [0.5; 3],
        toward: [0.0; 3],
        leads: (site % 2 == 0).then_some(1e-3),
    };
    ContactState { weight: 0.75, lost: 0.5, memory: vec![memory(3), memory(9)] }
}

/// Places of which shapes of held patches are made.
pub(super) fn places(count: u32) -> Vec<HeldPlace> {
    (0..count).map(|vertex| HeldPlace { vertex, radius: 0.25, displacement: [0.1, 0.0, -0.2] }).collect()
}

/// An obstacle of every shape.
pub(super) fn around() -> Surroundings {
    let shapes = [
        FixedShape::Plane,
        FixedShape::Ball { radius: 0.5 },
        FixedShape::Box { half: [1.0, 2.0, 3.0], round: 0.25 },
        FixedShape::Capsule { radius: 0.5, half_length: 1.0 },
    ];
    let of = |shape| FixedObstacle { shape, position: [0.0, -1.0, 0.0], ..FixedObstacle::GROUND };
    Surroundings { friction: 0.25, obstacles: shapes.map(of).to_vec() }
}

/// Valid bytes of every kind of external input.
pub(super) fn real_inputs() -> Vec<Vec<u8>> {
    let mut all: Vec<Vec<u8>> = samples().iter().map(|d| d.encode(3)).collect();
    let snapshot = SnapshotBytes {
        body: 1,
        tick: 5,
        q: vec![0.5; 9],
        v: vec![1.0; 9],
        a: vec![2.0; 9],
        z: vec![0.25; 9],
        load: Vec::new(),
        means: vec![(1, 2, [0.5, -3.0, 1.0])],
        contacts: contacts(),
        pose: Some(RigidState { position: [1.0, 2.0, 3.0], ..RigidState::default() }),
        resting: false,
    };
    let info = BodyInfo {
        body: 1,
        name: "a body".into(),
        hash: [7; 32],
        modes: 9,
        settings: StepSettings {
            gravity: [0.0, 0.0, -9.81],
            relaxation: Some(Relaxation { ratio: 0.5, time: 0.4 }),
            ..Default::default()
        },
        around: around(),
    };
    all.push(HostMessage::Snapshot(snapshot).encode());
    all.push(HostMessage::BodyAdded(info).encode());
    all.push(HostMessage::ModelChunk { hash: [1; 32], offset: 0, total: 99, bytes: vec![3; 50] }.encode());
    all.push(
        GuestMessage::GrabBegin {
            grab: 1,
            body: 1,
            vertex: 5,
            radius: 0.1,
            target: [0.0, 1.0, 2.0],
            hold: GrabConfig { stiffness: Some(50.0), relaxation: 0.01 },
        }
        .encode(),
    );
    all.push(GuestMessage::Impulse { body: 1, vertex: 8, impulse: [0.5, 0.0, -2.0] }.encode());
    let held = vec![HeldAt {
        body: BODY,
        grab: 3,
        vertex: 9,
        radius: 0.25,
        target: [1.0, -2.0, 0.5],
        hold: GrabConfig { stiffness: Some(400.0), relaxation: 0.01 }.capped(),
    }];
    let impulses = vec![ImpulseAt { body: BODY, vertex: 8, impulse: [0.5, 0.0, -2.0] }];
    let ticks = vec![InputTick { tick: 9, held, impulses }, InputTick { tick: 8, ..Default::default() }];
    let check = Some(StateCheck { body: BODY, tick: 8, value: 0.5 });
    all.push(Datagram::Inputs(Inputs { now: 9, ahead: Some(0.5), ticks, check }).encode(1));
    all.push(Datagram::InputRequest(vec![NackRun { first: 5, count: 3 }]).encode(2));
    let state = RigidState { position: [1.0, 2.0, 3.0], linear: [0.5; 3], ..RigidState::default() };
    let poses = vec![(RigidId(1), state), (RigidId(7), RigidState::default())];
    all.push(Datagram::Rigids(RigidPoses { tick: 9, poses }).encode(3));
    all.push(HostMessage::RigidAdded { rigid: 1, name: "a crate".into(), tick: 8, state }.encode());
    all.push(HostMessage::RigidsRest { tick: 9, rigids: vec![(1, state), (7, state)] }.encode());
    all.push(HostMessage::RigidRemoved { rigid: 1 }.encode());
    let frame =
        PeerFrame { center: [0.0; 3], orientation: [0.0, 0.0, 0.0, 1.0], velocity: [0.1; 3], spin: [0.0; 3] };
    let body = PeerBodyState {
        body: 1,
        q: vec![0.5; 4],
        v: vec![0.5; 4],
        a: vec![0.5; 4],
        z: Vec::new(),
        force: vec![0.0; 4],
        frame: Some(frame),
        pulls: vec![PeerHandState {
            user: 1,
            grab: 2,
            pull: [0.5; 3],
            mean: [0.25; 3],
            target: [1.0; 3],
            viscoelastic: [0.0; 3],
        }],
        contacts: contacts(),
        s: vec![0.5; 3],
        shapes: vec![PeerShapes { from: 5, places: places(2) }, PeerShapes { from: 9, places: places(1) }],
    };
    let hello = PeerMessage::Hello {
        version: 4,
        user: 2,
        name: "a peer".into(),
        address: "somewhere".into(),
        joining: true,
        scene: 0x0123_4567_89ab_cdef,
    };
    all.push(hello.encode());
    all.push(PeerMessage::Welcome { user: 2, others: vec![(3, "elsewhere".into())] }.encode());
    all.push(PeerMessage::Shapes { body: 1, from: 0, places: places(4) }.encode());
    all.push(PeerMessage::State { tick: 7, now: 9, more: false, bodies: vec![body] }.encode());
    all.push(b"12.5\nlost # a comment\n13\n".to_vec());
    all.push(bar(2, 0.05).to_bytes());
    all
}
