//! Runs every example without a window, as the files in `tests/examples` specify.
//!
//! Each file names an example, its arguments, and what the example must print and write, and must
//! not print.
//!
//! ```sh
//! cargo test -p pliant_examples              # builds the examples first, as any `cargo test` of the package does
//! PLIANT_RUN=join cargo test -p pliant_examples      # those whose file's name begins like that
//! ```
//!
//! Each example runs in its own folder, without a display and with its own cache.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

use std::{
    fs::{self, File},
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::atomic::{AtomicUsize, Ordering},
    thread,
    time::{Duration, Instant},
};

use serde::Deserialize;

/// A file of `tests/examples`.
#[derive(Deserialize, Debug)]
#[serde(deny_unknown_fields)]
struct Run {
    /// Name of the example.
    example: String,
    /// Arguments. `{assets}` is the project's folder of assets, and `{invite}` is the invite that
    /// the example in `beside` has printed.
    arguments: Vec<String>,
    /// Another example that is started before this one and ended after it.
    #[serde(default)]
    beside: Option<Beside>,
    /// Variables of its environment. It has no display otherwise.
    #[serde(default)]
    environment: Vec<(String, String)>,
    /// Texts that the output must contain, in this order.
    prints: Vec<String>,
    /// Texts that the output must not contain.
    #[serde(default)]
    lacks: Vec<String>,
    /// Files that must exist afterward and must not be empty.
    #[serde(default)]
    writes: Vec<String>,
}

#[derive(Deserialize, Debug)]
#[serde(deny_unknown_fields)]
struct Beside {
    example: String,
    arguments: Vec<String>,
}

const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");

/// File with the output of the example in `beside`.
const BESIDE: &str = "beside.txt";

/// Maximum duration of a run, also on a busy machine.
const LONGEST: Duration = Duration::from_secs(600);

fn runs() -> Vec<(String, Run)> {
    let options = ron::Options::default().with_default_extension(ron::extensions::Extensions::IMPLICIT_SOME);
    let mut all: Vec<(String, Run)> = fs::read_dir(format!("{ROOT}/tests/examples"))
        .unwrap()
        .map(|entry| {
            let path = entry.unwrap().path();
            let text = fs::read_to_string(&path).unwrap();
            let run = options.from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
            (path.file_stem().unwrap().to_string_lossy().into_owned(), run)
        })
        .collect();
    all.sort_by(|a, b| a.0.cmp(&b.0));
    all
}

/// Returns the package's examples in `examples/` by name, and whether each needs a window.
fn examples() -> Vec<(String, bool)> {
    let text = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/Cargo.toml")).unwrap();
    let value = |part: &str, key: &str| {
        let line = part.lines().find(|line| line.starts_with(key))?;
        Some(line.split_once('=')?.1.trim().trim_matches('"').to_owned())
    };
    text.split("[[")
        .filter_map(|part| part.strip_prefix("example]]"))
        .filter(|part| value(part, "path").unwrap().contains("/examples/"))
        .map(|part| {
            (
                value(part, "name").unwrap(),
                value(part, "required-features").is_some_and(|needs| needs.contains("window")),
            )
        })
        .collect()
}

#[test]
fn every_example_has_a_run_and_those_that_draw_run_headless_for_so_many_frames() {
    let (runs, examples) = (runs(), examples());
    assert!(examples.len() >= 14, "{examples:?}");
    for (_, run) in &runs {
        assert!(examples.iter().any(|(name, _)| *name == run.example), "there is no example {}", run.example);
    }
    for (name, draws) in &examples {
        // `join` opens a window but compiles without the feature; `make_models` needs the feature
        // but opens no window.
        let draws = (*draws || name == "join") && name != "make_models";
        let by_frames = |run: &Run| {
            let has = |argument: &str| run.arguments.iter().any(|given| given == argument);
            !draws || (has("--headless") && has("--frames"))
        };
        let found = runs.iter().any(|(_, run)| run.example == *name && by_frames(run));
        assert!(found, "{name}: expected a file in tests/examples that runs it (--headless --frames N)");
    }
}

/// Returns the path of an example's program, in cargo's folder beside that of this test.
fn program(example: &str) -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let name = format!("{example}{}", std::env::consts::EXE_SUFFIX);
    test.parent().unwrap().with_file_name("examples").join(name)
}

/// Builds the examples if they are missing.
///
/// Cargo builds the examples for a test of the whole package, but not for `--test examples` alone.
fn build_examples() {
    if examples().iter().all(|(name, _)| program(name).exists()) {
        return;
    }
    let mut cargo = Command::new(env!("CARGO"));
    cargo.args(["build", "-p", "pliant_examples", "--examples"]).current_dir(ROOT);
    if !cfg!(debug_assertions) {
        cargo.arg("--release");
    }
    assert!(cargo.status().unwrap().success(), "the examples cannot be built");
}

/// A program that is killed when this value is dropped.
struct Started {
    child: Child,
    output: PathBuf,
}

