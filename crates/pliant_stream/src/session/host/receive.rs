//! What a host does with the datagrams and messages of its guests.

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::ModalModel;

use super::HostSession;
use crate::session::guest_hands::TARGET_REPEATS;
use crate::session::host_config::HostEvent;
use crate::session::host_peer::{AnnouncedGrab, MAX_GUEST_GRABS, Standing};
use crate::session::{DisconnectReason, MIN_DATAGRAM};
use crate::state::{BodyId, GrabKey, PeerId, Role, capped_impulse};
use crate::wire::{Datagram, GuestMessage, HostMessage, PROTOCOL_VERSION};

impl HostSession {
    /// Processes a received datagram. Any bytes are allowed; invalid ones are counted and dropped.
    pub fn on_datagram(&mut self, now: Duration, peer: PeerId, bytes: &[u8]) {
        let Some(p) = self.peers.get_mut(&peer) else { return };
        let Ok((sequence, datagram)) = Datagram::decode(bytes) else {
            p.link.reject();
            return;
        };
        // Datagrams do not count before the guest has been accepted.
        let Some(user) = p.user() else {
            p.link.reject();
            return;
        };
        if !p.link.receive_datagram(now, sequence, bytes.len()) {
            return;
        }
        match datagram {
            Datagram::Targets(targets) => {
                let mut moved = Vec::new();
                let mut entries = targets.entries;
                entries.sort_by_key(|e| (e.grab, e.input));
                for (k, e) in entries.iter().enumerate() {
                    // A guest sends the last few targets of a grab. More of them are out of date.
                    if entries.get(k + TARGET_REPEATS).is_some_and(|later| later.grab == e.grab) {
                        continue;
                    }
                    let Some(held) = p.grabs.get_mut(&e.grab) else { continue };
                    // The input is newer when it is ahead by less than half the range, since the
                    // counter may wrap.
                    let newer = held.input.is_none_or(|last| (e.input.wrapping_sub(last) as i32) > 0);
                    if newer && p.budgets.targets.spend(now, 1.0) {
                        held.input = Some(e.input);
                        let key = GrabKey { user, grab: e.grab };
                        moved.push(HostEvent::GrabMoved {
                            key,
                            body: held.body,
                            input: e.input,
                            target: e.target,
                        });
                    }
                }
                moved.into_iter().for_each(|e| self.event(e));
            }
            Datagram::Nack(nack) => {
                p.link.stats.nacks += 1;
                let streams = p.streaming.contains(&nack.body);
                let runs = nack.runs.iter().filter(|_| streams);
                for tick in runs.flat_map(|r| r.first..r.first + u64::from(r.count)) {
                    if !p.budgets.repeats.spend(now, 1.0) {
                        break;
                    }
                    // A tick that is already queued needs no second answer.
                    if !p.resends.iter().any(|r| r.1 == nack.body && r.2 == tick) {
                        p.queue_resend(now + self.config.resend_after, nack.body, tick);
                    }
                }
                self.resend_due(now, peer);
            }
            Datagram::Ping(clock) => {
                p.link.take_report(clock.report);
                // Zero means that the guest has measured none since its last request.
                if clock.round_trip > 0 {
                    let sample = Duration::from_micros(u64::from(clock.round_trip));
                    p.link.sample_round_trip(sample, Duration::ZERO);
                }
                p.take_ping(now, clock.t1);
            }
            _ => p.link.reject(),
        }
    }

    /// Returns the work that messages have made for the app since the last call, in vertices within
    /// the radii of new patches. An app that has a frame's worth of it processes further messages
    /// in the next one.
    pub fn take_work(&mut self) -> usize {
        std::mem::take(&mut self.work)
    }

