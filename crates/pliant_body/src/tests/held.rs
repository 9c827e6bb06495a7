//! Held patches get their own shapes beside the frames.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use bevy::{math::DVec3, prelude::*};
use pliant_bake::{BakeConfig, Material, bake};
use pliant_mesh::shapes;
use pliant_modal::{Elasticity, HeldPlace, ModalModel};

use super::{app, refusals, spawn_with, state, steps};
use crate::{Grab, GrabForce, GrabOf, HeldShapesCache, ModalBody, VisualState};

/// Time after which shapes are not made any more. How long they take is told by a bench: on a busy
/// machine two minutes were not enough for twenty sets.
const HANGS: Duration = Duration::from_secs(900);

/// A bar of 1 m by 0.1 m by 0.1 m along x, clamped at x = 0.
fn bar() -> ModalModel {
    let config = BakeConfig {
        modes: 20,
        material: Some(Material::NeoHookean),
        anchors: vec!["x<1e-9".parse().unwrap()],
        ..Default::default()
    };
    bake(&shapes::bar([10, 2, 2], [1.0, 0.1, 0.1]).unwrap(), None, &config, &mut |_, _| ()).unwrap().model
}

fn reduced(body: &mut ModalBody) {
    body.settings.damping_scale = 30.0;
}

fn hold(app: &mut App, body: Entity, target: DVec3) -> Entity {
    let positions = state(app, body).model().surface().positions();
    let corner = positions.iter().position(|p| *p == [1.0, 0.1, 0.1]).unwrap() as u32;
    app.world_mut().spawn((Grab::new(corner, 0.06, target), GrabOf(body))).id()
}

fn has_shapes(app: &App, body: Entity) -> bool {
    state(app, body).body().held_shapes().is_some()
}

fn wait_for_shapes(app: &mut App, body: Entity) {
    let begun = Instant::now();
    while !has_shapes(app, body) {
        assert!(begun.elapsed() < HANGS, "no shapes are made");
        std::thread::sleep(Duration::from_millis(2));
        app.update();
    }
}

#[test]
fn a_held_patch_gets_its_own_shapes_and_they_are_felt_and_seen() {
    let mut app = app();
    let model = bar();
    let body = spawn_with(&mut app, model.clone(), reduced, ());
    let plain = spawn_with(
        &mut app,
        model,
        |body| {
            reduced(body);
            body.held_shapes = false;
        },
        (),
    );
    let target = DVec3::new(1.0, 0.16, 0.16);
    let hands = [body, plain].map(|body| hold(&mut app, body, target));
    steps(&mut app, 1);
    // The hand need not wait for them.
    assert!(app.world().get::<GrabForce>(hands[0]).unwrap().force.length() > 0.0);
    wait_for_shapes(&mut app, body);
    let begun = Instant::now();
    for _ in 0..20 {
        steps(&mut app, 20);
        while app.world().resource::<HeldShapesCache>().is_making() {
            assert!(begun.elapsed() < HANGS);
            std::thread::sleep(Duration::from_millis(2));
            steps(&mut app, 1);
        }
    }
    assert!(!has_shapes(&app, plain) && refusals(&mut app).is_empty());
    let [with, without] = hands.map(|hand| app.world().get::<GrabForce>(hand).unwrap().force);
    let change = (with - without).length() / without.length();
    assert!((0.003..0.2).contains(&change), "{with} N with and {without} N without shapes");
    // They have followed the hand, to about where it is.
    let place = state(&app, body).body().held_places().next().unwrap();
    let made = state(&app, body).body().held_shapes().unwrap().places().next().unwrap();
    let away = DVec3::from(place.displacement).distance(made.displacement.into());
    assert!(away < 0.02 + 0.1 * DVec3::from(made.displacement).length(), "{made:?} for {place:?}");
    // The surface that is shown is the body's own.
    let visual = app.world().get::<VisualState>(body).unwrap();
    let (shapes, s) = visual.held().unwrap();
    assert!(shapes.places().len() == 1 && s.iter().any(|s| *s != 0.0));
    let positions = state(&app, body).positions(visual);
    let mut solver = state(&app, body).body().clone();
    let mut want = positions.clone();
    solver.reconstruct(&mut want).unwrap();
    let off = |a: &[f32; 3], b: &[f32; 3]| Vec3::from(*a).distance(Vec3::from(*b));
    let most = positions.iter().zip(&want).map(|(a, b)| off(a, b)).fold(0.0, f32::max);
    assert!(most < 1e-6, "the shown surface is {most} m off");
    // Without the columns it would not be.
    let bare = state(&app, body).positions_at(visual.q());
    let dent = bare.iter().zip(&want).map(|(a, b)| off(a, b)).fold(0.0, f32::max);
    assert!(dent > 1e-4, "the columns move the surface by {dent} m");
    // They go with the hand, and the next hand on the patch need not wait.
    app.world_mut().despawn(hands[0]);
    steps(&mut app, 3);
    assert!(!has_shapes(&app, body) && app.world().get::<VisualState>(body).unwrap().held().is_none());
    assert!(!app.world().resource::<HeldShapesCache>().is_making());
    hold(&mut app, body, target);
    steps(&mut app, 1);
    assert!(has_shapes(&app, body));
}

