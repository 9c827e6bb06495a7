//! Connections among the peers, and the session's traffic.

use std::collections::BTreeSet;
use std::time::Duration;

use bevy::prelude::*;
use bytes::Bytes;
use pliant_stream::peer::PeerEvent;
use pliant_stream::wire::PeerMessage;
use pliant_stream::{Channel, DisconnectReason, PeerId, StreamError, UserId};

use super::reconnect::may_come_back;
use super::{NetPeer, PeerState};
use crate::remote::SessionJoined;
use crate::session::{SessionEvent, give_back, queue_event};
use crate::transport::{Event, Fingerprint, Invite, Role, has_called};
use crate::user::UserLink;

/// Another peer that this peer is connected with.
#[derive(Debug)]
pub(super) struct ConnectedPeer {
    pub(super) key: Fingerprint,
    address: Option<std::net::IpAddr>,
    /// The peer's user number, which this peer assigned or the other peer sent. The session then
    /// uses it.
    pub(super) number: Option<UserId>,
    /// Where the peer listens, for peers that join later.
    pub(super) invite: Option<Invite>,
    /// The peer's first message, until this peer's own session has begun.
    first: Option<Bytes>,
    /// When the peer connected.
    since: Duration,
    /// Whether this peer has closed the connection. Data that still arrives is ignored.
    pub(super) sent_away: bool,
}

impl ConnectedPeer {
    /// Replaces the invite's host with the address from which the peer has connected.
    fn with_seen_address(&self, invite: Invite) -> Invite {
        let host = self.address.map_or_else(|| invite.host.clone(), |address| address.to_string());
        Invite { host, ..invite }
    }
}

/// Processes the data from the peers.
pub(crate) fn receive(world: &mut World) {
    world.try_resource_scope(|world, mut peer: Mut<NetPeer>| {
        let net = &mut *peer;
        if matches!(net.state, PeerState::Closed { .. }) {
            return;
        }
        net.start(world);
        net.take_events(world);
        net.carrier.begin_frame();
        while let Some(event) = net.carrier.poll_in_frame() {
            net.take(world, event);
            // Events are processed at once. The session keeps a limited number of them, and one
            // peer's flood must not drop another peer's goodbye.
            net.take_events(world);
        }
        net.take_events(world);
        net.measure_paths();
        net.hang_up_on_the_silent();
        net.look_for_the_missed();
        net.flush();
    });
}

impl NetPeer {
    /// Creates the session when the bodies are loaded.
    fn start(&mut self, world: &mut World) {
        if self.session.is_some() || !self.gather(world) {
            return;
        }
        self.begin(world);
        // Connections may have opened before the bodies were loaded.
        let waiting: Vec<PeerId> = self.others.keys().copied().collect();
        waiting.into_iter().for_each(|peer| self.bring_in(peer));
    }

    /// Brings a connection into the session, once there is one. A peer that this one has called is
    /// greeted, and of any other peer the first message is awaited.
    fn bring_in(&mut self, peer: PeerId) {
        let now = self.now();
        let (most, opened) = (self.carrier.max_datagram_size(peer).unwrap_or(0), has_called(peer));
        let (Some(session), Some(other)) = (&self.session, self.others.get(&peer)) else { return };
        if session.stats(peer).is_some() || !(opened || other.first.is_some()) {
            return;
        }
        // The number that the peer has, or says that it has.
        let announced = other.first.as_ref().and_then(|bytes| match PeerMessage::decode(bytes) {
            Ok(PeerMessage::Hello { user, .. }) => Some(UserId(user)),
            _ => None,
        });
        if other.number.or(announced).is_some_and(|user| self.known.is_anothers(user, &other.key)) {
            return self.hang_up(peer, DisconnectReason::NumberTaken);
        }
        let address = self.invite_for(peer).to_string();
        let (Some(session), Some(other)) = (&mut self.session, self.others.get_mut(&peer)) else { return };
        session.set_address_for(peer, address);
        let added = if opened {
            session.connect(now, peer, other.number, most)
        } else {
            session.accept(now, peer, most)
        };
        if let Err(error) = added {
            debug!("peer {peer}: {error}");
            let is_small = matches!(error, StreamError::Config { what: "datagram size", .. });
            let reason = if is_small { DisconnectReason::SmallDatagrams } else { DisconnectReason::Full };
            return self.hang_up(peer, reason);
        }
        if let Some(bytes) = other.first.take() {
            session.on_message(now, peer, &bytes);
        }
    }

