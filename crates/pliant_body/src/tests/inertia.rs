use std::{f64::consts::TAU, time::Duration};

use bevy::{math::DVec3, prelude::*, time::TimeUpdateStrategy};

use super::{app, model, refusals, spawn, spawn_with, state, steps};
use crate::{Driven, Inertia, PliantSystems, Pose, RideOn, SingleSteps, Teleport};

/// What moves the entities, and when.
#[derive(Debug, Clone, Copy, PartialEq)]
enum By {
    Frames,
    Ticks,
    /// As a rigid body engine does: after the bodies' step.
    TicksAfter,
}

const ALL: [By; 3] = [By::Frames, By::Ticks, By::TicksAfter];

/// Moves an entity: its place and its turn about y at a time, s.
#[derive(Component, Clone, Copy)]
struct Course(fn(f64) -> (DVec3, f64));

fn follow(time: Res<Time>, mut movers: Query<(&Course, &mut Transform)>) {
    for (course, mut transform) in &mut movers {
        let (place, turn) = course.0(time.elapsed_secs_f64());
        (transform.translation, transform.rotation) = (place.as_vec3(), Quat::from_rotation_y(turn as f32));
    }
}

/// An app of 64 ticks a second in which courses are followed.
fn moving_app(by: By, frames: f64) -> App {
    let mut app = app();
    app.insert_resource(Time::<Fixed>::from_hz(64.0))
        .insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_secs_f64(1.0 / frames)));
    match by {
        By::Frames => app.add_systems(Update, follow),
        By::Ticks => app.add_systems(FixedUpdate, follow.before(PliantSystems::Input)),
        By::TicksAfter => app.add_systems(FixedPostUpdate, follow),
    };
    app
}

fn run(app: &mut App, frames: f64, seconds: f64) {
    steps(app, (frames * seconds) as usize);
}

/// Coordinate of a mode, kg^1/2 m.
fn q(app: &App, body: Entity, mode: usize) -> f64 {
    state(app, body).body().q()[mode]
}

/// Participation of stretch along x, kg^1/2, and its squared angular frequency.
fn stretch() -> (f64, f64) {
    let bar = model::bar();
    (bar.participation()[3][0], bar.omega()[3].powi(2))
}

#[test]
fn a_constant_velocity_gives_no_force_at_any_frame_rate() {
    let straight = Course(|t| (DVec3::new(5.0 * t, 1.0 - 2.0 * t, 30.0), 0.0));
    for by in ALL {
        for frames in [30.0, 60.0, 64.0, 144.0, 239.7] {
            let mut app = moving_app(by, frames);
            let parent = app.world_mut().spawn((straight, Transform::default(), Visibility::default())).id();
            let body = spawn(&mut app, model::bar(), (ChildOf(parent), Transform::from_xyz(0.3, 0.0, 0.0)));
            run(&mut app, frames, 3.0);
            let velocity = state(&app, body).body().frame().origin()[0];
            assert!(velocity > 10.0, "it moves: {velocity}");
            let energy = state(&app, body).body().energy();
            assert_eq!(energy, 0.0, "{by:?} at {frames} Hz");
        }
    }
}

#[test]
fn an_accelerated_entity_bends_its_body_as_the_opposite_gravity_does() {
    // It is at rest for a second, and has then 4 m/s^2 along x.
    let faster = Course(|t| (DVec3::new(2.0 * (t - 1.0).max(0.0).powi(2), 0.0, 0.0), 0.0));
    let (participation, square) = stretch();
    for by in ALL {
        for frames in [30.0, 60.0, 64.0, 144.0] {
            let mut app = moving_app(by, frames);
            let body = spawn(&mut app, model::bar(), faster);
            run(&mut app, frames, 4.0);
            let (mut mean, mut most, count) = (0.0, 0.0f64, frames as usize);
            for _ in 0..count {
                app.update();
                let share = -q(&app, body, 3) * square / (4.0 * participation);
                mean += share / count as f64;
                most = most.max((share - 1.0).abs());
            }
            assert!((mean - 1.0).abs() < 0.01, "{by:?} at {frames} Hz: {mean}");
            assert!(most < 0.02, "{by:?} at {frames} Hz: {most}");
        }
    }
}

