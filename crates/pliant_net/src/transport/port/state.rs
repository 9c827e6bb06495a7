//! What a port does when ends open, call, end and send.

use std::sync::Arc;

use bevy::platform::time::Instant;
use bytes::Bytes;
use pliant_stream::{Channel, DisconnectReason, PeerId, Role};

use super::connection::{message, take_number};
use super::{ADMIT, Connection, GOODBYE, Joining, MESSAGE, OPEN, PART, PortState, Remote};
use crate::transport::carrier::CALLED;
use crate::transport::connections::Connections;
use crate::transport::identity::Fingerprint;
use crate::transport::queue::lock;
use crate::transport::wire::reason_with_code;

impl PortState {
    /// Opens the connection that somebody waits for, if the other end is there.
    pub(super) fn open_awaited(&mut self) {
        let here = |joining: &mut Joining| self.remotes.contains_key(&joining.remote);
        if let Some(joining) = self.joining.take_if(here) {
            self.open(joining, PeerId::HOST);
        }
    }

    /// Opens a connection to another end that is there.
    pub(super) fn open(&mut self, joining: Joining, id: PeerId) {
        let Some(remote) = self.remotes.get_mut(&joining.remote) else { return };
        self.numbers = self.numbers.wrapping_add(1);
        let hello = message(OPEN, self.numbers, &[]);
        let mut open = Connection::new(self.numbers, id, hello, &remote.path, &joining.connections);
        open.since = joining.since;
        if let Some(before) = remote.open.replace(open) {
            before.peer.outbox.close(DisconnectReason::Replaced);
            remote.closing.push_back(before);
        }
    }

    /// Opens a connection to the peer with a key, unless the session has one.
    pub(super) fn call(&mut self, key: Fingerprint, connections: &Arc<Connections>) -> PeerId {
        let id = PeerId(CALLED + self.called);
        self.called += 1;
        let remote =
            self.remotes.iter().find(|(_, remote)| remote.path.key == key).map(|(&remote, _)| remote);
        let is_open = |remote: &Remote| remote.has_open(connections);
        match remote {
            // A remote with an open connection is not called again: a third party may have sent its
            // address, and a wrong one.
            Some(remote) if self.remotes.get(&remote).is_some_and(is_open) => {
                connections.ended(id, DisconnectReason::Full);
            }
            Some(remote) => {
                let (since, connections) = (Instant::now(), Arc::clone(connections));
                self.open(Joining { remote, since, connections }, id);
            }
            None => connections.ended(id, DisconnectReason::UnknownHost),
        }
        id
    }

    /// Another end opens a connection.
    fn opened(&mut self, from: u64, number: u16) {
        let Some(remote) = self.remotes.get_mut(&from) else { return };
        // What is refused leaves the connection that this end has.
        let Some(host) = self.host.as_ref().filter(|_| remote.opens.take(Instant::now())) else {
            // As if nobody answered: it may be tried again.
            return remote.refuse(number, DisconnectReason::Silent);
        };
        let own = |open: &&Connection| Arc::ptr_eq(&open.connections, host);
        let own = remote.open.as_ref().filter(own);
        // Where two call each other at once, the call of the lower key counts, at both.
        if own.is_some_and(|open| !open.admitted) && self.key < remote.path.key {
            return remote.refuse(number, DisconnectReason::Full);
        }
        let own = usize::from(own.is_some_and(|open| open.admitted));
        let others = host.peers().len().saturating_sub(own);
        if others >= host.limits.peers || host.inbox.overloaded() {
            return remote.refuse(number, DisconnectReason::Full);
        }
        if let Some(before) = remote.open.take() {
            // An attempt of this end was in the way, and of a connection the other end knows
            // nothing any more.
            let is_attempt = !before.admitted;
            before.end(if is_attempt { DisconnectReason::Full } else { DisconnectReason::Replaced });
        }
        self.peers += 1;
        let role = remote.path.role;
        let hello = message(ADMIT, number, &[role.to_byte()]);
        let mut open = Connection::new(number, PeerId(self.peers), hello, &remote.path, host);
        open.admit(remote, role);
        remote.open = Some(open);
    }

