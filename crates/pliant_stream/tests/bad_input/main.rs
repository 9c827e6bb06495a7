//! Arbitrary bytes cause no panic and no large allocation. The session continues or ends with a
//! reason.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]

mod parsers;
mod samples;
mod sessions;

#[path = "../support/mod.rs"]
mod support;
