//! Valid scenes become bodies, hands, sessions, devices and recordings.

use std::time::{Duration, Instant};

use bevy::prelude::*;
use bevy::time::TimeUpdateStrategy;
use pliant::body::{BodyState, Grab, GrabForce, ModalBody};
use pliant::prelude::PliantPlugins;
use pliant::scene::*;

use super::{ASSETS, GOOD, with};

fn app() -> App {
    let mut app = App::new();
    app.add_plugins((
        MinimalPlugins,
        AssetPlugin { file_path: ASSETS.into(), ..default() },
        TransformPlugin,
        bevy::diagnostic::DiagnosticsPlugin,
        PliantPlugins::default().build().disable::<pliant::body::PointerGrabPlugin>(),
    ))
    .insert_resource(TimeUpdateStrategy::ManualDuration(Duration::from_secs_f64(1.0 / 64.0)));
    #[cfg(feature = "render")]
    app.init_asset::<Mesh>().init_asset::<StandardMaterial>();
    app
}

/// Runs the app until `done`, with time for files that are read on other threads.
fn run_until(app: &mut App, what: &str, mut done: impl FnMut(&mut World) -> bool) {
    let start = Instant::now();
    loop {
        app.update();
        if done(app.world_mut()) {
            return;
        }
        assert!(start.elapsed() < Duration::from_secs(120), "{what} did not come");
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn failures(world: &mut World) -> Vec<SceneError> {
    world.resource_mut::<Messages<SceneFailed>>().drain().map(|failed| failed.error).collect()
}

#[test]
fn a_scene_becomes_bodies_and_hands_that_hold_and_let_go() {
    let mut app = app();
    let text = GOOD.replacen(
        "stiffness: 200",
        "stiffness: 200, from: 0.25, until: 0.75, pull: (0, 0, 0.05), rise: 0.1",
        1,
    );
    app.add_plugins(SceneFilePlugin::open(SceneFile::from_ron(&text, "my.ron").unwrap()).unwrap());
    let hand = |world: &mut World, name: &str| {
        let mut hands = world.query::<(&Name, &Grab, &GrabForce)>();
        hands.iter(world).find(|(own, ..)| own.as_str() == name).map(|(_, grab, force)| (*grab, *force))
    };
    run_until(&mut app, "the left hand", |world| hand(world, "left").is_some());
    // At 64 ticks per second, the right hand waits for 16 ticks, a quarter of a second.
    assert!(hand(app.world_mut(), "right").is_none());
    for _ in 0..16 {
        app.update();
    }
    let (taken, _) = hand(app.world_mut(), "right").unwrap();
    for _ in 0..16 {
        app.update();
    }
    let (grab, force) = hand(app.world_mut(), "right").unwrap();
    assert_eq!(grab.stiffness, Some(200.0));
    assert!((grab.target - taken.target).length() <= 0.05 + 1e-6);
    assert!((grab.target.z - taken.target.z - 0.05).abs() < 0.01, "{grab:?} {taken:?}");
    // The body pulls back on the moved hand, but not harder than the hand's spring allows.
    assert!(force.force.z < -0.01 && force.force.length() <= 200.0 * 0.05, "{force:?}");
    for _ in 0..24 {
        app.update();
    }
    assert!(hand(app.world_mut(), "right").is_none() && hand(app.world_mut(), "left").is_some());
    let world = app.world_mut();
    let places: Vec<(String, f32)> = world
        .query::<(&Name, &Transform, &BodyState)>()
        .iter(world)
        .map(|(name, place, _)| (name.to_string(), place.translation.x))
        .collect();
    assert!(places.contains(&("pip".into(), 0.0)) && places.contains(&("bud".into(), 0.5)), "{places:?}");
    // Despawning the instance despawns all its parts.
    let instance = world.query_filtered::<Entity, With<SceneInstance>>().single(world).unwrap();
    world.despawn(instance);
    assert_eq!(world.query::<&ModalBody>().iter(world).count(), 0);
    assert_eq!(world.query::<&Grab>().iter(world).count(), 0);
}

#[test]
fn a_file_of_the_scene_that_is_not_there_is_told_with_its_entry_and_line() {
    let mut app = app();
    let text = GOOD.replacen("bud.modal", "bad.modal", 1);
    app.add_plugins(SceneFilePlugin::open(SceneFile::from_ron(&text, "my.ron").unwrap()).unwrap());
    let mut errors = Vec::new();
    run_until(&mut app, "the failure", |world| {
        errors.extend(failures(world));
        !errors.is_empty()
    });
    assert_eq!(errors.len(), 1, "{errors:?}");
    let message = errors[0].to_string();
    assert!(message.starts_with("my.ron:5:30: the body `bud` cannot be loaded: "), "{message}");
    assert!(message.contains("bad.modal"), "{message}");
    assert_eq!(errors[0].kind, SceneErrorKind::Asset);
    // The other body is held regardless of the failure.
    run_until(&mut app, "the hands", |world| world.query::<(&Grab, &GrabForce)>().iter(world).count() == 2);
}

#[test]
fn a_vertex_that_the_body_does_not_have_is_told_once() {
    let mut app = app();
    let text = GOOD.replacen("Toward((1, 0, 0))", "Vertex(4000000)", 1);
    app.add_plugins(SceneFilePlugin::open(SceneFile::from_ron(&text, "my.ron").unwrap()).unwrap());
    let mut errors = Vec::new();
    run_until(&mut app, "the failure", |world| {
        errors.extend(failures(world));
        !errors.is_empty()
    });
    for _ in 0..10 {
        app.update();
        errors.extend(failures(app.world_mut()));
    }
    assert_eq!(errors.len(), 1, "{errors:?}");
    let message = errors[0].to_string();
    assert!(
        message.starts_with(
            "my.ron:8:44: the grab `left` cannot hold `pip`: expected a vertex of the surface, 0 to "
        ),
        "{message}"
    );
}

#[test]
fn a_game_loads_scenes_as_assets_where_it_likes() {
    let mut app = app();
    app.add_plugins(SceneFilePlugin::default());
    let files: [Handle<SceneFile>; 2] = {
        let assets = app.world().resource::<AssetServer>();
        [assets.load("scenes/solo.ron"), assets.load("pip.ron")]
    };
    let place = Transform::from_xyz(2.0, 0.0, 0.0);
    let [solo, wrong] = files.map(|file| app.world_mut().spawn((SceneInstance(file), place)).id());
    let mut errors = Vec::new();
    run_until(&mut app, "the body and the failure", |world| {
        errors.extend(failures(world));
        let body = world.query::<(&SceneBody, &BodyState, &GlobalTransform)>().iter(world).next();
        body.is_some_and(|(.., at)| at.translation().x > 1.0) && !errors.is_empty()
    });
    // The file describes a shape, not a scene; the message has the line of the mistake.
    assert_eq!(errors.len(), 1, "{errors:?}");
    assert!(errors[0].to_string().starts_with("pip.ron:"), "{}", errors[0]);
    assert!(errors[0].position.is_some());
    assert!(app.world().get::<SceneParts>(wrong).is_none());
    assert!(!app.world().get::<SceneParts>(solo).unwrap().entities().is_empty());
}

/// Replaces the asset by another text, as a file watcher does.
#[test]
fn a_scene_that_changes_is_made_anew() {
    let mut app = app();
    app.add_plugins(SceneFilePlugin::default());
    let file = SceneFile::from_ron(GOOD, "my.ron").unwrap();
    let handle = app.world_mut().resource_mut::<Assets<SceneFile>>().add(file);
    let instance = app.world_mut().spawn(SceneInstance(handle.clone())).id();
    run_until(&mut app, "the bodies", |world| world.query::<&BodyState>().iter(world).count() == 2);
    let changed = SceneFile::from_ron(r#"(bodies: [(name: "bud", model: "bud.modal")])"#, "my.ron").unwrap();
    app.world_mut().resource_mut::<Assets<SceneFile>>().insert(handle.id(), changed).unwrap();
    run_until(&mut app, "the other scene", |world| {
        let names: Vec<String> =
            world.query_filtered::<&Name, With<SceneBody>>().iter(world).map(ToString::to_string).collect();
        names == ["bud"]
    });
    assert_eq!(app.world().get::<SceneParts>(instance).unwrap().entities().len(), 1);
}

#[cfg(feature = "net")]
#[test]
fn a_session_is_for_an_app_that_was_built_for_it() {
    let mut app = app();
    app.add_plugins(SceneFilePlugin::default());
    let file = SceneFile::from_ron(&GOOD.replacen("title: \"one\"", "network: Host()", 1), "my.ron").unwrap();
    let handle = app.world_mut().resource_mut::<Assets<SceneFile>>().add(file);
    app.world_mut().spawn(SceneInstance(handle));
    let mut errors = Vec::new();
    run_until(&mut app, "the failure", |world| {
        errors.extend(failures(world));
        !errors.is_empty()
    });
    assert!(
        errors[0].to_string().starts_with("my.ron:2:14: this scene asks for a network, which"),
        "{}",
        errors[0]
    );
    // The rest of the scene exists.
    run_until(&mut app, "the hands", |world| world.query::<(&Grab, &GrabForce)>().iter(world).count() == 2);
}

/// Tests that each unmet request gives one error, and that the bodies and their hands exist.
#[cfg(all(feature = "net", feature = "rerun", feature = "haptics", feature = "bake"))]
#[test]
fn the_project_s_scenes_may_be_assets_of_a_game() {
    let mut app = app();
    app.add_plugins(SceneFilePlugin::default());
    let scenes = ["scenes/shared.ron", "scenes/everything.ron"];
    let instances = scenes.map(|scene| {
        let handle: Handle<SceneFile> = app.world().resource::<AssetServer>().load(scene);
        app.world_mut().spawn(SceneInstance(handle)).id()
    });
    let mut failures = Vec::new();
    run_until(&mut app, "the bodies and the clocks", |world| {
        failures.extend(world.resource_mut::<Messages<SceneFailed>>().drain());
        let begun = |at: &Entity| world.get::<SceneClock>(*at).is_some_and(|clock| clock.at(0.0).is_some());
        instances.iter().all(begun)
    });
    for _ in 0..10 {
        app.update();
    }
    let of = |instance| -> Vec<String> {
        failures.iter().filter(|one| one.instance == instance).map(|one| one.error.message.clone()).collect()
    };
    let shared = of(instances[0]);
    assert_eq!(shared.len(), 1, "{shared:#?}");
    assert!(shared[0].starts_with("this scene asks for a network, which an app gets when it is built"));
    let everything = of(instances[1]).join("\n");
    for part in [
        "this scene asks for a network, which",
        "this scene asks for a recording, which",
        "this app has no `HapticsPlugin`",
        "the body `jelly` is to be baked, and this app has no `BakePlugin`",
    ] {
        assert_eq!(everything.matches(part).count(), 1, "{part}: {everything}");
    }
    assert_eq!(everything.lines().count(), 4, "{everything}");
    let world = app.world_mut();
    let hands: Vec<String> =
        world.query_filtered::<&Name, With<GrabForce>>().iter(world).map(ToString::to_string).collect();
    // This is the hand of shared.ron. Of the other scene's two hands, one is the guest's and one
    // belongs to the missing body.
    assert_eq!(hands, ["of the host"]);
    let bodies: Vec<Entity> = world.query_filtered::<Entity, With<BodyState>>().iter(world).collect();
    assert_eq!(bodies.len(), 2);
}

/// Tests that the guest beside a host shows baked bodies, and that its view rests with the body.
#[cfg(all(feature = "net", feature = "bake"))]
#[test]
fn a_guest_s_view_of_a_baked_body_is_of_the_host_s_model_and_rests_with_it() {
    let shape = "bake: (shape: \"jelly.obj\", tets: 800, modes: 6, young: 2e4, damping_ratio: 0.3, anchors: [\"y<0.01\"])";
    let text = format!(
        "(bodies: [(name: \"bud\", {shape})], network: Host(guest: (beside: (1, 0, 0))),\
         grabs: [(name: \"hand\", body: \"bud\", patch: Toward((0, 1, 0)), pull: (0.02, 0, 0), until: 2)])"
    );
    let mut app = app();
    app.insert_resource(TimeUpdateStrategy::Automatic)
        .add_plugins(pliant::body::BakePlugin { cache: None })
        .add_plugins(SceneFilePlugin::open(SceneFile::from_ron(&text, "my.ron").unwrap()).unwrap());
    let view = |world: &mut World| {
        let mut views = world.query::<(&Name, &pliant::body::VisualState, &ModalBody)>();
        let found = views.iter(world).find(|(name, ..)| name.as_str() == "bud (guest)");
        found.map(|(_, shown, body)| {
            (shown.version(), shown.q().iter().fold(0.0_f64, |most, q| most.max(q.abs())), body.model.id())
        })
    };
    let mut most = 0.0_f64;
    run_until(&mut app, "the guest's view of the pull", |world| {
        assert_eq!(failures(world), []);
        most = view(world).map_or(most, |(_, q, _)| most.max(q));
        most > 1e-6
    });
    let (.., model) = view(app.world_mut()).unwrap();
    let world = app.world_mut();
    let hosts = world.query_filtered::<&ModalBody, With<SceneBody>>().single(world).unwrap();
    assert_eq!(hosts.model.id(), model, "one model in memory");
    // The body is released and comes to rest; after that, nothing writes the view.
    run_until(&mut app, "rest", |world| {
        world.query_filtered::<&BodyState, With<SceneBody>>().single(world).unwrap().is_resting()
    });
    let (mut last, mut same) = (0, 0);
    run_until(&mut app, "a view that is left alone", |world| {
        let (version, ..) = view(world).unwrap();
        same = if version == last { same + 1 } else { 0 };
        last = version;
        same > 500
    });
}

#[cfg(feature = "net")]
#[test]
fn a_guest_in_the_same_process_pulls_the_host_s_body_and_sees_it() {
    let text = GOOD
        .replacen("title: \"one\"", "network: Host(guest: (link: \"paper-4\", beside: (1, 0, 0)))", 1)
        .replacen("stiffness: 200", "pull: (0, 0, 0.08), by: Guest", 1);
    let plugin = SceneFilePlugin::open(SceneFile::from_ron(&text, "my.ron").unwrap()).unwrap();
    assert!(plugin.invite().is_some());
    let mut app = app();
    // A session runs in real time.
    app.insert_resource(TimeUpdateStrategy::Automatic).add_plugins(plugin);
    let mut pulled = 0.0_f64;
    run_until(&mut app, "the guest's hand and its view", |world| {
        let forces: Vec<f64> = world
            .query_filtered::<&GrabForce, With<pliant::net::HandOf>>()
            .iter(world)
            .map(|felt| felt.force.length())
            .collect();
        pulled = forces.into_iter().fold(pulled, f64::max);
        let mut views = world.query::<(&Name, &Transform, &pliant::body::VisualState)>();
        let moved = views.iter(world).any(|(name, place, shown)| {
            name.as_str() == "pip (guest)"
                && place.translation.x == 1.0
                && shown.q().iter().any(|q| q.abs() > 1e-4)
        });
        moved && pulled > 0.1
    });
}

#[cfg(feature = "haptics")]
#[test]
fn a_simulated_device_takes_hold_and_is_gone_with_its_scene() {
    use pliant::haptics::{HapticDevices, ToolGrabs};
    let device = "device: Virtual(on: (body: \"pip\", patch: Toward((1, 0.5, 0))), from: 0.3,\
                  motion: Path(points: [(at: 0.5, to: (0.04, 0, 0))]))";
    let text = GOOD.replacen("title: \"one\"", device, 1);
    let mut app = app();
    app.insert_resource(TimeUpdateStrategy::Automatic)
        .add_plugins(bevy::input::InputPlugin)
        .add_plugins(SceneFilePlugin::open(SceneFile::from_ron(&text, "my.ron").unwrap()).unwrap());
    run_until(&mut app, "a force in the hand", |world| {
        let holds = world.query::<&ToolGrabs>().iter(world).any(|held| !held.entities().is_empty());
        let felt =
            world.resource::<HapticDevices>().iter().map(|(_, status)| status.report.tick.wrench.force);
        holds && felt.into_iter().any(|force| force.iter().any(|newtons| newtons.abs() > 0.05))
    });
    let world = app.world_mut();
    let instance = world.query_filtered::<Entity, With<SceneInstance>>().single(world).unwrap();
    world.despawn(instance);
    assert_eq!(world.resource::<HapticDevices>().iter().count(), 0);
}

#[test]
fn stiffness_and_the_basis_of_a_body_are_the_scene_s() {
    let text = GOOD.replacen(
        "model: \"pip.modal\"",
        "model: \"pip.modal\", settings: (stiffness_scale: 4), half_basis: true",
        1,
    );
    let mut app = app();
    app.add_plugins(SceneFilePlugin::open(SceneFile::from_ron(&text, "my.ron").unwrap()).unwrap());
    run_until(&mut app, "the bodies", |world| world.query::<&BodyState>().iter(world).count() == 2);
    let world = app.world_mut();
    let bodies: Vec<(String, f64, bool, f64)> = world
        .query::<(&Name, &ModalBody, &BodyState)>()
        .iter(world)
        .map(|(name, body, state)| {
            let ratio = state.body().omega()[0] / state.model().omega()[0];
            (name.to_string(), body.settings.stiffness_scale, body.half_basis, ratio)
        })
        .collect();
    let of = |name: &str| bodies.iter().find(|body| body.0 == name).unwrap();
    assert_eq!((of("pip").1, of("pip").2), (4.0, true));
    // Four times the stiffness doubles the frequency.
    assert!((of("pip").3 - 2.0).abs() < 1e-9, "{bodies:?}");
    assert_eq!((of("bud").1, of("bud").2), (1.0, false));
    for (settings, column, message) in [
        ("stiffness_scale: 0", 71, "stiffness_scale: expected 1e-6 to 1e6, got 0"),
        ("relaxation: (ratio: 1, time: 2)", 74, "relaxation ratio: expected 0 or more, below 1, got 1"),
        ("integrator: GeneralizedAlpha(rho_inf: 2)", 92, "rho_inf: expected 0 to 1, got 2"),
    ] {
        let settings = format!("model: \"pip.modal\", settings: ({settings})");
        let error = with("model: \"pip.modal\"", &settings);
        assert_eq!((error.position, error.message.as_str()), (Some((4, column)), message));
    }
}

#[cfg(feature = "rerun")]
#[test]
fn a_recording_s_rates_and_color_are_the_scene_s() {
    use pliant::rerun::{RerunColor, RerunRecording};
    let folder = format!("pliant-recordings-{}", std::process::id());
    std::fs::create_dir(&folder).unwrap();
    let made = |fields: &str| {
        let recording = format!("recording: (file: \"{folder}/out.rrd\"{fields})");
        let text = GOOD.replacen("title: \"one\"", &recording, 1);
        let mut app = app();
        app.add_plugins(SceneFilePlugin::open(SceneFile::from_ron(&text, "my.ron").unwrap()).unwrap());
        *app.world().resource::<RerunRecording>()
    };
    assert_eq!(made(""), RerunRecording::default());
    let all =
        made(", shapes_hz: 5, metrics_hz: 30, hands_hz: 0, modes_hz: 2.5, color: Stress, device_loops: true");
    let expected = RerunRecording {
        on: true,
        shapes_hz: 5.0,
        metrics_hz: 30.0,
        hands_hz: 0.0,
        modes_hz: 2.5,
        color: RerunColor::Stress,
        device_loops: true,
    };
    assert_eq!(all, expected);
    std::fs::remove_dir_all(&folder).unwrap();
    for (field, place) in [("modes_hz: NaN", 44), ("metrics_hz: -1", 46), ("hands_hz: inf", 44)] {
        let error = with("title: \"one\"", &format!("recording: (file: \"out.rrd\", {field})"));
        assert_eq!(error.position, Some((2, place)), "{error}");
        assert!(error.message.starts_with("expected Hz from 0 to "), "{error}");
    }
    let error = with("title: \"one\"", "recording: (file: \"out.rrd\", color: Strain)");
    assert!(error.message.starts_with("unknown value `Strain` in Color; "), "{error}");
}
