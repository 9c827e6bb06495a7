//! Rigid bodies of avian that touch a soft cube, against what mechanics says.

use avian3d::prelude::*;

use pliant_body::RigidBodies;

use super::*;
use crate::obstacle::Motion;

pub(super) fn avian(gravity: f32) -> App {
    app_with(|app| {
        app.add_plugins(PhysicsPlugins::default()).insert_resource(Gravity(gravity * Vec3::NEG_Y));
    })
}

pub(super) fn earth() -> App {
    avian(GRAVITY as f32)
}

/// A box of this mass.
pub(super) fn brick(app: &mut App, at: Vec3, size: Vec3, mass: f64) -> Entity {
    let density = mass as f32 / (size.x * size.y * size.z);
    let collider = (Collider::cuboid(size.x, size.y, size.z), ColliderDensity(density));
    app.world_mut().spawn((RigidBody::Dynamic, collider, Transform::from_translation(at))).id()
}

/// A soft cube without weight of its own.
pub(super) fn weightless(app: &mut App, at: Vec3) -> Entity {
    let model = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(CUBE.clone()));
    let body = ModalBody::new(model);
    app.world_mut().spawn((body, Transform::from_translation(at))).id()
}

pub(super) fn place(app: &App, rigid: Entity) -> DVec3 {
    app.world().get::<Position>(rigid).unwrap().0.as_dvec3()
}

pub(super) fn velocity(app: &App, rigid: Entity) -> DVec3 {
    app.world().get::<LinearVelocity>(rigid).unwrap().0.as_dvec3()
}

fn throw(app: &mut App, body: Entity, velocity: [f64; 3]) {
    let mut state = app.world_mut().get_mut::<BodyState>(body).unwrap();
    let body = state.body_mut();
    let frame = *body.frame();
    let moving =
        pliant_modal::Frame::from_motion(&CUBE, frame.center(), frame.orientation(), velocity, frame.spin());
    let mut now = body.state().clone();
    now.frame = moving.unwrap();
    body.set_state(&now).unwrap();
}

/// Momentum (N s) and angular momentum about the origin (N m s) of a rigid body.
pub(super) fn momentum(app: &App, rigid: Entity) -> [DVec3; 2] {
    let get = app.world().entity(rigid);
    let mass = f64::from(get.get::<ComputedMass>().unwrap().value());
    let turn = get.get::<Rotation>().unwrap().0;
    let inertia = get.get::<ComputedAngularInertia>().unwrap().rotated(turn).tensor();
    let spin = get.get::<AngularVelocity>().unwrap().0;
    let linear = mass * velocity(app, rigid);
    [linear, (Mat3::from(inertia) * spin).as_dvec3() + place(app, rigid).cross(linear)]
}

pub(super) fn soft_momentum(app: &App, body: Entity) -> [DVec3; 2] {
    let frame = state(app, body).body().frame();
    let linear = CUBE.mass() * DVec3::from(frame.velocity());
    [linear, DVec3::from(frame.spin()) + DVec3::from(frame.center()).cross(linear)]
}

#[test]
fn momentum_is_exchanged_and_none_is_lost() {
    for ratio in [0.01, 1.0, 100.0] {
        let mut app = avian(0.0);
        let mass = ratio * CUBE.mass();
        let rigid = brick(&mut app, Vec3::new(0.26, 0.05, 0.03), Vec3::new(0.2, 0.3, 0.2), mass);
        let body = weightless(&mut app, Vec3::ZERO);
        app.update();
        app.update();
        throw(&mut app, body, [1.0, 0.0, 0.0]);
        let sum = |app: &App| {
            let (a, b) = (momentum(app, rigid), soft_momentum(app, body));
            [a[0] + b[0], a[1] + b[1]]
        };
        let (before, own) = (sum(&app), momentum(&app, rigid));
        let mut worst = [0.0f64; 2];
        let mut touched = false;
        for _ in 0..60 {
            app.update();
            touched |= !contacts(&app, body).0.is_empty();
            let now = sum(&app);
            for k in 0..2 {
                worst[k] = worst[k].max((now[k] - before[k]).length());
            }
        }
        let exchanged = (momentum(&app, rigid)[0] - own[0]).length();
        println!(
            "mass ratio {ratio}: exchanged {exchanged} N s, lost {:e}, angular {:e}",
            worst[0] / exchanged,
            worst[1] / exchanged
        );
        assert!(touched && exchanged > 0.0);
        assert!(worst[0] < 1e-6 * exchanged, "{} of {exchanged}", worst[0]);
        assert!(worst[1] < 1e-3 * exchanged, "{} of {exchanged}", worst[1]);
    }
}

