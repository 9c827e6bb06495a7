//! Reduced elasticity in closed form: a rod whose material is a spring along it.

use crate::nonlinear_rod;
use crate::rod;

use std::sync::Arc;

use nonlinear_rod::nonlinear_rod;
use pliant_modal::{
    Body, BodyConfig, ElasticEnergy, Elasticity, GrabConfig, GrabId, Kernel, Material, Patch, Relaxation,
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
fn it_has_no_warp_and_needs_a_material() {
    let model = Arc::new(nonlinear_rod(2e5, 5, 0.02));
    let kernel = Kernel::new(model.clone(), settings(), 5, 0.01).unwrap();
    assert!(kernel.is_reduced() && !kernel.warps());
    let plain = Arc::new(rod::rod(2e5, 5, 0.02, false));
    let kernel = Kernel::new(plain, settings(), 5, 0.01).unwrap();
    assert!(!kernel.is_reduced() && kernel.warps());
    // Settings that differ in the elasticity alone have different digests.
    let linear = StepSettings { elasticity: Elasticity::Linear, ..Default::default() };
    assert_ne!(settings().to_bytes(), linear.to_bytes());
    // A model that was baked with a material has its forces without being asked.
    assert_eq!(settings(), StepSettings::default());
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

/// A relaxing rod with its tip held 30 % of the length away, and the steps since.
fn relaxing(modes: usize, step: f64, relaxation: Relaxation) -> (Body, GrabId, f64) {
    let model = Arc::new(nonlinear_rod(2e5, modes, 0.5));
    let settings = StepSettings { relaxation: Some(relaxation), ..settings() };
    let mut body = Body::new(model.clone(), BodyConfig { step, ..settings.into() }).unwrap();
    let patch = Patch::around(model.surface(), tip(), 0.01).unwrap();
    let grab = body.grab(&patch, GrabConfig::default()).unwrap();
    let start = body.target(grab).unwrap();
    body.set_target(grab, [start[0] + 0.3 * LENGTH, start[1], start[2]]).unwrap();
    (body, grab, start[0])
}

#[test]
fn the_stress_of_a_stretched_rod_relaxes_as_the_standard_linear_solid() {
    let relaxation = Relaxation { ratio: 0.6, time: 1.0 };
    for (modes, step) in [(1, 1.0 / 480.0), (12, 1.0 / 480.0), (12, 1.0 / 60.0)] {
        // The same rod without relaxation.
        let (mut elastic, hand, _) = relaxing(modes, step, Relaxation { ratio: 0.0, time: 1.0 });
        for _ in 0..(4.0 / step) as usize {
            elastic.step().unwrap();
        }
        let at_once = elastic.reaction(hand).unwrap()[0];
        let (mut body, grab, _) = relaxing(modes, step, relaxation);
        let mut most = 0.0f64;
        for n in 1..=(12.0 / step) as usize {
            body.step().unwrap();
            let t = n as f64 * step;
            if t > 0.8 {
                let share = body.reaction(grab).unwrap()[0] / at_once;
                most = most.max((share / relaxation.modulus(t) - 1.0).abs());
            }
        }
        let end = body.reaction(grab).unwrap()[0] / at_once;
        println!("{modes} modes at {step:.4} s: off by {most:.4}, ends at {end:.5} of the force at once");
        assert!(most < 0.012 && (end - 0.4).abs() < 1e-4, "{modes} modes: {most}, {end}");
    }
}

#[test]
fn a_rod_under_a_held_force_creeps_as_the_standard_linear_solid() {
    // Slow, so that the material's damping has no part in it.
    let relaxation = Relaxation { ratio: 0.6, time: 5.0 };
    let step = 1.0 / 60.0;
    let model = Arc::new(nonlinear_rod(2e5, 12, 0.3));
    let tip_after = |relaxation: Option<Relaxation>, force: f64, seconds: f64| {
        let settings = StepSettings { relaxation, ..settings() };
        let mut body = Body::new(model.clone(), BodyConfig { step, ..settings.into() }).unwrap();
        let mut path = Vec::new();
        for _ in 0..(seconds / step) as usize {
            body.push(tip(), [force, 0.0, 0.0]).unwrap();
            body.step().unwrap();
            let mut surface = model.surface().positions().to_vec();
            body.reconstruct(&mut surface).unwrap();
            let rest = model.surface().positions()[tip() as usize];
            path.push(f64::from(surface[tip() as usize][0]) - f64::from(rest[0]));
        }
        path
    };
    // Small, so that the strain is proportional to the stress.
    let force = 1e-3 * 2e5 * AREA;
    let at_once = *tip_after(None, force, 8.0).last().unwrap();
    let path = tip_after(Some(relaxation), force, 150.0);
    let mut most = 0.0f64;
    for (n, x) in path.iter().enumerate() {
        let t = (n + 1) as f64 * step;
        if t > 2.0 {
            most = most.max((x / at_once / relaxation.creep(t) - 1.0).abs());
        }
    }
    println!("creep off by {most:.4}");
    assert!(most < 0.012, "{most}");
    // Under a large force, it ends where an elastic rod of the long-term modulus does: in the
    // material's law the force is 2.5 times as large there.
    let force = 0.1 * 2e5 * AREA;
    let long = *tip_after(Some(relaxation), force, 150.0).last().unwrap();
    let elastic = *tip_after(None, 2.5 * force, 8.0).last().unwrap();
    println!("under {force:.1} N: {long:.5} m, elastic with the long-term modulus {elastic:.5} m");
    assert!((long / elastic - 1.0).abs() < 1e-4, "{long} {elastic}");
}

#[test]
fn a_relaxing_rod_is_calm_and_gains_nothing_at_any_step_and_time() {
    for step in [1e-3, 1.0 / 240.0, 1.0 / 60.0, 0.1] {
        for ratio in [0.3, 0.95, 1.0 - 1e-9] {
            for time in [1e-9, 1e-3, 0.03, 1.0, 1e9] {
                let (mut body, grab, _) = relaxing(12, step, Relaxation { ratio, time });
                let mut force = Vec::new();
                for _ in 0..(3.0 / step) as usize {
                    body.step().unwrap();
                    force.push(body.reaction(grab).unwrap()[0]);
                }
                let what = format!("h {step}, ratio {ratio}, time {time}");
                let last = &force[force.len() - 10..];
                let size = last.iter().fold(0.0f64, |most, f| most.max(f.abs()));
                let flips = last.windows(3).map(|w| (w[2] - 2.0 * w[1] + w[0]).abs());
                let ringing = flips.fold(0.0, f64::max) / size.max(1e-6);
                assert!(ringing < 0.02, "{what}: ringing {ringing}");
                // The energy of the relaxed body, which no measure of what the branch stores
                // enters, never gets above what was stored.
                let before = body.energy();
                let elastic = |body: &Body| {
                    let mut state = body.state().clone();
                    state.v.fill(0.0);
                    let mut still = body.clone();
                    let plain = StepSettings { relaxation: None, ..settings() };
                    still.reconfigure(BodyConfig { step, ..plain.into() }).unwrap();
                    state.z.clear();
                    still.set_state(&state).unwrap();
                    still.energy()
                };
                body.release(grab);
                for _ in 0..(2.0 / step) as usize {
                    body.step().unwrap();
                    let now = body.kinetic_energy() + (1.0 - ratio) * elastic(&body);
                    assert!(now <= before * 1.001 + 1e-12, "{what}: {now} after {before}");
                }
            }
        }
    }
}
