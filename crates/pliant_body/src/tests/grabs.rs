use bevy::{math::DVec3, prelude::*};

use super::{app, model, refusals, spawn, spawn_with, state, steps};
use crate::{
    BodyReady, BodyState, Driven, Grab, GrabForce, GrabOf, Grabbed, Grabs, ModalAsset, ModalBody, Released,
};

fn linear(body: &mut ModalBody) {
    body.settings.warp = false;
}

fn grab(app: &mut App, body: Entity, target: DVec3) -> Entity {
    app.world_mut().spawn((Grab::new(model::tip(), 0.0, target), GrabOf(body))).id()
}

fn force(app: &App, grab: Entity) -> GrabForce {
    *app.world().get::<GrabForce>(grab).unwrap()
}

/// Returns the stiffness at the tip, N/m, with a hand of compliance `c`: the modes are springs in
/// series.
fn tip_stiffness(axis: usize, c: f64) -> f64 {
    let (mode, phi) =
        [(3, (3.0 / model::MASS).sqrt()), (0, (5.0 / model::MASS).sqrt()), (1, (5.0 / model::MASS).sqrt())]
            [axis];
    let omega = std::f64::consts::TAU * model::FREQUENCIES[mode];
    1.0 / ((phi / omega).powi(2) + c)
}

#[test]
fn a_held_tip_pushes_back_with_its_static_stiffness() {
    let mut app = app();
    let body = spawn_with(&mut app, model::bar(), linear, ());
    let hand = grab(&mut app, body, DVec3::new(1.0, 0.05, 0.0));
    steps(&mut app, 800);
    let held = state(&app, body).body().grabs().next().unwrap();
    assert_eq!(state(&app, body).grab_id(hand), Some(held));
    assert_eq!(state(&app, body).grab_id(body), None, "an entity that is no grab of it");
    let c = state(&app, body).body().compliance(held).unwrap()[1][1];
    let expected = -0.05 * tip_stiffness(1, c);
    let felt = force(&app, hand);
    assert!(
        (felt.force.y - expected).abs() < 1e-6 * expected.abs(),
        "{} N, expected {expected} N",
        felt.force.y
    );
    assert!(felt.force.x.abs() < 1e-9 && felt.force.z.abs() < 1e-9);
    // The patch is where the target and the force leave it.
    assert!((felt.point - DVec3::new(1.0, 0.05 + c * felt.force.y, 0.0)).length() < 1e-7, "{}", felt.point);
}

#[test]
fn turning_moving_and_scaling_the_entity_turns_moves_and_scales_what_is_felt() {
    let felt = |transform: Transform| {
        let mut app = app();
        let body = spawn_with(&mut app, model::bar(), linear, transform);
        let target = transform.transform_point(Vec3::new(1.0, 0.05, 0.0)).as_dvec3();
        let hand = grab(&mut app, body, target);
        steps(&mut app, 400);
        force(&app, hand)
    };
    let plain = felt(Transform::IDENTITY);
    let placed = Transform::from_xyz(3.0, -1.0, 2.0)
        .with_rotation(Quat::from_rotation_z(0.7))
        .with_scale(Vec3::splat(2.0));
    let moved = felt(placed);
    // Transforms are in single precision. Twice the size at the same stiffness gives twice the
    // displacement and twice the force.
    let expected = placed.rotation.as_dquat() * plain.force * 2.0;
    assert!(
        (moved.force - expected).length() < 1e-4 * expected.length(),
        "{} against {expected}",
        moved.force
    );
    let point = placed.transform_point(plain.point.as_vec3()).as_dvec3();
    assert!((moved.point - point).length() < 1e-5);
}

#[test]
fn a_grab_moves_nothing_until_its_target_does() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    grab(&mut app, body, DVec3::new(1.0, 0.0, 0.0));
    steps(&mut app, 20);
    assert!(state(&app, body).body().q().iter().all(|q| q.abs() < 1e-9));
}

#[test]
fn a_target_that_is_not_finite_is_refused_and_the_last_good_one_stays() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    let good = DVec3::new(1.0, 0.05, 0.0);
    let hand = grab(&mut app, body, good);
    app.world_mut().entity_mut(hand).insert(Name::new("left hand"));
    steps(&mut app, 100);
    let before = force(&app, hand);
    for (bad, word) in [(f64::NAN, "NaN"), (f64::INFINITY, "inf")] {
        app.world_mut().get_mut::<Grab>(hand).unwrap().target.z = bad;
        steps(&mut app, 30);
        let refused = refusals(&mut app);
        assert_eq!(refused.len(), 1, "once: {refused:?}");
        assert!(refused[0].0 == hand && refused[0].1.contains(word), "{refused:?}");
        let held = state(&app, body).body().grabs().next().unwrap();
        assert_eq!(state(&app, body).body().target(held).unwrap(), <[f64; 3]>::from(good));
        assert!((force(&app, hand).force - before.force).length() < 0.02 * before.force.length());
        app.world_mut().get_mut::<Grab>(hand).unwrap().target = good;
        steps(&mut app, 1);
    }
}

