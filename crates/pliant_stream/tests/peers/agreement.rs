//! Peers agree on one shape, whatever their paths and clocks do.

use std::time::Duration;

use pliant_modal::{GrabConfig, HeldPatch, Integrator, Patch, Relaxation};
use pliant_stream::emulator::{LinkConfig, Preset};
use pliant_stream::peer::{LateInputRepair, PeerEvent, PeerSession};
use pliant_stream::{DisconnectReason, StepSettings, Surroundings, UserId};

use super::mesh::Mesh;
use super::support::{bar, loose_bar};
use super::{BODY, MS, OTHER, S, floor};

#[test]
fn three_peers_agree_to_the_bit_under_rollback_over_the_papers_worst_network() {
    let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper1), 7);
    for k in 0..3 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    let mut settled: Vec<(u64, Vec<f64>)> = Vec::new();
    for second in 1..=30 {
        mesh.run(second * S);
        let p = mesh.peers[0].as_ref().unwrap();
        let from = p.confirmed().saturating_sub(60);
        for t in from..=p.confirmed() {
            if settled.last().is_none_or(|l| l.0 < t)
                && let Some(s) = p.state_at(BODY, t)
            {
                settled.push((t, s.q.clone()));
            }
        }
    }
    assert_eq!(mesh.agree(0, 1), 0.0, "the same inputs stepped the same way");
    assert_eq!(mesh.agree(0, 2), 0.0);
    assert!(!mesh.events.iter().any(|e| matches!(e.1, PeerEvent::Resynced { .. })), "{:?}", mesh.events);
    let ticks: Vec<u64> = mesh.peers.iter().map(|p| p.as_ref().unwrap().tick()).collect();
    let spread = ticks.iter().max().unwrap() - ticks.iter().min().unwrap();
    assert!(spread <= 1, "ticks stay together: {ticks:?}");
    let behind = ticks[0] - mesh.peers[0].as_ref().unwrap().confirmed();
    assert!(behind <= 40, "confirmed {behind} ticks behind");
    let error = mesh.shown_error(&settled);
    println!("shown error before confirmation: {:.3} %", 100.0 * error);
    assert!(error < 0.004, "{error}");
}

#[test]
fn rollback_is_nearer_than_the_papers_compensation() {
    let error = |repair| {
        let mut mesh = Mesh::new(2, &LinkConfig::preset(Preset::Paper2), 3);
        for k in 0..2 {
            mesh.start(k, repair, true);
        }
        mesh.run(20 * S);
        mesh.agree(0, 1)
    };
    let (exact, papers) = (error(LateInputRepair::Rollback), error(LateInputRepair::Compensate));
    println!("disagreement: rollback {exact:e}, compensation {papers:e}");
    assert_eq!(exact, 0.0);
    assert!((0.005..0.0125).contains(&papers), "{papers}");
}

#[test]
fn free_and_relaxing_bodies_agree_to_the_bit_and_late_joiners_with_them() {
    let settings = StepSettings {
        integrator: Integrator::GeneralizedAlpha { rho_inf: 0.5 },
        gravity: [0.0, 0.0, -0.4],
        relaxation: Some(Relaxation { ratio: 0.5, time: 0.4 }),
        ..Default::default()
    };
    for (free, settings) in
        [(true, StepSettings { relaxation: None, ..settings }), (false, settings), (true, settings)]
    {
        let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper2), 11);
        mesh.settings = settings;
        mesh.model = if free { loose_bar(24, 0.05) } else { bar(24, 0.05) };
        mesh.start(0, LateInputRepair::Rollback, true);
        mesh.start(1, LateInputRepair::Rollback, true);
        mesh.run(6 * S);
        mesh.start(2, LateInputRepair::Rollback, false);
        mesh.run(14 * S);
        assert_eq!(mesh.agree(0, 1), 0.0, "free {free}, {settings:?}");
        // The received orientation is normalized, so the last bit of the dependent values may
        // differ.
        assert!(mesh.agree(0, 2) < 1e-9, "free {free}, {settings:?}: {}", mesh.agree(0, 2));
        let all: Vec<&PeerSession> = mesh.peers.iter().flatten().collect();
        let tick = all.iter().map(|p| p.confirmed()).min().unwrap();
        let state = |k: usize| all[k].state_at(BODY, tick).unwrap();
        let pose = |k: usize| all[k].pose_at(BODY, tick);
        assert_eq!(pose(0).is_some(), free);
        assert_eq!((pose(0), &state(0).z), (pose(1), &state(1).z));
        let flown: f64 = state(0).z.iter().zip(&state(2).z).map(|(a, b)| (a - b).abs()).sum();
        assert!(flown < 1e-9, "{flown}");
        if let (Some(a), Some(b)) = (pose(0), pose(2)) {
            assert!((0..3).all(|k| (a.position[k] - b.position[k]).abs() < 1e-9), "{a:?} and {b:?}");
        }
        assert_eq!(state(0).z.is_empty(), settings.relaxation.is_none());
        if let Some(pose) = pose(0) {
            let moved = (0..3).map(|k| pose.position[k].powi(2)).sum::<f64>().sqrt();
            assert!(moved > 0.01, "the hands must have moved the frame: {moved} m");
        }
        // (In its first seconds a joining peer may need one more state, which it requests from the
        // peer with the lowest number.)
        let resynced = |e: &(usize, PeerEvent)| matches!(e.1, PeerEvent::Resynced { .. });
        assert!(mesh.events.iter().filter(|e| e.0 == 2 && resynced(e)).count() <= 1, "{:?}", mesh.events);
        let resynced = |e: &(usize, PeerEvent)| e.0 < 2 && resynced(e);
        assert!(!mesh.events.iter().any(resynced), "{:?}", mesh.events);
    }
}