    fn take(&mut self, world: &mut World, event: Event) {
        let now = self.now();
        match event {
            Event::Connected { peer, fingerprint, address, role } => {
                let (number, invite) = self.introduced.remove(&peer).unzip();
                let address = address.map(|address| address.ip());
                // The peer of this peer's own invite is reached there by others too.
                let first = has_called(peer) && matches!(self.state, PeerState::Joining);
                let invite = invite.or_else(|| self.config.join.clone().filter(|_| first));
                let (first, since, sent_away) = (None, now, false);
                let other =
                    ConnectedPeer { key: fingerprint, address, number, invite, first, since, sent_away };
                self.others.insert(peer, other);
                if role == Role::Watch && !has_called(peer) {
                    // Every peer steps the bodies with its own hands, so the mesh has no place for
                    // a watcher.
                    return self.hang_up(peer, DisconnectReason::WatchOnly);
                }
                self.bring_in(peer);
            }
            // The connection only stays open to send this peer's goodbye.
            Event::Datagram { peer, .. } | Event::Message { peer, .. }
                if self.others.get(&peer).is_none_or(|other| other.sent_away) => {}
            Event::Datagram { peer, at, bytes } => {
                let at = at.saturating_duration_since(self.began);
                if let Some(session) = &mut self.session {
                    session.on_datagram(at, peer, &bytes);
                }
            }
            Event::Message { peer, bytes } => match &mut self.session {
                Some(session) if session.stats(peer).is_some() => session.on_message(now, peer, &bytes),
                _ => {
                    if let Some(other) = self.others.get_mut(&peer) {
                        other.first.get_or_insert(bytes);
                    }
                    self.bring_in(peer);
                }
            },
            Event::Closed { peer, reason } => {
                debug!("peer {peer} is gone: {reason}");
                self.miss(now, peer, reason);
                if let Some(session) = &mut self.session {
                    session.disconnect(peer, reason);
                }
                if let Some(other) = self.others.remove(&peer)
                    && let Some(user) = self.known.number_of(&other.key)
                {
                    self.see(other.key, user);
                }
                self.introduced.remove(&peer);
                if has_called(peer) && matches!(self.state, PeerState::Joining) {
                    self.close(world, reason);
                }
            }
        }
    }

    /// Keeps that a peer has come or gone.
    fn see(&mut self, key: Fingerprint, user: UserId) {
        let own = self.carrier.fingerprint();
        let here: BTreeSet<Fingerprint> = self.others.values().map(|other| other.key).chain([own]).collect();
        self.known.see(key, user, |key| here.contains(key));
    }

    /// Whether the peer at a connection is in the session.
    pub(super) fn is_in(&self, peer: PeerId) -> bool {
        self.session.as_ref().is_some_and(|session| session.user_of(peer).is_some())
    }

    /// The peers that are in the session with this one, and where they are reached.
    pub(super) fn reachable(&self) -> Vec<(UserId, String)> {
        // A peer at an introduced address counts only from its hello on.
        let here = self.others.iter().filter(|(peer, _)| self.is_in(**peer));
        here.filter_map(|(_, other)| Some((other.number?, other.invite.as_ref()?.to_string()))).collect()
    }

    /// Gives a new peer its number and the invites of all other peers.
    fn welcome(&mut self, peer: PeerId) {
        let others = self.reachable();
        let Some(key) = self.others.get(&peer).map(|other| other.key) else { return };
        let present: BTreeSet<UserId> = self.others.values().filter_map(|other| other.number).collect();
        let before = self.known.number_of(&key).filter(|before| !present.contains(before));
        let Some(number) = before.or_else(|| self.known.free_number(&present)) else {
            return self.hang_up(peer, DisconnectReason::Full);
        };
        let Some(session) = &mut self.session else { return };
        if let Err(error) = session.welcome(peer, number, &others) {
            debug!("peer {peer}: {error}");
            self.hang_up(peer, DisconnectReason::Full);
        }
    }

