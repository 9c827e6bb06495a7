//! Records what Pliant does to the [rerun](https://rerun.io) viewer or to a file.
//!
//! The recording contains shapes, reactions, metrics and log lines.
//!
//! ```no_run
//! use bevy::prelude::*;
//! use pliant_body::PliantBodyPlugin;
//! use pliant_rerun::RerunPlugin;
//!
//! App::new().add_plugins((DefaultPlugins, PliantBodyPlugin::default(), RerunPlugin::file("session.rrd"))).run();
//! ```
//!
//! The recording uses the timelines [`TICK`], [`SIM_TIME`] and [`WALL_TIME`]. It contains:
//!
//! | Path | Content |
//! | --- | --- |
//! | `world/NAME` | the deformed surface of every body, colored by displacement or stress ([`RerunColor`]); connectivity once, then positions |
//! | `world/hands` | every grab: its reaction as an arrow, its target, the line between |
//! | `reaction/NAME` | magnitude of the reaction, N, in the color of the hand's user |
//! | `displacement/NAME` | largest displacement of the surface, m |
//! | `energy/NAME` | kinetic and elastic energy of all modes together, J |
//! | `step/NAME` | time of a step of the body, us; bodies that are near other bodies, tools or rigid bodies share theirs |
//! | `stress/NAME` | largest von Mises stress in the skin, Pa, if the color shows the stress |
//! | `modes/NAME` | energy of each mode, J, as bars |
//! | `spectrum/NAME` | amplitude of the body's most compliant point at each frequency, m over Hz, in the last 256 ticks |
//! | `AREA/NAME` | every Bevy diagnostic under `pliant/AREA/`, such as those of the network; those of the body crate are `time/step` (ms per tick), `frame/deform` (ms per frame) and `bodies/awake` |
//! | any other | values set in [`RerunScalars`] |
//! | `log` | the elasticity of every body, refused inputs, lines written with [`RerunScalars::log`], and the app's log lines, with [`log_layer`] |
//!
//! With the feature `contact`, `world/contacts` holds an arrow for the force of each place where a
//! body touches. It ends there, and is green where it holds and red where it slides. An arrow of
//! half the largest body's size (without the scale of its entity) is the weight of the heaviest
//! body, and none is longer than twice that. `contact/NAME` is the magnitude of the sum of the
//! forces on that body, N, `contact/NAME/depth` the depth of its deepest place, m, and
//! `contact/NAME/places` the number of places.
//!
//! With the feature `net`, the hands include those of the session's other users, and the log
//! includes users who join or leave and the state of the connection. With the feature `haptics`,
//! `device/NAME/` holds the force, lateness and energy of every device, and the log includes the
//! faults of the devices. With [`RerunRecording::device_loops`], `device/NAME/loop/` holds every
//! period of the device loop.
//!
//! The recording includes a layout: the scene beside a plot for each kind of metric.
//!
//! The app never waits. Each sink has one thread of low priority, which logs from a bounded queue.
//! A full queue drops ticks and counts them ([`RerunStats`]). Resting bodies are not sent. Data
//! whose rate in [`RerunRecording`] is zero is not gathered. A missing or closed viewer is not an
//! error, and then costs nothing. The recording is complete after [`AppExit`](bevy::app::AppExit),
//! when the app is dropped, and when a panic unwinds it.
#![cfg_attr(docsrs, feature(doc_cfg))]
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod blueprint;
mod collect;
mod columns;
#[cfg(feature = "contact")]
mod contact;
mod cost;
mod frame;
#[cfg(feature = "haptics")]
mod haptics;
mod log_lines;
mod motion;
#[cfg(feature = "net")]
mod net;
mod plugin;
mod queue;
mod recorder;
mod scalars;
mod stress;
#[cfg(test)]
mod tests;
#[cfg(all(test, feature = "contact"))]
mod tests_contact;
#[cfg(test)]
mod tests_sinks;
#[cfg(test)]
mod tests_streams;
mod worker;

/// What threads share. A test puts a channel on loom's locks in its place.
mod sync {
    pub(crate) use crossbeam_channel::{Receiver, RecvTimeoutError, Sender, TryIter, TrySendError, bounded};
}

pub use log_lines::log_layer;
pub use plugin::{RerunColor, RerunError, RerunPlugin, RerunRecording, RerunStats, RerunStyle, RerunSystems};
pub use scalars::RerunScalars;

/// Timeline of the tick, [`PliantTick`](pliant_body::PliantTick).
pub const TICK: &str = "tick";

/// Timeline of simulated time, s.
pub const SIM_TIME: &str = "sim_time";

/// Timeline of wall time.
pub const WALL_TIME: &str = "wall_time";