#[test]
fn crates_of_all_masses_rest_on_a_body() {
    for ratio in [0.01, 0.1, 1.0, 10.0] {
        let mut app = earth();
        app.world_mut().spawn(Obstacle::Floor);
        let body = spawn(&mut app, Transform::from_xyz(0.0, 0.1005, 0.0), ());
        let mass = ratio * CUBE.mass();
        let rigid = brick(&mut app, Vec3::new(0.0, 0.251, 0.0), Vec3::splat(0.1), mass);
        seconds(&mut app, 8.0);
        let mut most = 0.0f64;
        let mut sum = DVec3::ZERO;
        for _ in 0..120 {
            app.update();
            most = most.max(velocity(&app, rigid).length());
            let of = contacts(&app, body).0.iter().filter(|c| c.other == rigid);
            sum += of.map(|c| c.force).sum::<DVec3>() / 120.0;
        }
        println!(
            "ratio {ratio}: speed {most:e} m/s, force {:e} of m g, at {}",
            sum.y / (-mass * GRAVITY),
            place(&app, rigid)
        );
        assert!(most < 1e-2, "{ratio}: {most} m/s");
        assert!((sum.y / (-mass * GRAVITY) - 1.0).abs() < 0.01, "{ratio}: {sum}");
    }
}

#[test]
fn a_crate_of_a_hundred_times_the_mass_rests_on_a_stiffer_body() {
    let mut mesh = pliant_mesh::shapes::bar([3, 3, 3], [EDGE; 3]).unwrap();
    mesh.nodes.iter_mut().flatten().for_each(|x| *x -= 0.5 * EDGE);
    let damping = pliant_modal::Damping::Ratio(0.1);
    let config =
        pliant_bake::BakeConfig { modes: 12, young: 1e8, damping, ..pliant_bake::BakeConfig::linear() };
    let model = Arc::new(pliant_bake::bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model);
    let mass = 100.0 * model.mass();
    let mut app = earth();
    app.world_mut().spawn(Obstacle::Floor);
    let asset = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(model));
    let mut body = ModalBody::new(asset);
    body.settings.gravity = [0.0, -GRAVITY, 0.0];
    let body = app.world_mut().spawn((body, Transform::from_xyz(0.0, 0.1005, 0.0))).id();
    let rigid = brick(&mut app, Vec3::new(0.01, 0.252, 0.02), Vec3::new(0.2, 0.1, 0.2), mass);
    seconds(&mut app, 8.0);
    let (mut most, mut sum) = (0.0f64, 0.0);
    for _ in 0..120 {
        app.update();
        most = most.max(velocity(&app, rigid).length());
        let of = contacts(&app, body).0.iter().filter(|c| c.other == rigid);
        sum += of.map(|c| c.force.y).sum::<f64>() / 120.0;
    }
    let share = sum / (-mass * GRAVITY);
    println!("speed {most:e} m/s, force {share:e} of m g, at {}", place(&app, rigid));
    assert!(most < 1e-2 && (share - 1.0).abs() < 0.01 && place(&app, rigid).y > 0.24, "{most} {share}");
}

#[test]
fn a_body_rests_on_crates_of_all_masses_on_a_floor() {
    for ratio in [0.1, 1.0, 10.0, 100.0] {
        let mut app = earth();
        let floor = (RigidBody::Static, Collider::half_space(Vec3::Y));
        app.world_mut().spawn((floor, Transform::default()));
        let rigid =
            brick(&mut app, Vec3::new(0.0, 0.151, 0.0), Vec3::new(0.5, 0.3, 0.5), ratio * CUBE.mass());
        seconds(&mut app, 1.0);
        let body = spawn(&mut app, Transform::from_xyz(0.02, 0.45, 0.01), ());
        seconds(&mut app, 10.0);
        let force = contacts(&app, body).force();
        let depth = contacts(&app, body).0.iter().map(|c| c.penetration).fold(0.0, f64::max);
        println!(
            "ratio {ratio}: {force} for {}, speed {:e}, depth {depth:e}, resting {}, crate at {}, body {}",
            weight(),
            velocity(&app, rigid).length(),
            state(&app, body).is_resting(),
            place(&app, rigid),
            center(&app, body)
        );
        assert!((force.y / weight() - 1.0).abs() < 0.01, "{ratio}: {force}");
        assert!(velocity(&app, rigid).length() < 1e-2, "{ratio}: {}", velocity(&app, rigid));
        assert!(state(&app, body).is_resting() && center(&app, body).y > 0.39);
    }
}

fn ball(app: &mut App, at: Vec3, radius: f32, mass: f64) -> Entity {
    let volume = 4.0 / 3.0 * std::f32::consts::PI * radius.powi(3);
    let collider = (Collider::sphere(radius), ColliderDensity(mass as f32 / volume));
    app.world_mut().spawn((RigidBody::Dynamic, collider, Transform::from_translation(at))).id()
}

