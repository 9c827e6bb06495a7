//! Tests the errors for invalid scenes and the entities of valid ones.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

use std::time::{Duration, Instant};

use bevy::{prelude::*, time::TimeUpdateStrategy};

use pliant::body::{BodyState, Grab, GrabForce, ModalBody};
use pliant::prelude::PliantPlugins;
use pliant::scene::*;

/// A valid scene, line by line.
const GOOD: &str = r#"(
    title: "one",
    bodies: [
        (name: "pip", model: "pip.modal"),
        (name: "bud", model: "bud.modal", place: (at: (0.5, 0, 0))),
    ],
    grabs: [
        (name: "left", body: "pip", patch: Toward((1, 0, 0))),
        (name: "right", body: "pip", patch: Near((0, 0.2, 0)), stiffness: 200),
    ],
)"#;

fn refused(text: &str) -> SceneError {
    SceneFile::from_ron(text, "my.ron").expect_err("this scene is wrong")
}

/// Returns the error of the valid scene with a part of it replaced.
fn with(part: &str, by: &str) -> SceneError {
    assert!(GOOD.contains(part));
    refused(&GOOD.replacen(part, by, 1))
}

#[test]
fn a_good_scene_is_read() {
    let scene = SceneFile::from_ron(GOOD, "my.ron").unwrap();
    assert_eq!((scene.scene().bodies.len(), scene.scene().grabs.len()), (2, 2));
    assert_eq!(scene.scene().grabs[1].stiffness, Some(200.0));
    assert_eq!(SceneFile::new(scene.scene().clone()).unwrap().scene(), scene.scene());
}

#[test]
fn a_typo_and_an_unknown_field_are_told_with_what_was_expected() {
    let error = with("model: \"bud.modal\"", "modle: \"bud.modal\"");
    assert_eq!((error.position, error.kind), (Some((5, 23)), SceneErrorKind::Field));
    let text = error.to_string();
    assert!(text.starts_with("my.ron:5:23: unknown field `modle` in Body; did you mean `model`?"), "{text}");
    assert!(
        text.ends_with(
            "  5 |         (name: \"bud\", modle: \"bud.modal\", place: (at: (0.5, 0, 0))),\n    |                       ^"
        ),
        "{text}"
    );

    let error = with("title", "wind_speed");
    assert_eq!(error.position, Some((2, 5)));
    assert!(
        error.message.starts_with(
            "unknown field `wind_speed` in Scene; expected one of `title`, `step_hz`, `view`, `bodies`"
        ),
        "{error}"
    );

    let error = with("Toward((1", "Twoard((1");
    assert_eq!(error.position, Some((8, 44)));
    assert!(error.message.starts_with("unknown value `Twoard` in Patch; did you mean `Toward`?"), "{error}");
}

#[test]
fn what_is_no_ron_is_told_where_it_ends_to_be_one() {
    let error = with("(name: \"pip\", model", "(name: \"pip\" model");
    assert_eq!(
        error.to_string().lines().next(),
        Some("my.ron:4:22: expected a comma or a closing bracket, got `model`")
    );
    let error = with("stiffness: 200", "stiffness: \"200\"");
    assert_eq!((error.position, error.kind), (Some((9, 74)), SceneErrorKind::Syntax), "{error}");
    assert_eq!(error.message, "expected a number, got `\"200\"`");
    for (part, by, told) in [
        ("model: \"pip.modal\"", "model: pip.modal", "expected text in double quotes, got `pip.modal`"),
        ("model: \"pip.modal\"", "model: \"pip.modal\", modes: 3.5", "expected a whole number, got `.5`"),
        (
            "model: \"pip.modal\"",
            "model: \"pip.modal\", modes: -3",
            "expected a whole number, 0 or more, got `-3`",
        ),
        ("model: \"pip.modal\"", "model: \"pip.modal\", pointer: yes", "expected true or false, got `yes`"),
        (
            "Toward((1, 0, 0))",
            "Toward(1, 0, 0)",
            "expected an opening bracket (what has parts has brackets of its own, such as `Toward((1, 0, 0))`), got `1`",
        ),
    ] {
        assert_eq!(with(part, by).message, told);
    }
    let open = &GOOD[..GOOD.find(",\n    ],\n    grabs").unwrap()];
    assert_eq!(refused(open).message, "expected a comma or a closing bracket, got the end of the file");
    let error = with("model: \"pip.modal\"", "modes: 3, modes: 4");
    assert_eq!(error.position.unwrap().0, 4);
    assert!(error.message.contains("`modes` is there twice in Body"), "{error}");
    let error = with("name: \"left\", ", "");
    assert_eq!(error.position.unwrap().0, 8);
    assert!(error.message.contains("the field `name` is missing in Grab"), "{error}");
    assert_eq!(refused("").to_string(), "my.ron:1:1: the file is empty; expected a scene: `(bodies: [..])`");
    assert!(refused("  \n ").message.starts_with("the file is empty"));
}

