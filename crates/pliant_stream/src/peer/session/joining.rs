//! Peers that join and peers that leave.

use std::time::Duration;

use super::repair::late_cost;
use super::{
    DisconnectReason, Hello, MAX_ADDRESS, MAX_PEERS, MIN_DATAGRAM, PROTOCOL_VERSION, PeerEvent, PeerId,
    PeerMessage, PeerSession, RemotePeer, UserId, WINDOW,
};
use crate::StreamError;
use crate::wire::InputTick;

impl PeerSession {
    /// Sets where the peer at a connection, and those to whom it passes it on, reach this peer,
    /// instead of [`PeerSessionConfig::address`](super::PeerSessionConfig::address). Call this
    /// before [`PeerSession::connect`] or [`PeerSession::accept`]. An address of more than 512
    /// bytes has no effect.
    pub fn set_address_for(&mut self, peer: PeerId, address: String) {
        if address.len() <= MAX_ADDRESS {
            self.addresses.insert(peer, address);
        }
    }

    /// Adds a connection that this side has opened, and sends a hello.
    ///
    /// `user` is the number that the other peer was given. A peer with another number is not
    /// accepted, because the lowest number is trusted. `None`: its hello has the number.
    ///
    /// # Errors
    /// Returns [`StreamError::Full`] beyond 64 peers and [`StreamError::Config`] for the number 0,
    /// which no peer has, this peer's own number, or datagrams of less than [`MIN_DATAGRAM`].
    pub fn connect(
        &mut self,
        now: Duration,
        peer: PeerId,
        user: impl Into<Option<UserId>>,
        max_datagram: usize,
    ) -> Result<(), StreamError> {
        let user = user.into();
        if let Some(user) = user.filter(|&user| user == UserId::HOST || user == self.config.user) {
            let found = user.0.to_string();
            return Err(StreamError::Config { what: "user", found, expected: "a number of another peer" });
        }
        self.add(now, peer, user, max_datagram)?;
        self.greet(peer);
        Ok(())
    }

    /// Adds a connection that the other side has opened. The answer to its hello follows when this
    /// peer has a number.
    ///
    /// When there is no room, the oldest such connection without a hello is removed to make room.
    ///
    /// # Errors
    /// Returns [`StreamError::Full`] beyond 64 peers and [`StreamError::Config`] for datagrams of
    /// less than [`MIN_DATAGRAM`].
    pub fn accept(&mut self, now: Duration, peer: PeerId, max_datagram: usize) -> Result<(), StreamError> {
        self.add(now, peer, None, max_datagram)
    }

    fn add(
        &mut self,
        now: Duration,
        peer: PeerId,
        user: Option<UserId>,
        max_datagram: usize,
    ) -> Result<(), StreamError> {
        if max_datagram < MIN_DATAGRAM {
            let found = max_datagram.to_string();
            return Err(StreamError::Config { what: "datagram size", found, expected: "at least 256 bytes" });
        }
        if self.others.len() >= MAX_PEERS
            && let Some(silent) = self.others.iter().find(|(_, o)| o.is_silent()).map(|(p, _)| *p)
        {
            self.turn_away(silent, DisconnectReason::Silent);
        }
        if self.others.len() >= MAX_PEERS {
            return Err(StreamError::Full { what: "peers", limit: MAX_PEERS });
        }
        self.others.insert(peer, RemotePeer::new(peer, now, user, max_datagram, self.config.step));
        Ok(())
    }

    /// Sets a new datagram size of the path to a peer. A peer whose path carries less than
    /// [`MIN_DATAGRAM`] is disconnected.
    pub fn set_max_datagram(&mut self, peer: PeerId, bytes: usize) {
        let Some(other) = self.others.get_mut(&peer) else { return };
        other.link.max_datagram = bytes;
        if bytes < MIN_DATAGRAM {
            self.turn_away(peer, DisconnectReason::SmallDatagrams);
        }
    }

    /// Sends a hello, once for each connection.
    fn greet(&mut self, peer: PeerId) {
        let hello = PeerMessage::Hello {
            version: PROTOCOL_VERSION,
            user: self.config.user.0,
            name: self.config.name.clone(),
            address: self.addresses.get(&peer).unwrap_or(&self.config.address).clone(),
            joining: !self.started,
            scene: self.scene(),
        };
        if let Some(other) = self.others.get_mut(&peer).filter(|other| !other.greeted) {
            other.greeted = true;
            self.message(peer, &hello);
        }
    }

