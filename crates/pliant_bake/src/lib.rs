//! From a mesh to a modal model: finite elements, sparse factorisation and vibration modes.
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod element;
mod factor;
mod fem;
mod ordering;
mod blocks;
mod lanczos;
mod rigid;
mod solver;
mod sparse;
mod symbolic;
