use bevy::{math::DVec3, prelude::*};

use super::{app, frames_of, model, refusals, spawn, state, steps};
use crate::{Driven, Grab, GrabOf, SurfaceAnchor, SurfacePlace, VisualState};

fn sit(app: &mut App, body: Entity, point: Vec3, bundle: impl Bundle) -> Entity {
    app.world_mut().spawn((SurfaceAnchor::nearest(body, point), bundle)).id()
}

fn global(app: &App, entity: Entity) -> GlobalTransform {
    *app.world().get::<GlobalTransform>(entity).unwrap()
}

/// Position and normal of an anchor's place by the whole surface that is shown, in the body's axes.
fn shown(app: &App, body: Entity, anchor: Entity) -> [Vec3; 2] {
    let SurfacePlace::In { triangle, weights } = app.world().get::<SurfaceAnchor>(anchor).unwrap().place
    else {
        panic!("the place was not found");
    };
    let positions = state(app, body).positions(app.world().get::<VisualState>(body).unwrap());
    let corners = state(app, body).model().surface().triangles()[triangle as usize];
    let [a, b, c] = corners.map(|v| Vec3::from(positions[v as usize]));
    [a * weights.x + b * weights.y + c * weights.z, (b - a).cross(c - a).normalize()]
}

/// Largest deviation of an anchor from the surface that is shown, m, and of its y axis from the
/// normal.
fn off(app: &App, body: Entity, anchor: Entity) -> [f32; 2] {
    let [at, normal] = shown(app, body, anchor);
    let (body, anchor) = (global(app, body), global(app, anchor));
    let normal = body.rotation() * normal;
    [(body.transform_point(at) - anchor.translation()).length(), (normal - *anchor.up()).length()]
}

#[test]
fn an_entity_sits_at_the_nearest_place_in_the_axes_of_the_surface() {
    let mut app = app();
    let at = Transform::from_xyz(1.0, 2.0, 3.0)
        .with_rotation(Quat::from_rotation_z(0.4))
        .with_scale(Vec3::splat(2.0));
    let body = spawn(&mut app, model::bar(), at);
    // Above the top of the bar, with a scale of its own.
    let hat = sit(&mut app, body, Vec3::new(0.52, 0.4, 0.03), Transform::from_scale(Vec3::splat(3.0)));
    // At its end, where the normal is the body's x axis.
    let lamp = sit(&mut app, body, Vec3::new(1.3, 0.0, 0.01), ());
    steps(&mut app, 2);
    let expected = at.transform_point(Vec3::new(0.52, 0.1, 0.03));
    let placed = global(&app, hat).compute_transform();
    assert!(placed.translation.abs_diff_eq(expected, 1e-5), "{} {expected}", placed.translation);
    assert!(placed.rotation.abs_diff_eq(at.rotation, 1e-5), "{}", placed.rotation);
    assert!(placed.scale.abs_diff_eq(Vec3::splat(3.0), 1e-5), "{}", placed.scale);
    let placed = global(&app, lamp).compute_transform();
    assert!(placed.up().abs_diff_eq(at.rotation * Vec3::X, 1e-5), "{:?}", placed.up());
    assert!(placed.right().abs_diff_eq(Vec3::Z, 1e-5), "{:?}", placed.right());
    assert!(refusals(&mut app).is_empty());
}

