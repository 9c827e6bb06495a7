//! Motion of bodies with reduced elasticity: struck modes, and tangents that are not positive.

use std::sync::Arc;

use nalgebra::DMatrix;
use pliant_bake::{BakeConfig, bake};
use pliant_mesh::shapes;
use pliant_modal::{
    Body, BodyConfig, Damping, ElasticEnergy, Elasticity, GrabConfig, ModalModel, Patch, StepSettings,
};

fn config(coordinates: usize) -> BakeConfig {
    BakeConfig { modes: coordinates, anchors: vec!["x<1e-9".parse().unwrap()], ..BakeConfig::default() }
}

/// A bar of 1 m by 0.3 m by 0.3 m along x, clamped at x = 0.
fn bar(config: &BakeConfig) -> Arc<ModalModel> {
    let mesh = shapes::bar([10, 3, 3], [1.0, 0.3, 0.3]).unwrap();
    Arc::new(bake(&mesh, None, config, &mut |_, _| ()).unwrap().model)
}

fn reduced(model: &Arc<ModalModel>, step: f64) -> Body {
    let settings = StepSettings { elasticity: Elasticity::Reduced, ..StepSettings::default() };
    Body::new(model.clone(), BodyConfig { step, ..settings.into() }).unwrap()
}

fn norm(a: [f64; 3]) -> f64 {
    a.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Times and heights of the peaks of a coordinate that swings about zero, from its passages through
/// zero: the time of a passage upward, and the largest value until the next.
fn peaks(path: &[f64], step: f64) -> Vec<[f64; 2]> {
    let mut out: Vec<[f64; 2]> = Vec::new();
    for (i, pair) in path.windows(2).enumerate() {
        if pair[0] <= 0.0 && pair[1] > 0.0 {
            out.push([step * (i as f64 - pair[0] / (pair[1] - pair[0])), 0.0]);
        }
        if let Some(last) = out.last_mut() {
            last[1] = last[1].max(pair[1]);
        }
    }
    // The last swing may not have reached its peak.
    out.pop();
    out
}

/// Each mode alone is struck so that the surface moves by a thousandth of the length.
#[test]
fn the_five_lowest_modes_of_a_struck_body_ring_on_at_their_pitch() {
    let (step, zeta, seconds) = (1.0 / 240.0, 0.002, 8.0);
    for young in [1e5, 1e7] {
        let config = BakeConfig { young, damping: Damping::Ratio(zeta), ..config(36) };
        let model = bar(&config);
        for mode in 0..5 {
            let omega = model.omega()[mode];
            let mut body = reduced(&model, step);
            let count = model.surface().positions().len() as u32;
            let moves = |v: u32| norm([0, 1, 2].map(|axis| f64::from(model.displacement_row(v, axis, mode))));
            let most = (0..count).map(moves).fold(0.0, f64::max);
            let mut state = body.state().clone();
            state.v[mode] = 1e-3 * omega / most;
            body.set_state(&state).unwrap();
            let path: Vec<f64> = (0..(seconds / step) as usize)
                .map(|_| {
                    body.step().unwrap();
                    body.q()[mode]
                })
                .collect();
            let swings = peaks(&path, step);
            let ([first, last], between) = ([swings[0], swings[swings.len() - 1]], swings.len() - 1);
            let time = last[0] - first[0];
            // Of the lowest tones few swings fit, and of high ones few steps in a swing: peaks are
            // up to 1 - cos(omega h / 2) too low, alike at both ends.
            let lost = (first[1] / last[1]).ln() / time - zeta * omega;
            let pitch =
                std::f64::consts::TAU * between as f64 / time / (omega * (1.0 - zeta * zeta).sqrt()) - 1.0;
            println!(
                "E {young:.0e}, mode {mode}, {:.3} Hz: {:.2} % of the amplitude lost in a second beyond \
                 the damping, {:.3} % off its pitch",
                omega / std::f64::consts::TAU,
                100.0 * lost,
                100.0 * pitch
            );
            assert!(lost.abs() < 0.05, "E {young}, mode {mode}: {lost}");
            assert!(pitch.abs() < 0.01, "E {young}, mode {mode}: {pitch}");
        }
    }
}

/// The smallest and the largest eigenvalue of a tangent, in units of the squared frequencies at
/// rest.
fn extremes(tangent: &DMatrix<f64>, omega: &[f64]) -> [f64; 2] {
    let n = omega.len();
    let even = |i: usize, j: usize| 0.5 * (tangent[(i, j)] + tangent[(j, i)]) / (omega[i] * omega[j]);
    let values = DMatrix::from_fn(n, n, even).symmetric_eigen().eigenvalues;
    [values.min(), values.max()]
}

/// A bar that is pressed until it buckles has a tangent that is not positive. The step replaces it
/// by one that is, tells of it, and stays calm.
#[test]
fn a_tangent_that_loses_definiteness_is_projected_and_counted() {
    let model = bar(&config(30));
    let elastic = model.parts().reduced.as_ref().unwrap();
    let info = model.info();
    let mu = info.young / (2.0 * (1.0 + info.poisson));
    let lambda = 2.0 * mu * info.poisson / (1.0 - 2.0 * info.poisson);
    let law = elastic.material.with(lambda, mu);
    let mut energy = ElasticEnergy::new(elastic, law, model.omega()).unwrap();
    let n = model.mode_count();
    let mut tangents = |q: &[f64]| {
        energy.linearize(q);
        let (mut projected, mut row) = (DMatrix::zeros(n, n), vec![0.0; n]);
        for i in 0..n {
            energy.tangent_row(i, &mut row[i..]);
            for j in i..n {
                projected[(i, j)] = row[j];
                projected[(j, i)] = row[j];
            }
        }
        let raised = energy.raised();
        let force = |k: usize, by: f64| {
            let mut q = q.to_vec();
            q[k] += by / model.omega()[k];
            let mut out = vec![0.0; n];
            energy.force_at(&q, &mut out);
            out
        };
        let small = 1e-5;
        let columns: Vec<Vec<f64>> = (0..n)
            .map(|k| {
                let (ahead, back) = (force(k, small), force(k, -small));
                let slope = |(a, b): (&f64, &f64)| (a - b) / (2.0 * small) * model.omega()[k];
                ahead.iter().zip(&back).map(slope).collect()
            })
            .collect();
        let exact = DMatrix::from_fn(n, n, |i, j| columns[j][i]);
        (extremes(&projected, model.omega()), extremes(&exact, model.omega()), raised)
    };
    let (projected, exact, raised) = tangents(&vec![0.0; n]);
    assert_eq!(raised, 0, "at rest");
    assert!((projected[0] / exact[0] - 1.0).abs() < 1e-3, "{projected:?} and {exact:?}");

    let patch = {
        let positions = model.surface().positions();
        let away = |v: &u32| {
            let [x, y, z] = positions[*v as usize].map(f64::from);
            norm([x - 1.0, y - 0.15, z - 0.15])
        };
        let end = (0..positions.len() as u32).min_by(|a, b| away(a).total_cmp(&away(b))).unwrap();
        Patch::around(model.surface(), end, 0.2).unwrap()
    };
    for step in [1.0 / 60.0, 1.0 / 240.0] {
        let mut body = reduced(&model, step);
        let grab = body.grab(&patch, GrabConfig::default()).unwrap();
        assert_eq!(body.step().unwrap().projected, 0, "at rest");
        let start = body.target(grab).unwrap();
        let second = (1.0 / step) as usize;
        let (mut counts, mut forces, mut straight) = (Vec::new(), Vec::new(), Vec::new());
        for i in 1..=12 * second {
            let share = (i as f64 / (4 * second) as f64).min(1.0);
            body.set_target(grab, [start[0] - 0.5 * share, start[1], start[2]]).unwrap();
            counts.push(body.step().unwrap().projected);
            forces.push(body.reaction(grab).unwrap());
            if i == second {
                straight = body.q().to_vec();
            }
        }
        let (projected, exact, raised) = tangents(&straight);
        println!(
            "at {step:.4} s, pressed by an eighth: eigenvalues of the tangent from {:.4}, projected from {:.4}, {raised} points",
            exact[0], projected[0]
        );
        assert!(exact[0] < 0.0, "the bar does not buckle: {exact:?}");
        assert!(projected[0] > -1e-6 * projected[1] && raised > 0, "{projected:?}");
        let most = counts.iter().max().unwrap();
        println!("  at most {most} of {} points are projected in a step", elastic.weights.len());
        assert!(*most >= raised && *most <= elastic.weights.len(), "{most}");
        let last = &forces[10 * second..];
        let size = last.iter().map(|&f| norm(f)).fold(0.0, f64::max);
        let bend = |w: &[[f64; 3]]| norm(std::array::from_fn(|k| w[0][k] - 2.0 * w[1][k] + w[2][k]));
        let ringing = last.windows(3).map(bend).fold(0.0, f64::max) / size;
        body.release(grab);
        let held = body.energy();
        let most = (0..4 * second).fold(0.0f64, |most, _| {
            body.step().unwrap();
            most.max(body.energy())
        });
        println!("  {size:.1} N, ringing {ringing:.1e}, energy after the release {:.4}", most / held);
        assert!(ringing < 0.01, "{ringing}");
        assert!(most <= held * (1.0 + 1e-9), "{most} of {held}");
    }
}
