//! Probes of other shapes than a ball, with known answers: springs, levers, momentum, full
//! solutions.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector, UnitQuaternion, Vector3};
use pliant_bake::{BakeConfig, DeadLoad, StaticLoads, deflect};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{
    Cuboid, Islands, ModalModel, ObstacleShape, Patch, Plane, Probe, ProbeConfig, Sphere, Together,
};

use super::probe::{STIFFNESS, block, body, force, model, probe, step, top};

/// Half of the length of the capsules, m.
const HALF: f64 = 0.03;
const RADIUS: f64 = 0.005;

fn smooth(mut probe: Probe) -> Probe {
    let config = ProbeConfig { friction: 0.0, ..*probe.config() };
    probe.configure(config).unwrap();
    probe
}

fn capsule(target: Vector3<f64>) -> Probe {
    let mut probe = probe(RADIUS, target);
    probe.set_corners(&[[-HALF, 0.0, 0.0], [HALF, 0.0, 0.0]]).unwrap();
    probe
}

fn cuboid(target: Vector3<f64>, half: [f64; 3]) -> Probe {
    let corner =
        |n: usize| std::array::from_fn(|axis| if n >> axis & 1 == 0 { -half[axis] } else { half[axis] });
    let corners: Vec<[f64; 3]> = (0..8).map(corner).collect();
    let mut probe = probe(RADIUS, target);
    probe.set_corners(&corners).unwrap();
    probe
}

fn turned(about: Vector3<f64>) -> [f64; 4] {
    let q = UnitQuaternion::from_scaled_axis(about);
    [q.i, q.j, q.k, q.w]
}

/// Turn of a probe, rad, world axes.
fn turn(probe: &Probe) -> Vector3<f64> {
    let [x, y, z, w] = probe.rotation();
    UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z)).scaled_axis()
}

fn on(obstacle: impl ObstacleShape + 'static, mut probe: Probe) -> [Probe; 1] {
    probe.set_obstacles(vec![Arc::new(obstacle)]).unwrap();
    [probe]
}

fn rest(probes: &mut [Probe], ticks: usize) {
    let mut islands = Islands::default();
    (0..ticks).for_each(|_| step(&mut islands, &mut [], probes, 60.0));
}

/// A tilted capsule above a floor touches with its lower end, and further down with both.
#[test]
fn a_capsule_lies_down_as_its_spring_lets_it() {
    let tilt = 0.2;
    let turning = STIFFNESS * HALF * HALF;
    for sunk in [0.001, 0.003, 0.008, 0.012] {
        // The lower end of the target is that far below the floor.
        let height = RADIUS + HALF * f64::sin(tilt) - sunk;
        let mut probes = on(Plane::GROUND, smooth(capsule(Vector3::new(0.0, 0.1, 0.0))));
        probes[0].set_rotation(turned(Vector3::new(0.0, 0.0, tilt))).unwrap();
        rest(&mut probes, 2);
        probes[0].set_target([0.0, height, 0.0]).unwrap();
        rest(&mut probes, 200);
        let probe = &probes[0];
        let (f, torque, angle) = (force(probe), Vector3::from(probe.torque()), turn(probe).z);
        // One end: the angle `a` and the force `F` at the end, on both springs.
        let one = |f: f64| {
            let mut a = tilt;
            for _ in 0..200 {
                a = tilt - f * HALF * f64::cos(a) / turning;
            }
            (a, height + f / STIFFNESS - HALF * f64::sin(a) - RADIUS)
        };
        let (mut low, mut high) = (0.0, STIFFNESS * 0.1);
        for _ in 0..100 {
            let middle = 0.5 * (low + high);
            if one(middle).1 < 0.0 { low = middle } else { high = middle }
        }
        let (a, _) = one(low);
        // Two ends: the spring has all of the way, and its turn is undone.
        let (want, lies) = if a > 0.0 { (low, a) } else { (STIFFNESS * (RADIUS - height), 0.0) };
        let pulled = turning * (lies - tilt);
        println!(
            "{:.0} mm: {:.4} N of {want:.4}, {angle:.4} rad of {lies:.4}, {:.5} N m of {pulled:.5}",
            1e3 * sunk,
            f.y,
            torque.z
        );
        assert!((f.y / want - 1.0).abs() < 5e-3, "{f}");
        assert!((angle - lies).abs() < 2e-3 && (torque.z - pulled).abs() < 5e-3 * pulled.abs(), "{angle}");
    }
}

