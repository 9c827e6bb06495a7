//! Introductions: a peer sends the others the list of those with whom it is connected.
//!
//! Two peers may lose each other while one of them reconnects through a third peer, which learns of
//! neither loss. Without its introduction the mesh would stay incomplete.

use std::time::Duration;

use super::{MAX_ADDRESS, MAX_PEERS, PeerEvent, PeerId, PeerMessage, PeerSession, UserId};
use crate::StreamError;

/// Shortest time between two lists that are sent.
const INTRODUCTION_INTERVAL: Duration = Duration::from_secs(2);
/// Shortest time between two lists of one peer that are read. Messages may arrive in a bunch, but
/// what a list has is in the next one, too.
const READ_EVERY: Duration = Duration::from_millis(500);

/// What this peer sends of the others.
#[derive(Debug, Default)]
pub(super) struct Introductions {
    list: Vec<(u16, String)>,
    /// Whether somebody is on the list who was not when it was sent.
    is_new: bool,
    /// When the list may be sent again.
    next: Duration,
}

impl Introductions {
    /// Removes a user who has left from the list. The list is then sent again when the user comes
    /// back, even if the app notices both at once and its own list stays the same.
    pub(super) fn forget(&mut self, user: UserId) {
        self.list.retain(|(known, _)| *known != user.0);
    }
}

impl PeerSession {
    /// Sets with whom this peer is connected, as user numbers and addresses, at most 64. When the
    /// list has a user that it had not, all peers in the session receive it, at most every two
    /// seconds. Those that lack one of its users get [`PeerEvent::Introduced`].
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for an address of more than 512 bytes.
    pub fn introduce(&mut self, others: &[(UserId, String)]) -> Result<(), StreamError> {
        if let Some((_, address)) = others.iter().find(|(_, address)| address.len() > MAX_ADDRESS) {
            let found = address.len().to_string();
            return Err(StreamError::Config { what: "address", found, expected: "at most 512 bytes" });
        }
        let known = &mut self.introductions;
        let others = others.iter().take(MAX_PEERS);
        let list: Vec<(u16, String)> = others.map(|(user, address)| (user.0, address.clone())).collect();
        known.is_new |= list.iter().any(|(user, _)| known.list.iter().all(|(before, _)| before != user));
        known.list = list;
        Ok(())
    }

    /// Sends the list if it is due.
    pub(super) fn send_introductions(&mut self, now: Duration) {
        let known = &mut self.introductions;
        if !known.is_new || now < known.next {
            return;
        }
        (known.is_new, known.next) = (false, now + INTRODUCTION_INTERVAL);
        let message = PeerMessage::Others { others: known.list.clone() };
        self.broadcast(&message);
    }

    pub(super) fn take_others(&mut self, now: Duration, peer: PeerId, others: Vec<(u16, String)>) {
        let Some(other) = self.others.get_mut(&peer).filter(|other| other.user.is_some()) else { return };
        if other.announced_at.is_some_and(|at| now.saturating_sub(at) < READ_EVERY) {
            return other.link.reject();
        }
        other.announced_at = Some(now);
        let others = others.into_iter().map(|(user, address)| (UserId(user), address));
        let others: Vec<_> =
            others.filter(|(user, _)| *user != UserId::HOST && !self.is_taken(*user)).collect();
        if !others.is_empty() {
            self.event(PeerEvent::Introduced { peer, others });
        }
    }
}
