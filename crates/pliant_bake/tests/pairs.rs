//! Bodies that touch each other, with known answers: momentum, energy, Hertz, weight and stacks.

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_bake::{BakeConfig, bake};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{
    Body, BodyConfig, Damping, Frame, Islands, Material, ModalModel, Plane, StepSettings, Together, Touched,
};

const GRAVITY: f64 = 9.81;

fn model(mesh: &TetMesh, young: f64, change: impl Fn(&mut BakeConfig)) -> Arc<ModalModel> {
    let mut config = BakeConfig { modes: 30, young, poisson: 0.3, sites: Some(100), ..BakeConfig::linear() };
    change(&mut config);
    Arc::new(bake(mesh, None, &config, &mut |_, _| {}).unwrap().model)
}

fn cube(young: f64, change: impl Fn(&mut BakeConfig)) -> Arc<ModalModel> {
    model(&shapes::cube(4, 0.1).unwrap(), young, change)
}

fn ball(young: f64, change: impl Fn(&mut BakeConfig)) -> Arc<ModalModel> {
    model(&shapes::sphere(8, 0.1).unwrap(), young, |config| {
        config.sites = None;
        change(config);
    })
}

/// A body whose center of mass is at `at`.
fn place(
    model: &Arc<ModalModel>,
    rate: f64,
    gravity: f64,
    at: [f64; 3],
    turn: [f64; 4],
    velocity: [f64; 3],
    spin: [f64; 3],
) -> Body {
    let settings = StepSettings { gravity: [0.0, -gravity, 0.0], ..Default::default() };
    let mut body =
        Body::new(model.clone(), BodyConfig { step: 1.0 / rate, ..BodyConfig::from(settings) }).unwrap();
    let mut state = body.state().clone();
    let spin = spin.map(|x| x * model.inertia()[0][0]);
    state.frame = Frame::from_motion(model, at, turn, velocity, spin).unwrap();
    body.set_state(&state).unwrap();
    body
}

const LEVEL: [f64; 4] = [0.0, 0.0, 0.0, 1.0];

fn free(model: &Arc<ModalModel>, rate: f64, at: [f64; 3], velocity: [f64; 3]) -> Body {
    place(model, rate, 0.0, at, LEVEL, velocity, [0.0; 3])
}

fn step(islands: &mut Islands, bodies: &mut [Body]) {
    let mut all: Vec<Together<'_>> =
        bodies.iter_mut().enumerate().map(|(key, body)| Together::new(key as u64, body)).collect();
    islands.step(&mut all, |_, _| true);
    let errors: Vec<_> = all.iter().filter_map(|together| together.error.as_ref()).collect();
    assert!(errors.is_empty(), "{errors:?}");
}

fn run(bodies: &mut [Body], seconds: f64) {
    let mut islands = Islands::default();
    for _ in 0..(seconds / bodies[0].config().step).round() as usize {
        step(&mut islands, bodies);
    }
}

fn total(bodies: &[Body]) -> f64 {
    bodies.iter().map(|body| body.energy() + body.potential_energy() + body.contacts().report().energy).sum()
}

fn momentum(bodies: &[Body]) -> [Vector3<f64>; 2] {
    bodies.iter().fold([Vector3::zeros(); 2], |[linear, angular], body| {
        let (p, l) = body.momentum();
        [linear + Vector3::from(p), angular + Vector3::from(l)]
    })
}

fn soft(config: &mut BakeConfig) {
    config.material = Some(Material::NeoHookean);
}

