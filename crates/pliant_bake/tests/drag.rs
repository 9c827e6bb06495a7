//! Bakes and drags the paper's bar. The reaction must be smooth where the rigid constraint of the
//! paper's equation (4) flips its sign in every step.

use std::sync::Arc;

use nalgebra::{DMatrix, Vector3};
use pliant_bake::{BakeConfig, bake};
use pliant_mesh::shapes;
use pliant_modal::{
    Body, BodyConfig, Damping, Element, GrabConfig, Hand, HeldPatch, Hold, ImpliedPulls, Integrator, Kernel,
    Load, ModalModel, Patch, StepSettings,
};

/// Makes a bar of 20 x 3 x 3 cells, 1,080 tetrahedra and 20 modes, fixed at x = 0.
fn bar(young: f64) -> Arc<ModalModel> {
    let mesh = shapes::bar([20, 3, 3], [1.0, 0.15, 0.15]).unwrap();
    assert_eq!(mesh.tets.len(), 1_080);
    let config = BakeConfig {
        element: Element::Tet4,
        modes: 20,
        young,
        damping: Damping::Ratio(0.02),
        anchors: vec!["x<0.001".parse().unwrap()],
        ..BakeConfig::linear()
    };
    Arc::new(bake(&mesh, None, &config, &mut |_, _| {}).unwrap().model)
}

fn tip(model: &ModalModel) -> u32 {
    let from_middle = |p: &[f32; 3]| (p[0] - 1.0).powi(2) + (p[1] - 0.075).powi(2) + (p[2] - 0.075).powi(2);
    let positions = model.surface().positions();
    (0..positions.len())
        .min_by(|&a, &b| from_middle(&positions[a]).total_cmp(&from_middle(&positions[b])))
        .unwrap() as u32
}

/// Rises from 0 to 1 in one second, with a smooth acceleration.
fn path(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * t * (10.0 - 15.0 * t + 6.0 * t * t)
}

/// Returns max |second difference of F| / max |F| for a tip that is dragged sideways by a fifth of
/// the length.
///
/// A sign flip in every step gives 4.
fn ringing(model: &Arc<ModalModel>, integrator: Integrator, step: f64) -> f64 {
    let settings = StepSettings { integrator, ..Default::default() };
    let mut body = Body::new(model.clone(), BodyConfig { step, settings, ..Default::default() }).unwrap();
    let patch = Patch::around(model.surface(), tip(model), 0.06).unwrap();
    let grab = body.grab(&patch, GrabConfig::default()).unwrap();
    let start = body.grab_position(grab).unwrap();
    let mut forces = Vec::new();
    for i in 0..(2.0 / step) as usize {
        let way = 0.2 * path((i + 1) as f64 * step);
        body.set_target(grab, [start[0], start[1] + way, start[2]]).unwrap();
        body.step().unwrap();
        forces.push(body.reaction(grab).unwrap());
    }
    let norm = |f: [f64; 3]| f.iter().map(|x| x * x).sum::<f64>().sqrt();
    let largest = forces.iter().map(|f| norm(*f)).fold(0.0, f64::max);
    let jump = |w: &[[f64; 3]]| norm(std::array::from_fn(|k| w[2][k] - 2.0 * w[1][k] + w[0][k]));
    forces.windows(3).map(jump).fold(0.0, f64::max) / largest
}

#[test]
fn the_dragged_bar_does_not_ring() {
    let model = bar(2e6);
    for integrator in [Integrator::Exact, Integrator::GeneralizedAlpha { rho_inf: 0.5 }] {
        let got = ringing(&model, integrator, 1.0 / 40.0);
        println!("{integrator:?}: {got:.4}");
        assert!(got < 0.1, "{integrator:?}: {got}");
    }
}

