//! Probes that press and stroke, with known answers: springs, full solutions, Coulomb, momentum.

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_bake::{BakeConfig, DeadLoad, StaticLoads, bake, deflect};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{
    Body, BodyConfig, Damping, Islands, ModalModel, Patch, Plane, Probe, ProbeConfig, StepSettings, Together,
    Touched,
};

pub(crate) const STIFFNESS: f64 = 500.0;

pub(crate) fn model(mesh: &TetMesh, young: f64, anchor: Option<&str>) -> Arc<ModalModel> {
    let config = BakeConfig {
        modes: 30,
        young,
        poisson: 0.3,
        sites: Some(usize::MAX),
        anchors: anchor.map(|text| text.parse().unwrap()).into_iter().collect(),
        damping: Damping::Ratio(0.3),
        ..BakeConfig::linear()
    };
    Arc::new(bake(mesh, None, &config, &mut |_, _| {}).unwrap().model)
}

/// A cube of 0.1 m that stands on its fixed bottom.
pub(crate) fn block(young: f64) -> Arc<ModalModel> {
    model(&shapes::cube(6, 0.1).unwrap(), young, Some("y<0.001"))
}

pub(crate) fn body(model: &Arc<ModalModel>, rate: f64) -> Body {
    let config = BodyConfig { step: 1.0 / rate, ..BodyConfig::from(StepSettings::default()) };
    Body::new(model.clone(), config).unwrap()
}

pub(crate) fn probe(radius: f64, target: Vector3<f64>) -> Probe {
    let config = ProbeConfig { radius, stiffness: STIFFNESS, relaxation: 2e-3, friction: 0.5 };
    Probe::new(config, target.into()).unwrap()
}

pub(crate) fn step(islands: &mut Islands, bodies: &mut [Body], probes: &mut [Probe], rate: f64) {
    let mut all: Vec<Together<'_>> =
        bodies.iter_mut().enumerate().map(|(key, body)| Together::new(key as u64, body)).collect();
    islands.step_with(&mut all, probes, 1.0 / rate, |_, _| true, |_, _| true);
    let errors: Vec<_> = all.iter().filter_map(|together| together.error.as_ref()).collect();
    assert!(errors.is_empty(), "{errors:?}");
}

pub(crate) fn top(model: &ModalModel) -> Vector3<f64> {
    let [low, high] = model.surface().bounds().map(|at| Vector3::from(at.map(f64::from)));
    Vector3::new(0.5 * (low.x + high.x), high.y, 0.5 * (low.z + high.z))
}

pub(crate) fn force(probe: &Probe) -> Vector3<f64> {
    probe.force().into()
}

#[test]
fn on_a_rigid_floor_it_is_the_spring_and_the_cone() {
    let mut probes = [probe(0.01, Vector3::new(0.0, 0.03, 0.0))];
    probes[0].set_obstacles(vec![Arc::new(Plane::GROUND)]).unwrap();
    let mut islands = Islands::default();
    let mut at = |target: [f64; 3], ticks: usize| {
        probes[0].set_target(target).unwrap();
        (0..ticks).for_each(|_| step(&mut islands, &mut [], &mut probes, 60.0));
        (force(&probes[0]), Vector3::from(probes[0].position()))
    };
    let (f, _) = at([0.0, 0.03, 0.0], 3);
    assert_eq!(f, Vector3::zeros());
    // 6 mm below where the ball would touch: 3 N. The floor gives way by a thousandth of the
    // spring.
    let (f, x) = at([0.0, 0.004, 0.0], 60);
    assert!((f.y / 3.0 - 1.0).abs() < 2e-3 && f.xz().norm() < 1e-12, "{f}");
    assert!((x.y - 0.01).abs() < 2e-5, "{x}");
    // Within the cone (2 mm, 1 N of 1.5 N) it sticks, and beyond it slides.
    let (f, x) = at([0.002, 0.004, 0.0], 60);
    assert!((f.x + 1.0).abs() < 5e-3 && x.x.abs() < 1e-5, "{f} {x}");
    for k in 1..=80 {
        let (f, _) = at([0.002 + 1e-4 * f64::from(k), 0.004, 0.0], 1);
        let (t, most) = (-f.x, 0.5 * f.y);
        assert!(t <= most * (1.0 + 1e-9) && (k < 20 || (t / most - 1.0).abs() < 1e-9), "{k}: {f}");
    }
    let (_, x) = at([0.010, 0.004, 0.0], 1);
    assert!((x.x - 0.007).abs() < 1e-4, "{x}");
    let (f, x) = at([0.010, 0.02, 0.0], 1);
    assert_eq!(f, Vector3::zeros(), "no pull at {x}");
}

