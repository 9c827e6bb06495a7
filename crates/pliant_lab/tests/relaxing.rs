//! Bodies that relax: the viscoelastic state streams, recovers and decays like the rest of the
//! state.

use crate::support;

use std::time::Duration;

use pliant_lab::experiment::Experiment;
use pliant_modal::{Body, BodyConfig, GrabConfig, Patch, Relaxation};
use pliant_stream::codec::encoder::Encoder;
use pliant_stream::emulator::{LinkConfig, Loss, Preset};
use pliant_stream::peer::LateInputRepair;
use pliant_stream::recovery::Receiver;
use pliant_stream::wire::Datagram;
use pliant_stream::{
    BodyId, GrabKey, GrabState, GuestSessionConfig, HostSessionConfig, Newmark, RecoveryConfig, State,
    StepSettings, TickState, UserId,
};
use support::bar;
use support::scene::{BODY, S, Scene, cached, circling, paper1};

const MATERIAL: Relaxation = Relaxation { ratio: 0.6, time: 0.5 };
const H: f64 = 0.025;

#[test]
fn every_policy_streams_a_relaxing_body_as_well_as_an_elastic_one() {
    for name in RecoveryConfig::NAMES {
        let recovery = RecoveryConfig::by_name(name).unwrap();
        let run = |relaxation: Option<Relaxation>| {
            // A burst of six losses and then time to recover. Any error at the end is one that does
            // not decay.
            let link = LinkConfig {
                loss: Loss::Burst { first: 140, count: 6 },
                ..LinkConfig::preset(Preset::Paper1)
            };
            let mut e = Experiment::new(bar(40, 0.05), link, recovery);
            (e.seconds, e.relaxation) = (14.0, relaxation);
            e.run().unwrap()
        };
        let (elastic, relaxing) = (run(None), run(Some(MATERIAL)));
        println!(
            "{name}: elastic rms {:.4} % max {:.3} % end {:.1e} %, relaxing rms {:.4} % max {:.3} % end {:.1e} % force {:.3} %",
            elastic.rms_percent,
            elastic.max_percent,
            elastic.confirmed_end_percent,
            relaxing.rms_percent,
            relaxing.max_percent,
            relaxing.confirmed_end_percent,
            relaxing.force_rms_percent
        );
        assert!(relaxing.ticks > 500, "{name}");
        if name != "none" {
            assert!(
                relaxing.confirmed_end_percent < 0.01,
                "{name}: {} % stay",
                relaxing.confirmed_end_percent
            );
            assert!(relaxing.rms_percent < 3.0 * elastic.rms_percent + 0.01, "{name}");
        }
        if name == "default" {
            assert!(relaxing.rms_percent < 0.2 && relaxing.max_percent < 5.0, "{name}");
            assert!(relaxing.kbit_s < 100.0, "{} kbit/s", relaxing.kbit_s);
        }
    }
}

#[test]
fn peers_step_a_relaxing_body_together() {
    let link = LinkConfig::preset(Preset::Paper2);
    let mut e = Experiment::new(bar(40, 0.05), link, RecoveryConfig::default());
    (e.seconds, e.relaxation) = (15.0, Some(MATERIAL));
    let f = e.run_peers(LateInputRepair::Rollback).unwrap();
    assert!(f.rms_percent < 2.0, "{} %", f.rms_percent);
}