#[test]
fn names_that_are_there_twice_or_not_at_all() {
    let error = with("name: \"right\"", "name: \"left\"");
    assert_eq!(
        error.to_string().lines().next(),
        Some(
            "my.ron:9:16: the grab `left` is there already, in line 8, where it holds `pip`; every grab needs a name of its own"
        )
    );
    let error = with("\"right\", body: \"pip\"", "\"right\", body: \"pup\"");
    assert_eq!(
        error.to_string().lines().next(),
        Some(
            "my.ron:9:31: the grab `right` holds a body `pup` that is not in the scene; did you mean `pip`?"
        )
    );
    let error = with("\"right\", body: \"pip\"", "\"right\", body: \"dragon\"");
    assert!(error.message.ends_with("its bodies are `bud`, `pip`"), "{error}");
    let error = with("name: \"bud\"", "name: \"pip\"");
    assert_eq!(
        error.to_string().lines().next(),
        Some("my.ron:5:16: the body `pip` is there already, in line 4; every body needs a name of its own")
    );
    assert_eq!(error.kind, SceneErrorKind::Name);
    // The name of a copy counts as a name, too.
    let copies = GOOD
        .replacen("name: \"bud\"", "name: \"b\", copies: (count: (2, 1), spacing: (1, 1))", 1)
        .replacen("name: \"pip\"", "name: \"b.1\"", 1);
    assert!(refused(&copies).message.starts_with("the body `b.1` is there already"));
}