#[test]
fn a_body_on_a_spinning_parent_is_pulled_outward() {
    // The bar is 0.5 m out on a turntable of 3 rad/s: omega^2 integral of rho phi (R + x).
    let turntable = Course(|t| (DVec3::new(0.0, 0.4, 7.0), 3.0 * t));
    let (participation, square) = stretch();
    let moment = participation * 2.0 / 3.0;
    let expected = 9.0 * (0.5 * participation + moment) / square;
    for by in ALL {
        for frames in [60.0, 64.0, 144.0] {
            let mut app = moving_app(by, frames);
            let parent = app.world_mut().spawn((turntable, Transform::default(), Visibility::default())).id();
            let body = spawn(&mut app, model::bar(), (ChildOf(parent), Transform::from_xyz(0.5, 0.0, 0.0)));
            run(&mut app, frames, 8.0);
            let off = (1..=count(frames)).map(|_| {
                app.update();
                q(&app, body, 3) / expected - 1.0
            });
            let worst = off.fold(0.0f64, |most, off| most.max(off.abs()));
            assert!(worst < 0.03, "{by:?} at {frames} Hz: {worst}");
            // Nothing pulls it up, and what is left of its side is small.
            assert!(q(&app, body, 1).abs() < 0.02 * 9.0 * 0.5, "{}", q(&app, body, 1));
        }
    }
}

/// Number of frames in half a second.
fn count(frames: f64) -> usize {
    (0.5 * frames) as usize
}

#[test]
fn a_turning_parent_takes_gravity_with_the_world() {
    // A quarter turn about x: world's down is the body's -z, then.
    let mut app = app();
    let parent = app.world_mut().spawn((Transform::default(), Visibility::default())).id();
    let fall = |body: &mut crate::ModalBody| body.settings.gravity = [0.0, -2.0, 0.0];
    let body = spawn_with(&mut app, model::bar(), fall, ChildOf(parent));
    steps(&mut app, 800);
    let (down, side) = (q(&app, body, 0), q(&app, body, 1));
    assert!(down < 0.0 && side.abs() < 1e-3 * down.abs(), "{down} {side}");
    let mut transform = app.world_mut().get_mut::<Transform>(parent).unwrap();
    transform.rotation = Quat::from_rotation_x(-(TAU / 4.0) as f32);
    app.world_mut().write_message(Teleport(parent));
    steps(&mut app, 800);
    let turned = q(&app, body, 1) / down * (model::FREQUENCIES[1] / model::FREQUENCIES[0]).powi(2);
    assert!((turned.abs() - 1.0).abs() < 0.01, "{turned}");
    assert!(q(&app, body, 0).abs() < 1e-3 * down.abs());
}

#[test]
fn a_teleport_gives_nothing() {
    // Far ones are known, and of short ones the app is told.
    for (way, announced, moves) in [(10.0, false, false), (0.5, true, false), (0.5, false, true)] {
        for by in ALL {
            let mut app = moving_app(by, 60.0);
            let parent = app.world_mut().spawn((Transform::default(), Visibility::default())).id();
            let body = spawn(&mut app, model::bar(), ChildOf(parent));
            run(&mut app, 60.0, 0.5);
            for jump in 1..=5 {
                let jumped = Transform::from_xyz(way * jump as f32, 0.0, 0.0);
                *app.world_mut().get_mut::<Transform>(parent).unwrap() = jumped;
                if announced {
                    app.world_mut().write_message(Teleport(parent));
                }
                run(&mut app, 60.0, 0.2);
            }
            let energy = state(&app, body).body().energy();
            assert_eq!(energy > 0.0, moves, "{way} m, told {announced}, {by:?}: {energy} J");
        }
    }
}

