//! Probes that lie where two faces of one body meet in a valley: statics, full solutions, calm.

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_bake::{BakeConfig, DeadLoad, StaticLoads, deflect};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{Body, Islands, ModalModel, Patch, Probe, ProbeConfig};

use super::probe::{STIFFNESS, body, force, model, probe, step};

const RADIUS: f64 = 0.015;
/// Height of the valley above the ground, m.
const VALLEY: f64 = 0.03;
/// How far the ball is pressed beyond the place where it touches both faces, m.
const DEPTH: f64 = 0.003;

/// Sine of the angle between a face and the vertical plane through the valley.
fn sine() -> f64 {
    0.5f64.sqrt()
}

/// A block that stands on its fixed bottom. Two faces at 45 degrees meet in its top, at `x = 0`. A
/// ball in this valley touches each of them at a vertex. Its halves mirror each other.
fn grooved() -> TetMesh {
    let edge = RADIUS * sine();
    let mut mesh = shapes::bar([5, 4, 6], [5.0 * edge, 1.0, 6.0 * edge]).unwrap();
    for node in &mut mesh.nodes {
        node[1] *= VALLEY + node[0];
        node[2] -= 3.0 * edge;
    }
    let half = mesh.clone();
    let mirrored: Vec<u32> = half
        .nodes
        .iter()
        .zip(0..)
        .map(|([x, y, z], number)| {
            if *x == 0.0 {
                return number;
            }
            mesh.nodes.push([-x, *y, *z]);
            mesh.nodes.len() as u32 - 1
        })
        .collect();
    mesh.tets.extend(half.tets.iter().map(|tet| tet.map(|node| mirrored[node as usize])));
    mesh.orient();
    mesh.check().unwrap();
    mesh
}

/// Where the center of a ball is that touches both faces.
fn touching() -> Vector3<f64> {
    Vector3::new(0.0, VALLEY + RADIUS / sine(), 0.0)
}

fn in_groove(friction: f64, target: Vector3<f64>) -> Probe {
    let mut probe = probe(RADIUS, target);
    probe.configure(ProbeConfig { friction, ..*probe.config() }).unwrap();
    probe
}

/// What the faces of a groove give in some steps.
#[derive(Default)]
struct Felt {
    /// The last force of each side, N: that with a normal to the right, and to the left.
    sides: [Vector3<f64>; 2],
    /// Smallest and largest sum, N, and its largest change in a step.
    least: f64,
    most: f64,
    jump: f64,
}

fn feel(bodies: &mut [Body], probes: &mut [Probe], steps: usize, rate: f64) -> Felt {
    let mut islands = Islands::default();
    let mut felt = Felt { least: f64::INFINITY, ..Felt::default() };
    let mut last = force(&probes[0]);
    for _ in 0..steps {
        step(&mut islands, bodies, probes, rate);
        let now = force(&probes[0]);
        felt.jump = felt.jump.max((now - last).norm());
        (felt.least, felt.most) = (felt.least.min(now.norm()), felt.most.max(now.norm()));
        last = now;
    }
    for contact in probes[0].contacts() {
        felt.sides[usize::from(contact.normal[0] < 0.0)] += Vector3::from(contact.force);
    }
    felt
}

/// Area of the surface that is not fixed, m^2.
fn free_area(model: &ModalModel) -> f64 {
    let surface = model.surface();
    let corners = surface.triangles().iter().map(|triangle| {
        triangle.map(|vertex| Vector3::from(surface.positions()[vertex as usize].map(f64::from)))
    });
    let free = corners.filter(|corners| corners.iter().any(|corner| corner.y > 0.001));
    free.map(|[a, b, c]| 0.5 * (b - a).cross(&(c - a)).norm()).sum()
}

/// Way of both faces along their normals, m, for a force of 1 N along each, of the full solution.
fn full_give(mesh: &TetMesh, model: &ModalModel, young: f64, spacing: f64) -> f64 {
    let small = 1e-6;
    let foot = RADIUS * sine();
    let patches = [1.0, -1.0].map(|side| {
        let x = Vector3::new(side * foot, VALLEY + foot, 0.0);
        let far = |p: &[f32; 3]| (Vector3::from(p.map(f64::from)) - x).norm();
        let positions = model.surface().positions().iter().enumerate();
        let (nearest, at) = positions.min_by(|a, b| far(a.1).total_cmp(&far(b.1))).unwrap();
        assert!(far(at) < 1e-6);
        Patch::around(model.surface(), nearest as u32, spacing).unwrap()
    });
    let normals = [1.0, -1.0].map(|side| Vector3::new(-side * sine(), sine(), 0.0));
    let loads = [0, 1].map(|k| DeadLoad { patch: patches[k].clone(), force: (-small * normals[k]).into() });
    let anchors = vec!["y<0.001".parse().unwrap()];
    let config = BakeConfig { young, poisson: 0.3, anchors, ..BakeConfig::default() };
    let loads = StaticLoads { forces: &loads, ..StaticLoads::default() };
    let solved = deflect(mesh, &config, config.material.unwrap(), &loads).unwrap();
    let ways = [0, 1].map(|k| -normals[k].dot(&Vector3::from(solved.patches[k])) / small);
    0.5 * (ways[0] + ways[1])
}