    /// Gives a peer the number that it has requested ([`PeerEvent::JoinRequest`]), and sends it the
    /// numbers and addresses of the others.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownPeer`] for a connection that has not requested a number, and
    /// [`StreamError::Config`] for a number in use or an address of more than 512 bytes.
    pub fn welcome(
        &mut self,
        peer: PeerId,
        user: UserId,
        others: &[(UserId, String)],
    ) -> Result<(), StreamError> {
        let asking = |hello: &&Hello| hello.user == UserId::HOST;
        let asks = self.others.get(&peer).and_then(|other| other.hello.as_ref()).filter(asking).cloned();
        let hello = asks.ok_or(StreamError::UnknownPeer(peer))?;
        if user == UserId::HOST || self.is_taken(user) {
            let found = user.0.to_string();
            return Err(StreamError::Config { what: "user", found, expected: "a number that is free" });
        }
        if let Some((_, address)) = others.iter().find(|(_, address)| address.len() > MAX_ADDRESS) {
            let found = address.len().to_string();
            return Err(StreamError::Config { what: "address", found, expected: "at most 512 bytes" });
        }
        let others = others.iter().take(MAX_PEERS).map(|(user, address)| (user.0, address.clone())).collect();
        self.greet(peer);
        self.message(peer, &PeerMessage::Welcome { user: user.0, others });
        self.join(peer, Hello { user, ..hello });
        Ok(())
    }

    pub(super) fn is_taken(&self, user: UserId) -> bool {
        user == self.config.user || self.inputs.users.get(&user).is_some_and(|u| !u.gone)
    }

    /// Takes a peer's hello, once this peer has a number.
    pub(super) fn take_hello(&mut self, peer: PeerId) {
        let Some(hello) = self.others.get(&peer).and_then(|other| other.hello.clone()) else { return };
        if self.config.user == UserId::HOST {
            return;
        }
        if hello.user == UserId::HOST {
            return self.event(PeerEvent::JoinRequest { peer });
        }
        if self.is_taken(hello.user) {
            return self.turn_away(peer, DisconnectReason::NumberTaken);
        }
        self.greet(peer);
        self.join(peer, hello);
    }

    /// Lets a peer into the session.
    fn join(&mut self, peer: PeerId, hello: Hello) {
        let Hello { user, name, address, joining } = hello;
        let Some(other) = self.others.get_mut(&peer) else { return };
        (other.user, other.hello) = (Some(user), None);
        if let Some(budgets) = self.away.take(user) {
            other.budgets = budgets;
        }
        other.wants_state = joining && self.started;
        // Founding peers start together and expect each other from the start. The hands of a
        // joining peer come later. The first state that can be given to it is that of tick 1.
        let first =
            if joining { self.tick.max(1) + 1 } else { 1.max(self.tick.saturating_sub(WINDOW as u64 / 2)) };
        self.inputs.expect(user, first);
        self.event(PeerEvent::Joined { peer, user, name, address });
    }

    /// Ends a connection with a goodbye.
    pub(super) fn turn_away(&mut self, peer: PeerId, reason: DisconnectReason) {
        self.message(peer, &PeerMessage::Goodbye { reason });
        self.disconnect(peer, reason);
    }

    /// Removes a connection.
    pub fn disconnect(&mut self, peer: PeerId, reason: DisconnectReason) {
        self.addresses.remove(&peer);
        let Some(mut other) = self.others.remove(&peer) else { return };
        self.gone.add_counts(&other.link.stats);
        let Some(user) = other.user else { return self.event(PeerEvent::TurnedAway { peer, reason }) };
        // All peers received the same last input, or extrapolate the same hands a little further.
        // After that the hands are released.
        if let Some(last) = self.inputs.users.get(&user).and_then(|inputs| inputs.newest()).cloned() {
            let from = last.tick + 1;
            let bodies = self.changed_by(user, &InputTick { tick: from, ..InputTick::default() });
            let again = self.ticks_to_resimulate(&bodies, from);
            // Without a hand in its last input, nothing was extrapolated.
            if again > 0 {
                // The user pays for the ticks as for a late input. Otherwise a state repairs all.
                let cost = late_cost((&self.bodies, &self.inputs), &last, again);
                if other.pays_for_late(&mut self.shared, self.updated, cost) {
                    self.mark(&bodies, from);
                } else {
                    self.others.values_mut().for_each(|o| o.lost = true);
                }
            }
        }
        if let Some(inputs) = self.inputs.users.get_mut(&user) {
            inputs.gone = true;
        }
        self.inputs.forget_gone(self.tick);
        self.introductions.forget(user);
        self.away.keep(user, other.budgets);
        self.event(PeerEvent::Left { user, reason });
    }
}
