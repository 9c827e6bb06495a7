//! Joins a session with an invite that a host has printed: `join pliant://…`.
//!
//! In a window, the mouse pulls the body. With `--headless`, a hand moves by itself. `--bots 100`
//! makes load. `--replay FILE` shows a session that was recorded with `--record FILE`.
//!
//! What to learn here: a guest needs one plugin and no scene of its own, because the bodies arrive
//! over the session. The same app plays recordings. The guest waits for a lost host and reconnects.
//!
//! ```sh
//! cargo run --release --example join -- "pliant://127.0.0.1:4433#…"
//! cargo run --release --example join -- "pliant://…" --headless --network paper-1 --seconds 20
//! ```

mod bots;
#[path = "../session/mod.rs"]
mod session;
#[cfg(feature = "window")]
#[path = "../stage/mod.rs"]
mod stage;
// Without a window, only the command line of the stage is used.
#[cfg(not(feature = "window"))]
#[path = "../stage/options.rs"]
#[expect(dead_code, reason = "no window has a size, a scale, a panel")]
mod stage;
#[cfg(feature = "window")]
mod window;

use std::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;

use bevy::log::Level;
use bevy::prelude::*;
use clap::Parser;
use pliant::net::{
    CameraInterest, Invite, JoinConfig, JoinOptions, NetGuest, NetPlugin, RemoteBody, SessionClosed,
    SessionFailed, SessionJoined, SessionLost, SessionRecording, SharedBody,
};
use pliant::prelude::*;
use pliant::stream::emulator::Preset;

/// Joins a session.
#[derive(Parser, Debug)]
#[command(mut_arg("headless", |headless| headless.help("No window: a hand moves by itself, a line a second says how it goes")))]
#[command(mut_arg("seconds", |seconds| seconds.help("End after so many seconds. Default: when the session ends, or the window is closed")))]
pub struct Options {
    #[command(flatten)]
    stage: stage::Options,

    /// The invite that the host has printed.
    #[arg(required_unless_present_any = ["replay", "compare"])]
    invite: Option<Invite>,

    /// Your name in the session.
    #[arg(long, default_value = "guest")]
    name: String,

    /// A file with your key, created if it does not exist; with the same key you are the same user
    /// again.
    #[arg(long)]
    key: Option<PathBuf>,

    /// An emulated network under the connection: none, paper-1 to paper-4, lan, wifi and others.
    #[arg(long, default_value = "none", value_parser = session::network)]
    network: std::option::Option<Preset>,

    /// Seed that selects which packets the emulated network loses.
    #[arg(long, default_value_t = 1)]
    seed: u64,

    /// Use at most this many modes of each body.
    #[arg(long)]
    modes: Option<u16>,

    /// Use the local model of the body, so that the host does not send it.
    #[arg(long)]
    cached: bool,

    /// The local model: a file, or a file name under assets/.
    #[arg(long, default_value = "pip.modal")]
    body: PathBuf,

    /// Only watch.
    #[arg(long)]
    still: bool,

    /// Record everything that is received to this file.
    #[arg(long)]
    record: Option<PathBuf>,

    /// Show a recorded session.
    #[arg(long, conflicts_with = "record")]
    replay: Option<PathBuf>,

    /// Write what is shown for each tick to this file.
    #[arg(long)]
    trace: Option<PathBuf>,

    /// Compare what a guest has shown with what the host computed: two files of --trace, the host's
    /// first.
    #[arg(long, num_args = 2, value_names = ["HOST", "GUEST"])]
    compare: Vec<PathBuf>,

    /// Run this many guests without an app, for load.
    #[arg(long)]
    bots: Option<usize>,

    /// Number of bots that hold the body.
    #[arg(long, default_value_t = 0)]
    holders: usize,

    /// Let the bots count what they receive and step no body.
    #[arg(long)]
    light: bool,
}

fn main() -> ExitCode {
    match run(Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("join: {error}");
            ExitCode::from(2)
        }
    }
}