#[test]
fn a_teleport_keeps_the_speed_of_what_is_under_way() {
    // It runs at 3 m/s, and is 50 m farther on from one second on.
    let course = Course(|t| (DVec3::new(3.0 * t + if t < 1.0 { 0.0 } else { 50.0 }, 0.0, 0.0), 0.0));
    for by in ALL {
        let mut app = moving_app(by, 144.0);
        let body = spawn(&mut app, model::bar(), course);
        run(&mut app, 144.0, 2.0);
        assert!(state(&app, body).body().frame().origin()[0] > 53.0);
        assert_eq!(state(&app, body).body().energy(), 0.0, "{by:?}");
    }
}

#[test]
fn what_is_moved_in_a_pause_gives_nothing() {
    let mut app = moving_app(By::Frames, 60.0);
    let body = spawn(&mut app, model::bar(), ());
    run(&mut app, 60.0, 0.5);
    app.world_mut().resource_mut::<Time<Virtual>>().pause();
    steps(&mut app, 3);
    app.world_mut().get_mut::<Transform>(body).unwrap().translation.x = 0.5;
    app.world_mut().write_message(SingleSteps(1));
    steps(&mut app, 3);
    app.world_mut().resource_mut::<Time<Virtual>>().unpause();
    run(&mut app, 60.0, 0.5);
    assert!((state(&app, body).body().frame().origin()[0] - 0.5).abs() < 1e-6);
    assert_eq!(state(&app, body).body().energy(), 0.0);
}

#[test]
fn the_force_has_the_factor_and_the_scale_of_the_entity() {
    let faster = Course(|t| (DVec3::new(2.0 * t * t, 0.0, 0.0), 0.0));
    let (participation, square) = stretch();
    for (inertia, scale, expected) in
        [(0.0, 1.0, 0.0), (0.5, 1.0, 0.5), (1.0, 2.0, 0.5), (f32::NAN, 1.0, 0.0), (-1.0, 1.0, 0.0)]
    {
        let mut app = moving_app(By::Ticks, 64.0);
        let parent = app.world_mut().spawn((faster, Transform::default(), Visibility::default())).id();
        let place = Transform::from_scale(Vec3::splat(scale));
        let body = spawn(&mut app, model::bar(), (ChildOf(parent), Inertia(inertia), place));
        run(&mut app, 64.0, 4.0);
        let share = -q(&app, body, 3) * square / (4.0 * participation);
        assert!((share - expected).abs() < 5e-3, "{inertia}, {scale}: {share}");
        assert!(refusals(&mut app).is_empty());
    }
}

#[test]
fn remote_and_free_bodies_do_not_feel_it() {
    let faster = Course(|t| (DVec3::new(2.0 * t * t, 0.0, 0.0), 0.0));
    let mut app = moving_app(By::Ticks, 64.0);
    let remote = spawn(&mut app, model::bar(), (faster, Driven::Remote));
    let free = spawn(&mut app, model::free_bar(), Transform::from_xyz(0.0, 3.0, 0.0));
    run(&mut app, 64.0, 1.0);
    for body in [remote, free] {
        assert_eq!(state(&app, body).body().energy(), 0.0);
    }
}

#[test]
fn a_body_at_rest_on_a_still_entity_stays_at_rest() {
    let mut app = moving_app(By::Frames, 144.0);
    let parent = app.world_mut().spawn((Transform::from_xyz(900.0, 3.0, 0.1), Visibility::default())).id();
    let body = spawn(&mut app, model::bar(), ChildOf(parent));
    run(&mut app, 144.0, 2.0);
    assert!(state(&app, body).is_resting());
}

#[test]
fn a_body_comes_to_rest_after_its_entity_has_turned_to_a_stop() {
    for by in [By::Ticks, By::Frames] {
        let mut app = moving_app(by, 60.0);
        let parent = app.world_mut().spawn((Transform::default(), Visibility::default())).id();
        let body = spawn(&mut app, model::bar(), ChildOf(parent));
        run(&mut app, 60.0, 0.5);
        // It slows down so gently that the last changes of its velocity are below what single
        // precision tells.
        let eased = |t: f64| {
            let s = (t / 4.0).clamp(0.0, 1.0);
            (DVec3::ZERO, 0.3 * s * s * s * (10.0 - 15.0 * s + 6.0 * s * s))
        };
        app.world_mut().entity_mut(parent).insert(Course(eased));
        run(&mut app, 60.0, 40.0);
        assert!(state(&app, body).is_resting());
    }
}

