//! The guest's side of a session: tracks the host's bodies and moves the guest's own hands.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{HeldShapes, ModalModel};

use super::budgets::impulse_budget;
use super::download::Download;
use super::guest_body::StreamedBody;
use super::guest_config::{GuestEvent, GuestSessionConfig};
use super::guest_hands::LocalGrab;
use super::guest_rigids::{GuestRigids, StreamedRigid};
use super::{DisconnectReason, LinkStats, MIN_DATAGRAM, Output};
use crate::StreamError;
use crate::clock::ClockEstimate;
use crate::link::{Budget, Events, Link, STOOD_STILL, micros};
use crate::newmark::Newmark;
use crate::state::{BodyId, PeerId, RigidId, UserId, UserInfo, UserLinkInfo};
use crate::wire::{
    Clock, Datagram, GuestMessage, HostMessage, MAX_BODIES, MAX_CACHED, MAX_NAME, PROTOCOL_VERSION,
};

/// Interval of clock requests after the first eight.
const PING_EVERY: Duration = Duration::from_millis(500);
/// Interval of the first clock requests.
const PING_SOON: Duration = Duration::from_millis(100);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum GuestStanding {
    New,
    Greeted,
    In(UserId),
    Closed,
}

/// A guest of a session: a state machine without sockets or clock; see [`super`].
#[derive(Debug)]
pub struct GuestSession {
    pub(super) config: GuestSessionConfig,
    pub(super) link: Link,
    standing: GuestStanding,
    newmark: Newmark,
    pub(super) models: BTreeMap<[u8; 32], Arc<ModalModel>>,
    pub(super) downloads: BTreeMap<[u8; 32], Download>,
    /// Models that the caller is decoding.
    pub(super) being_read: BTreeSet<[u8; 32]>,
    /// Bytes of downloads and downloaded models together, see [`GuestSessionConfig::model_bytes`].
    pub(super) model_bytes: u64,
    /// Hashes of all models that the host has named, at most 16,384 (512 KiB).
    pub(super) announced: BTreeSet<[u8; 32]>,
    pub(super) bodies: BTreeMap<BodyId, StreamedBody>,
    rigids: GuestRigids,
    stalled: BTreeSet<BodyId>,
    users: BTreeMap<UserId, UserInfo>,
    links: BTreeMap<UserId, UserLinkInfo>,
    pub(super) grabs: BTreeMap<u16, LocalGrab>,
    pub(super) next_grab: u16,
    pub(super) input: u32,
    pub(super) impulse_budget: Budget,
    out: VecDeque<Output>,
    events: Events<GuestEvent>,
    clock: ClockEstimate,
    next_ping: Duration,
    pings: u64,
}

impl GuestSession {
    /// Creates a guest whose path carries datagrams of at most `max_datagram` bytes.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a name, datagram size or recovery setting out of range.
    pub fn new(config: GuestSessionConfig, max_datagram: usize) -> Result<Self, StreamError> {
        let fail = |what, found: String, expected| Err(StreamError::Config { what, found, expected });
        config.recovery.check()?;
        if config.name.len() > MAX_NAME {
            return fail("name", config.name, "at most 64 bytes");
        }
        if max_datagram < MIN_DATAGRAM {
            return fail("datagram size", max_datagram.to_string(), "at least 256 bytes");
        }
        Ok(Self {
            link: Link::new(PeerId::HOST, Duration::ZERO, max_datagram),
            standing: GuestStanding::New,
            newmark: Newmark::average(1.0 / 40.0),
            models: BTreeMap::new(),
            downloads: BTreeMap::new(),
            being_read: BTreeSet::new(),
            model_bytes: 0,
            announced: BTreeSet::new(),
            bodies: BTreeMap::new(),
            rigids: GuestRigids::new(1.0 / 40.0, config.recovery.playout),
            stalled: BTreeSet::new(),
            users: BTreeMap::new(),
            links: BTreeMap::new(),
            grabs: BTreeMap::new(),
            next_grab: 0,
            input: 0,
            impulse_budget: impulse_budget(),
            out: VecDeque::new(),
            events: Events::default(),
            clock: ClockEstimate::default(),
            next_ping: Duration::ZERO,
            pings: 0,
            config,
        })
    }

