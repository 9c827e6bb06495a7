//! The tokens that a peer gives to the others.

use pliant_stream::{DisconnectReason, PeerId};
use tracing::warn;

use super::NetPeer;
use super::reconnect::may_come_back;
use crate::transport::{Access, Grant, Invite, Token, has_called};

/// Most tokens that are valid at one time beside the application's.
const MAX_TOKENS: usize = 4096;

impl NetPeer {
    /// Returns the invite to this peer for the peer at a connection: where tokens are required,
    /// with that peer's own token.
    pub(super) fn invite_for(&mut self, peer: PeerId) -> Invite {
        let invite = Invite { token: None, ..self.carrier.invite() };
        let (Access::Tokens(_), Some(other)) = (&self.access, self.others.get(&peer)) else { return invite };
        let key = other.key;
        if let Some(&token) = self.tokens.get(&key) {
            return invite.with_token(token);
        }
        match Token::generate() {
            Ok(token) => {
                if self.tokens.len() >= MAX_TOKENS {
                    // Those of peers that are here, or were here not long ago, stay.
                    let known = &self.known;
                    self.tokens.retain(|key, _| known.number_of(key).is_some());
                }
                self.tokens.insert(key, token);
                self.admit_tokens();
                invite.with_token(token)
            }
            Err(error) => {
                warn!("a peer has no token: {error}");
                invite
            }
        }
    }

    /// Makes the token of a peer that is sent away for good invalid. A peer that is in the session
    /// by another connection needs it to come back: of two calls of an honest peer at once, one is
    /// refused, and so is one to which a false introduction has led. The refusal may arrive before
    /// the answer to the other call.
    pub(super) fn bar(&mut self, peer: PeerId, reason: DisconnectReason) {
        let (false, Some(barred)) = (may_come_back(reason), self.others.get(&peer)) else { return };
        let key = barred.key;
        let called = |other: PeerId| reason == DisconnectReason::NumberTaken && has_called(other);
        let stays = self.others.iter().any(|(&other, by)| {
            other != peer && by.key == key && !by.sent_away && (self.is_in(other) || called(other))
        });
        if !stays && self.tokens.remove(&key).is_some() {
            self.admit_tokens();
        }
    }

    fn admit_tokens(&self) {
        if let (Access::Tokens(grants), Some(quic)) = (&self.access, self.quic()) {
            let given = self.tokens.values().map(|&token| Grant::hold(token));
            quic.set_access(Access::Tokens(grants.iter().cloned().chain(given).collect()));
        }
    }
}