fn run(mut options: Options) -> Result<(), Box<dyn Error>> {
    options.stage.headless |= cfg!(not(feature = "window"));
    if options.bots.is_none() && options.compare.is_empty() {
        options.stage.check_window()?;
    }
    let options = &options;
    let shipped = || session::model(&options.body);
    if let [host, guest] = options.compare.as_slice() {
        // The first five seconds contain the clock synchronization and the grab.
        return session::trace::compare(&*shipped()?, host, guest, 200);
    }
    let emulation = session::emulation(options.network, options.seed);
    if let (Some(number), Some(invite)) = (options.bots, &options.invite) {
        let (holders, light, seconds) =
            (options.holders, options.light, options.stage.seconds.unwrap_or(10.0));
        let (cached, stopped) = (options.cached, session::stopped());
        let bots = bots::Bots { number, holders, light, cached, seconds, emulation, stopped };
        return bots::run(invite, &shipped()?, &bots);
    }
    session::end_on_terminate();
    let config = JoinConfig {
        name: options.name.clone(),
        transport: JoinOptions {
            identity: session::identity(options.key.as_deref())?,
            emulation,
            ..default()
        },
        modes: options.modes,
        // In a screenshot run the camera is off until just before the picture, so its view says
        // nothing.
        interest: Some(CameraInterest::default()).filter(|_| {
            cfg!(feature = "window") && !options.stage.headless && options.stage.screenshot.is_none()
        }),
        models: if options.cached { vec![shipped()?] } else { Vec::new() },
        record: options.record.clone(),
        ..default()
    };
    let net = match (&options.replay, &options.invite) {
        (Some(file), _) => NetPlugin::replay(SessionRecording::open(file)?, config),
        (None, Some(invite)) => NetPlugin::join(invite, config)?,
        (None, None) => return Err("an invite is needed".into()),
    };
    #[cfg(feature = "window")]
    if !options.stage.headless {
        return window::run(options, net);
    }
    let mut app = session::headless(Level::WARN);
    app.add_plugins((PliantBodyPlugin::default(), net)).add_systems(Update, session::print_status);
    finish(&mut app, options)?;
    session::ended(&app.run())
}

/// Adds what the app does with a window and without.
fn finish(app: &mut App, options: &Options) -> Result<(), Box<dyn Error>> {
    if let Some(file) = &options.trace {
        app.insert_resource(session::trace::Trace::create(file)?)
            .add_systems(Last, session::trace::write_shown);
    }
    app.insert_resource(session::EndAfter { seconds: options.stage.seconds, frames: options.stage.frames })
        .add_systems(Last, session::end)
        .add_systems(Update, print_events);
    if options.stage.headless && !options.still && options.replay.is_none() {
        let number = options.seed;
        let script = move |mut commands: Commands, bodies: Query<Entity, Added<RemoteBody>>| {
            for body in &bodies {
                commands.entity(body).insert(session::Script::of(number));
            }
        };
        app.add_systems(Update, script).add_systems(FixedUpdate, session::play.before(PliantSystems::Input));
    }
    Ok(())
}

/// Prints the events of the session and ends the app with it.
fn print_events(
    time: Res<Time<Real>>,
    mut joined: MessageReader<SessionJoined>,
    mut lost: MessageReader<SessionLost>,
    mut closed: MessageReader<SessionClosed>,
    mut exit: MessageWriter<AppExit>,
    mut failed: MessageReader<SessionFailed>,
    guest: Option<Res<NetGuest>>,
    shown: Query<&SharedBody, (With<RemoteBody>, Added<VisualState>)>,
) {
    let now = time.elapsed_secs_f64();
    for joined in joined.read() {
        println!(
            "{now:6.2} s  in as user {}{}",
            joined.user.0,
            if joined.reconnected { " again" } else { "" }
        );
    }
    for lost in lost.read() {
        println!("{now:6.2} s  lost the connection to the host: {}", lost.reason);
    }
    for body in &shown {
        println!("{now:6.2} s  a body is here: {}", body.name);
    }
    for closed in closed.read() {
        println!("{now:6.2} s  over: {}", closed.reason);
        // The end of a recording is a success, not an error. Without a guest the user has left.
        let well = guest.as_ref().is_none_or(|guest| guest.is_replay());
        exit.write(if well { AppExit::Success } else { AppExit::error() });
    }
    for failed in failed.read() {
        println!("{now:6.2} s  {}", failed.reason);
        exit.write(AppExit::error());
    }
}
