//! The carriers that a port makes for sessions.

use std::sync::Arc;

use bevy::platform::time::Instant;
use bytes::Bytes;
use pliant_stream::{DisconnectReason, PeerId};

use super::{CarrierPort, Joining, PortCarrier};
use crate::transport::carrier::{Carrier, Event, MeshCarrier, SendError};
use crate::transport::endpoint::TransportError;
use crate::transport::identity::Fingerprint;
use crate::transport::invite::Invite;
use crate::transport::stats::PeerStats;

impl Carrier for PortCarrier {
    fn fingerprint(&self) -> Fingerprint {
        self.port.state().key
    }

    fn poll(&self) -> Option<Event> {
        self.port.state().expire(&self.connections);
        self.connections.inbox.pop()
    }

    fn begin_frame(&self) {
        self.port.state().expire(&self.connections);
        self.connections.inbox.begin_frame();
    }

    fn poll_in_frame(&self) -> Option<Event> {
        self.connections.inbox.pop_in_frame()
    }

    fn charge(&self, work: usize) {
        self.connections.inbox.charge(work);
    }

    fn peers(&self) -> Vec<PeerId> {
        self.connections.peers()
    }

    fn send_datagram(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        self.connections.send_datagram(peer, bytes)
    }

    fn send_message(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        self.connections.send_message(peer, bytes)
    }

    fn unsent(&self, peer: PeerId) -> usize {
        self.connections.unsent(peer)
    }

    fn max_datagram_size(&self, peer: PeerId) -> Option<usize> {
        self.connections.max_datagram_size(peer)
    }

    fn close(&self, peer: PeerId, reason: DisconnectReason) {
        self.connections.close(peer, reason);
    }

    fn rejoin(&self) {
        let Some(remote) = self.remote else { return };
        let mut state = self.port.state();
        if !state.is_joining(&self.connections) {
            let connections = Arc::clone(&self.connections);
            let before = state.joining.replace(Joining { remote, since: Instant::now(), connections });
            if let Some(before) = before {
                before.connections.ended(PeerId::HOST, DisconnectReason::Replaced);
            }
            state.open_awaited();
        }
    }

    fn end(&self) {
        self.port.state().end(&self.connections);
    }

    fn stats(&self, peer: PeerId) -> Option<PeerStats> {
        self.connections.stats(peer)
    }
}

impl MeshCarrier for PortCarrier {
    fn invite(&self) -> Invite {
        CarrierPort::invite_of(self.fingerprint())
    }

    fn call(&self, invite: &Invite) -> Result<PeerId, TransportError> {
        Ok(self.port.state().call(invite.fingerprint, &self.connections))
    }

    fn forget(&self, peer: PeerId) {
        self.port.state().forget(peer, &self.connections);
    }
}

impl Drop for PortCarrier {
    fn drop(&mut self) {
        self.end();
    }
}
