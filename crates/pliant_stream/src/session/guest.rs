//! A guest's side: it follows the host and moves its own hands.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use pliant_modal::ModalModel;

use super::download::Download;
use super::guest_body::BodyView;
use super::guest_config::{GuestConfig, GuestEvent};
use super::guest_hands::OwnGrab;
use super::{DisconnectReason, LinkStats, MIN_DATAGRAM, Output};
use crate::StreamError;
use crate::clock::ClockEstimate;
use crate::link::{Events, Link, micros};
use crate::newmark::Newmark;
use crate::state::{BodyId, PeerId, UserId};
use crate::wire::{
    Clock, Datagram, GuestMessage, HostMessage, MAX_BODIES, MAX_CACHED, MAX_NAME, PROTOCOL_VERSION,
};

/// Clock requests come this far apart once the first eight have been answered.
const PING_EVERY: Duration = Duration::from_millis(500);
/// The first clock requests.
const PING_SOON: Duration = Duration::from_millis(100);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Standing {
    New,
    Greeted,
    In(UserId),
    Closed,
}

/// A guest of a session: a state machine without sockets or clock; see [`super`].
#[derive(Debug)]
pub struct GuestSession {
    pub(super) config: GuestConfig,
    pub(super) link: Link,
    standing: Standing,
    newmark: Newmark,
    pub(super) models: BTreeMap<[u8; 32], Arc<ModalModel>>,
    pub(super) downloads: BTreeMap<[u8; 32], Download>,
    /// Models that the caller reads.
    pub(super) being_read: BTreeSet<[u8; 32]>,
    /// Bytes that downloads and downloaded models take together, see [`GuestConfig::model_bytes`].
    pub(super) model_bytes: u64,
    /// Hashes of all models that the host has named, at most 16,384 (512 KiB).
    pub(super) announced: BTreeSet<[u8; 32]>,
    pub(super) bodies: BTreeMap<BodyId, BodyView>,
    stalled: BTreeSet<BodyId>,
    users: BTreeMap<UserId, String>,
    pub(super) grabs: BTreeMap<u16, OwnGrab>,
    pub(super) next_grab: u16,
    pub(super) input: u32,
    out: VecDeque<Output>,
    events: Events<GuestEvent>,
    clock: ClockEstimate,
    next_ping: Duration,
    pings: u64,
}

impl GuestSession {
    /// A guest whose path carries datagrams of so many bytes.
    ///
    /// # Errors
    /// [`StreamError::Config`] for a name, path or repair out of range.
    pub fn new(config: GuestConfig, max_datagram: usize) -> Result<Self, StreamError> {
        let fail = |what, found: String, expected| Err(StreamError::Config { what, found, expected });
        config.recovery.check()?;
        if config.name.len() > MAX_NAME {
            return fail("name", config.name, "at most 64 bytes");
        }
        if max_datagram < MIN_DATAGRAM {
            return fail("datagram size", max_datagram.to_string(), "at least 256 bytes");
        }
        Ok(Self {
            config,
            link: Link::new(PeerId::HOST, Duration::ZERO, max_datagram),
            standing: Standing::New,
            newmark: Newmark::average(1.0 / 40.0),
            models: BTreeMap::new(),
            downloads: BTreeMap::new(),
            being_read: BTreeSet::new(),
            model_bytes: 0,
            announced: BTreeSet::new(),
            bodies: BTreeMap::new(),
            stalled: BTreeSet::new(),
            users: BTreeMap::new(),
            grabs: BTreeMap::new(),
            next_grab: 0,
            input: 0,
            out: VecDeque::new(),
            events: Events::default(),
            clock: ClockEstimate::default(),
            next_ping: Duration::ZERO,
            pings: 0,
        })
    }

    /// Names a model that need not be sent. Before [`GuestSession::connect`]; at most 256.
    pub fn add_cached_model(&mut self, model: Arc<ModalModel>) {
        if self.models.len() < MAX_CACHED {
            self.models.insert(model.hash().0, model);
        }
    }