#[test]
fn two_free_bodies_exchange_momentum_and_lose_none() {
    let pairs = [
        ("cubes", cube(1e5, |_| ()), cube(3e4, |_| ())),
        ("ball and cube", ball(1e5, |_| ()), cube(1e6, |_| ())),
        ("reduced", cube(1e5, soft), ball(5e4, soft)),
    ];
    for (name, a, b) in &pairs {
        for speed in [0.5, 5.0] {
            let turn = [0.2, -0.1, 0.3, 0.9];
            let mut bodies = [
                place(a, 240.0, 0.0, [0.0; 3], turn, [speed, 0.1, 0.0], [0.5, -1.0, 2.0]),
                place(b, 240.0, 0.0, [0.22, 0.04, 0.01], LEVEL, [-speed, 0.0, 0.05], [-1.0, 0.3, 0.4]),
            ];
            let [p0, l0] = momentum(&bodies);
            let first = bodies[0].momentum();
            let mut islands = Islands::default();
            let (mut worst, mut exchanged) = ([0.0f64; 2], [0.0f64; 2]);
            for _ in 0..(0.2 / speed * 240.0) as usize + 24 {
                step(&mut islands, &mut bodies);
                let [p, l] = momentum(&bodies);
                let (p1, l1) = bodies[0].momentum();
                worst = [worst[0].max((p - p0).norm()), worst[1].max((l - l0).norm())];
                exchanged[0] = exchanged[0].max((Vector3::from(p1) - Vector3::from(first.0)).norm());
                exchanged[1] = exchanged[1].max((Vector3::from(l1) - Vector3::from(first.1)).norm());
            }
            println!(
                "{name} at {speed} m/s: linear {:.1e}, angular {:.1e} of {:.2e} N s, {:.2e} N m s exchanged",
                worst[0] / exchanged[0],
                worst[1] / exchanged[1],
                exchanged[0],
                exchanged[1]
            );
            assert!(exchanged[0] > 0.05 * a.mass() * speed, "{name}: they met");
            assert!(worst[0] < 1e-6 * exchanged[0] && worst[1] < 1e-6 * exchanged[1], "{name}: {worst:?}");
        }
    }
}

#[test]
fn equal_balls_head_on_exchange_their_velocities_in_the_time_of_hertz() {
    let (young, radius, speed) = (1e5f64, 0.1f64, 0.5);
    for (name, model) in [
        ("linear", ball(young, |c| c.damping = Damping::Ratio(0.0))),
        ("120 modes", ball(young, |c| (c.modes, c.damping) = (120, Damping::Ratio(0.0)))),
        (
            "reduced",
            ball(young, |c| {
                soft(c);
                c.damping = Damping::Ratio(0.0);
            }),
        ),
    ] {
        let plain = young / (2.0 * (1.0 - 0.3f64.powi(2)));
        let (mass, curve) = (0.5 * model.mass(), 0.5 * radius);
        let time = 2.87 * (mass * mass / (curve * plain * plain * speed)).powf(0.2);
        for steps in [16.0, 32.0, 64.0] {
            let rate = steps / time;
            let gap = 2.5 * speed / rate;
            let mut bodies = [
                free(&model, rate, [0.0; 3], [0.0; 3]),
                free(&model, rate, [-2.0 * radius - gap, 0.0, 0.0], [speed, 0.0, 0.0]),
            ];
            let start = total(&bodies);
            let mut islands = Islands::default();
            let (mut touched, mut gain, mut most) = (0, f64::NEG_INFINITY, 0.0f64);
            for _ in 0..(3.0 * steps) as usize {
                step(&mut islands, &mut bodies);
                let force = bodies[0].contacts().report().force[0];
                touched += usize::from(force > 0.0);
                most = most.max(force);
                gain = gain.max(total(&bodies) / start - 1.0);
            }
            let [after, before] = [&bodies[0], &bodies[1]].map(|body| body.frame().velocity());
            let e = (after[0] - before[0]) / speed;
            // Hertz: F = k d^(3/2), and the deepest d has the energy of the impact.
            let k = 4.0 / 3.0 * plain * curve.sqrt();
            let deepest = (1.25 * mass * speed * speed / k).powf(0.4);
            println!(
                "{name}, {steps} steps: velocities {:.3} and {:.3} of {speed}, e = {e:.3}, time {:.3} of Hertz, \
                 largest force {:.3} of Hertz, energy +{gain:.1e}, aside {:.1e}",
                after[0],
                before[0],
                touched as f64 / steps,
                most / (k * deepest.powf(1.5)),
                after[1].hypot(after[2]) / speed,
            );
            assert!(gain < 1e-9, "{name}: {gain}");
            // Steps at the end of an impact lose some of the energy, as with planes.
            let (time, force) = (touched as f64 / steps, most / (k * deepest.powf(1.5)));
            assert!((time - 1.0).abs() < 0.08 && (force - 1.0).abs() < 0.1, "{name}: {time}, {force}");
            assert!(e > if steps > 60.0 { 0.93 } else { 0.8 }, "{name}: {e}");
        }
    }
}

