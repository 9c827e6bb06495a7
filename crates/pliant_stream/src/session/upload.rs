//! Models on their way to guests: one rate for each and one for all, shared in turns.

use std::collections::VecDeque;
use std::ops::Bound;
use std::time::Duration;

use super::Output;
use super::host::HostSession;
use super::host_config::HostConfig;
use super::host_peer::Peer;
use crate::StreamError;
use crate::link::Budget;
use crate::state::PeerId;
use crate::wire::HostMessage;

/// Bytes of a model in one message.
const CHUNK: usize = 16 * 1024;
/// More of a model is not handed over while the transport has so much unsent: 1 MB/s in eight calls a second.
const MOST_UNSENT: usize = 128 * 1024;
/// What may be sent at once after a pause, s of the rate for all: an application of ten frames a second uses all of it.
const BURST: f64 = 0.1;

/// Whose turn it is, and what all may still have.
#[derive(Debug)]
pub(super) struct Upload {
    budget: Budget,
    /// Who had the last piece.
    last: Option<PeerId>,
}

impl Upload {
    pub(super) fn new(config: &HostConfig) -> Result<Self, StreamError> {
        for (what, rate) in [("model_rate", config.model_rate), ("models_rate", config.models_rate)] {
            if !(rate.is_finite() && rate >= 1.0) {
                let found = rate.to_string();
                return Err(StreamError::Config { what, found, expected: "at least 1 byte a second" });
            }
        }
        let burst = (config.models_rate * BURST).max(CHUNK as f64);
        Ok(Self { budget: Budget::new(config.models_rate, burst), last: None })
    }

    /// When the next piece for a guest can go; `None` when it waits for the transport, or for nothing.
    pub(super) fn ready_at(&self, peer: &Peer) -> Option<Duration> {
        let next = next_piece(peer)? as f64;
        Some(peer.model_budget.ready_at(next).max(self.budget.ready_at(next)))
    }
}

/// Bytes of the piece that a guest could be given, if the transport has room.
fn next_piece(peer: &Peer) -> Option<usize> {
    let transfer = peer.transfers.front()?;
    (peer.unsent < MOST_UNSENT).then(|| (transfer.bytes.len() - transfer.offset).min(CHUNK))
}

impl HostSession {
    /// Guests to whom a model is being sent.
    pub fn fetching(&self) -> impl Iterator<Item = PeerId> + '_ {
        self.peers.values().filter(|p| !p.transfers.is_empty()).map(|p| p.id)
    }

    /// Bytes of messages to a guest that the transport has taken and not sent yet. A guest of [`HostSession::fetching`] with 128 KiB and more
    /// gets nothing more of its model until it is told of less: the line behind it may be slower than [`HostConfig::model_rate`], and what
    /// is not sent is held in memory. Default: 0, for ever.
    pub fn set_unsent(&mut self, peer: PeerId, bytes: usize) {
        if let Some(p) = self.peers.get_mut(&peer) {
            p.unsent = bytes;
        }
    }

    /// One piece each, in turns, as far as the rates reach. Nobody's turn is lost when the rate for all runs out.
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
                if !p.model_budget.has(now, bytes as f64) {
                    continue;
                }
                if !self.upload.budget.spend(now, bytes as f64) {
                    return;
                }
                p.model_budget.spend(now, bytes as f64);
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

impl Peer {
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