/// Errors of a receiver that starts with a wrong viscoelastic state: per tick, the relative errors
/// of the shape and of the viscoelastic state.
fn wrong_state(recovery: &RecoveryConfig, ticks: u64) -> Vec<(f64, f64)> {
    let model = bar(24, 0.05);
    let integrator = recovery.integrator();
    let settings = StepSettings { integrator, relaxation: Some(MATERIAL), ..Default::default() };
    let config = BodyConfig {
        step: H,
        settings: StepSettings { integrator, relaxation: Some(MATERIAL), ..Default::default() },
        ..Default::default()
    };
    let mut truth = Body::new(model.clone(), config).unwrap();
    let patch = Patch::around(model.surface(), 66, 0.05).unwrap();
    let hand = truth.grab(&patch, GrabConfig::default()).unwrap();
    let start = truth.grab_position(hand).unwrap();
    let (beta, gamma) = integrator.newmark().unwrap_or((4.0 / 9.0, 5.0 / 6.0));
    let newmark = Newmark { h: H, beta, gamma };
    let mut encoder =
        Encoder::new(BodyId(1), model.clone(), &settings, newmark, recovery.subscription(None), 1200)
            .unwrap();
    let mut receiver: Option<Receiver> = None;
    let mut errors = Vec::new();
    for tick in 1..=200 + ticks {
        let t = tick as f64 * H;
        truth
            .set_target(hand, [start[0], start[1] + 0.1 * (0.9 * t).sin(), start[2] + 0.1 * t.min(1.0)])
            .unwrap();
        truth.step().unwrap();
        let grabs = [GrabState {
            key: GrabKey { user: UserId(1), grab: 0 },
            vertex: 66,
            radius: 0.05,
            target: truth.target(hand).unwrap(),
            reaction: truth.reaction(hand).unwrap(),
            hold: GrabConfig::default(),
        }];
        let (q, v, a, z) = (truth.q(), truth.v(), truth.a(), truth.z());
        let state = TickState { tick, q, v, a, z, pose: None, grabs: &grabs, resting: false };
        if tick < 200 {
            continue;
        }
        let Some(receiver) = &mut receiver else {
            encoder.restart(&state);
            let mut snapshot = encoder.snapshot(false);
            assert_eq!(snapshot.z.len(), 24, "a snapshot carries the viscoelastic state");
            snapshot.z.fill(0.0);
            receiver =
                Some(Receiver::new(model.clone(), settings, 24, newmark, recovery, &snapshot).unwrap());
            continue;
        };
        let mut bytes = vec![1, 0, 0];
        bytes.extend_from_slice(&encoder.encode(&state).first);
        let Datagram::Frame(frame) = Datagram::decode(&bytes).unwrap().1 else { unreachable!() };
        receiver.accept(&frame);
        receiver.advance();
        let distance = |of: fn(&State) -> &Vec<f64>, truth: &[f64]| {
            let size = truth.iter().map(|x| x * x).sum::<f64>().sqrt();
            of(receiver.confirmed()).iter().zip(truth).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
                / size
        };
        errors.push((distance(|s| &s.q, q), distance(|s| &s.z, z)));
    }
    errors
}

#[test]
fn a_wrong_state_is_forgotten_by_every_policy_and_put_right_by_slices() {
    for (name, refresh, after) in [("default", 0, 400), ("default", 15, 40), ("paper", 0, 400)] {
        let recovery = RecoveryConfig { refresh, snapshots: false, ..RecoveryConfig::by_name(name).unwrap() };
        let errors = wrong_state(&recovery, after);
        let (first, last) = (errors[0], errors[errors.len() - 1]);
        println!(
            "{name}, refresh {refresh}: viscoelastic state off by {:.3}, then {:.1e}; shape {:.1e}, then {:.1e}",
            first.1, last.1, first.0, last.0
        );
        assert!(first.1 > 0.1, "{name}: the viscoelastic state must be wrong to begin with: {}", first.1);
        assert!(
            last.1 < 2e-3,
            "{name}, refresh {refresh}: viscoelastic state off by {} after {after} ticks",
            last.1
        );
        assert!(last.0 < 2e-3, "{name}, refresh {refresh}: shape off by {}", last.0);
    }
}

#[test]
fn a_guest_joins_follows_rests_and_feels_a_relaxing_body() {
    let model = bar(40, 0.05);
    let settings = StepSettings { relaxation: Some(MATERIAL), ..Default::default() };
    let mut pair = pliant_lab::pair::Pair::new(HostSessionConfig::default()).unwrap();
    pair.host.add_body(BODY, "bar", model.clone(), settings).unwrap();
    let mut scene = Scene::with(&model, &settings);
    scene.hand = circling();
    pair.join_with(GuestSessionConfig::default(), paper1(), 1, cached(&model)).unwrap();
    pair.run_until(8 * S, &mut scene);
    // The second guest joins late and gets the viscoelastic state with the snapshot.
    pair.join_with(GuestSessionConfig::default(), paper1(), 2, cached(&model)).unwrap();
    scene.settled = 10 * S;
    pair.run_until(20 * S, &mut scene);
    let worst = scene.worst / scene.size();
    assert!(worst < 0.05, "{worst}");
    let own = pair.guests[0].session.body(BODY).unwrap().predicted_hand().expect("it holds the body");
    // The copy is ahead by the round trip. Compare its reaction with the host's current one, which
    // changes little for a slow hand.
    let truth = scene.body.reaction(scene.grabs[0].1).unwrap();
    let felt = own.reaction(0).unwrap();
    let size = truth.iter().map(|x| x * x).sum::<f64>().sqrt();
    let off = (0..3).map(|k| (truth[k] - felt[k]).powi(2)).sum::<f64>().sqrt();
    println!("worst {worst:.4}, own reaction off by {:.3} of {size:.2} N", off / size);
    assert!(off < 0.3 * size, "{felt:?} and {truth:?}");
    let view = pair.guests[1].session.body(BODY).unwrap();
    assert!(view.confirmed().unwrap().z.iter().any(|z| *z != 0.0));
    assert_eq!(view.counts().mismatches, 0, "the checksum counts the viscoelastic state");
    assert!(pair.now() >= Duration::from_secs(20));
}