#[test]
fn a_box_stands_on_its_face_and_on_its_edge() {
    let mut probes = on(Plane::GROUND, cuboid(Vector3::new(0.0, 0.1, 0.0), [0.02, 0.01, 0.03]));
    rest(&mut probes, 2);
    probes[0].set_target([0.0, 0.015 - 0.004, 0.0]).unwrap();
    rest(&mut probes, 60);
    let (f, torque) = (force(&probes[0]), Vector3::from(probes[0].torque()));
    let pushing = probes[0].contacts().iter().filter(|contact| contact.force[1] > 0.0).count();
    println!("{f:?} N, {torque:?} N m, {pushing} corners");
    assert!((f.y / (STIFFNESS * 0.004) - 1.0).abs() < 2e-3 && torque.norm() < 1e-8, "{f}");
    assert_eq!(pushing, 4);
    // On its edge it leans until the spring holds it.
    probes[0].set_rotation(turned(Vector3::new(0.0, 0.0, 0.6))).unwrap();
    probes[0].set_target([0.0, 0.02, 0.0]).unwrap();
    rest(&mut probes, 120);
    let lever: f64 = Vector3::new(0.02f64, 0.01, 0.03).norm();
    let (torque, angle) = (Vector3::from(probes[0].torque()), turn(&probes[0]));
    let want = STIFFNESS * lever * lever * (angle.z - 0.6);
    println!("{angle:?} rad, {torque:?} N m of {want}");
    assert!((torque.z / want - 1.0).abs() < 1e-6 && torque.z < -1e-3, "{torque}");
}

/// A capsule that is longer than the box below it, and exactly along it, lies on it.
#[test]
fn a_capsule_lies_on_a_box_that_is_narrower() {
    let beam =
        Cuboid { center: [0.0; 3], rotation: [0.0, 0.0, 0.0, 1.0], half: [0.01, 0.02, 0.02], round: 0.0 };
    let mut probes = on(beam, capsule(Vector3::new(0.0, 0.05, 0.0)));
    rest(&mut probes, 2);
    let mut islands = Islands::default();
    for k in 0..=270 {
        probes[0].set_target([0.0, 0.05 - 1e-4 * f64::from(k), 0.0]).unwrap();
        step(&mut islands, &mut [], &mut probes, 60.0);
    }
    rest(&mut probes, 60);
    let (f, x) = (force(&probes[0]), Vector3::from(probes[0].position()));
    println!("{f:?} N at {x:?}");
    assert!((f.y / (STIFFNESS * 0.002) - 1.0).abs() < 5e-3 && (x.y - 0.025).abs() < 1e-4, "{f} {x}");
    // Corners in one place are one, and a short thick tool does not turn about itself.
    let mut twin = probe(RADIUS, Vector3::new(0.0, 0.1, 0.0));
    twin.set_corners(&[[0.0; 3], [1e-4, 0.0, 0.0]]).unwrap();
    assert_eq!(twin.lever(), 0.0);
    twin.set_corners(&[[1e-3, 0.0, 0.0]]).unwrap();
    assert_eq!(twin.lever(), RADIUS);
}

/// Between its ends a capsule touches a sphere, which passes below it without a bump.
#[test]
fn a_capsule_strokes_a_sphere_without_a_bump() {
    let (ball, depth) = (0.02, 0.002);
    let sphere = Sphere { center: [0.0, 0.0, 0.0], radius: ball };
    let mut probes = on(sphere, smooth(capsule(Vector3::new(-0.025, 0.1, 0.0))));
    let mut islands = Islands::default();
    let (height, mut most) = (ball + RADIUS - depth, 0.0f64);
    for k in 0..=500 {
        let x = -0.025 + 1e-4 * f64::from(k);
        probes[0].set_target([x, height, 0.0]).unwrap();
        let ticks = if k == 0 { 100 } else { 8 };
        (0..ticks).for_each(|_| step(&mut islands, &mut [], &mut probes, 60.0));
        // Tool point at (x, y), axis at the angle `a`: force F against the normal of the axis.
        let solve = |f: f64| {
            let (mut a, mut y) = (0.0f64, height);
            let mut p = x;
            for _ in 0..100 {
                let normal = [-a.sin(), a.cos()];
                (p, y) = (x + f * normal[0] / STIFFNESS, height + f * normal[1] / STIFFNESS);
                // The foot of the center on the axis, from the tool point.
                let foot = -p * a.cos() - y * a.sin();
                a = f * foot / (STIFFNESS * HALF * HALF);
            }
            -p * -a.sin() + -y * a.cos() + ball + RADIUS
        };
        let (mut low, mut high) = (0.0, STIFFNESS * depth * 2.0);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if solve(middle) > 0.0 { low = middle } else { high = middle }
        }
        let got = force(&probes[0]).norm();
        most = most.max((got / low - 1.0).abs());
        assert!((got / low - 1.0).abs() < 0.01, "at {x}: {got} N of {low}");
    }
    println!("off by {:.2e} at most", most);
}

