//! Tests a slender bar that is fixed at one end and hangs under its own weight.

use std::sync::Arc;

use pliant_bake::{BakeConfig, bake};
use pliant_mesh::shapes;
use pliant_modal::{Body, BodyConfig, Damping, HeldPatch, ModalModel, Patch, StepSettings};

const YOUNG: f64 = 2.9e6;
const DENSITY: f64 = 1000.0;
const SIDE: f64 = 0.05;

/// Makes a bar of 1 x 0.05 x 0.05 m with 40 x 2 x 2 cells and 20 modes, fixed at x = 0.
fn bar() -> Arc<ModalModel> {
    let mesh = shapes::bar([40, 2, 2], [1.0, SIDE, SIDE]).unwrap();
    let config = BakeConfig {
        modes: 20,
        young: YOUNG,
        density: DENSITY,
        damping: Damping::Ratio(0.5),
        anchors: vec!["x<0.001".parse().unwrap()],
        ..BakeConfig::linear()
    };
    Arc::new(bake(&mesh, None, &config, &mut |_, _| {}).unwrap().model)
}

/// Returns the rest position of the end's center under `times` the gravity of the earth, m.
fn end_of(model: &Arc<ModalModel>, times: f64) -> [f64; 3] {
    let gravity = [0.0, -9.81 * times, 0.0];
    let mut body =
        Body::new(model.clone(), BodyConfig::from(StepSettings { gravity, ..Default::default() })).unwrap();
    for _ in 0..60 * 30 {
        body.step().unwrap();
    }
    let positions = model.surface().positions();
    let off = |p: &[f32; 3]| {
        (p[0] - 1.0).powi(2) + (p[1] - 0.5 * SIDE as f32).powi(2) + (p[2] - 0.5 * SIDE as f32).powi(2)
    };
    let end = (0..positions.len()).min_by(|&a, &b| off(&positions[a]).total_cmp(&off(&positions[b])));
    let patch = Patch::around(model.surface(), end.unwrap() as u32, 0.0).unwrap();
    let patch = HeldPatch::new(model, &patch, model.mode_count()).unwrap();
    (patch.rest() + patch.displacement(body.q(), true)).into()
}

/// Returns the end position of the heavy elastica, m.
///
/// The equation `E I t'' = -w (L - s) cos t` with `t(0) = 0`, `t'(L) = 0` is solved by the
/// Runge-Kutta method and bisection of the curvature at the wall.
fn elastica(times: f64) -> [f64; 2] {
    let stiffness = YOUNG * SIDE.powi(4) / 12.0;
    let weight = DENSITY * SIDE * SIDE * 9.81 * times;
    const PARTS: usize = 2000;
    let h = 1.0 / PARTS as f64;
    let shoot = |curvature: f64| {
        let slope = |s: f64, t: f64, k: f64| [k, weight * (1.0 - s) * t.cos() / stiffness, t.cos(), t.sin()];
        let mut y = [0.0, curvature, 0.0, 0.0];
        for i in 0..PARTS {
            let s = i as f64 * h;
            let k1 = slope(s, y[0], y[1]);
            let k2 = slope(s + 0.5 * h, y[0] + 0.5 * h * k1[0], y[1] + 0.5 * h * k1[1]);
            let k3 = slope(s + 0.5 * h, y[0] + 0.5 * h * k2[0], y[1] + 0.5 * h * k2[1]);
            let k4 = slope(s + h, y[0] + h * k3[0], y[1] + h * k3[1]);
            for j in 0..4 {
                y[j] += h / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j]);
            }
        }
        y
    };
    // Down is negative, so the curvature at the wall is negative and grows in magnitude with the
    // weight.
    let (mut low, mut high) = (-weight / stiffness, 0.0);
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if shoot(middle)[1] > 0.0 { high = middle } else { low = middle }
    }
    let end = shoot(0.5 * (low + high));
    [end[2], end[3]]
}

