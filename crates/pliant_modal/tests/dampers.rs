//! Hands with dampers: a damper has no static force and removes energy.

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

/// From the first step on in which the targets rest, the energy must not grow for any pair of
/// dampers.
///
/// Take a hand with the compliance `C` and the relaxation time `r`, a body without damping and a
/// step of first order. Over the step the patch goes the way `d`, and the gap to the target shrinks
/// from `g0` to `g1 = g0 - d`. The force `F` is constant and obeys `C F = g1 - r d / h`. The modes
/// take the work `F . d` without any error (the step is exact), and the spring of the hand gives
/// `(g0 + g1) . C^-1 d / 2`. The energy of the step then changes by
///
/// ```text
/// E1 - E0 = F . d - (g0 + g1) . C^-1 d / 2 = -(r / h + 1 / 2) d . C^-1 d
/// ```
///
/// which is never positive. A damper on the velocity at the end of the step has no such bound: a
/// mode that turns within the step ends it against its way. Up to 6.6 % of the largest energy came
/// back so.
#[test]
fn dampers_take_energy() {
    let times = [0.0, 0.01, 0.1, 0.5, 2.0, 10.0];
    let alpha = Integrator::GeneralizedAlpha { rho_inf: 0.5 };
    let mut worst = 0.0f64;
    for (integrator, second_order) in [(Integrator::Exact, true), (Integrator::Exact, false), (alpha, true)] {
        for step in [1.0 / 40.0, 1.0 / 60.0, 1.0 / 240.0] {
            for warp in [false, true] {
                for first in times {
                    for second in times {
                        let (mut body, grabs) = held(step, integrator, second_order, warp, [first, second]);
                        let starts = grabs.map(|grab| body.target(grab).unwrap());
                        let (mut least, mut most) = (f64::INFINITY, 0.0f64);
                        let mut grown = 0.0f64;
                        for k in 0..(3.0 / step) as usize {
                            let share = (k as f64 * step / 0.25).min(1.0);
                            for (i, (grab, [x, y, z])) in grabs.into_iter().zip(starts).enumerate() {
                                let way = 0.02 * share * if i == 0 { 1.0 } else { -0.5 };
                                body.set_target(grab, [x + way, y + 0.3 * way, z]).unwrap();
                            }
                            let before = energy(&body, &grabs);
                            body.step().unwrap();
                            let now = energy(&body, &grabs);
                            most = most.max(now);
                            if (k as f64 - 1.0) * step >= 0.25 - 1e-9 {
                                least = least.min(before);
                                grown = grown.max((now - least) / most);
                            }
                        }
                        if grown > 1e-9 {
                            println!(
                                "{integrator:?}, second order {second_order}, {step} s, warp {warp}, dampers {first} s and {second} s: {grown:.1e}"
                            );
                        }
                        worst = worst.max(grown);
                    }
                }
            }
        }
    }
    assert!(worst < 1e-9, "{worst}");
}

/// Reactions on one hand at the ticks of 60 Hz, N. The target goes to and fro by 2 cm within two
/// seconds, and trembles by 1 mm at 8 Hz if asked.
fn felt(rate: usize, stiffness: Option<f64>, relaxation: f64, trembles: bool) -> Vec<Vector3<f64>> {
    let model = pip();
    let config = BodyConfig { step: 1.0 / rate as f64, ..Default::default() };
    let mut body = Body::new(model.clone(), config).unwrap();
    let patch = Patch::around(model.surface(), 76, 0.0216).unwrap();
    let grab = body.grab(&patch, GrabConfig { stiffness, relaxation }).unwrap();
    let start = body.target(grab).unwrap();
    let mut forces = Vec::new();
    for k in 1..=4 * rate {
        let t = k as f64 / rate as f64;
        let slow = 0.01 * (1.0 - (std::f64::consts::PI * t).cos());
        let tremor = if trembles { 0.001 * (16.0 * std::f64::consts::PI * t).sin() } else { 0.0 };
        body.set_target(grab, [start[0] + slow, start[1] + tremor, start[2]]).unwrap();
        body.step().unwrap();
        if k % (rate / 60) == 0 {
            forces.push(Vector3::from(body.reaction(grab).unwrap()));
        }
    }
    forces
}

/// The reaction on a hand with a damper, against steps of 1/7680 s.
#[test]
fn a_damper_is_felt_as_with_fine_steps() {
    let cases = [
        ("400 N/m, 0.01 s, slow", Some(400.0), 0.01, false, [0.002, 0.001, 0.0005]),
        ("400 N/m, 0.01 s, trembles", Some(400.0), 0.01, true, [0.07, 0.028, 0.011]),
        ("no spring, 0.1 s, slow", None, 0.1, false, [0.004, 0.0016, 0.0006]),
        ("no spring, 1 s, slow", None, 1.0, false, [0.008, 0.0045, 0.002]),
    ];
    for (name, stiffness, relaxation, trembles, bounds) in cases {
        let fine = felt(7680, stiffness, relaxation, trembles);
        let largest = fine.iter().map(|f| f.norm()).fold(0.0, f64::max);
        let off = [60, 120, 240].map(|rate| {
            let coarse = felt(rate, stiffness, relaxation, trembles);
            let sum: f64 = coarse.iter().zip(&fine).map(|(a, b)| (a - b).norm_squared()).sum();
            (sum / fine.len() as f64).sqrt() / largest
        });
        println!("{name}: {:.4?} of {largest:.2} N", off);
        assert!(off.iter().zip(bounds).all(|(off, bound)| *off < bound), "{name}: {off:?}");
    }
}