/// What a hand gives to a free body by a shaped tool is what the body has, also of its spin.
#[test]
fn what_pushes_and_turns_the_tool_pushes_and_turns_the_body() {
    for is_box in [false, true] {
        let model = model(&shapes::cube(4, 0.1).unwrap(), 1e6, None);
        let mut bodies = [body(&model, 240.0)];
        let from = top(&model) + Vector3::new(0.02, 0.03, 0.01);
        let mut probes = [if is_box { cuboid(from, [0.02, 0.005, 0.01]) } else { capsule(from) }];
        probes[0].set_rotation(turned(Vector3::new(0.1, 0.3, 0.2))).unwrap();
        let mut islands = Islands::default();
        let (mut given, mut spun, mut worst) = (Vector3::zeros(), Vector3::zeros(), 0.0f64);
        for k in 0..240 {
            let down = 5e-4 * f64::from(k.min(100));
            probes[0].set_target((from - Vector3::new(0.2 * down, down, 0.0)).into()).unwrap();
            step(&mut islands, &mut bodies, &mut probes, 240.0);
            for contact in probes[0].contacts() {
                let force = -Vector3::from(contact.force) / 240.0;
                given += force;
                spun += Vector3::from(contact.point).cross(&force);
            }
            let sum: Vector3<f64> = probes[0]
                .contacts()
                .iter()
                .map(|contact| {
                    let arm = Vector3::from(contact.point) - Vector3::from(probes[0].position());
                    arm.cross(&Vector3::from(contact.force))
                })
                .sum();
            // The torque on the hand is that of the forces, but for the dents.
            let (torque, all) = (Vector3::from(probes[0].torque()), force(&probes[0]).norm());
            worst = worst.max((torque - sum).norm() / (all * HALF).max(1e-3));
        }
        let (linear, angular) = bodies[0].momentum();
        let off = (Vector3::from(linear) - given).norm() / given.norm();
        let turned = (Vector3::from(angular) - spun).norm() / (given.norm() * 0.05);
        println!(
            "box {is_box}: {:.4} N s, off by {off:.1e}, spin by {turned:.1e} of it, torque by {worst:.1e}",
            given.norm()
        );
        assert!(given.norm() > 1e-3 && off < 1e-9 && turned < 0.02, "{off} {turned}");
        assert!(worst < 0.05, "{worst}");
    }
}

/// A capsule that lies on a block, against full finite elements that a rigid line presses.
#[test]
fn a_lying_capsule_presses_with_its_whole_length() {
    const SPACING: f64 = 0.1 / 8.0;
    let mesh = shapes::cube(8, 0.1).unwrap();
    let mut line = None;
    for young in [1e4, 1e5] {
        let model = model(&mesh, young, Some("y<0.001"));
        let at = top(&model);
        let mut bodies = [body(&model, 60.0)];
        let mut probes = [probe(RADIUS, at + Vector3::new(0.0, 0.03, 0.0))];
        let half = 3.0 * SPACING;
        probes[0].set_corners(&[[-half, 0.0, 0.0], [half, 0.0, 0.0]]).unwrap();
        let mut islands = Islands::default();
        let depth = 0.002;
        let target = at + Vector3::new(0.0, RADIUS - depth, 0.0);
        probes[0].set_target(target.into()).unwrap();
        (0..400).for_each(|_| step(&mut islands, &mut bodies, &mut probes, 60.0));
        let got = force(&probes[0]).y;
        let line = young * *line.get_or_insert_with(|| rigid_line(&mesh, &model, at, young, SPACING) / young);
        let want = depth / (1.0 / STIFFNESS + 1.0 / line);
        println!(
            "{young:.0e}: {got:.4} N, a rigid line {want:.4} N ({:+.1} %), {} contacts",
            100.0 * (got / want - 1.0),
            probes[0].contacts().len()
        );
        assert!((got / want - 1.0).abs() < 0.25, "{got} {want}");
    }
}

