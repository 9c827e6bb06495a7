//! A host, a guest, and access to their next events.

use std::time::Duration;

use bytes::Bytes;
use pliant_net::transport::{
    Carrier, DisconnectReason, Endpoint, Event, Fingerprint, HostOptions, Invite, JoinOptions, Limits, PeerId,
};

use crate::support::wait::wait_for;

/// Waits for the next event that `wanted` accepts, and skips the others.
pub fn next<T>(endpoint: &Endpoint, mut wanted: impl FnMut(Event) -> Option<T>) -> T {
    wait_for("an event of the kind", || std::iter::from_fn(|| endpoint.poll()).find_map(&mut wanted))
}

/// Waits for the next event.
pub fn first(endpoint: &Endpoint) -> Event {
    wait_for("an event", || endpoint.poll())
}

/// Connects a guest, and checks that its connection is the first event that the application of
/// `host` receives.
pub fn is_first_heard_of(host: &Endpoint) -> Endpoint {
    let guest = guest(&host.invite());
    let received = first(host);
    let own = guest.fingerprint();
    let so = matches!(received, Event::Connected { fingerprint, .. } if fingerprint == own);
    assert!(so, "{received:?}");
    guest
}

pub fn connected(endpoint: &Endpoint) -> (PeerId, Fingerprint) {
    next(endpoint, |event| match event {
        Event::Connected { peer, fingerprint, .. } => Some((peer, fingerprint)),
        Event::Closed { reason, .. } => panic!("closed: {reason}"),
        _ => None,
    })
}

pub fn closed(endpoint: &Endpoint) -> DisconnectReason {
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

/// Limits with which a silent peer times out after two seconds.
pub fn quick(limits: Limits) -> Limits {
    Limits { idle_timeout: Duration::from_secs(2), keep_alive: Duration::from_millis(200), ..limits }
}

/// Limits with which a busy machine's silent peer does not time out, and the round trip is measured
/// often.
pub fn patient(limits: Limits) -> Limits {
    let half_a_minute = Duration::from_secs(30);
    let keep_alive = Duration::from_millis(200);
    Limits { idle_timeout: half_a_minute, handshake: half_a_minute, keep_alive, ..limits }
}

pub fn host() -> Endpoint {
    Endpoint::host(HostOptions { limits: patient(Limits::host()), ..HostOptions::default() }).unwrap()
}

pub fn guest(invite: &Invite) -> Endpoint {
    let limits = patient(Limits::guest());
    Endpoint::join(invite, JoinOptions { limits, ..JoinOptions::default() }).unwrap()
}
