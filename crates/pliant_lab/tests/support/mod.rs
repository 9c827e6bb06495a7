//! What these tests share: the bodies that the tests of the protocol have, and a scene around a session.
#![allow(dead_code, unused_imports, reason = "each test uses its part")]

pub mod scene;

// One copy for both crates: the protocol's tests may not lean on the laboratory.
#[path = "../../../pliant_stream/tests/support/mod.rs"]
mod protocol;

pub use protocol::{bar, direct::random, loose_bar};