/// Three hands beat one bar onto the floor, and another one falls onto it. Late inputs roll the
/// peers back over the blows.
#[test]
fn peers_step_contacts_to_the_bit_and_late_joiners_with_them() {
    let lowest = |around: Surroundings| {
        let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper1), 7);
        mesh.model = loose_bar(24, 0.05);
        mesh.other = Some(loose_bar(24, 0.05));
        mesh.settings.gravity = [0.0, -9.81, 0.0];
        mesh.hold = GrabConfig { stiffness: Some(400.0), relaxation: 0.01 };
        mesh.around = around;
        mesh.start(0, LateInputRepair::Rollback, true);
        mesh.start(1, LateInputRepair::Rollback, true);
        let mut lowest = f64::INFINITY;
        for half in 1..=24 {
            if half == 14 {
                mesh.start(2, LateInputRepair::Rollback, false);
            }
            mesh.run(half * S / 2);
            let p = mesh.peers[0].as_ref().unwrap();
            for tick in p.confirmed().saturating_sub(30)..=p.confirmed() {
                lowest = p.state_at(BODY, tick).map_or(lowest, |s| lowest.min(s.frame.center()[1]));
            }
        }
        assert!(!mesh.events.iter().any(|e| e.0 < 2 && matches!(e.1, PeerEvent::Resynced { .. })));
        assert_eq!((mesh.agree(0, 1), mesh.other_apart(0, 1)), (0.0, (0.0, 0.0)));
        let (far, bent) = mesh.other_apart(0, 2);
        println!("joiner: {:e} apart, the other bar {far:e} m and {bent:e}", mesh.agree(0, 2));
        assert!(mesh.agree(0, 2) < 1e-6 && far < 1e-6 && bent < 1e-6);
        let all: Vec<&PeerSession> = mesh.peers.iter().flatten().collect();
        let tick = all.iter().map(|p| p.confirmed()).min().unwrap();
        assert_eq!(all[0].pose_at(BODY, tick), all[1].pose_at(BODY, tick));
        assert!(all.iter().all(|p| p.body(BODY).unwrap().restepped() > 100), "late hands roll back");
        // The modes of this bar move it against its frame, so its surface tells where it lies.
        let (model, state) = (&mesh.model, all[0].state_at(OTHER, tick).unwrap());
        let height = |vertex: u32| {
            let patch = Patch::around(model.surface(), vertex, 0.0).unwrap();
            let patch = HeldPatch::new(model, &patch, model.mode_count()).unwrap();
            state.frame.to_world(patch.rest() + patch.displacement(&state.q, true)).y
        };
        (lowest, (0..68).map(height).fold(f64::INFINITY, f64::min))
    };
    let (held, fallen) = lowest(floor());
    let (unheld, gone) = lowest(Surroundings::default());
    println!("with the floor {held:.3} and {fallen:.3} m, without {unheld:.3} and {gone:.1} m");
    assert!(unheld < held - 0.01, "the hands beat it onto the floor");
    assert!((-0.2..-0.1).contains(&fallen) && gone < -50.0, "the other one lies on the floor");
}