/// The compliance of a patch of the full finite element model under a load along `axis`, m/N: the
/// bake has solved it with a site at every vertex.
fn full_compliance(model: &ModalModel, vertex: u32, radius: f64, axis: usize) -> f64 {
    let patch = Patch::around(model.surface(), vertex, radius).unwrap();
    let row = |mode| {
        let entries = patch.entries().iter();
        entries.map(|&(v, w)| w * f64::from(model.displacement_row(v, axis, mode))).sum::<f64>()
    };
    let modal: f64 = model.omega().iter().enumerate().map(|(k, w)| (row(k) / w).powi(2)).sum();
    modal + model.residual_flexibility(&patch, model.mode_count()).unwrap()[axis][axis]
}

#[test]
fn a_pressed_block_gives_the_force_of_the_full_solution() {
    for young in [1e4, 1e5, 1e6] {
        let model = block(young);
        let at = top(&model);
        let mut bodies = [body(&model, 60.0)];
        let mut probes = [probe(0.01, at + Vector3::new(0.0, 0.02, 0.0))];
        let mut islands = Islands::default();
        for depth in [0.001, 0.002, 0.004] {
            probes[0].set_target((at + Vector3::new(0.0, 0.01 - depth, 0.0)).into()).unwrap();
            (0..240).for_each(|_| step(&mut islands, &mut bodies, &mut probes, 60.0));
            let contacts = bodies[0].contacts();
            let [contact] = contacts.contacts() else { panic!("{} contacts", contacts.contacts().len()) };
            assert_eq!(contact.other, Touched::Probe(0));
            let spacing = (0.05_f64 / contacts.sites() as f64).sqrt();
            let full = full_compliance(&model, contact.vertex, spacing, 1);
            let want = depth / (1.0 / STIFFNESS + full);
            let got = force(&probes[0]).y;
            // A rigid ball on a half-space on the same spring (Hertz).
            let stiff = 4.0 / 3.0 * young / 0.91 * 0.1;
            let (mut low, mut hertz) = (0.0, STIFFNESS * depth);
            for _ in 0..100 {
                let middle: f64 = 0.5 * (low + hertz);
                let dent = (middle / stiff).powf(2.0 / 3.0);
                if middle < STIFFNESS * (depth - dent) { low = middle } else { hertz = middle }
            }
            println!(
                "E {young:.0e}, {:.0} mm: {got:.4} N, full {want:.4} N ({:+.1} %), Hertz {hertz:.4} N, depth {:.2} mm",
                1e3 * depth,
                100.0 * (got / want - 1.0),
                1e3 * (at.y + 0.01 - probes[0].position()[1]),
            );
            assert!((got / want - 1.0).abs() < 0.05, "{got} {want}");
            // What pushes the tool pushes the body.
            let sum = force(&probes[0]) + Vector3::from(contacts.report().force);
            assert!(sum.norm() < 1e-12 * got, "{sum}");
        }
    }
}

/// Deep presses, with reduced elasticity, against nonlinear finite elements of the same material
/// under the same force on the same patch.
#[test]
fn a_deeply_pressed_block_gives_the_force_of_the_full_nonlinear_solution() {
    let mesh = shapes::cube(6, 0.1).unwrap();
    let anchors = vec!["y<0.001".parse().unwrap()];
    let damping = Damping::Ratio(0.3);
    let config = BakeConfig { young: 1e5, poisson: 0.3, anchors, damping, ..BakeConfig::default() };
    let model = Arc::new(bake(&mesh, None, &config, &mut |_, _| {}).unwrap().model);
    let material = config.material.unwrap();
    let (at, stiffness) = (top(&model), 5e3);
    let mut bodies = [body(&model, 60.0)];
    let press = ProbeConfig { radius: 0.01, stiffness, relaxation: 2e-3, friction: 0.5 };
    let mut probes = [Probe::new(press, (at + Vector3::new(0.0, 0.011, 0.0)).into()).unwrap()];
    let mut islands = Islands::default();
    for depth in [0.004, 0.008, 0.016] {
        let from = probes[0].target()[1];
        let to = at.y + 0.01 - depth;
        for k in 0..600 {
            let share = (f64::from(k) / 300.0).min(1.0);
            probes[0].set_target([at.x, from + share * (to - from), at.z]).unwrap();
            step(&mut islands, &mut bodies, &mut probes, 60.0);
        }
        let contacts = bodies[0].contacts();
        let [contact] = contacts.contacts() else { panic!("{} contacts", contacts.contacts().len()) };
        let spacing = (0.05_f64 / contacts.sites() as f64).sqrt();
        let (got, sunk) = (force(&probes[0]).y, at.y + 0.01 - probes[0].position()[1]);
        // Force against way of the full solution, near the force that the probe feels.
        let full = |force: f64| {
            let patch = Patch::around(model.surface(), contact.vertex, spacing).unwrap();
            let load = [DeadLoad { patch, force: [0.0, -force, 0.0] }];
            let loads = StaticLoads { forces: &load, ..StaticLoads::default() };
            -deflect(&mesh, &config, material, &loads).unwrap().patches[0][1]
        };
        let [(near, y), (far, z)] = [got, 1.1 * got].map(|force| (full(force), force));
        let want = y * (sunk / near).powf((z / y).ln() / (far / near).ln());
        println!(
            "{:.1} mm deep ({:.0} %): {got:.3} N, full nonlinear {want:.3} N ({:+.1} %)",
            1e3 * sunk,
            1e3 * sunk,
            100.0 * (got / want - 1.0)
        );
        // The dent itself is linear, and at a seventh of the height it should not be.
        let bound = if depth < 0.01 { 0.05 } else { 0.09 };
        assert!((got / want - 1.0).abs() < bound, "{got} {want}");
    }
}

