//! Tests of sessions that ride on an app's own carrier.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod network;
mod port;
mod sessions;

#[path = "../support/mod.rs"]
mod support;
