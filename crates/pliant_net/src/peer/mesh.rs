//! Connections among the peers, and the session's traffic.

use std::collections::BTreeSet;
use std::time::Duration;

use bevy::prelude::*;
use bytes::Bytes;
use pliant_stream::peer::PeerEvent;
use pliant_stream::{Channel, DisconnectReason, PeerId, UserId};

use super::message::{MOST_PEERS, MeshMessage, PeerScene};
use super::{NetPeer, PeerState};
use crate::remote::{SessionClosed, SessionJoined};
use crate::transport::{Endpoint, Event, Fingerprint, Invite, Role};
use crate::user::UserLink;

/// Most keys whose user numbers are remembered.
const MOST_REMEMBERED: usize = 4096;

/// Another peer that this peer is connected with.
#[derive(Debug)]
pub(super) struct ConnectedPeer {
    pub(super) key: Fingerprint,
    address: std::net::IpAddr,
    /// The peer's user number, which this peer assigned or the other peer sent. The session then
    /// uses it.
    pub(super) number: Option<UserId>,
    /// Where the peer listens, for peers that join later.
    pub(super) invite: Option<Invite>,
    /// What the peer has said of itself, until this peer's own session has begun.
    waits: Option<Arrival>,
    /// When the peer connected.
    since: Duration,
    /// Whether this peer has closed the connection. Data that still arrives is ignored.
    sent_away: bool,
}

/// The first message of a peer that has connected to this one.
#[derive(Debug)]
enum Arrival {
    /// A new peer with this peer's invite, which asks for a number.
    New { scene: PeerScene, invite: Invite },
    /// A peer that has its number and was told of this one.
    Member { number: UserId, scene: PeerScene, invite: Invite },
}

impl ConnectedPeer {
    /// Replaces the invite's host with the address from which the peer has connected.
    fn seen_from_here(&self, invite: Invite) -> Invite {
        Invite { host: self.address.to_string(), ..invite }
    }
}

/// `PreUpdate`: processes the data from the peers.
pub(crate) fn receive(world: &mut World) {
    world.try_resource_scope(|world, mut peer: Mut<NetPeer>| {
        let net = &mut *peer;
        if matches!(net.state, PeerState::Closed { .. }) {
            return;
        }
        net.start(world);
        let mut came: Vec<(Option<PeerId>, Event)> = Vec::new();
        // An unread queue drops its oldest datagrams, so this reads all of them.
        came.extend(std::iter::from_fn(|| net.listening.poll()).map(|event| (None, event)));
        for (&peer, endpoint) in &net.opened {
            came.extend(std::iter::from_fn(|| endpoint.poll()).map(|event| (Some(peer), event)));
        }
        for (opened, event) in came {
            net.take(world, opened, event);
            // Events are processed at once. The session keeps a limited number of them, and one
            // peer's flood must not drop another peer's goodbye.
            net.take_events(world);
        }
        net.take_events(world);
        net.hang_up_on_the_silent();
        net.ending.retain(|thread| !thread.is_finished());
        net.look_for_the_missed();
        net.flush();
    });
}

impl NetPeer {
    /// Starts the session when the bodies are loaded: begins a new one, or asks to join.
    fn start(&mut self, world: &mut World) {
        if self.scene.bodies.is_empty() && !self.gather(world) {
            return;
        }
        if self.session.is_none() && self.config.join.is_none() {
            let user = UserId(1);
            if self.begin(world, user, true) {
                world.write_message(SessionJoined { user, reconnected: false });
            }
        }
        let waiting: Vec<PeerId> =
            self.others.iter().filter(|(_, other)| other.waits.is_some()).map(|(&peer, _)| peer).collect();
        if self.session.is_some() {
            waiting.into_iter().for_each(|peer| self.let_in(peer));
        }
        // The connection to the first peer may have opened before the bodies were loaded.
        if self.session.is_none() {
            let asked: Vec<PeerId> = self.opened.keys().copied().collect();
            for peer in asked {
                if let Some(other) = self.others.get_mut(&peer).filter(|other| other.number.is_none()) {
                    // The number marks the request as sent. The answer brings the real number.
                    other.number = Some(UserId::HOST);
                    let (scene, invite) = (self.scene.clone(), self.listening.invite());
                    self.send(peer, &MeshMessage::Introduce { scene, invite });
                }
            }
        }
    }

