//! Viscoelastic bodies, compared with the closed forms of the standard linear solid.

use crate::rod;

use std::sync::Arc;

use nalgebra::{Complex, Matrix4, Vector4};
use pliant_modal::{
    Body, BodyConfig, Coefficients, GrabConfig, Integrator, ModalModel, Patch, Relaxation, StepError,
    StepSettings, ViscoelasticCoefficients,
};
use rod::{AREA, DENSITY, LENGTH, rod, tip};

const ALL: [Integrator; 4] = [
    Integrator::Exact,
    Integrator::Newmark,
    Integrator::GeneralizedAlpha { rho_inf: 0.5 },
    Integrator::GeneralizedAlpha { rho_inf: 0.0 },
];
const HARD: [f64; 5] = [0.0, 1e-9, 0.4, 0.95, 1.0 - 1e-9];

fn made(
    integrator: Integrator,
    omega: f64,
    c: f64,
    relaxation: Relaxation,
    h: f64,
) -> (Coefficients, ViscoelasticCoefficients) {
    Coefficients::relaxing(integrator, omega, c, relaxation, h).unwrap()
}

/// Returns the recurrence as one matrix on `(q, v, a, z)`, and the responses to unit forces at the
/// old and the new time.
fn matrix(made: &(Coefficients, ViscoelasticCoefficients)) -> (Matrix4<f64>, Vector4<f64>, Vector4<f64>) {
    let (c, f) = made;
    let m = Matrix4::from_fn(|i, j| match (i, j) {
        (3, 3) => f.carry,
        (3, j) => f.free[j],
        (i, 3) => f.onto[i],
        (i, j) => c.free[i][j],
    });
    let old = Vector4::from_fn(|i, _| if i == 3 { f.free[3] } else { c.free[i][3] });
    let new = Vector4::from_fn(|i, _| if i == 3 { f.response } else { c.response[i] });
    (m, old, new)
}

/// Classical Runge-Kutta integration with very many substeps.
fn reference(omega: f64, c: f64, r: Relaxation, h: f64, f: f64, from: [f64; 3]) -> [f64; 3] {
    let n = 40_000;
    let dt = h / f64::from(n);
    let k = omega * omega;
    let slope = |[q, v, z]: [f64; 3]| [v, f - c * v - k * (q - r.ratio * z), (q - z) / r.time];
    let along = |x: [f64; 3], s: [f64; 3], t: f64| -> [f64; 3] { std::array::from_fn(|i| x[i] + t * s[i]) };
    let mut x = from;
    for _ in 0..n {
        let a = slope(x);
        let b = slope(along(x, a, 0.5 * dt));
        let d = slope(along(x, b, 0.5 * dt));
        let e = slope(along(x, d, dt));
        x = std::array::from_fn(|i| x[i] + dt * (a[i] + 2.0 * b[i] + 2.0 * d[i] + e[i]) / 6.0);
    }
    x
}

#[test]
fn the_exact_step_is_exact() {
    let h = 0.025;
    for (omega, zeta) in [(0.001, 0.0), (30.0, 0.0), (30.0, 0.05), (30.0, 1.0), (30.0, 7.0), (900.0, 0.02)] {
        for (ratio, time) in
            [(0.4, 0.1), (0.95, 0.01), (0.3, 2e-4), (1e-9, 1.0), (0.6, 1.0 / 30.0), (0.5, 1e9)]
        {
            let (c, relaxation) = (2.0 * zeta * omega, Relaxation { ratio, time });
            let (table, viscoelastic) = made(Integrator::Exact, omega, c, relaxation, h);
            let from = [0.3, -2.0, 0.2];
            let want = reference(omega, c, relaxation, h, 5.0, from);
            let mut got = table.step([from[0], from[1], 0.0], 0.0, 5.0);
            (0..3).for_each(|i| got[i] += viscoelastic.onto[i] * from[2]);
            let z = viscoelastic.step([from[0], from[1], 0.0], from[2], 0.0, 5.0);
            let what = format!("omega {omega}, zeta {zeta}, {relaxation:?}");
            assert!((got[0] - want[0]).abs() < 1e-10, "q, {what}: {} and {}", got[0], want[0]);
            assert!((got[1] - want[1]).abs() < 1e-8, "v, {what}: {} and {}", got[1], want[1]);
            assert!((z - want[2]).abs() < 1e-10, "z, {what}: {z} and {}", want[2]);
            let a = 5.0 - c * got[1] - omega * omega * (got[0] - ratio * z);
            assert!((got[2] - a).abs() < 1e-9 * omega.max(1.0).powi(2), "a, {what}: {} and {a}", got[2]);
        }
    }
}

