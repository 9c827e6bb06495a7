//! Tests of the scene's gravity.

use bevy::{math::DVec3, prelude::*};

use super::{STEP, app, model, refusals, spawn_with, state, steps};
use crate::{BodyGravity, BodyGravityScale, Driven, ModalBody};

fn gravity(app: &App, body: Entity) -> [f64; 3] {
    state(app, body).body().config().settings.gravity
}

#[test]
fn the_scenes_gravity_is_to_the_bit_that_of_the_settings() {
    let half = |body: &mut ModalBody| body.settings.gravity = [0.0, -1.0, 0.25];
    let all = |body: &mut ModalBody| body.settings.gravity = [0.5, -2.0, 0.25];
    let none = |_: &mut ModalBody| ();
    for model in [model::bar, model::free_bar] {
        let of = |scene: Option<Vec3>, settings: fn(&mut ModalBody), place: Transform| {
            let mut app = app();
            if let Some(scene) = scene {
                app.insert_resource(BodyGravity(scene));
            }
            let body = spawn_with(&mut app, model(), settings, place);
            steps(&mut app, 50);
            (gravity(&app, body), state(&app, body).body().state().clone())
        };
        for place in [Transform::IDENTITY, Transform::from_scale(Vec3::splat(2.0))] {
            let expected = of(None, all, place);
            assert_eq!(of(Some(Vec3::new(0.5, -1.0, 0.0)), half, place), expected, "{place:?}");
            assert_eq!(of(Some(Vec3::new(0.5, -2.0, 0.25)), none, place), expected, "{place:?}");
        }
        // As without the resource, bodies float.
        let floats = of(None, none, Transform::IDENTITY);
        assert_eq!(floats.0, [0.0; 3]);
        assert!(floats.1.q.iter().all(|q| *q == 0.0));
        assert_eq!(floats.1.frame.velocity(), [0.0; 3]);
    }
}

#[test]
fn free_bodies_fall_by_their_scale() {
    let mut app = app();
    app.insert_resource(BodyGravity::EARTH);
    let bodies = [1.0, 0.0, -0.5]
        .map(|scale| spawn_with(&mut app, model::free_bar(), |_| (), BodyGravityScale(scale)));
    let start = bodies.map(|body| *state(&app, body).body().frame());
    steps(&mut app, 40);
    for ((body, start), scale) in bodies.iter().zip(start).zip([1.0, 0.0, -0.5]) {
        let frame = state(&app, *body).body().frame();
        let fallen = DVec3::from(frame.center()) - DVec3::from(start.center());
        let gained = DVec3::from(frame.velocity()) - DVec3::from(start.velocity());
        let g = f64::from(-9.81_f32) * scale;
        // The velocity at the start is that of the first step.
        let (time, before) = (40.0 * STEP, start.velocity()[1]);
        assert!((gained - DVec3::Y * g * time).length() < 1e-9, "{scale}: {gained}");
        let way = before * time + 0.5 * g * time * time;
        assert!((fallen - DVec3::Y * way).length() < 1e-6, "{scale}: {fallen}, expected {way}");
    }
}

#[test]
fn a_change_wakes_the_bodies_and_reaches_those_of_others() {
    let mut app = app();
    let mine = spawn_with(&mut app, model::bar(), |body| body.rest_speed = 1.0, ());
    let remote = spawn_with(&mut app, model::bar(), |_| (), Driven::Remote);
    steps(&mut app, 60);
    assert!(state(&app, mine).is_resting());
    app.insert_resource(BodyGravity(Vec3::Y * -4.0));
    steps(&mut app, 1);
    assert!(!state(&app, mine).is_resting());
    assert_eq!([mine, remote].map(|body| gravity(&app, body)), [[0.0, -4.0, 0.0]; 2]);
    assert!(state(&app, mine).body().q()[0] < 0.0, "it sinks");
    // Nothing asks again, so the body may rest.
    steps(&mut app, 200);
    assert!(state(&app, mine).is_resting());
    app.world_mut().get_mut::<BodyGravityScale>(mine).unwrap().0 = 0.5;
    steps(&mut app, 1);
    assert_eq!(gravity(&app, mine), [0.0, -2.0, 0.0]);
    // Settings that change, and the number of modes, keep it.
    app.world_mut().get_mut::<ModalBody>(mine).unwrap().settings.damping_scale = 2.0;
    steps(&mut app, 1);
    assert_eq!(gravity(&app, mine), [0.0, -2.0, 0.0]);
    app.world_mut().get_mut::<ModalBody>(mine).unwrap().modes = Some(1);
    steps(&mut app, 2);
    assert_eq!((gravity(&app, mine), state(&app, mine).body().mode_count()), ([0.0, -2.0, 0.0], 1));
    assert_eq!(refusals(&mut app), []);
}

#[test]
fn a_gravity_that_is_no_number_is_refused_once() {
    let mut app = app();
    app.insert_resource(BodyGravity(Vec3::Y * -1.0));
    let body = spawn_with(&mut app, model::bar(), |_| (), ());
    steps(&mut app, 2);
    for (scene, scale) in [(Vec3::NAN, 1.0), (Vec3::Y, f32::INFINITY), (Vec3::Y * 1e30, 1.0)] {
        app.insert_resource(BodyGravity(scene));
        app.world_mut().get_mut::<BodyGravityScale>(body).unwrap().0 = scale;
        steps(&mut app, 3);
        let received = refusals(&mut app);
        assert!(received.len() == 1 && received[0].1.contains("gravity"), "{received:?}");
        assert_eq!(gravity(&app, body), [0.0, -1.0, 0.0]);
    }
    // The size changes the gravity that the body has accepted.
    app.world_mut().entity_mut(body).insert(Transform::from_scale(Vec3::splat(2.0)));
    steps(&mut app, 2);
    assert_eq!((gravity(&app, body), refusals(&mut app)), ([0.0, -0.5, 0.0], vec![]));
}
