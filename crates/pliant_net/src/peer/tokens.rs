//! The tokens that a peer gives to the others.

use pliant_stream::PeerId;
use tracing::warn;

use super::NetPeer;
use crate::transport::{Access, Fingerprint, Grant, Invite, Token};

/// Most tokens that are valid at one time beside the application's.
const MAX_TOKENS: usize = 4096;

impl NetPeer {
    /// Returns the invite to this peer that the peer at a connection is told: where tokens are
    /// asked for, with that peer's own token.
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

    /// Makes the token of a peer that was sent away invalid.
    pub(super) fn take_token(&mut self, key: &Fingerprint) {
        if self.tokens.remove(key).is_some() {
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
