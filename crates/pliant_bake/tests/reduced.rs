//! Bodies with reduced elasticity against full nonlinear solutions and published values.

use crate::uniaxial;

use std::sync::Arc;

use pliant_bake::{Bake, BakeConfig, DeadLoad, Material, PrescribedPatch, StaticLoads, bake, deflect};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{Body, BodyConfig, Elasticity, GrabConfig, GrabId, ModalModel, Patch, StepSettings};
use uniaxial::uniaxial;

fn config(coordinates: usize) -> BakeConfig {
    BakeConfig {
        modes: coordinates,
        material: Some(Material::NeoHookean),
        anchors: vec!["x<1e-9".parse().unwrap()],
        ..Default::default()
    }
}

fn model(mesh: &TetMesh, config: &BakeConfig) -> Arc<ModalModel> {
    let Bake { model, .. } = bake(mesh, None, config, &mut |_, _| ()).unwrap();
    Arc::new(model)
}

/// A bar of 1 m by 0.1 m by 0.1 m along x, clamped at x = 0.
fn slender() -> TetMesh {
    shapes::bar([20, 2, 2], [1.0, 0.1, 0.1]).unwrap()
}

/// A bar three times as thick.
fn thick() -> TetMesh {
    shapes::bar([10, 3, 3], [1.0, 0.3, 0.3]).unwrap()
}

fn reduced(model: &Arc<ModalModel>, step: f64, settings: StepSettings) -> Body {
    let settings = StepSettings { elasticity: Elasticity::Reduced, ..settings };
    Body::new(model.clone(), BodyConfig { step, ..settings.into() }).unwrap()
}

fn vertex(model: &ModalModel, at: [f64; 3]) -> u32 {
    let positions = model.surface().positions();
    let away = |v: u32| (0..3).map(|k| (f64::from(positions[v as usize][k]) - at[k]).powi(2)).sum::<f64>();
    (0..positions.len() as u32).min_by(|&a, &b| away(a).total_cmp(&away(b))).unwrap()
}

fn norm(a: [f64; 3]) -> f64 {
    a.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| a[k] - b[k])
}

/// Leads a hand to where it stays, slowly, and lets the body come to rest.
fn lead(body: &mut Body, grab: GrabId, way: [f64; 3]) {
    let start = body.target(grab).unwrap();
    for i in 1..=1_200 {
        let share = (f64::from(i) / 600.0).min(1.0);
        body.set_target(grab, std::array::from_fn(|k| start[k] + share * way[k])).unwrap();
        body.step().unwrap();
    }
}

/// Pulls a patch of a bar along `way`. Returns the error of the reaction as a share of it, and the
/// largest error of the surface, m, for linear and reduced elasticity.
fn pulled(
    mesh: &TetMesh,
    config: &BakeConfig,
    model: &Arc<ModalModel>,
    patch: &Patch,
    way: [f64; 3],
) -> [[f64; 2]; 2] {
    let held = [PrescribedPatch { patch: patch.clone(), displacement: way }];
    let loads = StaticLoads { prescribed: &held, ..Default::default() };
    let full = deflect(mesh, config, Material::NeoHookean, &loads).unwrap();
    [Elasticity::Linear, Elasticity::Reduced].map(|elasticity| {
        let settings = StepSettings { elasticity, damping_scale: 30.0, ..Default::default() };
        let mut body = Body::new(model.clone(), settings.into()).unwrap();
        let grab = body.grab(patch, GrabConfig::default()).unwrap();
        lead(&mut body, grab, way);
        let force = norm(minus(body.reaction(grab).unwrap(), full.reactions[0])) / norm(full.reactions[0]);
        let rest = model.surface().positions();
        let mut surface = rest.to_vec();
        body.reconstruct(&mut surface).unwrap();
        let off = |v: usize| {
            norm(std::array::from_fn(|k| f64::from(surface[v][k] - rest[v][k]) - full.surface[v][k]))
        };
        [force, (0..rest.len()).map(off).fold(0.0, f64::max)]
    })
}