impl Started {
    fn new(
        example: &str,
        arguments: &[String],
        environment: &[(String, String)],
        folder: &Path,
        output: &str,
    ) -> Self {
        let output = folder.join(output);
        let file = File::create(&output).unwrap();
        let child = Command::new(program(example))
            .args(arguments)
            .current_dir(folder)
            .env_remove("DISPLAY")
            .env_remove("WAYLAND_DISPLAY")
            .env("XDG_CACHE_HOME", folder.join("cache"))
            .envs(environment.iter().cloned())
            .stdin(Stdio::null())
            .stdout(file.try_clone().unwrap())
            .stderr(file)
            .spawn()
            .unwrap();
        Self { child, output }
    }

    fn printed(&self) -> String {
        String::from_utf8_lossy(&fs::read(&self.output).unwrap()).into_owned()
    }

    /// Waits for the first invite that the program prints.
    fn invite(&self) -> Result<String, String> {
        let began = Instant::now();
        while began.elapsed() < LONGEST {
            let printed = self.printed();
            // The last line may be incomplete, so only lines that have ended count.
            let lines = printed.split_inclusive('\n').filter(|line| line.ends_with('\n'));
            let words = lines.flat_map(str::split_whitespace);
            if let Some(invite) = words.into_iter().find(|word| word.starts_with("pliant://")) {
                return Ok(invite.to_owned());
            }
            thread::sleep(Duration::from_millis(20));
        }
        Err(format!("no invite came:\n{}", self.printed()))
    }
}

impl Drop for Started {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Runs an example; an error includes the output of the example in `beside`.
fn try_run(run: &Run, folder: &Path) -> Result<(), String> {
    run_in(run, folder).map_err(|why| match fs::read_to_string(folder.join(BESIDE)) {
        Ok(printed) => format!("{why}\nThe one beside it has printed:\n{printed}"),
        Err(_) => why,
    })
}

fn run_in(run: &Run, folder: &Path) -> Result<(), String> {
    fs::create_dir_all(folder).unwrap();
    let assets = fs::canonicalize(format!("{ROOT}/assets")).unwrap().display().to_string();
    let with = |arguments: &[String], invite: &str| -> Vec<String> {
        arguments.iter().map(|text| text.replace("{assets}", &assets).replace("{invite}", invite)).collect()
    };
    let beside = run
        .beside
        .as_ref()
        .map(|beside| Started::new(&beside.example, &with(&beside.arguments, ""), &[], folder, BESIDE));
    let invite = beside.as_ref().map(Started::invite).transpose()?.unwrap_or_default();
    let mut started =
        Started::new(&run.example, &with(&run.arguments, &invite), &run.environment, folder, "output.txt");
    let began = Instant::now();
    let status = loop {
        match started.child.try_wait().unwrap() {
            Some(status) => break status,
            None if began.elapsed() > LONGEST => return Err(format!("no end:\n{}", started.printed())),
            None => thread::sleep(Duration::from_millis(10)),
        }
    };
    let printed = started.printed();
    if !status.success() {
        return Err(format!("{status}:\n{printed}"));
    }
    if printed.contains("panicked at") || printed.contains(" ERROR ") {
        return Err(format!("something went wrong on the way:\n{printed}"));
    }
    let mut rest = printed.as_str();
    for words in &run.prints {
        match rest.split_once(words.as_str()) {
            Some((_, after)) => rest = after,
            None => return Err(format!("expected {words:?} in:\n{printed}")),
        }
    }
    if let Some(words) = run.lacks.iter().find(|words| printed.contains(*words)) {
        return Err(format!("did not expect {words:?} in:\n{printed}"));
    }
    for file in &run.writes {
        if fs::metadata(folder.join(file)).map_or(0, |found| found.len()) == 0 {
            return Err(format!("{file} was not written:\n{printed}"));
        }
    }
    Ok(())
}

#[test]
fn every_example_runs_and_says_what_its_file_says() {
    let wanted = std::env::var("PLIANT_RUN").unwrap_or_default();
    let runs: Vec<(String, Run)> = runs().into_iter().filter(|(name, _)| name.starts_with(&wanted)).collect();
    build_examples();
    assert!(!runs.is_empty(), "no file of tests/examples begins with {wanted:?}");
    let scratch = std::env::temp_dir().join(format!("pliant-examples-{}", std::process::id()));
    let next = AtomicUsize::new(0);
    // Two examples run at a time, since they mostly wait for the clock.
    let work = || {
        let mut wrong = Vec::new();
        while let Some((name, run)) = runs.get(next.fetch_add(1, Ordering::Relaxed)) {
            let began = Instant::now();
            if let Err(why) = try_run(run, &scratch.join(name)) {
                wrong.push(format!("tests/examples/{name}.ron: {why}"));
            }
            println!("{name}: {:.1} s", began.elapsed().as_secs_f64());
        }
        wrong
    };
    let wrong: Vec<String> = thread::scope(|scope| {
        let both = [scope.spawn(work), scope.spawn(work)];
        both.into_iter().flat_map(|one| one.join().unwrap()).collect()
    });
    let _ = fs::remove_dir_all(&scratch);
    assert!(wrong.is_empty(), "{}", wrong.join("\n\n"));
}
