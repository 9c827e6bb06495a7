//! The stiffness scale of a body, compared with a rod of the scaled Young's modulus and with closed
//! forms.

use crate::rod;

use std::sync::Arc;

use pliant_modal::{
    Body, BodyConfig, GrabConfig, Integrator, ModalModel, ModelError, Patch, Relaxation, StepError,
    StepSettings, SurfaceMesh,
};
use rod::{AREA, DENSITY, LENGTH, rod, tip};

const YOUNG: f64 = 1e5;
const H: f64 = 1e-3;

fn config(integrator: Integrator, stiffness_scale: f64) -> BodyConfig {
    BodyConfig {
        step: H,
        settings: StepSettings { integrator, stiffness_scale, ..Default::default() },
        ..BodyConfig::default()
    }
}

/// Drags a body with a moving hand and returns tip position, reaction and energy for each step.
fn dragged(mut body: Body) -> Vec<f64> {
    let patch = Patch::around(body.model().surface(), tip(), 0.01).unwrap();
    let hand = body.grab(&patch, GrabConfig { stiffness: Some(500.0), relaxation: 0.01 }).unwrap();
    let start = body.grab_position(hand).unwrap();
    let mut seen = Vec::new();
    for tick in 0..400 {
        let t = f64::from(tick) * H;
        body.set_target(hand, [start[0] + 0.02 * (31.0 * t).sin(), start[1], start[2]]).unwrap();
        body.push(tip(), [0.4, 0.0, 0.0]).unwrap();
        body.step().unwrap();
        seen.extend([body.grab_position(hand).unwrap()[0], body.reaction(hand).unwrap()[0], body.energy()]);
    }
    seen
}

#[test]
fn a_scaled_body_is_the_body_of_as_stiff_a_material() {
    let relaxing = Some(Relaxation { ratio: 0.4, time: 0.05 });
    for integrator in [Integrator::Exact, Integrator::Newmark, Integrator::GeneralizedAlpha { rho_inf: 0.5 }]
    {
        for (scale, relaxation) in [(3.0, None), (0.2, None), (3.0, relaxing), (1.0, None)] {
            let with = BodyConfig {
                settings: StepSettings { relaxation, ..config(integrator, scale).settings },
                ..config(integrator, scale)
            };
            let scaled = Body::new(Arc::new(rod(YOUNG, 6, 0.05, false)), with.clone()).unwrap();
            let plain =
                BodyConfig { settings: StepSettings { stiffness_scale: 1.0, ..with.settings }, ..with };
            let baked = Body::new(Arc::new(rod(YOUNG * scale, 6, 0.05, false)), plain).unwrap();
            for (a, b) in scaled.omega().iter().zip(baked.omega()) {
                assert!((a / b - 1.0).abs() < 1e-14);
            }
            for (a, b) in scaled.damping().iter().zip(baked.damping()) {
                assert!((a / b - 1.0).abs() < 1e-13);
            }
            let (scaled, baked) = (dragged(scaled), dragged(baked));
            let size = baked.iter().fold(0.0_f64, |m, x| m.max(x.abs()));
            let off = scaled.iter().zip(&baked).fold(0.0_f64, |m, (a, b)| m.max((a - b).abs()));
            assert!(off < 1e-9 * size, "{integrator:?}, {scale} times: {off} of {size}");
        }
    }
}

#[test]
fn twice_as_stiff_it_sinks_half_as_far_and_swings_root_two_faster() {
    let model = Arc::new(rod(YOUNG, 1, 0.0, false));
    let quarter_wave = std::f64::consts::FRAC_PI_2 / LENGTH;
    let phi = (2.0 / (DENSITY * AREA * LENGTH)).sqrt();
    for stiffness in [1.0, 2.0, 0.5] {
        let omega = quarter_wave * (YOUNG * stiffness / DENSITY).sqrt();
        // The scale also has to work if it changes on an existing body.
        let mut body = Body::new(model.clone(), config(Integrator::Exact, 1.0)).unwrap();
        body.reconfigure(BodyConfig {
            settings: StepSettings { damping_scale: 0.0, ..config(Integrator::Exact, stiffness).settings },
            ..config(Integrator::Exact, stiffness)
        })
        .unwrap();
        // Under a load that starts at once, the rod swings about its static position
        // `phi^2 F / omega^2`, from zero to twice that position.
        let (mut crossings, mut before, mut mean, mut most) = (Vec::new(), 0.0, 0.0, 0.0_f64);
        let hangs = phi * phi * 2.0 / (omega * omega);
        let steps = 8_000;
        for tick in 1..=steps {
            body.push(tip(), [2.0, 0.0, 0.0]).unwrap();
            body.step().unwrap();
            let at = phi * body.q()[0];
            (mean, most) = (mean + at / f64::from(steps), most.max(at));
            let off = at - hangs;
            if tick > 1 && before < 0.0 && off >= 0.0 {
                crossings.push(f64::from(tick) * H - H * off / (off - before));
            }
            before = off;
        }
        let periods = (crossings.len() - 1) as f64;
        let period = (crossings[crossings.len() - 1] - crossings[0]) / periods;
        let expected = std::f64::consts::TAU / omega;
        assert!((period / expected - 1.0).abs() < 1e-6, "{stiffness}: {period} s for {expected} s");
        assert!((most / (2.0 * hangs) - 1.0).abs() < 1e-3, "{stiffness}: {most} m for {} m", 2.0 * hangs);
        assert!((mean / hangs - 1.0).abs() < 0.02, "{stiffness}: {mean} m for {hangs} m");
    }
}