#[test]
fn a_hand_that_does_not_stand_still_gets_new_shapes_on_its_way() {
    let mut app = app();
    let body = spawn_with(&mut app, bar(), reduced, ());
    let rest = DVec3::new(1.0, 0.1, 0.1);
    let hand = hold(&mut app, body, rest);
    wait_for_shapes(&mut app, body);
    let (begun, mut turn, mut farthest) = (Instant::now(), 0.0f64, 0.0f64);
    while farthest < 0.05 {
        assert!(begun.elapsed() < HANGS, "the shapes stay those at rest");
        turn += 0.01;
        let to = rest + DVec3::new(0.0, 0.15 * turn.sin(), 0.1 * (0.7 * turn).sin());
        app.world_mut().get_mut::<Grab>(hand).unwrap().target = to;
        steps(&mut app, 1);
        std::thread::sleep(Duration::from_millis(2));
        let shapes = state(&app, body).body().held_shapes().unwrap();
        farthest =
            shapes.places().map(|place| DVec3::from(place.displacement).length()).fold(farthest, f64::max);
    }
}

#[test]
fn a_body_of_fewer_coordinates_or_of_linear_elasticity_gets_no_shapes() {
    let mut app = app();
    let few = spawn_with(
        &mut app,
        bar(),
        |body| {
            reduced(body);
            body.modes = Some(8);
        },
        (),
    );
    let linear = spawn_with(&mut app, bar(), |body| body.settings.elasticity = Elasticity::Linear, ());
    let target = DVec3::new(1.0, 0.16, 0.16);
    for body in [few, linear] {
        hold(&mut app, body, target);
    }
    steps(&mut app, 20);
    assert!(!app.world().resource::<HeldShapesCache>().is_making());
    assert!(![few, linear].into_iter().any(|body| has_shapes(&app, body)));
    // A body that becomes linear loses them.
    let body = spawn_with(&mut app, bar(), reduced, ());
    let hand = hold(&mut app, body, target);
    wait_for_shapes(&mut app, body);
    app.world_mut().get_mut::<ModalBody>(body).unwrap().settings.elasticity = Elasticity::Linear;
    steps(&mut app, 3);
    assert!(!has_shapes(&app, body));
    let force = app.world().get::<GrabForce>(hand).unwrap().force;
    assert!(force.is_finite() && force.length() > 0.0);
}

#[test]
fn the_cache_is_bounded_and_knows_what_has_no_shapes() {
    let _app = app();
    let mut cache = HeldShapesCache::default();
    let at = |vertex| HeldPlace { vertex, radius: 0.1, displacement: [0.0; 3] };
    let linear = Arc::new(super::model::bar());
    assert!(matches!(cache.get(&linear, &[at(0)]), Some(None)), "a linear model");
    let model = Arc::new(bar());
    assert!(matches!(cache.get(&model, &[]), Some(None)), "no patch");
    assert!(matches!(cache.get(&model, &[at(0); 5]), Some(None)), "too many patches");
    assert!(cache.get(&model, &[at(1_000_000)]).is_none());
    let begun = Instant::now();
    while cache.is_making() {
        assert!(begun.elapsed() < Duration::from_secs(60));
        std::thread::sleep(Duration::from_millis(1));
        // A patch that the model does not have is refused once.
        cache.get(&model, &[at(1_000_000)]);
    }
    assert!(matches!(cache.get(&model, &[at(1_000_000)]), Some(None)));
}