#[test]
fn without_a_ratio_it_is_the_elastic_step() {
    for integrator in ALL {
        for (omega, c, h) in [(30.0, 1.5, 0.02), (4e3, 80.0, 0.01), (0.5, 0.0, 0.1)] {
            let (table, viscoelastic) = made(integrator, omega, c, Relaxation { ratio: 0.0, time: 0.1 }, h);
            let elastic = Coefficients::new(integrator, omega, c, h).unwrap();
            let pairs = table.free.iter().flatten().chain(&table.response);
            for (got, want) in pairs.zip(elastic.free.iter().flatten().chain(&elastic.response)) {
                assert!(
                    (got - want).abs() <= 1e-11 * want.abs().max(1e-6),
                    "{integrator:?}: {got} and {want}"
                );
            }
            assert!(viscoelastic.onto.iter().all(|x| *x == 0.0));
        }
    }
}

#[test]
fn a_held_force_creeps_by_the_closed_form() {
    // A fast, critically damped mode tracks its force at once, so only the creep of the solid is
    // left.
    let (omega, relaxation) = (1e5, Relaxation { ratio: 0.7, time: 0.5 });
    for (integrator, tolerance) in
        [(Integrator::Exact, 1e-4), (Integrator::GeneralizedAlpha { rho_inf: 0.5 }, 6e-3)]
    {
        let h = 0.01;
        let (table, viscoelastic) = made(integrator, omega, 2.0 * omega, relaxation, h);
        let (mut x, mut z, mut old) = ([0.0; 3], 0.0, 0.0);
        for n in 1..=2_000 {
            let mut next = table.step(x, old, 1.0);
            (0..3).for_each(|i| next[i] += viscoelastic.onto[i] * z);
            z = viscoelastic.step(x, z, old, 1.0);
            (x, old) = (next, 1.0);
            let want = relaxation.creep(f64::from(n) * h) / (omega * omega);
            // For a force that starts within a step, generalized-alpha counts a third of a step
            // less.
            if n > 20 {
                assert!(
                    (x[0] / want - 1.0).abs() < tolerance,
                    "{integrator:?}, step {n}: {} and {want}",
                    x[0]
                );
            }
        }
        assert!((x[0] * omega * omega * (1.0 - 0.7) - 1.0).abs() < 1e-3, "it ends at the relaxed stiffness");
    }
}

#[test]
fn storage_and_loss_are_those_of_the_standard_linear_solid() {
    let relaxation = Relaxation { ratio: 0.6, time: 0.05 };
    let (mode, h) = (200.0f64, 3e-5);
    for integrator in ALL {
        let (m, old, new) = matrix(&made(integrator, mode, 0.0, relaxation, h));
        for at in [0.5, 5.0, 20.0, 100.0, 400.0f64] {
            // The response to a force `e^(i at t)` solves
            // `(e^(i at h) - M) x = old + new e^(i at h)`. The exact step takes its force as
            // constant over the step.
            let turn = Complex::from_polar(1.0, at * h);
            let held = integrator == Integrator::Exact;
            let push = old.map(Complex::from) + new.map(Complex::from) * turn;
            let system = Matrix4::from_diagonal_element(turn) - m.map(Complex::from);
            // The scaling makes rows and columns comparable.
            let s = Vector4::new(1.0, at, at * at, 1.0).map(Complex::from);
            let scaled = Matrix4::from_fn(|i, j| system[(i, j)] / s[i] * s[j]);
            let x = scaled.lu().solve(&push.component_div(&s)).unwrap();
            let sampled = if held {
                Complex::from_polar((0.5 * at * h).sin() / (0.5 * at * h), 0.5 * at * h)
            } else {
                Complex::from(1.0)
            };
            let modulus = (sampled / x[0] + at * at) / (mode * mode);
            let [storage, loss] = relaxation.complex_modulus(at);
            let bound = 1e-3;
            assert!(
                (modulus.re - storage).abs() < bound && (modulus.im - loss).abs() < bound,
                "{integrator:?} at {at} rad/s: {modulus}, wanted {storage} + {loss}i"
            );
        }
    }
}