    /// Adds a model that the host need not send. Call this before [`GuestSession::connect`]. Models
    /// beyond 256 are ignored.
    pub fn add_cached_model(&mut self, model: Arc<ModalModel>) {
        if self.models.len() < MAX_CACHED {
            self.models.insert(model.hash().0, model);
        }
    }

    /// Sends the hello message. Call this when the connection is open.
    ///
    /// # Errors
    /// Returns [`StreamError::State`] when the session was connected before.
    pub fn connect(&mut self, now: Duration) -> Result<(), StreamError> {
        if self.standing != GuestStanding::New {
            let (what, state) = ("connect", "not new");
            return Err(StreamError::State { what, state, needed: "a new session" });
        }
        self.standing = GuestStanding::Greeted;
        self.link.received_at(now);
        let hello = GuestMessage::Hello {
            version: PROTOCOL_VERSION,
            name: self.config.name.clone(),
            subscription: self.config.recovery.subscription(self.config.modes),
            cached: self.models.keys().copied().collect(),
        };
        self.message(&hello);
        Ok(())
    }

    /// Sets a new datagram size of the path. Everything that a guest sends fits the smallest size.
    pub fn set_max_datagram(&mut self, bytes: usize) {
        self.link.max_datagram = bytes;
    }

    /// Sends a goodbye message and closes the session.
    pub fn leave(&mut self) {
        if self.standing != GuestStanding::Closed {
            self.message(&GuestMessage::Goodbye { reason: DisconnectReason::Left });
            self.close(DisconnectReason::Left);
        }
    }

    /// The guest's user number, after the host has accepted the guest.
    pub fn user(&self) -> Option<UserId> {
        match self.standing {
            GuestStanding::In(user) => Some(user),
            GuestStanding::New | GuestStanding::Greeted | GuestStanding::Closed => None,
        }
    }

    /// Returns whether the session is over.
    pub fn is_closed(&self) -> bool {
        self.standing == GuestStanding::Closed
    }

    /// Length of the host's step, s; 1/40 before the host's welcome.
    pub fn step(&self) -> f64 {
        self.newmark.h
    }

    /// Returns a body of the session.
    pub fn body(&self, body: BodyId) -> Option<&StreamedBody> {
        self.bodies.get(&body)
    }

    /// Sets the own shapes of the patches that hands hold on a body
    /// ([`StreamedBody::held_places`]). The host need not have them, because coordinates mean the
    /// same with and without them. An unknown body and shapes of another model are ignored.
    pub fn set_held_shapes(&mut self, body: BodyId, shapes: Option<Arc<HeldShapes>>) {
        if let Some(predicted) = self.bodies.get_mut(&body).and_then(|body| body.predicted.as_mut()) {
            predicted.set_held_shapes(shapes);
        }
    }

    /// Iterates over all bodies.
    pub fn bodies(&self) -> impl Iterator<Item = &StreamedBody> {
        self.bodies.values()
    }

    /// Returns a rigid body of the session.
    pub fn rigid(&self, rigid: RigidId) -> Option<&StreamedRigid> {
        self.rigids.get(rigid)
    }

    /// Iterates over all rigid bodies.
    pub fn rigids(&self) -> impl Iterator<Item = &StreamedRigid> {
        self.rigids.iter()
    }

    /// Iterates over the other users in the session, with the user at the host if there is one.
    pub fn users(&self) -> impl Iterator<Item = &UserInfo> {
        self.users.values()
    }

    /// Iterates over the links of the other users in the session, as the host last described them.
    pub fn links(&self) -> impl Iterator<Item = &UserLinkInfo> {
        self.links.values()
    }

