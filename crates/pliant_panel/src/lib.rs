//! The live panel over a scene: bodies, users, network, devices, time and the recording.
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
//! `F1` opens and closes the panel. Tab and the arrow keys reach every knob. While the panel has
//! the pointer, neither the pointer nor a tool that the pointer moves grabs a body through the
//! panel. For other uses of the pointer and the keys in a scene see [`wants_pointer`] and
//! [`wants_keyboard`]. The panel shows what other plugins publish, and a section appears when its
//! plugin is there. The panel itself needs no network, device or recording. A closed panel gathers
//! and draws nothing. For a body whose header is closed the panel gathers only the name and the
//! state.
//!
//! Each part is a function over [`egui::Ui`] with a plain struct, which other panels can use:
//! [`bodies::show`], [`time::show`], [`network::show`], [`device::show`], [`recording::show`]. A
//! knob changes its field of the struct. The caller applies the change, as [`PanelPlugin`] does.
//!
//! # Features
//!
//! `net`, `haptics`: the sections for the session and the devices. `contact`: what each body
//! touches, and with which force. The section for a recording appears with the resource
//! [`PanelRecording`], which `pliant` keeps for the rerun viewer.
#![cfg_attr(docsrs, feature(doc_cfg))]
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
pub use plugin::{Panel, PanelPlugin, PanelRecording, PanelSection, wants_keyboard, wants_pointer};
pub use trace::{Trace, plot};
