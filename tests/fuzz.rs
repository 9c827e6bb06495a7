//! Scenes, and the extras of glTF models, from anybody.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

#[path = "../crates/pliant_lab/tests/support/fuzzing.rs"]
mod fuzzing;

use std::path::Path;

use bevy::prelude::*;
use pliant::body::BakeRequest;
use pliant::mesh::io::is_below;
use pliant::scene::{RecordingEntry, SceneFile};

/// The shipped scenes, and one of every kind of mistake.
fn scenes() -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/scenes");
    let mut files: Vec<_> = folder.read_dir().unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    assert!(files.len() > 3, "{files:?}");
    let small = r#"(bodies: [(name: "a", model: "a.modal", copies: (count: (2, 3), spacing: (1, 1)))],
        grabs: [(name: "g", body: "a.0", patch: Near((0, 1, 0)), motion: Path(points: [(at: 1, to: (0, 0, 1))]))],
        recording: (file: "out.rrd"))"#;
    let wrong = r#"(bodies: [(nam: "a", model: "../a.modal"), (name: "a", bake: (shape: "C:a.obj"))])"#;
    let mut all = vec![small.into(), wrong.into()];
    all.extend(files.iter().map(|file| std::fs::read(file).unwrap()));
    all
}

#[test]
fn no_text_panics_the_reader_of_scenes_and_none_names_a_file_beyond_its_folder() {
    let mut read = std::cell::Cell::new(0);
    fuzzing::run("scenes", scenes(), |bytes| {
        let text = String::from_utf8_lossy(bytes);
        match SceneFile::from_ron(&text, "my.ron") {
            Ok(file) => {
                read.set(read.get() + 1);
                let scene = file.scene();
                assert_eq!(SceneFile::new(scene.clone()).unwrap().scene(), scene);
                let models = scene.bodies.iter().filter_map(|body| body.model.as_deref());
                let shapes = scene.bodies.iter().filter_map(|body| Some(body.bake.as_ref()?.shape.as_str()));
                let file = scene.recording.as_ref().and_then(|RecordingEntry { file, .. }| file.as_deref());
                for path in models.chain(shapes).chain(file) {
                    assert!(is_below(path), "{path:?}");
                }
            }
            // It shows the line in question, cut to what a screen has room for.
            Err(error) => {
                assert!(error.to_string().len() < 4096, "{} bytes", error.to_string().len());
                let lines = text.lines().count();
                assert!(error.position.is_none_or(|(line, _)| line <= lines + 1), "{:?}", error.position);
            }
        }
    });
    assert!(*read.get_mut() > 10, "hardly any scene was read");
}

#[test]
fn no_json_panics_the_reader_of_extras() {
    let corpus = [
        r#"{"anchor":"x<0.001","stiffness":45000.0,"density":500,"skein":[{"a":{"b":1}}]}"#,
        r#"{"anchor":["x>0.999","z < 0", "y<1e300"]}"#,
        r#"{"stiffness":-1e308,"density":1e-320,"anchor":[]}"#,
        "[[[[[[[[]]]]]]]]",
    ];
    let corpus = corpus.iter().map(|text| text.as_bytes().to_vec()).collect();
    fuzzing::run("extras", corpus, |bytes| {
        let text = String::from_utf8_lossy(bytes);
        let before = BakeRequest::mesh(Handle::default());
        let anchors = before.config.anchors.len();
        match before.with_extras(&text) {
            // An anchor takes at least its quotes and a comma.
            Ok(request) => assert!(request.config.anchors.len() <= anchors + text.len() / 3),
            Err(error) => assert!(error.to_string().len() < 1024 + 2 * text.len()),
        }
    });
}
