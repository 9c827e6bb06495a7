//! Sends models to guests in turns, with one rate limit per guest and one for all.

use std::collections::VecDeque;
use std::ops::Bound;
use std::time::Duration;

use super::Output;
use super::host::HostSession;
use super::host_config::HostSessionConfig;
use super::host_peer::GuestPeer;
use crate::StreamError;
use crate::link::Budget;
use crate::state::PeerId;
use crate::wire::HostMessage;

/// Bytes of a model in one message.
const CHUNK: usize = 16 * 1024;
/// Unsent bytes in the transport beyond which no more of a model is sent: 1 MB/s in eight calls a
/// second.
const MAX_UNSENT: usize = 128 * 1024;
/// Burst after a pause, in seconds of the rate for all guests. An application that calls ten times
/// a second uses the whole rate.
const BURST: f64 = 0.1;

/// State of the turns, and the rate limit for all guests.
#[derive(Debug)]
pub(super) struct Upload {
    budget: Budget,
    /// The guest that received the last piece.
    last: Option<PeerId>,
}

impl Upload {
    pub(super) fn new(config: &HostSessionConfig) -> Result<Self, StreamError> {
        for (what, rate) in [("model_rate", config.model_rate), ("models_rate", config.models_rate)] {
            if !(rate.is_finite() && rate >= 1.0) {
                let found = rate.to_string();
                return Err(StreamError::Config { what, found, expected: "at least 1 byte a second" });
            }
        }
        let burst = (config.models_rate * BURST).max(CHUNK as f64);
        Ok(Self { budget: Budget::new(config.models_rate, burst), last: None })
    }

    /// Time at which the next piece for a guest can be sent; `None` when it waits for the transport
    /// or has no transfer.
    pub(super) fn ready_at(&self, peer: &GuestPeer) -> Option<Duration> {
        let next = next_piece(peer)? as f64;
        Some(peer.budgets.models.ready_at(next).max(self.budget.ready_at(next)))
    }
}

/// Size of the next piece for a guest, bytes, if the transport has room.
fn next_piece(peer: &GuestPeer) -> Option<usize> {
    let transfer = peer.transfers.front()?;
    (peer.unsent < MAX_UNSENT).then(|| (transfer.bytes.len() - transfer.offset).min(CHUNK))
}

impl HostSession {
    /// Iterates over the guests to whom a model is being sent.
    pub fn fetching(&self) -> impl Iterator<Item = PeerId> + '_ {
        self.peers.values().filter(|p| !p.transfers.is_empty()).map(|p| p.id)
    }

    /// Sets the number of bytes of messages to a guest that the transport has accepted and not sent
    /// yet.
    ///
    /// A guest of [`HostSession::fetching`] with 128 KiB or more gets nothing more of its model
    /// until the caller reports less. The connection may be slower than
    /// [`HostSessionConfig::model_rate`], and unsent bytes are held in memory. Default: 0, which
    /// stays until the first call.
    pub fn set_unsent(&mut self, peer: PeerId, bytes: usize) {
        if let Some(p) = self.peers.get_mut(&peer) {
            p.unsent = bytes;
        }
    }

    /// Sends one piece to each guest in turn, as far as the rates allow. No guest loses its turn
    /// when the rate for all is used up.
    pub(super) fn send_models(&mut self, now: Duration) {
        loop {
            let after = self.upload.last.map_or(Bound::Unbounded, Bound::Excluded);
            let turns: Vec<PeerId> = self
                .peers
                .range((after, Bound::Unbounded))
                .chain(&self.peers)
                .filter(|(_, p)| next_piece(p).is_some())
                .map(|(&id, _)| id)
                .take(self.peers.len())
                .collect();
            let mut sent = false;
            for id in turns {
                let Some(p) = self.peers.get_mut(&id) else { continue };
                let Some(bytes) = next_piece(p) else { continue };
                if !p.budgets.models.has(now, bytes as f64) {
                    continue;
                }
                if !self.upload.budget.spend(now, bytes as f64) {
                    return;
                }
                p.budgets.models.spend(now, bytes as f64);
                p.send_piece(bytes, &mut self.out);
                self.upload.last = Some(id);
                sent = true;
            }
            if !sent {
                return;
            }
        }
    }
}

impl GuestPeer {
    fn send_piece(&mut self, bytes: usize, out: &mut VecDeque<Output>) {
        let Some(t) = self.transfers.front_mut() else { return };
        let (begin, end) = (t.offset, t.offset + bytes);
        t.offset = end;
        let (hash, total, bytes) = (t.hash, t.bytes.len(), t.bytes[begin..end].to_vec());
        if end == total {
            self.transfers.pop_front();
            self.cached.insert(hash);
        }
        let (offset, total) = (begin as u64, total as u64);
        self.send_message(&HostMessage::ModelChunk { hash, offset, total, bytes }, out);
    }
}