    /// Keeps the number of a peer that has joined, and where it is reached.
    fn keep_joined(&mut self, peer: PeerId, user: UserId, address: &str) -> bool {
        let Some(other) = self.others.get_mut(&peer) else { return false };
        if self.known.is_anothers(user, &other.key) {
            self.hang_up(peer, DisconnectReason::NumberTaken);
            return false;
        }
        let announced = address.parse::<Invite>();
        match (&mut other.invite, announced) {
            // A peer that this one has called is reached where it was called, with the token that
            // it has given to this one.
            (Some(invite), Ok(announced)) => invite.token = announced.token.or(invite.token),
            (Some(_), Err(_)) => {}
            (None, Ok(announced)) => other.invite = Some(other.with_seen_address(announced)),
            (None, Err(_)) => {
                self.hang_up(peer, DisconnectReason::Protocol);
                return false;
            }
        }
        other.number = Some(user);
        let key = other.key;
        self.see(key, user);
        true
    }

    /// Connects to the peers that were in the session before this one.
    fn call(&mut self, others: Vec<(UserId, String)>) {
        for (number, address) in others {
            let Ok(invite) = address.parse::<Invite>() else {
                debug!("user {} has no invite", number.0);
                continue;
            };
            match self.carrier.call(&invite) {
                Ok(peer) => {
                    self.introduced.insert(peer, (number, invite));
                }
                Err(error) => warn!("another peer cannot be reached: {error}"),
            }
        }
    }

    fn send(&self, peer: PeerId, message: Bytes) {
        if let Err(error) = self.carrier.send_message(peer, message) {
            debug!("not sent to peer {peer}: {error}");
            self.carrier.close(peer, DisconnectReason::Unread);
        }
    }

    /// Disconnects peers that connect without introducing themselves, because each of them would
    /// occupy a place.
    fn hang_up_on_the_silent(&mut self) {
        let (Some(session), PeerState::In { .. }) = (&self.session, &self.state) else { return };
        let (now, most) = (self.now(), self.limits.handshake);
        let silent = |(peer, other): &(&PeerId, &ConnectedPeer)| {
            // A peer that connected while this peer's bodies were being loaded could not be
            // answered earlier.
            let since = other.since.max(self.began_at);
            !other.sent_away && now.saturating_sub(since) > most && session.user_of(**peer).is_none()
        };
        let silent: Vec<PeerId> = self.others.iter().filter(silent).map(|(&peer, _)| peer).collect();
        for peer in silent {
            self.hang_up(peer, DisconnectReason::Silent);
        }
    }

    /// Tells the session how large the datagrams of each path may be, which QUIC finds out while it
    /// runs.
    fn measure_paths(&mut self) {
        let size = |&peer: &PeerId| Some((peer, self.carrier.max_datagram_size(peer)?));
        let sizes: Vec<(PeerId, usize)> = self.others.keys().filter_map(size).collect();
        let Some(session) = &mut self.session else { return };
        sizes.into_iter().for_each(|(peer, bytes)| session.set_max_datagram(peer, bytes));
    }

    fn hang_up(&mut self, peer: PeerId, reason: DisconnectReason) {
        debug!("peer {peer} is sent away: {reason}");
        if let Some(other) = self.others.get_mut(&peer) {
            (other.sent_away, other.first) = (true, None);
            self.bar(peer, reason);
        }
        self.carrier.close(peer, reason);
        if let Some(session) = &mut self.session {
            session.disconnect(peer, reason);
        }
    }

