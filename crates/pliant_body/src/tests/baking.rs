#![cfg(feature = "bake")]

use std::time::{Duration, Instant};

use bevy::{
    asset::RenderAssetUsages,
    mesh::{PrimitiveTopology, VertexAttributeValues},
    prelude::*,
};
use pliant_bake::{BakeCache, BakeConfig};
use pliant_mesh::shapes;

use super::{Received, app, model, refusals, state, tick};
use crate::{
    ATTRIBUTE_ANCHOR, ATTRIBUTE_STIFFNESS, BakeExtrasError, BakeFailed, BakePlugin, BakeProgress,
    BakeRequest, BakeSkin, BodyState, ModalAsset, ModalBody,
};

fn baking_app(cache: Option<BakeCache>) -> App {
    let mut app = app();
    app.add_plugins(BakePlugin { cache });
    app
}

/// Returns a bar of 1 m, fixed at one end, that bakes in about a tenth of a second.
fn bar(modes: usize) -> BakeRequest {
    let config = BakeConfig {
        name: "bar".into(),
        modes,
        anchors: vec!["x<0.001".parse().unwrap()],
        sites: Some(8),
        ..BakeConfig::linear()
    };
    BakeRequest { config, ..BakeRequest::new(shapes::bar([12, 3, 3], [1.0, 0.2, 0.2]).unwrap().into()) }
}

fn progress(app: &App, entity: Entity) -> BakeProgress {
    app.world().get::<BakeProgress>(entity).expect("a request has its progress").clone()
}

