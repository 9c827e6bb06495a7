//! Guests on the host: joining, recognition by key, subscriptions and leaving.

use std::collections::BTreeSet;

use bevy::prelude::*;
use pliant_stream::{DisconnectReason, GrabKey, HostEvent, PeerId, UserId};

use super::NetHost;
use super::hands::GuestGrab;
use crate::transport::{Event, Fingerprint, Role};

/// A guest's connection.
#[derive(Debug)]
pub(super) struct Guest {
    pub(super) key: Fingerprint,
    pub(super) role: Role,
    /// The user's entity, once the guest is in the session.
    pub(super) entity: Option<Entity>,
}

/// Processes the data from the guests.
pub(crate) fn receive(world: &mut World) {
    world.try_resource_scope(|world, mut host: Mut<NetHost>| {
        let host = &mut *host;
        host.carrier.begin_frame();
        while let Some(event) = host.carrier.poll_in_frame() {
            let now = host.now();
            match event {
                Event::Connected { peer, address, fingerprint, role } => {
                    debug!("guest {peer} from {address:?} with key {fingerprint}");
                    host.guests.insert(peer, Guest { key: fingerprint, role, entity: None });
                    let most = host.carrier.max_datagram_size(peer).unwrap_or(0);
                    if let Err(error) = host.session.connect(now, peer, most) {
                        debug!("guest {peer}: {error}");
                        host.carrier.close(peer, DisconnectReason::Full);
                    }
                }
                Event::Datagram { peer, at, bytes } => {
                    let at = at.saturating_duration_since(host.began);
                    host.session.on_datagram(at, peer, &bytes);
                }
                Event::Message { peer, bytes } => {
                    host.session.on_message(now, peer, &bytes);
                    host.carrier.charge(host.session.take_work());
                }
                Event::Closed { peer, reason } => {
                    debug!("guest {peer} is gone: {reason}");
                    host.session.disconnect(peer, reason);
                    host.take_events(world);
                    host.guests.remove(&peer);
                }
            }
            // Events are processed at once. The session keeps a limited number of them and drops
            // the oldest, and one guest's flood must not drop another guest's goodbye.
            host.take_events(world);
        }
        for peer in host.carrier.peers() {
            if let Some(most) = host.carrier.max_datagram_size(peer) {
                host.session.set_max_datagram(peer, most);
            }
        }
        host.take_events(world);
    });
}

impl NetHost {
    pub(super) fn take_events(&mut self, world: &mut World) {
        while let Some(event) = self.session.poll_event() {
            self.apply(world, event);
        }
    }

    /// Admits a guest that has sent a join request and whose key and token the transport has
    /// checked. The guest gets the number that it had before.
    fn let_in(&mut self, world: &mut World, peer: PeerId) {
        let now = self.now();
        let Some((key, role)) = self.guests.get(&peer).map(|guest| (guest.key, guest.role)) else { return };
        // One key is one user. A new connection replaces an older one whose loss has not been
        // noticed yet.
        let older: Vec<PeerId> = self
            .guests
            .iter()
            .filter(|(other, guest)| **other != peer && guest.key == key && guest.entity.is_some())
            .map(|(&other, _)| other)
            .collect();
        for other in older {
            debug!("guest {other} has come anew as {peer}");
            self.session.kick(other, DisconnectReason::Replaced);
        }
        let present: BTreeSet<UserId> = self.session.users().map(|(_, user, _)| user).collect();
        let before = self.known.number_of(&key).or_else(|| self.known.free_number(&present));
        if let Err(error) = self.session.accept_as(now, peer, before, role) {
            debug!("guest {peer} was not let in: {error}");
            self.session.kick(peer, DisconnectReason::Refused);
        }
        // The older connection's leave must come before the new one's join.
        self.take_events(world);
    }

    fn joined(&mut self, world: &mut World, peer: PeerId, id: UserId, name: &str) {
        let Some(guest) = self.guests.get_mut(&peer) else { return };
        let key = guest.key;
        let back = self.known.number_of(&key) == Some(id);
        guest.entity = Some(self.users.join(world, id, name, guest.role, back));
        self.seen(key, id);
    }

    /// Keeps that a user has come or gone.
    fn seen(&mut self, key: Fingerprint, user: UserId) {
        let present: BTreeSet<Fingerprint> =
            self.guests.values().filter(|guest| guest.entity.is_some()).map(|guest| guest.key).collect();
        self.known.see(key, user, |key| present.contains(key));
    }

    fn apply(&mut self, world: &mut World, event: HostEvent) {
        match event {
            HostEvent::JoinRequest { peer, .. } => self.let_in(world, peer),
            HostEvent::Joined { peer, user, name, .. } => self.joined(world, peer, user, &name),
            HostEvent::Left { peer, user, reason } => {
                // The session's goodbye is more precise than the end of the connection, so it is
                // sent first.
                self.flush();
                self.carrier.close(peer, reason);
                let guest = self.guests.get_mut(&peer);
                let inside = guest.and_then(|guest| guest.entity.take().map(|_| guest.key));
                if let Some((id, key)) = user.zip(inside) {
                    self.users.leave(world, id, reason);
                    self.seen(key, id);
                }
            }
            HostEvent::GrabBegan { key, body, vertex, radius, target, hold } => {
                if let Err(why) = self.begin_grab(world, key, body, vertex, radius, target, hold) {
                    debug!("grab {} of user {} is refused: {why}", key.grab, key.user.0);
                    self.session.refuse_grab(key);
                }
            }
            HostEvent::GrabMoved { key, body, input, target } => {
                let Some(target) = self.target_in_world(world, body, target) else { return };
                let hands = self.grabs.range(hands_of(key.user)).count();
                let grab = self.grabs.get(&key).and_then(|&entity| world.get_mut::<GuestGrab>(entity));
                if let Some(mut grab) = grab {
                    grab.hand.take(input, hands, target.to_array().into());
                }
            }
            HostEvent::Impulse { user, body, vertex, impulse } => {
                if let Err(why) = self.take_impulse(world, user, body, vertex, impulse) {
                    debug!("an impulse of user {} is ignored: {why}", user.0);
                }
            }
            HostEvent::GrabEnded { key, .. } => {
                if let Some(entity) = self.grabs.remove(&key) {
                    // The entity may have been despawned with its body or its user.
                    world.try_despawn(entity).ok();
                }
            }
            _ => {}
        }
    }
}

/// Returns the range of all grabs of a user.
fn hands_of(user: UserId) -> std::ops::RangeInclusive<GrabKey> {
    GrabKey { user, grab: 0 }..=GrabKey { user, grab: u16::MAX }
}