#[test]
fn the_force_in_the_hand_is_that_of_the_full_solution() {
    let (mesh, config) = (slender(), config(30));
    let model = model(&mesh, &config);
    // Where, the patch's radius, the direction; way, and the bounds on the errors of the force and
    // of the surface. Away from the end face the patch's own shapes are missing, so that the bounds
    // are wider.
    type Row = (&'static str, [f64; 3], f64, [f64; 3], f64, [f64; 2]);
    let rows: [Row; 9] = [
        ("end, sideways", [1.0, 0.05, 0.05], 0.08, [0.0, 1.0, 0.0], 0.08, [0.01, 1e-3]),
        ("end, sideways", [1.0, 0.05, 0.05], 0.08, [0.0, 1.0, 0.0], 0.3, [0.02, 6e-3]),
        ("end, sideways", [1.0, 0.05, 0.05], 0.08, [0.0, 1.0, 0.0], 0.5, [0.03, 0.015]),
        ("end, pulled", [1.0, 0.05, 0.05], 0.08, [1.0, 0.0, 0.0], 0.08, [0.01, 0.01]),
        ("end, pulled", [1.0, 0.05, 0.05], 0.08, [1.0, 0.0, 0.0], 0.3, [0.02, 0.035]),
        ("corner of the end", [1.0, 0.1, 0.1], 0.05, [0.0, 0.7, 0.7], 0.08, [0.03, 8e-3]),
        ("corner of the end", [1.0, 0.1, 0.1], 0.05, [0.0, 0.7, 0.7], 0.28, [0.1, 0.05]),
        ("middle", [0.5, 0.1, 0.05], 0.05, [0.0, 1.0, 0.0], 0.08, [0.02, 9e-3]),
        ("middle", [0.5, 0.1, 0.05], 0.05, [0.0, 1.0, 0.0], 0.28, [0.12, 0.12]),
    ];
    for (name, at, radius, direction, by, bounds) in rows {
        let patch = Patch::around(model.surface(), vertex(&model, at), radius).unwrap();
        let [linear, reduced] = pulled(&mesh, &config, &model, &patch, direction.map(|x| x * by));
        println!("{name} by {by}: force and surface off by {reduced:.4?}, linear {linear:.4?}");
        assert!(reduced[0] < bounds[0] && reduced[1] < bounds[1], "{name} by {by}: {reduced:?}");
    }
}

#[test]
fn a_slender_cantilever_bends_as_the_elastica() {
    // v / L and u / L of the elastica (Bisshopp and Drucker 1945), as in the full solution's test.
    let side = 1.0 / 30.0;
    let mesh = shapes::bar([30, 1, 1], [1.0, side, side]).unwrap();
    let config = BakeConfig { young: 1e6, poisson: 0.0, ..config(30) };
    let model = model(&mesh, &config);
    let positions = model.surface().positions();
    let end: Vec<u32> = (0..positions.len() as u32).filter(|&v| positions[v as usize][0] > 0.999).collect();
    for (p, v, u) in [(1.0, 0.30172, 0.05643), (2.0, 0.49346, 0.16064)] {
        let force = p * 1e6 * side.powi(4) / 12.0 / end.len() as f64;
        let mut body =
            reduced(&model, 1.0 / 60.0, StepSettings { damping_scale: 30.0, ..Default::default() });
        for _ in 0..6_000 {
            for &vertex in &end {
                body.push(vertex, [0.0, force, 0.0]).unwrap();
            }
            body.step().unwrap();
        }
        let mut surface = positions.to_vec();
        body.reconstruct(&mut surface).unwrap();
        let mean = |axis: usize| {
            let moved = |&v: &u32| f64::from(surface[v as usize][axis] - positions[v as usize][axis]);
            end.iter().map(moved).sum::<f64>() / end.len() as f64
        };
        println!("P L^2 / E I = {p}: {:.5}, {:.5}; the elastica {u}, {v}", -mean(0), mean(1));
        assert!((mean(1) - v).abs() < 0.01 && (-mean(0) - u).abs() < 0.01, "{p}: {} {}", mean(0), mean(1));
    }
}

/// A bar of 1 m, thirty times as long as thick, with the vertices of its free end.
fn rod(config: &BakeConfig) -> (Arc<ModalModel>, Vec<u32>) {
    let mesh = shapes::bar([30, 1, 1], [1.0, 1.0 / 30.0, 1.0 / 30.0]).unwrap();
    let model = model(&mesh, config);
    let positions = model.surface().positions();
    let end = (0..positions.len() as u32).filter(|&v| positions[v as usize][0] > 0.999).collect();
    (model, end)
}

/// Steps a body under forces on vertices that depend on its surface, until it is at rest. Returns
/// the surface.
fn loaded(
    model: &Arc<ModalModel>,
    forces: impl Fn(f64, &[[f32; 3]]) -> Vec<(u32, [f64; 3])>,
) -> Vec<[f32; 3]> {
    let mut body = reduced(model, 1.0 / 60.0, StepSettings { damping_scale: 30.0, ..Default::default() });
    let mut surface = model.surface().positions().to_vec();
    for step in 0..8_000 {
        for (vertex, force) in forces((f64::from(step) / 3_000.0).min(1.0), &surface) {
            body.push(vertex, force).unwrap();
        }
        body.step().unwrap();
        body.reconstruct(&mut surface).unwrap();
    }
    surface
}

fn mean(surface: &[[f32; 3]], vertices: &[u32]) -> [f64; 3] {
    let sum = |axis: usize| vertices.iter().map(|&v| f64::from(surface[v as usize][axis])).sum::<f64>();
    std::array::from_fn(|axis| sum(axis) / vertices.len() as f64)
}

#[test]
fn a_couple_bends_a_rod_to_a_quarter_of_a_circle() {
    let config = BakeConfig { young: 1e6, poisson: 0.0, ..config(30) };
    let (model, end) = rod(&config);
    let side = 1.0 / 30.0;
    let angle = std::f64::consts::FRAC_PI_2;
    let couple = angle * 1e6 * f64::powi(side, 4) / 12.0;
    let rest = model.surface().positions();
    let half = |above: bool| -> Vec<u32> {
        end.iter().copied().filter(|&v| (f64::from(rest[v as usize][1]) > 0.5 * side) == above).collect()
    };
    let [low, high] = [half(false), half(true)];
    assert!(low.len() == 2 && high.len() == 2);
    let surface = loaded(&model, |part, surface| {
        // The pair of forces turns with the end face: it stays across the way from low to high.
        let across = minus(mean(surface, &high), mean(surface, &low));
        let force = part * couple / (2.0 * norm(across));
        let along = [across[1], -across[0], 0.0].map(|x| x * force / norm(across));
        let pull = |v: &u32| (*v, along);
        let press = |v: &u32| (*v, along.map(|x| -x));
        low.iter().map(pull).chain(high.iter().map(press)).collect()
    });
    let tip = mean(&surface, &end);
    // The axis is an arc: x = R sin(L / R), y = R (1 - cos(L / R)), R = 2 L / pi.
    let radius = 1.0 / angle;
    let off = norm([tip[0] - radius, tip[1] - 0.5 * side - radius, tip[2] - 0.5 * side]);
    println!("the tip of a rod bent by 90 degrees is at {tip:.4?}, off by {off:.4} of its length");
    // The coordinates do not have all of so large a turn (docs/limits.md).
    assert!(off < 0.05, "{tip:?}");
}

#[test]
fn a_stretched_rod_pulls_as_its_law_says() {
    let side = 1.0 / 30.0;
    let stretch = 1.3;
    for material in [Material::NeoHookean, Material::StVenantKirchhoff] {
        let config = BakeConfig { young: 1e6, material: Some(material), ..config(30) };
        let (model, end) = rod(&config);
        let stress = match material {
            Material::NeoHookean => uniaxial(config.young, config.poisson, stretch),
            _ => 0.5 * config.young * stretch * (stretch * stretch - 1.0),
        };
        let force = stress * side * side / end.len() as f64;
        let surface = loaded(&model, |part, _| end.iter().map(|&v| (v, [part * force, 0.0, 0.0])).collect());
        // The middle does not feel how the ends are held.
        let at = |x: f32| {
            let positions = model.surface().positions();
            let near = |v: &u32| (positions[*v as usize][0] - x).abs() < 1e-3;
            mean(&surface, &(0..positions.len() as u32).filter(near).collect::<Vec<_>>())[0]
        };
        let got = (at(0.8) - at(0.2)) / 0.6;
        println!("{material}: stretched to {got:.5}, the closed form {stretch}");
        assert!((got - stretch).abs() < 0.005, "{material}: {got}");
    }
}

#[test]
fn a_bar_hangs_as_the_full_solution_does() {
    let (mesh, config) = (thick(), BakeConfig { young: 5e5, ..config(30) });
    let model = model(&mesh, &config);
    for g in [9.81, 19.62] {
        let gravity = [0.0, -g, 0.0];
        let full =
            deflect(&mesh, &config, Material::NeoHookean, &StaticLoads { gravity, ..Default::default() })
                .unwrap();
        let mut body =
            reduced(&model, 1.0 / 60.0, StepSettings { gravity, damping_scale: 30.0, ..Default::default() });
        for _ in 0..3_000 {
            body.step().unwrap();
        }
        let rest = model.surface().positions();
        let mut surface = rest.to_vec();
        body.reconstruct(&mut surface).unwrap();
        let off = |v: usize| {
            norm(std::array::from_fn(|k| f64::from(surface[v][k] - rest[v][k]) - full.surface[v][k]))
        };
        let worst = (0..rest.len()).map(off).fold(0.0, f64::max);
        let tip = vertex(&model, [1.0, 0.15, 0.15]) as usize;
        println!("{g} m/s^2: the end hangs {:.4} m, off by {worst:.4} m at most", full.surface[tip][1]);
        assert!(worst < 0.01, "{g}: {worst}");
    }
}

/// Lets a held bar go and returns its free motion: the path of a patch along `axis` and the
/// energies.
fn released(
    model: &Arc<ModalModel>,
    way: [f64; 3],
    axis: usize,
    step: f64,
    seconds: f64,
) -> (Vec<f64>, Vec<f64>) {
    let patch = Patch::around(model.surface(), vertex(model, [1.0, 0.15, 0.15]), 0.2).unwrap();
    let mut body = reduced(model, 1.0 / 60.0, StepSettings { damping_scale: 20.0, ..Default::default() });
    let grab = body.grab(&patch, GrabConfig::default()).unwrap();
    lead(&mut body, grab, way);
    let mut state = body.state().clone();
    state.v.fill(0.0);
    let mut body = reduced(model, step, StepSettings { damping_scale: 0.0, ..Default::default() });
    // A hand this soft only tells where the patch is.
    let probe = body.grab(&patch, GrabConfig { stiffness: Some(1e-9), relaxation: 0.0 }).unwrap();
    let rest = body.grab_position(probe).unwrap()[axis];
    body.set_state(&state).unwrap();
    let mut path = vec![body.grab_position(probe).unwrap()[axis] - rest];
    let mut energy = vec![body.energy()];
    for _ in 0..(seconds / step) as usize {
        body.step().unwrap();
        path.push(body.grab_position(probe).unwrap()[axis] - rest);
        energy.push(body.energy());
    }
    (path, energy)
}

/// Frequency from the falling zero crossings of a path, Hz.
fn frequency(path: &[f64], step: f64) -> f64 {
    let crossing = |(i, pair): (usize, &[f64])| {
        let [a, b] = [pair[0], pair[1]];
        (a > 0.0 && b <= 0.0).then(|| step * (i as f64 + a / (a - b)))
    };
    let times: Vec<f64> = path.windows(2).enumerate().filter_map(crossing).collect();
    (times.len() - 1) as f64 / (times[times.len() - 1] - times[0])
}

#[test]
fn a_body_that_was_let_go_rings_on_at_its_frequency_and_gains_nothing() {
    let model = model(&thick(), &config(30));
    let step = 1.0 / 240.0;
    for (way, axis, small) in
        [([0.0, 0.01, 0.0], 1, true), ([0.01, 0.0, 0.0], 0, true), ([0.0, 0.4, 0.0], 1, false)]
    {
        let (path, energy) = released(&model, way, axis, step, 5.0);
        let (fine, _) = released(&model, way, axis, step / 8.0, 5.0);
        let (hz, fine) = (frequency(&path, step), frequency(&fine, step / 8.0));
        let most = energy.iter().fold(0.0f64, |most, e| most.max(*e)) / energy[0];
        let lost = 1.0 - (energy[energy.len() - 1] / energy[0]).sqrt();
        println!("{way:?}: {hz:.4} Hz, {fine:.4} by a finer step; {lost:.4} of the amplitude lost in 5 s");
        assert!((hz / fine - 1.0).abs() < if small { 1e-3 } else { 0.01 }, "{way:?}: {hz} and {fine}");
        assert!(most <= 1.0 + 1e-9, "{way:?}: energy grew to {most}");
        assert!(lost < if small { 0.01 } else { 0.15 }, "{way:?}: {lost}");
    }
}

#[test]
fn jerks_presses_and_tears_are_calm() {
    let bar = model(&thick(), &config(30));
    let cube = {
        let config = BakeConfig { anchors: vec!["y<1e-9".parse().unwrap()], ..config(30) };
        model(&shapes::cube(3, 1.0).unwrap(), &config)
    };
    let free = model(&thick(), &BakeConfig { anchors: Vec::new(), ..config(30) });
    // Model, hands with their patches and ways, all at once.
    type Hands = Vec<([f64; 3], f64, [f64; 3])>;
    let end = [1.0, 0.15, 0.15];
    let apart: Hands = vec![([0.0, 0.15, 0.15], 0.15, [-0.35, 0.0, 0.0]), (end, 0.15, [0.35, 0.0, 0.0])];
    let cases: Vec<(&str, &Arc<ModalModel>, Hands)> = vec![
        ("jerked aside", &bar, vec![(end, 0.2, [0.0, 0.5, 0.0])]),
        ("jerked out", &bar, vec![(end, 0.2, [0.5, 0.0, 0.0])]),
        ("folded", &bar, vec![(end, 0.2, [-0.8, 0.2, 0.0])]),
        ("turned inside out", &bar, vec![(end, 0.2, [-1.3, 0.0, 0.0])]),
        ("pressed to half the height", &cube, vec![([0.5, 1.0, 0.5], 0.6, [0.0, -0.5, 0.0])]),
        ("torn apart by 70 %", &free, apart),
    ];
    for (name, model, hands) in cases {
        for step in [1.0 / 60.0, 1.0 / 240.0] {
            let mut body = reduced(model, step, StepSettings::default());
            let mut grabs = Vec::new();
            for (at, radius, way) in &hands {
                let patch = Patch::around(model.surface(), vertex(model, *at), *radius).unwrap();
                let grab = body.grab(&patch, GrabConfig::default()).unwrap();
                let from = body.target(grab).unwrap();
                body.set_target(grab, std::array::from_fn(|k| from[k] + way[k])).unwrap();
                grabs.push(grab);
            }
            let steps = |seconds: f64| 0..(seconds / step) as usize;
            let forces: Vec<[f64; 3]> = steps(8.0)
                .map(|_| {
                    body.step().unwrap();
                    body.reaction(grabs[0]).unwrap()
                })
                .collect();
            // Ringing over the last two seconds: the second difference as a share of the force. A
            // force that flips in every step has 4.
            let last = &forces[forces.len() - (2.0 / step) as usize..];
            let size = last.iter().map(|&f| norm(f)).fold(0.0, f64::max);
            let bend = |w: &[[f64; 3]]| norm(std::array::from_fn(|k| w[0][k] - 2.0 * w[1][k] + w[2][k]));
            let ringing = last.windows(3).map(bend).fold(0.0, f64::max) / size;
            grabs.into_iter().for_each(|grab| body.release(grab));
            let held = body.energy();
            let most = steps(4.0).fold(0.0f64, |most, _| {
                body.step().unwrap();
                most.max(body.energy())
            });
            println!(
                "{name} at {step:.4} s: {size:.1} N, ringing {ringing:.1e}, energy after release {:.4}",
                most / held
            );
            assert!(ringing < 0.01, "{name} at {step}: {ringing}");
            assert!(most <= held * (1.0 + 1e-9), "{name} at {step}: {}", most / held);
        }
    }
}

#[test]
fn dead_loads_agree_too_and_a_model_without_material_stays_linear() {
    let (mesh, config) = (thick(), config(30));
    let model = model(&mesh, &config);
    let patch = Patch::around(model.surface(), vertex(&model, [1.0, 0.15, 0.15]), 0.2).unwrap();
    let force = [0.0, 60.0, 0.0];
    let loads = [DeadLoad { patch: patch.clone(), force }];
    let full =
        deflect(&mesh, &config, Material::NeoHookean, &StaticLoads { forces: &loads, ..Default::default() })
            .unwrap();
    let mut body = reduced(&model, 1.0 / 60.0, StepSettings { damping_scale: 30.0, ..Default::default() });
    for _ in 0..2_000 {
        for &(vertex, weight) in patch.entries() {
            body.push(vertex, force.map(|f| f * weight)).unwrap();
        }
        body.step().unwrap();
    }
    let probe = body.grab(&patch, GrabConfig::default()).unwrap();
    let rest = Body::new(model.clone(), BodyConfig::default()).unwrap().grab(&patch, GrabConfig::default());
    assert!(rest.is_ok());
    let mut moved = body.grab_position(probe).unwrap();
    for &(v, weight) in patch.entries() {
        let at = model.surface().positions()[v as usize];
        (0..3).for_each(|k| moved[k] -= weight * f64::from(at[k]));
    }
    let want = full.patches[0];
    println!("moved {moved:.4?}, the full solution {want:.4?}");
    // The residual flexibility under a push is not among the coordinates.
    assert!(norm(minus(moved, want)) < 0.03 * norm(want), "{moved:?} and {want:?}");

    let plain = BakeConfig { material: None, modes: 20, ..config.clone() };
    let linear = self::model(&mesh, &plain);
    let mut paths = [Elasticity::Linear, Elasticity::Reduced].map(|elasticity| {
        let settings = StepSettings { elasticity, ..Default::default() };
        let mut body = Body::new(linear.clone(), settings.into()).unwrap();
        let grab = body.grab(&patch, GrabConfig::default()).unwrap();
        lead(&mut body, grab, [0.0, 0.2, 0.0]);
        body.q().to_vec()
    });
    let second = paths[1].split_off(0);
    assert_eq!(paths[0], second);
}

#[test]
fn what_a_material_does_not_bear_is_refused_by_name() {
    let mesh = shapes::bar([2, 1, 1], [0.4, 0.1, 0.1]).unwrap();
    let refused = |config: BakeConfig| bake(&mesh, None, &config, &mut |_, _| ()).unwrap_err().to_string();
    let most = BakeConfig::MAX_COORDINATES;
    let many = refused(BakeConfig { modes: most + 1, ..config(1) });
    assert!(many.contains("modes") && many.contains("120") && most == 120, "{many}");
    let locking = refused(BakeConfig { poisson: 0.49, ..config(9) });
    assert!(locking.contains("Poisson"), "{locking}");
}

#[test]
fn any_number_of_coordinates_bakes() {
    let mesh = shapes::bar([4, 1, 1], [0.4, 0.1, 0.1]).unwrap();
    for count in [1, 2, 3, 5, 9] {
        for free in [false, true] {
            let anchors = if free { Vec::new() } else { config(1).anchors };
            let model = model(&mesh, &BakeConfig { anchors, sites: Some(8), ..config(count) });
            assert_eq!(model.mode_count(), count);
            let mut body = reduced(&model, 1.0 / 60.0, StepSettings::default());
            body.apply_impulse(0, [0.1, 0.2, 0.0]).unwrap();
            (0..60).for_each(|_| assert!(body.step().unwrap().regularized == 0));
        }
    }
}