    /// Limits how many modes of a body the host sends, for a body that is small or out of view.
    ///
    /// The host rounds the limit up to the next of 1, 2, 3, 4, 6, 8, 12 and so on. With 0 it sends
    /// nothing of the body, and `None`, the default, removes the limit. A message is sent when the
    /// limit changes. Returns false for an unknown body.
    pub fn set_interest(&mut self, body: BodyId, modes: Option<u16>) -> bool {
        let Some(view) = self.bodies.get_mut(&body) else { return false };
        if std::mem::replace(&mut view.interest, modes) != modes {
            self.message(&GuestMessage::Interest { body: body.0, modes });
        }
        true
    }

    /// Metrics of the connection.
    pub fn stats(&self) -> LinkStats {
        self.link.stats()
    }

    /// Host clock minus own clock, s.
    pub fn clock_offset(&self) -> Option<f64> {
        self.clock.offset()
    }

    /// Processes a received datagram. Any bytes are allowed; invalid ones are counted and dropped.
    pub fn on_datagram(&mut self, now: Duration, bytes: &[u8]) {
        if self.user().is_none() {
            return;
        }
        let (sequence, datagram) = match Datagram::decode(bytes) {
            Ok(x) => x,
            Err(_) => {
                self.link.reject();
                return;
            }
        };
        if !self.link.receive_datagram(now, sequence, bytes.len()) {
            return;
        }
        match datagram {
            Datagram::Frame(frame) => {
                let body = frame.body;
                let Some(view) = self.bodies.get_mut(&body) else { return };
                view.take_frame(now, frame);
                self.ask(now, body);
            }
            Datagram::Rigids(poses) => self.rigids.take(now, &poses),
            Datagram::Pong(clock) => {
                self.link.take_report(clock.report);
                // The request has come at t2, or later if the host stood still: then nobody knows.
                let Some(spent) = clock.t3.checked_sub(clock.t2).map(Duration::from_micros) else { return };
                let (t2, waited) =
                    if spent > STOOD_STILL { (clock.t3, spent) } else { (clock.t2, Duration::ZERO) };
                if let Some(rtt) = self.clock.sample(clock.t1, t2, clock.t3, micros(now)) {
                    self.link.sample_round_trip(rtt, waited.saturating_add(self.link.waited(now)));
                }
            }
            _ => self.link.reject(),
        }
    }

    /// Processes a received message. A message that breaks the protocol ends the session.
    pub fn on_message(&mut self, now: Duration, bytes: &[u8]) {
        if self.standing == GuestStanding::Closed {
            return;
        }
        self.link.receive_message(now, bytes.len());
        let Ok(message) = HostMessage::decode(bytes) else {
            self.link.reject();
            return self.break_off(DisconnectReason::Protocol);
        };
        match (message, self.standing) {
            (HostMessage::Welcome { version, user, step_ns, beta, gamma, users }, GuestStanding::Greeted) => {
                if version != PROTOCOL_VERSION {
                    return self.close(DisconnectReason::VersionMismatch);
                }
                self.newmark = Newmark { h: step_ns as f64 * 1e-9, beta, gamma };
                self.rigids = GuestRigids::new(self.newmark.h, self.config.recovery.playout);
                self.standing = GuestStanding::In(UserId(user));
                self.users = users.into_iter().map(|info| (info.user, info)).collect();
                self.next_ping = now;
                self.event(GuestEvent::Welcomed { user: UserId(user) });
            }
            (HostMessage::Goodbye { reason }, _) => self.close(reason),
            (message, GuestStanding::In(_)) => self.in_session(now, message),
            _ => self.break_off(DisconnectReason::Protocol),
        }
    }