/// Equation (4) of the paper as printed, solved here: average acceleration, and the force that has
/// the patch at its target at the end of each step. Returns the reactions, N.
fn papers_hand(model: &ModalModel, patch: &Patch, step: f64, ways: &[f64]) -> Vec<Vector3<f64>> {
    let modes = model.mode_count();
    let rows: Vec<Vector3<f64>> = (0..modes)
        .map(|mode| {
            let row = |axis| -> f64 {
                let entries = patch.entries().iter();
                entries.map(|&(v, w)| w * f64::from(model.displacement_row(v, axis, mode))).sum()
            };
            Vector3::new(row(0), row(1), row(2))
        })
        .collect();
    let quarter = 0.25 * step * step;
    let mut state = vec![[0.0f64; 3]; modes];
    let mut reactions = Vec::new();
    for way in ways {
        let mass = |k: usize| 1.0 + 0.5 * step * model.damping()[k] + quarter * model.omega()[k].powi(2);
        let ahead = |k: usize| {
            let [q, v, a] = state[k];
            [q + step * v + quarter * a, v + 0.5 * step * a]
        };
        let alone = |k: usize| {
            let [q, v] = ahead(k);
            -(model.damping()[k] * v + model.omega()[k].powi(2) * q) / mass(k)
        };
        let (mut soft, mut left) = (nalgebra::Matrix3::zeros(), Vector3::new(0.0, *way, 0.0));
        for (k, row) in rows.iter().enumerate() {
            soft += row * row.transpose() * (quarter / mass(k));
            left -= row * (ahead(k)[0] + quarter * alone(k));
        }
        let force = soft.try_inverse().unwrap() * left;
        let next: Vec<[f64; 3]> = (0..modes)
            .map(|k| {
                let a = alone(k) + rows[k].dot(&force) / mass(k);
                let [q, v] = ahead(k);
                [q + quarter * a, v + 0.5 * step * a, a]
            })
            .collect();
        state = next;
        reactions.push(-force);
    }
    reactions
}

/// The paper's own hand and integrator, by name. Its force is that of the paper's equation, and
/// flips its sign in every step after a jump of the hand: a position constraint under average
/// acceleration has the double eigenvalue -1 in the constrained direction.
#[test]
fn the_papers_hand_is_its_equation_4() {
    let settings = StepSettings { integrator: Integrator::Newmark, warp: false, ..Default::default() };
    for (young, step) in [(1e5, 1.0 / 40.0), (2e6, 1.0 / 40.0), (2e6, 1e-3), (1e9, 1e-3)] {
        let model = bar(young);
        let patch = Patch::around(model.surface(), tip(&model), 0.06).unwrap();
        let config = BodyConfig { step, settings, ..Default::default() };
        let mut body = Body::new(model.clone(), config).unwrap();
        let grab = body.grab(&patch, GrabConfig::RIGID).unwrap();
        let start = body.grab_position(grab).unwrap();
        // Small enough that the bound of all hands, a pull from one size of the body away, is far.
        let ways = vec![1e-4; 80];
        let want = papers_hand(&model, &patch, step, &ways);
        let (mut worst, mut largest, mut flips) = (0.0f64, 0.0f64, 0);
        for (i, (way, want)) in ways.iter().zip(&want).enumerate() {
            body.set_target(grab, [start[0], start[1] + way, start[2]]).unwrap();
            body.step().unwrap();
            let got = Vector3::from(body.reaction(grab).unwrap());
            (worst, largest) = (worst.max((got - want).norm()), largest.max(want.norm()));
            flips += usize::from(i > 0 && got.y * want.y > 0.0 && want.y * ((i % 2) as f64 - 0.5) > 0.0);
        }
        println!("E {young:.0e}, h {step:.4}: off by {:.1e}, {flips} of 79 steps flip", worst / largest);
        assert!(worst < 1e-6 * largest, "E {young}, h {step}: {worst} N of {largest} N");
        assert!(flips >= 75, "E {young}, h {step}: {flips}");
    }
}

