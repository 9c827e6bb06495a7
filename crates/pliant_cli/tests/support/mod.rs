//! Runs the program in a folder of its own.
#![allow(dead_code, clippy::unwrap_used, reason = "each test file uses its part; a failed test should panic")]

use std::path::PathBuf;
use std::process::{Command, Output};

/// A folder for one test, removed at the end.
pub struct Folder(pub PathBuf);

impl Folder {
    pub fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("pliant-cli-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    pub fn file(&self, name: &str) -> String {
        self.0.join(name).to_string_lossy().into_owned()
    }

    pub fn write(&self, name: &str, text: &str) -> String {
        std::fs::write(self.0.join(name), text).unwrap();
        self.file(name)
    }

    /// Names of the files in the folder.
    pub fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(&self.0)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// The program without a user's cache, so that every bake really runs.
pub fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_pliant"));
    for name in ["HOME", "XDG_CACHE_HOME", "LOCALAPPDATA"] {
        command.env_remove(name);
    }
    command
}

pub fn pliant(arguments: &[&str]) -> Output {
    program().args(arguments).output().unwrap()
}

pub fn succeeds(arguments: &[&str]) -> String {
    let (told, message) = succeeds_with_a_word(arguments);
    assert!(message.is_empty(), "no progress bar in a pipe: {message}");
    told
}

/// Returns the output on stdout and on stderr.
pub fn succeeds_with_a_word(arguments: &[&str]) -> (String, String) {
    let output = pliant(arguments);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments:?}: {message}");
    (String::from_utf8(output.stdout).unwrap(), message)
}

/// Expects exit code 2 and no output on stdout. Returns the message on stderr.
pub fn refused(arguments: &[&str]) -> String {
    let output = pliant(arguments);
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {message}");
    assert!(output.stdout.is_empty() && !message.trim().is_empty(), "{arguments:?}");
    message
}

pub fn json(text: &str) -> serde_json::Value {
    serde_json::from_str(text).unwrap()
}
