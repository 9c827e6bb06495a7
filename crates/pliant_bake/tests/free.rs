//! Free bodies of reduced elasticity between hands: the frame and the elastic coordinates are
//! stepped by turns, and what that costs in force, calm, momentum and energy.

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_bake::{Bake, BakeConfig, Material, PrescribedPatch, StaticLoads, bake, deflect};
use pliant_mesh::{TetMesh, shapes};
use pliant_modal::{
    Body, BodyConfig, Elasticity, GrabConfig, GrabId, HeldShapes, ModalModel, Patch, StepSettings,
};

type Vector = [f64; 3];

fn config() -> BakeConfig {
    BakeConfig { modes: BakeConfig::COORDINATES, material: Some(Material::NeoHookean), ..Default::default() }
}

fn model(mesh: &TetMesh) -> Arc<ModalModel> {
    let Bake { model, .. } = bake(mesh, None, &config(), &mut |_, _| ()).unwrap();
    Arc::new(model)
}

/// A bar of 1 m by 0.1 m by 0.1 m along x.
fn bar() -> TetMesh {
    shapes::bar([20, 2, 2], [1.0, 0.1, 0.1]).unwrap()
}

/// A block of 1 m by 0.4 m by 0.4 m along x.
fn block() -> TetMesh {
    shapes::bar([10, 4, 4], [1.0, 0.4, 0.4]).unwrap()
}

fn patch(model: &ModalModel, at: Vector, radius: f64) -> Patch {
    let positions = model.surface().positions();
    let away = |v: u32| (0..3).map(|k| (f64::from(positions[v as usize][k]) - at[k]).powi(2)).sum::<f64>();
    let vertex = (0..positions.len() as u32).min_by(|&a, &b| away(a).total_cmp(&away(b))).unwrap();
    Patch::around(model.surface(), vertex, radius).unwrap()
}