    pub(super) fn flush(&mut self) {
        let Some(session) = &mut self.session else { return };
        let mut out = Vec::new();
        out.extend(std::iter::from_fn(|| session.poll_output()));
        for output in out {
            match output.channel {
                Channel::Datagram => {
                    // A datagram that is not taken is lost. The next one repeats its content.
                    let _ = self.carrier.send_datagram(output.peer, Bytes::from_owner(output.bytes));
                }
                Channel::Message => self.send(output.peer, Bytes::from_owner(output.bytes)),
            }
        }
    }

    fn take_events(&mut self, world: &mut World) {
        let now = self.now();
        while let Some(event) = self.session.as_mut().and_then(|session| session.poll_event()) {
            match event {
                PeerEvent::Started => {
                    if let PeerState::In { user } = self.state {
                        queue_event(world, SessionEvent::Joined(SessionJoined { user, reconnected: false }));
                    }
                }
                PeerEvent::JoinRequest { peer } => self.welcome(peer),
                PeerEvent::Welcomed { user, others } => {
                    self.enter(world, user);
                    self.call(others);
                }
                PeerEvent::Joined { peer, user, name, address } => {
                    if !self.keep_joined(peer, user, &address) {
                        continue;
                    }
                    self.found(user, peer);
                    self.refused.remove(&user);
                    self.introduce();
                    self.users.join(world, user, &name, Role::Hold, false);
                }
                PeerEvent::Introduced { peer, others } => self.look_for_introduced(peer, others),
                PeerEvent::Left { user, reason } => {
                    if !may_come_back(reason) && reason != DisconnectReason::Left {
                        self.refused.insert(user);
                    }
                    if !self.users.leave(world, user, reason) {
                        continue;
                    }
                    let gone: Vec<PeerId> = self
                        .others
                        .iter()
                        .filter(|(_, other)| other.number == Some(user))
                        .map(|(&peer, _)| peer)
                        .collect();
                    for peer in gone {
                        if reason == DisconnectReason::Silent {
                            self.miss(now, peer, reason);
                        }
                        self.carrier.close(peer, reason);
                        if let Some(other) = self.others.get_mut(&peer) {
                            (other.number, other.invite, other.sent_away) = (None, None, true);
                            if reason != DisconnectReason::Left {
                                self.bar(peer, reason);
                            }
                        }
                    }
                    // Whoever comes back counts as new, and the list is sent again: another peer
                    // may have given up looking.
                    self.introduce();
                }
                PeerEvent::TurnedAway { peer, reason } => {
                    // The session's goodbye is more precise than the end of the connection, so it
                    // is sent first.
                    self.flush();
                    self.hang_up(peer, reason);
                }
                PeerEvent::Resynced { from } => debug!("the state of user {} was taken over", from.0),
                _ => {}
            }
        }
        // QUIC measures the round trip and the outgoing loss of each link.
        for (&peer, other) in &self.others {
            let entity = other.number.and_then(|user| self.users.get(user));
            let (Some(stats), Some(entity)) = (self.carrier.stats(peer), entity) else { continue };
            if let Some(mut link) = world.get_mut::<UserLink>(entity) {
                let (round_trip, loss_out) = (stats.round_trip, stats.loss());
                let session = self.session.as_ref().and_then(|session| session.stats(peer));
                let loss_in = session.map_or(0.0, |session| session.loss_in);
                link.set_if_neq(UserLink { round_trip, loss_in, loss_out });
            }
        }
    }

    pub(super) fn close(&mut self, world: &mut World, reason: DisconnectReason) {
        info!("the session is over: {reason}");
        let inside = matches!(self.state, PeerState::In { .. });
        self.state = PeerState::Closed { reason };
        queue_event(world, SessionEvent::over(inside, reason));
    }

    /// Leaves the session as the app has asked. The bodies are the app's again, the other peers
    /// receive a goodbye, and the port is free.
    pub(crate) fn end(&mut self, world: &mut World) {
        if matches!(self.state, PeerState::In { .. }) {
            self.close(world, DisconnectReason::Left);
        }
        self.end_connections();
        self.users.clear(world);
        self.bodies.values().for_each(|played| give_back(world, played.entity));
    }
}
