//! Bevy plugin that carries Pliant's streaming sessions over QUIC.
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

pub mod transport;
