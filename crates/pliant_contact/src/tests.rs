//! A cube on obstacles in an app without a renderer, against what mechanics says.

#[cfg(feature = "avian")]
mod attachment;
#[cfg(feature = "avian")]
mod avian;
#[cfg(feature = "mesh")]
mod mesh;

use std::sync::{Arc, LazyLock};

use bevy::{math::DVec3, prelude::*, time::TimeUpdateStrategy, transform::TransformPlugin};
use pliant_body::{
    BodyRefused, BodyState, FixedObstacles, Grab, GrabOf, ModalAsset, ModalBody, PliantBodyPlugin,
    ProbeState, TouchProbe,
};
use pliant_modal::{FixedObstacle, FixedShape, ModalModel};

use crate::{
    BodyContacts, BodyFriction, ContactEnded, ContactLayers, ContactPlugin, ContactStarted, Obstacle,
    TouchBodies,
};

const STEP: f64 = 1.0 / 60.0;
const GRAVITY: f64 = 9.81;
/// Edge of the cube, m.
const EDGE: f64 = 0.2;

/// A free cube around the origin, of rubber of 1 MPa.
static CUBE: LazyLock<Arc<ModalModel>> = LazyLock::new(|| {
    let mut mesh = pliant_mesh::shapes::bar([3, 3, 3], [EDGE; 3]).unwrap();
    mesh.nodes.iter_mut().flatten().for_each(|x| *x -= 0.5 * EDGE);
    let damping = pliant_modal::Damping::Ratio(0.1);
    let config =
        pliant_bake::BakeConfig { modes: 12, young: 1e6, damping, ..pliant_bake::BakeConfig::linear() };
    Arc::new(pliant_bake::bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model)
});

#[derive(Resource, Default)]
struct Received {
    started: Vec<ContactStarted>,
    ended: Vec<ContactEnded>,
    refused: Vec<String>,
}

fn app() -> App {
    app_with(|_| ())
}

fn app_with(plugins: impl FnOnce(&mut App)) -> App {
    let mut app = App::new();
    app.add_plugins((MinimalPlugins, AssetPlugin::default(), TransformPlugin))
        .insert_resource(Time::<Fixed>::from_seconds(STEP))
        .insert_resource(TimeUpdateStrategy::FixedTimesteps(1))
        .add_plugins((PliantBodyPlugin::default(), ContactPlugin::default()))
        .init_resource::<Received>()
        .add_observer(|event: On<ContactStarted>, mut received: ResMut<Received>| {
            received.started.push(*event)
        })
        .add_observer(|event: On<ContactEnded>, mut received: ResMut<Received>| received.ended.push(*event))
        .add_observer(|refused: On<BodyRefused>, mut received: ResMut<Received>| {
            received.refused.push(refused.error.to_string());
        });
    plugins(&mut app);
    app.finish();
    app.cleanup();
    app.update();
    app
}

fn spawn(app: &mut App, at: impl Into<Transform>, bundle: impl Bundle) -> Entity {
    let model = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(CUBE.clone()));
    let mut body = ModalBody::new(model);
    body.settings.gravity = [0.0, -GRAVITY, 0.0];
    app.world_mut().spawn((body, at.into(), bundle)).id()
}

fn seconds(app: &mut App, seconds: f64) {
    for _ in 0..(seconds / STEP) as usize {
        app.update();
    }
}

fn state(app: &App, body: Entity) -> &BodyState {
    app.world().get(body).unwrap()
}

fn center(app: &App, body: Entity) -> DVec3 {
    state(app, body).scale() * DVec3::from(state(app, body).body().frame().center())
}

fn contacts(app: &App, body: Entity) -> &BodyContacts {
    app.world().get(body).unwrap()
}

fn weight() -> f64 {
    CUBE.mass() * GRAVITY
}

