//! What a scene costs, with what it does not need left out: six typical scenes, each compiled with its own features.
//!
//! `python3 benches/leave_out/run.py` builds all of them and makes the table. By hand, for one:
//!
//! ```sh
//! cargo run --release -p pliant --no-default-features --features window --example leave_out -- --scene solo
//! ```
//!
//! No window and no graphics card: surfaces are written on the processor, to an image that nobody draws. Frames come sixty times a second, by the wall's clock, and each has a step.

#[cfg(feature = "net")]
mod partner;
mod scene;

use std::{
    error::Error,
    process::ExitCode,
    time::{Duration, Instant},
};

use bevy::{app::PluginsState, diagnostic::DiagnosticsStore, ecs::schedule::Schedules, prelude::*};
use clap::Parser;
use pliant::body::AWAKE_BODIES;
use scene::{Scene, Work};

#[derive(Parser)]
struct Options {
    /// Which scene; those whose features were not compiled are refused.
    #[arg(long, value_enum)]
    scene: Scene,
    /// Seconds that are measured, at rest and again at work.
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// For the other end of a session: join this invite (`host` to open one and print its invite) and stay until the input ends.
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
    // The engine alone first: what is beyond its systems is ours.
    let mut engine = App::new();
    scene::engine(&mut engine);
    let engine = systems(&mut engine);

    let mut app = App::new();
    scene::engine(&mut app);
    let mut company = scene::plugins(options.scene, &mut app)?;
    let all = systems(&mut app);
    scene::spawn(options.scene, &mut app, &mut company)?;

    // Long enough for bodies to come, to settle and to fall asleep, and for sessions to measure their way.
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

/// Readies an app, runs a frame of it, and counts the systems in its schedules.
fn systems(app: &mut App) -> usize {
    while app.plugins_state() == PluginsState::Adding {
        bevy::tasks::tick_global_task_pools_on_main_thread();
    }
    app.finish();
    app.cleanup();
    app.update();
    app.world().resource::<Schedules>().iter().map(|(_, schedule)| schedule.systems_len()).sum()
}

/// Runs frames at their pace; the time of each, ms.
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

/// Frames measured: what they cost the thread of the app, and the whole program.
fn measure(app: &mut App, seconds: f64) -> String {
    let before = processor();
    let (mut times, mut awake) = (Vec::new(), 0.0);
    for _ in 0..(seconds / 0.5).round().max(1.0) as usize {
        times.extend(frames(app, 0.5));
        awake += app
            .world()
            .resource::<DiagnosticsStore>()
            .get(&AWAKE_BODIES)
            .and_then(|found| found.measurement())
            .map_or(0.0, |newest| newest.value);
    }
    let spent = (processor() - before) * 1e3 / times.len() as f64;
    awake /= (seconds / 0.5).round().max(1.0);
    times.sort_by(f64::total_cmp);
    let at = |part: f64| times[((times.len() - 1) as f64 * part) as usize];
    format!(
        "{{\"frame_ms\": {:.4}, \"frame_ms_p99\": {:.4}, \"processor_ms\": {spent:.4}, \"awake\": {awake:.1}}}",
        at(0.5),
        at(0.99)
    )
}

/// Processor time of this program, all threads, s: of `/proc`, zero where there is none.
fn processor() -> f64 {
    let Ok(tasks) = std::fs::read_dir("/proc/self/task") else { return 0.0 };
    // The first number of `schedstat` is nanoseconds on a processor; the clock of `stat` ticks a hundred times a second only.
    let one = |path: std::path::PathBuf| -> Option<f64> {
        std::fs::read_to_string(path.join("schedstat")).ok()?.split(' ').next()?.parse().ok()
    };
    tasks.flatten().filter_map(|task| one(task.path())).sum::<f64>() * 1e-9
}
