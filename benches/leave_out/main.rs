//! Cost of a scene without the features that it does not need: ten scenes, each compiled
//! with its own features.
//!
//! `python3 benches/leave_out/run.py` builds all scenes and writes the table. To run one scene by
//! hand:
//!
//! ```sh
//! cargo run --release -p pliant_examples --no-default-features --features window --example leave_out -- --scene solo
//! ```
//!
//! The program uses no window and no graphics card. Surfaces are written on the CPU, to an image
//! that is never rendered. The program runs sixty frames a second in real time, and each frame has
//! one step.

#[cfg(feature = "net")]
mod partner;
mod scene;

use std::{
    error::Error,
    process::ExitCode,
    time::{Duration, Instant},
};

use bevy::{
    app::PluginsState,
    diagnostic::{DiagnosticPath, DiagnosticsStore},
    ecs::schedule::Schedules,
    prelude::*,
};
use clap::Parser;
use pliant::body::{AWAKE_BODIES, STEP_TIME};
use scene::{Scene, Work};

#[derive(Parser)]
struct Options {
    /// The scene. A scene whose features were not compiled is refused.
    #[arg(long, value_enum)]
    scene: Scene,
    /// Seconds to measure at rest and again at work.
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Run as the other end of a session: join this invite, or open a session and print its invite
    /// (`host`), and stay until the input ends.
    #[arg(long, hide = true)]
    partner: Option<String>,
}

/// Frames a second.
const HZ: f64 = 60.0;

fn main() -> ExitCode {
    let options = Options::parse();
    let done = match &options.partner {
        #[cfg(feature = "net")]
        Some(invite) => partner::play(invite),
        _ => run(&options),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("leave_out: {error}");
            ExitCode::from(2)
        }
    }
}

fn run(options: &Options) -> Result<(), Box<dyn Error>> {
    if !(0.5..=600.0).contains(&options.seconds) {
        return Err(format!("--seconds: expected 0.5 to 600, got {}", options.seconds).into());
    }
    // Count the engine's systems alone first. All further systems belong to this project.
    let mut engine = App::new();
    scene::engine(&mut engine);
    let engine = systems(&mut engine);

    let mut app = App::new();
    scene::engine(&mut app);
    let mut company = scene::plugins(options.scene, &mut app)?;
    let all = systems(&mut app);
    scene::spawn(options.scene, &mut app, &mut company)?;

    // Wait until bodies have loaded, settled and fallen asleep, and sessions have measured their
    // path.
    frames(&mut app, 4.0);
    let rest = measure(&mut app, options.seconds);
    app.insert_resource(Work(true));
    frames(&mut app, 1.0);
    let work = measure(&mut app, options.seconds);
    println!(
        "{{\"scene\": \"{}\", \"systems\": {all}, \"engine_systems\": {engine}, \"rest\": {rest}, \"work\": {work}}}",
        options.scene.name()
    );
    drop(company);
    Ok(())
}

/// Initializes an app, runs one frame and counts the systems in its schedules.
fn systems(app: &mut App) -> usize {
    while app.plugins_state() == PluginsState::Adding {
        bevy::tasks::tick_global_task_pools_on_main_thread();
    }
    app.finish();
    app.cleanup();
    app.update();
    app.world().resource::<Schedules>().iter().map(|(_, schedule)| schedule.systems_len()).sum()
}

/// Runs frames at `HZ` and returns the time of each, ms.
fn frames(app: &mut App, seconds: f64) -> Vec<f64> {
    let count = (seconds * HZ) as u32;
    let begun = Instant::now();
    (0..count)
        .map(|frame| {
            let due = begun + Duration::from_secs_f64(f64::from(frame) / HZ);
            std::thread::sleep(due.saturating_duration_since(Instant::now()));
            let start = Instant::now();
            app.update();
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect()
}

fn newest(app: &App, path: &DiagnosticPath) -> f64 {
    let store = app.world().resource::<DiagnosticsStore>();
    store.get(path).and_then(|found| found.measurement()).map_or(0.0, |newest| newest.value)
}

/// Measures frames: the time on the app's thread and the CPU time of the whole program.
fn measure(app: &mut App, seconds: f64) -> String {
    let before = processor();
    let (mut times, mut steps, mut awake) = (Vec::new(), Vec::new(), 0.0);
    for _ in 0..(seconds / 0.5).round().max(1.0) as usize {
        times.extend(frames(app, 0.5));
        awake += newest(app, &AWAKE_BODIES);
        steps.push(newest(app, &STEP_TIME));
    }
    let spent = (processor() - before) * 1e3 / times.len() as f64;
    awake /= (seconds / 0.5).round().max(1.0);
    times.sort_by(f64::total_cmp);
    steps.sort_by(f64::total_cmp);
    let step = steps[steps.len() / 2];
    let at = |part: f64| times[((times.len() - 1) as f64 * part) as usize];
    format!(
        "{{\"frame_ms\": {:.4}, \"frame_ms_p99\": {:.4}, \"processor_ms\": {spent:.4}, \"awake\": {awake:.1}, \"step_ms\": {step:.4}}}",
        at(0.5),
        at(0.99)
    )
}

/// CPU time of all threads of this program, s, from `/proc`. Zero on systems without it.
fn processor() -> f64 {
    let Ok(tasks) = std::fs::read_dir("/proc/self/task") else { return 0.0 };
    // The first number of `schedstat` is the time on a CPU in nanoseconds. The clock of `stat`
    // ticks only a hundred times a second.
    let one = |path: std::path::PathBuf| -> Option<f64> {
        std::fs::read_to_string(path.join("schedstat")).ok()?.split(' ').next()?.parse().ok()
    };
    tasks.flatten().filter_map(|task| one(task.path())).sum::<f64>() * 1e-9
}
