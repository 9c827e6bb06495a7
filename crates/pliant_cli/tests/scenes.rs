//! Checks with Cargo which crates each set of features compiles, and which imports are forbidden.
//!
//! Cargo reads the manifests of the crates that it lists. It downloads those that no build here has
//! needed yet, so these tests do not need a used cargo home. With a used cargo home they do not
//! need the network.

#![expect(clippy::unwrap_used, reason = "a failed test should panic")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::{fs, process::Command};

/// The crates that a package compiles for this platform with these feature arguments.
fn crates(package: &str, features: &[&str]) -> BTreeSet<String> {
    let output = Command::new(env!("CARGO"))
        .args(["tree", "--locked", "-p", package, "-e", "normal", "--prefix", "none"])
        .args(features)
        .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "cargo tree of {package} with {features:?}: {told}");
    let text = String::from_utf8(output.stdout).unwrap();
    let list: BTreeSet<String> =
        text.lines().filter_map(|line| line.split(' ').next()).map(str::to_owned).collect();
    assert!(list.contains(package), "{text}");
    list
}

/// The crates of the package `pliant` with these features and no others.
fn with(features: &str) -> BTreeSet<String> {
    crates("pliant", &["--no-default-features", "--features", features])
}

/// The names in a list that match a pattern: a whole name, or a prefix followed by a star.
fn matching<'a>(list: &'a BTreeSet<String>, pattern: &str) -> Vec<&'a String> {
    list.iter()
        .filter(|name| match pattern.strip_suffix('*') {
            Some(beginning) => name.starts_with(beginning),
            None => *name == pattern,
        })
        .collect()
}

fn lacks(list: &BTreeSet<String>, patterns: &[&str], who: &str) {
    for pattern in patterns {
        let found = matching(list, pattern);
        assert!(found.is_empty(), "{who} compiles {found:?}");
    }
}

const RENDERER: [&str; 6] = ["bevy_render", "bevy_pbr", "bevy_core_pipeline", "bevy_winit", "winit", "wgpu"];

/// Name of the scene, its features, and the crates that it must not compile.
const SCENES: [(&str, &str, &[&str]); 6] = [
    (
        "a body without a picture",
        "",
        &[
            "wgpu",
            "bevy_render",
            "quinn*",
            "tokio",
            "rerun",
            "arrow",
            "bevy_egui",
            "egui",
            "pliant_haptics",
            "pliant_contact",
            "faer",
        ],
    ),
    (
        "one body or many",
        "render",
        &[
            "quinn*",
            "tokio",
            "rerun",
            "bevy_egui",
            "pliant_haptics",
            "pliant_contact",
            "pliant_stream",
            "faer",
            "bevy_winit",
        ],
    ),
    (
        "a host without a picture",
        "net",
        &["wgpu", "bevy_render", "rerun", "arrow", "bevy_egui", "egui", "pliant_haptics", "faer"],
    ),
    ("a guest", "net,render", &["rerun", "bevy_egui", "pliant_haptics", "faer"]),
    (
        "a body that is felt",
        "haptics,render",
        &["quinn*", "tokio", "rerun", "bevy_egui", "pliant_stream", "faer"],
    ),
    (
        "baking in the game",
        "bake",
        &["bevy_render", "wgpu", "quinn*", "tokio", "rerun", "bevy_egui", "pliant_haptics"],
    ),
];

#[test]
fn a_scene_compiles_nothing_that_it_does_not_need() {
    let everything = crates("pliant", &["--all-features"]);
    // The window and what is drawn in it are the game's, which here are the examples.
    let game = crates("pliant_examples", &[]);
    for (name, features, without) in SCENES {
        let list = with(features);
        println!("{name} ({features}): {} crates of {}", list.len(), everything.len());
        lacks(&list, without, name);
        if !features.contains("render") {
            lacks(&list, &RENDERER, name);
        }
        assert!(list.len() < everything.len());
    }
    let named = SCENES.iter().flat_map(|scene| scene.2).chain(&RENDERER);
    for pattern in named {
        let found = matching(&game, pattern);
        assert!(!found.is_empty(), "{pattern} is no crate of ours at all: the list is out of date");
    }
}