fn norm(a: Vector) -> f64 {
    a.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn minus(a: Vector, b: Vector) -> Vector {
    std::array::from_fn(|k| a[k] - b[k])
}

/// A body that two hands hold, with the shapes of their patches.
fn held(model: &Arc<ModalModel>, patches: &[Patch], step: f64, damping_scale: f64) -> (Body, Vec<GrabId>) {
    let settings = StepSettings { elasticity: Elasticity::Reduced, damping_scale, ..Default::default() };
    let mut body = Body::new(model.clone(), BodyConfig { step, ..settings.into() }).unwrap();
    let grabs = patches.iter().map(|patch| body.grab(patch, GrabConfig::default()).unwrap()).collect();
    body.set_held_shapes(HeldShapes::new(model, patches).unwrap().map(Arc::new)).unwrap();
    assert!(body.held_shapes().is_some());
    (body, grabs)
}

/// The energy of a body with that in gravity, and what the springs of its hands and of their
/// patches store, J.
fn stored(body: &Body, grabs: &[GrabId]) -> f64 {
    let spring = |grab: &GrabId| {
        let c = body.compliance(*grab).unwrap();
        let force = body.frame().rotation().inverse() * Vector3::from(body.mean_reaction(*grab).unwrap());
        let along = |i: usize| (0..3).map(|j| force[i] * c[i][j] * force[j]).sum::<f64>();
        0.5 * (0..3).map(along).sum::<f64>()
    };
    let (gravity, center) = (body.config().settings.gravity, body.frame().center());
    let height = -(0..3).map(|k| gravity[k] * center[k]).sum::<f64>();
    body.energy() + body.model().mass() * height + grabs.iter().map(spring).sum::<f64>()
}

/// The hands carry a bar that they have jerked: its weight works on the frame, which counts, too.
#[test]
fn a_free_body_under_gravity_in_hands_that_stay_gains_no_energy() {
    let model = model(&bar());
    let patches = [0.0, 1.0].map(|x| patch(&model, [x, 0.05, 0.05], 0.06));
    for (name, gravity, way) in [
        ("turned by 90 degrees", 9.81, [0.5, -0.5, 0.0]),
        ("sheared", 9.81, [0.1, 0.0, 0.3]),
        ("pressed, heavy", 30.0, [-0.1, 0.0, 0.0]),
    ] {
        let (mut body, grabs) = held(&model, &patches, 1.0 / 60.0, 1.0);
        let settings = StepSettings { gravity: [0.0, -gravity, 0.0], ..body.config().settings };
        body.reconfigure(BodyConfig { step: 1.0 / 60.0, ..settings.into() }).unwrap();
        for (grab, sign) in grabs.iter().zip([1.0, -1.0]) {
            let at = body.target(*grab).unwrap();
            body.set_target(*grab, std::array::from_fn(|k| at[k] + sign * way[k])).unwrap();
        }
        // The first steps are those in which the hands jump.
        let mut most = f64::INFINITY;
        for second in 0..8 {
            let mut now = f64::NEG_INFINITY;
            for _ in 0..60 {
                body.step().unwrap();
                now = now.max(stored(&body, &grabs));
            }
            println!("{name}, second {second}: {now:.4} J");
            assert!(second < 2 || now <= most, "{name}: {now} J after {most}");
            most = now;
        }
    }
}

/// Leads hands to where they stay, slowly, and lets the body come to rest.
fn lead(body: &mut Body, grabs: &[GrabId], ways: &[Vector], seconds: f64) {
    let starts: Vec<Vector> = grabs.iter().map(|grab| body.target(*grab).unwrap()).collect();
    let steps = (seconds / body.config().step) as u32;
    for i in 1..=2 * steps {
        let share = (f64::from(i) / f64::from(steps)).min(1.0);
        for ((grab, way), start) in grabs.iter().zip(ways).zip(&starts) {
            body.set_target(*grab, std::array::from_fn(|k| start[k] + share * way[k])).unwrap();
        }
        body.make_held_shapes().unwrap();
        body.step().unwrap();
    }
}

#[test]
fn the_force_in_two_hands_that_tear_shear_and_turn_a_free_body_is_that_of_the_full_solution() {
    let (bar, block) = (bar(), block());
    // Whether the block, ways of both hands as shares of the length, the bound on the error.
    type Row = (&'static str, bool, Vector, f64);
    let rows: [Row; 9] = [
        ("bar, torn by .3", false, [0.3, 0.0, 0.0], 0.005),
        ("bar, torn by .5", false, [0.5, 0.0, 0.0], 0.005),
        ("bar, torn by .7", false, [0.7, 0.0, 0.0], 0.005),
        ("bar, torn by .3 and sheared by .3", false, [0.3, 0.3, 0.0], 0.005),
        ("bar, torn by .1 and turned by .8", false, [0.1, 0.8, 0.0], 0.005),
        ("block, torn by .3", true, [0.3, 0.0, 0.0], 0.01),
        ("block, torn by .5", true, [0.5, 0.0, 0.0], 0.01),
        ("block, torn by .7", true, [0.7, 0.0, 0.0], 0.01),
        ("block, torn by .2 and sheared by .3", true, [0.2, 0.3, 0.0], 0.01),
    ];
    let models = [model(&bar), model(&block)];
    for (name, thick, way, bound) in rows {
        let (mesh, model) = if thick { (&block, &models[1]) } else { (&bar, &models[0]) };
        let (middle, radius) = if thick { (0.2, 0.21) } else { (0.05, 0.06) };
        let patches = [0.0, 1.0].map(|x| patch(model, [x, middle, middle], radius));
        let ways = [way.map(|x| -0.5 * x), way.map(|x| 0.5 * x)];
        let prescribed = [0, 1].map(|i| PrescribedPatch { patch: patches[i].clone(), displacement: ways[i] });
        let loads = StaticLoads { prescribed: &prescribed, ..Default::default() };
        let full = deflect(mesh, &config(), Material::NeoHookean, &loads).unwrap();
        let (mut slow, grabs) = held(model, &patches, 1.0 / 60.0, 30.0);
        lead(&mut slow, &grabs, &ways, 5.0);
        // The hands differ by what still moves the body along the line between them.
        for _ in 0..600 {
            slow.step().unwrap();
        }
        let size = norm(full.reactions[0]);
        let mut off = 0.0f64;
        for (grab, want) in grabs.iter().zip(&full.reactions) {
            off = off.max(norm(minus(slow.reaction(*grab).unwrap(), *want)) / size);
        }
        let [a, b] = [0, 1].map(|i| slow.reaction(grabs[i]).unwrap());
        let apart = norm(std::array::from_fn(|k| a[k] + b[k])) / size;
        println!("{name}: {size:.2} N, off by {off:.5}, both hands differ by {apart:.1e}");
        assert!(off < bound && apart < 1e-6, "{name}: {off} {apart}");
    }
}

#[test]
fn jerked_and_turned_free_bodies_are_calm_and_gain_nothing() {
    let models = [("bar", model(&bar()), 0.05, 0.06), ("block", model(&block()), 0.2, 0.21)];
    let cases: [(&str, Vector, Vector); 6] = [
        ("torn by .3", [-0.15, 0.0, 0.0], [0.15, 0.0, 0.0]),
        ("torn by .7", [-0.35, 0.0, 0.0], [0.35, 0.0, 0.0]),
        ("torn by .3 and sheared by .5", [-0.15, -0.25, 0.0], [0.15, 0.25, 0.0]),
        ("turned by 90 degrees", [0.5, -0.5, 0.0], [-0.5, 0.5, 0.0]),
        ("carried off", [0.0, 0.8, 0.3], [0.0, 0.8, 0.3]),
        ("pressed by .3", [0.15, 0.0, 0.0], [-0.15, 0.0, 0.0]),
    ];
    for (body_name, model, middle, radius) in &models {
        let patches = [0.0, 1.0].map(|x| patch(model, [x, *middle, *middle], *radius));
        let rates = if *body_name == "bar" { &[60.0, 240.0][..] } else { &[60.0][..] };
        for (name, first, second) in cases {
            for &rate in rates {
                let (mut body, grabs) = held(model, &patches, 1.0 / rate, 1.0);
                for (grab, way) in grabs.iter().zip([first, second]) {
                    let at = body.target(*grab).unwrap();
                    body.set_target(*grab, std::array::from_fn(|k| at[k] + way[k])).unwrap();
                }
                // The momentum is what the hands have given. Of the angular momentum that is so up
                // to the arms, which are those of the last round and not those at the end.
                let mut given = [[0.0; 3]; 2];
                let mut lost = [0.0f64; 2];
                let (mut pushed, mut early, mut late) = (0.0, [0.0f64; 2], [0.0f64; 2]);
                // Of the body alone, and with the springs of the hands.
                let largest = |most: [f64; 2], body: &Body| {
                    [most[0].max(body.energy()), most[1].max(stored(body, &grabs))]
                };
                let steps = (8.0 * rate) as usize;
                for i in 0..steps {
                    body.step().unwrap();
                    match (i as f64 / rate) as u32 {
                        1 => early = largest(early, &body),
                        7 => late = largest(late, &body),
                        _ => {}
                    }
                    for grab in &grabs {
                        let f = body.mean_reaction(*grab).unwrap();
                        let at = body.grab_position(*grab).unwrap();
                        let arm = [
                            at[1] * f[2] - at[2] * f[1],
                            at[2] * f[0] - at[0] * f[2],
                            at[0] * f[1] - at[1] * f[0],
                        ];
                        for k in 0..3 {
                            given[0][k] -= f[k] / rate;
                            given[1][k] -= arm[k] / rate;
                        }
                    }
                    let (linear, angular) = body.momentum();
                    lost[0] = lost[0].max(norm(minus(linear, given[0])));
                    lost[1] = lost[1].max(norm(minus(angular, given[1])));
                    pushed += grabs.iter().map(|g| norm(body.reaction(*g).unwrap())).sum::<f64>() / rate;
                }
                let energy = body.energy();
                grabs.iter().for_each(|grab| body.release(*grab));
                let (start, mut most, mut drift) = (body.momentum(), 0.0f64, [0.0f64; 2]);
                for _ in 0..(4.0 * rate) as usize {
                    body.step().unwrap();
                    most = most.max(body.energy());
                    let now = body.momentum();
                    drift[0] = drift[0].max(norm(minus(now.0, start.0)));
                    drift[1] = drift[1].max(norm(minus(now.1, start.1)));
                }
                println!(
                    "{body_name} {name} at {rate} Hz: energy {early:.3?} J in the second second, {late:.3?} in \
                     the eighth; after the release {energy:.3}, then at most {most:.3}; momentum off by \
                     {:.1e} and {:.1e} of what was given, then by {:.1e} and {:.1e}",
                    lost[0] / pushed,
                    lost[1] / pushed,
                    drift[0] / pushed,
                    drift[1] / pushed
                );
                let what = format!("{body_name} {name} at {rate} Hz");
                assert!(late[0] <= early[0] && late[1] <= early[1], "{what}: {late:?} J after {early:?}");
                assert!(most <= energy * (1.0 + 1e-9), "{what}: {most} J after {energy}");
                assert!(lost[0] < 1e-12 * pushed && lost[1] < 0.03 * pushed, "{what}: {lost:?} of {pushed}");
                assert!(drift.iter().all(|drift| *drift < 1e-12 * pushed), "{what}: {drift:?} of {pushed}");
            }
        }
    }
}
