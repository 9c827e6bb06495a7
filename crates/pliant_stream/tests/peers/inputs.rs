//! Hands and impulses cross between peers whole, and act alike at all of them.

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{Body, BodyConfig, GrabConfig, ModalModel, Patch};
use pliant_stream::emulator::{LinkConfig, Loss, Preset};
use pliant_stream::peer::{LateInputRepair, PeerSession, PeerSessionConfig};
use pliant_stream::{BodyId, StepSettings, StreamError};

use super::mesh::Mesh;
use super::support::loose_bar;
use super::{BODY, MS, OTHER, S};

/// Three peers strike a free body in turns. Its momentum is the sum of what was sent, and the same
/// to the bit at all peers: each impulse acts once, at one tick.
#[test]
fn impulses_act_once_and_alike_at_all_peers() {
    for repair in [LateInputRepair::Rollback, LateInputRepair::Compensate] {
        let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper1), 19);
        mesh.other = Some(loose_bar(12, 0.05));
        (0..3).for_each(|k| mesh.start(k, repair, true));
        let mut sum = [0.0; 3];
        for round in 0..9_u32 {
            mesh.run(2 * S + round * 300 * MS);
            let k = round as usize % 3;
            // These numbers are the same in single precision.
            let impulse = [0.25, -0.5 * f64::from(round), 0.125];
            (0..3).for_each(|axis| sum[axis] += impulse[axis]);
            mesh.peers[k].as_mut().unwrap().apply_impulse(OTHER, Mesh::VERTEX[k], impulse).unwrap();
        }
        mesh.run(8 * S);
        assert_eq!(mesh.other_apart(0, 1), (0.0, 0.0));
        assert_eq!(mesh.other_apart(0, 2), (0.0, 0.0));
        let peer = mesh.peers[0].as_ref().unwrap();
        let velocity = peer.state_at(OTHER, peer.confirmed()).unwrap().frame.velocity();
        for (axis, expected) in sum.into_iter().enumerate() {
            assert!((2.0 * velocity[axis] - expected).abs() < 1e-9, "{velocity:?}, {sum:?} N s over 2 kg");
        }
        assert!(peer.body(OTHER).unwrap().live().q.iter().any(|q| q.abs() > 1e-6), "the modes move too");
    }
}

#[test]
fn an_impulse_of_a_peer_has_its_bounds() {
    let mut mesh = Mesh::new(2, &LinkConfig::default(), 5);
    mesh.other = Some(loose_bar(12, 0.05));
    (0..2).for_each(|k| mesh.start(k, LateInputRepair::Rollback, true));
    mesh.run(S);
    let peer = mesh.peers[0].as_mut().unwrap();
    for wrong in [[f64::NAN, 0.0, 0.0], [0.0, f64::INFINITY, 0.0], [0.0, 0.0, 2e9]] {
        let error = peer.apply_impulse(OTHER, 0, wrong).unwrap_err();
        assert_eq!(error, StreamError::NotFinite { what: "impulse" });
    }
    assert_eq!(peer.apply_impulse(BodyId(9), 0, [1.0; 3]), Err(StreamError::UnknownBody(BodyId(9))));
    assert!(matches!(peer.apply_impulse(OTHER, 1_000_000, [1.0; 3]), Err(StreamError::Model(_))));
    peer.apply_impulse(OTHER, Mesh::VERTEX[0], [0.0, -1e8, 0.0]).unwrap();
    for _ in 1..8 {
        peer.apply_impulse(OTHER, Mesh::VERTEX[0], [0.0; 3]).unwrap();
    }
    let full = StreamError::Full { what: "impulses", limit: 8 };
    assert_eq!(peer.apply_impulse(OTHER, 0, [1.0; 3]), Err(full), "the ninth of a tick");
    mesh.run(2 * S);
    for k in 0..2 {
        let peer = mesh.peers[k].as_ref().unwrap();
        let velocity = peer.body(OTHER).unwrap().live().frame.velocity();
        assert!((velocity[1] + pliant_stream::MAX_IMPULSE_SPEED).abs() < 1e-6, "{k}: {velocity:?}");
    }
}