/// A rigid hand is where it should be after each step, and one with the residual flexibility of its
/// patch is not.
#[test]
fn a_rigid_hand_is_at_its_target() {
    let model = bar(2e6);
    let patch = Patch::around(model.surface(), tip(&model), 0.06).unwrap();
    let left = |hold| {
        let settings = StepSettings { warp: false, ..Default::default() };
        let config = BodyConfig { step: 1.0 / 40.0, settings, ..Default::default() };
        let mut body = Body::new(model.clone(), config).unwrap();
        let grab = body.grab(&patch, hold).unwrap();
        let start = body.grab_position(grab).unwrap();
        let mut worst = 0.0f64;
        for i in 1..=80 {
            let target = [start[0], start[1] + 0.2 * path(f64::from(i) / 40.0), start[2]];
            body.set_target(grab, target).unwrap();
            body.step().unwrap();
            let at = body.grab_position(grab).unwrap();
            worst = (0..3).fold(worst, |m, k| m.max((at[k] - target[k]).abs()));
        }
        worst
    };
    let (rigid, soft) = (left(GrabConfig::RIGID), left(GrabConfig::default()));
    println!("{rigid:.1e} m from the target, with the residual flexibility {soft:.1e} m");
    assert!(rigid < 1e-12 && soft > 1e-6, "{rigid} and {soft}");
}

/// Equation (10) on a bar that is bent: the forces of two hands from the accelerations. What a
/// force does to a mode is the derivative of the way of the patch by the mode's coordinate, which
/// is taken here by differences of the warped positions.
#[test]
fn the_forces_of_hands_follow_from_the_accelerations_of_a_bent_bar() {
    let model = bar(2e6);
    let patch = |x: f32| {
        let distance = |p: &[f32; 3]| (p[0] - x).powi(2) + (p[1] - 0.15).powi(2) + (p[2] - 0.075).powi(2);
        let all = model.surface().positions();
        let near = (0..all.len()).min_by(|a, b| distance(&all[*a]).total_cmp(&distance(&all[*b])));
        Patch::around(model.surface(), near.unwrap() as u32, 0.06).unwrap()
    };
    let (patches, forces) = ([patch(1.0), patch(0.5)], [[0.3, 1.5, -0.4], [0.2, -0.8, 0.5]]);
    let modes = model.mode_count();
    let held = patches.each_ref().map(|patch| Arc::new(HeldPatch::new(&model, patch, modes).unwrap()));
    for warp in [false, true] {
        let settings = StepSettings { warp, ..Default::default() };
        let kernel = Kernel::new(model.clone(), settings, modes, 1.0 / 40.0).unwrap();
        let mut state = kernel.at_rest();
        // The first two modes bend the end by a third of the length.
        let unit = |k: usize| held[0].displacement(&one(modes, k, 1.0), false).norm();
        for k in 0..modes {
            state.q[k] = if k < 2 { 0.3 } else { 0.002 * (k as f64).cos() } / unit(k).max(1e-3);
            state.v[k] = 0.1 * (k as f64).sin();
        }
        for k in 0..modes {
            let (omega, damping) = (model.omega()[k], model.damping()[k]);
            let mut force = 0.0;
            for (held, pull) in held.iter().zip(forces) {
                let step = 1e-5;
                let at = |d: f64| {
                    let mut q = state.q.clone();
                    q[k] += d;
                    held.displacement(&q, warp)
                };
                force += ((at(step) - at(-step)) / (2.0 * step)).dot(&Vector3::from(pull));
            }
            state.a[k] = force - damping * state.v[k] - omega * omega * state.q[k];
        }
        let mut hands = held.each_ref().map(|held| {
            let (target, velocity) = (held.rest(), Vector3::zeros());
            Hand::new(held.clone(), Hold::Target { target, velocity, config: GrabConfig::default() })
        });
        ImpliedPulls::new(&kernel).solve(&kernel, &state, &mut hands);
        for (hand, want) in hands.iter().zip(forces) {
            let off = (hand.pull - Vector3::from(want)).norm() / Vector3::from(want).norm();
            println!("warp {warp}: off by {off:.1e}");
            assert!(off < 1e-6, "warp {warp}: {:?} instead of {want:?}", hand.pull);
        }
    }
}

