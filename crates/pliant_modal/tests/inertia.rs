//! Bodies whose anchors move, against closed forms, and one under gravity after a failed step.

use crate::nonlinear_rod;
use crate::rod;

use std::{f64::consts::TAU, sync::Arc};

use nonlinear_rod::nonlinear_rod;
use pliant_modal::{Body, BodyConfig, Elasticity, FrameMotion, ModalModel, StepSettings};
use rod::{AREA, DENSITY, LENGTH, rod};

const YOUNG: f64 = 2e5;

fn pip() -> ModalModel {
    ModalModel::read(concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/pip.modal")).unwrap()
}

fn body(model: &Arc<ModalModel>, hz: f64, settings: StepSettings) -> Body {
    Body::new(model.clone(), BodyConfig { step: 1.0 / hz, ..settings.into() }).unwrap()
}

/// Displacement of the rod's tip, m.
fn tip(body: &Body) -> f64 {
    let row = |mode| f64::from(body.model().displacement_row(rod::tip(), 0, mode));
    body.q().iter().enumerate().map(|(mode, q)| q * row(mode)).sum()
}

#[test]
fn an_accelerated_body_bends_as_under_the_opposite_gravity() {
    let reduced = StepSettings { elasticity: Elasticity::Reduced, ..Default::default() };
    let cases =
        [(Arc::new(pip()), StepSettings::default()), (Arc::new(nonlinear_rod(YOUNG, 8, 0.05)), reduced)];
    for (model, settings) in cases {
        // The frame is turned: gravity is in world axes, the motion in those of the body.
        let turn = [0.0, 0.0, (0.25f64).sin(), (0.25f64).cos()];
        let acceleration = [6.0, -4.0, 3.0];
        let mut moved = body(&model, 64.0, settings);
        let world = {
            let (sin, cos) = (0.5f64).sin_cos();
            let [x, y, z] = acceleration;
            [-(cos * x - sin * y), -(sin * x + cos * y), -z]
        };
        let mut heavy = body(&model, 64.0, StepSettings { gravity: world, ..settings });
        for body in [&mut moved, &mut heavy] {
            body.set_pose([0.0; 3], turn).unwrap();
        }
        for _ in 0..200 {
            moved.set_frame_motion(FrameMotion { acceleration, ..Default::default() }).unwrap();
            moved.step().unwrap();
            heavy.step().unwrap();
            let largest = heavy.q().iter().fold(0.0f64, |most, q| most.max(q.abs()));
            for (moved, heavy) in moved.q().iter().zip(heavy.q()) {
                assert!((moved - heavy).abs() <= 1e-9 * largest, "{moved} {heavy}");
            }
        }
        assert!(moved.energy() > 1e-3, "{}", moved.energy());
        // It holds for one step.
        for _ in 0..4_000 {
            moved.step().unwrap();
        }
        assert!(moved.energy() < 1e-3 * heavy.energy(), "{} {}", moved.energy(), heavy.energy());
    }
}

#[test]
fn a_rod_that_spins_about_its_anchor_stretches_as_published() {
    // E A u'' = -rho A omega^2 x with u(0) = 0 and u'(L) = 0: rho omega^2 L^3 / (3 E) at the tip.
    let (model, spin) = (Arc::new(rod(YOUNG, 12, 0.4, false)), 2.0);
    let exact = DENSITY * spin * spin * LENGTH.powi(3) / (3.0 * YOUNG);
    for axis in [[0.0, spin, 0.0], [0.0, 0.0, -spin], [0.0, spin * 0.6, spin * 0.8]] {
        let mut body = body(&model, 240.0, StepSettings::default());
        for _ in 0..2_000 {
            let motion = FrameMotion { angular_velocity: axis, ..Default::default() };
            body.set_frame_motion(motion).unwrap();
            body.step().unwrap();
        }
        // Each mode holds the share 96 / pi^4 / (2 k - 1)^4 of it, so all but 2e-5 are in twelve.
        assert!((tip(&body) / exact - 1.0).abs() < 2e-3, "{} {exact}", tip(&body));
    }
    // A spin about the rod itself leaves it alone.
    let mut body = body(&model, 240.0, StepSettings::default());
    for _ in 0..500 {
        let motion = FrameMotion { angular_velocity: [spin, 0.0, 0.0], ..Default::default() };
        body.set_frame_motion(motion).unwrap();
        body.step().unwrap();
    }
    assert!(tip(&body).abs() < 1e-3 * exact, "{}", tip(&body));
}

#[test]
fn the_moments_of_a_rod_are_those_of_its_modes() {
    let model = rod(YOUNG, 12, 0.05, false);
    for mode in 0..12 {
        // The integral of rho A x sqrt(2 / m) sin(k x).
        let k = (2 * mode + 1) as f64 * TAU / 4.0 / LENGTH;
        let sign = if mode % 2 == 0 { 1.0 } else { -1.0 };
        let exact = sign * (2.0 / model.mass()).sqrt() * DENSITY * AREA / (k * k);
        let moment = model.moment(mode);
        let first = 16.0 / TAU / TAU * (2.0 * model.mass()).sqrt() * LENGTH;
        assert!((moment[0][0] - exact).abs() < 2e-3 * first, "{mode}: {} {exact}", moment[0][0]);
        let others = moment.as_flattened()[1..].iter();
        assert!(others.fold(0.0f64, |most, x| most.max(x.abs())) < 1e-3 * first, "{moment:?}");
    }
    assert_eq!(model.moment(12), [[0.0; 3]; 3]);
}

#[test]
fn a_shaken_base_moves_a_mode_by_its_transfer_function() {
    // q'' + c q' + w^2 q = -P a sin(W t): an amplitude of P a / sqrt((w^2 - W^2)^2 + (c W)^2).
    let model = Arc::new(rod(YOUNG, 1, 0.1, false));
    let (w, c, p) = (model.omega()[0], model.damping()[0], model.participation()[0][0]);
    let amplitude = 3.0;
    for share in [0.3, 1.0, 1.7] {
        let shaking = share * w;
        let error = |hz: f64| {
            let mut body = body(&model, hz, StepSettings::default());
            let exact = p * amplitude / ((w * w - shaking * shaking).powi(2) + (c * shaking).powi(2)).sqrt();
            let lag = (c * shaking).atan2(w * w - shaking * shaking);
            let mut worst = 0.0f64;
            let settled = (40.0 / c * hz) as usize;
            for step in 0..settled + (2.0 * TAU / shaking * hz) as usize {
                let middle = (step as f64 + 0.5) / hz;
                let acceleration = [amplitude * (shaking * middle).sin(), 0.0, 0.0];
                body.set_frame_motion(FrameMotion { acceleration, ..Default::default() }).unwrap();
                body.step().unwrap();
                if step > settled {
                    let end = (step + 1) as f64 / hz;
                    worst = worst.max((body.q()[0] + exact * (shaking * end - lag).sin()).abs());
                }
            }
            worst / exact
        };
        let (coarse, fine) = (error(100.0), error(200.0));
        assert!(fine < 0.01, "{share}: {fine}");
        assert!((3.5..4.5).contains(&(coarse / fine)), "{share}: of second order: {coarse} {fine}");
    }
}

#[test]
fn no_jitter_of_the_anchors_tears_a_body_apart() {
    let reduced = StepSettings { elasticity: Elasticity::Reduced, ..Default::default() };
    let cases =
        [(Arc::new(pip()), StepSettings::default()), (Arc::new(nonlinear_rod(YOUNG, 8, 0.05)), reduced)];
    for (model, settings) in cases {
        let mut body = body(&model, 64.0, settings);
        let (mut seed, mut worst) = (1u64, 0.0f64);
        let mut random = move || {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (seed >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        };
        let mut positions = model.surface().positions().to_vec();
        for _ in 0..64 * 60 {
            // The velocity changes by up to 200 m/s and 200 rad/s in a tick.
            let mut up_to = |most: f64| std::array::from_fn(|_| most * random());
            body.set_frame_motion(FrameMotion {
                acceleration: up_to(200.0 * 64.0),
                angular_velocity: up_to(100.0),
                angular_acceleration: up_to(200.0 * 64.0),
            })
            .unwrap();
            body.step().unwrap();
            body.reconstruct(&mut positions).unwrap();
            for (at, rest) in positions.iter().zip(model.surface().positions()) {
                let way: f64 = (0..3).map(|k| f64::from(at[k] - rest[k]).powi(2)).sum();
                worst = worst.max(way.sqrt());
            }
        }
        assert!(worst < 4.0 * model.size(), "{} of {}", worst, model.size());
    }
}

#[test]
fn a_free_body_ignores_the_motion_and_a_wild_number_is_refused() {
    let mut body = body(&Arc::new(rod(YOUNG, 4, 0.05, true)), 64.0, StepSettings::default());
    let motion = FrameMotion { acceleration: [1.0, 2.0, 3.0], ..Default::default() };
    body.set_frame_motion(motion).unwrap();
    body.step().unwrap();
    assert_eq!((body.energy(), body.frame().velocity()), (0.0, [0.0; 3]));
    for bad in [f64::NAN, f64::INFINITY] {
        let motion = FrameMotion { angular_velocity: [0.0, bad, 0.0], ..Default::default() };
        assert!(body.set_frame_motion(motion).is_err());
    }
}

/// A step that fails leaves nothing in the scratch of gravity on the bent shape.
#[test]
fn a_body_under_gravity_recovers_from_a_step_that_fails() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/bud.modal");
    let model = Arc::new(ModalModel::read(path).unwrap());
    let settings = StepSettings { gravity: [0.0, -9.81, 0.0], ..Default::default() };
    let mut body = Body::new(model, settings.into()).unwrap();
    for _ in 0..10 {
        body.step().unwrap();
    }
    let before = body.state().clone();
    for huge in [1e90, 1e150, 1e300, f64::MAX] {
        let mut state = before.clone();
        (state.q[0], state.v[1], state.a[2]) = (huge, -huge, huge);
        body.set_state(&state).unwrap();
        let refused = (0..100).filter(|_| body.step().is_err()).count();
        assert!(refused <= 1, "{huge}: {refused} steps were refused");
        body.set_state(&before).unwrap();
        for _ in 0..100 {
            body.step().unwrap();
        }
    }
}
