//! Where bodies touch: arrows in the scene and sums in the plots.

use bevy::{math::DVec3, prelude::*, time::TimeUpdateStrategy, transform::TransformPlugin};
use pliant_body::{BodyState, ModalBody, PliantBodyPlugin};
use pliant_contact::{BodyContacts, ContactPlugin, ContactPoint, Obstacle};
use rerun::external::re_log_encoding::rrd::DecoderApp;

use crate::{
    RerunPlugin, RerunStats,
    frame::{RecordedContact, RecordedFrame},
    tests::{body, bytes_of_colors, frame, numbers, recorder, rows, scratch, until},
};

/// A contact of 1 N.
pub(crate) fn touching() -> BodyContacts {
    BodyContacts(vec![ContactPoint {
        other: Entity::PLACEHOLDER,
        vertex: 0,
        point: DVec3::ZERO,
        normal: DVec3::Y,
        force: DVec3::Y,
        penetration: 0.0,
        sliding: false,
    }])
}

#[test]
fn a_force_is_an_arrow_that_tells_whether_it_slides_and_none_is_longer_than_the_body() {
    let (mut recorder, stream, storage) = recorder();
    let place = |force: f32, sliding| RecordedContact { point: [0.0; 3], force: [0.0, force, 0.0], sliding };
    // The body weighs a kilogram.
    let places = vec![place(9.806_65, false), place(1e30, true)];
    let mut first = frame(1, &body(), 0.0);
    (first.contacts, first.contacts_changed) = (places, true);
    recorder.log(&first).unwrap();
    recorder.log(&RecordedFrame { tick: 2, ..RecordedFrame::default() }).unwrap();
    recorder.log(&RecordedFrame { tick: 3, contacts_changed: true, ..RecordedFrame::default() }).unwrap();
    let size = body().model.size() as f32;
    recorder.end();
    drop(stream);
    let messages = storage.take();
    let path = "/world/contacts";
    assert_eq!(rows(&messages, path, "vectors"), 2, "what has not changed is not drawn again");
    assert_eq!(bytes_of_colors(&messages, path), [[0, 158, 115], [213, 94, 0]]);
    let arrows = crate::tests::vectors(&messages, path, "vectors");
    assert_eq!(arrows.len(), 2, "and none at the end");
    let near = |a: f32, b: f32| (a / b - 1.0).abs() < 1e-5;
    assert!(near(arrows[0][1], 0.5 * size) && near(arrows[1][1], size), "{arrows:?}");
}

#[test]
fn a_body_that_lies_on_the_floor_has_its_weight_in_the_plot() {
    let path = scratch("contact");
    let mut app = App::new();
    app.add_plugins((
        MinimalPlugins,
        AssetPlugin { file_path: concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets").into(), ..default() },
        TransformPlugin,
        PliantBodyPlugin::default(),
        ContactPlugin::default(),
    ))
    .insert_resource(Time::<Fixed>::from_seconds(1.0 / 60.0))
    .insert_resource(TimeUpdateStrategy::FixedTimesteps(1))
    .add_plugins(RerunPlugin::file(&path).with_queue(2048));
    app.finish();
    app.cleanup();
    app.world_mut().spawn(Obstacle::Floor);
    let jack = app.world().resource::<AssetServer>().load("jack.modal");
    let mut body = ModalBody::new(jack);
    body.settings.gravity = [0.0, -9.81, 0.0];
    let entity = app.world_mut().spawn((body, Name::new("jack"), Transform::from_xyz(0.0, 0.4, 0.0))).id();
    until("the jack rests on the floor", || {
        app.update();
        let state = app.world().get::<BodyState>(entity).ok_or("no body")?;
        let touches = app.world().get::<BodyContacts>(entity).is_some_and(|all| !all.0.is_empty());
        if touches && state.is_resting() { Ok(()) } else { Err("it moves") }
    });
    let weight = app.world().get::<BodyState>(entity).unwrap().model().mass() * 9.81;
    let places = app.world().get::<BodyContacts>(entity).unwrap().0.len() as f64;
    // A body that is removed takes its arrows along.
    app.world_mut().entity_mut(entity).despawn();
    app.update();
    assert_eq!(app.world().resource::<RerunStats>().dropped, 0);
    drop(app);
    let file = std::io::BufReader::new(std::fs::File::open(&path).unwrap());
    let messages: Vec<_> = DecoderApp::decode_lazy(file).map(Result::unwrap).collect();
    std::fs::remove_file(path).unwrap();
    let last = |path: &str| *numbers(&messages, path, "scalars").last().unwrap();
    let force = last("/contact/jack");
    assert!((force / weight - 1.0).abs() < 1e-3, "{force} N where it weighs {weight} N");
    assert!((0.0..2e-3).contains(&last("/contact/jack/depth")));
    assert_eq!(last("/contact/jack/places"), places);
    let arrows = crate::tests::row_lengths(&messages, "/world/contacts", "vectors");
    assert!(arrows.len() > 10 && arrows.contains(&(places as usize)), "{arrows:?}");
    assert_eq!(arrows.last(), Some(&0), "{arrows:?}");
}
