//! Shared parts of the networked examples.
//!
//! These are the body, emulated networks by name, stored keys, scripted hands, and an app without a
//! window.
#![allow(dead_code, reason = "each example uses the part that it needs")]

#[cfg(feature = "watch")]
pub mod publish;
pub mod serve;
pub mod trace;

use std::error::Error;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bevy::app::{ScheduleRunnerPlugin, TerminalCtrlCHandlerPlugin};
use bevy::log::{Level, LogPlugin};
use bevy::math::DVec3;
use bevy::prelude::*;
use pliant::modal::ModalModel;
use pliant::net::{Emulation, Identity, NetStats, User};
use pliant::prelude::*;
use pliant::stream::emulator::Preset;

/// The project's assets, from the crate that owns the examples.
pub const ASSETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets");

/// The name of the body in the session.
pub const BODY: &str = "pip";

/// Returns an emulated network by its name; `none` is the real network.
pub fn network(name: &str) -> Result<Option<Preset>, String> {
    if name == "none" {
        return Ok(None);
    }
    let names = || Preset::ALL.map(Preset::name).join(", ");
    Preset::by_name(name).map(Some).ok_or_else(|| format!("expected none, {}", names()))
}

/// Returns the network as a link under a session; the seed selects which packets it loses.
pub fn emulation(network: Option<Preset>, seed: u64) -> Option<Emulation> {
    network.map(|preset| Emulation::preset(preset, seed))
}

/// Returns the key in a file, which is created if it does not exist.
///
/// With the same key, a user or a host keeps its identity in the next run.
pub fn identity(file: Option<&Path>) -> Result<Option<Identity>, Box<dyn Error>> {
    Ok(file.map(Identity::at).transpose()?)
}

/// Reads a body from a file, or from the project's assets.
pub fn model(file: &Path) -> Result<Arc<ModalModel>, Box<dyn Error>> {
    let path = if file.exists() { PathBuf::from(file) } else { Path::new(ASSETS).join(file) };
    Ok(Arc::new(ModalModel::read(path)?))
}

/// Creates an app without a window or a renderer.
///
/// The app ends cleanly on Ctrl-C, and on SIGTERM after [`end_on_terminate`].
pub fn headless(level: Level) -> App {
    let mut app = App::new();
    app.add_plugins((
        MinimalPlugins.set(ScheduleRunnerPlugin::run_loop(Duration::from_millis(2))),
        // The library of relays tells of every track that is asked for.
        LogPlugin { level, filter: format!("{},moq_net=warn", bevy::log::DEFAULT_FILTER), ..default() },
        TerminalCtrlCHandlerPlugin,
        AssetPlugin { file_path: ASSETS.into(), ..default() },
        TransformPlugin,
    ));
    app
}

/// Makes SIGTERM end the app cleanly, as Ctrl-C does: goodbyes are sent and files are finished.
///
/// Call this before any other thread is created. A thread that exists already would let the signal
/// end the process at once.
pub fn end_on_terminate() {
    #[cfg(unix)]
    on_signals(&[nix::sys::signal::Signal::SIGTERM], TerminalCtrlCHandlerPlugin::gracefully_exit);
}

/// Returns a flag that Ctrl-C or SIGTERM sets, for a program without an app.
///
/// A second signal ends the process at once.
pub fn stopped() -> Arc<AtomicBool> {
    let stopped = Arc::new(AtomicBool::new(false));
    #[cfg(unix)]
    {
        use nix::sys::signal::Signal::{SIGINT, SIGTERM};
        let flag = stopped.clone();
        on_signals(&[SIGINT, SIGTERM], move || {
            if flag.swap(true, Ordering::Relaxed) {
                std::process::exit(i32::from(CTRL_C));
            }
        });
    }
    stopped
}

/// Blocks the signals in all threads except one, which waits for them.
#[cfg(unix)]
fn on_signals(signals: &[nix::sys::signal::Signal], act: impl Fn() + Send + 'static) {
    let set: nix::sys::signal::SigSet = signals.iter().copied().collect();
    if set.thread_block().is_ok() {
        std::thread::spawn(move || {
            while set.wait().is_ok() {
                act();
            }
        });
    }
}

/// Exit code of Bevy after Ctrl-C, by the convention of shells.
const CTRL_C: u8 = 130;

/// Returns an error if the app has failed. Ctrl-C is not a failure.
pub fn ended(exit: &AppExit) -> Result<(), Box<dyn Error>> {
    match exit {
        AppExit::Error(code) if code.get() != CTRL_C => Err("the session is over".into()),
        AppExit::Success | AppExit::Error(_) => Ok(()),
    }
}

/// A hand that grabs the farthest point of a body in some direction and moves it.
#[derive(Component, Debug, Clone, Copy)]
pub struct Script {
    /// Direction of the grabbed point, in body axes.
    pub toward: DVec3,
    /// Displacement of the hand, as fractions of the body's size.
    pub pull: DVec3,
    /// Angular frequency of the motion, rad/s.
    pub rate: f64,
}

