//! The live panel over a scene: bodies, users and network, devices, time and the recording, with their knobs and plots.
//!
//! ```no_run
//! use bevy::prelude::*;
//! use pliant_body::PliantBodyPlugin;
//! use pliant_panel::PanelPlugin;
//!
//! fn main() {
//!     App::new().add_plugins((DefaultPlugins, PliantBodyPlugin::default(), PanelPlugin::default())).run();
//! }
//! ```
//!
//! `F1` opens and closes it; Tab and the arrow keys reach every knob. While it has the pointer, neither the pointer nor a tool that the pointer moves grabs
//! a body through it; what else pointer and keys do in a scene is asked of [`wants_pointer`] and [`wants_keyboard`]. It shows what other plugins
//! publish, and a section appears once its plugin is there: nothing of the network, a device or a recording is asked for by this one. Closed, it
//! gathers and draws nothing; of a body whose header is closed it gathers name and state.
//!
//! Each part is a function over [`egui::Ui`] and a plain struct, for a panel of your own: [`bodies::show`], [`time::show`], [`network::show`], [`device::show`],
//! [`recording::show`]. A knob changes its field of the struct; taking it over is up to you, as [`PanelPlugin`] does.
//!
//! # Features
//!
//! `net`, `haptics`, `rerun`: the sections about them.
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

pub mod bodies;
pub mod device;
mod knob;
pub mod network;
mod plugin;
pub mod recording;
pub mod time;
mod trace;

pub use bevy_egui::{self, egui};
pub use plugin::{Panel, PanelPlugin, PanelSection, wants_keyboard, wants_pointer};
pub use trace::{Trace, plot};
