//! What the page of threats promises is held by tests that exist and run.

#![expect(clippy::unwrap_used, clippy::panic, reason = "a failed test should panic")]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn read(name: &str) -> String {
    fs::read_to_string(root().join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

/// All files below the folders of the sources, as paths from the root with `/` between the names.
fn files() -> Vec<String> {
    let mut found = Vec::new();
    let mut folders: Vec<String> = ["crates", "tests", "examples"].map(str::to_owned).to_vec();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(root().join(&folder)).unwrap() {
            let entry = entry.unwrap();
            let path = format!("{folder}/{}", entry.file_name().to_string_lossy());
            if entry.file_type().unwrap().is_dir() { folders.push(path) } else { found.push(path) }
        }
    }
    found
}

/// The tests of a source, and whether each runs without being asked for.
fn tests_of(text: &str) -> Vec<(String, bool)> {
    let mut found = Vec::new();
    let (mut is_test, mut runs) = (false, true);
    for line in text.lines().map(str::trim) {
        if line == "#[test]" {
            (is_test, runs) = (true, true);
        } else if line.starts_with("#[ignore") {
            runs = false;
        } else if let Some(rest) = line.strip_prefix("fn ").filter(|_| is_test) {
            found.push((rest.split(['(', '<']).next().unwrap().to_owned(), runs));
            is_test = false;
        } else if !line.starts_with("#[") && !line.starts_with("//") {
            is_test = false;
        }
    }
    found
}

/// What a page has between backticks, outside of fenced blocks.
fn quoted(text: &str) -> Vec<&str> {
    let mut fenced = false;
    let lines = text.lines().filter(|line| {
        let fence = line.starts_with("```");
        fenced ^= fence;
        !fenced && !fence
    });
    lines.flat_map(|line| line.split('`').skip(1).step_by(2)).collect()
}

/// Whether a name in a page is that of a test: at least three words.
fn names_a_test(name: &str) -> bool {
    let word = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    name.trim_end_matches('…').chars().all(word) && name.matches('_').count() >= 2
}

struct Tree {
    files: Vec<String>,
    tests: BTreeMap<String, bool>,
}

impl Tree {
    fn read() -> Self {
        let files = files();
        let sources = files.iter().filter(|file| file.ends_with(".rs"));
        let tests: BTreeMap<String, bool> = sources.flat_map(|file| tests_of(&read(file))).collect();
        assert!(tests.len() > 800, "only {} tests were found", tests.len());
        Self { files, tests }
    }

    /// Tells what is wrong with a test that a page names. A name may be cut short by an ellipsis.
    fn fault(&self, name: &str) -> Option<String> {
        let runs = match name.strip_suffix('…') {
            Some(beginning) => {
                self.tests.range(beginning.to_owned()..).next().filter(|t| t.0.starts_with(beginning))
            }
            None => self.tests.get_key_value(name),
        };
        match runs {
            None => Some(format!("no test is called {name}")),
            Some((_, false)) => Some(format!("{name} runs only when it is asked for")),
            Some((_, true)) => None,
        }
    }

    /// Whether a name is the end of a file's path.
    fn has_file(&self, name: &str) -> bool {
        self.files.iter().any(|file| file == name || file.ends_with(&format!("/{name}")))
    }

    /// Whether a name in the column of the tests is something that can hold a promise.
    fn holds(&self, name: &str, crates: &[&str]) -> bool {
        let program = |of: &&str| {
            self.has_file(&format!("{of}/tests/{name}.rs"))
                || self.has_file(&format!("{of}/tests/{name}/main.rs"))
        };
        (names_a_test(name) && self.fault(name).is_none())
            || (name.contains('/') && self.has_file(name))
            || crates.iter().any(program)
    }
}

