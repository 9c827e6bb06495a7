//! What tests need of the machine, however busy it is and whatever else runs on it.
#![allow(dead_code, reason = "every test uses its own part of it")]

use std::{
    fmt::Debug,
    net::{TcpListener, TcpStream},
    time::{Duration, Instant},
};

use pliant_haptics::{LoopConfig, SafetyConfig, StaleConfig, VirtualConfig};

/// How long anything that must come may take. Only what never comes takes longer.
pub const LIMIT: Duration = Duration::from_secs(60);

/// Looks until it sees what is waited for. Time passes within `look`, which says what it saw
/// instead.
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

/// A loop in real time whose force comes and stays, although the machine leaves the loop or the
/// game out for a while.
///
/// A second of silence is no reason to fade, a stall only keeps the ramp from going on, and motors
/// do not get hot while somebody waits. What those stages do by default is tested in virtual time.
pub fn patient() -> LoopConfig {
    let safety = SafetyConfig {
        stale: Some(StaleConfig { patience: 1.0, limit: 2.0 }),
        fade: Some(f64::INFINITY),
        thermal: None,
        ..SafetyConfig::for_device(&VirtualConfig::touch().info(), 1000.0)
    };
    LoopConfig { safety: Some(safety), ..LoopConfig::default() }
}

/// An address where nobody listens and nobody can begin to: the port is the near end of a
/// connection that stays.
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