#[test]
fn a_ball_bounces_off_a_body_and_gains_no_energy() {
    // The touch of a light ball is shorter than a step of 60 Hz, which loses its bounce.
    for (ratio, rate, bounces) in
        [(0.01, 60, false), (0.1, 60, false), (0.1, 240, true), (1.0, 240, true), (10.0, 60, false)]
    {
        let mut app = earth();
        app.insert_resource(Time::<Fixed>::from_hz(f64::from(rate)));
        let ticks = |app: &mut App, seconds: f64| {
            (0..(seconds * f64::from(rate)) as usize).for_each(|_| app.update())
        };
        app.world_mut().spawn(Obstacle::Floor);
        let body = spawn(&mut app, Transform::from_xyz(0.0, 0.1005, 0.0), ());
        ticks(&mut app, 3.0);
        let mass = ratio * CUBE.mass();
        // Wider than the sites of the coarse cube are apart: between them it would sink in.
        let radius = 0.15;
        let rigid = ball(&mut app, Vec3::new(0.0, 0.2 + radius + 0.5, 0.0), radius, mass);
        ticks(&mut app, 0.1);
        let energy = |app: &App| {
            let soft = state(app, body).body().energy() + state(app, body).body().potential_energy();
            let v = velocity(app, rigid);
            let spin = app.world().get::<AngularVelocity>(rigid).unwrap().0.as_dvec3();
            let turning = 0.2 * mass * f64::from(radius * radius) * spin.length_squared();
            soft + mass * (0.5 * v.length_squared() + GRAVITY * place(app, rigid).y) + turning
        };
        let before = energy(&app);
        let (mut up, mut most) = (0.0f64, f64::NEG_INFINITY);
        for _ in 0..rate {
            app.update();
            most = most.max(energy(&app) - before);
            up = up.max(velocity(&app, rigid).y);
        }
        let scale = mass * GRAVITY * 0.5;
        println!(
            "ratio {ratio} at {rate} Hz: leaves at {up} m/s of 3.13, gains {:e} of the fall's energy",
            most / scale
        );
        assert!(up < 3.13 && (!bounces || up > 0.05), "{ratio}: {up} m/s");
        assert!(most < 0.02 * scale, "{ratio}: {} of {scale}", most);
    }
}

#[test]
fn what_is_removed_sensed_or_no_number_does_no_harm() {
    let mut app = earth();
    app.world_mut().spawn((
        RigidBody::Static,
        Collider::cuboid(4.0, 1.0, 4.0),
        Transform::from_xyz(0.0, -0.5, 0.0),
    ));
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.101, 0.0), ());
    let sensor = (Collider::cuboid(1.0, 1.0, 1.0), Sensor, Transform::from_xyz(0.0, 0.1, 0.0));
    app.world_mut().spawn((RigidBody::Static, sensor));
    let layers = ContactLayers { memberships: 0, filters: 0 };
    let through = brick(&mut app, Vec3::new(0.0, 0.15, 0.0), Vec3::splat(0.05), 1.0);
    app.world_mut().entity_mut(through).insert(layers);
    let rigid = brick(&mut app, Vec3::new(0.0, 0.3, 0.0), Vec3::splat(0.1), 4.0);
    seconds(&mut app, 2.0);
    assert!(contacts(&app, body).touches(rigid) && !contacts(&app, body).touches(through));
    assert!((center(&app, body).y - 0.1).abs() < 0.01);
    // A velocity without a number touches as if it stood still, and is gone in the next tick.
    let other = brick(&mut app, Vec3::new(1.0, 0.3, 0.0), Vec3::splat(0.1), 4.0);
    app.world_mut().get_mut::<LinearVelocity>(other).unwrap().0.x = f32::NAN;
    app.world_mut().despawn(other);
    app.world_mut().entity_mut(rigid).remove::<Collider>();
    seconds(&mut app, 0.1);
    assert!(!contacts(&app, body).touches(rigid));
    let next = brick(&mut app, Vec3::new(0.0, 0.3, 0.0), Vec3::splat(0.1), 4.0);
    seconds(&mut app, 3.0);
    assert!(contacts(&app, body).touches(next) && app.world().get::<Sleeping>(next).is_some());
    assert!(state(&app, body).is_resting());
    app.world_mut().despawn(next);
    seconds(&mut app, 1.0);
    assert!(
        !contacts(&app, body).touches(next)
            && state(&app, body).body().state().q.iter().all(|q| q.is_finite())
    );
    let last = brick(&mut app, Vec3::new(0.0, 0.3, 0.0), Vec3::splat(0.1), 4.0);
    seconds(&mut app, 3.0);
    app.world_mut().despawn(body);
    seconds(&mut app, 1.0);
    assert!(place(&app, last).y < 0.12, "{}", place(&app, last));
}

