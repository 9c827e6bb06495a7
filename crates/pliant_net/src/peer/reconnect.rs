//! Reconnects peers that have lost each other.

use std::time::Duration;

use pliant_stream::{DisconnectReason, PeerId, UserId};
use tracing::debug;

use super::{NetPeer, PeerState};
use crate::retry::Retry;
use crate::transport::Invite;

/// A lost peer that has not said goodbye.
#[derive(Debug, Clone)]
pub(super) struct Missed {
    pub(super) number: UserId,
    invite: Invite,
    retry: Retry,
    /// The connection attempt under way.
    calling: Option<PeerId>,
}

/// Most lost peers that are tracked. The one that was lost first is given up first.
const MAX_MISSED: usize = 64;

/// Returns whether a connection that ended for this reason is opened again: the peers have lost
/// each other, or there was no room, and neither has sent the other away.
pub(super) fn may_come_back(reason: DisconnectReason) -> bool {
    reason.is_loss() || reason == DisconnectReason::Full
}

impl NetPeer {
    /// Tracks a peer whose connection is gone, if this peer is the one that must reconnect.
    pub(super) fn miss(&mut self, now: Duration, peer: PeerId, reason: DisconnectReason) {
        let key = self.listening.fingerprint();
        if let Some(missed) = self.missed.iter_mut().find(|missed| missed.calling == Some(peer)) {
            // The other peer may not have noticed the loss yet, so its answer does not matter. Only
            // the time limit ends the attempts.
            missed.calling = None;
            missed.retry.schedule(now, self.config.rejoin, key);
            return;
        }
        let (PeerState::In { user }, Some(other)) = (&self.state, self.others.get(&peer)) else { return };
        let (Some(number), Some(invite)) = (other.number, other.invite.clone()) else { return };
        let known = self.missed.iter().any(|missed| missed.number == number);
        if !may_come_back(reason) || known || *user < number || number == UserId::HOST {
            return;
        }
        let mut retry = Retry::default();
        if !retry.schedule(now, self.config.rejoin, key) {
            return;
        }
        debug!("user {} is looked for", number.0);
        if self.missed.len() >= MAX_MISSED {
            self.missed.remove(0);
        }
        self.missed.push(Missed { number, invite, retry, calling: None });
    }

    /// Stops tracking a peer that has connected, again or for the first time.
    pub(super) fn found(&mut self, number: UserId) {
        self.missed.retain(|missed| missed.number != number);
    }

    /// Connects to the lost peers whose attempts are due, and gives up those lost for too long.
    pub(super) fn look_for_the_missed(&mut self) {
        let now = self.now();
        let (patience, key) = (self.config.rejoin, self.listening.fingerprint());
        let mut all = std::mem::take(&mut self.missed);
        all.retain(|missed| !missed.retry.is_over(now, patience));
        for missed in all.iter_mut().filter(|missed| missed.calling.is_none()) {
            if !missed.retry.is_due(now) {
                continue;
            }
            match self.connect_to(&missed.invite) {
                Ok(peer) => {
                    self.introduced.insert(peer, (missed.number, missed.invite.clone()));
                    missed.calling = Some(peer);
                }
                Err(error) => {
                    debug!("user {} cannot be called: {error}", missed.number.0);
                    missed.retry.schedule(now, patience, key);
                }
            }
        }
        self.missed = all;
    }
}
