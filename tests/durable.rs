//! Tests that what is written outlives a loss of power: each file is synced before it gets its
//! name, and its folder afterwards. A library before the C library of a process of its own sees the
//! calls.
#![cfg(target_os = "linux")]

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use pliant::{
    mesh::{io, shapes},
    modal::ModalModel,
    net::transport::Identity,
};

const FOLDER: &str = "PLIANT_TEST_FOLDER";

/// Writes one file of each kind, for [`files_are_synced_before_they_get_their_names`].
#[test]
#[ignore = "is run by another test, in a process of its own"]
fn files_are_written() {
    let Ok(folder) = std::env::var(FOLDER) else { return };
    let folder = Path::new(&folder);
    let jack = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../assets/jack.modal");
    ModalModel::read(jack).unwrap().write(folder.join("a.modal")).unwrap();
    io::write_msh(folder.join("a.msh"), &shapes::sphere(2, 1.0).unwrap()).unwrap();
    Identity::at(folder.join("a.key")).unwrap();
}

/// Builds the library that sees the calls.
fn witness(folder: &Path) -> PathBuf {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/durable/witness.c");
    let library = folder.join("libwitness.so");
    let is_there = |compiler: &&str| Command::new(compiler).arg("--version").output().is_ok();
    let compiler = ["cc", "gcc", "clang"].into_iter().find(is_there);
    let compiler = compiler.unwrap_or_else(|| panic!("a C compiler, which the workspace needs to build"));
    let mut built = Command::new(compiler);
    built.args(["-shared", "-fPIC", "-O1", "-Wall", "-Werror", "-o"]);
    assert!(built.args([&library, &source]).status().unwrap().success(), "{compiler} does not build it");
    library
}

#[test]
fn files_are_synced_before_they_get_their_names() {
    let folder = std::env::temp_dir().join(format!("pliant-durable-{}", std::process::id()));
    std::fs::remove_dir_all(&folder).ok();
    let files = folder.join("files");
    std::fs::create_dir_all(&files).unwrap();
    let files = files.canonicalize().unwrap();
    let log = folder.join("log");
    let child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "durable::files_are_written", "--ignored"])
        .env("LD_PRELOAD", witness(&folder))
        .env("PLIANT_WITNESS", &log)
        .env(FOLDER, &files)
        .output()
        .unwrap();
    assert!(child.status.success(), "{}", String::from_utf8_lossy(&child.stdout));
    let log = std::fs::read_to_string(&log).unwrap();
    let calls: Vec<Vec<&str>> = log.lines().map(|line| line.split('\t').collect()).collect();
    let folder_synced = ["sync", files.to_str().unwrap(), ""];
    for name in ["a.modal", "a.msh", "a.key"] {
        let path = files.join(name);
        let at = calls.iter().position(|call| call[0] == "name" && Path::new(call[2]) == path);
        let at = at.unwrap_or_else(|| panic!("{name} gets no name at once:\n{log}"));
        let synced = ["sync", calls[at][1], ""];
        assert!(calls[..at].iter().any(|call| *call == synced), "{name} is not synced before:\n{log}");
        // Of the files that are written afterwards, each syncs the folder too.
        let next =
            calls[at + 1..].iter().position(|call| call[0] == "name").map_or(calls.len(), |n| at + 1 + n);
        let after = calls[at + 1..next].iter().any(|call| *call == folder_synced);
        assert!(after, "the folder is not synced after {name} has its name:\n{log}");
    }
    std::fs::remove_dir_all(&folder).unwrap();
}
