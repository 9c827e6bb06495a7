//! Bodies whose motion is known in closed form.
//!
//! One program, since linking one for each of these files would take longer than their tests.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
mod body;
mod dampers;
mod file;
mod implied;
mod inertia;
mod nonlinear_rod;
mod order;
mod reduced;
mod relaxation;
mod rod;
mod stiffness;
mod stretched;
