//! A mistake in a scene is told with its place, and no input panics.

use bevy::prelude::*;
use pliant::scene::*;

use super::{GOOD, refused, with};

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
    for (part, by, expected) in [
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
        assert_eq!(with(part, by).message, expected);
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

/// The defaults of a scene are those of a bake, also where the feature is off.
#[cfg(feature = "bake")]
#[test]
fn a_bake_of_a_scene_has_the_defaults_of_a_bake_and_refuses_what_its_material_does_not_bear() {
    let baked = |rest: &str| {
        let bake = format!("bake: (shape: \"pip.obj\"{rest})");
        SceneFile::from_ron(&GOOD.replacen("model: \"pip.modal\"", &bake, 1), "my.ron")
    };
    let scene = baked("").unwrap();
    let (got, wanted) = (scene.scene().bodies[0].bake.clone().unwrap(), pliant::bake::BakeConfig::default());
    assert_eq!((got.modes, got.material), (wanted.modes, wanted.material_name()));
    assert_eq!((got.young, got.poisson, got.density), (wanted.young, wanted.poisson, wanted.density));
    for (rest, expected) in [
        (", material: \"rubber\"", "`neo-hookean`, `st-venant-kirchhoff` or `linear`"),
        (", poisson: 0.49", "a Poisson ratio from -0.99 to 0.45"),
        (", modes: 121", "modes from 1 to 120"),
    ] {
        let error = baked(rest).unwrap_err();
        assert!(error.to_string().contains(expected), "{error}");
    }
    assert!(baked(", material: \"linear\", poisson: 0.49, modes: 121").is_ok());
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