#[test]
fn clocks_that_differ_by_years_change_nothing_among_peers() {
    let year = Duration::from_secs(365 * 86_400);
    let go = |began: [Duration; 3]| {
        let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper1), 4);
        mesh.began = began.to_vec();
        mesh.start(0, LateInputRepair::Rollback, true);
        mesh.start(1, LateInputRepair::Rollback, true);
        mesh.run(4 * S);
        // The third peer joins late, with a clock that is decades off.
        mesh.start(2, LateInputRepair::Rollback, false);
        mesh.run(10 * S);
        assert_eq!((mesh.agree(0, 1), mesh.agree(0, 2)), (0.0, 0.0), "to the bit");
        let ticks: Vec<u64> = mesh.peers.iter().flatten().map(PeerSession::tick).collect();
        assert!(ticks.iter().max().unwrap() - ticks.iter().min().unwrap() <= 8, "{ticks:?}");
        ticks
    };
    let one_age = go([Duration::ZERO; 3]);
    for began in [[Duration::ZERO, 30 * year, 60 * year], [60 * year, Duration::ZERO, 30 * year]] {
        let ticks = go(began);
        let apart = ticks.iter().zip(&one_age).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        assert!(apart <= 2, "{ticks:?} where one clock has {one_age:?}");
    }
}

#[test]
fn a_peer_that_stalls_for_two_seconds_catches_up_within_one() {
    let mut mesh = Mesh::new(3, &LinkConfig { delay: 30 * MS, ..LinkConfig::default() }, 3);
    (0..3).for_each(|k| mesh.start(k, LateInputRepair::Rollback, true));
    mesh.run(4 * S);
    // Its process stands still, and what arrives is lost.
    let stalled = mesh.peers[1].take();
    mesh.run(6 * S);
    mesh.peers[1] = stalled;
    let behind = |mesh: &Mesh| {
        let tick = |k: usize| mesh.peers[k].as_ref().unwrap().tick();
        tick(0) - tick(1).min(tick(0))
    };
    assert!(behind(&mesh) > 70, "{}", behind(&mesh));
    mesh.run(7 * S);
    assert!(behind(&mesh) <= 8, "{} ticks behind after a second", behind(&mesh));
    mesh.run(9 * S);
    let left = mesh.events.iter().any(|(_, event)| matches!(event, PeerEvent::Left { .. }));
    assert!(!left, "nobody has left");
    let off = mesh.agree(0, 1);
    assert!(off < 1e-6, "{off}");
}

#[test]
fn two_of_four_peers_that_stall_together_catch_up_within_a_second() {
    let mut mesh = Mesh::new(4, &LinkConfig { delay: 30 * MS, ..LinkConfig::default() }, 3);
    (0..4).for_each(|k| mesh.start(k, LateInputRepair::Rollback, true));
    mesh.run(4 * S);
    let stalled = [1, 2].map(|k| mesh.peers[k].take());
    mesh.run(6 * S);
    for (k, peer) in [1, 2].into_iter().zip(stalled) {
        mesh.peers[k] = peer;
    }
    mesh.run(7 * S);
    let ticks: Vec<u64> = mesh.peers.iter().flatten().map(PeerSession::tick).collect();
    assert!(ticks.iter().max().unwrap() - ticks.iter().min().unwrap() <= 8, "{ticks:?}");
    mesh.run(9 * S);
    for other in 1..4 {
        let off = mesh.agree(0, other);
        assert!(off < 1e-6, "{other}: {off}");
    }
}

#[test]
fn a_peer_that_dies_lets_go() {
    let mut mesh = Mesh::new(3, &LinkConfig::preset(Preset::Paper3), 9);
    for k in 0..3 {
        mesh.start(k, LateInputRepair::Rollback, true);
    }
    mesh.run(5 * S);
    mesh.peers[2] = None;
    mesh.run(20 * S);
    let left = |e: &(usize, PeerEvent)| {
        matches!(e.1, PeerEvent::Left { user: UserId(3), reason: DisconnectReason::Silent })
    };
    assert_eq!(mesh.events.iter().filter(|e| left(e)).count(), 2);
    assert_eq!(mesh.peers[0].as_ref().unwrap().body(BODY).unwrap().grabs().len(), 2);
    assert!(mesh.agree(0, 1) < 1e-3, "{}", mesh.agree(0, 1));
}