#[test]
fn a_grab_of_nothing_is_refused_and_the_body_goes_on() {
    let mut app = app();
    let body = spawn_with(&mut app, model::bar(), |body| body.settings.gravity = [0.0, -1.0, 0.0], ());
    for (vertex, radius) in [(1_000_000, 0.01), (0, f64::NAN), (0, -1.0)] {
        let hand = app.world_mut().spawn((Grab::new(vertex, radius, DVec3::ZERO), GrabOf(body))).id();
        let before = state(&app, body).body().q()[0];
        steps(&mut app, 3);
        let refused = refusals(&mut app);
        assert!(refused.len() == 1 && refused[0].0 == hand, "{refused:?}");
        assert_ne!(state(&app, body).body().q()[0], before);
        assert_eq!(force(&app, hand), GrabForce::default());
    }
}

#[test]
fn a_grab_that_found_the_body_full_is_held_once_a_place_is_free() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    let most = pliant_modal::Body::MAX_GRABS;
    let hands: Vec<Entity> = (0..=most).map(|_| grab(&mut app, body, DVec3::new(1.0, 0.0, 0.0))).collect();
    steps(&mut app, 5);
    let refused = refusals(&mut app);
    assert!(refused.len() == 1 && refused[0].0 == hands[most], "told once, of the one too many: {refused:?}");
    assert_eq!(state(&app, body).body().grabs().count(), most);
    app.world_mut().despawn(hands[3]);
    steps(&mut app, 1);
    assert_eq!(state(&app, body).body().grabs().count(), most);
    assert!(state(&app, body).held.iter().all(|held| held.id.is_some()));
    assert!(refusals(&mut app).is_empty());
}

#[test]
fn a_grab_that_was_refused_does_not_keep_the_body_awake() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    let nowhere = app.world_mut().spawn((Grab::new(1_000_000, 0.01, DVec3::ZERO), GrabOf(body))).id();
    steps(&mut app, 30);
    assert!(state(&app, body).is_resting(), "0.5 s are 20 steps");
    app.world_mut().despawn(nowhere);
    steps(&mut app, 1);
    assert!(state(&app, body).is_resting(), "it held nothing, so nothing was let go");
    grab(&mut app, body, DVec3::new(1.0, 0.05, 0.0));
    steps(&mut app, 30);
    assert!(!state(&app, body).is_resting());
}

#[test]
fn despawning_a_grab_or_unrelating_it_lets_go() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    let (a, b) =
        (grab(&mut app, body, DVec3::new(1.0, 0.1, 0.0)), grab(&mut app, body, DVec3::new(1.0, 0.0, 0.1)));
    steps(&mut app, 5);
    assert_eq!(state(&app, body).body().grabs().count(), 2);
    assert_eq!(app.world().get::<Grabs>(body).unwrap().entities(), [a, b]);
    app.world_mut().despawn(a);
    steps(&mut app, 1);
    assert_eq!(state(&app, body).body().grabs().count(), 1);
    app.world_mut().entity_mut(b).remove::<GrabOf>();
    steps(&mut app, 400);
    assert_eq!(state(&app, body).body().grabs().count(), 0);
    assert!(state(&app, body).is_resting(), "let go, it swings back and rests");
}

#[test]
fn despawning_a_body_despawns_the_hands_on_it() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    let hand = grab(&mut app, body, DVec3::new(1.0, 0.1, 0.0));
    steps(&mut app, 5);
    app.world_mut().despawn(body);
    steps(&mut app, 3);
    assert!(app.world().get_entity(hand).is_err());
}

#[test]
fn a_body_swapped_while_held_is_held_on_in_its_new_shape() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    let hand = grab(&mut app, body, DVec3::new(1.0, 0.1, 0.0));
    steps(&mut app, 50);
    let other = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model::free_bar()));
    app.world_mut().get_mut::<ModalBody>(body).unwrap().model = other;
    steps(&mut app, 3);
    assert!(state(&app, body).model().is_free());
    assert_eq!(state(&app, body).body().grabs().count(), 1);
    assert!(force(&app, hand).force.length() > 0.0);

    // Removing the component of a grabbed body leaves nothing that could be stepped.
    app.world_mut().entity_mut(body).remove::<ModalBody>();
    steps(&mut app, 3);
    assert!(app.world().get::<BodyState>(body).is_none());
}

#[test]
fn changing_the_number_of_modes_keeps_the_motion_of_those_that_stay() {
    let mut app = app();
    let body = spawn_with(&mut app, model::bar(), |body| body.settings.gravity = [1.0, -9.0, 0.0], ());
    steps(&mut app, 400);
    let before = state(&app, body).body().q().to_vec();
    app.world_mut().get_mut::<ModalBody>(body).unwrap().modes = Some(2);
    steps(&mut app, 1);
    let after = state(&app, body).body().q();
    assert_eq!(after.len(), 2);
    assert!((after[0] - before[0]).abs() < 1e-4 * before[0].abs(), "{after:?} against {before:?}");
}

