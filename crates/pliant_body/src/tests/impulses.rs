//! Tests of impulses and forces sent as messages.

use bevy::{
    math::{DQuat, DVec3},
    prelude::*,
};

use super::{STEP, app, model, refusals, spawn, state, steps};
use crate::{Driven, Impulse, Push};

const VERTEX: u32 = 31;

/// Returns the linear and angular momentum (about the world's origin) of a free body and the
/// position of its vertex, all in the entity's world.
fn motion(app: &App, body: Entity) -> (DVec3, DVec3, DVec3) {
    let state = state(app, body);
    let (linear, angular) = state.body().momentum();
    let frame = state.body().frame();
    let rest = DVec3::from(state.model().surface().positions()[VERTEX as usize].map(f64::from));
    let at = DVec3::from(frame.origin()) + DQuat::from_array(frame.orientation()) * rest;
    let scale = state.scale();
    (DVec3::from(linear) * scale, DVec3::from(angular) * scale * scale, at * scale)
}

/// Sends messages to a free body with an arbitrary transform after its first step, and checks the
/// impulse that the body receives.
fn changes_by(scale: f32, impulse: DVec3, send: impl FnOnce(&mut World, Entity)) {
    let mut app = app();
    let place = Transform::from_xyz(0.4, -1.3, 2.0)
        .with_rotation(Quat::from_euler(EulerRot::XYZ, 0.3, 1.1, -0.7))
        .with_scale(Vec3::splat(scale));
    let body = spawn(&mut app, model::free_bar(), place);
    steps(&mut app, 1);
    let (linear, angular, at) = motion(&app, body);
    assert_eq!((linear, state(&app, body).scale()), (DVec3::ZERO, f64::from(scale)));
    send(app.world_mut(), body);
    steps(&mut app, 1);
    for _ in 0..2 {
        let (after, turning, _) = motion(&app, body);
        assert!((after - linear - impulse).length() < 1e-9, "{after}");
        assert!((turning - angular - at.cross(impulse)).length() < 1e-9, "{turning}");
        // The impulse acts once and has no later effect.
        steps(&mut app, 20);
    }
    assert!(state(&app, body).body().v().iter().any(|v| *v != 0.0), "it also bends");
    assert_eq!(refusals(&mut app), []);
}

const J: DVec3 = DVec3::new(0.7, -1.1, 0.4);

#[test]
fn an_impulse_changes_momentum_by_itself_and_spin_by_its_moment() {
    for scale in [1.0, 2.5] {
        changes_by(scale, J, |world, body| {
            world.write_message(Impulse { body, vertex: VERTEX, impulse: 3.0 * J });
            world.write_message(Impulse { body, vertex: VERTEX, impulse: -2.0 * J });
        });
    }
}

#[test]
fn a_push_brings_in_its_force_times_one_tick() {
    for scale in [1.0, 2.5] {
        changes_by(scale, J, |world, body| {
            world.write_message(Push { body, vertex: VERTEX, force: J / STEP });
        });
    }
}

#[test]
fn a_resting_body_is_woken_by_an_impulse_or_a_push_and_not_by_a_refused_one() {
    for pushed in [false, true] {
        let mut app = app();
        let body = spawn(&mut app, model::bar(), ());
        steps(&mut app, 30);
        assert!(state(&app, body).is_resting());
        app.world_mut().write_message(Push { body, vertex: model::tip(), force: DVec3::NAN });
        steps(&mut app, 1);
        assert!(state(&app, body).is_resting());
        assert_eq!(refusals(&mut app).len(), 1);

        let up = DVec3::new(0.0, 1.0, 0.0);
        if pushed {
            app.world_mut().write_message(Push { body, vertex: model::tip(), force: up / STEP });
        } else {
            app.world_mut().write_message(Impulse { body, vertex: model::tip(), impulse: up });
        }
        steps(&mut app, 1);
        assert!(!state(&app, body).is_resting());
        assert!(state(&app, body).body().q()[0] > 0.0);
    }
}

