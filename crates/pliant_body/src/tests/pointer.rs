use bevy::{
    camera::{
        ComputedCameraValues, NormalizedRenderTarget, RenderTarget, RenderTargetInfo,
        visibility::RenderLayers,
    },
    math::DVec3,
    picking::{
        InteractionPlugin, PickingPlugin,
        events::{Click, Over, Pointer},
        pointer::{Location, PointerAction, PointerButton, PointerId, PointerInput},
    },
    prelude::*,
    window::{PrimaryWindow, WindowRef},
};

use super::{app, model, spawn_with, state, steps};
use crate::{
    Driven, Grab, GrabOf, NoPointerGrab, PointerGrab, PointerGrabPlugin, PointerHeld, SurfaceHit, VisualState,
};

/// Returns a camera over the whole window.
fn camera(order: isize) -> Camera {
    let size = RenderTargetInfo { physical_size: UVec2::new(800, 600), scale_factor: 1.0 };
    let clip_from_view = Mat4::perspective_infinite_reverse_rh(1.0, 800.0 / 600.0, 0.1);
    let computed = ComputedCameraValues { clip_from_view, target_info: Some(size), ..Default::default() };
    Camera { computed, order, ..Default::default() }
}

/// Returns an app with a camera and the bar as a remote body.
///
/// The camera is two meters from the tip of the bar and looks along -z at a window of 800 x 600.
fn scene() -> (App, Entity, Entity) {
    let mut app = app();
    app.add_plugins((PickingPlugin, InteractionPlugin, PointerGrabPlugin));
    app.world_mut().spawn(PointerId::Mouse);
    let window = Window { resolution: (800, 600).into(), ..Default::default() };
    let window = app.world_mut().spawn((window, PrimaryWindow)).id();
    app.world_mut().spawn((camera(0), Transform::from_xyz(1.0, 0.0, 2.1)));
    let body = spawn_with(
        &mut app,
        model::bar(),
        |body| body.settings.warp = false,
        (Driven::Remote, InheritedVisibility::VISIBLE),
    );
    (app, window, body)
}

/// Where `at` is in the window. `at` is in meters from the middle of the view in the plane z = 0.1,
/// two meters in front of the camera.
fn location(app: &App, window: Entity, at: Vec2) -> Location {
    let pixels_a_meter = 300.0 / (2.0 * 0.5f32.tan());
    let position = Vec2::new(400.0, 300.0) + Vec2::new(at.x, -at.y) * pixels_a_meter;
    assert!(app.world().get::<Window>(window).is_some());
    let target = RenderTarget::Window(WindowRef::Entity(window)).normalize(None);
    Location { target: target.unwrap_or(NormalizedRenderTarget::None { width: 0, height: 0 }), position }
}

/// Moves a pointer to `at`, with its primary button pressed or released.
fn point_with(app: &mut App, pointer: PointerId, window: Entity, at: Vec2, down: bool) {
    let location = location(app, window, at);
    let button = PointerButton::Primary;
    let was = app.world_mut().query::<(&PointerId, &bevy::picking::pointer::PointerPress)>();
    let was = { was }.iter(app.world()).any(|(id, press)| *id == pointer && press.is_primary_pressed());
    let mut actions = vec![PointerAction::Move { delta: Vec2::ZERO }];
    match (was, down) {
        (false, true) => actions.push(PointerAction::Press(button)),
        (true, false) => actions.push(PointerAction::Release(button)),
        _ => {}
    }
    for action in actions {
        app.world_mut().write_message(PointerInput::new(pointer, location.clone(), action));
    }
    app.update();
}

fn point(app: &mut App, window: Entity, at: Vec2, down: bool) {
    point_with(app, PointerId::Mouse, window, at, down);
}

fn held(app: &mut App) -> Option<(Entity, Grab, GrabOf)> {
    let mut query = app.world_mut().query_filtered::<(Entity, &Grab, &GrabOf), With<PointerHeld>>();
    query.single(app.world()).ok().map(|(entity, grab, of)| (entity, *grab, *of))
}