#[test]
fn a_crate_that_no_body_touches_sleeps_on_and_lets_its_neighbor_rest() {
    let mut app = earth();
    let floor = (RigidBody::Static, Collider::half_space(Vec3::Y));
    app.world_mut().spawn((floor, Transform::default()));
    let rigid = brick(&mut app, Vec3::new(0.3, 0.1, 0.0), Vec3::splat(0.2), 4.0);
    seconds(&mut app, 3.0);
    assert!(app.world().get::<Sleeping>(rigid).is_some());
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.12, 0.0), ());
    let mut listed = false;
    for _ in 0..360 {
        app.update();
        listed |= !app.world().resource::<RigidBodies>().0.is_empty();
        assert!(app.world().get::<Sleeping>(rigid).is_some());
    }
    assert!(listed && !contacts(&app, body).touches(rigid) && state(&app, body).is_resting());
}

/// Neither one that slides past nor one that lies still near it, for as long as it is awake.
#[test]
fn a_crate_that_moves_beside_a_resting_body_does_not_wake_it() {
    let mut app = earth();
    let floor = (RigidBody::Static, Collider::half_space(Vec3::Y));
    app.world_mut().spawn((floor, Transform::default()));
    let body = spawn(&mut app, Transform::from_xyz(0.0, 0.101, 0.0), ());
    seconds(&mut app, 3.0);
    assert!(state(&app, body).is_resting());
    let rigid = brick(&mut app, Vec3::new(0.3, 0.101, -0.3), Vec3::splat(0.2), 4.0);
    app.world_mut().entity_mut(rigid).insert(LinearVelocity(Vec3::new(0.0, 0.0, 2.0)));
    let mut awake = 0;
    for _ in 0..30 {
        app.update();
        awake += usize::from(!state(&app, body).is_resting());
    }
    println!("awake for {awake} of 30 ticks");
    assert!(velocity(&app, rigid).length() < 2.0, "it has slid");
    assert_eq!(awake, 0);
    // One that comes to it does.
    app.world_mut().entity_mut(rigid).insert(LinearVelocity(Vec3::ZERO));
    let way = DVec3::from(state(&app, body).body().frame().center()) - place(&app, rigid);
    app.world_mut().entity_mut(rigid).insert(LinearVelocity(3.0 * way.normalize().as_vec3()));
    seconds(&mut app, 0.5);
    assert!(center(&app, body).length() > 0.11, "{}", center(&app, body));
}

#[test]
fn a_collider_on_a_child_is_where_its_body_takes_it() {
    let mut app = earth();
    let moving = (RigidBody::Kinematic, LinearVelocity(2.0 * Vec3::Y), AngularVelocity(Vec3::Y));
    let rigid = app.world_mut().spawn((moving, Transform::default())).id();
    let child = (Collider::sphere(0.1), Transform::from_xyz(0.5, 0.0, 0.0), ChildOf(rigid));
    let child = app.world_mut().spawn(child).id();
    for tick in 0..20 {
        app.update();
        if tick < 3 {
            continue;
        }
        let turn = app.world().get::<Rotation>(rigid).unwrap().0.as_dquat();
        let at = place(&app, rigid) + turn * DVec3::new(0.5, 0.0, 0.0);
        let distance = app.world().get::<Motion>(child).unwrap().distance(1.0, &at.to_array().into());
        assert!((distance + 0.1).abs() < 1e-4, "{distance} m at {tick}");
    }
}

#[test]
fn a_body_stays_on_a_crate_that_only_turns() {
    let mut app = earth();
    let floor = (RigidBody::Static, Collider::half_space(Vec3::Y));
    app.world_mut().spawn((floor, Transform::default()));
    let rigid = brick(&mut app, Vec3::new(0.0, 0.149, 0.0), Vec3::new(0.5, 0.3, 0.5), 4.0);
    app.world_mut().entity_mut(rigid).insert(LockedAxes::TRANSLATION_LOCKED);
    seconds(&mut app, 1.0);
    let body = spawn(&mut app, Transform::from_xyz(0.05, 0.42, 0.02), ());
    seconds(&mut app, 8.0);
    let mut spin = 0.0f32;
    for _ in 0..120 {
        app.update();
        spin = spin.max(app.world().get::<AngularVelocity>(rigid).unwrap().0.length());
    }
    println!("the crate turns by up to {spin:e} rad/s, body at {}", center(&app, body));
    assert!((center(&app, body).y - 0.4).abs() < 0.01 && spin < 0.01);
}
