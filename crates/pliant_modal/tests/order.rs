//! Order of accuracy of the reaction, compared with the modal equations integrated in very small
//! steps.
#![allow(clippy::unwrap_used, missing_docs, reason = "a failed test should panic")]

mod rod;

use std::sync::Arc;

use pliant_modal::{Body, BodyConfig, GrabConfig, ModalModel, Patch, StepSettings};
use rod::{rod, tip};

const MODES: usize = 8;
/// Durations of the hand's motion and of the whole run, s.
const MOVES: f64 = 0.5;
const WATCHED: f64 = 1.0;

/// Displacement of the hand, m, smooth up to its third derivative.
fn way(t: f64) -> f64 {
    let x = (t / MOVES).clamp(0.0, 1.0);
    0.05 * x.powi(4) * (35.0 - x * (84.0 - x * (70.0 - 20.0 * x)))
}

fn patch(model: &ModalModel) -> Patch {
    Patch::around(model.surface(), tip(), 0.1).unwrap()
}

/// Returns the reaction along the rod at the end of each step, N.
fn felt(model: &Arc<ModalModel>, hz: f64, second_order: bool) -> Vec<f64> {
    let config = BodyConfig {
        step: 1.0 / hz,
        settings: StepSettings { second_order, warp: false, ..Default::default() },
        ..Default::default()
    };
    let mut body = Body::new(model.clone(), config).unwrap();
    let grab = body.grab(&patch(model), GrabConfig::default()).unwrap();
    let [x, y, z] = body.target(grab).unwrap();
    (1..=(WATCHED * hz) as usize)
        .map(|step| {
            body.set_target(grab, [x + way(step as f64 / hz), y, z]).unwrap();
            body.step().unwrap();
            body.reaction(grab).unwrap()[0]
        })
        .collect()
}

/// Returns the same reaction from `q'' + c q' + omega^2 q = phi (target - phi . q) / C`.
///
/// It uses the Runge-Kutta method in steps of 1/`fine` s and samples at multiples of 1/`hz` s.
fn exact(model: &Arc<ModalModel>, hz: f64, fine: f64) -> Vec<f64> {
    let mut body = Body::new(model.clone(), BodyConfig::default()).unwrap();
    let patch = patch(model);
    let grab = body.grab(&patch, GrabConfig::default()).unwrap();
    let compliance = body.compliance(grab).unwrap()[0][0];
    let phi: Vec<f64> = (0..MODES)
        .map(|mode| {
            let row = |&(v, w): &(u32, f64)| w * f64::from(model.displacement_row(v, 0, mode));
            patch.entries().iter().map(row).sum()
        })
        .collect();
    let pull =
        |q: &[f64], t: f64| (way(t) - phi.iter().zip(q).map(|(phi, q)| phi * q).sum::<f64>()) / compliance;
    let slope = |state: &[f64], t: f64| -> Vec<f64> {
        let (q, v) = state.split_at(MODES);
        let pull = pull(q, t);
        let a =
            (0..MODES).map(|k| phi[k] * pull - model.damping()[k] * v[k] - model.omega()[k].powi(2) * q[k]);
        v.iter().copied().chain(a).collect()
    };
    let add =
        |s: &[f64], k: &[f64], h: f64| -> Vec<f64> { s.iter().zip(k).map(|(s, k)| s + h * k).collect() };
    let (h, every) = (1.0 / fine, (fine / hz) as usize);
    let mut state = vec![0.0; 2 * MODES];
    let mut out = Vec::new();
    for step in 0..(WATCHED * fine) as usize {
        let t = step as f64 * h;
        let k1 = slope(&state, t);
        let k2 = slope(&add(&state, &k1, 0.5 * h), t + 0.5 * h);
        let k3 = slope(&add(&state, &k2, 0.5 * h), t + 0.5 * h);
        let k4 = slope(&add(&state, &k3, h), t + h);
        for (i, s) in state.iter_mut().enumerate() {
            *s += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
        }
        if (step + 1) % every == 0 {
            out.push(-pull(&state[..MODES], t + h));
        }
    }
    out
}

/// Returns the largest and the root mean square difference, as shares of the largest force.
fn error(felt: &[f64], exact: &[f64]) -> (f64, f64) {
    let peak = exact.iter().fold(0.0f64, |peak, f| peak.max(f.abs()));
    let off = || felt.iter().zip(exact).map(|(a, b)| (a - b) / peak);
    (off().fold(0.0, |m, x| m.max(x.abs())), (off().map(|x| x * x).sum::<f64>() / exact.len() as f64).sqrt())
}

#[test]
fn what_a_hand_feels_is_of_second_order() {
    let model = Arc::new(rod(2e5, MODES, 0.05, false));
    let of = |hz: f64, second| error(&felt(&model, hz, second), &exact(&model, hz, 192_000.0));
    for hz in [60.0, 120.0, 240.0, 480.0] {
        let (first, second) = (of(hz, false), of(hz, true));
        println!(
            "{hz} Hz: first order {:.2} % (rms {:.2} %), second {:.3} % (rms {:.3} %)",
            100.0 * first.0,
            100.0 * first.1,
            100.0 * second.0,
            100.0 * second.1
        );
    }
    let errors: Vec<f64> = [120.0, 240.0, 480.0].map(|hz| of(hz, true).1).to_vec();
    for pair in errors.windows(2) {
        assert!(pair[0] / pair[1] > 3.3, "half the step, a quarter of the error: {errors:?}");
    }
    assert!(of(60.0, true).1 < 0.3 * of(60.0, false).1);
}