#[test]
fn no_step_grows_at_any_stiffness_ratio_time_or_step() {
    for integrator in ALL {
        for h in [1e-4, 1e-3, 1.0 / 40.0, 0.1] {
            for omega in [1e-2, 1.0, 40.0, 1e3, 1e5, 1e7] {
                for zeta in [0.0, 0.02, 1.0, 30.0] {
                    for ratio in HARD {
                        for time in [1e-9, 1e-6, 1e-3, 0.1, 1.0 / omega, 10.0, 1e9] {
                            grows(integrator, h, omega, zeta, Relaxation { ratio, time });
                        }
                    }
                }
            }
        }
    }
}

/// Checks two hundred steps without forces from different initial states.
///
/// The energy, with the branch's share as the integrator weights it, never grows. With
/// generalized-alpha the energy never exceeds the largest value of the first hundred steps again.
fn grows(integrator: Integrator, h: f64, omega: f64, zeta: f64, relaxation: Relaxation) {
    let c = 2.0 * zeta * omega;
    let (table, viscoelastic) = made(integrator, omega, c, relaxation, h);
    let x = 0.5 * h / relaxation.time;
    let kept = match integrator {
        Integrator::Exact => 1.0,
        _ if x < 1e-4 => 1.0,
        _ => x / x.tanh(),
    };
    let r = relaxation.ratio;
    let energy = |[q, v, _]: [f64; 3], z: f64| {
        v * v + omega * omega * ((1.0 - r) * q * q + kept * r * (q - z) * (q - z))
    };
    for (q, v, z) in [(1.0, 0.0, 0.0), (0.0, omega, 0.0), (1.0, -omega, 1.0), (0.5, 0.0, 0.5 - 0.1 / kept)] {
        let mut state = [q, v, -c * v - omega * omega * (q - r * z)];
        let mut z = z;
        let first = energy(state, z);
        let (mut last, mut largest) = (first, first);
        for n in 0..200 {
            let mut next = table.step(state, 0.0, 0.0);
            (0..3).for_each(|i| next[i] += viscoelastic.onto[i] * z);
            z = viscoelastic.step(state, z, 0.0, 0.0);
            state = next;
            let now = energy(state, z);
            // Newmark's accelerations of a mode far above the step rate are large, and so are their
            // rounding errors.
            let bound = match integrator {
                Integrator::Exact => last + 1e-11 * first,
                Integrator::Newmark => last + (1e-12 + 1e-15 * omega * h * (omega + c) * h) * first,
                // Generalized-alpha is stable in its spectrum but not step by step in this norm, so
                // the first steps may overshoot.
                _ if n < 100 => f64::MAX,
                _ => largest * (1.0 + 1e-9),
            };
            assert!(
                now <= bound,
                "{integrator:?}, h {h}, omega {omega}, zeta {zeta}, {relaxation:?}, step {n}: {now} after {last}"
            );
            last = now;
            if n < 100 {
                largest = largest.max(now);
            }
        }
    }
}

fn tip_patch(model: &ModalModel) -> Patch {
    Patch::around(model.surface(), tip(), 0.01).unwrap()
}

