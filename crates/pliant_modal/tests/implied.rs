//! Equation (10) of Tang et al. 2013: the forces of hands from the state of the body.
//!
//! The true forces are chosen. The accelerations that they give follow from the equation of motion
//! of each mode and from the model's mode shapes, without the code under test.

use crate::rod;

use std::sync::Arc;

use nalgebra::Vector3;
use pliant_modal::{
    GrabConfig, Hand, HeldPatch, Hold, ImpliedPulls, Kernel, ModalModel, Patch, Relaxation, State,
    StepSettings,
};
use rod::{rod, tip};

const MODES: usize = 8;

/// A state at rest or in motion, with the accelerations that `pulls` (N) on the patches give it.
fn state(
    model: &ModalModel,
    kernel: &Kernel,
    moving: f64,
    relaxation: Option<Relaxation>,
    pulls: &[(Patch, [f64; 3])],
) -> State {
    let mut state = kernel.at_rest();
    for k in 0..MODES {
        let (omega, damping) = (model.omega()[k], model.damping()[k]);
        let phase = 1.3 * k as f64;
        state.q[k] = moving * 1e-3 * phase.cos();
        state.v[k] = moving * 1e-3 * omega * phase.sin();
        let mut viscous = 0.0;
        if let (Some(relaxation), Some(z)) = (relaxation, state.z.get_mut(k)) {
            *z = 0.7 * state.q[k];
            viscous = relaxation.ratio * *z;
        }
        let mut force = 0.0;
        for (patch, pull) in pulls {
            for &(vertex, weight) in patch.entries() {
                for (axis, pull) in pull.iter().enumerate() {
                    force += weight * f64::from(model.displacement_row(vertex, axis, k)) * pull;
                }
            }
        }
        state.a[k] = force - damping * state.v[k] - omega * omega * (state.q[k] - viscous);
    }
    state
}

fn implied(model: &Arc<ModalModel>, kernel: &Kernel, state: &State, patches: &[Patch]) -> Vec<Vector3<f64>> {
    let mut hands: Vec<Hand> = patches
        .iter()
        .map(|patch| {
            let held = Arc::new(HeldPatch::new(model, patch, MODES).unwrap());
            let hold = Hold::Target {
                target: held.rest(),
                velocity: Vector3::zeros(),
                config: GrabConfig::default(),
            };
            Hand::new(held, hold)
        })
        .collect();
    ImpliedPulls::new(kernel).solve(kernel, state, &mut hands);
    hands.iter().map(|hand| hand.pull).collect()
}

#[test]
fn the_forces_of_hands_follow_from_the_accelerations() {
    let model = Arc::new(rod(1e6, MODES, 0.05, false));
    let far = Patch::around(model.surface(), tip(), 0.1).unwrap();
    let near = Patch::around(model.surface(), tip() / 2, 0.1).unwrap();
    let relaxing = Some(Relaxation { ratio: 0.5, time: 0.4 });
    for relaxation in [None, relaxing] {
        for moving in [0.0, 1.0] {
            for hands in [1, 2] {
                let settings = StepSettings { warp: false, relaxation, ..Default::default() };
                let kernel = Kernel::new(model.clone(), settings, MODES, 1.0 / 40.0).unwrap();
                let pulls = [(far.clone(), [1.5, 0.0, 0.0]), (near.clone(), [-0.6, 0.0, 0.0])];
                let state = state(&model, &kernel, moving, relaxation, &pulls[..hands]);
                let patches: Vec<Patch> = pulls[..hands].iter().map(|p| p.0.clone()).collect();
                let got = implied(&model, &kernel, &state, &patches);
                for (got, (_, want)) in got.iter().zip(&pulls) {
                    let off = (got - Vector3::from(*want)).norm() / Vector3::from(*want).norm();
                    println!("{hands} hands, moving {moving}, relaxing {}: {off:.1e}", relaxation.is_some());
                    assert!(off < 1e-8, "{got:?} instead of {want:?}");
                }
            }
        }
    }
}
