//! Tests the paper's compensation against direct integration.

use pliant_stream::codec::quantization::Quanta;
use pliant_stream::recovery::{AccelerationDriven, History, Recovery};
use pliant_stream::wire::{Accelerations, TickFrame};
use pliant_stream::{BodyId, Newmark, Predict, State};

fn frame(tick: u64, a: &[f64]) -> TickFrame {
    TickFrame {
        body: BodyId(1),
        tick,
        run: 0,
        resting: false,
        resent: false,
        displacements: false,
        part: None,
        grabs: Vec::new(),
        pose: None,
        accelerations: Some(Accelerations::F64(a.to_vec())),
        slice: None,
        check: None,
        repeats: Vec::new(),
    }
}

/// Newmark pairs (beta, gamma) from the paper's to generalized-alpha's, and two unusual ones.
const PAIRS: [(f64, f64); 5] =
    [(0.25, 0.5), (4.0 / 9.0, 5.0 / 6.0), (1.0 / 6.0, 0.5), (0.3, 0.6), (0.0, 0.5)];

#[test]
fn equations_8_and_9_hold_to_rounding_for_any_newmark() {
    // Integrate with and without a wrong acceleration at tick i. At every later tick j the
    // difference must match the identity.
    for (beta, gamma) in PAIRS {
        for h in [1.0 / 40.0, 1.0 / 1000.0] {
            let newmark = Newmark { h, beta, gamma };
            let (i, da) = (7_u64, 3.25);
            let (mut q, mut v) = ((0.0, 0.0), (0.0, 0.0));
            let a = |n: u64| (n as f64 * 0.37).sin() * 5.0;
            let wrong = |n: u64| a(n) + if n == i { da } else { 0.0 };
            for n in 1..=200_u64 {
                let right_step = newmark.step(q.0, v.0, a(n - 1), a(n));
                let wrong_step = newmark.step(q.1, v.1, wrong(n - 1), wrong(n));
                (q, v) = ((right_step.0, wrong_step.0), (right_step.1, wrong_step.1));
                if n < i {
                    continue;
                }
                let (dq, dv) = (q.1 - q.0, v.1 - v.0);
                let (want_q, want_v) = if n == i {
                    (beta * h * h * da, gamma * h * da)
                } else {
                    (((n - i) as f64 + gamma - 0.5) * h * h * da, h * da)
                };
                let scale = q.0.abs().max(1e-3);
                assert!(
                    (dq - want_q).abs() < 1e-13 * scale,
                    "beta {beta} gamma {gamma} h {h} tick {n}: {dq} {want_q}"
                );
                assert!((dv - want_v).abs() < 1e-13 * v.0.abs().max(1.0), "velocity at {n}: {dv} {want_v}");
                let response = newmark.response(n - i);
                assert!((response.0 * da - want_q).abs() < 1e-18 && (response.1 * da - want_v).abs() < 1e-18);
            }
        }
    }
}

#[test]
fn every_late_acceleration_takes_its_error_out_exactly() {
    // The paper's three loss patterns: 22 at random from 135, 12 in a row from 140, and one in 50
    // from tick 135. Each acceleration arrives 50 ticks late.
    let random: Vec<u64> = (0..22).map(|k| 135 + (k * k * 7 + k * 13) % 500).collect();
    let burst: Vec<u64> = (140..152).collect();
    let every: Vec<u64> = (0..11).map(|k| 135 + 50 * k).collect();
    for lost in [random, burst, every] {
        for predict in [Predict::Zero, Predict::Hold, Predict::Linear] {
            for (beta, gamma) in PAIRS {
                let newmark = Newmark { h: 0.025, beta, gamma };
                let truth = |n: u64| [(n as f64 * 0.11).sin(), 40.0 * (n as f64 * 0.53).cos()];
                let mut whole = State::zero(2, false);
                let mut history = History::new(0);
                let mut receiver = AccelerationDriven::new(newmark, predict, true, 2);
                let mut drifting = AccelerationDriven::new(newmark, predict, false, 2);
                let mut largest = 0.0_f64;
                for n in 1..=720_u64 {
                    newmark.advance(&mut whole, &truth(n));
                    if !lost.contains(&n) {
                        history.take(&frame(n, &truth(n)), &Quanta::even(2), |_, _| {});
                    }
                    receiver.advance(n, &history);
                    drifting.advance(n, &history);
                    if n > 50 && lost.contains(&(n - 50)) {
                        history.take(&frame(n - 50, &truth(n - 50)), &Quanta::even(2), |_, _| {});
                        assert!(receiver.correct(n - 50, &history));
                        assert!(!drifting.correct(n - 50, &history));
                    }
                    largest = largest.max(whole.q[1].abs()).max(whole.q[0].abs());
                }
                for k in 0..2 {
                    let error = (receiver.confirmed().q[k] - whole.q[k]).abs() / largest;
                    assert!(
                        error < 1e-9,
                        "{predict:?} beta {beta}: {error:e} of the scale after the last repair"
                    );
                }
                let drift = (drifting.confirmed().q[1] - whole.q[1]).abs() / largest;
                assert!(drift > 1e-5, "without compensation the error stays: {drift:e}");
            }
        }
    }
}

#[test]
fn a_wrong_velocity_that_stays_drifts_linearly() {
    // The theorem for an uncompensated loss predicts a constant velocity error h da and a
    // displacement error that grows by h^2 da per tick.
    let newmark = Newmark::average(0.025);
    let mut history = History::new(0);
    let mut receiver = AccelerationDriven::new(newmark, Predict::Zero, false, 1);
    for n in 1..=120_u64 {
        if n != 20 {
            history.take(&frame(n, &[if n == 20 { 2.0 } else { 0.0 }]), &Quanta::even(1), |_, _| {});
        }
        receiver.advance(n, &history);
    }
    // The true acceleration is 2 at tick 20 only. The receiver uses 0 throughout.
    let (mut q, mut v) = (0.0, 0.0);
    for n in 1..=120_u64 {
        let a = |n| if n == 20 { 2.0 } else { 0.0 };
        (q, v) = newmark.step(q, v, a(n - 1), a(n));
    }
    assert!((v - receiver.confirmed().v[0] - 0.025 * 2.0).abs() < 1e-15);
    assert!((q - receiver.confirmed().q[0] - 100.0 * 0.025 * 0.025 * 2.0).abs() < 1e-13);
}
