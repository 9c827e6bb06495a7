//! Tests the errors for invalid scenes and the entities of valid ones.

mod mistakes;
mod needs;
mod running;

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

const ASSETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets");
