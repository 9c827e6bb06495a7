//! Two people hold one soft body over a network that loses packets.
//!
//! One process runs three apps on three threads: a host that steps the body, you, and a scripted
//! second user. They are connected by real QUIC on loopback. Between each guest and the host lies
//! one of the paper's networks (`--network 1` to `4`, or another by its name), emulated packet by
//! packet.
//!
//! What to learn here: how a body is shared (`host.rs`, ten lines), how a guest sees and holds it
//! (`guest.rs`), and how loss affects what you see and feel. The blue ghost is the newest true
//! state of the host.
//!
//! ```sh
//! cargo run --release --example shared_body
//! cargo run --release --example shared_body -- --headless --seconds 10 --rerun out.rrd
//! ```

mod guest;
mod hand;
mod host;
mod meter;
mod options;
#[path = "../stage/mod.rs"]
mod stage;
mod table;
mod view;

use std::{
    error::Error,
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    process::ExitCode,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread,
};

use bevy::math::DVec3;
use clap::Parser;
use pliant::{
    body::Integrator,
    modal::ModalModel,
    net::{Emulation, HostConfig, Invite, JoinConfig, JoinOptions, NetPlugin},
    rerun::RerunPlugin,
    stream::RecoveryConfig,
};

use guest::{Guest, GuestReport};
use hand::ScriptedHand;
use meter::Truth;
use options::{Options, Recovery};

/// Ticks per second, as in the paper.
const RATE: f64 = 40.0;

/// The name of the body in the session.
const BODY: &str = "pip";

fn main() -> ExitCode {
    let options = Options::parse();
    match run(&options) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("shared_body: {error}");
            ExitCode::from(2)
        }
    }
}

fn run(options: &Options) -> Result<(), Box<dyn Error>> {
    let mut options = options.clone();
    options.stage.check_window()?;
    let path = Path::new(stage::ASSETS).join(&options.body);
    let model = Arc::new(ModalModel::read(path)?);

    let hosting = NetPlugin::host(HostConfig::default())?;
    let invite = hosting.invite().cloned().ok_or("the host has no invite")?;
    let truth = Truth::default();
    let shared = host::Shared::default();
    let host_thread = {
        let (model, truth, shared) = (model.clone(), truth.clone(), shared.clone());
        // The receiver reads streamed accelerations by Newmark's formulas, so the host steps the
        // body by a method that satisfies them. A stream of reactions does not need this.
        let integrator = match options.recovery {
            Recovery::Default => Integrator::Exact,
            Recovery::Paper | Recovery::None => Integrator::GeneralizedAlpha { rho_inf: 0.5 },
        };
        thread::Builder::new()
            .name("host".into())
            .spawn(move || host::run(model, integrator, hosting, truth, shared))?
    };

    let stop_other = Arc::new(AtomicBool::new(false));
    let missing = Arc::new(AtomicUsize::new(2));
    let other = Guest {
        title: String::new(),
        hand: Some(ScriptedHand {
            toward: DVec3::new(-1.0, 0.55, 0.0),
            pull: DVec3::new(-0.17, 0.08, 0.07),
            wait: 0.0,
        }),
        rerun: None,
        duration: None,
        stage: stage::Options { headless: true, ..stage::Options::default() },
        stop: stop_other.clone(),
        missing: missing.clone(),
        ..guest(&options, "other", 2, &model, &invite, &truth)?
    };
    let other_thread =
        thread::Builder::new().name("other".into()).spawn(move || guest::run_headless(other, false))?;

    let scripted = options.stage.headless || options.stage.screenshot.is_some();
    let you = Guest {
        title: format!("network {}", options.network.name()),
        hand: scripted.then_some(ScriptedHand {
            toward: DVec3::new(1.0, 0.55, 0.0),
            pull: DVec3::new(0.18, 0.06, 0.13),
            wait: 0.7,
        }),
        rerun: recorder(&options)?,
        duration: options.duration(),
        missing,
        ..guest(&options, "you", 1, &model, &invite, &truth)?
    };
    let yours = if options.stage.headless {
        guest::run_headless(you, true)
    } else {
        // Without a graphics driver, the engine panics on this thread; the message offers an
        // alternative.
        catch_unwind(AssertUnwindSafe(|| guest::run_windowed(you)))
            .map_err(|_| "the window could not be opened; --headless runs without one")?
    };

    let hosted = shared.snapshot();
    stop_other.store(true, Ordering::Relaxed);
    let others = other_thread.join().map_err(|_| "the other guest's thread stopped")?;
    shared.stop.store(true, Ordering::Relaxed);
    host_thread.join().map_err(|_| "the host's thread stopped")?;

    table::print(&options, &hosted, &yours, &others);
    for file in options.stage.screenshot.iter().cloned().chain(recording(&options)) {
        if std::fs::metadata(&file).map_or(0, |found| found.len()) == 0 {
            return Err(format!("{} was not written", file.display()).into());
        }
    }
    match failure(&options, &yours, &others) {
        Some(why) => Err(why.into()),
        None => Ok(()),
    }
}

/// Creates a guest with its own link to the host.
fn guest(
    options: &Options,
    name: &str,
    number: u64,
    model: &Arc<ModalModel>,
    invite: &Invite,
    truth: &Truth,
) -> Result<Guest, Box<dyn Error>> {
    let seed = options.seed.wrapping_mul(1_000).wrapping_add(number);
    let config = JoinConfig {
        name: name.into(),
        transport: JoinOptions {
            emulation: Some(Emulation::preset(options.network, seed)),
            ..JoinOptions::default()
        },
        recovery: RecoveryConfig::by_name(options.recovery.name()).ok_or("no such recovery")?,
        models: vec![model.clone()],
        ..JoinConfig::default()
    };
    Ok(Guest {
        title: String::new(),
        net: NetPlugin::join(invite, config)?,
        truth: truth.clone(),
        hand: None,
        rerun: None,
        duration: None,
        stage: options.stage.clone(),
        stop: Arc::default(),
        missing: Arc::default(),
    })
}

fn recorder(options: &Options) -> Result<Option<RerunPlugin>, Box<dyn Error>> {
    Ok(match options.rerun.as_deref() {
        None => None,
        Some("viewer") => Some(RerunPlugin::viewer()),
        Some(file) => {
            // The plugin would continue without its file; here a missing file is an error.
            std::fs::File::create(file).map_err(|error| format!("--rerun {file}: {error}"))?;
            Some(RerunPlugin::file(file))
        }
    })
}

/// Returns the file of the recording, if there is one.
fn recording(options: &Options) -> Option<PathBuf> {
    options.rerun.as_deref().filter(|sink| *sink != "viewer").map(PathBuf::from)
}

fn failure(options: &Options, yours: &GuestReport, others: &GuestReport) -> Option<String> {
    let of = |who: &str, report: &GuestReport| report.failure.as_ref().map(|why| format!("{who}: {why}"));
    of("your session", yours).or_else(|| {
        // This process ends the other guest, so its goodbye is not a failure. A body that never
        // arrived is one, unless a window was closed first.
        (others.meters.streamed.ticks == 0
            && (options.duration().is_some() || options.stage.frames.is_some()))
        .then(|| of("the other session", others).unwrap_or("the other never saw the body".into()))
    })
}