#[test]
fn a_body_falls_on_a_floor_and_rests_there() {
    let mut app = app();
    let floor = app.world_mut().spawn((Obstacle::Floor, Transform::from_xyz(0.0, 0.3, 0.0))).id();
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.5, 0.0), ());
    seconds(&mut app, 6.0);
    let force = contacts(&app, body).force();
    assert!((force - weight() * DVec3::Y).length() < 1e-3 * weight(), "{force} N for {} N", weight());
    let height = center(&app, body).y;
    assert!((height - 0.3 - 0.5 * EDGE).abs() < 0.02 * EDGE, "the center is at {height}");
    assert!(contacts(&app, body).0.iter().all(|c| c.other == floor && c.penetration < 2e-3 * EDGE));
    assert!(state(&app, body).is_resting());
    let received = app.world().resource::<Received>();
    let first = received.started[0];
    assert!((first.entity, first.other, first.normal) == (body, floor, DVec3::Y));
    // It fell by 0.1 m, and no more than doubles its momentum in the first step of the contact.
    let momentum = CUBE.mass() * (2.0 * GRAVITY * 0.1).sqrt();
    assert!(first.impulse.y > 0.0 && first.impulse.y < 2.1 * momentum, "{}", first.impulse);
    assert_eq!(received.started.len(), received.ended.len() + 1);
}

#[test]
fn a_resting_body_falls_when_its_floor_goes() {
    let mut app = app();
    let floor = app.world_mut().spawn(Obstacle::Floor).id();
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.101, 0.0), ());
    seconds(&mut app, 4.0);
    assert!(state(&app, body).is_resting());
    app.world_mut().despawn(floor);
    seconds(&mut app, 0.5);
    let fallen = center(&app, body).y;
    assert!((fallen - 0.1 + 0.5 * GRAVITY * 0.25).abs() < 0.1, "{fallen}");
    assert!(app.world().resource::<Received>().ended.iter().any(|ended| ended.other == floor));
    assert!(contacts(&app, body).0.is_empty());
}

#[test]
fn a_body_of_twice_the_scale_has_twice_the_forces() {
    let mut app = app();
    app.world_mut().spawn(Obstacle::Box { half: Vec3::new(2.0, 0.5, 2.0) });
    let at = Transform::from_xyz(0.0, 0.5 + 0.201, 0.0).with_scale(Vec3::splat(2.0));
    let body = spawn(&mut app, at, ());
    seconds(&mut app, 4.0);
    // The mass stays, and so does its weight in the world.
    let force = contacts(&app, body).force().y;
    assert!((force / weight() - 1.0).abs() < 1e-3, "{force} N for {} N", weight());
    assert!((center(&app, body).y - 0.5 - EDGE).abs() < 0.02 * EDGE);
}

#[test]
fn what_shares_no_layer_does_not_touch() {
    let mut app = app();
    let other = ContactLayers { memberships: 2, filters: 2 };
    app.world_mut().spawn((Obstacle::Floor, other));
    let through =
        spawn(&mut app, Transform::from_xyz(0.0, 0.3, 0.0), ContactLayers { memberships: 1, ..other });
    let on = spawn(&mut app, Transform::from_xyz(1.0, 0.3, 0.0), other);
    seconds(&mut app, 1.0);
    assert!(center(&app, through).y < -1.0 && center(&app, on).y > 0.09);
}

/// A slope of 30 degrees, whose tangent is 0.577.
#[test]
fn on_ice_a_body_slides_and_on_rubber_it_sticks() {
    for (own, floor, slides) in
        [(0.5, None, true), (0.8, None, false), (0.5, Some(1.2), false), (0.8, Some(0.1), true)]
    {
        let mut app = app();
        let turn = Quat::from_rotation_z(-std::f32::consts::FRAC_PI_6);
        let ground = app.world_mut().spawn((Obstacle::Floor, Transform::from_rotation(turn))).id();
        if let Some(floor) = floor {
            app.world_mut().entity_mut(ground).insert(BodyFriction(floor));
        }
        let at = Transform::from_translation(turn * Vec3::new(0.0, 0.1, 0.0)).with_rotation(turn);
        let body = spawn(&mut app, at, BodyFriction(own));
        seconds(&mut app, 1.0);
        let (before, speed) = (center(&app, body), state(&app, body).body().frame().velocity());
        seconds(&mut app, 1.0);
        let way = (center(&app, body) - before).length();
        let mu = floor.map_or(own, |floor: f64| (own * floor).sqrt());
        assert_eq!(way > 0.02, slides, "{own} {floor:?}: {way} m");
        if slides {
            let gained = DVec3::from(state(&app, body).body().frame().velocity()) - DVec3::from(speed);
            let want = GRAVITY * (0.5 - mu * 0.75f64.sqrt());
            assert!((gained.length() / want - 1.0).abs() < 0.02, "{own} {floor:?}: {gained} for {want}");
        }
    }
    let mut app = app();
    app.world_mut().spawn((Obstacle::Floor, BodyFriction(f64::NAN)));
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.2, 0.0), ());
    seconds(&mut app, 0.5);
    assert!(center(&app, body).y < 0.0, "what is refused is not touched");
    assert_eq!(app.world().resource::<Received>().refused.len(), 1);
}

