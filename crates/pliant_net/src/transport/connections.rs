//! The connections of a session, between the session and what carries their bytes.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use pliant_stream::{DisconnectReason, PeerId};
use tokio::sync::Notify;

use super::carrier::{Event, SendError};
use super::config::Limits;
use super::queue::{Inbox, Outbox, lock};
use super::stats::{DropCounts, PeerStats};
use super::wire::LONGEST;

/// Messages are sent in parts of this size, bytes, so that the rate cap applies within a long
/// message, and datagrams do not wait for its end.
pub(super) const MESSAGE_PART: usize = 2048;

/// Longest time to deliver the last messages before a close.
pub(super) const GRACE: Duration = Duration::from_secs(1);

/// One peer, shared by the session and what carries its bytes.
#[derive(Debug, Default)]
pub(super) struct PeerConnection {
    pub(super) outbox: Outbox,
    pub(super) stats: Mutex<PeerStats>,
    pub(super) dropped: Mutex<DropCounts>,
    pub(super) max_datagram: AtomicUsize,
    pub(super) address: Mutex<Option<SocketAddr>>,
}

/// The open connections and their queues.
#[derive(Debug)]
pub(super) struct Connections {
    pub(super) inbox: Inbox,
    pub(super) limits: Limits,
    peers: Mutex<BTreeMap<PeerId, Arc<PeerConnection>>>,
}

impl Connections {
    pub(super) fn new(limits: Limits) -> Self {
        Self { inbox: Inbox::default(), limits, peers: Mutex::default() }
    }

    /// Opens a connection, and reports it as `connected`. What is returned is notified when there
    /// is room for messages.
    pub(super) fn open(&self, id: PeerId, peer: Arc<PeerConnection>, connected: Event) -> Arc<Notify> {
        lock(&self.peers).insert(id, peer);
        self.inbox.open(id, connected)
    }

    /// Reports the end of a connection, or of an attempt.
    pub(super) fn ended(&self, id: PeerId, reason: DisconnectReason) {
        lock(&self.peers).remove(&id);
        self.inbox.close(id, reason);
    }

    /// Ends a connection without an event.
    pub(super) fn forget(&self, id: PeerId) {
        lock(&self.peers).remove(&id);
        self.inbox.forget(id);
    }

    pub(super) fn peers(&self) -> Vec<PeerId> {
        lock(&self.peers).keys().copied().collect()
    }

    pub(super) fn peer(&self, peer: PeerId) -> Option<Arc<PeerConnection>> {
        lock(&self.peers).get(&peer).cloned()
    }

    pub(super) fn send_datagram(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        let peer = self.peer(peer).ok_or(SendError::NotConnected)?;
        let most = peer.max_datagram.load(Ordering::Relaxed);
        if bytes.len() > most {
            lock(&peer.dropped).too_large += 1;
            return Err(SendError::TooLarge { len: bytes.len(), most });
        }
        let dropped = peer.outbox.push_datagram(bytes, self.limits.queued_datagrams);
        if dropped > 0 {
            lock(&peer.dropped).send_queue_full += dropped;
        }
        Ok(())
    }

    pub(super) fn send_message(&self, peer: PeerId, bytes: Bytes) -> Result<(), SendError> {
        let len = bytes.len();
        if len > LONGEST {
            return Err(SendError::TooLong { len });
        }
        let peer = self.peer(peer).ok_or(SendError::NotConnected)?;
        if peer.outbox.push_message(bytes, self.limits.queued_messages) {
            Ok(())
        } else {
            Err(SendError::QueueFull { len })
        }
    }

    pub(super) fn unsent(&self, peer: PeerId) -> usize {
        self.peer(peer).map_or(0, |peer| peer.outbox.message_bytes())
    }

    pub(super) fn close(&self, peer: PeerId, reason: DisconnectReason) {
        if let Some(peer) = self.peer(peer) {
            peer.outbox.close(reason);
        }
    }

    pub(super) fn max_datagram_size(&self, peer: PeerId) -> Option<usize> {
        self.peer(peer).map(|peer| peer.max_datagram.load(Ordering::Relaxed))
    }

    pub(super) fn stats(&self, peer: PeerId) -> Option<PeerStats> {
        let peer = self.peer(peer)?;
        let dropped = *lock(&peer.dropped);
        let stats = PeerStats { dropped, ..*lock(&peer.stats) };
        Some(stats)
    }
}