#[test]
fn an_impulse_gives_a_mode_its_shape_times_the_impulse() {
    // For bending along y, phi(tip) = sqrt(5/m). An entity of scale 2 receives half of the impulse
    // in the body's own world.
    for scale in [1.0, 2.0] {
        let mut app = app();
        let body = spawn(&mut app, model::bar(), Transform::from_scale(Vec3::splat(scale)));
        steps(&mut app, 1);
        app.world_mut().write_message(Impulse { body, vertex: model::tip(), impulse: DVec3::Y });
        steps(&mut app, 1);
        // The solution of q'' + 2 zeta w q' + w^2 q = 0 from q' = J phi is exact over the step.
        let w = std::f64::consts::TAU * model::FREQUENCIES[0];
        let (decay, damped) = (0.2 * w, w * (1.0 - 0.04_f64).sqrt());
        let start = (5.0 / model::MASS).sqrt() / f64::from(scale);
        let expected = start * (-decay * STEP).exp() * (damped * STEP).sin() / damped;
        let q = state(&app, body).body().q()[0];
        assert!((q - expected).abs() < 1e-6 * expected, "{q}, expected {expected}");
    }
}

#[test]
fn what_cannot_be_struck_is_refused_by_name_and_changes_nothing() {
    let mut app = app();
    let body = spawn(&mut app, model::free_bar(), ());
    let remote = spawn(&mut app, model::free_bar(), Driven::Remote);
    let none = app.world_mut().spawn_empty().id();
    let gone = app.world_mut().spawn_empty().id();
    app.world_mut().despawn(gone);
    steps(&mut app, 1);
    let before = state(&app, body).body().state().clone();
    let wrong = [
        (body, VERTEX, DVec3::NAN, "finite"),
        (body, VERTEX, DVec3::new(0.0, f64::INFINITY, 0.0), "finite"),
        (body, VERTEX, DVec3::splat(f64::MAX), "impulse: expected one"),
        (body, 1_000_000, DVec3::Y, "vertex 1000000"),
        (none, VERTEX, DVec3::Y, "no body"),
        (gone, VERTEX, DVec3::Y, "no body"),
    ];
    for (entity, vertex, impulse, word) in wrong {
        app.world_mut().write_message(Impulse { body: entity, vertex, impulse });
        steps(&mut app, 2);
        let received = refusals(&mut app);
        assert!(
            received.len() == 1 && received[0].0 == entity && received[0].1.contains(word),
            "{word}: {received:?}"
        );
        if impulse.x < 1e300 {
            app.world_mut().write_message(Push { body: entity, vertex, force: impulse });
            steps(&mut app, 2);
            let received = refusals(&mut app);
            assert!(
                received.len() == 1 && received[0].0 == entity && received[0].1.contains(word),
                "{word}: {received:?}"
            );
        }
        assert_eq!(*state(&app, body).body().state(), before);
    }
    // An impulse on a remote body is left to who drives it, and nobody takes a force.
    app.world_mut().write_message(Impulse { body: remote, vertex: VERTEX, impulse: DVec3::Y });
    steps(&mut app, 2);
    assert_eq!(refusals(&mut app).len(), 0);
    app.world_mut().write_message(Push { body: remote, vertex: VERTEX, force: DVec3::Y });
    steps(&mut app, 2);
    let received = refusals(&mut app);
    assert!(
        received.len() == 1 && received[0].0 == remote && received[0].1.contains("remotely"),
        "{received:?}"
    );
    // The force overflows: the step is refused once, and the next step is valid again.
    app.world_mut().write_message(Push { body, vertex: VERTEX, force: DVec3::splat(f64::MAX) });
    steps(&mut app, 3);
    assert_eq!(refusals(&mut app).len(), 1);
    assert_eq!(state(&app, body).body().q(), before.q);
    app.world_mut().write_message(Impulse { body, vertex: VERTEX, impulse: DVec3::Y });
    steps(&mut app, 1);
    assert!(state(&app, body).body().frame().velocity()[1] > 0.0);
}
