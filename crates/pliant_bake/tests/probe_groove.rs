//! Probes that lie where two faces of one body meet in a valley: statics, full solutions, calm.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use pliant_bake::{BakeConfig, DeadLoad, StaticLoads, deflect};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{Body, Islands, ModalModel, Patch, Probe, ProbeConfig};

use super::probe::{STIFFNESS, body, force, model, probe, step};

const RADIUS: f64 = 0.015;
/// Height of the valley above the ground, m.
const VALLEY: f64 = 0.03;
/// How far the ball is pressed beyond the place where it touches both faces, m.
const DEPTH: f64 = 0.003;

/// A valley whose faces rise at this angle, rad.
#[derive(Clone, Copy)]
struct Groove(f64);

/// A valley of 90 degrees, and one into which the corner of a cube fits.
const STEEP: Groove = Groove(std::f64::consts::FRAC_PI_4);
const FLAT: Groove = Groove(std::f64::consts::FRAC_PI_6);

impl Groove {
    /// Outward normal of the face on a side, 1 or -1.
    fn normal(self, side: f64) -> Vector3<f64> {
        Vector3::new(-side * self.0.sin(), self.0.cos(), 0.0)
    }

    /// Where the center of a ball is that touches both faces.
    fn touching(self) -> Vector3<f64> {
        Vector3::new(0.0, VALLEY + RADIUS / self.0.cos(), 0.0)
    }
}

