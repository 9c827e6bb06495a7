//! The session of one peer with all other peers.

mod grabs;
mod introductions;
mod joining;
mod pacing;
mod repair;
mod shapes;
mod states;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{ModalModel, StepSettings};

use introductions::Introductions;
use pacing::BEHIND;
use repair::affords;

use super::body::PeerBody;
use super::config::{PeerEvent, PeerSessionConfig};
use super::inputs::{InputLog, WINDOW};
use super::other::{Hello, PeerBudgets, RemotePeer, late_of_all};
use crate::link::{AwayBudgets, Budget, Events, SharedBudgets};
use crate::session::{DisconnectReason, LinkStats, MIN_DATAGRAM, Output};
use crate::state::{BodyId, PeerId, Tick, UserId};
use crate::wire::{
    Datagram, HeldAt, ImpulseAt, InputTick, Inputs, MAX_ADDRESS, MAX_BODIES, MAX_NAME, MAX_PEERS, MAX_TICKS,
    PROTOCOL_VERSION, PeerMessage, StateCheck,
};
use crate::{StreamError, Surroundings};

/// Largest number of outputs that wait to be fetched before new datagrams are dropped, as a path
/// would drop them.
const MAX_OUT: usize = 16_384;
/// Largest number of coordinates of all bodies. A state of them, which a peer collects from each
/// other one, then has 21 MB, besides hands and contacts.
const MAX_COORDINATES: usize = 1 << 19;
/// Number of ticks between checks.
const CHECK_EVERY: u64 = 16;
/// Tolerance of checks as a share of the state's magnitude. Machines of different peers round
/// differently.
const CHECK_TOLERANCE: f64 = 1e-3;
/// Largest number of missed ticks that a peer catches up on at once.
const MAX_MISSED: u64 = 1024;
/// Largest number of steps in an update.
const STEPS: u64 = 8;

/// One of several equal peers: a state machine without sockets or clock.
#[derive(Debug)]
pub struct PeerSession {
    config: PeerSessionConfig,
    others: BTreeMap<PeerId, RemotePeer>,
    /// The addresses at which peers reach this one, if not the address of the settings.
    addresses: BTreeMap<PeerId, String>,
    /// Budgets of the users that are away.
    away: AwayBudgets<PeerBudgets>,
    shared: SharedBudgets,
    /// The time of the last update.
    updated: Duration,
    introductions: Introductions,
    bodies: BTreeMap<BodyId, PeerBody>,
    inputs: InputLog,
    own: BTreeMap<u16, HeldAt>,
    /// Own impulses that the next step applies.
    impulses: Vec<ImpulseAt>,
    next_grab: u16,
    tick: Tick,
    started: bool,
    next_step: Option<Duration>,
    /// This peer was behind most others and steps until it is not.
    catches_up: bool,
    /// Ticks that a stall has cost, or a jump of the own clock. The others may hurry this peer by
    /// no more than these.
    missed: u64,
    /// Ticks that this peer has lately caught up to the others. If they turn out to be behind, it
    /// waits as many.
    caught_up: u64,
    /// The body that steps past ticks again first.
    turn: BodyId,
    /// The tick of the last state taken. Rollback never goes to an earlier tick.
    taken: Tick,
    out: VecDeque<Output>,
    events: Events<PeerEvent>,
    requested: Option<Duration>,
    last_check: Option<StateCheck>,
    /// What making shapes of held patches may cost.
    making: Budget,
    /// Counts of the connections that have ended.
    gone: LinkStats,
}