#[test]
fn numbers_out_of_their_range_are_told_where_they_are() {
    for (part, by, wrong, words) in [
        ("(0.5, 0, 0)", "(0.5, NaN, 0)", "NaN", "expected meters from -1000000 to 1000000, got NaN"),
        ("(0.5, 0, 0)", "(inf, 0, 0)", "inf", "got inf"),
        ("stiffness: 200", "stiffness: -1", "-1", "expected N/m above 0 and at most 1000000000, got -1"),
        ("stiffness: 200", "stiffness: 1e999", "1e999", "got inf"),
        (
            "stiffness: 200",
            "from: 2, until: 1.5",
            "1.5",
            "expected a time after `from`, which is 2 s, got 1.5",
        ),
        (
            "stiffness: 200",
            "motion: Path(points: [(at: 1, to: (0, 0, 0)), (at: 0.75, to: (0, 0, 0))])",
            "0.75",
            "expected a time after 1 s",
        ),
        ("Toward((1, 0, 0))", "Toward((-0, 0, 0))", "(-0", "expected a direction, got one without a length"),
        ("title: \"one\"", "step_hz: 0", "0", "expected ticks a second from 1 to 2000, got 0"),
        ("model: \"pip.modal\"", "model: \"../s.modal\"", "\"../s", "a path under the folder of assets"),
        ("model: \"pip.modal\"", "model: \"/pip.modal\"", "\"/pip", "a path under the folder of assets"),
        ("model: \"pip.modal\"", "model: \"C:/s.modal\"", "\"C:/s", "a path under the folder of assets"),
        ("model: \"pip.modal\"", "model: \"C:s.modal\"", "\"C:s", "a path under the folder of assets"),
        ("model: \"pip.modal\"", "model: \"a/.. /s.modal\"", "\"a/", "a path under the folder of assets"),
        ("model: \"pip.modal\"", "model: \"a//s.modal\"", "\"a//", "a path under the folder of assets"),
        ("model: \"pip.modal\"", "model: \"./s.modal\"", "\"./s", "a path under the folder of assets"),
        ("model: \"pip.modal\"", "model: \"NUL.modal\"", "\"NUL", "a path under the folder of assets"),
        ("model: \"pip.modal\"", "model: \"con.a.modal\"", "\"con", "a path under the folder of assets"),
        ("model: \"pip.modal\"", "model: \"aux/s.modal\"", "\"aux", "a path under the folder of assets"),
        ("model: \"pip.modal\"", "model: \"a\\\\s.modal\"", "\"a\\", "a path under the folder of assets"),
        ("title: \"one\"", "recording: (file: \"COM1.rrd\")", "\"COM1", "below the working directory"),
        ("title: \"one\"", "recording: (file: \"C:x.rrd\")", "\"C:x", "below the working directory"),
        ("title: \"one\"", "recording: (file: \"a:b/x.rrd\")", "\"a:b", "below the working directory"),
        ("model: \"pip.modal\"", "model: \"pip.obj\"", "\"pip.obj", "a file that ends with .modal"),
        ("model: \"pip.modal\"", "modes: 3", "\"pip\"", "is made of nothing"),
        ("title: \"one\"", "recording: (file: \"/etc/x.rrd\")", "\"/etc", "below the working directory"),
        ("title: \"one\"", "recording: (file: \"../x.rrd\")", "\"../", "below the working directory"),
        ("title: \"one\"", "recording: ()", "()", "goes nowhere"),
        ("place:", "copies: (count: (100000, 9), spacing: (1, 1)), place:", "100000", "a number of rows"),
        (
            "place:",
            "copies: (count: (100, 99), spacing: (1, 1)), place:",
            "(name: \"bud\"",
            "at most 4096 bodies",
        ),
    ] {
        let text = GOOD.replacen(part, by, 1);
        let error = refused(&text);
        assert!(error.message.contains(words), "{error}");
        let before = &text[..text.find(wrong).unwrap()];
        let place = (before.lines().count(), before.lines().last().unwrap().len() + 1);
        assert_eq!(error.position, Some(place), "{error}");
        assert_eq!(with(part, by), error);
    }
}

/// A game without the feature has no mesh crate, so that a scene has the rules of paths once more.
#[cfg(feature = "bake")]
#[test]
fn a_scene_and_a_document_of_a_mesh_name_files_by_the_same_rules() {
    let scene = GOOD.replacen("model: \"pip.modal\"", "bake: (shape: \"pip.obj\")", 1);
    let scene = SceneFile::from_ron(&scene, "my.ron").unwrap().scene().clone();
    let taken = |path: &str| {
        let mut scene = scene.clone();
        scene.bodies[0].bake.as_mut().unwrap().shape = path.into();
        SceneFile::new(scene).is_ok()
    };
    let devices = "con PRN aux NUL conin$ CONOUT$ Clock$ com0 COM1 com9 COM¹ lpt³ LPT2";
    let names = "a b.obj .hidden ü..c console null COM com10 comx LPTé a.nul %2e%2e";
    for path in devices.split(' ').chain(names.split(' ')) {
        let forms = [
            "@", "@.txt", "@ .txt", "x/@/y", "x/@.a.b", "/@", "@/", "x//@", "./@", "../@", "x/../@", "x/./@",
            "x/.../@", "@.", "@ ", "@./y", "@ /y", "\\@", "x\\@", "..\\@", "C:@", "C:/@", "@:stream", "@\0",
            "@\n", "@\u{85}",
        ];
        for path in forms.map(|form| form.replace('@', path)) {
            assert_eq!(taken(&path), pliant::mesh::io::is_below(&path), "{path:?}");
        }
    }
    assert!(taken("x/console.obj") && !taken("") && !taken(&"a".repeat(1025)));
    assert!(devices.split(' ').all(|device| !taken(device) && !taken(&format!("x/{device}.obj"))));
}

