//! Peers that have lost each other find each other again.

use std::time::Duration;

use pliant_stream::{DisconnectReason, PeerId, UserId};
use tracing::debug;

use super::{NetPeer, PeerState};
use crate::transport::{CloseReason, Invite};

/// Somebody who cannot be heard any more and has not said goodbye.
#[derive(Debug, Clone)]
pub(super) struct Missed {
    pub(super) number: UserId,
    invite: Invite,
    since: Duration,
    next: Duration,
    /// The connection that is being tried.
    calling: Option<PeerId>,
}

/// Between two calls.
const PAUSE: Duration = Duration::from_secs(1);
/// So many are looked for at most; who has been missed longest is given up first.
const MOST_MISSED: usize = 64;

/// Did the other end go of its own will? One that has found us silent has not.
fn has_left(reason: &CloseReason) -> bool {
    match reason {
        CloseReason::ByPeer { reason, .. } => *reason != DisconnectReason::Silent,
        CloseReason::Protocol { .. } | CloseReason::Refused { .. } | CloseReason::WrongFingerprint { .. } => {
            true
        }
        _ => false,
    }
}

impl NetPeer {
    /// A connection is gone: is it to be made again, and by us?
    pub(super) fn miss(&mut self, now: Duration, peer: PeerId, reason: &CloseReason) {
        if let Some(missed) = self.missed.iter_mut().find(|missed| missed.calling == Some(peer)) {
            // Whatever the other says now (it may not have noticed yet that we were gone), only the time decides.
            (missed.calling, missed.next) = (None, now + PAUSE);
            return;
        }
        let (PeerState::In { user }, Some(other)) = (&self.state, self.others.get(&peer)) else { return };
        let (Some(number), Some(invite)) = (other.number, other.invite.clone()) else { return };
        let known = self.missed.iter().any(|missed| missed.number == number);
        if has_left(reason)
            || known
            || *user < number
            || number == UserId::HOST
            || self.config.rejoin.is_zero()
        {
            return;
        }
        debug!("user {} is looked for", number.0);
        if self.missed.len() >= MOST_MISSED {
            self.missed.remove(0);
        }
        self.missed.push(Missed { number, invite, since: now, next: now + PAUSE, calling: None });
    }

    /// Somebody is here, again or for the first time.
    pub(super) fn found(&mut self, number: UserId) {
        self.missed.retain(|missed| missed.number != number);
    }

    /// Calls those whose turn it is, and gives up on those missed for too long.
    pub(super) fn look_for_the_missed(&mut self) {
        let now = self.now();
        let most = self.config.rejoin;
        self.missed.retain(|missed| now.saturating_sub(missed.since) < most);
        for at in 0..self.missed.len() {
            let missed = self.missed[at].clone();
            if missed.calling.is_some() || missed.next > now {
                continue;
            }
            match self.connect_to(&missed.invite) {
                Ok(peer) => {
                    self.introduced.insert(peer, (missed.number, missed.invite));
                    self.missed[at].calling = Some(peer);
                }
                Err(error) => {
                    debug!("user {} cannot be called: {error}", missed.number.0);
                    self.missed[at].next = now + PAUSE;
                }
            }
        }
    }
}
