//! The laboratory: sessions over emulated paths against what is true.
//!
//! One program, since linking one for each of these files would take longer than their tests.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
mod contact_sessions;
mod drop;
mod economy;
mod held;
mod hitches;
mod measure;
mod peer_shapes;
mod predicted_hand;
mod quantum;
mod reduced;
mod relaxing;
mod sessions;
mod stiffness;
mod support;
mod trouble;
mod two_predicted_hands;