    fn in_session(&mut self, now: Duration, message: HostMessage) {
        match message {
            HostMessage::BodyAdded(info) => {
                let body = BodyId(info.body);
                if let Some(view) = self.bodies.get_mut(&body) {
                    // The host changes the step settings of a known body, from the snapshot that
                    // follows.
                    if !view.change(info) {
                        return self.break_off(DisconnectReason::Protocol);
                    }
                    return;
                }
                if self.bodies.len() >= MAX_BODIES {
                    return self.break_off(DisconnectReason::Protocol);
                }
                let name = info.name.clone();
                if self.announced.len() >= 16 * MAX_BODIES {
                    return self.break_off(DisconnectReason::Protocol);
                }
                self.announced.insert(info.hash);
                let model = self.models.get(&info.hash).cloned();
                let mut view =
                    StreamedBody::new(info, self.newmark, self.config.recovery, self.config.predict_hand);
                if let Some(model) = model {
                    view.set_model(model);
                }
                self.bodies.insert(body, view);
                self.event(GuestEvent::BodyAnnounced { body, name });
            }
            HostMessage::BodyRemoved { body } => {
                let body = BodyId(body);
                self.grabs.retain(|_, g| g.body != body);
                if self.bodies.remove(&body).is_some() {
                    self.event(GuestEvent::BodyGone { body });
                }
            }
            HostMessage::ModelChunk { hash, offset, total, bytes } => {
                self.model_chunk(hash, offset, total, &bytes);
            }
            HostMessage::Snapshot(snapshot) => {
                let body = BodyId(snapshot.body);
                let Some(view) = self.bodies.get_mut(&body) else { return };
                let ready = view.take_snapshot(now, snapshot);
                let resynced = std::mem::take(&mut view.resynced);
                let changed = std::mem::take(&mut view.changed);
                if ready && let Some(model) = view.model().cloned() {
                    self.event(GuestEvent::BodyReady { body, model });
                } else if resynced {
                    self.event(GuestEvent::Resynced { body });
                }
                if changed {
                    self.event(GuestEvent::BodyChanged { body });
                }
                self.ask(now, body);
            }
            HostMessage::BodyPlaced { body, placement } => {
                let body = BodyId(body);
                let Some(view) = self.bodies.get_mut(&body) else { return };
                view.placement = Some(placement);
                self.event(GuestEvent::BodyPlaced { body, placement });
            }
            HostMessage::RigidAdded { rigid, name, tick, state } => {
                let rigid = RigidId(rigid);
                if !self.rigids.add(rigid, &name, tick, state) {
                    return self.break_off(DisconnectReason::Protocol);
                }
                self.event(GuestEvent::RigidArrived { rigid, name });
            }
            HostMessage::RigidsRest { tick, rigids } => self.rigids.rest(tick, &rigids),
            HostMessage::RigidRemoved { rigid } => {
                let rigid = RigidId(rigid);
                if self.rigids.remove(rigid) {
                    self.event(GuestEvent::RigidGone { rigid });
                }
            }
            HostMessage::Links(links) => {
                for link in links {
                    if self.users.contains_key(&link.user) {
                        self.links.insert(link.user, link);
                    }
                }
            }
            HostMessage::UserJoined(info) => {
                self.users.insert(info.user, info.clone());
                self.event(GuestEvent::UserJoined(info));
            }
            HostMessage::UserLeft { user, reason } => {
                self.users.remove(&UserId(user));
                self.links.remove(&UserId(user));
                self.event(GuestEvent::UserLeft { user: UserId(user), reason });
            }
            HostMessage::GrabRefused { grab } => {
                if let Some(own) = self.grabs.remove(&grab) {
                    self.forget_own(own.body, grab);
                    self.event(GuestEvent::GrabRefused { grab });
                }
            }
            HostMessage::Welcome { .. } | HostMessage::Goodbye { .. } => {
                self.break_off(DisconnectReason::Protocol)
            }
        }
    }

