//! Runs tests that draw.
//!
//! Without a graphics driver, even a software one, these tests are counted as ignored, and one line
//! says what is missing. `PLIANT_REQUIRE_PICTURES=1` makes them fail instead.

use std::{
    env,
    panic::{self, resume_unwind},
    process::ExitCode,
    time::{Duration, Instant},
};

use bevy::prelude::App;
use libtest_mimic::{Arguments, Trial};

/// The main function of a test program that draws.
///
/// `studio` creates an app that draws, and panics if that is not possible.
pub fn main(studio: fn() -> App, tests: &[(&'static str, fn(App))]) -> ExitCode {
    let arguments = Arguments::from_args();
    let required = env::var_os("PLIANT_REQUIRE_PICTURES").is_some();
    let missing = !arguments.list && !required && !can_draw(studio);
    if missing {
        eprintln!(
            "skipped: a graphics driver is missing, a software one will do \
             (Debian: mesa-vulkan-drivers libvulkan1)"
        );
    }
    let trials = tests
        .iter()
        .map(|&(name, test)| {
            let run = move || {
                test(studio());
                Ok(())
            };
            Trial::test(name, run).with_ignored_flag(missing)
        })
        .collect();
    libtest_mimic::run(&arguments, trials).exit_code()
}

fn can_draw(studio: fn() -> App) -> bool {
    // The line above reports the missing driver; the panic message of the engine is suppressed.
    let hook = panic::take_hook();
    panic::set_hook(Box::new(|_| ()));
    let drawn = panic::catch_unwind(studio);
    panic::set_hook(hook);
    let Err(reason) = drawn else { return true };
    let words = reason.downcast_ref::<&str>().copied();
    let words = words.or_else(|| reason.downcast_ref::<String>().map(String::as_str));
    match words {
        Some(words) if words.contains("Unable to find a GPU") => false,
        // Any other panic is a real fault.
        _ => resume_unwind(reason),
    }
}

/// Calls `frame` until it returns a value.
///
/// Shaders are compiled and pictures are read back on other threads, which takes long on a busy
/// machine without a graphics card.
pub fn wait_for<T>(what: &str, mut frame: impl FnMut() -> Result<T, String>) -> T {
    let start = Instant::now();
    loop {
        match frame() {
            Ok(found) => return found,
            Err(last) if start.elapsed() > Duration::from_secs(300) => panic!("{what}: {last}"),
            Err(_) => std::thread::sleep(Duration::from_millis(5)),
        }
    }
}
