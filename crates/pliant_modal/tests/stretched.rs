//! A free body between two hands that pull apart. The tension keeps the body in line between the
//! hands, and the body comes to rest.

use std::sync::Arc;

use pliant_modal::{Body, BodyConfig, GrabConfig, Integrator, ModalModel, Patch, StepSettings};

/// The free jack of the example `free_bodies`: 0.41 m, 0.66 kg, three different moments of inertia
/// and knobs on thin arms.
fn jack() -> Arc<ModalModel> {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/jack.modal");
    Arc::new(ModalModel::read(path).unwrap())
}

/// Pulls both ends apart by `part` of the size over two seconds, with a sideways tremble, and holds
/// until 10 s.
///
/// Returns values for the last three seconds: the largest deviation of the tension from its mean as
/// a share of the mean, the mean (N), and the largest difference between the hands (N).
fn tension(
    model: &Arc<ModalModel>,
    integrator: Integrator,
    step: f64,
    corrections: u8,
    part: f64,
) -> (f64, f64, f64) {
    let config = BodyConfig {
        step,
        settings: StepSettings { integrator, corrections, ..Default::default() },
        ..Default::default()
    };
    let mut body = Body::new(model.clone(), config).unwrap();
    let positions = model.surface().positions();
    let hands = [1.0f64, -1.0].map(|side| {
        let vertex = (0..positions.len())
            .max_by(|&a, &b| {
                let along = |i: usize| side * f64::from(positions[i][0]);
                along(a).total_cmp(&along(b))
            })
            .unwrap();
        let patch = Patch::around(model.surface(), vertex as u32, 0.03).unwrap();
        let grab = body.grab(&patch, GrabConfig::default()).unwrap();
        (grab, body.target(grab).unwrap(), side)
    });
    let (mut along, mut apart) = (Vec::new(), 0.0f64);
    for k in 0..(10.0 / step) as usize {
        let t = k as f64 * step;
        let way = (t / 2.0).min(1.0);
        let way = way * way * (3.0 - 2.0 * way);
        for (grab, at, side) in &hands {
            let tremble = if t < 6.0 { 0.003 * (7.0 * t).sin() } else { 0.0 };
            let [x, y, z] = *at;
            let target = [x + 0.5 * part * model.size() * way * side, y + tremble * side, z];
            body.set_target(*grab, target).unwrap();
        }
        body.step().unwrap();
        if t > 7.0 {
            let [a, b] = hands.map(|(grab, _, _)| body.reaction(grab).unwrap());
            along.push(-a[0]);
            apart = (0..3).map(|i| (a[i] + b[i]).abs()).fold(apart, f64::max);
        }
    }
    let mean = along.iter().sum::<f64>() / along.len() as f64;
    let off = along.iter().map(|f| (f - mean).abs()).fold(0.0, f64::max);
    (off / mean.abs(), mean, apart)
}

#[test]
fn a_free_body_stretched_between_two_hands_comes_to_rest() {
    let model = jack();
    let alpha = Integrator::GeneralizedAlpha { rho_inf: 0.5 };
    let exact = Integrator::Exact;
    let (coarse, fine) = (1.0 / 64.0, 1.0 / 250.0);
    // If the frame lagged by one step, the exact step would be unstable at 33 % with two and with
    // eight rounds.
    for (integrator, step, corrections, part) in [
        (exact, coarse, 2, 0.20),
        (exact, coarse, 2, 0.27),
        (exact, coarse, 2, 0.33),
        (exact, coarse, 2, 0.40),
        (exact, coarse, 1, 0.70),
        (exact, coarse, 8, 0.40),
        (exact, fine, 2, 0.40),
        (alpha, coarse, 2, 0.27),
        (alpha, coarse, 2, 0.50),
        (alpha, coarse, 8, 0.50),
    ] {
        let (off, force, apart) = tension(&model, integrator, step, corrections, part);
        println!(
            "{integrator:?} {step}, {corrections} rounds: {part} apart, {force:.2} N, wobble {off:.2e}, hands differ by {apart:.2e} N"
        );
        // Reference from a fine step.
        let (_, fine, _) = tension(&model, alpha, 1.0 / 500.0, 2, part);
        assert!((force / fine - 1.0).abs() < 1e-3, "{force} N, {fine} N in fine steps");
        assert!(off < 1e-3, "{integrator:?} {step}, {corrections}: {part} apart: {off}");
        assert!(
            apart < 1e-2 * force,
            "{integrator:?} {step}, {corrections}: {part} apart: {apart} N of {force}"
        );
    }
}