/// A vector with one number that is not 0.
fn one(length: usize, at: usize, value: f64) -> Vec<f64> {
    (0..length).map(|k| if k == at { value } else { 0.0 }).collect()
}

/// Steps of these lengths, s.
const STEPS: [f64; 4] = [1.0 / 40.0, 1.0 / 60.0, 1.0 / 240.0, 1.0 / 1000.0];

#[test]
fn nor_does_it_at_any_stiffness_and_step() {
    for young in [1e3, 1e5, 1e7, 1e9, 1e11] {
        let model = bar(young);
        for step in STEPS {
            let got = ringing(&model, Integrator::Exact, step);
            println!("E {young:.0e}, h {step:.4}: {got:.4}");
            assert!(got < 0.05, "E {young}, h {step}: {got}");
        }
    }
}

/// Returns the spectral radius of one step of the bar that is held at rest, without warp.
///
/// A step is then linear in the coordinates, the velocities and the hand's last mean force. Its
/// matrix is made by a step from each unit vector.
fn spectral_radius(model: &Arc<ModalModel>, step: f64) -> f64 {
    let settings = StepSettings { warp: false, ..Default::default() };
    let modes = model.mode_count();
    let mut kernel = Kernel::new(model.clone(), settings, modes, step).unwrap();
    let patch = Patch::around(model.surface(), tip(model), 0.06).unwrap();
    let patch = Arc::new(HeldPatch::new(model, &patch, modes).unwrap());
    let hold = Hold::Target {
        target: Vector3::from(patch.rest()),
        velocity: Vector3::zeros(),
        config: GrabConfig::default(),
    };
    let size = 2 * modes + 3;
    // Each velocity is in units of its frequency and the force in units of the first mode, so that
    // the matrix is well scaled.
    let omega = model.omega().to_vec();
    // A hand farther away than the body's size would pull no harder.
    let small = 1e-3;
    let force = small * omega[0].powi(2);
    let mut matrix = DMatrix::zeros(size, size);
    for unit in 0..size {
        let mut state = kernel.at_rest();
        let mut hand = Hand::new(patch.clone(), hold);
        match unit {
            _ if unit < modes => state.q[unit] = small,
            _ if unit < 2 * modes => state.v[unit - modes] = small * omega[unit - modes],
            // A hand carries its mean force into the next step.
            _ => hand.mean[unit - 2 * modes] = force,
        }
        let mut hands = [hand];
        kernel.prepare(&hands);
        kernel.step(&mut state, &mut hands, &Load::default()).unwrap();
        for k in 0..modes {
            matrix[(k, unit)] = state.q[k] / small;
            matrix[(modes + k, unit)] = state.v[k] / (small * omega[k]);
        }
        (0..3).for_each(|axis| matrix[(2 * modes + axis, unit)] = hands[0].mean[axis] / force);
    }
    let memory = matrix.columns(2 * modes, 3);
    assert!(memory.column_iter().all(|column| column.norm() > 0.0), "the last force has an effect");
    matrix.complex_eigenvalues().iter().map(|x| x.norm()).fold(0.0, f64::max)
}

#[test]
fn a_held_bar_comes_to_rest_at_any_stiffness_and_step() {
    for young in [1e3, 1e5, 1e7, 1e9, 1e11] {
        let model = bar(young);
        for step in STEPS {
            let got = spectral_radius(&model, step);
            println!("E {young:.0e}, h {step:.4}: 1 - {:.2e}", 1.0 - got);
            assert!(got < 1.0, "E {young}, h {step}: {got}");
        }
    }
}