#[test]
fn nothing_rides_on_what_rides_on_it() {
    let mut app = moving_app(By::Ticks, 64.0);
    let body = spawn(&mut app, model::bar(), ());
    let child = app.world_mut().spawn((Name::new("Head"), ChildOf(body), Transform::default())).id();
    for root in [body, child] {
        app.world_mut().entity_mut(body).insert(RideOn { root, name: "Head".into() });
        run(&mut app, 64.0, 0.1);
        assert!(app.world().get::<ChildOf>(body).is_none());
    }
}

#[test]
fn a_turn_has_the_shorter_of_two_ways() {
    // A quaternion and its opposite are the same rotation.
    let step = 0.01;
    let at = |turn: f64, sign: f64| Pose {
        origin: DVec3::ZERO,
        orientation: bevy::math::DQuat::from_rotation_z(turn) * sign,
    };
    for sign in [1.0, -1.0] {
        let [velocity, spin] = at(3.05, sign).velocity_since(&at(3.0, 1.0), step).unwrap();
        assert_eq!(velocity, DVec3::ZERO);
        assert!((spin - DVec3::Z * 5.0).length() < 1e-9, "{sign}: {spin}");
    }
    assert_eq!(at(1.5, 1.0).velocity_since(&at(0.0, 1.0), step), None);
}

#[test]
fn a_body_rides_on_a_bone_by_its_name() {
    let mut app = moving_app(By::Ticks, 64.0);
    let character = app.world_mut().spawn((Transform::default(), Visibility::default())).id();
    let body = spawn(
        &mut app,
        model::bar(),
        (RideOn { root: character, name: "Head".into() }, Transform::from_xyz(0.0, 0.1, 0.0)),
    );
    run(&mut app, 64.0, 0.5);
    assert!(app.world().get::<ChildOf>(body).is_none(), "there is no bone yet");
    // A skinned mesh has its joints below the character: as a glTF scene makes them, later.
    let joint = |app: &mut App, name: &str, parent: Entity, y: f32| {
        let place = Transform::from_xyz(0.0, y, 0.0);
        app.world_mut()
            .spawn((Name::new(name.to_owned()), ChildOf(parent), place, Visibility::default()))
            .id()
    };
    // Near enough that the way there is slower than what counts as a teleport by itself.
    let spine = joint(&mut app, "Spine", character, 0.1);
    let neck = joint(&mut app, "Neck", spine, 0.05);
    let head = joint(&mut app, "Head", neck, 0.05);
    let skin =
        bevy::mesh::skinning::SkinnedMesh { inverse_bindposes: default(), joints: vec![spine, neck, head] };
    app.world_mut().spawn((skin, ChildOf(character), Transform::default(), Visibility::default()));
    run(&mut app, 64.0, 0.5);
    assert_eq!(app.world().get::<ChildOf>(body).map(ChildOf::parent), Some(head));
    assert!(app.world().get::<RideOn>(body).is_none());
    assert_eq!(state(&app, body).body().energy(), 0.0, "to be put in place is no motion");
    let origin = DVec3::from(state(&app, body).body().frame().origin());
    assert!((origin - DVec3::new(0.0, 0.3, 0.0)).length() < 1e-5, "{origin}");
    // The body feels the neck nod.
    app.world_mut().entity_mut(neck).insert(Course(|t| (DVec3::Y * 0.05, 0.5 * (6.0 * t).sin())));
    run(&mut app, 64.0, 1.0);
    assert!(state(&app, body).body().energy() > 1e-3);
    app.world_mut().entity_mut(character).despawn();
    run(&mut app, 64.0, 0.1);
    assert!(app.world().get_entity(body).is_err(), "it goes with what it rides on");
}
