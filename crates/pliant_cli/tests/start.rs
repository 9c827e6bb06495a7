//! Runs the commands of the program's documentation exactly as written.

#![expect(clippy::unwrap_used, reason = "a failed test should panic")]

mod support;

use support::{Folder, program};

/// Splits a line into words as a shell does, without comments and single quotes.
fn words(line: &str) -> Vec<String> {
    let command = line.split(" #").next().unwrap_or_default();
    command.split_whitespace().map(|word| word.trim_matches('\'').to_owned()).collect()
}

#[test]
fn the_start_in_the_documentation_runs() {
    let folder = Folder::new("start");
    let page = include_str!("../src/main.rs");
    let lines: Vec<&str> = page.lines().filter_map(|line| line.strip_prefix("//! pliant ")).collect();
    assert_eq!(lines.len(), 6, "{lines:?}");
    for line in lines {
        let output = program().args(words(line)).current_dir(&folder.0).output().unwrap();
        let told = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(
            output.status.success() && (line.contains(" -o ") || !told.is_empty()),
            "pliant {line}: {}\n{told}{}",
            output.status,
            String::from_utf8_lossy(&output.stderr)
        );
    }
    assert_eq!(folder.names(), ["bar.modal", "bar.msh"]);
}
