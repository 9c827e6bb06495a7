//! Sessions of the Bevy plugin, over real sockets and over carriers of tests.
//!
//! One program, since linking one for each of these files would take longer than their tests.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
mod at_run_time;
#[path = "carrier/main.rs"]
mod carrier;
mod interest;
#[path = "loopback/main.rs"]
mod loopback;
mod mesh;
mod peers;
#[cfg(feature = "watch")]
#[path = "support/relay.rs"]
mod relay;
mod returning;
mod rigids;
mod roles;
mod session;
mod support;
mod tuning;
#[cfg(feature = "watch")]
mod watch;
#[cfg(feature = "watch")]
mod watch_choices;
#[cfg(feature = "watch")]
#[path = "support/watching.rs"]
mod watching;