#[test]
fn a_ball_rests_on_both_faces_of_a_groove() {
    let mesh = grooved();
    for young in [2e4, 1e5, 1e6] {
        let soft: Arc<ModalModel> = model(&mesh, young, Some("y<0.001"));
        let mut give = None;
        for rate in [60.0, 240.0, 1000.0] {
            let mut bodies = [body(&soft, rate)];
            let mut probes = [in_groove(0.0, touching() + Vector3::new(0.0, 0.01, 0.0))];
            feel(&mut bodies, &mut probes, 2, rate);
            let down = rate as usize / 2;
            for k in 1..=down {
                let way = -0.01 + (0.01 + DEPTH) * k as f64 / down as f64;
                probes[0].set_target((touching() - Vector3::new(0.0, way, 0.0)).into()).unwrap();
                feel(&mut bodies, &mut probes, 1, rate);
            }
            feel(&mut bodies, &mut probes, 2 * down, rate);
            let felt = feel(&mut bodies, &mut probes, down, rate);
            let spacing = (free_area(&soft) / bodies[0].contacts().sites() as f64).sqrt();
            // A force F on the ball is F / (2 s) on each face, and a way along the normals is 1 / s
            // of it down.
            let give = *give.get_or_insert_with(|| full_give(&mesh, &soft, young, spacing));
            let want = DEPTH / (1.0 / STIFFNESS + give / (2.0 * sine().powi(2)));
            let (f, sunk) = (force(&probes[0]), touching().y - probes[0].position()[1]);
            let each = felt.sides.map(|side| side.norm());
            println!(
                "E {young:.0e} at {rate} Hz: {:.4} N of {want:.4} N, faces {:.4} and {:.4} N, {:.2} mm deep, \
                 {:.4} to {:.4} N, jump {:.1e} N",
                f.y,
                each[0],
                each[1],
                1e3 * sunk,
                felt.least,
                felt.most,
                felt.jump
            );
            assert!((f.y / want - 1.0).abs() < 0.1, "{} N of {want} N", f.y);
            let statics = f.y / (2.0 * sine());
            assert!(each.iter().all(|each| (each / statics - 1.0).abs() < 0.02), "{each:?} of {statics}");
            assert!(f.x.hypot(f.z) < 0.02 * f.y, "{f}");
            assert!(felt.jump < 1e-3 * f.y && felt.most - felt.least < 1e-2 * f.y, "it trembles");
        }
    }
}

/// A hand that leads a ball over a groove, into both faces of it and out again, on a closed way,
/// has given energy.
#[test]
fn a_hand_on_a_closed_way_through_a_groove_gives_energy() {
    let soft = model(&grooved(), 5e4, Some("y<0.001"));
    for rate in [60.0, 1000.0] {
        for friction in [0.0, 0.5] {
            let mut bodies = [body(&soft, rate)];
            let mut probes = [in_groove(friction, touching() + Vector3::new(0.0, 0.01, 0.0))];
            let mut islands = Islands::default();
            let (mut given, mut most, mut last) = (0.0, 0.0f64, None::<Vector3<f64>>);
            for k in 0..=(8.0 * rate) as usize {
                let t = std::f64::consts::TAU * k as f64 / (2.0 * rate);
                let way = Vector3::new(0.012 * t.sin(), 0.003 + 0.007 * t.cos(), 0.01 * (2.0 * t).sin());
                let to = touching() + way;
                probes[0].set_target(to.into()).unwrap();
                step(&mut islands, &mut bodies, &mut probes, rate);
                let f = force(&probes[0]);
                most = most.max(f.norm());
                if let Some(from) = last {
                    given -= f.dot(&(to - from));
                }
                last = Some(to);
                assert!(bodies[0].energy() < 0.1, "{} J", bodies[0].energy());
            }
            println!("at {rate} Hz, friction {friction}: {given:.5} J in four rounds, {most:.3} N at most");
            assert!(given > 0.0 && most > 0.5, "{given} {most}");
        }
    }
}
