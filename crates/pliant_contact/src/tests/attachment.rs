//! Soft cubes that are attached to rigid bodies of avian, against what mechanics says.

use avian3d::prelude::*;

use super::{
    avian::{avian, brick, earth, momentum, place, soft_momentum, velocity},
    *,
};
use crate::{Attachment, AttachmentForce};

const LOW: Vec3 = Vec3::new(0.0, -0.5 * EDGE as f32, 0.0);
const HIGH: Vec3 = Vec3::new(0.0, 0.5 * EDGE as f32, 0.0);

fn force(app: &App, attachment: Entity) -> DVec3 {
    app.world().get::<AttachmentForce>(attachment).unwrap().0
}

/// The cube with a vertex in the middle of each face, so that it hangs straight.
static EVEN: LazyLock<Arc<ModalModel>> = LazyLock::new(|| {
    let mut mesh = pliant_mesh::shapes::bar([2, 2, 2], [EDGE; 3]).unwrap();
    mesh.nodes.iter_mut().flatten().for_each(|x| *x -= 0.5 * EDGE);
    let damping = pliant_modal::Damping::Ratio(0.1);
    let config =
        pliant_bake::BakeConfig { modes: 12, young: 1e6, damping, ..pliant_bake::BakeConfig::linear() };
    Arc::new(pliant_bake::bake(&mesh, None, &config, &mut |_, _| ()).unwrap().model)
});

fn spawn_even(app: &mut App, at: Transform, gravity: f64) -> Entity {
    let model = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset(EVEN.clone()));
    let mut body = ModalBody::new(model);
    body.settings.gravity = [0.0, -gravity, 0.0];
    app.world_mut().spawn((body, at)).id()
}

/// A cube that hangs from something of this kind, and what it hangs from.
fn hang(app: &mut App, kind: RigidBody) -> [Entity; 3] {
    let top = app.world_mut().spawn((kind, Collider::sphere(0.05), Transform::from_xyz(0.0, 1.0, 0.0))).id();
    let body = spawn_even(app, Transform::from_xyz(0.0, 0.9, 0.0), GRAVITY);
    let attachment = app.world_mut().spawn(Attachment::new(body, HIGH, top, Vec3::ZERO)).id();
    [top, body, attachment]
}

#[test]
fn a_crate_hangs_from_a_cube_with_its_weight() {
    for ratio in [0.1, 1.0, 10.0] {
        let mut app = earth();
        let [_, body, above] = hang(&mut app, RigidBody::Static);
        let mass = ratio * CUBE.mass();
        let size = Vec3::splat(0.1);
        let rigid = brick(&mut app, Vec3::new(0.0, 0.75, 0.0), size, mass);
        // Nothing else damps a pendulum.
        app.world_mut().entity_mut(rigid).insert(LinearDamping(1.0));
        let top = Vec3::new(0.0, 0.05, 0.0);
        let below = app.world_mut().spawn(Attachment::new(body, LOW, rigid, top)).id();
        seconds(&mut app, 20.0);
        let pulls = force(&app, below) + mass * GRAVITY * DVec3::Y;
        let holds = force(&app, above) - (mass + CUBE.mass()) * GRAVITY * DVec3::Y;
        let speed = velocity(&app, rigid).length();
        println!(
            "ratio {ratio}: pull off by {:.1e}, hold by {:.1e}, {speed:.1e} m/s, rests {}, crate at {}",
            pulls.length() / (mass * GRAVITY),
            holds.length() / (mass * GRAVITY),
            state(&app, body).is_resting(),
            place(&app, rigid)
        );
        assert!(contacts(&app, body).0.is_empty(), "attached bodies do not touch");
        assert!(pulls.length() < 1e-2 * mass * GRAVITY && holds.length() < 1e-2 * mass * GRAVITY);
        // A heavy one goes on rocking below what avian and the body call rest, and wakes again.
        assert!(ratio > 1.0 || state(&app, body).is_resting(), "it rests");
        let there = place(&app, rigid);
        seconds(&mut app, 5.0);
        assert!((place(&app, rigid) - there).length() < 1e-3, "it goes on hanging");
        // Without the attachment it falls.
        app.world_mut().entity_mut(below).remove::<Attachment>();
        seconds(&mut app, 0.5);
        assert!(place(&app, rigid).y < there.y - 0.5, "it falls");
        assert!(app.world().get::<AttachmentForce>(below).is_none());
    }
}