    /// Ends the connections and attempts of a session.
    pub(super) fn end(&mut self, connections: &Arc<Connections>) {
        self.host.take_if(|host| Arc::ptr_eq(host, connections));
        self.joining.take_if(|joining| Arc::ptr_eq(&joining.connections, connections));
        self.remotes.values_mut().for_each(|remote| remote.end(|_| true, connections));
    }

    /// Ends one connection of a session, or its attempt.
    pub(super) fn forget(&mut self, peer: PeerId, connections: &Arc<Connections>) {
        connections.forget(peer);
        let nobody = Arc::new(Connections::new(connections.limits.clone()));
        for remote in self.remotes.values_mut() {
            remote.end(|id| id == peer, connections);
            // Its end is no event.
            let own = |open: &&mut Connection| open.id == peer && Arc::ptr_eq(&open.connections, connections);
            remote.closing.iter_mut().filter(own).for_each(|open| open.connections = Arc::clone(&nobody));
        }
    }

    /// Ends attempts that have not been admitted in time.
    pub(super) fn expire(&mut self, connections: &Arc<Connections>) {
        let late = |since: Instant| since.elapsed() > connections.limits.handshake;
        let waits = |joining: &mut Joining| Arc::ptr_eq(&joining.connections, connections);
        let unopened = self.joining.take_if(|joining| waits(joining) && late(joining.since)).is_some();
        if unopened {
            connections.ended(PeerId::HOST, DisconnectReason::Silent);
        }
        for remote in self.remotes.values_mut() {
            let unanswered = |open: &mut Connection| {
                Arc::ptr_eq(&open.connections, connections) && !open.admitted && late(open.since)
            };
            if let Some(open) = remote.open.take_if(unanswered) {
                open.end(DisconnectReason::Silent);
            }
        }
    }

    pub(super) fn is_joining(&self, connections: &Arc<Connections>) -> bool {
        self.joining.as_ref().is_some_and(|joining| Arc::ptr_eq(&joining.connections, connections))
            || self.remotes.values().any(|remote| remote.has_open(connections))
    }
}

impl PortState {
    pub(super) fn take_datagram(&mut self, from: u64, mut bytes: Bytes) {
        let len = bytes.len();
        let Some(remote) = self.remotes.get_mut(&from) else { return };
        let Some(open) = take_number(&mut bytes).and_then(|number| remote.admitted(number)) else { return };
        open.received(Channel::Datagram, len);
        let (inbox, most) = (&open.connections.inbox, open.connections.limits.queued_datagrams);
        let dropped = inbox.push_datagram(open.id, Instant::now(), bytes, most);
        if dropped > 0 {
            lock(&open.peer.dropped).receive_queue_full += dropped;
        }
    }

    pub(super) fn take_message(&mut self, from: u64, mut bytes: Bytes) {
        let len = bytes.len();
        let kind = (!bytes.is_empty()).then(|| bytes.split_to(1)).map(|kind| kind[0]);
        let (Some(kind), Some(number)) = (kind, take_number(&mut bytes)) else { return };
        if kind == OPEN {
            return self.opened(from, number);
        }
        let Some(remote) = self.remotes.get_mut(&from) else { return };
        match kind {
            ADMIT => {
                let role = bytes.first().copied().and_then(Role::from_byte);
                let awaited = remote.open.take_if(|open| open.number == number && !open.admitted);
                match (awaited, role) {
                    (Some(mut open), Some(role)) => {
                        open.admit(remote, role);
                        remote.open = Some(open);
                    }
                    (Some(open), None) => open.end(DisconnectReason::Protocol),
                    // An attempt that was given up.
                    (None, _) => remote.refuse(number, DisconnectReason::Left),
                }
            }
            PART | MESSAGE => {
                let Some(open) = remote.admitted(number) else { return remote.deny(number) };
                open.received(Channel::Message, len);
                open.take_part(bytes, kind == MESSAGE);
            }
            GOODBYE => {
                if let (Some(connection), Some(&code)) = (remote.take(number), bytes.first()) {
                    connection.end(reason_with_code(code));
                }
            }
            _ => {}
        }
    }
}
