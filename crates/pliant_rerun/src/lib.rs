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
//! | `world/NAME` | the deformed surface of every body, coloured by displacement; connectivity once, then positions |
//! | `world/hands` | every grab: its reaction as an arrow, its target, the line between |
//! | `reaction/NAME` | magnitude of the reaction, N |
//! | `displacement/NAME` | largest displacement of the surface, m |
//! | `AREA/NAME` | every Bevy diagnostic under `pliant/AREA/`, as the network and the step have them; `time/` for those without an area |
//! | any other | what anybody sets in [`RerunScalars`] |
//! | `log` | what was refused, and what is written with [`RerunScalars::say`] |
//!
//! With the feature `net`, the hands of a session's other users are among the hands, and who comes and goes is in the log.
//!
//! A layout comes with the recording: the scene beside a plot for each kind of figure.
//!
//! The app never waits: one thread a sink logs from a bounded queue, which drops and counts what it has no room for
//! ([`RerunStats`]). Bodies that rest are not sent. A viewer that is not there is no error, and costs nothing from then on. The recording
//! is whole after [`AppExit`](bevy::app::AppExit), when the app is dropped, and when a panic unwinds it.
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod blueprint;
mod collect;
mod frame;
#[cfg(feature = "net")]
mod net;
mod plugin;
mod recorder;
mod scalars;
#[cfg(test)]
mod tests;
mod worker;

pub use plugin::{RerunError, RerunPlugin, RerunRecording, RerunStats, RerunStyle, RerunSystems};
pub use scalars::RerunScalars;

/// Timeline: the tick, [`PliantTick`](pliant_body::PliantTick).
pub const TICK: &str = "tick";

/// Timeline: simulated time, s.
pub const SIM_TIME: &str = "sim_time";

/// Timeline: wall time.
pub const WALL_TIME: &str = "wall_time";