#[test]
fn each_test_that_the_pages_name_exists_and_runs() {
    let tree = Tree::read();
    let mut faults = Vec::new();
    for page in ["THREATS.md", "docs/report/measurements.md"] {
        let text = read(page);
        // The other parts of the page of measurements name functions too.
        let part = text
            .split_once("### The smallest faults that were tried")
            .map_or(&*text, |(_, rest)| rest.split_once("\n## ").map_or(rest, |(part, _)| part));
        let names: Vec<&str> = quoted(part).into_iter().filter(|name| names_a_test(name)).collect();
        println!("{page} names {} tests", names.len());
        assert!(names.len() > 60, "{page}: only {names:?}");
        faults.extend(names.into_iter().filter_map(|name| Some(format!("{page}: {}", tree.fault(name)?))));
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn each_promise_is_held_by_a_test_or_the_page_says_that_none_does() {
    let tree = Tree::read();
    let text = read("THREATS.md");
    let (mut promises, mut without, mut faults) = (0, Vec::new(), Vec::new());
    let mut in_table = false;
    for line in text.lines() {
        let cells: Vec<&str> = line.trim_matches('|').split(" | ").map(str::trim).collect();
        let [threat, .., held] = cells[..] else {
            in_table = false;
            continue;
        };
        if held == "Test" {
            in_table = true;
        } else if in_table && held != "---" {
            promises += 1;
            let names = quoted(held);
            let crates: Vec<&str> =
                names.iter().copied().filter(|name| name.starts_with("pliant_")).collect();
            if held == "no test" || held.starts_with("settings in ") {
                without.push(threat);
            } else if !names.iter().any(|name| tree.holds(name, &crates)) {
                faults.push(format!("{threat}: {held}"));
            }
        }
    }
    println!("{promises} promises, {} of them without a test: {without:?}", without.len());
    assert!(promises > 75, "only {promises} promises were found");
    assert!(without.len() <= 3, "without a test: {without:?}");
    assert!(faults.is_empty(), "nothing that exists holds\n{}", faults.join("\n"));
}

/// The files that cargo does not make programs of by itself, and that no program names.
fn left_out(files: &[String], text_of: impl Fn(&str) -> String) -> Vec<String> {
    let mut lost = Vec::new();
    for file in files {
        let Some((folder, name)) = file.rsplit_once("tests/") else { continue };
        let Some(name) = name.strip_suffix("/main.rs").or(name.strip_suffix(".rs")) else { continue };
        if name.contains('/') || folder.contains("/src/") {
            continue;
        }
        // The tests of whole apps belong to the package of the examples.
        let package = if folder.is_empty() { "crates/pliant_examples/" } else { folder };
        let manifest = text_of(&format!("{package}Cargo.toml"));
        if !folder.is_empty() && !manifest.contains("autotests = false") {
            continue;
        }
        let suite = text_of(&format!("{folder}tests/suite.rs"));
        let module = suite.lines().any(|line| line == format!("mod {name};"));
        let program = manifest.split("[[").filter(|part| part.starts_with("test]]")).any(|part| {
            let names = |line: &str| line == format!("name = \"{name}\"");
            part.lines().any(names)
        });
        if !module && !program {
            lost.push(file.clone());
        }
    }
    lost
}

#[test]
fn each_test_file_belongs_to_a_program() {
    let lost = left_out(&files(), read);
    assert!(lost.is_empty(), "neither a module of a suite nor a [[test]]: {lost:?}");
    // A file that nothing names is noticed.
    let text = |name: &str| match name {
        "crates/a/Cargo.toml" => "autotests = false\n[[test]]\nname = \"own\"\n".to_owned(),
        "crates/a/tests/suite.rs" => "mod first;\n".to_owned(),
        _ => String::new(),
    };
    let files = ["first.rs", "own/main.rs", "lost.rs", "lost/main.rs", "first/part.rs"];
    let lost = left_out(&files.map(|file| format!("crates/a/tests/{file}")), text);
    assert_eq!(lost, ["crates/a/tests/lost.rs", "crates/a/tests/lost/main.rs"]);
}

/// What reads the sources and the pages would notice a test that is gone.
#[test]
fn a_test_that_is_gone_or_is_not_run_is_noticed() {
    let source = "#[test]\nfn one_that_runs() {}\n#[test]\n#[ignore = \"long\"]\nfn one_that_waits() {}\n\
                  fn no_test_at_all() {}\n    #[test]\n    // Why.\n    fn one_within(a: u8) {}\n";
    let found = [("one_that_runs", true), ("one_that_waits", false), ("one_within", true)];
    assert_eq!(tests_of(source), found.map(|(name, runs)| (name.to_owned(), runs)));
    let tree =
        Tree { files: vec!["crates/a/tests/b.rs".into()], tests: tests_of(source).into_iter().collect() };
    assert_eq!(tree.fault("one_that_runs"), None);
    assert_eq!(tree.fault("one_that_r…"), None);
    assert!(
        ["one_that_waits", "no_test_at_all", "one_that_…_", "zero…"].iter().all(|t| tree.fault(t).is_some())
    );
    assert!(tree.holds("tests/b.rs", &[]) && tree.holds("b", &["a"]) && !tree.holds("c", &["a"]));
    assert_eq!(quoted("a `b` c\n```sh\n`d`\n```\n`e_f_g`"), ["b", "e_f_g"]);
    assert!(
        names_a_test("e_f_g") && names_a_test("e_f_g…") && !names_a_test("e_f") && !names_a_test("E::f_g_h")
    );
}
