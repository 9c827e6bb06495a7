//! Tests of endpoints on loopback: what arrives, what is refused, and who notices that a peer is
//! gone.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod crossing;
mod endpoints;
mod entering;
mod misbehaving;
mod unauthenticated;
#[path = "../support/wait.rs"]
mod wait;