#[test]
fn stroking_slides_at_the_cone_and_lifting_lets_go_without_a_pull() {
    for (young, rate) in [(2e4, 30.0), (2e4, 60.0), (1e5, 240.0), (1e6, 60.0)] {
        let model = block(young);
        let at = top(&model);
        let mut bodies = [body(&model, rate)];
        let mut probes = [probe(0.01, at + Vector3::new(-0.03, 0.02, 0.0))];
        let mut islands = Islands::default();
        let (mut slid, mut last) = (0, f64::INFINITY);
        for k in 0..(2.0 * rate) as usize {
            let t = k as f64 / rate;
            let down = if t < 0.5 { 0.012 * (t / 0.5) } else { 0.012 };
            let along = 0.04 * (t - 0.5).max(0.0);
            let target = at + Vector3::new(-0.03 + along, 0.02 - down - 0.002, 0.0);
            probes[0].set_target(target.into()).unwrap();
            step(&mut islands, &mut bodies, &mut probes, rate);
            let f = force(&probes[0]);
            for contact in probes[0].contacts() {
                let (n, f) = (Vector3::from(contact.normal), Vector3::from(contact.force));
                let (fn_, ft) = (f.dot(&n), (f - n * f.dot(&n)).norm());
                assert!(fn_ >= 0.0 && ft <= 0.5 * fn_ * (1.0 + 1e-4), "{young} {rate} {t}: {fn_} {ft}");
                if contact.sliding && fn_ > 0.0 {
                    slid += 1;
                    assert!((ft - 0.5 * fn_).abs() < 1e-4 * fn_, "{ft} {fn_}");
                }
            }
            assert!(f.iter().all(|x| x.is_finite()));
        }
        assert!(slid > rate as usize / 2, "{slid}");
        assert!(force(&probes[0]).y > 0.1);
        // Lifted slowly, the force falls without a change of sign.
        let [x, y, z] = probes[0].target();
        for k in 1..=(rate as usize) {
            let lifted = 0.02 * k as f64 / rate;
            probes[0].set_target([x, y + lifted, z]).unwrap();
            step(&mut islands, &mut bodies, &mut probes, rate);
            let f = force(&probes[0]).y;
            assert!(f >= 0.0 && f <= last + 1e-3, "{young} {rate} {lifted}: {f} after {last}");
            last = f;
        }
        assert_eq!(last, 0.0);
    }
}

#[test]
fn a_free_body_takes_the_momentum_that_the_probe_gives() {
    let model = model(&shapes::sphere(6, 0.05).unwrap(), 1e5, None);
    let mut bodies = [body(&model, 60.0)];
    let mut probes = [probe(0.01, Vector3::new(-0.10, 0.01, 0.0))];
    let mut islands = Islands::default();
    let mut given = Vector3::zeros();
    for k in 0..120 {
        probes[0].set_target([-0.10 + 0.002 * f64::from(k).min(40.0), 0.01, 0.0]).unwrap();
        step(&mut islands, &mut bodies, &mut probes, 60.0);
        given -= force(&probes[0]) / 60.0;
    }
    let (got, _) = bodies[0].momentum();
    let off = (Vector3::from(got) - given).norm() / given.norm();
    println!("momentum {:.4} N s, off by {off:.1e}", given.norm());
    assert!(given.x > 1e-3 && off < 1e-9, "{off}");
}

