//! Reconnects peers that have lost each other.

use std::time::Duration;

use pliant_stream::{DisconnectReason, PeerId, UserId};
use tracing::debug;

use super::{NetPeer, PeerState};
use crate::retry_pause::retry_pause;
use crate::transport::Invite;

/// A lost peer that has not said goodbye.
#[derive(Debug, Clone)]
pub(super) struct Missed {
    pub(super) number: UserId,
    invite: Invite,
    since: Duration,
    next: Duration,
    /// Number of attempts to connect.
    calls: u32,
    /// The connection attempt under way.
    calling: Option<PeerId>,
}

/// Pause between two attempts to connect, which is half to one and a half times as long.
const PAUSE: Duration = Duration::from_secs(1);
/// Most lost peers that are tracked. The one that was lost first is given up first.
const MAX_MISSED: usize = 64;

/// Returns whether the peers have lost each other, and neither has sent the other away.
pub(super) fn is_loss(reason: DisconnectReason) -> bool {
    use DisconnectReason::{Full, Lost, Silent, UnknownHost};
    matches!(reason, Silent | Lost | Full | UnknownHost)
}

impl NetPeer {
    /// Tracks a peer whose connection is gone, if this peer is the one that must reconnect.
    pub(super) fn miss(&mut self, now: Duration, peer: PeerId, reason: DisconnectReason) {
        let key = self.listening.fingerprint();
        let pause = |calls| retry_pause(PAUSE, key, calls);
        if let Some(missed) = self.missed.iter_mut().find(|missed| missed.calling == Some(peer)) {
            // The other peer may not have noticed the loss yet, so its answer does not matter. Only
            // the time limit ends the attempts.
            (missed.calling, missed.next) = (None, now + pause(missed.calls));
            return;
        }
        let (PeerState::In { user }, Some(other)) = (&self.state, self.others.get(&peer)) else { return };
        let (Some(number), Some(invite)) = (other.number, other.invite.clone()) else { return };
        let known = self.missed.iter().any(|missed| missed.number == number);
        if !is_loss(reason)
            || known
            || *user < number
            || number == UserId::HOST
            || self.config.rejoin.is_zero()
        {
            return;
        }
        debug!("user {} is looked for", number.0);
        if self.missed.len() >= MAX_MISSED {
            self.missed.remove(0);
        }
        self.missed.push(Missed {
            number,
            invite,
            since: now,
            next: now + pause(0),
            calls: 0,
            calling: None,
        });
    }

    /// Stops tracking a peer that has connected, again or for the first time.
    pub(super) fn found(&mut self, number: UserId) {
        self.missed.retain(|missed| missed.number != number);
    }

    /// Connects to the lost peers whose attempts are due, and gives up those lost for too long.
    pub(super) fn look_for_the_missed(&mut self) {
        let now = self.now();
        let most = self.config.rejoin;
        self.missed.retain(|missed| now.saturating_sub(missed.since) < most);
        for at in 0..self.missed.len() {
            let missed = self.missed[at].clone();
            if missed.calling.is_some() || missed.next > now {
                continue;
            }
            self.missed[at].calls += 1;
            match self.connect_to(&missed.invite) {
                Ok(peer) => {
                    self.introduced.insert(peer, (missed.number, missed.invite));
                    self.missed[at].calling = Some(peer);
                }
                Err(error) => {
                    debug!("user {} cannot be called: {error}", missed.number.0);
                    let key = self.listening.fingerprint();
                    self.missed[at].next = now + retry_pause(PAUSE, key, missed.calls + 1);
                }
            }
        }
    }
}