#[test]
fn what_lies_on_an_anchored_body_presses_with_its_weight() {
    let slab = shapes::bar([9, 3, 9], [0.3, 0.1, 0.3]).unwrap();
    let held = model(&slab, 1e5, |c| c.anchors = vec!["y<0.001".parse().unwrap()]);
    for (name, top) in [
        ("ball", ball(1e5, |_| ())),
        ("cube", cube(1e5, |_| ())),
        ("stiff cube", cube(1e7, |_| ())),
        ("reduced cube", cube(1e5, soft)),
    ] {
        let [low, _] = top.surface().bounds();
        let height = 0.1 + top.center_of_mass()[1] - f64::from(low[1]) + 0.01;
        let mut bodies = [
            free(&held, 60.0, held.center_of_mass(), [0.0; 3]),
            place(&top, 60.0, GRAVITY, [0.15, height, 0.15], LEVEL, [0.0; 3], [0.0; 3]),
        ];
        run(&mut bodies, 30.0);
        let weight = top.mass() * GRAVITY;
        let report = *bodies[1].contacts().report();
        let off = (Vector3::from(report.force) - Vector3::new(0.0, weight, 0.0)).norm() / weight;
        let other = (Vector3::from(report.force) + Vector3::from(bodies[0].contacts().report().force)).norm();
        println!(
            "{name}: force off by {off:.1e}, action and reaction by {:.1e}, penetration {:.1e} m, {} contacts, kinetic {:.1e} J",
            other / weight,
            report.penetration,
            report.contacts,
            bodies[1].kinetic_energy()
        );
        // A ball goes on rolling at some micrometers a second.
        let bound = if name == "ball" { 2e-5 } else { 1e-6 };
        assert!(off < bound && other < 1e-12 * weight, "{name}: {off}");
        assert!(bodies[1].contacts().contacts().iter().all(|c| c.other == Touched::Body(0)));
    }
}

fn stack(young: f64, count: usize, change: impl Fn(&mut BakeConfig)) -> Vec<Body> {
    let model = cube(young, change);
    (0..count)
        .map(|level| {
            let at = [0.05, 0.05 + 0.1 * level as f64, 0.05];
            let mut body = place(&model, 60.0, GRAVITY, at, LEVEL, [0.0; 3], [0.0; 3]);
            body.set_obstacles(vec![Arc::new(Plane::GROUND)]).unwrap();
            body
        })
        .collect()
}

#[test]
fn a_stack_of_five_cubes_stands() {
    for (young, seconds) in [(1e6, 60.0), (1e5, 600.0)] {
        let mut bodies = stack(young, 5, |_| ());
        let begun = std::time::Instant::now();
        run(&mut bodies, 5.0);
        let settled: Vec<_> = bodies.iter().map(|body| Vector3::from(body.frame().center())).collect();
        run(&mut bodies, seconds);
        let wall = begun.elapsed().as_secs_f64();
        for (level, (body, settled)) in bodies.iter().zip(&settled).enumerate() {
            let weight = body.model().mass() * GRAVITY;
            let report = body.contacts().report();
            let off = (report.force[1] - weight).abs() / weight;
            let crept = (Vector3::from(body.frame().center()) - settled).norm() / 0.1;
            println!(
                "{young:e}, cube {level}: force off by {off:.1e}, crept {crept:.1e} of the size, kinetic {:.1e} J, residual {:.1e} m, {} rounds, {} sweeps, guarded {}",
                body.kinetic_energy(),
                report.residual,
                report.rounds,
                report.sweeps,
                report.guarded
            );
            assert!(off < 1e-6 && crept < 1e-4, "{level}: {off} {crept}");
        }
        println!("    {:.1} us a step of all", wall * 1e6 / ((seconds + 5.0) * 60.0));
    }
}