    /// Processes a received message. A message that breaks the protocol ends the guest's session.
    pub fn on_message(&mut self, now: Duration, peer: PeerId, bytes: &[u8]) {
        let Some(p) = self.peers.get_mut(&peer) else { return };
        p.link.receive_message(now, bytes.len());
        let message = match GuestMessage::decode(bytes) {
            // A guest may change its interest in every body at once, so these messages have a
            // budget of their own. Beyond it they have no effect.
            Ok(GuestMessage::Interest { body, modes }) if p.user().is_some() => {
                if p.budgets.interests.spend(now, 1.0) {
                    self.set_interest(peer, BodyId(body), modes);
                }
                return;
            }
            // A game may strike many bodies in a frame, which is no breach of the protocol either.
            Ok(GuestMessage::Impulse { body, vertex, impulse }) if p.user().is_some() => {
                let body = BodyId(body);
                let model = self.bodies.get(&body).map(|b| &b.model);
                let fits = p.role == Role::Hold && p.pays_for_impulse(&mut self.shared, now);
                let on = |model: &&Arc<ModalModel>| (vertex as usize) < model.surface().positions().len();
                if let (Some(user), Some(model), true) = (p.user(), model.filter(on), fits) {
                    let impulse = capped_impulse(model, impulse);
                    self.event(HostEvent::Impulse { user, body, vertex, impulse });
                }
                return;
            }
            Ok(m) if p.budgets.messages.spend(now, 1.0) => m,
            _ => {
                p.link.reject();
                return self.drop_peer(peer, DisconnectReason::Protocol, true);
            }
        };
        match (message, p.user()) {
            (GuestMessage::Hello { version, name, subscription, cached }, None)
                if p.standing == Standing::Silent =>
            {
                if version != PROTOCOL_VERSION {
                    return self.drop_peer(peer, DisconnectReason::VersionMismatch, true);
                }
                if p.link.max_datagram < MIN_DATAGRAM {
                    return self.drop_peer(peer, DisconnectReason::SmallDatagrams, true);
                }
                p.name = name;
                p.subscription = Some(subscription);
                p.cached = cached.into_iter().collect();
                p.standing = Standing::Asking;
                if self.config.open {
                    self.admit(now, peer, None, Role::Hold);
                } else {
                    let name = p.name.clone();
                    self.event(HostEvent::JoinRequest { peer, name });
                }
            }
            (GuestMessage::Goodbye { reason }, _) => self.drop_peer(peer, reason, false),
            (GuestMessage::GrabBegin { grab, body, vertex, radius, target, hold }, Some(user)) => {
                let body = BodyId(body);
                // The budget limits new patches, since each costs every encoder of the body a
                // table.
                let model = self.bodies.get(&body).map(|b| &b.model);
                let may =
                    p.role == Role::Hold && p.grabs.len() < MAX_GUEST_GRABS && !p.grabs.contains_key(&grab);
                let on = |model: &&Arc<ModalModel>| (vertex as usize) < model.surface().positions().len();
                let model = model.filter(|model| may && on(model));
                let paid = model.and_then(|m| p.pays_for_patch(&mut self.shared, now, m, vertex, radius));
                if let Some(entries) = paid {
                    self.work += entries;
                    p.grabs.insert(grab, AnnouncedGrab { body, input: None });
                    let key = GrabKey { user, grab };
                    self.event(HostEvent::GrabBegan { key, body, vertex, radius, target, hold });
                } else {
                    p.send_message(&HostMessage::GrabRefused { grab }, &mut self.out);
                }
            }
            (GuestMessage::GrabEnd { grab }, Some(user)) => {
                if let Some(held) = p.grabs.remove(&grab) {
                    self.event(HostEvent::GrabEnded { key: GrabKey { user, grab }, body: held.body });
                }
            }
            (GuestMessage::SnapshotRequest { body }, Some(_)) => {
                let body = BodyId(body);
                if p.streaming.contains(&body) && p.budgets.snapshots.spend(now, 1.0) {
                    self.send_snapshot(peer, body);
                }
            }
            _ => {
                p.link.reject();
                self.drop_peer(peer, DisconnectReason::Protocol, true);
            }
        }
    }
}
