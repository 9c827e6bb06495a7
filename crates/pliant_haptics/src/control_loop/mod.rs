//! The loop at device rate. It computes a wrench from a sample and the local model that the
//! simulation publishes.

pub(crate) mod core;
pub(crate) mod coupling;
pub(crate) mod cycle;
pub(crate) mod heartbeat;
pub(crate) mod held_patches;
pub(crate) mod histogram;
pub(crate) mod local_body;
pub(crate) mod local_model;
pub(crate) mod proxy;
pub(crate) mod runner;
pub(crate) mod scheduler;
pub(crate) mod stop;
pub(crate) mod supervisor;
pub(crate) mod tool;
pub(crate) mod touch;
pub(crate) mod validation;

/// What threads share. Tests put loom's in its place.
#[cfg_attr(
    not(any(feature = "inverse", feature = "vendor")),
    expect(unused_imports, reason = "real devices alone share connections")
)]
pub(crate) mod sync {
    pub(crate) use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};
    pub(crate) use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
}
