//! The control loop and its plugin, with devices that are simulated.
//!
//! One program, since linking one for each of these files would take longer than their tests.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
mod drag;
mod faults;
mod held_patches;
mod hitches;
mod plugin;
mod rig;
mod sources;
mod stability;
mod strokes;
mod tool;
mod touch;
