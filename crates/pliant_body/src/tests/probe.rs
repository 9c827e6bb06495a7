//! Tests of probes that press bodies.

use bevy::{math::DVec3, prelude::*};

use super::{STEP, app, model, refusals, spawn, state, steps};
use crate::{ProbeShape, ProbeState, TouchProbe};

/// A probe above the middle of a free bar at some scale, and the two entities.
fn above(scale: f32) -> (App, Entity, Entity, DVec3) {
    let mut app = app();
    let body = spawn(&mut app, model::free_bar(), Transform::from_scale(Vec3::splat(scale)));
    let [low, high] =
        state(&app, body).model().surface().bounds().map(|at| Vec3::from(at).as_dvec3() * f64::from(scale));
    let radius = 0.2 * (high.y - low.y);
    let start = DVec3::new(0.5 * (low.x + high.x), high.y + 2.0 * radius, 0.5 * (low.z + high.z));
    let probe = app.world_mut().spawn(TouchProbe { radius, target: start, ..default() }).id();
    steps(&mut app, 2);
    (app, body, probe, start)
}

fn lead(app: &mut App, probe: Entity, target: DVec3) {
    app.world_mut().get_mut::<TouchProbe>(probe).unwrap().target = target;
    steps(app, 1);
}

fn force(app: &App, probe: Entity) -> DVec3 {
    app.world().get::<ProbeState>(probe).unwrap().force()
}

#[test]
fn a_body_takes_the_momentum_of_a_probe_at_every_scale() {
    for scale in [1.0, 2.5] {
        let (mut app, body, probe, start) = above(scale);
        assert_eq!(force(&app, probe), DVec3::ZERO);
        let mut given = DVec3::ZERO;
        for step in 1..=40 {
            let way = app.world().get::<TouchProbe>(probe).unwrap().radius * 0.1 * f64::from(step).min(20.0);
            lead(&mut app, probe, start - way * DVec3::Y);
            given -= STEP * force(&app, probe);
        }
        let state = state(&app, body);
        let got = DVec3::from(state.body().momentum().0) * state.scale();
        assert!(given.y < 0.0, "it was pushed down: {given}");
        assert!((got - given).length() < 1e-9 * given.length(), "{scale}: {got} {given}");
        assert_eq!(refusals(&mut app), []);
    }
}

#[test]
fn a_shaped_probe_turns_as_its_spring_lets_it_at_every_scale() {
    for scale in [1.0, 2.5] {
        let (mut app, _, probe, start) = above(scale);
        // A ball on an arm beside the tool point.
        let TouchProbe { radius, stiffness, .. } = *app.world().get::<TouchProbe>(probe).unwrap();
        let arm = 2.0 * radius;
        app.world_mut().entity_mut(probe).insert(ProbeShape { corners: vec![DVec3::X * arm] });
        for step in 1..=30 {
            lead(
                &mut app,
                probe,
                start - DVec3::X * arm - DVec3::Y * radius * (1.0 + 0.01 * f64::from(step)),
            );
        }
        let state = app.world().get::<ProbeState>(probe).unwrap();
        let (axis, angle) = state.rotation().unwrap().to_axis_angle();
        let want = stiffness * arm * arm * angle * axis;
        assert!(state.force().y > 0.0 && state.torque().z > 0.0, "{:?} {:?}", state.force(), state.torque());
        let off = (state.torque() - want).length() / want.length();
        assert!(off < 0.05, "{scale}: {} {want}", state.torque());
        // A shape without a point touches nothing, and that is told.
        app.world_mut().entity_mut(probe).insert(ProbeShape { corners: Vec::new() });
        steps(&mut app, 2);
        assert_eq!(force(&app, probe), DVec3::ZERO);
        let received = refusals(&mut app);
        assert!(matches!(&received[..], [(entity, _)] if *entity == probe), "told once: {received:?}");
    }
}

#[test]
fn a_probe_wakes_what_it_touches_and_bad_settings_touch_nothing() {
    let (mut app, body, probe, start) = above(1.0);
    steps(&mut app, 60);
    assert!(state(&app, body).is_resting(), "nothing touches it");
    let radius = app.world().get::<TouchProbe>(probe).unwrap().radius;
    let down = start - 1.5 * radius * DVec3::Y;
    lead(&mut app, probe, down);
    assert!(!state(&app, body).is_resting() && force(&app, probe).y > 0.0);
    app.world_mut().get_mut::<TouchProbe>(probe).unwrap().enabled = false;
    steps(&mut app, 1);
    assert_eq!(force(&app, probe), DVec3::ZERO, "it is switched off");
    app.world_mut().get_mut::<TouchProbe>(probe).unwrap().enabled = true;
    assert_eq!(refusals(&mut app), []);
    for bad in [0.0, f64::NAN] {
        app.world_mut().get_mut::<TouchProbe>(probe).unwrap().radius = bad;
        steps(&mut app, 3);
        assert_eq!(force(&app, probe), DVec3::ZERO);
    }
    let received = refusals(&mut app);
    assert!(matches!(&received[..], [(entity, _)] if *entity == probe), "told once: {received:?}");
}