impl PeerSession {
    /// Creates a peer without connections.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a setting out of range, and for a founding peer without
    /// a number.
    pub fn new(config: PeerSessionConfig) -> Result<Self, StreamError> {
        let fail = |what, found: String, expected| Err(StreamError::Config { what, found, expected });
        if config.user == UserId::HOST && config.founds {
            return fail("user", "0".into(), "1 or more");
        }
        if !(1e-5..=1.0).contains(&config.step) {
            return fail("step", config.step.to_string(), "1e-5 to 1 s");
        }
        if config.name.len() > MAX_NAME {
            return fail("name", config.name, "at most 64 bytes");
        }
        if config.address.len() > MAX_ADDRESS {
            return fail("address", config.address, "at most 512 bytes");
        }
        if config.repeats >= MAX_TICKS {
            return fail("repeats", config.repeats.to_string(), "at most 15");
        }
        let started = config.founds;
        let mut inputs = InputLog::default();
        if config.user != UserId::HOST {
            inputs.expect(config.user, 1);
        }
        Ok(Self {
            shared: SharedBudgets::of_all(late_of_all(config.step)),
            config,
            others: BTreeMap::new(),
            addresses: BTreeMap::new(),
            away: AwayBudgets::default(),
            updated: Duration::ZERO,
            introductions: Introductions::default(),
            bodies: BTreeMap::new(),
            inputs,
            own: BTreeMap::new(),
            impulses: Vec::new(),
            next_grab: 0,
            tick: 0,
            started,
            next_step: None,
            catches_up: false,
            missed: 0,
            caught_up: 0,
            turn: BodyId(0),
            taken: 0,
            out: VecDeque::new(),
            events: Events::default(),
            requested: None,
            last_check: None,
            making: shapes::making(),
            gone: LinkStats::default(),
        })
    }

    /// Adds a body. All peers add the same bodies under the same numbers before they start.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a number in use, [`StreamError::Full`] beyond 1,024
    /// bodies or 524,288 coordinates of all bodies, and [`StreamError::Model`] for a model or
    /// settings that cannot be stepped.
    pub fn add_body(
        &mut self,
        id: BodyId,
        model: Arc<ModalModel>,
        settings: &StepSettings,
    ) -> Result<(), StreamError> {
        if self.bodies.contains_key(&id) {
            let found = id.to_string();
            return Err(StreamError::Config { what: "body", found, expected: "a number that is not in use" });
        }
        if self.bodies.len() >= MAX_BODIES {
            return Err(StreamError::Full { what: "bodies", limit: MAX_BODIES });
        }
        let before: usize = self.bodies.values().map(|body| body.model().mode_count()).sum();
        if before + model.mode_count() > MAX_COORDINATES {
            return Err(StreamError::Full { what: "coordinates of all bodies", limit: MAX_COORDINATES });
        }
        let c = &self.config;
        let body = PeerBody::new(id, model, settings, c.step, c.repair, c.blend_ticks)?;
        self.bodies.insert(id, body);
        Ok(())
    }

    /// Lets a free body touch what stands still around it. All peers set the same before they
    /// connect.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownBody`] for an unknown body, and the errors of
    /// [`Surroundings::check`]. The old surroundings then stay.
    pub fn set_surroundings(&mut self, id: BodyId, around: Surroundings) -> Result<(), StreamError> {
        self.bodies.get_mut(&id).ok_or(StreamError::UnknownBody(id))?.set_surroundings(around)
    }

    /// Sets whether a body is stepped with the own shapes of its held patches
    /// ([`PeerSession::shapes_to_make`]). All peers set the same before they connect. Default:
    /// true. Only bodies with reduced elasticity have such shapes.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownBody`] for an unknown body.
    pub fn set_held_shapes(&mut self, id: BodyId, wants: bool) -> Result<(), StreamError> {
        self.bodies.get_mut(&id).ok_or(StreamError::UnknownBody(id))?.wants_shapes = wants;
        Ok(())
    }