    /// Steps all bodies to the current time and sends targets, NACKs, snapshot requests and clock
    /// requests that are due.
    ///
    /// Call this once a frame and at [`GuestSession::next_wakeup`]. Returns the number of ticks of
    /// all bodies together.
    pub fn update(&mut self, now: Duration) -> u64 {
        self.link.updated(now);
        let Some(user) = self.user() else {
            let waits = self.standing == GuestStanding::Greeted;
            if waits && self.link.is_silent(now, self.config.idle_timeout) {
                self.close(DisconnectReason::Silent);
            }
            return 0;
        };
        if self.link.is_silent(now, self.config.idle_timeout) {
            self.message(&GuestMessage::Goodbye { reason: DisconnectReason::Silent });
            self.close(DisconnectReason::Silent);
            return 0;
        }
        let round_trip = self.link.round_trip().unwrap_or_default();
        let mut stepped = 0;
        let ids: Vec<BodyId> = self.bodies.keys().copied().collect();
        for id in ids {
            if let Some(view) = self.bodies.get_mut(&id) {
                stepped += view.advance(now, user, round_trip);
                let (stalls, resynced) = (view.is_stalled(), std::mem::take(&mut view.resynced));
                if !stalls {
                    self.stalled.remove(&id);
                } else if self.stalled.insert(id) {
                    self.event(GuestEvent::Stalled { body: id });
                }
                if resynced {
                    self.event(GuestEvent::Resynced { body: id });
                }
            }
            self.ask(now, id);
        }
        self.rigids.advance(now);
        self.send_targets(now);
        if now >= self.next_ping {
            self.pings += 1;
            self.next_ping = now + if self.pings < 8 { PING_SOON } else { PING_EVERY };
            let clock = Clock { t1: micros(now), ..self.link.clock() };
            self.datagram(&Datagram::Ping(clock));
        }
        stepped
    }

    /// Latest time at which to call [`GuestSession::update`] if nothing happens before: the next
    /// tick of a body, a NACK to repeat, a target to send, a clock request or the idle timeout.
    pub fn next_wakeup(&self, now: Duration) -> Option<Duration> {
        if matches!(self.standing, GuestStanding::New | GuestStanding::Closed) {
            return None;
        }
        let mut next = self.link.silent_at(self.config.idle_timeout);
        if self.user().is_some() {
            next = next.min(self.next_ping);
            for view in self.bodies.values() {
                next = view.next_tick_due(now).map_or(next, |t| next.min(t));
                next = view.next_request().map_or(next, |t| next.min(t));
            }
            for g in self.grabs.values() {
                next = g.due(now).map_or(next, |due| next.min(due));
            }
        }
        Some(next.max(now))
    }

    /// Returns the next datagram or message to send.
    ///
    /// Nothing is dropped here. Each [`GuestSession::update`] adds at most one NACK and one
    /// snapshot request per body, one datagram of targets and one clock request. Each message of
    /// the host adds at most one answer.
    pub fn poll_output(&mut self) -> Option<Output> {
        self.out.pop_front()
    }

    /// Returns the next event.
    pub fn poll_event(&mut self) -> Option<GuestEvent> {
        self.events.pop()
    }

    fn ask(&mut self, now: Duration, body: BodyId) {
        let round_trip = self.link.round_trip().unwrap_or(Duration::from_millis(200));
        let Some(view) = self.bodies.get_mut(&body) else { return };
        let nack = view.missing(now, round_trip);
        let snapshot = view.request_snapshot(now);
        if let Some(nack) = nack {
            self.link.stats.nacks += 1;
            self.datagram(&Datagram::Nack(nack));
        }
        if snapshot {
            self.message(&GuestMessage::SnapshotRequest { body: body.0 });
        }
    }

    pub(super) fn datagram(&mut self, datagram: &Datagram) {
        self.link.send_datagram(|sequence| datagram.encode(sequence), &mut self.out);
    }

    pub(super) fn message(&mut self, message: &GuestMessage) {
        self.link.send_message(message.encode(), &mut self.out);
    }

    pub(super) fn event(&mut self, event: GuestEvent) {
        self.events.push(event);
    }

    pub(super) fn break_off(&mut self, reason: DisconnectReason) {
        self.message(&GuestMessage::Goodbye { reason });
        self.close(reason);
    }

    fn close(&mut self, reason: DisconnectReason) {
        if self.standing != GuestStanding::Closed {
            self.standing = GuestStanding::Closed;
            self.grabs.clear();
            self.downloads.clear();
            self.event(GuestEvent::Closed { reason });
        }
    }
}
