//! Reduced elasticity in closed form: a rod whose material is a spring along it.
#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "a failed test should panic")]

mod nonlinear_rod;
mod rod;

use std::sync::Arc;

use nonlinear_rod::nonlinear_rod;
use pliant_modal::{
    Body, BodyConfig, ElasticEnergy, Elasticity, GrabConfig, Kernel, Material, Patch, Relaxation, StepError,
    StepSettings,
};
use rod::{AREA, LENGTH, tip};

fn settings() -> StepSettings {
    StepSettings { elasticity: Elasticity::Reduced, ..Default::default() }
}

/// Stress of the law of St. Venant and Kirchhoff without sideways strain (nu = 0) at a stretch, Pa.
fn stress(young: f64, stretch: f64) -> f64 {
    0.5 * young * stretch * (stretch * stretch - 1.0)
}

#[test]
fn a_stretched_rod_pulls_as_its_law_says() {
    let young = 2e5;
    let model = Arc::new(nonlinear_rod(young, 15, 0.5));
    for stretch in [0.8, 1.05, 1.3] {
        let mut body = Body::new(model.clone(), settings().into()).unwrap();
        let patch = Patch::around(model.surface(), tip(), 0.01).unwrap();
        let grab = body.grab(&patch, GrabConfig::default()).unwrap();
        let start = body.target(grab).unwrap();
        body.set_target(grab, [start[0] + (stretch - 1.0) * LENGTH, start[1], start[2]]).unwrap();
        for _ in 0..600 {
            body.step().unwrap();
        }
        // Sines do not meet the free end's slope, so that few modes are a little too stiff there.
        let (got, want) = (-body.reaction(grab).unwrap()[0], stress(young, stretch) * AREA);
        println!("stretch {stretch}: {got:.3} N, the law {want:.3} N");
        assert!((got / want - 1.0).abs() < 0.05, "{stretch}: {got} and {want}");
    }
}

#[test]
fn force_and_tangent_are_the_derivatives_of_the_energy() {
    let model = nonlinear_rod(2e5, 11, 0.02);
    let info = model.info();
    for material in [Material::NeoHookean, Material::StVenantKirchhoff] {
        let mut reduced = model.parts().reduced.clone().unwrap();
        reduced.material = material;
        // Gradients in all directions.
        for (index, g) in reduced.gradients.iter_mut().enumerate() {
            *g += 0.3 * ((index * 7919 % 101) as f32 / 101.0 - 0.5);
        }
        let law = material.with(0.4 * info.young, 0.4 * info.young);
        let mut energy = ElasticEnergy::new(&reduced, law, model.omega()).unwrap();
        let q: Vec<f64> = (0..11).map(|k| 0.05 * (f64::from(k) * 1.7).sin()).collect();
        energy.linearize(&q);
        let force = energy.force().to_vec();
        let mut again = vec![0.0; 11];
        energy.force_at(&q, &mut again);
        let size = force.iter().map(|f| f * f).sum::<f64>().sqrt();
        let step = 1e-5;
        for i in 0..11 {
            let shifted = |by: f64| {
                let mut q = q.clone();
                q[i] += by;
                q
            };
            let slope = (energy.energy(&shifted(step)) - energy.energy(&shifted(-step))) / (2.0 * step);
            assert!((slope - force[i]).abs() < 1e-6 * size, "{material}: {slope} and {}", force[i]);
            assert!((again[i] - force[i]).abs() < 1e-12 * size, "{material}: {} and {}", again[i], force[i]);
        }
        // What a slice lacks counts as zero.
        let short = [&q[..4], &[0.0; 7]].concat();
        assert_eq!(energy.energy(&q[..4]), energy.energy(&short));
        let mut few = [0.0; 3];
        energy.force_at(&short, &mut again);
        energy.force_at(&q[..4], &mut few);
        assert_eq!(few, again[..3]);
        energy.tangent_row(11, &mut few);
        if energy.raised() == 0 {
            let mut row = vec![0.0; 11];
            energy.tangent_row(0, &mut row);
            let at = |by: f64| {
                let mut q = q.clone();
                q[0] += by;
                let mut out = vec![0.0; 11];
                energy.force_at(&q, &mut out);
                out
            };
            let (ahead, back) = (at(step), at(-step));
            for k in 0..11 {
                let slope = (ahead[k] - back[k]) / (2.0 * step);
                let scale = model.omega()[0] * model.omega()[k];
                assert!((slope - row[k]).abs() < 1e-3 * scale, "{material}: {slope} and {}", row[k]);
            }
        }
    }
}

