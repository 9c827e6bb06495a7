//! A server without a window or a renderer: invited users see and hold one body.
//!
//! What to learn here:
//!
//! - A host is an app like any other, with only the plugins that it needs.
//! - Tokens decide what each user may do.
//! - With a stored key, the invite stays valid when the server restarts.
//! - Ctrl-C shuts the server down cleanly, and so does the SIGTERM of a service manager.
//!
//! ```sh
//! cargo run --release -p pliant_examples --no-default-features --features net --example dedicated_server -- --key server.key
//! ```

mod session;

use std::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

use bevy::log::Level;
use bevy::prelude::*;
use clap::Parser;
use pliant::net::transport::{Limits, RateCap};
use pliant::net::{NetHost, NetStats, SharedBody, User};
use pliant::prelude::*;

/// Serves one soft body.
#[derive(Parser, Debug)]
struct Options {
    #[command(flatten)]
    serve: session::serve::Serve,

    /// Ticks per second.
    #[arg(long, default_value_t = 40.0, value_parser = rate)]
    hz: f64,

    /// The body: a file, or a file name under assets/.
    #[arg(long, default_value = "pip.modal")]
    body: PathBuf,

    /// Keep only this many modes, lowest first.
    #[arg(long)]
    modes: Option<usize>,

    /// Let a hand of the server move the body.
    #[arg(long)]
    play: bool,

    /// Maximum number of guests, in total and from one address.
    #[arg(long, default_value_t = 256)]
    guests: usize,

    /// Maximum rate to one guest, Mbit/s.
    #[arg(long, default_value_t = 8.0)]
    rate: f64,

    #[cfg(feature = "watch")]
    #[command(flatten)]
    watchers: session::publish::Publish,

    /// Write the state of every tick to this file, for `join --compare`.
    #[arg(long)]
    trace: Option<PathBuf>,

    /// End after this many seconds.
    #[arg(long)]
    seconds: Option<f64>,
}

fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(hz) if (1.0..=1000.0).contains(&hz) => Ok(hz),
        _ => Err("expected 1 to 1000".into()),
    }
}

fn main() -> ExitCode {
    match run(&Options::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("dedicated_server: {error}");
            ExitCode::from(2)
        }
    }
}

fn run(options: &Options) -> Result<(), Box<dyn Error>> {
    session::end_on_terminate();
    let model = session::model(&options.body)?;
    let limits = Limits {
        peers: options.guests,
        per_address: options.guests,
        rate: RateCap::from_mbit_per_s(options.rate),
        ..Limits::host()
    };
    let net = options.serve.open("server", limits)?;
    let mut app = session::headless(Level::INFO);
    app.add_plugins((PliantBodyPlugin::default(), net))
        .insert_resource(Time::<Fixed>::from_hz(options.hz))
        .insert_resource(session::EndAfter { seconds: options.seconds, frames: None })
        .init_resource::<Log>()
        .add_systems(First, begin_frame)
        .add_systems(FixedUpdate, session::play.before(PliantSystems::Input))
        .add_systems(Last, (end_frame, session::end).chain());
    let asset = app.world_mut().resource_mut::<Assets<ModalAsset>>().add(ModalAsset::from(model));
    let body = ModalBody { modes: options.modes, ..ModalBody::new(asset) };
    let body = app.world_mut().spawn((body, SharedBody::named(session::BODY))).id();
    if options.play {
        app.world_mut().entity_mut(body).insert(session::Script::of(0));
    }
    #[cfg(feature = "watch")]
    options.watchers.add_to(&mut app)?;
    if let Some(file) = &options.trace {
        app.insert_resource(session::trace::Trace::create(file)?)
            .add_systems(FixedUpdate, session::trace::write_truth.after(PliantSystems::Publish));
    }
    app.run();
    Ok(())
}

/// Durations of the frames that contain a tick, without the work on the network's thread.
#[derive(Resource, Default)]
struct Log {
    began: Option<Instant>,
    tick: u64,
    /// Durations since the last line, ms.
    took: Vec<f64>,
    said: Option<(Instant, f64, u64, u64)>,
}

fn begin_frame(mut log: ResMut<Log>) {
    log.began = Some(Instant::now());
}

/// Prints a line of metrics every ten seconds.
fn end_frame(
    mut log: ResMut<Log>,
    tick: Res<PliantTick>,
    host: Option<Res<NetHost>>,
    stats: Res<NetStats>,
    users: Query<&User>,
) {
    let now = Instant::now();
    let Some(began) = log.began.take() else { return };
    if tick.0 != log.tick {
        log.tick = tick.0;
        log.took.push((now - began).as_secs_f64() * 1e3);
    }
    let (processor, memory) = session::used().unwrap_or_default();
    let bytes = stats.bytes_out;
    let Some((since, processor_then, bytes_then, ticks_then)) = log.said else {
        log.said = Some((now, processor, bytes, tick.0));
        return;
    };
    let passed = (now - since).as_secs_f64();
    if passed < 10.0 || host.is_none() {
        return;
    }
    log.said = Some((now, processor, bytes, tick.0));
    log.took.sort_by(f64::total_cmp);
    let part = |share: f64| log.took.get((log.took.len() as f64 * share) as usize).copied().unwrap_or(0.0);
    println!(
        "{} users, {:.1} ticks/s, a tick {:.2} ms in the median, {:.2} at 99 %, {:.2} at most; processor {:.0} %, memory {memory:.0} MB, \
         {:.1} Mbit/s out, {} dropped",
        users.iter().count().saturating_sub(1),
        (tick.0 - ticks_then) as f64 / passed,
        part(0.5),
        part(0.99),
        log.took.last().copied().unwrap_or(0.0),
        100.0 * (processor - processor_then) / passed,
        bytes.saturating_sub(bytes_then) as f64 * 8e-6 / passed,
        stats.dropped.send_queue_full,
    );
    log.took.clear();
}