#[test]
fn a_fast_pull_feels_the_instantaneous_stiffness_and_a_long_one_the_relaxed() {
    // Every mode and the residual flexibility relax alike, so a rod held at its tip relaxes as the
    // material does.
    let (young, pulled) = (2e5, 0.02);
    let relaxation = Relaxation { ratio: 0.6, time: 1.0 };
    for modes in [1, 3, 12] {
        for integrator in [Integrator::Exact, Integrator::GeneralizedAlpha { rho_inf: 0.5 }] {
            let model = Arc::new(rod(young, modes, 0.5, false));
            let h = 1.0 / 480.0;
            let config = BodyConfig {
                step: h,
                settings: StepSettings { integrator, relaxation: Some(relaxation), ..Default::default() },
                ..Default::default()
            };
            let mut body = Body::new(model.clone(), config).unwrap();
            let grab = body.grab(&tip_patch(&model), GrabConfig::default()).unwrap();
            let start = body.grab_position(grab).unwrap();
            body.set_target(grab, [start[0] + pulled, start[1], start[2]]).unwrap();
            let instantaneous = -young * AREA * pulled / LENGTH;
            for n in 1..=480 * 12 {
                body.step().unwrap();
                // The pull is a step in time, and the rod takes a few periods (0.3 s) to settle.
                let t = f64::from(n) * h;
                if t > 0.8 {
                    let got = body.reaction(grab).unwrap()[0] / instantaneous;
                    // The contact floor of a grab is half a percent of the compliance of this rod.
                    assert!(
                        (got / relaxation.modulus(t) - 1.0).abs() < 0.012,
                        "{integrator:?}, {modes} modes, {t} s: {got} and {}",
                        relaxation.modulus(t)
                    );
                }
            }
            let end = body.reaction(grab).unwrap()[0] / instantaneous;
            assert!((end / 0.4 - 1.0).abs() < 0.006, "{integrator:?}, {modes} modes: ends at {end}");
        }
    }
    // A material that takes a year to relax reacts elastically to a hand.
    let model = Arc::new(rod(young, 12, 0.5, false));
    let relaxation = Some(Relaxation { ratio: 0.6, time: 3e7 });
    let mut body =
        Body::new(model.clone(), BodyConfig::from(StepSettings { relaxation, ..Default::default() }))
            .unwrap();
    let grab = body.grab(&tip_patch(&model), GrabConfig::default()).unwrap();
    let start = body.grab_position(grab).unwrap();
    body.set_target(grab, [start[0] + pulled, start[1], start[2]]).unwrap();
    for _ in 0..600 {
        body.step().unwrap();
    }
    let got = body.reaction(grab).unwrap()[0] / (-young * AREA * pulled / LENGTH);
    assert!((got - 1.0).abs() < 0.006, "{got}");
}

#[test]
fn held_reactions_stay_smooth_and_finite_at_every_extreme() {
    for integrator in [Integrator::Exact, Integrator::GeneralizedAlpha { rho_inf: 0.5 }] {
        for young in [1e5, 1e9] {
            for step in [1e-4, 1.0 / 240.0, 0.1] {
                for ratio in HARD {
                    for time in [1e-9, 1e-3, 0.1, 1e9] {
                        let relaxation = Some(Relaxation { ratio, time });
                        let model = Arc::new(rod(young, 20, 0.05, false));
                        let config = BodyConfig {
                            step,
                            settings: StepSettings { integrator, relaxation, ..Default::default() },
                            ..Default::default()
                        };
                        let mut body = Body::new(model.clone(), config).unwrap();
                        let grab = body.grab(&tip_patch(&model), GrabConfig::default()).unwrap();
                        let start = body.grab_position(grab).unwrap();
                        let mut force = Vec::new();
                        for i in 0..400 {
                            let s = (f64::from(i) / 300.0).min(1.0);
                            let s = s * s * (3.0 - 2.0 * s);
                            body.set_target(grab, [start[0] + 0.05 * s, start[1], start[2]]).unwrap();
                            body.step().unwrap();
                            force.push(body.reaction(grab).unwrap()[0]);
                        }
                        let largest = force.iter().fold(0.0f64, |m, f| m.max(f.abs()));
                        // The reaction consists of stiffness and, for a fast pull, the wave
                        // impedance of the rod.
                        let speed = 1.5 * 0.05 / (300.0 * step);
                        let most = young * AREA * 0.05 / LENGTH + (young * DENSITY).sqrt() * AREA * speed;
                        assert!(largest <= 1.3 * most, "{largest} of {most}");
                        let flips = force.windows(3).map(|w| (w[2] - 2.0 * w[1] + w[0]).abs());
                        let ringing = flips.fold(0.0, f64::max) / largest.max(1e-12);
                        let what = format!("{integrator:?}, E {young}, h {step}, {relaxation:?}");
                        assert!(largest < 1e-9 || ringing < 0.5, "{what}: ringing {ringing}");
                        // After the release the body can only lose energy.
                        body.release(grab);
                        let before = body.energy();
                        for _ in 0..50 {
                            body.step().unwrap();
                        }
                        assert!(
                            body.energy() <= 1.02 * before + 1e-12,
                            "{what}: {before} to {}",
                            body.energy()
                        );
                    }
                }
            }
        }
    }
}

