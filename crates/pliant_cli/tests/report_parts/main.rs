//! Runs each part of the report in its short form and checks its files and that the numbers match
//! the text.

#![expect(clippy::unwrap_used, clippy::panic, reason = "a failed test should panic")]

mod contact;
mod networks;
mod part;
mod physics;
#[path = "../support/mod.rs"]
mod support;
mod tables;