    /// Digest of the bodies, their models, step settings and surroundings, whether they are stepped
    /// with own shapes of held patches, and the step length.
    pub fn scene(&self) -> u64 {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&self.config.step.to_bits().to_le_bytes());
        for (id, body) in &self.bodies {
            hasher.update(&id.0.to_le_bytes());
            hasher.update(&body.model().hash().0);
            hasher.update(&body.settings().to_bytes());
            hasher.update(&body.surroundings().to_bytes());
            hasher.update(&[u8::from(body.takes_shapes())]);
        }
        let mut first = [0; 8];
        first.copy_from_slice(&hasher.finalize().as_bytes()[..8]);
        u64::from_le_bytes(first)
    }

    /// Metrics of a connection; `None` for an unknown connection.
    ///
    /// They are the traffic in both directions, the share of datagrams lost on the path to this
    /// peer, the jitter of that path (`jitter`), the requests for inputs (`nacks`) and the rejected
    /// datagrams. Only the transport knows the round trip and the loss on the path to the other
    /// peer.
    pub fn stats(&self, peer: PeerId) -> Option<LinkStats> {
        self.others.get(&peer).map(|other| other.link.stats())
    }

    /// Counts of all connections, including those that have ended, so they never decrease.
    pub fn totals(&self) -> LinkStats {
        let mut sum = self.gone;
        self.others.values().for_each(|other| sum.add_counts(&other.link.stats));
        sum
    }

    /// The user number of a connection's peer; `None` before its hello, and for an unknown
    /// connection.
    pub fn user_of(&self, peer: PeerId) -> Option<UserId> {
        self.others.get(&peer)?.user
    }

    /// Returns a body of the session.
    pub fn body(&self, id: BodyId) -> Option<&PeerBody> {
        self.bodies.get(&id)
    }

    /// The tick reached; 0 before the start.
    pub fn tick(&self) -> Tick {
        self.tick
    }

    /// The newest tick for which all inputs are known and have acted. Its state is final.
    pub fn confirmed(&self) -> Tick {
        self.inputs.complete().min(self.resimulated_to())
    }

    /// The state of a body after one of the last 128 ticks.
    pub fn state_at(&self, body: BodyId, tick: Tick) -> Option<&crate::State> {
        self.bodies.get(&body)?.past(tick)
    }

    /// Reactions (N) of the hands on a body at one of the last 128 ticks, with their users.
    pub fn reactions_at(&self, body: BodyId, tick: Tick) -> Option<Vec<(UserId, [f64; 3])>> {
        self.bodies.get(&body)?.reactions_at(tick)
    }

    /// The rigid frame of a free body after one of the last 128 ticks.
    pub fn pose_at(&self, body: BodyId, tick: Tick) -> Option<crate::RigidState> {
        self.bodies.get(&body)?.past_pose(tick)
    }

    /// Processes a received datagram. Any bytes are allowed.
    pub fn on_datagram(&mut self, now: Duration, peer: PeerId, bytes: &[u8]) {
        let Some(other) = self.others.get_mut(&peer) else { return };
        let (Some(user), Ok((sequence, datagram))) = (other.user, Datagram::decode(bytes)) else {
            other.link.reject();
            return;
        };
        if !other.link.receive_datagram(now, sequence, bytes.len()) {
            return;
        }
        match datagram {
            Datagram::Inputs(Inputs { now: theirs, ahead: seen, ticks, check }) => {
                other.theirs = seen.or(other.theirs);
                other.newest = theirs;
                other.newest_at = now;
                other.came(now, theirs as f64 * self.config.step);
                let sample = self.tick as f64 - theirs as f64;
                if sample.abs() < WINDOW as f64 {
                    let ahead = other.ahead.get_or_insert(sample);
                    *ahead += 0.05 * (sample - *ahead);
                }
                for input in ticks {
                    let tick = input.tick;
                    // A tick in the far future is not stored, since it would displace ticks that
                    // are needed.
                    if tick > self.tick + WINDOW as u64 / 2 {
                        continue;
                    }
                    // What costs too much counts as lost. It is requested again, and when it has
                    // been missing for too long, a state repairs all.
                    if !self.inputs.lacks(user, tick) {
                        continue;
                    }
                    let bodies = self.changed_by(user, &input);
                    let waits = |id: &BodyId| !self.bodies.get(id).is_some_and(|b| b.cannot_wait(tick));
                    let again = self.ticks_to_resimulate(&bodies, tick);
                    let Some(other) = self.others.get_mut(&peer) else { return };
                    let pays = (other, &mut self.shared);
                    if bodies.iter().all(waits)
                        && affords(now, pays, (&self.bodies, &self.inputs), &input, again)
                        && self.inputs.put(user, input)
                    {
                        self.mark(&bodies, tick);
                    }
                }
                if let Some(check) = check {
                    self.compare(peer, user, check);
                }
            }
            Datagram::InputRequest(runs) => self.answer(now, peer, &runs),
            _ => other.link.reject(),
        }
    }

    /// Processes a received message. A message that breaks the protocol ends the connection.
    pub fn on_message(&mut self, now: Duration, peer: PeerId, bytes: &[u8]) {
        let message = PeerMessage::decode(bytes);
        // The digest takes a while to compute, and only a hello needs it.
        let own = matches!(message, Ok(PeerMessage::Hello { .. })).then(|| self.scene());
        let Some(other) = self.others.get_mut(&peer) else { return };
        other.link.receive_message(now, bytes.len());
        match message {
            Ok(PeerMessage::Hello { version, user, name, address, joining, scene }) => {
                let user = UserId(user);
                let twice = other.user.is_some() || other.hello.is_some();
                let refused = if version != PROTOCOL_VERSION {
                    Some(DisconnectReason::VersionMismatch)
                } else if twice || other.expected.is_some_and(|expected| user != expected) {
                    Some(DisconnectReason::Protocol)
                } else {
                    (Some(scene) != own).then_some(DisconnectReason::SceneMismatch)
                };
                if let Some(reason) = refused {
                    return self.turn_away(peer, reason);
                }
                other.hello = Some(Hello { user, name, address, joining });
                self.take_hello(peer);
            }
            Ok(PeerMessage::Welcome { user, others }) => {
                let user = UserId(user);
                // Only a peer that this one has asked gives a number, and it has another one
                // itself.
                let from = other.hello.as_ref().filter(|_| other.greeted).map(|hello| hello.user);
                let asked = self.config.user == UserId::HOST && from.is_some();
                if !asked || from == Some(UserId::HOST) || from == Some(user) {
                    return self.turn_away(peer, DisconnectReason::Protocol);
                }
                self.config.user = user;
                self.inputs.expect(user, 1);
                let others = others.into_iter().map(|(user, address)| (UserId(user), address)).collect();
                self.event(PeerEvent::Welcomed { user, others });
                let waiting: Vec<PeerId> = self.others.keys().copied().collect();
                waiting.into_iter().for_each(|peer| self.take_hello(peer));
            }
            Ok(PeerMessage::StateRequest) => other.wants_state = true,
            Ok(PeerMessage::State { tick, now: theirs, more, bodies }) => {
                self.take_part(now, peer, [tick, theirs], more, bodies);
            }
            Ok(PeerMessage::Goodbye { reason }) => self.disconnect(peer, reason),
            Ok(PeerMessage::Others { others }) => self.take_others(now, peer, others),
            Ok(PeerMessage::Shapes { body, from, places }) => {
                self.take_places(now, peer, BodyId(body), from, places);
            }
            Err(_) => {
                other.link.reject();
                self.turn_away(peer, DisconnectReason::Protocol);
            }
        }
    }

    /// Steps to the current time and sends what is due. Returns the number of ticks.
    pub fn update(&mut self, now: Duration) -> u64 {
        self.updated = now;
        let silent: Vec<PeerId> = self
            .others
            .iter()
            .filter(|(_, o)| o.link.is_silent(now, self.config.idle_timeout))
            .map(|(p, _)| *p)
            .collect();
        for peer in silent {
            self.turn_away(peer, DisconnectReason::Silent);
        }
        if !self.started {
            return 0;
        }
        self.send_introductions(now);
        self.roll_back();
        self.resimulate();
        let mut stepped = 0;
        let due = *self.next_step.get_or_insert(now + Duration::from_secs_f64(self.config.step));
        let mut due = due;
        while due <= now && stepped < STEPS {
            if self.caught_up > 0 && self.lead().1 > BEHIND {
                self.caught_up -= 1;
                due += Duration::from_secs_f64(self.config.step);
                continue;
            }
            self.step();
            stepped += 1;
            self.caught_up = self.caught_up.saturating_sub(1);
            due += Duration::from_secs_f64(self.config.step * (1.0 + self.drift()));
            if stepped == STEPS && due <= now {
                // A stall of this machine and a jump of its clock look the same here. The ticks
                // that the other peers report decide how many were missed.
                let missed = ((now - due).as_secs_f64() / self.config.step) as u64;
                self.missed = self.missed.saturating_add(missed).min(MAX_MISSED);
                due = now + Duration::from_secs_f64(self.config.step);
            }
        }
        stepped += self.catch_up(STEPS - stepped);
        self.next_step = Some(due);
        self.ask(now);
        self.give_states(now);
        stepped
    }

    /// Latest time at which to call [`PeerSession::update`]. `None` when there is nothing to wait
    /// for.
    pub fn next_wakeup(&self) -> Option<Duration> {
        let silent = self.others.values().map(|other| other.link.silent_at(self.config.idle_timeout));
        self.next_step.filter(|_| self.started).into_iter().chain(silent).min()
    }

    /// Returns the next datagram or message to send.
    ///
    /// Once 16,384 outputs wait here, new datagrams are dropped. Messages are never dropped.
    /// Besides the first and the last message of each connection, messages are requests for a
    /// state, at most one a second, and states. Each peer gets at most 16 states at once and two a
    /// second, and none while the queue is full.
    pub fn poll_output(&mut self) -> Option<Output> {
        self.out.pop_front()
    }

    /// Returns the next event.
    pub fn poll_event(&mut self) -> Option<PeerEvent> {
        self.events.pop()
    }

    fn step(&mut self) {
        self.tick += 1;
        let held = self.own.values().copied().collect();
        let impulses = std::mem::take(&mut self.impulses);
        self.inputs.put(self.config.user, InputTick { tick: self.tick, held, impulses });
        for body in self.bodies.values_mut() {
            body.advance(&self.inputs);
        }
        self.inputs.forget_gone(self.tick);
        let tick = self.tick;
        self.bodies.values_mut().for_each(|body| body.columns.forget(tick));
        let confirmed = self.confirmed();
        let due = confirmed - confirmed % CHECK_EVERY;
        let mut check = None;
        if self.last_check.is_none_or(|c| c.tick < due) && due > 0 {
            // Each check covers one body, in turn.
            let index = (due / CHECK_EVERY) as usize % self.bodies.len().max(1);
            check =
                self.bodies.values().nth(index).filter(|b| !b.lacks_shapes(due)).and_then(|b| {
                    Some(StateCheck { body: b.id(), tick: due, value: b.check(due)?.0 as f32 })
                });
            self.last_check = check.or(self.last_check);
        }
        let known = |o: &RemotePeer| o.user.is_some() || o.expected.is_some();
        let peers: Vec<PeerId> = self.others.iter().filter(|(_, o)| known(o)).map(|(p, _)| *p).collect();
        for peer in peers {
            self.send_inputs(peer, check);
        }
    }

    fn send_inputs(&mut self, peer: PeerId, check: Option<StateCheck>) {
        let Some(own) = self.inputs.users.get(&self.config.user) else { return };
        let Some(other) = self.others.get(&peer) else { return };
        let mut ticks: Vec<InputTick> = (0..=self.config.repeats as u64)
            .map_while(|back| self.tick.checked_sub(back))
            .filter_map(|t| own.at(t).cloned())
            .collect();
        while ticks.len() > 1 && Inputs::bytes(&ticks) > other.link.max_datagram {
            ticks.pop();
        }
        let (now, ahead) = (self.tick, other.ahead);
        self.datagram(peer, &Datagram::Inputs(Inputs { now, ahead, ticks, check }));
    }

    fn datagram(&mut self, peer: PeerId, datagram: &Datagram) {
        let Some(other) = self.others.get_mut(&peer) else { return };
        if self.out.len() >= MAX_OUT {
            return other.link.drop_datagram();
        }
        other.link.send_datagram(|sequence| datagram.encode(sequence), &mut self.out);
    }

    fn message(&mut self, peer: PeerId, message: &PeerMessage) {
        if let Some(other) = self.others.get_mut(&peer) {
            other.link.send_message(message.encode(), &mut self.out);
        }
    }

    /// Sends a message to all peers in the session.
    fn broadcast(&mut self, message: &PeerMessage) {
        let joined = self.others.iter().filter(|(_, other)| other.user.is_some());
        let peers: Vec<PeerId> = joined.map(|(&peer, _)| peer).collect();
        peers.into_iter().for_each(|peer| self.message(peer, message));
    }

    fn event(&mut self, event: PeerEvent) {
        self.events.push(event);
    }
}