#[cfg(feature = "net")]
#[test]
fn networks_by_names_that_there_are() {
    let error = with("title: \"one\"", "network: Host(guest: (link: \"paper1\"))");
    assert_eq!(error.position, Some((2, 33)), "{error}");
    assert!(error.message.contains("did you mean `paper-1`? The networks are paper-1, paper-2"), "{error}");
    let error = with("title: \"one\"", "network: Join(invite: \"http://here\")");
    assert_eq!((error.position, error.kind), (Some((2, 27)), SceneErrorKind::Value), "{error}");
    let error = with("title: \"one\"", "network: Host(listen: \"localhost\")");
    assert!(error.message.contains("such as \"0.0.0.0:7400\""), "{error}");
    let error = with("stiffness: 200", "by: Guest");
    assert!(error.message.contains("the scene has none"), "{error}");
}

#[test]
fn a_mistake_in_a_scene_without_a_text_has_no_line() {
    let mut scene = SceneFile::from_ron(GOOD, "my.ron").unwrap().scene().clone();
    scene.grabs[1].name = "left".into();
    let error = SceneFile::new(scene).unwrap_err();
    assert_eq!(error.position, None);
    assert!(
        error
            .to_string()
            .starts_with("a scene made in code: the grab `left` is there already, in another place")
    );
}

#[test]
fn no_input_panics_or_takes_long() {
    // The inputs are deeply nested, long, cut off, and not text.
    assert!(refused(&"(bodies: [".repeat(10_000)).message.len() < 400);
    assert!(refused(&format!("(title: {}", "[".repeat(100_000))).to_string().len() < 2000);
    assert!(refused(&format!("(bodies: {}", "(".repeat(100_000))).to_string().len() < 2000);
    assert_eq!(refused(&"a".repeat(MAX_BYTES + 1)).kind, SceneErrorKind::Read);
    assert!(refused(&"a".repeat(MAX_BYTES)).to_string().len() < 2000);
    assert!(refused(&format!("({}: 1)", "b".repeat(100_000))).to_string().len() < 2000);
    assert!(refused(&"/*".repeat(100_000)).to_string().len() < 2000);
    for cut in (0..GOOD.len() - 1).filter(|&cut| GOOD.is_char_boundary(cut)) {
        assert_ne!(refused(&GOOD[..cut]).to_string(), "");
    }
    // Each byte is replaced in turn; nothing may panic.
    for at in 0..GOOD.len() {
        for byte in [b'(', b')', b'"', b'-', b'9', 0] {
            let mut bytes = GOOD.as_bytes().to_vec();
            bytes[at] = byte;
            let _ = SceneFile::from_ron(std::str::from_utf8(&bytes).unwrap(), "my.ron")
                .map_err(|e| e.to_string());
        }
    }
}