#[test]
fn a_probe_touches_what_shares_its_layers() {
    let (all, apart) = (ContactLayers::default(), ContactLayers { memberships: 2, filters: 2 });
    for (layers, touches) in [(all, true), (apart, false)] {
        let mut app = app();
        let others = ContactLayers { memberships: 1, filters: 1 };
        app.world_mut().spawn((Obstacle::Floor, others));
        spawn(&mut app, Transform::from_xyz(1.0, 0.5 * EDGE as f32, 0.0), others);
        let probe = |at: DVec3| (TouchProbe { radius: 0.01, target: at, ..default() }, layers);
        let probes = [DVec3::new(0.0, 0.02, 0.0), DVec3::new(1.0, EDGE + 0.02, 0.0)]
            .map(|at| app.world_mut().spawn(probe(at)).id());
        seconds(&mut app, 2.0);
        for _ in 0..15 {
            for mut probe in app.world_mut().query::<&mut TouchProbe>().iter_mut(app.world_mut()) {
                probe.target.y -= 1e-3;
            }
            app.update();
        }
        for probe in probes {
            let force = app.world().get::<ProbeState>(probe).unwrap().force().y;
            assert_eq!(force > 0.1, touches, "{layers:?}: {force} N");
        }
    }
}

#[test]
fn a_moving_box_carries_what_lies_on_it() {
    let mut app = app();
    app.world_mut().spawn((Obstacle::Box { half: Vec3::new(5.0, 0.1, 5.0) }, Name::new("belt")));
    app.add_systems(FixedFirst, |time: Res<Time>, mut boxes: Query<&mut Transform, With<Obstacle>>| {
        boxes.iter_mut().for_each(|mut at| at.translation.x = 0.4 * time.elapsed_secs().min(2.0));
    });
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.2, 0.0), BodyFriction(0.8));
    seconds(&mut app, 1.9);
    let speed = state(&app, body).body().frame().velocity()[0];
    assert!((speed - 0.4).abs() < 0.01, "{speed} m/s on a belt of 0.4 m/s");
    // The belt has stopped, and so has the body.
    seconds(&mut app, 4.0);
    assert!(state(&app, body).is_resting());
}

#[test]
fn friction_decides_whether_a_body_stays_on_a_slope() {
    let mut app = app();
    let slope = Quat::from_rotation_z(-0.3);
    app.world_mut().spawn((Obstacle::Floor, Transform::from_rotation(slope)));
    let up = slope * Vec3::new(0.0, 0.1005, 0.0);
    let at = |z: f32| Transform::from_translation(up + Vec3::Z * z).with_rotation(slope);
    // tan 0.3 = 0.309.
    let stays = spawn(&mut app, at(0.0), BodyFriction(0.35));
    let slides = spawn(&mut app, at(1.0), BodyFriction(0.2));
    seconds(&mut app, 1.0);
    let gone = |body| (center(&app, body) - up.as_dvec3()).xy().length();
    let (sine, cosine) = 0.3f64.sin_cos();
    let way = 0.5 * GRAVITY * (sine - 0.2 * cosine);
    assert!(gone(stays) < 0.01 * EDGE, "{}", gone(stays));
    assert!((gone(slides) / way - 1.0).abs() < 0.05, "{} m for {way} m", gone(slides));
}

#[test]
fn an_obstacle_without_a_number_is_refused_once_and_touches_nothing() {
    let mut app = app();
    app.world_mut().spawn(Obstacle::Ball { radius: f32::NAN });
    app.world_mut().spawn((Obstacle::Floor, Transform::from_xyz(0.0, f32::NAN, 0.0)));
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.3, 0.0), BodyFriction(-1.0));
    seconds(&mut app, 0.5);
    assert!(center(&app, body).y < -0.5);
    let received = &app.world().resource::<Received>().refused;
    assert_eq!(received.iter().filter(|received| received.contains("radius")).count(), 1, "{received:?}");
    assert_eq!(received.iter().filter(|received| received.contains("friction")).count(), 1, "{received:?}");
}