/// Stiffness (N/m) of the full model against a rigid line of seven patches at this distance (m)
/// from each other.
fn rigid_line(mesh: &TetMesh, model: &ModalModel, at: Vector3<f64>, young: f64, spacing: f64) -> f64 {
    let patches: Vec<Patch> = (-3..=3)
        .map(|k| {
            let x = at + Vector3::new(spacing * f64::from(k), 0.0, 0.0);
            let far = |p: &[f32; 3]| (Vector3::from(p.map(f64::from)) - x).norm();
            let positions = model.surface().positions().iter().enumerate();
            let nearest = positions.min_by(|a, b| far(a.1).total_cmp(&far(b.1))).unwrap().0;
            Patch::around(model.surface(), nearest as u32, spacing).unwrap()
        })
        .collect();
    let anchors = vec!["y<0.001".parse().unwrap()];
    let config = BakeConfig { young, poisson: 0.3, anchors, ..BakeConfig::default() };
    let small = 1e-6;
    let mut give = DMatrix::zeros(patches.len(), patches.len());
    for column in 0..patches.len() {
        let force = |k| [0.0, if k == column { -small } else { 0.0 }, 0.0];
        let loads = patches.iter().enumerate();
        let loads: Vec<_> =
            loads.map(|(k, patch)| DeadLoad { patch: patch.clone(), force: force(k) }).collect();
        let loads = StaticLoads { forces: &loads, ..StaticLoads::default() };
        let solved = deflect(mesh, &config, config.material.unwrap(), &loads).unwrap();
        for (row, moved) in solved.patches.iter().enumerate() {
            give[(row, column)] = -moved[1] / small;
        }
    }
    give.lu().solve(&DVector::repeat(patches.len(), 1.0)).unwrap().sum()
}