/// Compares a device's spring and damper on Pip between a peer session and a body.
#[test]
fn a_peers_hand_has_its_own_spring_and_damper() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/pip.modal");
    let pip = Arc::new(ModalModel::read(path).unwrap());
    let (vertex, radius) = (76, f64::from(0.0216_f32));
    // A Touch device: 400 N/m and 4 N s/m.
    let hold = GrabConfig { stiffness: Some(400.0), relaxation: 0.01 }.capped();
    let mut peer = PeerSession::new(PeerSessionConfig::default()).unwrap();
    peer.add_body(BODY, pip.clone(), &StepSettings::default()).unwrap();
    let mut body = Body::new(pip.clone(), BodyConfig { step: 1.0 / 40.0, ..Default::default() }).unwrap();
    let patch = Patch::around(pip.surface(), vertex, radius).unwrap();
    let id = body.grab(&patch, hold).unwrap();
    let start = body.target(id).unwrap();
    let at = |tick: u64| {
        let way = 0.02 * (tick as f64 / 40.0).min(1.0);
        [start[0] + way, start[1] - 0.5 * way, start[2]].map(|x| f64::from(x as f32))
    };
    peer.update(Duration::ZERO);
    let grab = peer.begin_grab(BODY, vertex, radius, at(0), hold).unwrap();
    let mut largest = 0.0f64;
    for tick in 1..=120 {
        peer.set_target(grab, at(tick)).unwrap();
        assert_eq!(peer.update(25 * MS * tick as u32 + MS), 1);
        body.set_target(id, at(tick)).unwrap();
        body.step().unwrap();
        let (felt, expected) = (peer.body(BODY).unwrap().grabs()[0].reaction, body.reaction(id).unwrap());
        for (felt, expected) in felt.iter().zip(expected) {
            largest = largest.max(expected.abs());
            assert!(
                (felt - expected).abs() <= 1e-9 * largest,
                "tick {tick}: {felt} N instead of {expected} N"
            );
        }
    }
    assert!(largest > 0.05, "{largest} N");
}

/// The damper of a hand crosses: the other peer computes the same force, to the bit, and another
/// one than for a hand without a damper.
#[test]
fn a_hands_damper_is_felt_alike_by_the_other_peer() {
    let felt = |relaxation| {
        let link = LinkConfig { loss: Loss::Random(0.05), delay: 20 * MS, ..Default::default() };
        let mut mesh = Mesh::new(2, &link, 11);
        mesh.hold = GrabConfig { stiffness: Some(40.0), relaxation };
        for k in 0..2 {
            mesh.start(k, LateInputRepair::Rollback, true);
        }
        mesh.run(6 * S);
        let [a, b] = [0, 1].map(|k| mesh.peers[k].as_ref().unwrap());
        let last = a.confirmed().min(b.confirmed());
        let mut all = Vec::new();
        for tick in last - 60..=last {
            let reactions = a.reactions_at(BODY, tick).unwrap();
            assert_eq!(reactions.len(), 2);
            assert_eq!(b.reactions_at(BODY, tick).unwrap(), reactions, "tick {tick}");
            all.push(reactions[0].1);
        }
        all
    };
    let (damped, free) = (felt(0.1), felt(0.0));
    let size = |x: &[f64; 3]| x.iter().map(|x| x * x).sum::<f64>().sqrt();
    let largest = free.iter().map(size).fold(0.0, f64::max);
    let apart = damped.iter().zip(&free).map(|(a, b)| size(&std::array::from_fn(|c| a[c] - b[c])));
    let apart = apart.fold(0.0, f64::max);
    assert!(apart > 0.05 * largest, "{apart} N of {largest} N");
}