/// Each feature with crates of its own, those crates, and the features that need this feature.
const FEATURES: [(&str, &[&str], &[&str]); 9] = [
    ("render", &["bevy_render", "bevy_pbr", "bevy_core_pipeline", "wgpu"], &["panel"]),
    ("contact", &["pliant_contact"], &["contact-mesh"]),
    ("contact-mesh", &["parry3d-f64"], &[]),
    ("net", &["pliant_net", "quinn*"], &["watch"]),
    ("watch", &["moq-net", "web-transport-*"], &[]),
    ("haptics", &["pliant_haptics"], &[]),
    ("rerun", &["pliant_rerun", "rerun", "re_*", "arrow"], &[]),
    ("panel", &["pliant_panel", "bevy_egui", "egui", "egui_plot"], &[]),
    ("bake", &["pliant_bake", "pliant_mesh", "faer"], &[]),
];

#[test]
fn a_feature_that_is_off_compiles_none_of_its_crates() {
    for (feature, own, needing) in FEATURES {
        let others: Vec<&str> = FEATURES
            .iter()
            .map(|other| other.0)
            .filter(|other| *other != feature && !needing.contains(other))
            .collect();
        lacks(&with(&others.join(",")), own, &format!("pliant without {feature}"));
        let list = with(feature);
        for pattern in own {
            assert!(!matching(&list, pattern).is_empty(), "{feature} does not compile {pattern}");
        }
    }
}

/// Tests that no feature of ours chooses the window, the user interface or the threads of a game,
/// and what the default features are.
#[test]
fn what_is_the_games_to_choose_is_not_chosen_by_us() {
    let asked = |arguments: &[&str]| {
        let output = Command::new(env!("CARGO"))
            .args(["tree", "--locked", "-p", "pliant", "-e", "features,normal", "--prefix", "none"])
            .args(["-f", "{p} {f}"])
            .args(arguments)
            .current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
            .output()
            .unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        let line = text.lines().find(|line| line.starts_with("bevy_internal v")).unwrap().to_owned();
        let features = line.split(' ').nth(2).unwrap();
        features.split(',').map(str::to_owned).collect::<BTreeSet<_>>()
    };
    let choices = ["x11", "wayland", "bevy_winit", "bevy_ui", "bevy_ui_render", "default_font", "png"];
    for arguments in [&[][..], &["--all-features"]] {
        let features = asked(arguments);
        println!("pliant {arguments:?} asks of Bevy: {features:?}");
        lacks(&features, &choices, "pliant");
        lacks(&features, &["multi_threaded", "reflect_auto_register*"], "pliant");
        assert!(features.contains("bevy_pbr"), "the features are read wrongly: {features:?}");
    }
    let without: Vec<&str> = FEATURES.iter().filter(|f| f.0 != "render").flat_map(|f| f.1).copied().collect();
    lacks(&crates("pliant", &[]), &without, "pliant with its default features");
}

#[test]
fn the_crates_below_the_plugins_import_no_engine_runtime_or_viewer() {
    for package in ["pliant_mesh", "pliant_bake", "pliant_modal", "pliant_stream", "pliant_lab"] {
        lacks(&crates(package, &[]), &["bevy*", "tokio", "quinn*", "rerun", "egui*"], package);
    }
}

/// The crates that a game in a browser may have. What the devices' loops are made of is native, and
/// the laboratory and the program are no part of a game.
const IN_BROWSERS: [&str; 11] = [
    "pliant",
    "pliant_path",
    "pliant_mesh",
    "pliant_bake",
    "pliant_modal",
    "pliant_stream",
    "pliant_body",
    "pliant_contact",
    "pliant_net",
    "pliant_rerun",
    "pliant_panel",
];

/// The files in the `src` of a crate, without those of tests.
fn sources(package: &str) -> Vec<PathBuf> {
    let mut folders = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(package).join("src")];
    let mut found = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_stem().unwrap().to_string_lossy().into_owned();
            match path.is_dir() {
                _ if name == "tests" || name.ends_with("_tests") => {}
                true => folders.push(path),
                false => found.push(path),
            }
        }
    }
    found
}