#[test]
fn momentum_goes_both_ways() {
    for ratio in [0.1, 1.0, 10.0] {
        let mut app = avian(0.0);
        let mass = ratio * CUBE.mass();
        let rigid = brick(&mut app, Vec3::new(0.15, 0.0, 0.0), Vec3::splat(0.1), mass);
        let body = spawn_even(&mut app, Transform::default(), 0.0);
        app.update();
        app.update();
        let (right, left) = (Vec3::new(0.1, 0.0, 0.0), Vec3::new(-0.05, 0.0, 0.0));
        app.world_mut().spawn(Attachment::new(body, right, rigid, left));
        app.world_mut().get_mut::<LinearVelocity>(rigid).unwrap().0 = Vec3::new(0.0, 1.0, 0.5);
        let sum = |app: &App| {
            let (a, b) = (momentum(app, rigid), soft_momentum(app, body));
            [a[0] + b[0], a[1] + b[1]]
        };
        let (before, own) = (sum(&app), momentum(&app, rigid)[0]);
        let (mut lost, mut exchanged, mut apart) = ([0.0f64; 2], 0.0f64, 0.0f64);
        for _ in 0..600 {
            app.update();
            let now = sum(&app);
            for k in 0..2 {
                lost[k] = lost[k].max((now[k] - before[k]).length());
            }
            exchanged = exchanged.max((momentum(&app, rigid)[0] - own).length());
            apart = apart.max((place(&app, rigid) - center(&app, body)).length());
        }
        println!(
            "ratio {ratio}: exchanged {exchanged:.3} N s, lost {:.1e} and {:.1e}, {apart:.3} m apart",
            lost[0] / exchanged,
            lost[1] / exchanged
        );
        assert!(lost[0] < 1e-5 * exchanged && lost[1] < 1e-3 * exchanged, "{lost:?} of {exchanged}");
        assert!(apart < 0.3, "they come {apart} m apart");
    }
}

/// At twice the scale, and with another number of modes, which makes another body.
#[test]
fn attachments_go_on_with_another_scale_and_another_body() {
    for scale in [1.0f32, 2.0] {
        let mut app = earth();
        let body = spawn_even(&mut app, Transform::from_scale(Vec3::splat(scale)), GRAVITY);
        let mut holds = Vec::new();
        for x in [-1.0, 1.0] {
            let corner = Vec3::new(0.5 * x, 0.5, 0.0) * EDGE as f32;
            let at = Transform::from_translation(scale * corner);
            let top = app.world_mut().spawn((RigidBody::Static, Collider::sphere(0.01), at)).id();
            holds.push(app.world_mut().spawn(Attachment::new(body, corner, top, Vec3::ZERO)).id());
        }
        seconds(&mut app, 10.0);
        let held = |app: &mut App| {
            let mut mean = [DVec3::ZERO; 2];
            for _ in 0..120 {
                app.update();
                for (mean, hold) in mean.iter_mut().zip(&holds) {
                    *mean += force(app, *hold) / 120.0;
                }
            }
            mean
        };
        let before = held(&mut app);
        app.world_mut().get_mut::<ModalBody>(body).unwrap().modes = Some(6);
        seconds(&mut app, 10.0);
        for [left, right] in [before, held(&mut app)] {
            println!("scale {scale}: {left} and {right} N");
            let sum = (left + right - weight() * DVec3::Y).length();
            assert!(sum < 0.02 * weight() && left.y > 0.3 * weight() && right.y > 0.3 * weight());
        }
    }
}

#[test]
fn what_moves_by_itself_takes_the_cube_along() {
    let mut app = earth();
    let [top, body, attachment] = hang(&mut app, RigidBody::Kinematic);
    seconds(&mut app, 10.0);
    let (hung, began) = (center(&app, body), place(&app, top));
    // Avian would let a slower one fall asleep.
    app.world_mut().get_mut::<LinearVelocity>(top).unwrap().0 = 0.3 * Vec3::X;
    (0..20).for_each(|_| app.update());
    app.world_mut().get_mut::<LinearVelocity>(top).unwrap().0 = Vec3::ZERO;
    // It swings, which nothing but the attachment damps: the mean counts.
    let (mut way, mut mean) = (DVec3::ZERO, DVec3::ZERO);
    let count = 1200;
    for _ in 0..count {
        app.update();
        way += (center(&app, body) - hung) / f64::from(count);
        mean += force(&app, attachment) / f64::from(count);
    }
    println!("the middle of its swing went {way}, mean force {mean} N");
    let led = place(&app, top) - began;
    assert!(led.x > 0.09 && (way - led).length() < 5e-3, "it went {way} for {led}");
    assert!((mean - weight() * DVec3::Y).length() < 1e-2 * weight(), "{mean}");
}

#[test]
fn what_is_not_there_is_refused_and_the_cube_goes_on() {
    let mut app = earth();
    let [top, body, attachment] = hang(&mut app, RigidBody::Static);
    seconds(&mut app, 1.0);
    let height = center(&app, body).y;
    app.world_mut().entity_mut(top).despawn();
    seconds(&mut app, 0.5);
    assert!(center(&app, body).y < height - 0.5, "it falls");
    assert!(app.world().get::<Attachment>(attachment).is_none());
    // No patch of this radius, and no such triangle.
    let rigid = brick(&mut app, Vec3::ZERO, Vec3::splat(0.1), 1.0);
    let wrong = Attachment { radius: f64::NAN, ..Attachment::new(body, LOW, rigid, Vec3::ZERO) };
    app.world_mut().spawn(wrong);
    let nowhere = pliant_body::SurfacePlace::In { triangle: u32::MAX, weights: Vec3::ONE };
    let wrong = Attachment { place: nowhere, ..Attachment::new(body, LOW, rigid, Vec3::ZERO) };
    app.world_mut().spawn(wrong);
    app.world_mut().spawn(Attachment::new(body, LOW, rigid, Vec3::NAN));
    seconds(&mut app, 1.0);
    let refused = &app.world().resource::<Received>().refused;
    println!("{refused:?}");
    assert_eq!(refused.len(), 4, "each is told once: {refused:?}");
    assert!(center(&app, body).is_finite());
}
