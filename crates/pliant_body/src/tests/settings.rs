//! Tests of settings that are changed, corrected and refused while bodies run.

use std::time::Duration;

use bevy::{prelude::*, time::TimeUpdateStrategy};

use super::{STEP, app, model, refusals, spawn_with, state, steps};
use pliant_modal::Relaxation;

use crate::{BodyState, ModalAsset, ModalBody};

fn settings(app: &mut App, body: Entity) -> Mut<'_, ModalBody> {
    app.world_mut().get_mut::<ModalBody>(body).unwrap()
}

/// Checks that a body with refused settings moves exactly like an equal body, also when the length
/// of the tick changes. Both bodies fall.
fn goes_on_with_the_settings_it_had(mut app: App, lengthen: impl Fn(&mut App, Duration)) {
    let falls = |body: &mut ModalBody| body.settings.gravity = [0.0, -1.0, 0.0];
    let good = spawn_with(&mut app, model::bar(), falls, ());
    let bad = spawn_with(&mut app, model::bar(), falls, ());
    lengthen(&mut app, Duration::from_millis(25));
    steps(&mut app, 5);
    let same = state(&app, good).body().state().clone();
    app.world_mut().get_mut::<BodyState>(bad).unwrap().body_mut().set_state(&same).unwrap();
    {
        let mut bad = settings(&mut app, bad);
        bad.settings.damping_scale = f64::NAN;
        // This change is refused together with the invalid one.
        bad.settings.gravity = [0.0; 3];
    }
    for millis in [25, 20, 10, 30, 10] {
        lengthen(&mut app, Duration::from_millis(millis));
        steps(&mut app, 2);
    }
    let received = refusals(&mut app);
    assert_eq!(received.len(), 1, "{received:?}");
    assert!(received[0].0 == bad && received[0].1.contains("damping_scale"), "{received:?}");
    let config = state(&app, bad).body().config();
    assert_eq!(
        (config.step, config.settings.damping_scale, config.settings.gravity),
        (0.010, 1.0, [0.0, -1.0, 0.0])
    );
    assert_ne!(state(&app, good).body().q(), same.q, "it moves");
    assert_eq!(state(&app, bad).body().state(), state(&app, good).body().state());

    // At twice the size and with the kept settings, gravity in the body's own world is halved.
    app.world_mut().entity_mut(bad).insert(Transform::from_scale(Vec3::splat(2.0)));
    steps(&mut app, 3);
    assert_eq!(refusals(&mut app), []);
    assert_eq!(state(&app, bad).body().config().settings.gravity, [0.0, -0.5, 0.0]);

    settings(&mut app, bad).settings.damping_scale = 3.0;
    steps(&mut app, 1);
    assert_eq!(refusals(&mut app), []);
    let config = state(&app, bad).body().config();
    assert_eq!((config.settings.damping_scale, config.settings.gravity), (3.0, [0.0; 3]));
}

#[test]
fn a_refused_change_and_frames_of_other_lengths_in_update() {
    let mut app = super::app_in(Update);
    app.update();
    goes_on_with_the_settings_it_had(app, |app, length| {
        app.insert_resource(TimeUpdateStrategy::ManualDuration(length));
    });
}

#[test]
fn a_refused_change_and_another_fixed_step() {
    goes_on_with_the_settings_it_had(app(), |app, length| {
        app.world_mut().resource_mut::<Time<Fixed>>().set_timestep(length);
    });
}

#[test]
fn a_material_set_on_the_component_relaxes_and_stays_through_other_steps() {
    let mut app = app();
    let material = Relaxation { ratio: 0.5, time: 0.2 };
    let body = spawn_with(
        &mut app,
        model::bar(),
        |body| {
            // The expected value belongs to the body without warping.
            body.settings.warp = false;
            body.settings.gravity = [0.0, -1.0, 0.0];
            body.settings.relaxation = Some(material);
            body.settings.corrections = 5;
        },
        (),
    );
    app.world_mut().resource_mut::<Time<Fixed>>().set_timestep_seconds(STEP / 2.0);
    steps(&mut app, 2_000);
    let config = state(&app, body).body().config();
    assert_eq!((config.step, config.settings.corrections), (STEP / 2.0, 5));
    assert_eq!(config.settings.relaxation, Some(pliant_modal::Relaxation { ratio: 0.5, time: 0.2 }));
    // Half of the stiffness is left, so the tip hangs twice as low as with an elastic material,
    // 5/3 g / omega^2.
    let expected = 2.0 * 5.0 / 3.0 / (std::f64::consts::TAU * model::FREQUENCIES[0]).powi(2);
    let tip = (5.0 / model::MASS).sqrt() * state(&app, body).body().q()[0];
    assert!((tip + expected).abs() < 1e-3 * expected, "sank {tip} m, expected -{expected} m");

    settings(&mut app, body).settings.relaxation = Some(Relaxation { ratio: 1.0, time: 0.2 });
    steps(&mut app, 3);
    let received = refusals(&mut app);
    assert!(received.len() == 1 && received[0].1.contains("relaxation ratio"), "{received:?}");
    settings(&mut app, body).settings.relaxation = None;
    steps(&mut app, 1);
    assert_eq!(state(&app, body).body().config().settings.relaxation, None);
}

