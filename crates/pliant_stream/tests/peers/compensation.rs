//! The paper's compensation of late inputs, as peers use it.

use std::time::Duration;

use pliant_modal::{GrabConfig, Relaxation};
use pliant_stream::emulator::{LinkConfig, Preset};
use pliant_stream::peer::{LateInputRepair, PeerSession, PeerSessionConfig};
use pliant_stream::wire::{Datagram, HeldAt, InputTick, Inputs};
use pliant_stream::{PeerId, State, StepSettings, UserId};

use super::mesh::{Mesh, greeted};
use super::support::{bar, loose_bar};
use super::{BODY, MS, S};

#[test]
fn compensation_keeps_a_free_relaxing_body_together() {
    let mut mesh = Mesh::new(2, &LinkConfig::preset(Preset::Paper3), 11);
    mesh.settings.relaxation = Some(Relaxation { ratio: 0.5, time: 0.4 });
    mesh.model = loose_bar(24, 0.05);
    mesh.start(0, LateInputRepair::Compensate, true);
    mesh.start(1, LateInputRepair::Compensate, true);
    mesh.run(15 * S);
    let all: Vec<&PeerSession> = mesh.peers.iter().flatten().collect();
    let tick = all.iter().map(|p| p.confirmed()).min().unwrap();
    let place = |k: usize| all[k].pose_at(BODY, tick).unwrap().position;
    let apart = (0..3).map(|k| (place(0)[k] - place(1)[k]).powi(2)).sum::<f64>().sqrt();
    println!("compensation: frames {apart:.2e} m apart, shapes {:.5}", mesh.agree(0, 1));
    assert!(apart < 1.5e-4, "{apart} m");
    assert!(mesh.agree(0, 1) < 0.004, "{}", mesh.agree(0, 1));
}

/// The paper's equations (8) and (9) for a late input: `n` ticks after it, the velocity is off by
/// `h da`, and the place by `n h^2 da` (average acceleration). They hold at every tick of the
/// history, from which later corrections begin and which checks are made of, and not at the present
/// tick alone.
#[test]
fn compensation_corrects_every_tick_of_the_history() {
    const LATE: u64 = 30;
    const LAST: u64 = 60;
    let step = PeerSessionConfig::default().step;
    for free in [false, true] {
        let config =
            PeerSessionConfig { user: UserId(2), repair: LateInputRepair::Compensate, ..Default::default() };
        let mut p = PeerSession::new(config).unwrap();
        let model = if free { loose_bar(24, 0.05) } else { bar(24, 0.05) };
        p.add_body(BODY, model, &StepSettings::default()).unwrap();
        greeted(&mut p);
        let send = |p: &mut PeerSession, tick: u64, aside: f64, sequence: u16| {
            let target = [1.0, 0.18 + aside, 0.08];
            let (body, grab, vertex, radius, hold) = (BODY, 0, 66, 0.05, GrabConfig::default());
            let held = vec![HeldAt { body, grab, vertex, radius, target, hold }];
            let ticks = vec![InputTick { tick, held, impulses: Vec::new() }];
            let inputs = Datagram::Inputs(Inputs { now: tick, ahead: None, ticks, check: None });
            p.on_datagram(25 * MS * p.tick() as u32, PeerId(1), &inputs.encode(sequence));
        };
        p.update(Duration::ZERO);
        while p.tick() < LAST {
            let next = p.tick() + 1;
            if next != LATE {
                send(&mut p, next, 0.0, next as u16);
            }
            p.update(25 * MS * next as u32 + MS);
        }
        let history = |p: &PeerSession| -> Vec<State> {
            (1..=LAST).map(|tick| p.state_at(BODY, tick).unwrap().clone()).collect()
        };
        let before = history(&p);
        send(&mut p, LATE, 0.02, LATE as u16);
        assert_eq!(p.update(25 * MS * LAST as u32 + MS), 0, "no step");
        let after = history(&p);
        let body = p.body(BODY).unwrap();
        assert_eq!(
            (&body.live().q, body.live().frame),
            (&after[LAST as usize - 1].q, after[LAST as usize - 1].frame)
        );
        // Place and velocity of each mode, and of the center of mass of a free body.
        let all = |s: &State| -> (Vec<f64>, Vec<f64>) {
            let (place, speed) = (s.frame.center(), s.frame.velocity());
            (s.q.iter().copied().chain(place).collect(), s.v.iter().copied().chain(speed).collect())
        };
        let off: Vec<(Vec<f64>, Vec<f64>)> = (before.iter().zip(&after))
            .map(|(before, after)| {
                let ((q, v), (to_q, to_v)) = (all(before), all(after));
                let minus = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a - b).collect();
                (minus(&to_q, &q), minus(&to_v, &v))
            })
            .collect();
        let of = |tick: u64| &off[tick as usize - 1];
        let largest = of(LAST).0.iter().fold(0.0f64, |m, x| m.max(x.abs()));
        assert!(largest > 1e-4, "the late input must matter: {largest}");
        let mut worst = 0.0f64;
        for tick in 1..=LAST {
            let ((place, speed), (_, last)) = (of(tick), of(LAST));
            for k in 0..place.len() {
                let (modal, n) = (k < 24, tick.saturating_sub(LATE) as f64);
                let wrong = match tick {
                    ..LATE => place[k].abs() + speed[k].abs(),
                    // At the tick itself, both are what the solver gives.
                    LATE => 0.0,
                    _ if modal => (place[k] - n * step * last[k]).abs() + step * (speed[k] - last[k]).abs(),
                    _ => {
                        (place[k] - of(LATE).0[k] - n * step * last[k]).abs()
                            + step * (speed[k] - last[k]).abs()
                    }
                };
                worst = worst.max(wrong / largest);
            }
        }
        println!("free {free}: the history is off by {worst:.1e} of the correction");
        assert!(worst < 1e-9, "{worst}");
        assert_eq!(body.restepped(), 1, "one tick is corrected");
    }
}