#[test]
fn a_body_far_from_everything_has_no_contact_work() {
    let mut app = app();
    app.world_mut().spawn((Obstacle::Floor, Transform::from_xyz(0.0, -100.0, 0.0)));
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.0, 0.0), ());
    seconds(&mut app, 0.5);
    assert!(state(&app, body).body().contacts().obstacles().is_empty());
    // A ball that comes near is one.
    app.world_mut().spawn((Obstacle::Ball { radius: 0.1 }, Transform::from_xyz(0.0, -1.5, 0.0)));
    seconds(&mut app, 0.05);
    assert_eq!(state(&app, body).body().contacts().obstacles().len(), 1);
}

#[test]
fn a_box_that_moves_beside_a_resting_body_does_not_wake_it_and_one_that_comes_to_it_does() {
    let mut app = app();
    app.world_mut().spawn((Obstacle::Floor, Transform::default()));
    let half = Vec3::splat(0.1);
    let side = app.world_mut().spawn((Obstacle::Box { half }, Transform::from_xyz(0.3, 0.1, 0.0))).id();
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.101, 0.0), ());
    seconds(&mut app, 3.0);
    assert!(state(&app, body).is_resting());
    let mut awake = 0;
    for tick in 0..60 {
        let z = 0.1 * (0.3 * f64::from(tick)).sin() as f32;
        app.world_mut().get_mut::<Transform>(side).unwrap().translation.z = z;
        app.update();
        awake += usize::from(!state(&app, body).is_resting());
    }
    println!("awake for {awake} of 60 ticks");
    assert_eq!(awake, 0);
    // The box is where it is when the body wakes, and not where it was.
    for tick in 0..60 {
        app.world_mut().get_mut::<Transform>(side).unwrap().translation.x = 0.3 - 0.002 * tick as f32;
        app.update();
    }
    // The face of the box has come to 0.082 m, so the body's center is 0.018 m away.
    let pushed = center(&app, body).x;
    println!("pushed by {pushed} m");
    assert!((pushed + 0.018).abs() < 2e-3, "{pushed}");
    assert!(app.world().resource::<Received>().refused.is_empty());
}

#[test]
fn a_hand_presses_a_body_on_a_table() {
    let mut app = app();
    app.world_mut().spawn(Obstacle::Floor);
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.1005, 0.0), ());
    seconds(&mut app, 3.0);
    let positions = CUBE.surface().positions();
    let top = (0..positions.len() as u32)
        .max_by(|&a, &b| {
            let at = |v: u32| positions[v as usize][1] - 0.5 * positions[v as usize][0].abs();
            at(a).total_cmp(&at(b))
        })
        .unwrap();
    let hand = app.world_mut().spawn((Grab::new(top, 0.12, DVec3::new(0.0, 0.15, 0.0)), GrabOf(body))).id();
    seconds(&mut app, 3.0);
    let reaction = app.world().get::<pliant_body::GrabForce>(hand).unwrap().force;
    let floor = contacts(&app, body).force();
    // What the hand and the weight press down the floor holds up.
    let sum = floor - reaction - weight() * DVec3::Y;
    assert!(reaction.y > weight() && sum.length() < 1e-3 * floor.length(), "{floor} {reaction} {sum}");
}

#[test]
fn a_floor_that_is_turned_at_once_throws_nothing() {
    let mut app = app();
    let floor = app.world_mut().spawn(Obstacle::Floor).id();
    let body = spawn(&mut app, Transform::from_xyz(0.5, 0.1005, 0.0), ());
    seconds(&mut app, 3.0);
    // By 115 degrees about the vertical in one tick: the plane stays where it is.
    app.world_mut().get_mut::<Transform>(floor).unwrap().rotate_y(2.0);
    app.update();
    let speed = DVec3::from(state(&app, body).body().frame().velocity()).length();
    assert!(speed < 1e-3, "{speed} m/s");
}