/// A block that stands on its fixed bottom. Two faces meet in its top, at `x = 0`. A ball in this
/// valley touches each of them at a vertex. Its halves mirror each other.
fn grooved(groove: Groove) -> TetMesh {
    let edge = RADIUS * groove.0.sin();
    let count = (0.053 / edge).round() as usize;
    let mut mesh = shapes::bar([count, 4, 6], [count as f64 * edge, 1.0, 0.0636]).unwrap();
    for node in &mut mesh.nodes {
        node[1] *= VALLEY + node[0] * groove.0.tan();
        node[2] -= 0.0318;
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

/// Ends of a capsule that lies along a groove, m.
const ALONG: [[f64; 3]; 2] = [[0.0, 0.0, -0.02], [0.0, 0.0, 0.02]];

/// What the faces of a groove give in some steps.
#[derive(Default)]
struct Felt {
    /// The last force of each side, N: that with a normal to the right, and to the left.
    sides: [Vector3<f64>; 2],
    /// Smallest and largest sum, N, and its largest change in a step.
    least: f64,
    most: f64,
    jump: f64,
    /// Steps that were begun anew with implicit contacts.
    guarded: usize,
}

fn feel(bodies: &mut [Body], probes: &mut [Probe], steps: usize, rate: f64) -> Felt {
    let mut islands = Islands::default();
    let mut felt = Felt { least: f64::INFINITY, ..Felt::default() };
    let mut last = force(&probes[0]);
    for _ in 0..steps {
        step(&mut islands, bodies, probes, rate);
        felt.guarded += usize::from(bodies[0].contacts().report().guarded);
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
fn full_give(groove: Groove, mesh: &TetMesh, model: &ModalModel, young: f64, spacing: f64) -> f64 {
    let small = 1e-6;
    let normals = [1.0, -1.0].map(|side| groove.normal(side));
    let patches = normals.map(|normal| {
        let x = groove.touching() - RADIUS * normal;
        let far = |p: &[f32; 3]| (Vector3::from(p.map(f64::from)) - x).norm();
        let positions = model.surface().positions().iter().enumerate();
        let (nearest, at) = positions.min_by(|a, b| far(a.1).total_cmp(&far(b.1))).unwrap();
        assert!(far(at) < 1e-6);
        Patch::around(model.surface(), nearest as u32, spacing).unwrap()
    });
    let loads = [0, 1].map(|k| DeadLoad { patch: patches[k].clone(), force: (-small * normals[k]).into() });
    let anchors = vec!["y<0.001".parse().unwrap()];
    let config = BakeConfig { young, poisson: 0.3, anchors, ..BakeConfig::default() };
    let loads = StaticLoads { forces: &loads, ..StaticLoads::default() };
    let solved = deflect(mesh, &config, config.material.unwrap(), &loads).unwrap();
    let ways = [0, 1].map(|k| -normals[k].dot(&Vector3::from(solved.patches[k])) / small);
    0.5 * (ways[0] + ways[1])
}

/// How a tool lies in a groove that was led into it without friction and rests there.
struct Rest {
    young: f64,
    /// Force, its part on each face, and the force of a ball there by full finite elements, N.
    force: f64,
    each: [f64; 2],
    ball: f64,
}

/// Presses a tool into a groove and asserts that it is calm, that both faces bear the same, and
/// that they bear what the spring gives.
fn rests(groove: Groove, name: &str, tool: impl Fn(&mut Probe)) -> Vec<Rest> {
    let mesh = grooved(groove);
    let mut found = Vec::new();
    for young in [2e4, 1e5, 1e6] {
        let soft: Arc<ModalModel> = model(&mesh, young, Some("y<0.001"));
        let mut give = None;
        for rate in [60.0, 240.0, 1000.0] {
            let mut bodies = [body(&soft, rate)];
            let mut probes = [probe(RADIUS, groove.touching())];
            tool(&mut probes[0]);
            probes[0].configure(ProbeConfig { friction: 0.0, ..*probes[0].config() }).unwrap();
            // Where the tool touches first.
            let from = Vector3::from(probes[0].target());
            let to = |way: f64| <[f64; 3]>::from(from - Vector3::new(0.0, way, 0.0));
            probes[0].set_target(to(-0.01)).unwrap();
            feel(&mut bodies, &mut probes, 2, rate);
            let down = rate as usize / 2;
            for k in 1..=down {
                probes[0].set_target(to(-0.01 + (0.01 + DEPTH) * k as f64 / down as f64)).unwrap();
                feel(&mut bodies, &mut probes, 1, rate);
            }
            feel(&mut bodies, &mut probes, 2 * down, rate);
            let felt = feel(&mut bodies, &mut probes, down, rate);
            let spacing = (free_area(&soft) / bodies[0].contacts().sites() as f64).sqrt();
            // A force F on the ball is F / (2 c) on each face with the cosine c of its slope, and a
            // way along the normals is 1 / c of it down.
            let give = *give.get_or_insert_with(|| full_give(groove, &mesh, &soft, young, spacing));
            let cosine = groove.0.cos();
            let ball = DEPTH / (1.0 / STIFFNESS + give / (2.0 * cosine.powi(2)));
            let (f, sunk) = (force(&probes[0]), from.y - probes[0].position()[1]);
            let each = felt.sides.map(|side| side.norm());
            println!(
                "{name}, E {young:.0e} at {rate} Hz: {:.4} N, a ball {ball:.4} N, faces {:.4} and {:.4} N, \
                 {:.2} mm deep, {:.4} to {:.4} N, jump {:.1e} N, {} contacts, {} guarded",
                f.y,
                each[0],
                each[1],
                1e3 * sunk,
                felt.least,
                felt.most,
                felt.jump,
                probes[0].contacts().len(),
                felt.guarded
            );
            assert!((each[0] / each[1] - 1.0).abs() < 0.02, "{each:?}");
            let spring = STIFFNESS * (DEPTH - sunk);
            assert!((f.y / spring - 1.0).abs() < 0.02, "{} N of {spring} N", f.y);
            assert!(f.x.hypot(f.z) < 0.02 * f.y, "{f}");
            assert!(felt.jump < 1e-3 * f.y && felt.most - felt.least < 1e-2 * f.y, "it trembles");
            found.push(Rest { young, force: f.y, each, ball });
        }
    }
    found
}

/// Each face bears what holds the tool with it.
fn bears(groove: Groove, Rest { force, each, .. }: &Rest) {
    let statics = force / (2.0 * groove.0.cos());
    assert!(each.iter().all(|each| (each / statics - 1.0).abs() < 0.02), "{each:?} of {statics}");
}

fn rests_as_a_ball(groove: Groove, name: &str, tool: impl Fn(&mut Probe)) {
    for rest in rests(groove, name, tool) {
        let Rest { young, force, ball, .. } = rest;
        bears(groove, &rest);
        assert!((force / ball - 1.0).abs() < 0.1, "{name}, {young:e}: {force} N of {ball} N");
    }
}

/// It presses more sites than a ball, and no harder than the spring.
fn rests_on_more_than_a_ball(groove: Groove, name: &str, tool: impl Fn(&mut Probe)) {
    for rest in rests(groove, name, tool) {
        let Rest { young, force, ball, .. } = rest;
        bears(groove, &rest);
        let right = force > 0.99 * ball && force < STIFFNESS * DEPTH;
        assert!(right, "{name}, {young:e}: {force} N, a ball {ball} N");
    }
}

/// Moves a tool so that this place of it (own axes) is where a ball touches both faces.
fn set(probe: &mut Probe, groove: Groove, turn: UnitQuaternion<f64>, place: Vector3<f64>) {
    probe.set_rotation([turn.i, turn.j, turn.k, turn.w]).unwrap();
    probe.set_target((groove.touching() - turn * place).into()).unwrap();
}

#[test]
fn a_ball_rests_on_both_faces_of_a_groove() {
    rests_as_a_ball(STEEP, "ball", |_| {});
}

#[test]
fn a_capsule_rests_along_a_groove() {
    rests_on_more_than_a_ball(STEEP, "capsule along", |probe| probe.set_corners(&ALONG).unwrap());
}

/// Each end lies on one face.
#[test]
fn a_capsule_rests_across_a_groove() {
    rests(STEEP, "capsule across", |probe| {
        probe.set_corners(&[[-0.02, 0.0, 0.0], [0.02, 0.0, 0.0]]).unwrap();
        let [x, y, z] = probe.target();
        probe.set_target([x, y + 0.02, z]).unwrap();
    });
}

/// A cube that stands on one corner.
#[test]
fn a_corner_of_a_box_rests_in_a_groove() {
    let corners: Vec<Vector3<f64>> =
        (0..8).map(|n| Vector3::from_fn(|axis, _| if n >> axis & 1 == 0 { -0.01 } else { 0.01 })).collect();
    let turn = UnitQuaternion::rotation_between(&corners[0], &-Vector3::y()).unwrap();
    // One of its edges is above the valley.
    let edge = turn * (corners[1] - corners[0]);
    let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * -edge.x.atan2(edge.z)) * turn;
    let points: Vec<[f64; 3]> = corners.iter().map(|corner| (*corner).into()).collect();
    rests_as_a_ball(FLAT, "corner of a box", |probe| {
        probe.set_corners(&points).unwrap();
        set(probe, FLAT, turn, corners[0]);
    });
}

/// A slender pyramid that stands on its top, and one that lies on an edge.
#[test]
fn a_hull_rests_in_a_groove() {
    let top = Vector3::new(0.0, -0.03, 0.0);
    let base = [[0.01, 0.0, 0.01], [-0.01, 0.0, 0.01], [-0.01, 0.0, -0.01], [0.01, 0.0, -0.01]];
    rests_as_a_ball(STEEP, "top of a hull", |probe| {
        probe.set_corners(&[&[top.into()], &base[..]].concat()).unwrap();
        set(probe, STEEP, UnitQuaternion::identity(), top);
    });
    let high = [[0.0, 0.02, -0.02], [0.0, 0.02, 0.02]];
    rests_on_more_than_a_ball(STEEP, "edge of a hull", |probe| {
        probe.set_corners(&[ALONG, high].concat()).unwrap();
    });
}

/// A hand that leads a tool from free air into both faces of a groove, over them in rounds, and out
/// again has given energy, on the whole way and in each round but the first, which begins at rest.
#[test]
fn a_hand_on_a_closed_way_through_a_groove_gives_energy() {
    let soft = model(&grooved(STEEP), 5e4, Some("y<0.001"));
    let across = [[-0.02, 0.0, 0.0], [0.02, 0.0, 0.0]];
    let hull = [[0.0; 3], [0.01, 0.03, 0.01], [-0.01, 0.03, 0.01], [0.0, 0.03, -0.01]];
    // With the height above a ball that touches both faces around which the rounds lead, m. The
    // capsule that lies across touches 2 cm above it, and is also pressed that deep.
    let tools: [(&str, &[[f64; 3]], f64); 5] = [
        ("ball", &[[0.0; 3]], 0.0),
        ("capsule along", &ALONG, 0.0),
        ("capsule across", &across, 0.02),
        ("capsule across, deep", &across, 0.0),
        ("hull", &hull, 0.0),
    ];
    let all = [60.0, 1000.0].into_iter().flat_map(|rate| tools.map(|tool| (rate, tool)));
    for (rate, (name, corners, height)) in all {
        for friction in [0.0, 0.5] {
            let mut bodies = [body(&soft, rate)];
            let start = STEEP.touching() + Vector3::new(0.0, height, 0.0);
            let round = |t: f64| {
                let turn = std::f64::consts::TAU * t / 2.0;
                start
                    + Vector3::new(0.012 * turn.sin(), 0.003 + 0.007 * turn.cos(), 0.01 * (2.0 * turn).sin())
            };
            // Down for half a second, four rounds of two seconds, and up again.
            let way = |t: f64| {
                let out = (0.5 - t).max(t - 8.5).max(0.0);
                round(t.clamp(0.5, 8.5) - 0.5) + Vector3::new(0.0, 0.08 * out, 0.0)
            };
            let mut probes = [probe(RADIUS, way(0.0))];
            probes[0].configure(ProbeConfig { friction, ..*probes[0].config() }).unwrap();
            probes[0].set_corners(corners).unwrap();
            let mut islands = Islands::default();
            let (mut given, mut most, mut last) = (0.0, 0.0f64, way(0.0));
            // What was given at the ends of the rounds.
            let mut rounds = Vec::new();
            let mut guarded = 0;
            for k in 0..=(9.0 * rate) as usize {
                let t = k as f64 / rate;
                let to = way(t);
                probes[0].set_target(to.into()).unwrap();
                step(&mut islands, &mut bodies, &mut probes, rate);
                guarded += usize::from(bodies[0].contacts().report().guarded);
                let f = force(&probes[0]);
                if k == 0 {
                    assert!(f.norm() == 0.0, "{name}: {f} in free air");
                }
                most = most.max(f.norm());
                given -= f.dot(&(to - last));
                last = to;
                if (t - 0.5).rem_euclid(2.0) < 1e-9 {
                    rounds.push(given);
                }
                assert!(bodies[0].energy() < 0.1, "{} J", bodies[0].energy());
            }
            let each: Vec<f64> = rounds.windows(2).map(|ends| ends[1] - ends[0]).collect();
            println!(
                "{name} at {rate} Hz, friction {friction}: {given:.5} J, in the rounds {each:.5?} J, {most:.3} N \
                 at most, {guarded} guarded"
            );
            assert!(force(&probes[0]).norm() == 0.0, "{name}: free air is free");
            assert!(given > 0.0 && most > 0.5, "{name}: {given} {most}");
            assert!(each.len() == 4 && each[1..].iter().all(|each| *each > 0.0), "{name}: {each:?}");
        }
    }
}