impl Script {
    /// Returns the script of one number; scripts of different numbers move differently.
    pub fn of(number: u64) -> Self {
        let angle = 2.4 * number as f64;
        let side = if number.is_multiple_of(2) { 1.0 } else { -1.0 };
        Self {
            toward: DVec3::new(side, 0.55, 0.1 * angle.sin()),
            pull: DVec3::new(0.12 * side, 0.05 * angle.cos(), 0.10 * angle.sin()),
            rate: 1.7 + 0.3 * (number % 5) as f64,
        }
    }
}

/// The grab that a script has made, and the rest position of its patch.
#[derive(Component, Debug, Clone, Copy)]
pub struct Scripted {
    script: Script,
    at_rest: DVec3,
    began: f64,
}

/// Plays every [`Script`] on its body; runs in `FixedUpdate`, before [`PliantSystems::Input`].
pub fn play(
    mut commands: Commands,
    time: Res<Time>,
    bodies: Query<(Entity, &Script, &BodyState, &GlobalTransform)>,
    mut grabs: Query<(&mut Grab, &GrabOf, &Scripted)>,
) {
    let now = time.elapsed_secs_f64();
    for (body, script, state, place) in &bodies {
        let mut own = grabs.iter_mut().filter(|(_, of, _)| of.0 == body);
        if let Some((mut grab, _, scripted)) = own.next() {
            let t = now - scripted.began;
            // The hand moves slowly to its displacement, then about it on a path that does not
            // repeat soon.
            let rise = 1.0 - (-t / 0.6).exp();
            let wave = |part: f64| 0.4 * ((script.rate * part * t).sin());
            let about = DVec3::new(wave(1.0), wave(1.37), wave(0.81)) * script.pull.length();
            grab.target = scripted.at_rest + state.model().size() * rise * (script.pull + about);
        } else {
            let surface = state.model().surface();
            let along = |p: &[f32; 3]| Vec3::from_array(*p).as_dvec3().dot(script.toward);
            let positions = surface.positions();
            let far =
                (0..positions.len()).max_by(|&a, &b| along(&positions[a]).total_cmp(&along(&positions[b])));
            let Some(vertex) = far else { continue };
            let at = place.transform_point(Vec3::from(positions[vertex])).as_dvec3();
            commands.spawn((
                Grab::new(vertex as u32, 0.06 * state.model().size(), at),
                GrabOf(body),
                Scripted { script: *script, at_rest: at, began: now },
            ));
        }
    }
}

/// Prints a line of network metrics once per second, for runs without a window.
pub fn print_status(
    time: Res<Time<Real>>,
    stats: Res<NetStats>,
    users: Query<&User>,
    forces: Query<&GrabForce, With<Grab>>,
    mut last: Local<f64>,
) {
    let now = time.elapsed_secs_f64();
    if now < *last + 1.0 {
        return;
    }
    *last = now;
    let force = forces.iter().map(|felt| felt.force.length()).fold(0.0, f64::max);
    println!(
        "{now:6.1} s  {} users  round trip {:5.1} ms  loss {:4.1} % in {:4.1} % out  {:6.0} kbit/s in {:6.0} out  \
         guessed {} corrected {}  reaction {force:.2} N",
        users.iter().count(),
        stats.round_trip.as_secs_f64() * 1e3,
        stats.loss_in * 100.0,
        stats.loss_out * 100.0,
        stats.bytes_in_per_s * 8e-3,
        stats.bytes_out_per_s * 8e-3,
        stats.guessed,
        stats.recovered,
    );
}

/// When the app ends by itself.
#[derive(Resource, Clone, Copy, Debug, Default)]
pub struct EndAfter {
    /// Seconds after the start.
    pub seconds: Option<f64>,
    /// Frames after a body exists.
    pub frames: Option<u64>,
}

/// Ends the app when its time is over.
pub fn end(
    time: Res<Time<Real>>,
    mut after: ResMut<EndAfter>,
    bodies: Query<(), With<BodyState>>,
    mut exit: MessageWriter<AppExit>,
) {
    if let Some(frames) = after.frames.as_mut().filter(|_| !bodies.is_empty()) {
        *frames = frames.saturating_sub(1);
    }
    if after.frames == Some(0) || after.seconds.is_some_and(|after| time.elapsed_secs_f64() >= after) {
        exit.write(AppExit::Success);
    }
}

/// Returns the processor time, s, and the memory, MB, of this process if the system reports them.
pub fn used() -> Option<(f64, f64)> {
    used_by("self")
}

/// As [`used`], of the process with a number.
pub fn used_by(process: &str) -> Option<(f64, f64)> {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // After the name in parentheses, fields 14 and 15 are the ticks in user and in system mode, 10
    // ms each.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |at: usize| fields.get(at)?.parse::<f64>().ok();
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kilobytes: f64 = resident.trim().trim_end_matches("kB").trim().parse().ok()?;
    Some(((ticks(11)? + ticks(12)?) / 100.0, kilobytes / 1e3))
}