#[test]
fn the_state_has_the_viscoelastic_part() {
    let model = Arc::new(rod(2e5, 8, 0.05, false));
    let relaxation = Some(Relaxation { ratio: 0.5, time: 0.2 });
    let config = BodyConfig::from(StepSettings { relaxation, ..Default::default() });
    let mut body = Body::new(model.clone(), config.clone()).unwrap();
    let grab = body.grab(&tip_patch(&model), GrabConfig::default()).unwrap();
    let start = body.grab_position(grab).unwrap();
    body.set_target(grab, [start[0] + 0.05, start[1], start[2]]).unwrap();
    for _ in 0..30 {
        body.step().unwrap();
    }
    assert_eq!(body.z().len(), 8);
    assert!(body.z()[0] > 0.0 && body.z()[0] < body.q()[0]);
    assert!(body.grab_viscoelastic_state(grab).unwrap()[0] > 0.0);
    // A second body that takes over the state and the grab moves in the same way.
    let mut other = Body::new(model.clone(), config).unwrap();
    let hand = other.grab(&tip_patch(&model), GrabConfig::default()).unwrap();
    other.set_state(body.state()).unwrap();
    other.set_grab_viscoelastic_state(hand, body.grab_viscoelastic_state(grab).unwrap()).unwrap();
    other.set_mean_reaction(hand, body.mean_reaction(grab).unwrap()).unwrap();
    other.set_target(hand, body.target(grab).unwrap()).unwrap();
    for _ in 0..30 {
        body.step().unwrap();
        other.step().unwrap();
    }
    assert_eq!((body.q(), body.z(), body.reaction(grab)), (other.q(), other.z(), other.reaction(hand)));

    let mut bad = body.state().clone();
    bad.z[3] = f64::NAN;
    assert!(matches!(body.set_state(&bad), Err(StepError::Input { what: "z", .. })));
    bad.z.clear();
    assert!(matches!(body.set_state(&bad), Err(StepError::Length { what: "z", expected: 8, got: 0 })));
    assert!(body.set_grab_viscoelastic_state(grab, [f64::NAN, 0.0, 0.0]).is_err());
    // A switch to an elastic material and back clears the viscoelastic state.
    let held = body.config().clone();
    body.reconfigure(BodyConfig {
        settings: StepSettings { relaxation: None, ..held.settings },
        ..held.clone()
    })
    .unwrap();
    assert!(body.z().is_empty());
    body.step().unwrap();
    body.reconfigure(held).unwrap();
    assert_eq!(body.z(), [0.0; 8]);
}

#[test]
fn materials_that_are_none_are_refused() {
    let model = Arc::new(rod(2e5, 3, 0.05, false));
    for (ratio, time) in [
        (1.0, 1.0),
        (-0.1, 1.0),
        (f64::NAN, 1.0),
        (0.5, 0.0),
        (0.5, f64::NAN),
        (0.5, f64::INFINITY),
        (0.5, -1.0),
    ] {
        let relaxation = Some(Relaxation { ratio, time });
        assert!(
            Body::new(model.clone(), BodyConfig::from(StepSettings { relaxation, ..Default::default() }))
                .is_err()
        );
    }
    let relaxation = Relaxation { ratio: 0.5, time: 1.0 };
    assert!(Coefficients::relaxing(Integrator::Exact, 1e15, 0.0, relaxation, 0.1).is_err());
}