    fn take(&mut self, world: &mut World, opened: Option<PeerId>, event: Event) {
        let now = self.now();
        match event {
            Event::Connected { peer, fingerprint, address, role } => {
                let peer = opened.unwrap_or(peer);
                let (number, invite) = self.introduced.remove(&peer).unzip();
                let address = address.ip();
                let (waits, since, sent_away) = (None, now, false);
                let other =
                    ConnectedPeer { key: fingerprint, address, number, invite, waits, since, sent_away };
                self.others.insert(peer, other);
                if role == Role::Watch && opened.is_none() {
                    // Every peer steps the bodies with its own hands, so the mesh has no place for
                    // a watcher.
                    return self.hang_up(peer, DisconnectReason::WatchOnly);
                }
                // This peer sends a join request to the first peer only, and introduces itself to
                // the others.
                if let (Some(_), PeerState::In { user }) = (opened, &self.state) {
                    let (number, scene, invite) = (*user, self.scene.clone(), self.listening.invite());
                    self.send(peer, &MeshMessage::Member { number, scene, invite });
                    self.talk_to(now, peer);
                }
            }
            // The connection only stays open to send this peer's goodbye.
            Event::Datagram { peer, .. } | Event::Message { peer, .. }
                if self.others.get(&opened.unwrap_or(peer)).is_none_or(|other| other.sent_away) => {}
            Event::Datagram { peer, at, bytes } => {
                let at = at.saturating_duration_since(self.began);
                if let Some(session) = &mut self.session {
                    session.on_datagram(at, opened.unwrap_or(peer), &bytes);
                }
            }
            Event::Message { peer, bytes } => {
                let peer = opened.unwrap_or(peer);
                self.on_mesh_message(world, now, peer, opened.is_some(), bytes);
            }
            Event::Closed { peer, reason } => {
                let peer = opened.unwrap_or(peer);
                debug!("peer {peer} is gone: {reason}");
                self.miss(now, peer, reason);
                if let Some(session) = &mut self.session {
                    session.disconnect(peer, reason);
                }
                self.others.remove(&peer);
                self.introduced.remove(&peer);
                // The endpoint's thread may wait for the other end's last packets, which must not
                // block a frame.
                self.ending.extend(self.opened.remove(&peer).and_then(Endpoint::close_detached));
                if opened.is_some() && self.session.is_none() {
                    self.close(world, reason);
                }
            }
        }
    }

    fn on_mesh_message(
        &mut self,
        world: &mut World,
        now: Duration,
        peer: PeerId,
        opened: bool,
        bytes: Bytes,
    ) {
        match MeshMessage::read(bytes) {
            Some(MeshMessage::Session(bytes)) => {
                if let Some(session) = &mut self.session {
                    session.on_message(now, peer, &bytes);
                }
            }
            Some(MeshMessage::Introduce { scene, invite }) if !opened => {
                self.arrived(peer, Arrival::New { scene, invite });
            }
            Some(MeshMessage::Member { number, scene, invite }) if !opened => {
                self.arrived(peer, Arrival::Member { number, scene, invite });
            }
            Some(MeshMessage::Welcome { number, from, others })
                if opened
                    && self.session.is_none()
                    && ![number, from].contains(&UserId::HOST)
                    && number != from =>
            {
                if !self.begin(world, number, false) {
                    return;
                }
                if let Some(first) = self.others.get_mut(&peer) {
                    (first.number, first.invite) = (Some(from), self.config.join.clone());
                    let key = first.key;
                    self.remember(key, from);
                }
                self.talk_to(now, peer);
                for (number, invite) in others {
                    match self.connect_to(&invite) {
                        Ok(peer) => {
                            self.introduced.insert(peer, (number, invite));
                        }
                        Err(error) => warn!("another peer cannot be reached: {error}"),
                    }
                }
            }
            _ => {
                self.rejected += 1;
                self.hang_up(peer, DisconnectReason::Protocol);
            }
        }
    }

    /// Remembers the user number of a key for a reconnect. The number of remembered keys is
    /// limited, and keys of absent peers are forgotten first.
    pub(super) fn remember(&mut self, key: Fingerprint, number: UserId) {
        if self.numbers.len() >= MOST_REMEMBERED && !self.numbers.contains_key(&key) {
            let here: BTreeSet<Fingerprint> = self.others.values().map(|other| other.key).collect();
            let gone = self.numbers.keys().find(|key| !here.contains(key)).copied();
            gone.map(|key| self.numbers.remove(&key));
        }
        self.numbers.insert(key, number);
    }

    /// Takes a peer's first message. The answer waits until this peer's own session has begun: the
    /// welcome of this peer may still be on its way when others have been told of it.
    fn arrived(&mut self, peer: PeerId, arrival: Arrival) {
        let Some(other) = self.others.get_mut(&peer) else { return };
        if other.number.is_some() || other.waits.is_some() {
            return self.hang_up(peer, DisconnectReason::Protocol);
        }
        other.waits = Some(arrival);
        if self.session.is_some() {
            self.let_in(peer);
        }
    }

    /// Answers a peer that has arrived.
    fn let_in(&mut self, peer: PeerId) {
        match self.others.get_mut(&peer).and_then(|other| other.waits.take()) {
            Some(Arrival::New { scene, invite }) => self.welcome(peer, scene, invite),
            Some(Arrival::Member { number, scene, invite }) => self.take_member(peer, number, scene, invite),
            None => {}
        }
    }

