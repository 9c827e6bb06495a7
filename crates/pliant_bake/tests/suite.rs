//! What is baked, against closed forms and against finite elements.
//!
//! One program, since linking one for each of these files would take longer than their tests.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")]
mod attached;
mod bake;
mod balls;
mod contact;
mod drag;
mod free;
mod hang;
mod held;
mod moments;
mod pairs;
mod probe;
mod probe_groove;
mod probe_shapes;
mod punch;
mod reduced;
mod reduced_motion;
mod regions;
mod rigids;
mod stiffness;
mod thin;
mod uniaxial;
