//! The protocol without a network: sessions, peers and what they do with anything they are sent.
//!
//! One program, since linking one for each of these files would take longer than their tests.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
#[path = "bad_input/main.rs"]
mod bad_input;
mod clocks;
mod compensation;
mod emulator;
mod floods;
mod hostile;
mod interest;
mod introductions;
mod large_states;
mod late_inputs;
mod late_inputs_of_many;
mod limits;
mod models;
mod peer_links;
#[path = "peers/main.rs"]
mod peers;
mod rigids;
mod support;
mod watch;