#[test]
fn a_change_on_the_way_keeps_the_motion_and_the_balance_of_forces() {
    let relaxing = Some(Relaxation { ratio: 0.3, time: 0.1 });
    let alpha = Integrator::GeneralizedAlpha { rho_inf: 0.5 };
    let plain = config(alpha, 1.0);
    let cases = [
        (
            None,
            BodyConfig { settings: StepSettings { stiffness_scale: 7.0, ..plain.settings }, ..plain.clone() },
        ),
        (
            relaxing,
            BodyConfig {
                settings: StepSettings { stiffness_scale: 7.0, relaxation: relaxing, ..plain.settings },
                ..plain.clone()
            },
        ),
        (
            None,
            BodyConfig { settings: StepSettings { damping_scale: 5.0, ..plain.settings }, ..plain.clone() },
        ),
        (
            relaxing,
            BodyConfig {
                settings: StepSettings { damping_scale: 0.0, relaxation: relaxing, ..plain.settings },
                ..plain.clone()
            },
        ),
        (relaxing, plain.clone()),
        (
            None,
            BodyConfig { settings: StepSettings { relaxation: relaxing, ..plain.settings }, ..plain.clone() },
        ),
        (
            relaxing,
            BodyConfig {
                settings: StepSettings {
                    relaxation: Some(Relaxation { ratio: 0.8, time: 0.3 }),
                    ..plain.settings
                },
                ..plain.clone()
            },
        ),
    ];
    for (relaxation, after) in cases {
        let before = BodyConfig { settings: StepSettings { relaxation, ..plain.settings }, ..plain.clone() };
        let mut body = Body::new(Arc::new(rod(YOUNG, 4, 0.03, false)), before.clone()).unwrap();
        body.apply_impulse(tip(), [0.5, 0.0, 0.0]).unwrap();
        for _ in 0..37 {
            body.step().unwrap();
        }
        let (q, v) = (body.q().to_vec(), body.v().to_vec());
        // Without external forces `a + c v + omega^2 (q - ratio z)` is the residual, which is as
        // small as the error of the integrator.
        let left_over = |body: &Body| -> Vec<f64> {
            let ratio = body.config().settings.relaxation.map_or(0.0, |r| r.ratio);
            (0..4)
                .map(|i| {
                    let stretch = body.q()[i] - ratio * body.z().get(i).copied().unwrap_or(0.0);
                    body.a()[i] + body.damping()[i] * body.v()[i] + body.omega()[i].powi(2) * stretch
                })
                .collect()
        };
        let unbalanced = left_over(&body);
        let resisted = body.a().to_vec();
        body.reconfigure(BodyConfig { step: 0.5 * H, ..before }).unwrap();
        assert_eq!(body.a(), resisted, "another step is no other force");
        body.reconfigure(after).unwrap();
        assert_eq!((body.q(), body.v()), (&q[..], &v[..]));
        // The viscoelastic state starts at zero when relaxation is switched on.
        let begins = relaxation.is_none() && body.config().settings.relaxation.is_some();
        assert_eq!(body.a() == resisted, begins);
        for (then, now) in unbalanced.iter().zip(left_over(&body)) {
            let size = body.omega()[3].powi(2) * q.iter().fold(0.0_f64, |m, q| m.max(q.abs()));
            assert!((then - now).abs() < 1e-12 * size, "{then} became {now} of {size}");
        }
    }
}

#[test]
fn a_patch_of_another_surface_has_no_flexibility_here() {
    let model = rod(YOUNG, 3, 0.1, false);
    let three = three_of_it(&model);
    let patch = Patch::around(&three, 200, 0.0).unwrap();
    let error = model.residual_flexibility(&patch, 3).unwrap_err();
    assert!(matches!(error, ModelError::Vertex { what: "patch", vertex: 200, count: 84, .. }), "{error}");
    let mut body = Body::new(Arc::new(model), config(Integrator::Exact, 1.0)).unwrap();
    assert_eq!(body.grab(&patch, GrabConfig::default()), Err(StepError::Vertex { vertex: 200, count: 84 }));
}

/// Makes a surface with more vertices than that of `model`: three copies of it side by side.
fn three_of_it(model: &ModalModel) -> SurfaceMesh {
    let (mut positions, mut triangles) = (Vec::new(), Vec::new());
    for copy in 0..3 {
        let first = positions.len() as u32;
        positions.extend(model.surface().positions().iter().map(|p| [p[0], p[1] + copy as f32, p[2]]));
        triangles.extend(model.surface().triangles().iter().map(|t| t.map(|v| v + first)));
    }
    SurfaceMesh::new(positions, triangles, None, Vec::new()).unwrap()
}

#[test]
fn what_is_no_stiffness_is_refused_and_changes_nothing() {
    let mut body = Body::new(Arc::new(rod(YOUNG, 2, 0.1, false)), config(Integrator::Exact, 2.0)).unwrap();
    for bad in [f64::NAN, f64::INFINITY, 0.0, -1.0, 1e-7, 1e7] {
        let error = body.reconfigure(config(Integrator::Exact, bad)).unwrap_err();
        assert!(matches!(error, StepError::Input { what: "stiffness_scale", .. }), "{error}");
        assert_eq!(body.config().settings.stiffness_scale, 2.0);
    }
}
