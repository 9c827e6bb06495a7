//! Hands with dampers: a damper has no static force and removes energy.
#![allow(clippy::unwrap_used, missing_docs, reason = "a failed test should panic")]

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};
use pliant_modal::{Body, BodyConfig, GrabConfig, GrabId, Integrator, ModalModel, Patch, StepSettings};

fn pip() -> Arc<ModalModel> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal");
    Arc::new(ModalModel::read(path).unwrap())
}

/// The work of gravity on a bent body is that of its potential, so the total energy stays constant
/// without damping.
#[test]
fn under_gravity_energy_stays() {
    let model = pip();
    let config = BodyConfig {
        step: 1.0 / 60.0,
        settings: StepSettings { damping_scale: 0.0, gravity: [25.0, -15.0, 10.0], ..Default::default() },
        ..Default::default()
    };
    let mut body = Body::new(model, config).unwrap();
    let (mut most, mut off) = (0.0f64, 0.0f64);
    for _ in 0..60 * 60 {
        body.step().unwrap();
        most = most.max(body.energy());
        off = off.max((body.energy() + body.potential_energy()).abs());
    }
    assert!(most > 1.0 && off < 1e-5 * most, "{off} J of {most} J");
}

/// Makes a body with two hands 2 cm apart and the given relaxation times of their dampers (s).
fn held(
    step: f64,
    integrator: Integrator,
    second_order: bool,
    warp: bool,
    relaxations: [f64; 2],
) -> (Body, [GrabId; 2]) {
    let model = pip();
    let config = BodyConfig {
        step,
        settings: StepSettings { integrator, second_order, warp, ..Default::default() },
        ..Default::default()
    };
    let mut body = Body::new(model.clone(), config).unwrap();
    let grabs = [(76, relaxations[0]), (63, relaxations[1])].map(|(vertex, relaxation)| {
        let patch = Patch::around(model.surface(), vertex, 0.0216).unwrap();
        body.grab(&patch, GrabConfig { relaxation, ..GrabConfig::default() }).unwrap()
    });
    (body, grabs)
}

/// Moves both hands 2 cm sideways and compares the final reaction on the second hand.
#[test]
fn a_damper_has_no_static_force() {
    const EXPECTED: f64 = -1.134;
    let times = [0.0, 1.0 / 60.0, 0.1, 2.0];
    for first in times {
        for second in times {
            let (mut body, grabs) = held(1.0 / 64.0, Integrator::Exact, true, false, [first, second]);
            let targets = grabs.map(|grab| body.target(grab).unwrap());
            for (grab, [x, y, z]) in grabs.into_iter().zip(targets) {
                body.set_target(grab, [x + 0.02, y, z]).unwrap();
            }
            for _ in 0..64 * 60 {
                body.step().unwrap();
            }
            let [force, ..] = body.reaction(grabs[1]).unwrap();
            println!("dampers of {first:.3} and {second:.3} s: {force:.4} N");
            assert!((force / EXPECTED - 1.0).abs() < 0.01, "{first} s and {second} s: {force} N");
        }
    }
}

/// Energy of the body and of the springs between patches and targets, J.
fn energy(body: &Body, grabs: &[GrabId]) -> f64 {
    let spring = |&grab: &GrabId| {
        let (from, to) = (body.grab_position(grab).unwrap(), body.target(grab).unwrap());
        let gap = Vector3::from(to) - Vector3::from(from);
        let compliance = body.compliance(grab).unwrap();
        let stiffness = Matrix3::from_fn(|i, j| compliance[i][j]).try_inverse().unwrap();
        0.5 * gap.dot(&(stiffness * gap))
    };
    body.energy() + grabs.iter().map(spring).sum::<f64>()
}