#[test]
fn two_bodies_and_a_floor_are_pressed_at_once() {
    let model = block(1e5);
    let at = top(&model);
    // Two blocks side by side with a gap that is narrower than the ball.
    let mut bodies = [body(&model, 60.0), body(&model, 60.0)];
    bodies[0].set_pose([-0.055, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]).unwrap();
    bodies[1].set_pose([0.055, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]).unwrap();
    let mut probes = [probe(0.012, at + Vector3::new(0.0, 0.03, 0.0))];
    let mut islands = Islands::default();
    let target = at - Vector3::new(0.0, 0.004, 0.0);
    probes[0].set_target(target.into()).unwrap();
    (0..240).for_each(|_| step(&mut islands, &mut bodies, &mut probes, 60.0));
    let (f, x) = (force(&probes[0]), Vector3::from(probes[0].position()));
    println!("{f:?} at {x:?}, {} contacts", probes[0].contacts().len());
    assert!((f - STIFFNESS * (x - target)).norm() < 1e-9, "the spring balances both");
    for body in &bodies {
        let pushed = body.contacts().report().force;
        assert!(pushed[1] < -0.1, "{pushed:?}");
    }
    // A floor at the height of the block's top stops a ball over the block's edge.
    let floor = Plane { point: at.into(), normal: [0.0, 1.0, 0.0] };
    let mut bodies = [body(&model, 60.0)];
    let mut probes = [probe(0.01, at + Vector3::new(0.0, 0.03, 0.0))];
    probes[0].set_obstacles(vec![Arc::new(floor)]).unwrap();
    probes[0].set_target((at + Vector3::new(0.0, 0.005, 0.0)).into()).unwrap();
    (0..240).for_each(|_| step(&mut islands, &mut bodies, &mut probes, 60.0));
    let (f, x) = (force(&probes[0]), Vector3::from(probes[0].position()));
    // The floor is rigid and takes all that the block would bend for.
    assert!((f.y - 2.5).abs() < 0.01 && (x.y - at.y - 0.01).abs() < 2e-5, "{f} {x}");
}

#[test]
fn nothing_is_passed_through_and_nothing_explodes() {
    // A plate 5 mm thin that stands on its edge.
    let plate = model(&shapes::bar([2, 10, 10], [0.005, 0.1, 0.1]).unwrap(), 1e6, Some("y<0.001"));
    let [low, high] = plate.surface().bounds().map(|at| Vector3::from(at.map(f64::from)));
    let middle = 0.5 * (low + high);
    for (speed, rate) in [(0.5, 60.0), (5.0, 240.0), (5.0, 60.0), (5.0, 30.0)] {
        let mut bodies = [body(&plate, rate)];
        let from = middle - Vector3::new(0.1, 0.0, 0.0);
        let mut probes = [probe(0.005, from)];
        let mut islands = Islands::default();
        step(&mut islands, &mut bodies, &mut probes, rate);
        let mut most = 0.0f64;
        for k in 1..=rate as usize {
            let way = (speed * k as f64 / rate).min(0.11);
            probes[0].set_target((from + Vector3::new(way, 0.0, 0.0)).into()).unwrap();
            step(&mut islands, &mut bodies, &mut probes, rate);
            most = most.max(force(&probes[0]).norm());
            assert!(bodies[0].q().iter().all(|q| q.is_finite()));
        }
        let f = force(&probes[0]);
        println!("{speed} m/s at {rate} Hz: {:.3} N at the end, {most:.3} N at most", f.x);
        assert!(f.x < -0.05 && most < STIFFNESS * 0.12, "{f}");
    }
    // Numbers that are none.
    for bad in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(Probe::new(ProbeConfig { radius: bad, ..Default::default() }, [0.0; 3]).is_err());
        assert!(Probe::new(ProbeConfig { stiffness: bad, ..Default::default() }, [0.0; 3]).is_err());
    }
    let mut bodies = [body(&block(1e5), 60.0)];
    let at = top(bodies[0].model());
    let mut islands = Islands::default();
    let mut probes = [probe(0.01, at)];
    assert!(probes[0].set_target([f64::NAN, 0.0, 0.0]).is_err());
    // Begins inside, at the surface, far inside, teleports in and out.
    for depth in [0.0, 0.005, 0.02, 0.05] {
        let mut probes = [probe(0.01, at - Vector3::new(0.0, depth, 0.0))];
        let mut first = 0.0;
        for k in 0..120 {
            step(&mut islands, &mut bodies, &mut probes, 60.0);
            let f = force(&probes[0]).norm();
            first = if k == 0 { f } else { first };
            assert!(f.is_finite() && f <= STIFFNESS * 0.03, "{depth}: {f}");
        }
        println!("begins {depth} m deep: {first:.3} N at first, {:.3} N after 2 s", force(&probes[0]).norm());
    }
    for k in 0..60 {
        let y = if k % 2 == 0 { 10.0 } else { 0.0 };
        probes[0].set_target((at + Vector3::new(0.0, y, 0.0)).into()).unwrap();
        step(&mut islands, &mut bodies, &mut probes, 60.0);
        assert!(force(&probes[0]).norm() < STIFFNESS * 0.03);
    }
}