    /// Begins to play with a peer that has its number.
    fn take_member(&mut self, peer: PeerId, number: UserId, scene: PeerScene, invite: Invite) {
        let known = self.others.values().any(|other| other.number == Some(number));
        let own = if let PeerState::In { user } = self.state { user } else { UserId::HOST };
        if scene != self.scene {
            self.hang_up(peer, DisconnectReason::SceneMismatch);
        } else if known || number == UserId::HOST || number == own {
            self.hang_up(peer, DisconnectReason::NumberTaken);
        } else if let Some(other) = self.others.get_mut(&peer) {
            other.number = Some(number);
            other.invite = Some(other.seen_from_here(invite));
            let key = other.key;
            self.remember(key, number);
            self.talk_to(self.now(), peer);
        }
    }

    /// Gives a new peer its number and the invites of all other peers.
    fn welcome(&mut self, peer: PeerId, scene: PeerScene, invite: Invite) {
        let now = self.now();
        if scene != self.scene {
            return self.hang_up(peer, DisconnectReason::SceneMismatch);
        }
        let others: Vec<(UserId, Invite)> =
            self.others.values().filter_map(|other| Some((other.number?, other.invite.clone()?))).collect();
        if self.others.len() > MOST_PEERS {
            return self.hang_up(peer, DisconnectReason::Full);
        }
        let Some(key) = self.others.get(&peer).map(|other| other.key) else { return };
        let present: BTreeSet<UserId> = self.others.values().filter_map(|other| other.number).collect();
        let before = self.numbers.get(&key).copied().filter(|before| !present.contains(before));
        let PeerState::In { user: own } = self.state else { return };
        let taken: BTreeSet<UserId> =
            self.numbers.values().copied().chain(present).chain([own, UserId::HOST]).collect();
        // The number is the first one that no present or remembered peer has. A peer that claims a
        // large number therefore leaves room for all others.
        let Some(number) = before.or_else(|| (1..=u16::MAX).map(UserId).find(|n| !taken.contains(n))) else {
            return self.hang_up(peer, DisconnectReason::Full);
        };
        self.remember(key, number);
        if let Some(other) = self.others.get_mut(&peer) {
            other.number = Some(number);
            other.invite = Some(other.seen_from_here(invite));
        }
        let PeerState::In { user: from } = self.state else { return };
        self.send(peer, &MeshMessage::Welcome { number, from, others });
        self.talk_to(now, peer);
    }

    /// Starts the session on a connection.
    fn talk_to(&mut self, now: Duration, peer: PeerId) {
        let (endpoint, number) = self.way(peer);
        let most = endpoint.max_datagram_size(number).unwrap_or(0);
        if let Some(session) = &mut self.session
            && let Some(user) = self.others.get(&peer).and_then(|other| other.number)
            && let Err(error) = session.connect(now, peer, user, most)
        {
            debug!("peer {peer}: {error}");
            self.hang_up(peer, DisconnectReason::Full);
        }
    }

    fn send(&self, peer: PeerId, message: &MeshMessage) {
        let (endpoint, number) = self.way(peer);
        if let Err(error) = endpoint.send_message(number, message.to_message()) {
            debug!("not sent to peer {peer}: {error}");
            endpoint.close(number, DisconnectReason::Unread);
        }
    }

    /// Disconnects peers that connect without introducing themselves, because each of them would
    /// occupy a place.
    fn hang_up_on_the_silent(&mut self) {
        let Some(session) = &self.session else { return };
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

    fn hang_up(&mut self, peer: PeerId, reason: DisconnectReason) {
        debug!("peer {peer} is sent away: {reason}");
        if let Some(other) = self.others.get_mut(&peer) {
            (other.sent_away, other.waits) = (true, None);
        }
        let (endpoint, number) = self.way(peer);
        endpoint.close(number, reason);
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
                    let (endpoint, number) = self.way(output.peer);
                    // A datagram that is not taken is lost. The next one repeats its content.
                    let _ = endpoint.send_datagram(number, Bytes::from_owner(output.bytes));
                }
                Channel::Message => {
                    self.send(output.peer, &MeshMessage::Session(Bytes::from_owner(output.bytes)));
                }
            }
        }
    }

    fn take_events(&mut self, world: &mut World) {
        let now = self.now();
        while let Some(event) = self.session.as_mut().and_then(|session| session.poll_event()) {
            match event {
                PeerEvent::Started => {
                    if let PeerState::In { user } = self.state {
                        world.write_message(SessionJoined { user, reconnected: false });
                    }
                }
                PeerEvent::Joined { user, name } => {
                    self.found(user);
                    self.users.join(world, user, &name, Role::Hold, false);
                }
                PeerEvent::Left { user, reason } => {
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
                        let (endpoint, number) = self.way(peer);
                        endpoint.close(number, reason);
                        if let Some(other) = self.others.get_mut(&peer) {
                            (other.number, other.invite, other.sent_away) = (None, None, true);
                        }
                    }
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
            let (endpoint, number) = self.way(peer);
            let entity = other.number.and_then(|user| self.users.get(user));
            let (Some(stats), Some(entity)) = (endpoint.stats(number), entity) else { continue };
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
        self.state = PeerState::Closed { reason };
        world.write_message(SessionClosed { reason });
    }
}