#[test]
fn a_file_that_is_too_long_or_no_text_or_not_there() {
    let folder = std::env::temp_dir().join(format!("pliant-scene-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let file = folder.join("long.ron");
    // One megabyte of the eight gigabytes is read. On other systems, a sparse file may use disk
    // space.
    let bytes = if cfg!(target_os = "linux") { 1 << 33 } else { 2 << 20 };
    std::fs::File::create(&file).unwrap().set_len(bytes).unwrap();
    let error = SceneFile::read(&file).unwrap_err();
    std::fs::remove_file(&file).unwrap();
    assert_eq!(error.kind, SceneErrorKind::Read);
    assert!(error.message.contains("at most 1048576 bytes"), "{error}");
    std::fs::write(&file, b"(bodies:\n [\xff]").unwrap();
    let error = SceneFile::read(&file).unwrap_err();
    assert_eq!((error.position, error.kind), (Some((2, 3)), SceneErrorKind::Read));
    std::fs::remove_dir_all(&folder).unwrap();
    let error = SceneFile::read(&file).unwrap_err();
    assert!(error.to_string().contains("long.ron: the scene cannot be read: "), "{error}");
}

const ASSETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets");

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
    let told = errors[0].to_string();
    assert!(told.starts_with("my.ron:5:30: the body `bud` cannot be loaded: "), "{told}");
    assert!(told.contains("bad.modal"), "{told}");
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
    let told = errors[0].to_string();
    assert!(
        told.starts_with(
            "my.ron:8:44: the grab `left` cannot hold `pip`: expected a vertex of the surface, 0 to "
        ),
        "{told}"
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
    let mut told = Vec::new();
    run_until(&mut app, "the bodies and the clocks", |world| {
        told.extend(world.resource_mut::<Messages<SceneFailed>>().drain());
        let begun = |at: &Entity| world.get::<SceneClock>(*at).is_some_and(|clock| clock.at(0.0).is_some());
        instances.iter().all(begun)
    });
    for _ in 0..10 {
        app.update();
    }
    let of = |instance| -> Vec<String> {
        told.iter().filter(|one| one.instance == instance).map(|one| one.error.message.clone()).collect()
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

/// For each feature: the part of the scene to replace, its replacement, the position of the error,
/// and the feature that is needed.
const NEEDS: [(&str, &str, (usize, usize), &str); 4] = [
    ("title: \"one\"", "network: Host()", (2, 14), "net"),
    ("title: \"one\"", "device: Pointer(on: (body: \"pip\", patch: Vertex(0)))", (2, 13), "haptics"),
    ("title: \"one\"", "recording: (file: \"never/made.rrd\")", (2, 16), "rerun"),
    ("model: \"bud.modal\"", "bake: (shape: \"bud.ron\")", (5, 29), "bake"),
];

#[test]
fn each_entry_needs_its_feature_and_no_other() {
    let good = SceneFile::from_ron(GOOD, "my.ron").unwrap();
    assert_eq!(good.lacking(|_| false), []);
    let words = ["a network", "a device", "a recording", "a bake"];
    for ((part, by, place, feature), what) in NEEDS.into_iter().zip(words) {
        let file = SceneFile::from_ron(&GOOD.replacen(part, by, 1), "my.ron").unwrap();
        assert_eq!(file.lacking(|_| true), [], "{feature}");
        assert_eq!(file.lacking(|has| has == feature), [], "nothing but {feature} is needed");
        let told = file.lacking(|has| has != feature);
        assert_eq!(told.len(), 1, "{told:?}");
        assert_eq!((told[0].position, told[0].kind), (Some(place), SceneErrorKind::Feature), "{}", told[0]);
        let expected =
            format!("this scene asks for {what}, and this program was compiled without `{feature}`");
        assert!(told[0].message.starts_with(&expected), "{}", told[0]);
    }
}

#[test]
fn a_scene_that_the_program_was_not_compiled_for_is_not_opened() {
    let compiled =
        [cfg!(feature = "net"), cfg!(feature = "haptics"), cfg!(feature = "rerun"), cfg!(feature = "bake")];
    for ((part, by, _, feature), compiled) in NEEDS.into_iter().zip(compiled) {
        // The recording's folder does not exist. With the feature, this is the error; without the
        // feature, the missing feature is reported first.
        let opened =
            SceneFilePlugin::open(SceneFile::from_ron(&GOOD.replacen(part, by, 1), "my.ron").unwrap());
        match (compiled, opened) {
            (true, Ok(_)) => assert_ne!(feature, "rerun"),
            (true, Err(error)) => {
                assert_eq!((feature, error.kind), ("rerun", SceneErrorKind::Open), "{error}")
            }
            (false, Ok(_)) => panic!("`{feature}` was not compiled, and the scene was opened"),
            (false, Err(error)) => assert_eq!(error.kind, SceneErrorKind::Feature, "{error}"),
        }
    }
}

#[test]
fn a_recording_that_cannot_be_written_is_told_before_the_scene_plays() {
    let wrong = |file: &str| {
        let text = GOOD.replacen("title: \"one\"", &format!("recording: (file: \"{file}\")"), 1);
        SceneFile::from_ron(&text, "my.ron").unwrap()
    };
    let file = wrong("no/such folder/out.rrd");
    let told = file.check_files(ASSETS);
    assert_eq!(told.len(), 1, "{told:?}");
    assert_eq!((told[0].position, told[0].kind), (Some((2, 23)), SceneErrorKind::Open));
    assert_eq!(told[0].message, "cannot record to no/such folder/out.rrd: there is no folder no/such folder");
    #[cfg(feature = "rerun")]
    assert_eq!(SceneFilePlugin::open(file).err(), Some(told[0].clone()));
    // The path itself is a folder, and it has no parent folder that could be missing.
    let folder = format!("pliant-scene-{}.rrd", std::process::id());
    std::fs::create_dir(&folder).unwrap();
    let told = wrong(&folder).check_files(ASSETS);
    std::fs::remove_dir(&folder).unwrap();
    assert!(told[0].message.ends_with(": it is a folder"), "{told:?}");
    assert_eq!(wrong("out.rrd").check_files(ASSETS), []);
    assert!(!std::path::Path::new("out.rrd").exists(), "a check makes no file");
}

#[test]
fn missing_files_are_told_by_a_check_with_their_lines() {
    assert_eq!(SceneFile::from_ron(GOOD, "my.ron").unwrap().check_files(ASSETS), []);
    let text = GOOD.replacen("model: \"pip.modal\"", "model: \"pop.modal\"", 1).replacen(
        "model: \"bud.modal\"",
        "bake: (shape: \"jelly.obi\")",
        1,
    );
    let told = SceneFile::from_ron(&text, "my.ron").unwrap().check_files(ASSETS);
    let lines: Vec<String> =
        told.iter().map(|error| error.to_string().lines().next().unwrap().to_owned()).collect();
    assert_eq!(lines.len(), 2, "{lines:#?}");
    assert!(
        lines[0].starts_with("my.ron:4:30: the body `pip` cannot be loaded: there is no pop.modal in "),
        "{}",
        lines[0]
    );
    assert!(lines[0].ends_with("assets; did you mean `pip.modal`?"), "{}", lines[0]);
    assert!(
        lines[1].starts_with("my.ron:5:37: the body `bud` cannot be made: there is no jelly.obi in "),
        "{}",
        lines[1]
    );
    assert!(lines[1].ends_with("; did you mean `jelly.obj`?"), "{}", lines[1]);
    assert!(told.iter().all(|error| error.kind == SceneErrorKind::Asset));
    // The file exists, but it is not a model.
    let text = GOOD.replacen("model: \"bud.modal\"", "model: \"../Cargo.toml\"", 1);
    assert!(SceneFile::from_ron(&text, "my.ron").is_err());
    let folder = std::env::temp_dir().join(format!("pliant-models-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("pip.modal"), "nothing that was baked").unwrap();
    std::fs::copy(format!("{ASSETS}/bud.modal"), folder.join("bud.modal")).unwrap();
    let told = SceneFile::from_ron(GOOD, "my.ron").unwrap().check_files(&folder);
    std::fs::remove_dir_all(&folder).unwrap();
    assert_eq!((told.len(), told[0].position), (1, Some((4, 30))), "{told:?}");
    // The model does not have this vertex.
    let text = GOOD.replacen("Toward((1, 0, 0))", "Vertex(4000000)", 1);
    let told = SceneFile::from_ron(&text, "my.ron").unwrap().check_files(ASSETS);
    assert_eq!((told.len(), told[0].position), (1, Some((8, 44))), "{told:?}");
    assert!(
        told[0].message.starts_with("the grab `left` cannot hold `pip`: expected a vertex"),
        "{}",
        told[0]
    );
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
    for (settings, column, told) in [
        ("stiffness_scale: 0", 71, "stiffness_scale: expected 1e-6 to 1e6, got 0"),
        ("relaxation: (ratio: 1, time: 2)", 74, "relaxation ratio: expected 0 or more, below 1, got 1"),
        ("integrator: GeneralizedAlpha(rho_inf: 2)", 92, "rho_inf: expected 0 to 1, got 2"),
    ] {
        let settings = format!("model: \"pip.modal\", settings: ({settings})");
        let error = with("model: \"pip.modal\"", &settings);
        assert_eq!((error.position, error.message.as_str()), (Some((4, column)), told));
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

#[test]
fn the_project_s_scenes_are_right() {
    let mut count = 0;
    for entry in std::fs::read_dir(format!("{ASSETS}/scenes")).unwrap() {
        let path = entry.unwrap().path();
        let scene = SceneFile::read(&path).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(scene.check_files(ASSETS), []);
        assert_ne!(scene.scene().title, "", "{path:?}");
        count += 1;
    }
    assert!(count >= 5);
}
