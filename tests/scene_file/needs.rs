//! What a scene needs: compiled features and files.

use bevy::prelude::*;
use pliant::scene::*;

use super::{ASSETS, GOOD};

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
        let errors = file.lacking(|has| has != feature);
        assert_eq!(errors.len(), 1, "{errors:?}");
        assert_eq!(
            (errors[0].position, errors[0].kind),
            (Some(place), SceneErrorKind::Feature),
            "{}",
            errors[0]
        );
        let expected =
            format!("this scene asks for {what}, and this program was compiled without `{feature}`");
        assert!(errors[0].message.starts_with(&expected), "{}", errors[0]);
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
    let errors = file.check_files(ASSETS);
    assert_eq!(errors.len(), 1, "{errors:?}");
    assert_eq!((errors[0].position, errors[0].kind), (Some((2, 23)), SceneErrorKind::Open));
    assert_eq!(
        errors[0].message,
        "cannot record to no/such folder/out.rrd: there is no folder no/such folder"
    );
    #[cfg(feature = "rerun")]
    assert_eq!(SceneFilePlugin::open(file).err(), Some(errors[0].clone()));
    // The path itself is a folder, and it has no parent folder that could be missing.
    let folder = format!("pliant-scene-{}.rrd", std::process::id());
    std::fs::create_dir(&folder).unwrap();
    let errors = wrong(&folder).check_files(ASSETS);
    std::fs::remove_dir(&folder).unwrap();
    assert!(errors[0].message.ends_with(": it is a folder"), "{errors:?}");
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
    let errors = SceneFile::from_ron(&text, "my.ron").unwrap().check_files(ASSETS);
    let lines: Vec<String> =
        errors.iter().map(|error| error.to_string().lines().next().unwrap().to_owned()).collect();
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
    assert!(errors.iter().all(|error| error.kind == SceneErrorKind::Asset));
    // The file exists, but it is not a model.
    let text = GOOD.replacen("model: \"bud.modal\"", "model: \"../Cargo.toml\"", 1);
    assert!(SceneFile::from_ron(&text, "my.ron").is_err());
    let folder = std::env::temp_dir().join(format!("pliant-models-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("pip.modal"), "nothing that was baked").unwrap();
    std::fs::copy(format!("{ASSETS}/bud.modal"), folder.join("bud.modal")).unwrap();
    let errors = SceneFile::from_ron(GOOD, "my.ron").unwrap().check_files(&folder);
    std::fs::remove_dir_all(&folder).unwrap();
    assert_eq!((errors.len(), errors[0].position), (1, Some((4, 30))), "{errors:?}");
    // The model does not have this vertex.
    let text = GOOD.replacen("Toward((1, 0, 0))", "Vertex(4000000)", 1);
    let errors = SceneFile::from_ron(&text, "my.ron").unwrap().check_files(ASSETS);
    assert_eq!((errors.len(), errors[0].position), (1, Some((8, 44))), "{errors:?}");
    assert!(
        errors[0].message.starts_with("the grab `left` cannot hold `pip`: expected a vertex"),
        "{}",
        errors[0]
    );
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
