//! Finds out whether a window can be opened and drawn in.

use std::{
    io::Read,
    process::{Child, Command, Stdio, exit},
    sync::OnceLock,
    thread,
    time::{Duration, Instant},
};

use bevy::{log::LogPlugin, prelude::*, window::WindowResolution, winit::WinitSettings};

/// Set in the process that tries.
const TRIES: &str = "PLIANT_TRIES_A_WINDOW";

/// Longest time that a try may take. Some drivers hang.
const LONGEST: Duration = Duration::from_secs(30);

/// Returns why no window can be opened and drawn in; `None` if one can.
///
/// Window systems and graphics drivers panic, abort or hang where they fail. So another process of
/// this program tries first, with a window that is not shown. It runs the example up to here, so
/// that an example makes its stage before it opens sockets and files.
pub fn fault() -> Option<String> {
    static FOUND: OnceLock<Option<String>> = OnceLock::new();
    FOUND.get_or_init(find).clone()
}

fn find() -> Option<String> {
    if std::env::var_os(TRIES).is_some() {
        open();
    }
    let set = |name| std::env::var_os(name).is_some_and(|value| !value.is_empty());
    let wayland = cfg!(feature = "wayland");
    if cfg!(not(any(windows, target_os = "macos"))) && !set("DISPLAY") && !(wayland && set("WAYLAND_DISPLAY"))
    {
        return Some("DISPLAY is not set".into());
    }
    let program = std::env::current_exe().ok()?;
    let mut tries = Command::new(program);
    tries.args(std::env::args_os().skip(1)).env(TRIES, "1");
    let tries = tries.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn();
    tries.map_or_else(|error| Some(error.to_string()), outcome)
}

/// Waits for the process that tries, and returns its fault.
fn outcome(mut tries: Child) -> Option<String> {
    let mut stderr = tries.stderr.take()?;
    let output = thread::spawn(move || {
        let mut text = Vec::new();
        // What cannot be read is left out.
        stderr.read_to_end(&mut text).ok();
        String::from_utf8_lossy(&text).into_owned()
    });
    let began = Instant::now();
    let status = loop {
        match tries.try_wait() {
            Ok(Some(status)) => break status,
            Ok(None) if began.elapsed() < LONGEST => thread::sleep(Duration::from_millis(10)),
            Ok(None) | Err(_) => {
                // It may have ended by itself meanwhile.
                tries.kill().ok();
                tries.wait().ok();
                return Some(format!("nothing was drawn within {} s", LONGEST.as_secs()));
            }
        }
    };
    if status.success() {
        return None;
    }
    let output = output.join().unwrap_or_default();
    let panic = output.lines().skip_while(|line| !line.contains(" panicked at ")).nth(1);
    Some(match panic {
        Some(text) if text.contains("XOpenDisplayFailed") => {
            let display = std::env::var("DISPLAY").unwrap_or_default();
            format!("nobody serves the display {display}, or it does not let this program in")
        }
        Some(text) => text.to_owned(),
        None => format!("a process that tried it ended with {status}"),
    })
}

/// Opens a window that is not shown, draws a frame in it, and ends the process.
fn open() -> ! {
    let window = Window { visible: false, resolution: WindowResolution::new(64, 64), ..default() };
    let plugins = DefaultPlugins
        .build()
        .disable::<LogPlugin>()
        .set(WindowPlugin { primary_window: Some(window), ..default() });
    App::new()
        .add_plugins(plugins)
        .insert_resource(WinitSettings::continuous())
        .add_systems(Startup, |mut commands: Commands| {
            commands.spawn(Camera3d::default());
        })
        .add_systems(Update, |mut frames: Local<u32>| {
            *frames += 1;
            if *frames == 3 {
                exit(0);
            }
        })
        .run();
    exit(1)
}