#[test]
fn a_body_made_twice_as_stiff_while_it_hangs_hangs_half_as_low_and_swings_root_two_faster() {
    let mut app = app();
    let body = spawn_with(
        &mut app,
        model::bar(),
        |body| {
            // The expected value belongs to the body without warping.
            body.settings.warp = false;
            body.settings.gravity = [0.0, -1.0, 0.0];
            body.rest_speed = 0.0;
        },
        (),
    );
    let tip = |app: &App| (5.0 / model::MASS).sqrt() * state(app, body).body().q()[0];
    let hangs = |stiffness: f64| {
        // The tip hangs at 5/3 g / omega^2.
        -5.0 / 3.0 / (stiffness * (std::f64::consts::TAU * model::FREQUENCIES[0]).powi(2))
    };
    steps(&mut app, 2_000);
    assert!((tip(&app) / hangs(1.0) - 1.0).abs() < 1e-3, "{} m", tip(&app));
    // Without damping, the body swings about its new rest position, upward from its old rest
    // position.
    settings(&mut app, body).settings.stiffness_scale = 2.0;
    settings(&mut app, body).settings.damping_scale = 0.0;
    let (mut crossings, mut before, mut highest) = (Vec::new(), f64::NAN, f64::NEG_INFINITY);
    for step in 0..1_000 {
        steps(&mut app, 1);
        let off = tip(&app) - hangs(2.0);
        highest = highest.max(off);
        if before < 0.0 && off >= 0.0 {
            crossings.push(STEP * (f64::from(step) - off / (off - before)));
        }
        before = off;
    }
    let half = hangs(1.0) - hangs(2.0);
    assert!((highest / -half - 1.0).abs() < 0.02, "swings {highest} m up, not {}", -half);
    let period = (crossings[crossings.len() - 1] - crossings[0]) / (crossings.len() - 1) as f64;
    let expected = 1.0 / (model::FREQUENCIES[0] * 2f64.sqrt());
    assert!((period / expected - 1.0).abs() < 0.01, "{period} s, expected {expected} s");
    settings(&mut app, body).settings.damping_scale = 1.0;
    steps(&mut app, 2_000);
    assert!((tip(&app) / hangs(2.0) - 1.0).abs() < 1e-3, "{} m", tip(&app));
    settings(&mut app, body).settings.stiffness_scale = 0.0;
    steps(&mut app, 2);
    let received = refusals(&mut app);
    assert!(received.len() == 1 && received[0].1.contains("stiffness_scale"), "{received:?}");
    assert_eq!(state(&app, body).body().config().settings.stiffness_scale, 2.0);
}

#[test]
fn what_was_configured_on_the_body_itself_stays_when_the_step_and_the_scale_change() {
    let mut app = app();
    let body = spawn_with(&mut app, model::bar(), |_| (), ());
    let relaxation = Some(pliant_modal::Relaxation { ratio: 0.25, time: 2.0 });
    let mut running = app.world_mut().get_mut::<BodyState>(body).unwrap();
    let mut config = running.body().config().clone();
    (config.settings.relaxation, config.settings.corrections) = (relaxation, 7);
    running.body_mut().reconfigure(config).unwrap();
    app.world_mut().resource_mut::<Time<Fixed>>().set_timestep_seconds(STEP / 4.0);
    app.world_mut().entity_mut(body).insert(Transform::from_scale(Vec3::splat(0.5)));
    steps(&mut app, 3);
    let config = state(&app, body).body().config();
    assert_eq!(
        (config.step, config.settings.relaxation, config.settings.corrections),
        (STEP / 4.0, relaxation, 7)
    );
}

#[test]
fn a_model_that_was_refused_is_tried_again_when_its_asset_changes() {
    let mut app = app();
    // The frequency is too high for a viscoelastic material: omega h is above 1e12.
    let material = Some(Relaxation { ratio: 0.5, time: 1.0 });
    let body = spawn_with(&mut app, model::stiff_bar(1e13), |body| body.settings.relaxation = material, ());
    steps(&mut app, 3);
    assert!(app.world().get::<BodyState>(body).is_none());
    let received = refusals(&mut app);
    assert!(received.len() == 1 && received[0].1.contains("omega"), "{received:?}");

    let handle = settings(&mut app, body).bypass_change_detection().model.clone();
    let mut assets = app.world_mut().resource_mut::<Assets<ModalAsset>>();
    *assets.get_mut(&handle).unwrap() = ModalAsset::from(model::bar());
    steps(&mut app, 1);
    assert_eq!(state(&app, body).model().hash(), model::bar().hash());
    assert_eq!(refusals(&mut app), []);
}