#[test]
fn the_pointer_takes_the_surface_where_it_is_now_and_drags_it_in_the_plane_that_faces_the_camera() {
    let (mut app, window, body) = scene();
    // The bar is bent up until the tip is half a meter higher, so that nothing is left to grab at
    // the rest shape.
    let q = 0.5 / (5.0 / model::MASS).sqrt();
    app.world_mut().get_mut::<VisualState>(body).unwrap().snap(&[q, 0.0, 0.0, 0.0]).unwrap();
    point(&mut app, window, Vec2::new(-0.02, 0.0), true);
    assert_eq!(held(&mut app), None);
    point(&mut app, window, Vec2::new(-0.02, 0.0), false);

    point(&mut app, window, Vec2::new(-0.1, 0.42), true);
    let (_, grab, of) = held(&mut app).expect("the bent bar is there");
    assert_eq!(of, GrabOf(body));
    assert_eq!(grab.radius, 0.06 * state(&app, body).model().size());
    let at = state(&app, body).model().surface().positions()[grab.vertex as usize];
    assert!(at[0] > 0.8 && at[2] == 0.1, "the nearest vertex is on the side that faces the camera: {at:?}");

    // The target starts at the patch, not at the pointer, and moves by the same distance as the
    // pointer.
    let start = grab.target;
    point(&mut app, window, Vec2::new(0.1, 0.52), true);
    let (_, moved, _) = held(&mut app).unwrap();
    assert!(
        (moved.target - start - DVec3::new(0.2, 0.1, 0.0)).length() < 1e-3,
        "{} from {start}",
        moved.target
    );

    point(&mut app, window, Vec2::new(0.1, 0.52), false);
    assert_eq!(held(&mut app), None);
}

#[test]
fn what_is_beside_hidden_from_the_pointer_or_switched_off_is_not_taken() {
    let (mut app, window, body) = scene();
    point(&mut app, window, Vec2::new(0.5, 0.5), true);
    assert_eq!(held(&mut app), None, "beside");
    point(&mut app, window, Vec2::ZERO, false);

    app.world_mut().entity_mut(body).insert(NoPointerGrab);
    point(&mut app, window, Vec2::new(-0.05, 0.0), true);
    assert_eq!(held(&mut app), None, "a ghost");
    point(&mut app, window, Vec2::ZERO, false);

    app.world_mut().entity_mut(body).remove::<NoPointerGrab>();
    app.world_mut().resource_mut::<PointerGrab>().enabled = false;
    point(&mut app, window, Vec2::new(-0.05, 0.0), true);
    assert_eq!(held(&mut app), None, "switched off");
    point(&mut app, window, Vec2::ZERO, false);

    app.world_mut().resource_mut::<PointerGrab>().enabled = true;
    point(&mut app, window, Vec2::new(-0.05, 0.0), true);
    assert!(held(&mut app).is_some());
    app.world_mut().resource_mut::<PointerGrab>().enabled = false;
    steps(&mut app, 1);
    assert_eq!(held(&mut app), None, "switching off lets go");
}

#[test]
fn a_body_that_goes_while_it_is_dragged_takes_the_grab_along() {
    let (mut app, window, body) = scene();
    point(&mut app, window, Vec2::new(-0.05, 0.0), true);
    assert!(held(&mut app).is_some());
    app.world_mut().despawn(body);
    point(&mut app, window, Vec2::new(0.0, 0.1), true);
    assert_eq!(held(&mut app), None);
}

#[test]
fn a_camera_with_no_body_under_the_pointer_leaves_it_to_the_one_behind() {
    let here = Transform::from_xyz(1.0, 0.0, 2.1);
    let away = here.looking_to(Vec3::Z, Vec3::Y);
    let all = RenderLayers::layer(0);
    // The cases are an interface that looks elsewhere, one that looks at the same place but at
    // other layers, a second camera of the scene, and the scene on its own layer.
    for (front, layers, of_scene, of_body, through_front) in [
        (away, &all, &all, &all, Some(false)),
        (here, &RenderLayers::layer(5), &all, &all, Some(false)),
        (here, &RenderLayers::from_layers(&[0, 5]), &all, &all, Some(true)),
        (away, &all, &RenderLayers::layer(3), &RenderLayers::layer(3), Some(false)),
        (away, &all, &RenderLayers::layer(3), &all, None),
    ] {
        let (mut app, window, body) = scene();
        let mut cameras = app.world_mut().query_filtered::<Entity, With<Camera>>();
        let back = cameras.single(app.world()).unwrap();
        let front = app.world_mut().spawn((camera(1), front, layers.clone())).id();
        app.world_mut().entity_mut(back).insert(of_scene.clone());
        app.world_mut().entity_mut(body).insert(of_body.clone());
        steps(&mut app, 1);
        point(&mut app, window, Vec2::new(-0.05, 0.0), true);
        let through = held(&mut app).map(|(grab, ..)| app.world().get::<PointerHeld>(grab).unwrap().camera);
        assert_eq!(through, through_front.map(|through| if through { front } else { back }));
        let Some(start) = held(&mut app).map(|(_, grab, _)| grab.target) else { continue };
        // The drag uses the camera through which the body was grabbed.
        point(&mut app, window, Vec2::new(0.05, 0.0), true);
        let way = held(&mut app).unwrap().1.target - start;
        assert!((way - DVec3::new(0.1, 0.0, 0.0)).length() < 1e-3, "{way}");
    }
}