#[test]
fn an_anchor_follows_a_pulled_body_in_every_frame_and_turns_with_it() {
    let mut app = app();
    frames_of(&mut app, 0.31);
    let body = spawn(&mut app, model::bar(), Transform::from_xyz(0.0, 1.0, 0.0));
    let group = app.world_mut().spawn((Transform::from_xyz(4.0, 0.0, 0.0), Visibility::default())).id();
    let place = Vec3::new(0.97, 0.1, 0.02);
    let anchors = [
        sit(&mut app, body, place, ()),
        sit(&mut app, body, place, ChildOf(body)),
        sit(&mut app, body, place, ChildOf(group)),
    ];
    steps(&mut app, 4);
    let start = global(&app, anchors[0]);
    app.world_mut().spawn((Grab::new(model::tip(), 0.1, DVec3::new(0.9, 1.4, 0.1)), GrabOf(body)));
    for _ in 0..400 {
        app.update();
        for anchor in anchors {
            let [way, turn] = off(&app, body, anchor);
            assert!(way < 2e-6 && turn < 1e-5, "{way} m, {turn}");
        }
    }
    let end = global(&app, anchors[0]);
    let way = end.translation() - start.translation();
    assert!(way.y > 0.25, "{way}");
    // The tip is bent up: it turns about z by the slope of the bending mode, 2 y / L.
    let angle = end.right().y.atan2(end.right().x);
    assert!((angle - 2.0 * 0.4).abs() < 0.15, "{angle}");
}

#[test]
fn an_anchor_follows_what_is_shown_of_a_remote_body() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), Driven::Remote);
    let anchor = sit(&mut app, body, Vec3::new(0.9, 0.1, 0.0), ());
    steps(&mut app, 2);
    let rest = global(&app, anchor).translation();
    app.world_mut().get_mut::<VisualState>(body).unwrap().snap(&[0.5, 0.0, 0.2, 0.0]).unwrap();
    app.update();
    let [way, turn] = off(&app, body, anchor);
    assert!(way < 2e-6 && turn < 1e-5, "{way} m, {turn}");
    assert!((global(&app, anchor).translation() - rest).length() > 0.1);
}

#[test]
fn an_anchor_of_a_resting_body_writes_nothing() {
    #[derive(Resource, Default)]
    struct Writes(usize);
    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    sit(&mut app, body, Vec3::new(0.9, 0.1, 0.0), Name::new("hat"));
    steps(&mut app, 60);
    app.init_resource::<Writes>().add_systems(
        Last,
        |moved: Query<(), (Changed<Transform>, With<SurfaceAnchor>)>, mut writes: ResMut<Writes>| {
            writes.0 += moved.iter().count();
        },
    );
    steps(&mut app, 2);
    app.world_mut().resource_mut::<Writes>().0 = 0;
    steps(&mut app, 20);
    assert_eq!(app.world().resource::<Writes>().0, 0);
}

#[test]
fn an_anchor_whose_body_or_place_is_gone_stays_and_says_so_once() {
    let mut app = app();
    let body = spawn(&mut app, model::bar(), ());
    let hat = sit(&mut app, body, Vec3::new(0.9, 0.1, 0.0), ());
    steps(&mut app, 2);
    let at = global(&app, hat);
    app.world_mut().entity_mut(body).despawn();
    steps(&mut app, 3);
    assert_eq!(global(&app, hat), at);
    assert!(app.world().get::<SurfaceAnchor>(hat).is_none());
    let received = refusals(&mut app);
    assert!(
        received.len() == 1 && received[0].0 == hat && received[0].1.contains("stays where it is"),
        "{received:?}"
    );

    let body = spawn(&mut app, model::bar(), ());
    let places = [
        SurfacePlace::Nearest(Vec3::NAN),
        SurfacePlace::In { triangle: u32::MAX, weights: Vec3::X },
        SurfacePlace::In { triangle: 0, weights: Vec3::INFINITY },
    ];
    for place in places {
        let anchor = app.world_mut().spawn(SurfaceAnchor { body, place }).id();
        steps(&mut app, 3);
        assert!(app.world().get::<SurfaceAnchor>(anchor).is_none());
        assert_eq!(refusals(&mut app).len(), 1, "{place:?}");
    }
    // A body that is still to be loaded is waited for.
    let later = app.world_mut().spawn(crate::ModalBody::default()).id();
    let anchor = sit(&mut app, later, Vec3::ZERO, ());
    steps(&mut app, 3);
    assert!(app.world().get::<SurfaceAnchor>(anchor).is_some() && refusals(&mut app).is_empty());
}
