//! The connections of equal peers over QUIC: one socket on which others are admitted, and one for
//! each peer that this one has called.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use bytes::Bytes;
use pliant_stream::{DisconnectReason, PeerId};

use super::Emulation;
use super::carrier::{CALLED, Carrier, Event, MeshCarrier, SendError};
use super::config::{Access, HostOptions, JoinOptions, Limits};
use super::endpoint::{Endpoint, TransportError};
use super::identity::{Fingerprint, Identity};
use super::invite::Invite;
use super::queue::lock;
use super::stats::PeerStats;

/// A peer's connections over QUIC.
pub(crate) struct QuicMesh {
    listening: Endpoint,
    /// Connections that this peer has opened.
    opened: Mutex<BTreeMap<PeerId, Arc<Endpoint>>>,
    /// Closed connections that are still sending their goodbye. No frame waits for them.
    ending: Mutex<Vec<Arc<Endpoint>>>,
    /// The private key in PKCS #8 form, which the opened connections use too.
    key: Vec<u8>,
    limits: Limits,
    emulation: Mutex<Option<Emulation>>,
    next: AtomicU64,
}

impl QuicMesh {
    pub(crate) fn open(mut options: HostOptions) -> Result<Self, TransportError> {
        let identity = options.identity.take().map_or_else(Identity::generate, Ok)?;
        let key = identity.to_pkcs8();
        let (limits, emulation) = (options.limits.clone(), Mutex::new(options.emulation.clone()));
        let listening = Endpoint::host(HostOptions { identity: Some(identity), ..options })?;
        let (opened, ending, next) = (Mutex::default(), Mutex::default(), AtomicU64::new(CALLED));
        Ok(Self { listening, opened, ending, key, limits, emulation, next })
    }

    /// Changes who may connect from this call on.
    pub(crate) fn set_access(&self, access: Access) {
        self.listening.set_access(access);
    }

    pub(crate) fn emulation(&self) -> Option<Emulation> {
        lock(&self.emulation).clone()
    }

    /// Sets, replaces or removes the emulated link under every connection.
    pub(crate) fn set_emulation(&self, emulation: Option<Emulation>) {
        self.listening.set_emulation(emulation.clone());
        lock(&self.opened).values().for_each(|endpoint| endpoint.set_emulation(emulation.clone()));
        *lock(&self.emulation) = emulation;
    }

    /// Calls `with` with the endpoint of a connection, and the connection's number there.
    fn way<T>(&self, peer: PeerId, with: impl FnOnce(&Endpoint, PeerId) -> T) -> T {
        let opened = lock(&self.opened).get(&peer).cloned();
        match opened {
            Some(endpoint) => with(&endpoint, PeerId::HOST),
            None => with(&self.listening, peer),
        }
    }

    /// Returns the next event that `poll` finds on any socket, with the mesh's number of the peer.
    fn next_event(&self, poll: impl Fn(&Endpoint) -> Option<Event>) -> Option<Event> {
        if let Some(event) = poll(&self.listening) {
            return Some(event);
        }
        let polled = lock(&self.opened).iter().find_map(|(&id, endpoint)| Some((id, poll(endpoint)?)));
        let (id, event) = polled?;
        Some(match event {
            Event::Connected { fingerprint, address, role, .. } => {
                Event::Connected { peer: id, fingerprint, address, role }
            }
            Event::Datagram { at, bytes, .. } => Event::Datagram { peer: id, at, bytes },
            Event::Message { bytes, .. } => Event::Message { peer: id, bytes },
            Event::Closed { reason, .. } => {
                self.forget(id);
                Event::Closed { peer: id, reason }
            }
        })
    }
}

impl Carrier for QuicMesh {
    fn fingerprint(&self) -> Fingerprint {
        self.listening.fingerprint()
    }

    fn poll(&self) -> Option<Event> {
        self.next_event(Endpoint::poll)
    }

    fn begin_frame(&self) {
        lock(&self.ending).retain(|endpoint| !endpoint.is_over());
        self.listening.begin_frame();
        lock(&self.opened).values().for_each(|endpoint| endpoint.begin_frame());
    }

    fn poll_in_frame(&self) -> Option<Event> {
        self.next_event(Endpoint::poll_in_frame)
    }

    fn peers(&self) -> Vec<PeerId> {
        let mut peers = self.listening.peers();
        let opened = lock(&self.opened);
        peers.extend(opened.iter().filter(|(_, endpoint)| !endpoint.peers().is_empty()).map(|(&id, _)| id));
        peers
    }

    fn send_datagram(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        self.way(peer, |endpoint, peer| endpoint.send_datagram(peer, bytes))
    }

    fn send_message(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        self.way(peer, |endpoint, peer| endpoint.send_message(peer, bytes))
    }

    fn unsent(&self, peer: PeerId) -> usize {
        self.way(peer, Endpoint::unsent)
    }

    fn max_datagram_size(&self, peer: PeerId) -> Option<usize> {
        self.way(peer, Endpoint::max_datagram_size)
    }

    fn close(&self, peer: PeerId, reason: DisconnectReason) {
        self.way(peer, |endpoint, peer| endpoint.close(peer, reason));
    }

    fn rejoin(&self) {}

    fn end(&self) {
        self.listening.end();
        lock(&self.opened).values().for_each(|endpoint| endpoint.end());
    }

    fn stats(&self, peer: PeerId) -> Option<PeerStats> {
        self.way(peer, Endpoint::stats)
    }
}

impl MeshCarrier for QuicMesh {
    fn invite(&self) -> Invite {
        self.listening.invite()
    }

    fn call(&self, invite: &Invite) -> Result<PeerId, TransportError> {
        let options = JoinOptions {
            identity: Some(Identity::from_pkcs8(&self.key)?),
            limits: self.limits.of_a_call(),
            emulation: self.emulation(),
            bind: None,
        };
        let endpoint = Endpoint::join(invite, options)?;
        let peer = PeerId(self.next.fetch_add(1, Ordering::Relaxed));
        lock(&self.opened).insert(peer, Arc::new(endpoint));
        Ok(peer)
    }

    fn forget(&self, peer: PeerId) {
        if let Some(endpoint) = lock(&self.opened).remove(&peer) {
            endpoint.end();
            lock(&self.ending).push(endpoint);
        }
    }
}

impl Drop for QuicMesh {
    /// Says goodbye on all connections at the same time. This takes at most two seconds, whatever
    /// their number: they end before the first of them is waited for.
    fn drop(&mut self) {
        self.end();
    }
}