/// A second after the targets have come to rest, the energy must not grow for any pair of dampers.
/// Within that second, [`what_a_long_damper_gives_back_is_its_work_over_the_way`] bounds it.
#[test]
fn dampers_take_energy() {
    let times = [0.0, 0.01, 0.1, 0.5, 2.0, 10.0];
    let alpha = Integrator::GeneralizedAlpha { rho_inf: 0.5 };
    for (integrator, second_order) in [(Integrator::Exact, true), (Integrator::Exact, false), (alpha, true)] {
        for step in [1.0 / 40.0, 1.0 / 240.0] {
            for warp in [false, true] {
                for first in times {
                    for second in times {
                        // Two dampers of ten seconds still give back 2.0e-4 of the energy then, at
                        // first order with the warp. Nothing else gains 1e-9.
                        let lags = warp && !second_order && f64::min(first, second) > 2.0;
                        let room = if lags { 3e-4 } else { 1e-9 };
                        let (mut body, grabs) = held(step, integrator, second_order, warp, [first, second]);
                        let starts = grabs.map(|grab| body.target(grab).unwrap());
                        let mut least = f64::INFINITY;
                        let mut most = 0.0f64;
                        for k in 0..(6.0 / step) as usize {
                            let t = k as f64 * step;
                            let share = (t / 0.25).min(1.0);
                            for (i, (grab, [x, y, z])) in grabs.into_iter().zip(starts).enumerate() {
                                let way = 0.02 * share * if i == 0 { 1.0 } else { -0.5 };
                                body.set_target(grab, [x + way, y + 0.3 * way, z]).unwrap();
                            }
                            body.step().unwrap();
                            let now = energy(&body, &grabs);
                            most = most.max(now);
                            if t > 1.0 {
                                assert!(
                                    now <= least + room * most,
                                    "{integrator:?}, second order {second_order}, {step} s, warp {warp}, dampers {first} s and {second} s: \
                                     {now} J after {least} J, at {t} s"
                                );
                                least = least.min(now);
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Where the targets rest, the energy of a step changes by what its damping forces and its springs
/// say, and by nothing else.
///
/// Take a hand with the compliance `C` and the relaxation time `r`, a body without damping and a
/// step of first order. Over the step the patch goes the way `d = u1 - u0`, and the gap to the
/// target shrinks from `g0` to `g1 = g0 - d`. The force `F` is constant and obeys
/// `C F = g1 - r v`, with the velocity `v` of the patch at the end of the step. The modes take the
/// work `F . d` without any error (the step is exact), and the spring of the hand gives
/// `(g0 + g1) . C^-1 d / 2`. With `D = F - C^-1 g1 = -r C^-1 v`, the force of the damper,
///
/// ```text
/// E1 - E0 = F . d - (g0 + g1) . C^-1 d / 2 = D . d - d . C^-1 d / 2
/// ```
///
/// The second term only takes energy. The first one does too while the patch ends the step in the
/// direction in which it went, as it does when the step resolves the motion. A mode that turns
/// within a step may end it against its way: the damper then gives energy back. That is bounded by
/// the motion itself, since with no way there is no work, and each such turn costs the second term
/// too. Most of it comes when the targets stop: 7 % of the largest energy for dampers of ten
/// seconds at 60 Hz, 2 % for those of a second. [`dampers_take_energy`] shows that it is over a
/// second later.
#[test]
fn what_a_long_damper_gives_back_is_its_work_over_the_way() {
    let times = [[0.01, 0.01], [0.1, 0.1], [1.0, 0.0], [1.0, 1.0], [10.0, 2.0], [10.0, 10.0]];
    let mut given = 0.0f64;
    for (step, relaxations) in
        [40.0, 60.0, 240.0].into_iter().flat_map(|rate| times.map(|times| (1.0 / rate, times)))
    {
        let [undamped, damped] = [0.0, 1.0].map(|damping_scale| {
            let (mut body, grabs) = held(step, Integrator::Exact, false, false, relaxations);
            let mut config = body.config().clone();
            config.settings.damping_scale = damping_scale;
            body.reconfigure(config).unwrap();
            let starts = grabs.map(|grab| body.target(grab).unwrap());
            let stiffness = grabs.map(|grab| {
                let compliance = body.compliance(grab).unwrap();
                Matrix3::from_fn(|i, j| compliance[i][j]).try_inverse().unwrap()
            });
            let places = |body: &Body| grabs.map(|grab| Vector3::from(body.grab_position(grab).unwrap()));
            let (mut least, mut most, mut grown) = (f64::INFINITY, 0.0f64, 0.0f64);
            for k in 0..(6.0 / step) as usize {
                let share = (k as f64 * step / 0.25).min(1.0);
                for (i, (grab, [x, y, z])) in grabs.into_iter().zip(starts).enumerate() {
                    let way = 0.02 * share * if i == 0 { 1.0 } else { -0.5 };
                    body.set_target(grab, [x + way, y + 0.3 * way, z]).unwrap();
                }
                let (from, before) = (places(&body), energy(&body, &grabs));
                body.step().unwrap();
                let (to, now) = (places(&body), energy(&body, &grabs));
                most = most.max(now);
                // From the first step on in which the targets stand still.
                if (k as f64 - 1.0) * step < 0.25 - 1e-9 {
                    continue;
                }
                let mut expected = 0.0;
                for (i, grab) in grabs.into_iter().enumerate() {
                    let (way, end) = (to[i] - from[i], Vector3::from(body.target(grab).unwrap()));
                    let force = -Vector3::from(body.reaction(grab).unwrap());
                    let damper = force - stiffness[i] * (end - to[i]);
                    expected += damper.dot(&way) - 0.5 * way.dot(&(stiffness[i] * way));
                }
                let off = now - before - expected;
                // Damping of the body's own takes some more.
                let right = if damping_scale == 0.0 { off.abs() < 1e-9 * most } else { off < 1e-9 * most };
                assert!(right, "{step} s, {relaxations:?} s: off by {off} J of {most} J");
                least = least.min(before);
                grown = grown.max((now - least) / most);
            }
            grown
        });
        println!(
            "dampers of {relaxations:?} s, steps of {step:.4} s: {undamped:.1e} come back, {damped:.1e} in a damped body"
        );
        assert!(damped <= undamped && undamped < 0.1, "{undamped} and {damped}");
        given = given.max(undamped);
    }
    assert!(given > 1e-3, "nothing comes back any more: tell so in docs/limits.md");
}