    /// The connection is open: says hello.
    ///
    /// # Errors
    /// [`StreamError::State`] when hello was said before.
    pub fn connect(&mut self, now: Duration) -> Result<(), StreamError> {
        if self.standing != Standing::New {
            let (what, state) = ("connect", "not new");
            return Err(StreamError::State { what, state, needed: "a new session" });
        }
        self.standing = Standing::Greeted;
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

    /// The path's datagrams have another size now. (Everything a guest sends fits the smallest.)
    pub fn set_max_datagram(&mut self, bytes: usize) {
        self.link.max_datagram = bytes;
    }

    /// Says goodbye. The session is closed.
    pub fn leave(&mut self) {
        if self.standing != Standing::Closed {
            self.message(&GuestMessage::Goodbye { reason: DisconnectReason::Left });
            self.close(DisconnectReason::Left);
        }
    }

    /// Our number, once the host has let us in.
    pub fn user(&self) -> Option<UserId> {
        match self.standing {
            Standing::In(user) => Some(user),
            Standing::New | Standing::Greeted | Standing::Closed => None,
        }
    }

    /// True after the end.
    pub fn is_closed(&self) -> bool {
        self.standing == Standing::Closed
    }

    /// The host's step, s; 1/40 before the host has said.
    pub fn step(&self) -> f64 {
        self.newmark.h
    }

    /// A body.
    pub fn body(&self, body: BodyId) -> Option<&BodyView> {
        self.bodies.get(&body)
    }

    /// All bodies.
    pub fn bodies(&self) -> impl Iterator<Item = &BodyView> {
        self.bodies.values()
    }

    /// The others in the session.
    pub fn users(&self) -> impl Iterator<Item = (UserId, &str)> {
        self.users.iter().map(|(u, n)| (*u, n.as_str()))
    }

    /// How the path does.
    pub fn stats(&self) -> LinkStats {
        self.link.stats()
    }

    /// Host clock minus own clock, s.
    pub fn clock_offset(&self) -> Option<f64> {
        self.clock.offset()
    }

    /// Something arrived unreliably. Any bytes will do: what makes no sense is counted and forgotten.
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
            Datagram::Pong(clock) => {
                self.link.take_report(clock.report);
                if let Some(rtt) = self.clock.sample(clock.t1, clock.t2, clock.t3, micros(now)) {
                    self.link.sample_round_trip(rtt);
                }
            }
            Datagram::Targets(_) | Datagram::Nack(_) | Datagram::Ping(_) => self.link.reject(),
        }
    }

    /// Something arrived reliably. A message that breaks the protocol ends the session.
    pub fn on_message(&mut self, now: Duration, bytes: &[u8]) {
        if self.standing == Standing::Closed {
            return;
        }
        self.link.receive_message(now, bytes.len());
        let Ok(message) = HostMessage::decode(bytes) else {
            self.link.reject();
            return self.break_off(DisconnectReason::Protocol);
        };
        match (message, self.standing) {
            (HostMessage::Welcome { version, user, step_ns, beta, gamma, users }, Standing::Greeted) => {
                if version != PROTOCOL_VERSION {
                    return self.close(DisconnectReason::Version);
                }
                self.newmark = Newmark { h: step_ns as f64 * 1e-9, beta, gamma };
                self.standing = Standing::In(UserId(user));
                self.users = users.into_iter().map(|(u, n)| (UserId(u), n)).collect();
                self.next_ping = now;
                self.event(GuestEvent::Welcomed { user: UserId(user) });
            }
            (HostMessage::Goodbye { reason }, _) => self.close(reason),
            (message, Standing::In(_)) => self.in_session(now, message),
            _ => self.break_off(DisconnectReason::Protocol),
        }
    }

    fn in_session(&mut self, now: Duration, message: HostMessage) {
        match message {
            HostMessage::BodyAdded(info) => {
                let body = BodyId(info.body);
                if let Some(view) = self.bodies.get_mut(&body) {
                    // The same body, stepped otherwise from the snapshot on that follows.
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
                    BodyView::new(info, self.newmark, self.config.recovery, self.config.predict_own_hand);
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
            HostMessage::UserJoined { user, name } => {
                self.users.insert(UserId(user), name.clone());
                self.event(GuestEvent::UserJoined { user: UserId(user), name });
            }
            HostMessage::UserLeft { user } => {
                self.users.remove(&UserId(user));
                self.event(GuestEvent::UserLeft { user: UserId(user) });
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

    /// Steps all bodies to what is due by now, and sends what is due: targets, questions, clock requests. Call once a
    /// frame and at [`GuestSession::next_wakeup`]. Returns how many ticks all bodies took together.
    pub fn update(&mut self, now: Duration) -> u64 {
        let Some(user) = self.user() else {
            let waits = self.standing == Standing::Greeted;
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
                if view.is_stalled() {
                    if self.stalled.insert(id) {
                        self.event(GuestEvent::Stalled { body: id });
                    }
                } else {
                    self.stalled.remove(&id);
                }
            }
            self.ask(now, id);
        }
        self.say_targets(now);
        if now >= self.next_ping {
            self.pings += 1;
            self.next_ping = now + if self.pings < 8 { PING_SOON } else { PING_EVERY };
            let clock = Clock { t1: micros(now), ..self.link.clock() };
            self.datagram(&Datagram::Ping(clock));
        }
        stepped
    }

    /// When to call [`GuestSession::update`] at the latest, if nothing happens before: the next tick of a body, a
    /// question to repeat, a clock request, the idle timeout.
    pub fn next_wakeup(&self, now: Duration) -> Option<Duration> {
        if matches!(self.standing, Standing::New | Standing::Closed) {
            return None;
        }
        let mut next = self.link.silent_at(self.config.idle_timeout);
        if self.user().is_some() {
            next = next.min(self.next_ping);
            for view in self.bodies.values() {
                next = view.next_tick_due(now).map_or(next, |t| next.min(t));
                next = view.next_ask().map_or(next, |t| next.min(t));
            }
            for g in self.grabs.values() {
                next = g.due(now).map_or(next, |due| next.min(due));
            }
        }
        Some(next.max(now))
    }

    /// The next thing to send. Nothing is dropped here; each [`GuestSession::update`] adds one question a body, one
    /// datagram of targets and one clock request at most, each message of the host at most one answer.
    pub fn poll_output(&mut self) -> Option<Output> {
        self.out.pop_front()
    }

    /// The next thing that happened.
    pub fn poll_event(&mut self) -> Option<GuestEvent> {
        self.events.pop()
    }

    fn ask(&mut self, now: Duration, body: BodyId) {
        let round_trip = self.link.round_trip().unwrap_or(Duration::from_millis(200));
        let Some(view) = self.bodies.get_mut(&body) else { return };
        let nack = view.missing(now, round_trip);
        let snapshot = view.ask_snapshot(now);
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
        if self.standing != Standing::Closed {
            self.standing = Standing::Closed;
            self.grabs.clear();
            self.downloads.clear();
            self.event(GuestEvent::Closed { reason });
        }
    }
}
