//! Whole scenes: files, settings, models, and what of them an app has.
//!
//! One program, since linking the engine to each of these files would take longer than their tests.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

#[path = "blender.rs"]
mod blender;
mod durable;
mod gravity;
mod inspector;
mod leave_out;
mod reflected;
mod saving;
#[path = "scene_file/main.rs"]
mod scene_file;