/// Wild hands with tools of all shapes on bodies and obstacles: the force is never more than the
/// spring has, and what a hand gives on a closed way is not less than nothing.
#[test]
fn shapes_are_calm_in_wild_hands() {
    let mut seed = 0x9E37_79B9_7F4A_7C15_u64;
    let mut random = move || {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) as f64 / f64::from(1u32 << 31) * 2.0 - 1.0
    };
    let soft = block(2e4);
    let at = top(&soft);
    for shape in 0..4 {
        for rate in [30.0, 60.0, 1000.0] {
            let from = at + Vector3::new(0.0, 0.05, 0.0);
            let mut probe = match shape {
                0 => capsule(from),
                1 => cuboid(from, [0.02, 0.01, 0.03]),
                2 => {
                    // A needle beside the tool point.
                    let mut needle = probe(0.0005, from);
                    needle.set_corners(&[[0.05, 0.0, 0.0], [0.15, 0.0, 0.0]]).unwrap();
                    needle
                }
                _ => {
                    // All corners in one place.
                    let mut none = probe(RADIUS, from);
                    none.set_corners(&[[0.0; 3]; 16]).unwrap();
                    none
                }
            };
            let side = Cuboid {
                center: [0.07, 0.05, 0.0],
                rotation: [0.0, 0.0, 0.0, 1.0],
                half: [0.02, 0.05, 0.02],
                round: 0.0,
            };
            probe.set_obstacles(vec![Arc::new(Plane::GROUND), Arc::new(side)]).unwrap();
            let mut probes = [probe];
            let mut bodies = [body(&soft, rate)];
            let mut islands = Islands::default();
            let (mut to, mut angle) = (from, Vector3::zeros());
            let mut worst = 0.0f64;
            for _ in 0..(3.0 * rate) as usize {
                // Up to 3 m/s and 20 rad/s.
                to += Vector3::from_fn(|_, _| 3.0 * random()) / rate;
                to += 0.05 * (at - to);
                angle = 0.95 * angle + Vector3::from_fn(|_, _| 20.0 * random()) / rate;
                probes[0].set_target(to.into()).unwrap();
                probes[0].set_rotation(turned(angle)).unwrap();
                step(&mut islands, &mut bodies, &mut probes, rate);
                let (f, x) = (force(&probes[0]), Vector3::from(probes[0].position()));
                let ratio = f.norm() / (STIFFNESS * 0.1);
                worst = worst.max(ratio);
                assert!(x.iter().chain(&f).all(|x| x.is_finite()));
                assert!(bodies[0].q().iter().all(|q| q.is_finite()));
                let energy = bodies[0].energy();
                assert!(energy < 10.0, "{shape} at {rate} Hz: {energy} J");
            }
            println!("shape {shape} at {rate} Hz: {worst:.2} of what 0.1 m of the spring give at most");
            assert!(worst < 20.0);
        }
    }
    // Sizes beyond all measure, beside a body and a floor.
    for radius in [1e-300, 1e-9, 0.01, 1e9, 1e150] {
        for far in [1e-300, 1e-160, 1.0, 1e9, 1e160, 1e300] {
            let mut probes = on(Plane::GROUND, probe(0.01, at));
            let config = ProbeConfig { radius, ..*probes[0].config() };
            probes[0].configure(config).unwrap();
            probes[0].set_corners(&[[-far, 0.0, 0.0], [far, 0.0, far]]).unwrap();
            let mut bodies = [body(&soft, 60.0)];
            let mut islands = Islands::default();
            for k in 0..10 {
                probes[0].set_target((at + Vector3::new(0.0, -0.002 * f64::from(k), 0.0)).into()).unwrap();
                probes[0].set_rotation(turned(Vector3::new(0.1, 0.2, 0.3) * f64::from(k))).unwrap();
                // A step may fail, and is told; what is kept is finite.
                let mut all = [Together::new(7, &mut bodies[0])];
                islands.step_with(&mut all, &mut probes, 1.0 / 60.0, |_, _| true, |_, _| true);
                let x = Vector3::from(probes[0].position());
                let all = x.iter().chain(bodies[0].q()).all(|x| x.is_finite());
                assert!(all && probes[0].rotation().iter().all(|x| x.is_finite()), "{radius:e} {far:e} {x}");
                // A ball as large as the sun begins around the body, and its spring is as long.
                let energy = bodies[0].energy();
                assert!(energy < 10.0 || radius > 1.0 || far > 10.0, "{radius:e} {far:e}: {energy} J");
            }
        }
    }
    let mut probe = probe(0.01, at);
    assert!(probe.set_corners(&[]).is_err() && probe.set_corners(&[[0.0; 3]; 17]).is_err());
    assert!(probe.set_corners(&[[f64::NAN, 0.0, 0.0]]).is_err());
    assert!(probe.set_rotation([0.0; 4]).is_err() && probe.set_rotation([f64::NAN; 4]).is_err());
}

/// A hand that leads a capsule over a block and back to where it began has given energy and not
/// taken any.
#[test]
fn a_hand_on_a_closed_way_gives_energy() {
    for rate in [60.0, 1000.0] {
        let soft = block(5e4);
        let at = top(&soft);
        let mut bodies = [body(&soft, rate)];
        let mut probes = [capsule(at + Vector3::new(0.0, 0.02, 0.0))];
        let mut islands = Islands::default();
        let (mut given, mut last) = (0.0, None::<(Vector3<f64>, UnitQuaternion<f64>)>);
        for k in 0..=(8.0 * rate) as usize {
            let t = std::f64::consts::TAU * k as f64 / (2.0 * rate);
            let to = at + Vector3::new(0.02 * t.sin(), 0.01 + 0.01 * t.cos(), 0.01 * (2.0 * t).sin());
            let turn = Vector3::new(0.0, 0.5 * t.sin(), 0.4 * t.cos());
            probes[0].set_target(to.into()).unwrap();
            probes[0].set_rotation(turned(turn)).unwrap();
            step(&mut islands, &mut bodies, &mut probes, rate);
            let q = UnitQuaternion::from_scaled_axis(turn);
            if let Some((from, before)) = last {
                let torque = Vector3::from(probes[0].torque());
                given -=
                    force(&probes[0]).dot(&(to - from)) + torque.dot(&(q * before.inverse()).scaled_axis());
            }
            last = Some((to, q));
        }
        println!("at {rate} Hz: {given:.5} J in four rounds");
        assert!(given > 0.0, "{given}");
    }
}
