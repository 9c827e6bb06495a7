//! A host, a guest, and the next thing that happened to them.

use std::time::{Duration, Instant};

use bytes::Bytes;
use pliant_net::transport::{
    CloseReason, Endpoint, Event, Fingerprint, HostOptions, Invite, JoinOptions, Limits, PeerId,
};

pub const PATIENCE: Duration = Duration::from_secs(5);

/// The next event that `wanted` accepts; others are passed over.
pub fn next<T>(endpoint: &Endpoint, mut wanted: impl FnMut(Event) -> Option<T>) -> T {
    let start = Instant::now();
    while start.elapsed() < PATIENCE {
        match endpoint.poll().map(&mut wanted) {
            Some(Some(found)) => return found,
            Some(None) => {}
            None => std::thread::sleep(Duration::from_millis(1)),
        }
    }
    panic!("nothing of the kind within {PATIENCE:?}");
}

pub fn connected(endpoint: &Endpoint) -> (PeerId, Fingerprint) {
    next(endpoint, |event| match event {
        Event::Connected { peer, fingerprint, .. } => Some((peer, fingerprint)),
        Event::Closed { reason, .. } => panic!("closed: {reason}"),
        _ => None,
    })
}

pub fn closed(endpoint: &Endpoint) -> CloseReason {
    next(endpoint, |event| match event {
        Event::Closed { reason, .. } => Some(reason),
        _ => None,
    })
}

pub fn message(endpoint: &Endpoint) -> Bytes {
    next(endpoint, |event| match event {
        Event::Message { bytes, .. } => Some(bytes),
        Event::Closed { reason, .. } => panic!("closed: {reason}"),
        _ => None,
    })
}

pub fn datagram(endpoint: &Endpoint) -> Bytes {
    next(endpoint, |event| match event {
        Event::Datagram { bytes, .. } => Some(bytes),
        Event::Closed { reason, .. } => panic!("closed: {reason}"),
        _ => None,
    })
}

pub fn quick(limits: Limits) -> Limits {
    Limits { idle_timeout: Duration::from_secs(1), keep_alive: Duration::from_millis(200), ..limits }
}

pub fn host() -> Endpoint {
    Endpoint::host(HostOptions { limits: quick(Limits::host()), ..HostOptions::default() }).unwrap()
}

pub fn guest(invite: &Invite) -> Endpoint {
    Endpoint::join(invite, JoinOptions { limits: quick(Limits::guest()), ..JoinOptions::default() }).unwrap()
}
