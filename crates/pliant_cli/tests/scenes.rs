//! What a scene leaves out: the crates that each feature set of the face compiles, by Cargo's own account.

#![expect(clippy::unwrap_used, reason = "a failed test should panic")]

use std::{collections::BTreeSet, process::Command};

/// The crates that `pliant` compiles with these features.
fn crates(features: &[&str]) -> BTreeSet<String> {
    let output = Command::new(env!("CARGO"))
        .args(["tree", "-p", "pliant", "-e", "normal", "--prefix", "none", "--offline"])
        .args(features)
        .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines().filter_map(|line| line.split(' ').next()).map(str::to_owned).collect()
}

/// Name of the scene, its features, and what it must not compile.
const SCENES: [(&str, &str, &[&str]); 6] = [
    (
        "a body without a picture",
        "",
        &["bevy_render", "wgpu", "quinn", "tokio", "rerun", "bevy_egui", "pliant_haptics", "faer"],
    ),
    (
        "one body or many",
        "render",
        &["quinn", "tokio", "rerun", "bevy_egui", "pliant_haptics", "pliant_stream", "faer", "bevy_winit"],
    ),
    (
        "a host without a picture",
        "net",
        &["bevy_render", "wgpu", "rerun", "bevy_egui", "pliant_haptics", "faer"],
    ),
    ("a guest", "net,render", &["rerun", "bevy_egui", "pliant_haptics", "faer"]),
    (
        "a body that is felt",
        "haptics,render",
        &["quinn", "tokio", "rerun", "bevy_egui", "pliant_stream", "faer"],
    ),
    (
        "baking in the game",
        "bake",
        &["bevy_render", "wgpu", "quinn", "tokio", "rerun", "bevy_egui", "pliant_haptics"],
    ),
];

#[test]
fn a_scene_compiles_nothing_that_it_does_not_need() {
    let everything = crates(&["--all-features"]);
    for (name, features, without) in SCENES {
        let list = crates(&["--no-default-features", "--features", features]);
        println!("{name} ({features}): {} crates of {}", list.len(), everything.len());
        for forbidden in without {
            assert!(!list.contains(*forbidden), "{name} compiles {forbidden}");
            assert!(
                everything.contains(*forbidden),
                "{forbidden} is no crate of ours at all: the list is out of date"
            );
        }
        assert!(list.len() < everything.len());
    }
}