/// The lines of a source, without its tests, that name the clock of the standard library.
///
/// A lint for types cannot tell: natively `bevy::platform::time::Instant` and `web_time::Instant`
/// are the standard library's.
fn standard_clocks(text: &str) -> Vec<String> {
    // Tests within a file are its end. A module of tests in another file is not.
    let within = |(at, _): &(usize, &str)| text[*at..].lines().nth(1).is_some_and(|l| l.ends_with('{'));
    let end = text.match_indices("#[cfg(test)]\nmod ").find(within).map_or(text.len(), |(at, _)| at);
    let text = &text[..end];
    let whole = |line: &str| line.split(|c: char| !c.is_alphanumeric()).any(|word| word == "Instant");
    text.split_inclusive(';')
        .map(|statement| {
            let lines = statement.lines().filter(|line| !line.trim_start().starts_with("//"));
            lines.map(str::trim).collect::<Vec<_>>().join(" ")
        })
        .filter(|statement| {
            let imports = statement.contains("use std::") && whole(statement);
            imports || statement.contains("std::time::Instant") || statement.contains("use std::time;")
        })
        .collect()
}

/// Tests that nothing reads a clock that panics in browsers (`std::time::Instant::now`).
#[test]
fn clocks_are_those_that_browsers_have() {
    for wrong in [
        "use std::time::Instant;",
        "use std::time::{Duration, Instant};",
        "use std::{\n    fs,\n    time::{Duration, Instant},\n};",
        "fn now() {\n    let now = std::time::Instant::now();\n}",
        "use std::time;\nfn now() { time::Instant::now(); }",
        "#[cfg(test)]\nmod tests;\n\nuse std::time::Instant;",
    ] {
        assert_eq!(standard_clocks(wrong).len(), 1, "{wrong} is not found");
    }
    let right = "use std::time::Duration;\nuse bevy::platform::time::Instant;\n#[cfg(test)]\nmod tests {\n    \
                 use std::time::Instant;\n}";
    assert_eq!(standard_clocks(right), [""; 0], "what is right is found");

    let (mut faults, mut seen) = (Vec::new(), 0);
    for path in IN_BROWSERS.iter().flat_map(|package| sources(package)) {
        seen += 1;
        let found = standard_clocks(&fs::read_to_string(&path).unwrap());
        faults.extend(found.into_iter().map(|line| format!("{}: {line}", path.display())));
    }
    assert!(seen > 100, "only {seen} sources were found");
    assert!(
        faults.is_empty(),
        "not bevy::platform::time::Instant or web_time::Instant:\n{}",
        faults.join("\n")
    );
}

/// Name of the public type that a line declares.
fn public_type(line: &str) -> Option<&str> {
    let declared = line.trim_start().strip_prefix("pub ")?;
    let kinds = ["struct ", "enum ", "trait ", "type ", "union "];
    let rest = kinds.iter().find_map(|kind| declared.strip_prefix(kind))?;
    rest.split(|c: char| !c.is_alphanumeric()).next()
}

/// Tests that one name means one thing: a reader who knows a type of one crate finds no other of
/// its name.
#[test]
fn no_two_crates_have_a_public_type_of_one_name() {
    let mut crates: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for entry in fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("..")).unwrap() {
        let entry = entry.unwrap();
        if !entry.path().join("src").is_dir() {
            continue;
        }
        let package = entry.file_name().to_string_lossy().into_owned();
        for path in sources(&package) {
            let text = fs::read_to_string(path).unwrap();
            for name in text.lines().filter_map(public_type) {
                crates.entry(name.to_owned()).or_default().insert(package.clone());
            }
        }
    }
    assert!(crates.len() > 400, "only {} public types were found", crates.len());
    let shared: Vec<_> = crates.iter().filter(|(_, crates)| crates.len() > 1).collect();
    assert!(shared.is_empty(), "{shared:?}");
}

#[test]
fn only_the_program_imports_the_laboratory() {
    // The package `pliant` with all features compiles every crate that an app can have.
    for package in ["pliant", "pliant_mesh", "pliant_bake", "pliant_modal", "pliant_stream"] {
        lacks(&crates(package, &["--all-features"]), &["pliant_lab"], package);
    }
    assert!(crates("pliant_cli", &[]).contains("pliant_lab"));
    // The protocol depends on no mesh and no bake. The laboratory depends neither on the plugins
    // nor on the program.
    lacks(&crates("pliant_stream", &[]), &["pliant_mesh", "pliant_bake", "plotters"], "pliant_stream");
    lacks(&crates("pliant_lab", &[]), &["pliant_cli", "pliant_body", "clap"], "pliant_lab");
}