/// Bodies, speeds and ways to meet: no gain of energy, no panic, no explosion.
#[test]
fn no_contact_of_two_bodies_ever_adds_energy() {
    let needle = model(&shapes::bar([2, 30, 2], [0.02, 0.3, 0.02]).unwrap(), 1e7, |c| c.modes = 12);
    let bodies = [
        ("cube", cube(1e5, |_| ())),
        ("stiff cube", cube(1e8, |_| ())),
        ("ball", ball(3e4, |_| ())),
        ("needle", needle),
        ("reduced", cube(1e5, soft)),
    ];
    for (name, a) in &bodies {
        for (other, b) in &bodies {
            for (rate, speed) in [(60.0, 1.0), (60.0, 50.0), (1000.0, 3.0)] {
                let (one, two) = ([0.3, 0.1, 0.2, 0.9], [-0.1, 0.5, 0.2, 0.7]);
                let mut pair = [
                    place(a, rate, GRAVITY, [0.0, 0.2, 0.0], one, [0.3 * speed, 0.0, 0.0], [1.0, -2.0, 0.5]),
                    place(b, rate, GRAVITY, [0.4, 0.25, 0.02], two, [-speed, 0.0, 0.0], [0.3, 2.0, -1.0]),
                ];
                for body in &mut pair {
                    body.set_obstacles(vec![Arc::new(Plane::GROUND)]).unwrap();
                }
                let start = total(&pair);
                let scale: f64 =
                    pair.iter().map(|body| body.energy() + body.model().mass() * GRAVITY * 0.2).sum();
                let mut islands = Islands::default();
                let (mut gain, mut deep, mut met) = (f64::NEG_INFINITY, 0.0f64, false);
                for _ in 0..rate as usize {
                    step(&mut islands, &mut pair);
                    gain = gain.max((total(&pair) - start) / scale);
                    let contacts = pair[0].contacts();
                    met |= contacts.contacts().iter().any(|c| matches!(c.other, Touched::Body(_)));
                    deep = deep.max(contacts.report().penetration / a.size());
                }
                println!(
                    "{name} and {other} at {speed} m/s, {rate} Hz: energy +{gain:.1e}, met {met}, penetration {deep:.1e}"
                );
                assert!(gain < 1e-9, "{name} and {other} at {speed} m/s, {rate} Hz: +{gain:.1e}");
            }
        }
    }
}

#[test]
fn bodies_thrown_at_each_other_do_not_pass_through() {
    for (name, a, b) in [
        ("cubes", cube(1e8, |_| ()), cube(1e8, |_| ())),
        ("balls", ball(2e7, |_| ()), ball(2e7, |_| ())),
        ("ball and cube", ball(2e7, |_| ()), cube(1e8, |_| ())),
    ] {
        let mut pair = [
            free(&a, 60.0, [0.0; 3], [50.0, 0.0, 0.0]),
            free(&b, 60.0, [1.0, 0.01, 0.02], [-50.0, 0.0, 0.0]),
        ];
        run(&mut pair, 0.2);
        let [x, y] = [&pair[0], &pair[1]].map(|body| body.frame().center()[0]);
        println!(
            "{name}: at {x:.3} m and {y:.3} m, speeds {:?}",
            pair.map(|body| body.frame().velocity()[0])
        );
        assert!(x < y, "{name}: {x} {y}");
    }
}

#[test]
fn bodies_at_one_place_far_away_or_without_a_number_do_no_harm() {
    let model = cube(1e5, |_| ());
    // At one place, and half inside each other.
    for offset in [0.0, 1e-9, 0.02, 0.05] {
        let mut pair = [0.0, offset].map(|x| free(&model, 60.0, [x, 0.0, 0.0], [0.0; 3]));
        run(&mut pair, 2.0);
        for body in &pair {
            let speed = Vector3::from(body.frame().velocity()).norm();
            println!("{offset} m apart: {:?}, {speed:.3} m/s", body.frame().center());
            // Bodies are pushed apart at half their size a second.
            assert!(speed < 0.2 && body.energy() < 1e-2, "{offset}: {speed} {}", body.energy());
        }
    }
    let far = free(&model, 60.0, [1e120, 0.0, 0.0], [0.0; 3]);
    let beside = free(&model, 60.0, [1e120, 0.05, 0.0], [0.0; 3]);
    let fast = free(&model, 60.0, [0.3, 0.0, 0.0], [1e200, 0.0, 0.0]);
    let still = free(&model, 60.0, [0.0; 3], [0.0; 3]);
    let mut all = [still, far, beside, fast];
    let mut islands = Islands::default();
    for _ in 0..60 {
        let mut group: Vec<Together<'_>> =
            all.iter_mut().enumerate().map(|(key, body)| Together::new(key as u64, body)).collect();
        islands.step(&mut group, |_, _| true);
    }
    assert!(all.iter().all(|body| body.state().is_finite()));
    assert!(Vector3::from(all[0].frame().center()).norm() < 1e-3);
}