#[test]
fn bodies_rest_on_each_other_and_wake_together() {
    let mut app = app();
    let floor = app.world_mut().spawn(Obstacle::Floor).id();
    let below = spawn(&mut app, Transform::from_xyz(0.0, 0.5 * EDGE as f32 + 0.001, 0.0), TouchBodies);
    let above = spawn(&mut app, Transform::from_xyz(0.02, 1.5 * EDGE as f32 + 0.02, 0.01), TouchBodies);
    seconds(&mut app, 8.0);
    assert!(state(&app, below).is_resting() && state(&app, above).is_resting());
    let force = contacts(&app, above).force();
    assert!((force - weight() * DVec3::Y).length() < 1e-3 * weight(), "{force} N for {} N", weight());
    assert!(contacts(&app, above).0.iter().all(|contact| contact.other == below));
    // The floor carries both, and the forces between them are opposite.
    let of = |other| contacts(&app, below).0.iter().filter(move |c| c.other == other).map(|c| c.force);
    let (up, down): (DVec3, DVec3) = (of(floor).sum(), of(above).sum());
    assert!((down + force).length() < 1e-9 * weight() && (up.y / weight() - 2.0).abs() < 1e-3, "{up} {down}");
    let received = app.world().resource::<Received>();
    let received = |entity, other| received.started.iter().any(|e| (e.entity, e.other) == (entity, other));
    assert!(received(above, below) && received(below, above) && received(below, floor));
    // What lies on a body that is moved away falls.
    app.world_mut().get_mut::<Transform>(below).unwrap().translation.x = 5.0;
    seconds(&mut app, 1.0);
    assert!(center(&app, above).y < EDGE, "{}", center(&app, above));
    seconds(&mut app, 4.0);
    assert!(state(&app, below).is_resting() && state(&app, above).is_resting());
}

#[test]
fn a_body_falls_when_the_one_below_is_removed_and_through_one_that_it_does_not_touch() {
    let mut app = app();
    app.world_mut().spawn(Obstacle::Floor);
    let below = spawn(&mut app, Transform::from_xyz(0.0, 0.5 * EDGE as f32, 0.0), TouchBodies);
    let above = spawn(&mut app, Transform::from_xyz(0.0, 1.5 * EDGE as f32, 0.0), TouchBodies);
    // Without the component it touches the floor alone.
    let through = spawn(&mut app, Transform::from_xyz(0.05, 4.0 * EDGE as f32, 0.05), ());
    seconds(&mut app, 6.0);
    assert!(center(&app, above).y > 1.4 * EDGE && center(&app, through).y < 0.6 * EDGE);
    assert!(state(&app, above).is_resting());
    app.world_mut().despawn(below);
    seconds(&mut app, 2.0);
    assert!(center(&app, above).y < 0.6 * EDGE, "{}", center(&app, above));
}

#[test]
fn who_steps_a_body_elsewhere_is_told_what_stands_still() {
    let mut app = app();
    app.world_mut().spawn(Obstacle::Floor);
    app.world_mut().spawn((Obstacle::Ball { radius: 0.5 }, Transform::from_xyz(3.0, 0.0, 0.0)));
    let capsule = Obstacle::Capsule { radius: 0.1, half_length: 0.2 };
    let moves = app.world_mut().spawn((capsule, Transform::from_xyz(9.0, 0.0, 0.0))).id();
    let layers = ContactLayers { memberships: 2, filters: 2 };
    app.world_mut().spawn((Obstacle::Box { half: Vec3::ONE }, layers));
    let own = (BodyFriction(0.3), ContactLayers { memberships: 1, ..default() });
    let body = spawn(&mut app, Transform::from_xyz(0.0, 1.0, 0.0).with_scale(Vec3::splat(2.0)), own);
    seconds(&mut app, 0.1);
    let received = |app: &mut App| {
        app.world_mut().entity_mut(body).insert(FixedObstacles::default());
        app.world().get::<FixedObstacles>(body).unwrap().clone()
    };
    assert_eq!(received(&mut app).obstacles.len(), 3);
    app.world_mut().get_mut::<Transform>(moves).unwrap().translation.x += 0.01;
    app.update();
    let FixedObstacles { friction, obstacles } = received(&mut app);
    // In the world of the body, in which all lengths are halved.
    let ball = FixedObstacle {
        shape: FixedShape::Ball { radius: 0.25 },
        position: [1.5, 0.0, 0.0],
        ..FixedObstacle::GROUND
    };
    assert!(friction == 0.3 && obstacles.len() == 2, "{obstacles:?}");
    assert!(obstacles.contains(&FixedObstacle::GROUND) && obstacles.contains(&ball), "{obstacles:?}");
}