/// Runs frames until the bake of `entity` is over, and returns the progress in each frame.
fn wait(app: &mut App, entity: Entity) -> Vec<BakeProgress> {
    let (start, mut seen) = (Instant::now(), Vec::new());
    loop {
        app.update();
        let now = progress(app, entity);
        let over = matches!(now, BakeProgress::Done { .. } | BakeProgress::Failed { .. });
        seen.push(now);
        if over {
            return seen;
        }
        assert!(start.elapsed() < Duration::from_secs(300), "no end: {:?}", seen.last());
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// What Blender writes for an object with custom properties. All frequencies of an elastic body are
/// proportional to the root of stiffness over density.
#[test]
fn the_properties_of_a_model_say_how_it_is_baked() {
    let free = || {
        let mut request = bar(4);
        request.config.anchors.clear();
        request
    };
    let json = r#"{"anchor":"x<0.001","stiffness":45000.0,"density":500,"skein":[{"a":{"b":1}}]}"#;
    let request = free().with_extras(json).unwrap();
    let (plain, given) = (bar(4).config, request.config);
    assert_eq!((given.anchors.clone(), given.young, given.density), (plain.anchors.clone(), 45e3, 500.0));
    let frequencies = |config: &BakeConfig| {
        let tets = shapes::bar([12, 3, 3], [1.0, 0.2, 0.2]).unwrap();
        pliant_bake::bake(&tets, None, config, &mut |_, _| ()).unwrap().model.omega().to_vec()
    };
    let expected = (45e3 / 500.0 / (plain.young / plain.density)).sqrt();
    for (new, old) in frequencies(&given).iter().zip(frequencies(&plain)) {
        assert!((new / old - expected).abs() < 1e-6 * expected, "{new}, {old}, {expected}");
    }
    // Several anchors come on top of those of the request, and what is not given stays.
    let two = bar(4).with_extras(r#"{"anchor":["x>0.999","z < 0"]}"#).unwrap().config;
    assert_eq!((two.anchors.len(), two.young, two.density), (3, plain.young, plain.density));
    assert_eq!(bar(4).with_extras("{}").unwrap().config, plain);
    for wrong in [
        "",
        "7",
        "[]",
        r#"["y<0.01", 4e4, 950]"#,
        r#"{"anchor":3}"#,
        r#"{"density":"heavy"}"#,
        r#"{"stiffness":true}"#,
    ] {
        assert!(matches!(bar(4).with_extras(wrong), Err(BakeExtrasError::Json(_))), "{wrong}");
    }
    let error = bar(4).with_extras(r#"{"anchor":"left"}"#).unwrap_err();
    assert!(matches!(&error, BakeExtrasError::Anchor(of) if of.text == "left"), "{error}");
}

#[test]
fn a_request_becomes_a_body_while_the_frames_go_on() {
    let mut app = baking_app(None);
    let mut settings = ModalBody::default();
    settings.settings.gravity[1] = -1.0;
    let entity = app.world_mut().spawn((bar(6), settings)).id();
    let before = tick(&app);
    let seen = wait(&mut app, entity);
    // There was one tick per frame during the bake, so the frame in which the bake began did not
    // wait for its end.
    assert_eq!(tick(&app) - before, seen.len() as u64);
    assert!(matches!(seen[0], BakeProgress::Running { .. }), "{seen:?}");
    assert!(
        matches!(seen.last(), Some(BakeProgress::Done { cached: false, seconds, repair: None }) if *seconds > 0.0),
        "{seen:?}"
    );
    app.update();
    // The result equals that of a direct bake, and the settings beside the request are kept.
    let by_hand = pliant_bake::bake(
        &shapes::bar([12, 3, 3], [1.0, 0.2, 0.2]).unwrap(),
        None,
        &bar(6).config,
        &mut |_, _| (),
    )
    .unwrap();
    assert_eq!(state(&app, entity).model().hash(), by_hand.model.hash());
    assert_eq!(state(&app, entity).body().config().settings.gravity, [0.0, -1.0, 0.0]);
}

#[test]
fn an_unchanged_bake_is_read_and_a_changed_request_is_baked_again() {
    let folder = std::env::temp_dir().join(format!("pliant_body-bakes-{}", std::process::id()));
    let cache = BakeCache::new(&folder);
    let mut app = baking_app(Some(cache.clone()));
    let [first, second] = [0, 1].map(|_| app.world_mut().spawn(bar(5)).id());
    wait(&mut app, second);
    // Bakes run one at a time, in the order of the requests. The second found the result of the
    // first.
    assert!(matches!(progress(&app, first), BakeProgress::Done { cached: false, .. }));
    assert!(matches!(progress(&app, second), BakeProgress::Done { cached: true, .. }));
    app.update();
    assert_eq!(state(&app, first).model().hash(), state(&app, second).model().hash());

    app.world_mut().get_mut::<BakeRequest>(second).unwrap().config.modes = 7;
    wait(&mut app, second);
    app.update();
    assert_eq!((state(&app, first).body().mode_count(), state(&app, second).body().mode_count()), (5, 7));
    std::fs::remove_dir_all(folder).unwrap();
}

#[test]
fn what_cannot_be_baked_says_why_and_the_next_one_is_made() {
    let mut app = baking_app(None);
    let missing = app.world_mut().spawn((Name::new("jelly"), BakeRequest::file("no/such/jelly.obj"))).id();
    let mut nan = bar(5);
    nan.config.young = f64::NAN;
    let nan = app.world_mut().spawn(nan).id();
    let bare = app.world_mut().spawn(BakeRequest { skin: BakeSkin::Shape, ..bar(5) }).id();
    let good = app.world_mut().spawn(bar(5)).id();
    app.add_observer(|failed: On<BakeFailed>, mut received: ResMut<Received>| {
        received.0.push((failed.entity, failed.error.to_string()));
    });
    let seen = wait(&mut app, good);
    let received = refusals(&mut app);
    assert!(matches!(seen.last(), Some(BakeProgress::Done { .. })), "{seen:?}");
    assert_eq!(
        received.iter().map(|(entity, _)| *entity).collect::<Vec<_>>(),
        [missing, nan, bare],
        "{received:?}"
    );
    for ((entity, text), expected) in
        received.iter().zip(["jelly.obj", "Young's modulus", "expected a surface"])
    {
        assert!(text.contains(expected), "{text}");
        assert_eq!(progress(&app, *entity), BakeProgress::Failed { reason: text.clone() });
        assert!(app.world().get::<ModalBody>(*entity).is_none());
    }
    app.update();
    assert!(app.world().get::<BodyState>(good).is_some());
}

#[test]
fn a_dirty_surface_is_mended_and_says_how() {
    let (mut ball, _) = shapes::sphere(6, 0.5).unwrap().boundary();
    ball.triangles[7].swap(0, 1);
    ball.triangles.pop();
    let mut app = baking_app(None);
    let config = BakeConfig { modes: 3, sites: Some(8), ..BakeConfig::linear() };
    let entity =
        app.world_mut().spawn(BakeRequest { tets: 1000, config, ..BakeRequest::new(ball.into()) }).id();
    let seen = wait(&mut app, entity);
    let Some(BakeProgress::Done { repair: Some(repair), .. }) = seen.last() else { panic!("{seen:?}") };
    assert_eq!((repair.turned_triangles, repair.covered_holes), (1, 1), "{repair}");
}

#[test]
fn a_bake_without_a_word_has_the_material_of_large_strains() {
    let mut app = baking_app(None);
    let bar = shapes::bar([4, 1, 1], [0.4, 0.1, 0.1]).unwrap();
    let config = BakeConfig { sites: Some(8), ..BakeConfig::default() };
    let entity = app.world_mut().spawn(BakeRequest { config, ..BakeRequest::new(bar.into()) }).id();
    wait(&mut app, entity);
    app.update();
    assert!(state(&app, entity).body().model().material().is_some());
    let processed = crate::BakeSettings::default();
    let default = BakeConfig::default();
    assert_eq!((processed.modes, processed.material), (default.modes, default.material_name()));
}

#[test]
fn a_request_that_is_gone_makes_nothing_and_keeps_nobody_waiting() {
    let mut app = baking_app(None);
    let models = |app: &App| app.world().resource::<Assets<ModalAsset>>().len();
    let before = models(&app);
    let [running, waiting, withdrawn, last] =
        [5, 6, 7, 8].map(|modes| app.world_mut().spawn(bar(modes)).id());
    app.update();
    assert!(matches!(progress(&app, running), BakeProgress::Running { .. }));
    assert_eq!(progress(&app, waiting), BakeProgress::Waiting);
    app.world_mut().despawn(running);
    app.world_mut().despawn(waiting);
    app.world_mut().entity_mut(withdrawn).remove::<BakeRequest>();
    wait(&mut app, last);
    app.update();
    assert_eq!(state(&app, last).body().mode_count(), 8);
    assert_eq!(models(&app), before + 1, "of the others nothing was made");
    assert!(app.world().get::<BakeProgress>(withdrawn).is_none());
}

#[test]
fn a_new_bake_under_a_hand_is_held_on() {
    let mut app = baking_app(None);
    let entity = super::spawn(&mut app, model::bar(), ());
    let hand =
        app.world_mut().spawn((crate::Grab::new(3, 0.1, bevy::math::DVec3::ONE), crate::GrabOf(entity))).id();
    app.update();
    assert!(state(&app, entity).grab_id(hand).is_some());
    app.world_mut().entity_mut(entity).insert(bar(5));
    wait(&mut app, entity);
    super::steps(&mut app, 2);
    assert_eq!(state(&app, entity).body().mode_count(), 5);
    assert!(state(&app, entity).grab_id(hand).is_some(), "the hand holds the new body");
}

/// Returns a box of the engine with vertices of their own on each face, as modelers write them.
fn painted_box() -> Mesh {
    let mut mesh = Mesh::from(Cuboid::new(0.4, 0.1, 0.1)).with_computed_normals();
    let Some(VertexAttributeValues::Float32x3(positions)) = mesh.attribute(Mesh::ATTRIBUTE_POSITION) else {
        panic!("a box has positions");
    };
    let (stiff, anchor): (Vec<f32>, Vec<f32>) =
        positions.iter().map(|p| (4.0, if p[0] < 0.0 { 1.0 } else { 0.0 })).unzip();
    mesh.insert_attribute(ATTRIBUTE_STIFFNESS, stiff);
    mesh.insert_attribute(ATTRIBUTE_ANCHOR, anchor);
    mesh
}

fn of_mesh(mesh: Handle<Mesh>) -> BakeRequest {
    let config = BakeConfig { modes: 6, sites: Some(8), ..BakeConfig::linear() };
    BakeRequest { tets: 1_500, config, ..BakeRequest::mesh(mesh) }
}

/// A mesh becomes a body when it is loaded, with what is painted on it, and lets others pass until
/// then.
#[test]
fn a_painted_mesh_becomes_a_body() {
    let mut app = baking_app(None);
    app.init_asset::<Mesh>();
    let later = app.world().resource::<Assets<Mesh>>().reserve_handle();
    let waiting = app.world_mut().spawn(of_mesh(later.clone())).id();
    let other = app.world_mut().spawn(bar(4)).id();
    assert!(matches!(wait(&mut app, other).last(), Some(BakeProgress::Done { .. })));
    assert_eq!(progress(&app, waiting), BakeProgress::Waiting);
    app.world_mut().resource_mut::<Assets<Mesh>>().insert(&later, painted_box()).unwrap();
    assert!(matches!(wait(&mut app, waiting).last(), Some(BakeProgress::Done { .. })));

    // The same box without painting, fixed and stiffened by numbers.
    let config =
        BakeConfig { young: 4e5, anchors: vec!["x<0".parse().unwrap()], ..of_mesh(Handle::default()).config };
    let mut plain = painted_box();
    plain.remove_attribute(ATTRIBUTE_STIFFNESS);
    plain.remove_attribute(ATTRIBUTE_ANCHOR);
    let plain = app.world_mut().resource_mut::<Assets<Mesh>>().add(plain);
    let by_numbers = app.world_mut().spawn(BakeRequest { config, ..of_mesh(plain) }).id();
    assert!(matches!(wait(&mut app, by_numbers).last(), Some(BakeProgress::Done { .. })));
    app.update();
    let [painted, numbers] = [waiting, by_numbers].map(|entity| {
        let handle = app.world().get::<ModalBody>(entity).unwrap().model.clone();
        app.world().resource::<Assets<ModalAsset>>().get(&handle).unwrap().0.clone()
    });
    assert!(!painted.is_free());
    // The body's surface is that of the mesh, with its seams.
    assert_eq!(painted.surface().positions().len(), 24);
    for (a, b) in painted.omega().iter().zip(numbers.omega()) {
        // The border between fixed and free lies on an edge of the painting, where it is rounded.
        assert!((a / b - 1.0).abs() < 0.05, "{a} for {b} 1/s");
    }
}

#[test]
fn a_mesh_without_triangles_is_refused() {
    let mut app = baking_app(None);
    app.init_asset::<Mesh>();
    let lines = Mesh::new(PrimitiveTopology::LineList, RenderAssetUsages::default())
        .with_inserted_attribute(Mesh::ATTRIBUTE_POSITION, vec![[0.0f32; 3]; 2]);
    let open = Mesh::from(Plane3d::default().mesh().size(1.0, 1.0));
    for (mesh, expected) in [(lines, "a list of triangles"), (open, "meshed")] {
        let mesh = app.world_mut().resource_mut::<Assets<Mesh>>().add(mesh);
        let entity = app.world_mut().spawn(of_mesh(mesh)).id();
        match wait(&mut app, entity).last() {
            Some(BakeProgress::Failed { reason }) => assert!(reason.contains(expected), "{reason}"),
            other => panic!("{other:?}"),
        }
    }
}