#[test]
fn the_mark_at_the_target_is_as_large_as_the_body_makes_it() {
    let mark = |scale: f32| {
        let (mut app, window, body) = scene();
        let place = Transform::from_xyz(1.0 - scale, 0.0, 0.0).with_scale(Vec3::splat(scale));
        app.world_mut().entity_mut(body).insert(place);
        steps(&mut app, 2);
        point(&mut app, window, Vec2::new(-0.05, 0.0), true);
        let (grab, ..) = held(&mut app).expect("it is under the pointer");
        app.world().get::<PointerHeld>(grab).unwrap().mark
    };
    assert!((mark(2.0) / mark(1.0) - 2.0).abs() < 1e-5);
}

#[test]
fn an_app_observes_pointers_on_the_deformed_surface() {
    #[derive(Resource, Default)]
    struct Seen(Vec<(Entity, Option<Vec3>, Option<Vec3>, Option<u32>)>, usize);
    let (mut app, window, body) = scene();
    let q = 0.5 / (5.0 / model::MASS).sqrt();
    app.world_mut().get_mut::<VisualState>(body).unwrap().snap(&[q, 0.0, 0.0, 0.0]).unwrap();
    app.init_resource::<Seen>();
    app.world_mut().entity_mut(body).observe(|over: On<Pointer<Over>>, mut seen: ResMut<Seen>| {
        let hit = &over.hit;
        let vertex = hit.extra_as::<SurfaceHit>().map(|hit| hit.vertex);
        seen.0.push((over.entity, hit.position, hit.normal, vertex));
    });
    app.world_mut().entity_mut(body).observe(|_: On<Pointer<Click>>, mut seen: ResMut<Seen>| seen.1 += 1);
    // Where the rest shape was there is nothing.
    point(&mut app, window, Vec2::new(-0.02, 0.0), false);
    assert!(app.world().resource::<Seen>().0.is_empty());
    point(&mut app, window, Vec2::new(-0.1, 0.42), false);
    let seen = app.world().resource::<Seen>().0.clone();
    let [(entity, Some(point_hit), Some(normal), Some(vertex))] = seen[..] else { panic!("{seen:?}") };
    assert_eq!(entity, body);
    assert!((point_hit - Vec3::new(0.9, 0.42, 0.1)).length() < 0.01, "{point_hit}");
    assert!(normal.z > 0.99 && normal.is_normalized(), "{normal}");
    let at = state(&app, body).model().surface().positions()[vertex as usize];
    assert!(at[0] > 0.8 && at[2] == 0.1, "{at:?}");
    point(&mut app, window, Vec2::new(-0.1, 0.42), true);
    point(&mut app, window, Vec2::new(-0.1, 0.42), false);
    assert_eq!(app.world().resource::<Seen>().1, 1, "one click");
}

#[test]
fn every_finger_holds_the_body_by_itself() {
    let (mut app, window, body) = scene();
    let fingers = [PointerId::Touch(1), PointerId::Touch(2)];
    let entities = fingers.map(|finger| app.world_mut().spawn(finger).id());
    point_with(&mut app, fingers[0], window, Vec2::new(-0.05, 0.0), true);
    point_with(&mut app, fingers[1], window, Vec2::new(-0.4, 0.0), true);
    let targets = |app: &mut App| {
        let mut query = app.world_mut().query::<(&PointerHeld, &Grab, &GrabOf)>();
        let mut all: Vec<_> =
            query.iter(app.world()).map(|(held, grab, of)| (held.pointer, grab.target, of.0)).collect();
        all.sort_by_key(|(pointer, ..)| *pointer != fingers[0]);
        all
    };
    let start = targets(&mut app);
    assert_eq!(start.iter().map(|t| (t.0, t.2)).collect::<Vec<_>>(), fingers.map(|f| (f, body)));
    // One moves, the other stays.
    point_with(&mut app, fingers[0], window, Vec2::new(0.05, 0.0), true);
    let moved = targets(&mut app);
    assert!((moved[0].1 - start[0].1 - DVec3::new(0.1, 0.0, 0.0)).length() < 1e-3);
    assert_eq!(moved[1].1, start[1].1);
    // One is lifted, the other is taken away without a word.
    point_with(&mut app, fingers[0], window, Vec2::new(0.05, 0.0), false);
    assert_eq!(targets(&mut app).len(), 1);
    app.world_mut().despawn(entities[1]);
    app.update();
    assert!(targets(&mut app).is_empty());
}

#[test]
fn without_picking_nothing_is_picked_and_nothing_fails() {
    let mut app = app();
    app.add_plugins(PointerGrabPlugin);
    steps(&mut app, 2);
    assert_eq!(held(&mut app), None);
}
