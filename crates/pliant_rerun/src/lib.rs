//! Streams what Pliant does to the [rerun](https://rerun.io) viewer or to a file: shapes, reactions, figures, lines of text.
//!
//! ```no_run
//! use bevy::prelude::*;
//! use pliant_body::PliantBodyPlugin;
//! use pliant_rerun::RerunPlugin;
//!
//! App::new().add_plugins((DefaultPlugins, PliantBodyPlugin::default(), RerunPlugin::file("session.rrd"))).run();
//! ```
//!
//! What is recorded, on the timelines [`TICK`], [`SIM_TIME`] and [`WALL_TIME`]:
//!
//! | Path | What |
//! | --- | --- |
//! | `world/NAME` | the deformed surface of every body, colored by displacement or stress ([`RerunColor`]); connectivity once, then positions |
//! | `world/hands` | every grab: its reaction as an arrow, its target, the line between |
//! | `reaction/NAME` | magnitude of the reaction, N, in the color of the hand's user |
//! | `displacement/NAME` | largest displacement of the surface, m |
//! | `energy/NAME` | kinetic and elastic energy of all modes together, J |
//! | `stress/NAME` | largest von Mises stress in the skin, Pa, when that is the color |
//! | `modes/NAME` | energy of each mode, J, as bars |
//! | `spectrum/NAME` | how far the loosest point of the body swings at each frequency, m over Hz, in the last 256 ticks |
//! | `AREA/NAME` | every Bevy diagnostic under `pliant/AREA/`, as the network has them; the body crate's are `time/step` (ms a tick), `frame/deform` (ms a frame) and `bodies/awake` |
//! | any other | what anybody sets in [`RerunScalars`] |
//! | `log` | what was refused, what is written with [`RerunScalars::say`], and what the app logs, with [`log_layer`] |
//!
//! With the feature `net`, the hands of a session's other users are among the hands, and who comes and goes and how the connection stands
//! is in the log. With the feature `haptics`, `device/NAME/` has the force, lateness and energy of every device, and the log its faults; with
//! [`RerunRecording::device_loops`] `device/NAME/loop/` has every period of its loop.
//!
//! A layout comes with the recording: the scene beside a plot for each kind of figure.
//!
//! The app never waits: one thread of low priority a sink logs from a bounded queue, which drops and counts what it has no room for
//! ([`RerunStats`]). Bodies that rest are not sent, and what [`RerunRecording`] gives a rate of zero is not gathered. A viewer that is not there, or is closed, is no error, and costs nothing from then on.
//! The recording is whole after [`AppExit`](bevy::app::AppExit), when the app is dropped, and when a panic unwinds it.
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod blueprint;
mod collect;
mod columns;
mod frame;
#[cfg(feature = "haptics")]
mod haptics;
mod log_lines;
mod motion;
#[cfg(feature = "net")]
mod net;
mod plugin;
mod recorder;
mod scalars;
mod stress;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_sinks;
#[cfg(test)]
mod tests_streams;
mod worker;

pub use log_lines::log_layer;
pub use plugin::{RerunColor, RerunError, RerunPlugin, RerunRecording, RerunStats, RerunStyle, RerunSystems};
pub use scalars::RerunScalars;

/// Timeline: the tick, [`PliantTick`](pliant_body::PliantTick).
pub const TICK: &str = "tick";

/// Timeline: simulated time, s.
pub const SIM_TIME: &str = "sim_time";

/// Timeline: wall time.
pub const WALL_TIME: &str = "wall_time";