#[test]
fn small_motions_are_those_of_linear_elasticity() {
    let model = Arc::new(nonlinear_rod(2e5, 5, 0.02));
    let config = |elasticity| BodyConfig {
        step: 1.0 / 1_000.0,
        ..StepSettings { elasticity, ..Default::default() }.into()
    };
    let mut bodies = [Elasticity::Linear, Elasticity::Reduced]
        .map(|elasticity| Body::new(model.clone(), config(elasticity)).unwrap());
    for body in &mut bodies {
        body.apply_impulse(tip(), [1e-6, 0.0, 0.0]).unwrap();
        for _ in 0..500 {
            body.step().unwrap();
        }
    }
    let size = bodies[0].q().iter().map(|q| q.abs()).fold(0.0, f64::max);
    for (linear, reduced) in bodies[0].q().iter().zip(bodies[1].q()) {
        assert!((linear - reduced).abs() < 0.02 * size, "{linear} and {reduced}");
    }
}

#[test]
fn what_reduced_elasticity_has_not_is_refused_and_it_has_no_warp() {
    let model = Arc::new(nonlinear_rod(2e5, 5, 0.02));
    let relaxation = Some(Relaxation { ratio: 0.5, time: 0.1 });
    let wrong = StepSettings { relaxation, ..settings() };
    let error = Kernel::new(model.clone(), wrong, 5, 0.01).unwrap_err();
    assert!(matches!(error, StepError::Input { what: "relaxation", .. }), "{error}");
    let kernel = Kernel::new(model.clone(), settings(), 5, 0.01).unwrap();
    assert!(kernel.is_reduced() && !kernel.warps());
    let plain = Arc::new(rod::rod(2e5, 5, 0.02, false));
    let kernel = Kernel::new(plain, settings(), 5, 0.01).unwrap();
    assert!(!kernel.is_reduced() && kernel.warps());
    // Settings that differ in the elasticity alone have different digests.
    assert_ne!(settings().to_bytes(), StepSettings::default().to_bytes());
    let read: StepSettings = postcard::from_bytes(&postcard::to_stdvec(&settings()).unwrap()).unwrap();
    assert_eq!(read, settings());
}

#[test]
fn a_body_that_keeps_no_mode_or_few_steps_too() {
    let model = Arc::new(nonlinear_rod(2e5, 5, 0.02));
    for modes in 0..=5 {
        let config = BodyConfig { modes: Some(modes), ..settings().into() };
        let mut body = Body::new(model.clone(), config).unwrap();
        body.apply_impulse(tip(), [0.1, 0.0, 0.0]).unwrap();
        for _ in 0..20 {
            body.step().unwrap();
        }
        assert_eq!(body.energy() > 0.0, modes > 0);
    }
    let reduced = model.parts().reduced.clone().unwrap();
    let law = Material::NeoHookean.with(1e5, 1e5);
    for omega in [&[][..], &[0.0; 5], &[f64::NAN; 5], &[1.0; 4]] {
        assert!(ElasticEnergy::new(&reduced, law, omega).is_err(), "{omega:?}");
    }
}

#[test]
fn absurd_states_are_an_error_or_a_step_and_never_a_panic() {
    let model = Arc::new(nonlinear_rod(2e5, 5, 0.02));
    for size in [1e-300, 1.0, 1e6, 1e50, 1e99, 1e200] {
        let mut body = Body::new(model.clone(), settings().into()).unwrap();
        let mut state = body.state().clone();
        state.q.iter_mut().enumerate().for_each(|(k, q)| *q = if k % 2 == 0 { size } else { -size });
        state.v.fill(-size);
        body.set_state(&state).unwrap();
        let patch = Patch::around(model.surface(), tip(), 0.01).unwrap();
        body.grab(&patch, GrabConfig::default()).unwrap();
        for _ in 0..20 {
            let _ = body.step();
            assert!(body.state().is_finite(), "{size}");
        }
    }
}