#[test]
fn a_remote_body_leaves_its_grabs_to_its_driver() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    let hand = grab(&mut app, body, DVec3::new(1.0, 0.1, 0.0));
    steps(&mut app, 5);
    app.world_mut().entity_mut(body).insert(Driven::Remote);
    steps(&mut app, 1);
    assert_eq!(state(&app, body).body().grabs().count(), 0);
    let given = GrabForce { force: DVec3::X, point: DVec3::Y };
    app.world_mut().entity_mut(hand).insert(given);
    steps(&mut app, 5);
    assert_eq!(force(&app, hand), given);
}

#[test]
fn a_hand_that_lost_its_body_feels_nothing() {
    type Lose = fn(&mut World, Entity, Entity);
    let ways: [(&str, Lose); 6] = [
        ("let go", |world, _, hand| {
            world.entity_mut(hand).remove::<GrabOf>();
        }),
        ("no grab any more", |world, _, hand| {
            world.entity_mut(hand).remove::<Grab>();
        }),
        ("no body any more", |world, body, _| {
            world.entity_mut(body).remove::<ModalBody>();
        }),
        ("not simulated any more", |world, body, _| {
            world.entity_mut(body).remove::<BodyState>();
            world.entity_mut(body).get_mut::<ModalBody>().unwrap().model = Handle::default();
        }),
        ("onto what is no body", |world, _, hand| {
            let other = world.spawn_empty().id();
            world.entity_mut(hand).insert(GrabOf(other));
        }),
        ("driven by somebody else", |world, body, _| {
            world.entity_mut(body).insert(Driven::Remote);
        }),
    ];
    for (way, lose) in ways {
        let mut app = app();
        let body = spawn(&mut app, model::bar(), ());
        let hand = grab(&mut app, body, DVec3::new(1.0, 0.05, 0.0));
        steps(&mut app, 20);
        assert!(force(&app, hand).force.length() > 1.0);
        lose(app.world_mut(), body, hand);
        steps(&mut app, 1);
        assert_eq!(force(&app, hand), GrabForce::default(), "{way}");
    }
    // On a remote body, the source that drives the body writes the forces of the hands.
    for lose in [ways[0].1, ways[2].1] {
        let mut app = app();
        let body = spawn(&mut app, model::bar(), Driven::Remote);
        let hand = grab(&mut app, body, DVec3::new(1.0, 0.05, 0.0));
        steps(&mut app, 2);
        let felt = GrabForce { force: DVec3::X, point: DVec3::Y };
        *app.world_mut().get_mut::<GrabForce>(hand).unwrap() = felt;
        steps(&mut app, 2);
        assert_eq!(force(&app, hand), felt);
        lose(app.world_mut(), body, hand);
        assert_eq!(force(&app, hand), GrabForce::default());
    }
}

#[derive(Resource, Default, Debug, PartialEq)]
struct Seen(Vec<(&'static str, Entity, Option<Entity>)>);

#[test]
fn observers_are_told_of_bodies_and_of_hands_that_take_hold_and_let_go() {
    let mut app = app();
    app.init_resource::<Seen>()
        .add_observer(|on: On<BodyReady>, mut seen: ResMut<Seen>| seen.0.push(("ready", on.entity, None)))
        .add_observer(|on: On<Grabbed>, mut seen: ResMut<Seen>| {
            seen.0.push(("grabbed", on.entity, Some(on.grab)));
        })
        .add_observer(|on: On<Released>, mut seen: ResMut<Seen>| {
            seen.0.push(("released", on.entity, Some(on.grab)));
        });
    let seen = |app: &mut App| std::mem::take(&mut app.world_mut().resource_mut::<Seen>().0);
    let body = spawn(&mut app, model::bar(), ());
    assert_eq!(seen(&mut app), [("ready", body, None)]);
    let [first, second] = [0, 1].map(|_| grab(&mut app, body, DVec3::X));
    steps(&mut app, 3);
    let both = [("grabbed", body, Some(first)), ("grabbed", body, Some(second))];
    assert_eq!(seen(&mut app), both, "once each");
    // A hand whose settings change holds on, and one that is refused lets go.
    app.world_mut().get_mut::<Grab>(first).unwrap().stiffness = Some(50.0);
    steps(&mut app, 2);
    assert_eq!(seen(&mut app), []);
    app.world_mut().get_mut::<Grab>(first).unwrap().stiffness = Some(-1.0);
    steps(&mut app, 2);
    assert_eq!(seen(&mut app), [("released", body, Some(first))]);
    app.world_mut().entity_mut(second).remove::<GrabOf>();
    steps(&mut app, 2);
    assert_eq!(seen(&mut app), [("released", body, Some(second))]);
    app.world_mut().entity_mut(second).insert(GrabOf(body));
    steps(&mut app, 2);
    assert_eq!(seen(&mut app), [("grabbed", body, Some(second))]);
    app.world_mut().entity_mut(body).remove::<ModalBody>();
    app.update();
    assert_eq!(seen(&mut app), [("released", body, Some(second))]);
}
