//! Shared by these tests: the bodies of the protocol tests, and a scene around a session.
#![allow(dead_code, unused_imports, reason = "each test uses its part")]

pub mod scene;

// Both crates use this one copy. The protocol's tests may not depend on the laboratory.
#[path = "../../../pliant_stream/tests/support/mod.rs"]
pub mod protocol;

pub use protocol::{bar, direct::random, loose_bar};
