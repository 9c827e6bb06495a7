//! Helpers that make tests robust on a busy machine.
#![allow(dead_code, reason = "every test uses its own part of it")]

use std::{
    fmt::Debug,
    net::{TcpListener, TcpStream},
    time::{Duration, Instant},
};

use pliant_haptics::{LoopConfig, SafetyConfig, StaleConfig, VirtualConfig};

/// Time limit for every expected event. The limit is long, so that only an event that never happens
/// exceeds it.
pub const LIMIT: Duration = Duration::from_secs(300);

/// Calls `look` until it succeeds. `look` lets time pass and returns what it saw if it fails.
#[track_caller]
pub fn until<T, L: Debug>(what: &str, mut look: impl FnMut() -> Result<T, L>) -> T {
    let begun = Instant::now();
    loop {
        match look() {
            Ok(seen) => return seen,
            Err(seen) => assert!(begun.elapsed() < LIMIT, "not in {LIMIT:?}: {what}; the last was {seen:?}"),
        }
    }
}

/// Returns settings of a real-time loop whose force stays, even if the machine suspends the loop or
/// the game for a while.
///
/// A second without updates causes no fade, a stall only pauses the ramp, and the motors have no
/// thermal limit. Tests in virtual time cover the defaults of these stages.
pub fn patient() -> LoopConfig {
    let safety = SafetyConfig {
        stale: Some(StaleConfig { patience: 1.0, limit: 2.0 }),
        fade: Some(f64::INFINITY),
        thermal: None,
        ..SafetyConfig::for_device(&VirtualConfig::touch().info(), 1000.0)
    };
    LoopConfig { safety: Some(safety), ..LoopConfig::default() }
}

/// An address that refuses connections. Its port is the local end of an open connection, so no
/// other process can listen there.
pub struct Nobody {
    pub address: String,
    _ends: (TcpListener, TcpStream),
}

impl Nobody {
    pub fn new() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let stream = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        Self { address: stream.local_addr().unwrap().to_string(), _ends: (listener, stream) }
    }
}