#[test]
fn a_bar_hangs_lower_the_heavier_it_is_and_never_behind_its_wall() {
    let model = bar();
    let mut last = 0.0;
    for times in [0.05, 0.2, 0.5, 1.0, 2.0] {
        let ([x, y, _], [true_x, true_y]) = (end_of(&model, times), elastica(times));
        let fallen = 0.5 * SIDE - y;
        println!(
            "{times} g: the end is at {x:.3} m and {fallen:.3} m lower; the elastica's at {true_x:.3} and {:.3}",
            -true_y
        );
        assert!(x > 0.0, "{times} g: behind the wall at {x} m");
        assert!(fallen > last, "{times} g: {fallen} m, less than {last} m under less");
        last = fallen;
        // The modes of a bar that bends far are off by up to 9 %.
        let most = if times <= 0.05 { 0.05 } else { 0.1 };
        assert!((fallen / -true_y - 1.0).abs() < most, "{times} g: {fallen} m instead of {} m", -true_y);
    }
}

/// An impulse and a push do their work along the way of the bent shape's own point: the energy that
/// an impulse gives a body at rest is half the product of the impulse and the velocity that the
/// point gets.
#[test]
fn an_impulse_on_a_bent_bar_works_along_the_bent_shape() {
    let model = bar();
    let positions = model.surface().positions();
    let end = (0..positions.len()).max_by(|&a, &b| positions[a][0].total_cmp(&positions[b][0])).unwrap();
    let mut body = Body::new(model.clone(), BodyConfig::from(StepSettings::default())).unwrap();
    // Bent by about a right angle.
    let mut state = body.state().clone();
    let row = f64::from(model.rotation_row(end as u32, 2, 0)).abs();
    let axis = if row > 1e-3 { 2 } else { 1 };
    state.q[0] = 1.5 / f64::from(model.rotation_row(end as u32, axis, 0));
    body.set_state(&state).unwrap();
    let at = |q: &[f64]| {
        let patch = Patch::around(model.surface(), end as u32, 0.0).unwrap();
        let patch = HeldPatch::new(&model, &patch, model.mode_count()).unwrap();
        patch.displacement(q, true)
    };
    let directions = [[1e-3, 0.0, 0.0], [0.0, 1e-3, 0.0], [0.0, 0.0, 1e-3], [6e-4, -7e-4, 2e-4]];
    for impulse in directions {
        let mut hit = body.clone();
        hit.apply_impulse(end as u32, impulse).unwrap();
        let kinetic: f64 = hit.v().iter().map(|v| 0.5 * v * v).sum();
        let t = 1e-6;
        let along =
            |sign: f64| -> Vec<f64> { state.q.iter().zip(hit.v()).map(|(q, v)| q + sign * t * v).collect() };
        let speed = (at(&along(1.0)) - at(&along(-1.0))) / (2.0 * t);
        let work: f64 = 0.5 * speed.iter().zip(impulse).map(|(u, j)| u * j).sum::<f64>();
        assert!((kinetic / work - 1.0).abs() < 1e-4, "{kinetic} J, and {work} J of work for {impulse:?}");
        // At rest the same impulse would give another energy: the bar is really bent.
        let mut straight = Body::new(model.clone(), BodyConfig::from(StepSettings::default())).unwrap();
        straight.apply_impulse(end as u32, impulse).unwrap();
        let other: f64 = straight.v().iter().map(|v| 0.5 * v * v).sum();
        assert!((other / kinetic - 1.0).abs() > 1e-3 || kinetic < 1e-12, "{other} {kinetic}");
        // A push in one short step gives the same momentum as the impulse.
        let mut pushed = body.clone();
        let step = 1e-7;
        pushed.reconfigure(BodyConfig { step, ..BodyConfig::from(StepSettings::default()) }).unwrap();
        let (mut free, rest) = (pushed.clone(), hit.v().to_vec());
        pushed.push(end as u32, impulse.map(|j| j / step)).unwrap();
        pushed.step().unwrap();
        free.step().unwrap();
        let gained = pushed.v().iter().zip(free.v()).map(|(a, b)| a - b);
        let off = gained.zip(&rest).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        assert!(off < 1e-3 * (2.0 * kinetic).sqrt(), "a push gains otherwise: {off}");
    }
}