#[test]
fn contacts_of_bodies_are_deterministic() {
    let make = || {
        let mut bodies = stack(1e5, 3, |_| ());
        let mut state = bodies[2].state().clone();
        let (turn, spin) = ([0.1, 0.2, 0.0, 0.9], [0.0, 1e-3, 0.0]);
        state.frame = Frame::from_motion(bodies[2].model(), [0.07, 0.4, 0.04], turn, [0.0; 3], spin).unwrap();
        bodies[2].set_state(&state).unwrap();
        bodies
    };
    let (mut a, mut b) = (make(), make());
    run(&mut a, 1.0);
    run(&mut b, 1.0);
    for (a, b) in a.iter().zip(&b) {
        assert_eq!(a.state(), b.state());
        assert_eq!(a.contacts().contacts(), b.contacts().contacts());
    }
}

#[test]
fn bodies_stepped_on_several_threads_are_the_same_to_the_bit() {
    let cube = cube(1e5, |_| ());
    // Two that meet, and ten on their own, two of which pass through each other.
    let start: Vec<Body> = (0..12)
        .map(|i| {
            let at = match i {
                0 => [0.0; 3],
                1 => [0.22, 0.04, 0.01],
                10 | 11 => [10.0, 0.0, 0.0],
                i => [f64::from(i), 0.0, 0.0],
            };
            let speed = if i == 1 { -1.0 } else { 0.0 };
            place(&cube, 240.0, 9.81, at, LEVEL, [speed, 0.0, 0.0], [1.0, 0.1 * f64::from(i), 0.0])
        })
        .collect();
    let run = |threads: usize| {
        let (mut bodies, mut islands) = (start.clone(), Islands::default());
        let mut touched = false;
        for _ in 0..60 {
            let mut all: Vec<Together<'_>> =
                bodies.iter_mut().enumerate().map(|(key, body)| Together::new(key as u64, body)).collect();
            all[10].touches = false;
            if threads == 1 {
                islands.step(&mut all, |_, _| true);
            } else {
                islands.step_by(
                    &mut all,
                    &mut [],
                    0.0,
                    |_, _| true,
                    |_, _| false,
                    |all, step| {
                        std::thread::scope(|scope| {
                            for part in all.chunks_mut(12usize.div_ceil(threads)) {
                                scope.spawn(move || part.iter_mut().rev().for_each(step));
                            }
                        });
                    },
                );
            }
            assert!(all.iter().all(|together| together.error.is_none()));
            touched |= all[0].body.contacts().contacts().iter().any(|c| c.other == Touched::Body(1));
            assert!(all[11].body.contacts().contacts().is_empty(), "the other touches nothing");
        }
        assert!(touched, "the first two met");
        bodies
    };
    let alone = run(1);
    for threads in [2, 3, 12] {
        for (a, b) in alone.iter().zip(&run(threads)) {
            assert_eq!(a.state(), b.state(), "on {threads} threads");
        }
    }
}

#[test]
fn a_hundred_bodies_on_one_spot_do_no_harm() {
    let model = model(&shapes::cube(1, 0.1).unwrap(), 1e5, |c| (c.modes, c.sites) = (6, Some(8)));
    let mut bodies: Vec<Body> = (0..100)
        .map(|_| {
            let mut body = place(&model, 60.0, GRAVITY, [0.05, 0.06, 0.05], LEVEL, [0.0; 3], [0.0; 3]);
            body.set_obstacles(vec![Arc::new(Plane::GROUND)]).unwrap();
            body
        })
        .collect();
    let mut islands = Islands::default();
    let (begun, start) = (std::time::Instant::now(), total(&bodies));
    let mut gain = f64::NEG_INFINITY;
    for _ in 0..20 {
        step(&mut islands, &mut bodies);
        gain = gain.max((total(&bodies) - start) / start);
    }
    let seconds = begun.elapsed().as_secs_f64() / 20.0;
    let speed = |body: &Body| Vector3::from(body.frame().velocity()).norm();
    let fastest = bodies.iter().map(speed).fold(0.0, f64::max);
    let lowest = bodies.iter().map(|body| body.frame().center()[1]).fold(f64::INFINITY, f64::min);
    println!("a step takes {:.1} ms; {fastest:.3} m/s, {lowest:.4} m, energy {gain:+.1e}", 1e3 * seconds);
    assert!(gain < 1e-9 && fastest < 1.0 && lowest > 0.04, "{gain} {fastest} {lowest}");
}
