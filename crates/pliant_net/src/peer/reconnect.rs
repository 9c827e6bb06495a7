//! Reconnects peers that have lost each other.

use std::collections::BTreeSet;
use std::time::Duration;

use pliant_stream::{DisconnectReason, PeerId, UserId};
use tracing::debug;

use super::missed::Missed;
use super::{NetPeer, PeerState};
use crate::transport::{Fingerprint, Invite};

/// Returns whether a connection that ended for this reason is opened again: the peers have lost
/// each other, or there was no room, and neither has sent the other away.
pub(super) fn may_come_back(reason: DisconnectReason) -> bool {
    reason.is_loss() || reason == DisconnectReason::Full
}

impl NetPeer {
    /// Tracks a peer whose connection is gone, if this peer is the one that must reconnect.
    pub(super) fn miss(&mut self, now: Duration, peer: PeerId, reason: DisconnectReason) {
        if self.missed.ended(now, peer) {
            return;
        }
        let (PeerState::In { user }, Some(other)) = (&self.state, self.others.get(&peer)) else { return };
        let (Some(number), Some(invite)) = (other.number, other.invite.clone()) else { return };
        if may_come_back(reason) && number < *user && number != UserId::HOST {
            self.missed.lose(now, number, invite);
        }
    }

    /// Looks for peers that another one is connected with and this one is not. The one with the
    /// higher number connects, so that only one of two does.
    pub(super) fn look_for_introduced(&mut self, peer: PeerId, others: Vec<(UserId, String)>) {
        let PeerState::In { user: own } = self.state else { return };
        let Some(reporter) = self.others.get(&peer).and_then(|other| other.number) else { return };
        let now = self.now();
        let here = self.others.iter().filter(|(peer, _)| self.is_in(**peer));
        let keys: BTreeSet<Fingerprint> = here.map(|(_, other)| other.key).collect();
        for (number, address) in others {
            let Ok(invite) = address.parse::<Invite>() else { continue };
            // A malicious peer may send any address. So a peer that is in the session is not called
            // at one, neither under its own number nor under another.
            let is_here = self.users.get(number).is_some() || keys.contains(&invite.fingerprint);
            if number < own && number != UserId::HOST && !is_here && !self.refused.contains(&number) {
                self.missed.report(now, reporter, number, invite);
            }
        }
    }

    /// Sends the other peers the list of those with whom this one is connected.
    pub(super) fn introduce(&mut self) {
        let others = self.reachable();
        let Some(session) = &mut self.session else { return };
        if let Err(error) = session.introduce(&others) {
            debug!("no introductions are sent: {error}");
        }
    }

    /// Stops looking for a peer that has connected, again or for the first time. Attempts at other
    /// addresses end. They are not sent away, which would cost that peer the token to come back.
    pub(super) fn found(&mut self, number: UserId, by: PeerId) {
        for peer in self.missed.found(number).into_iter().filter(|peer| *peer != by) {
            if let Some(session) = &mut self.session {
                session.disconnect(peer, DisconnectReason::Left);
            }
            self.others.remove(&peer);
            self.introduced.remove(&peer);
            self.carrier.forget(peer);
        }
    }

    /// Connects to the lost peers whose attempts are due, and gives up those lost for too long.
    pub(super) fn look_for_the_missed(&mut self) {
        let now = self.now();
        let none = Missed::new(Duration::ZERO, self.carrier.fingerprint());
        let mut missed = std::mem::replace(&mut self.missed, none);
        missed.call(now, |number, invite| match self.carrier.call(invite) {
            Ok(peer) => {
                self.introduced.insert(peer, (number, invite.clone()));
                Some(peer)
            }
            Err(error) => {
                debug!("user {} cannot be called: {error}", number.0);
                None
            }
        });
        self.missed = missed;
    }
}
