//! A host with guests under faults.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use pliant_modal::{Body, BodyConfig, GrabId, ModalModel, Patch};
use pliant_stream::emulator::LinkConfig;
use pliant_stream::wire::GuestMessage;
use pliant_stream::{
    BodyId, Channel, DisconnectReason, GrabKey, GrabState, GuestEvent, GuestSession, GuestSessionConfig,
    HandPlayout, HostEvent, HostSession, HostSessionConfig, RigidId, RigidState, Role, StepSettings,
    StreamError, TickState, UserId,
};

use super::attack::Attacker;
use super::device::{DeviceLoop, DeviceRecord};
use super::schedule::Random;
use super::state::Processes;
use super::{
    AGREES, COMPARED, Digest, END, FaultKind, IDLE, LOOK, MAX_FORCE, MAX_MEMORY, Memory, Outcome,
    SimulatedFault, apart, hand, hold, norm,
};
use crate::pair::{Pair, PathConfig, Stalled, World};

const BODY: BodyId = BodyId(1);
/// A rigid body of the host's app, and how far guests may show it from where it was, m.
const CRATE: RigidId = RigidId(1);
const CRATE_AGREES: f64 = 0.02;
/// A host plays hands back two ticks late, and leads them by no more than this in a tick, m.
const PLAYOUT: (usize, f64) = (2, 20.0 / 40.0);
/// How long a hand has held when the reaction displayed to it is compared with the truth.
const SETTLED: Duration = Duration::from_secs(3);
/// The grabs that a flood begins and ends.
const FLOOD_GRABS: std::ops::Range<u16> = 100..104;
/// Ticks that a guest may show before the host has made them: guesses while frames are lost.
const AHEAD: u64 = 4;
/// Ticks of the host that are kept to compare with.
const KEPT: usize = 400;
/// Largest displayed reaction over the largest true one, also with a malicious guest: a fifth
/// beyond it, and the rounding of the frames.
const MAX_SHARE: f64 = 1.2 + 1e-3;

struct HeldHand {
    id: GrabId,
    state: GrabState,
    hand: HandPlayout,
}

/// What the apps of host and guests do around their sessions.
struct Apps {
    now: Duration,
    model: Arc<ModalModel>,
    body: Body,
    held: BTreeMap<GrabKey, HeldHand>,
    /// The numbers of users by name, which the host's app stores.
    known: BTreeMap<String, UserId>,
    truth: VecDeque<(u64, Vec<f64>)>,
    /// The process of each guest of the pair, its grab, and when it took hold.
    guests: Vec<(usize, Option<u16>, Duration)>,
    /// The largest reactions of each process's hand: shown, and true, N.
    largest: Vec<(f64, f64)>,
    /// The devices of the guests' processes.
    devices: Vec<Option<DeviceLoop>>,
    device_record: DeviceRecord,
    /// The processes whose apps have just written a file.
    wrote: Vec<usize>,
    attacker: Attacker,
    random: Random,
    ticks: u64,
    digest: Digest,
    broken: Option<String>,
}

fn name(process: usize) -> String {
    format!("process {process}")
}

impl Apps {
    fn ensure(&mut self, holds: bool, what: impl FnOnce() -> String) {
        if !holds && self.broken.is_none() {
            self.broken = Some(format!("{:.3} s: {}", self.now.as_secs_f64(), what()));
        }
    }

    fn malicious(&self) -> usize {
        self.largest.len() - 1
    }

    fn process_of(&self, user: UserId) -> Option<usize> {
        let name = self.known.iter().find(|(_, known)| **known == user)?.0;
        name.strip_prefix("process ")?.parse().ok()
    }

    /// A target within a body's length of the body, as a host's app allows it.
    fn reachable(&self, target: [f64; 3]) -> [f64; 3] {
        let from = [0.5, 0.1, 0.1];
        let away: [f64; 3] = std::array::from_fn(|x| target[x] - from[x]);
        let share = (self.model.size() / norm(away).max(1e-9)).min(1.0);
        std::array::from_fn(|x| from[x] + share * away[x])
    }

    fn size(&self) -> f64 {
        self.truth.iter().map(|(_, q)| apart(q, &vec![0.0; q.len()])).fold(0.0, f64::max)
    }

    fn begin(&mut self, key: GrabKey, state: GrabState) -> Option<()> {
        let patch = Patch::around(self.model.surface(), state.vertex, state.radius).ok()?;
        let id = self.body.grab(&patch, state.hold).ok()?;
        let target = self.reachable(state.target);
        self.body.set_target(id, target).ok()?;
        self.held.insert(key, HeldHand { id, state, hand: HandPlayout::new(target.into()) });
        Some(())
    }
}

impl World for Apps {
    fn step(&mut self, now: Duration, tick: u64, host: &mut HostSession) {
        self.ticks += 1;
        for held in self.held.values_mut() {
            let target = held.hand.next(PLAYOUT.0, PLAYOUT.1).into();
            let _ = self.body.set_target(held.id, target);
        }
        let stepped = self.body.step();
        self.ensure(stepped.is_ok(), || format!("the host's step fails: {stepped:?}"));
        let mut grabs = Vec::new();
        for held in self.held.values_mut() {
            held.state.target = self.body.target(held.id).unwrap_or_default();
            held.state.reaction = self.body.reaction(held.id).unwrap_or_default();
            grabs.push(held.state);
        }
        for grab in &grabs {
            let force = norm(grab.reaction);
            if let Some(process) = self.process_of(grab.key.user) {
                let fair = force <= MAX_FORCE || process == self.malicious();
                self.ensure(fair, || format!("the body pulls {} with {force} N", name(process)));
                self.largest[process].1 = self.largest[process].1.max(force);
            }
        }
        let (q, v, a) = (self.body.q(), self.body.v(), self.body.a());
        self.digest.add_all(q);
        let finite = q.iter().chain(v).all(|x| x.is_finite());
        let state = TickState { tick, q, v, a, z: &[], pose: None, grabs: &grabs, resting: false };
        let published = host.publish(now, BODY, &state);
        self.truth.push_back((tick, q.to_vec()));
        if self.truth.len() > KEPT {
            self.truth.pop_front();
        }
        let moved = host.publish_rigids(now, tick, &[(CRATE, crate_at(tick as f64))]);
        self.ensure(moved.is_ok(), || format!("a rigid body is not published: {moved:?}"));
        self.ensure(finite, || "the host's body is not finite".to_owned());
        self.ensure(published.is_ok(), || format!("a tick is not published: {published:?}"));
        let mut names: Vec<&str> = host.users().map(|(_, _, name)| name).collect();
        names.sort_unstable();
        let once = names.windows(2).all(|pair| pair[0] != pair[1]);
        self.ensure(once, || format!("somebody is there twice: {names:?}"));
    }

    fn host_event(&mut self, now: Duration, event: HostEvent, host: &mut HostSession) {
        match event {
            HostEvent::JoinRequest { peer, name } => {
                self.wrote.push(0);
                // One name is one user, and a new connection takes the place of an older one.
                let older = host.users().find(|(_, _, other)| **other == *name).map(|(older, ..)| older);
                if let Some(older) = older {
                    host.kick(older, DisconnectReason::Replaced);
                }
                let next = self.known.values().map(|user| user.0).max().unwrap_or(0) + 1;
                let number = *self.known.entry(name).or_insert(UserId(next));
                let given = host.accept_as(now, peer, Some(number), Role::Hold);
                // It may have gone while the host stood still. The event of that follows.
                let gone = given == Err(StreamError::UnknownPeer(peer));
                self.ensure(given == Ok(number) || gone, || format!("user {} becomes {given:?}", number.0));
            }
            HostEvent::GrabBegan { key, vertex, radius, target, hold, .. } => {
                let state = GrabState { key, vertex, radius, target, reaction: [0.0; 3], hold };
                let of_user = self.held.keys().filter(|held| held.user == key.user).count();
                if of_user >= 4 || self.begin(key, state).is_none() {
                    host.refuse_grab(key);
                }
            }
            HostEvent::GrabMoved { key, input, target, .. } => {
                let target = self.reachable(target);
                if let Some(held) = self.held.get_mut(&key) {
                    held.hand.take(input, 1, target.into());
                }
            }
            HostEvent::GrabEnded { key, .. } => {
                if let Some(held) = self.held.remove(&key) {
                    self.body.release(held.id);
                }
            }
            _ => {}
        }
    }

    fn guest_event(&mut self, _now: Duration, guest: usize, event: GuestEvent, _session: &mut GuestSession) {
        let (process, grab, _) = self.guests[guest];
        match event {
            GuestEvent::ModelCame { .. } => self.wrote.push(process),
            GuestEvent::GrabRefused { grab: refused } if grab == Some(refused) => {
                self.ensure(process == self.malicious(), || format!("{} may not hold", name(process)));
                self.guests[guest].1 = None;
            }
            GuestEvent::Closed { reason } if process != self.malicious() => {
                use DisconnectReason::{Replaced, Silent};
                let expected = matches!(reason, Silent | Replaced);
                self.ensure(expected, || format!("{} is sent away: {reason}", name(process)));
            }
            _ => {}
        }
    }

    fn guest_stepped(&mut self, now: Duration, guest: usize, stepped: u64, session: &mut GuestSession) {
        let (process, grab, _) = self.guests[guest];
        let Some(user) = session.user() else { return };
        let Some(view) = session.body(BODY).filter(|view| stepped > 0 && view.is_ready()) else { return };
        let finite = view.visual().is_none_or(|shown| shown.is_finite());
        view.visual().into_iter().for_each(|shown| self.digest.add_all(&shown.q));
        self.ensure(finite, || format!("{} shows what is not finite", name(process)));
        let most = 16 * self.largest.len();
        let (hands, users) = (view.grabs().len(), session.users().count());
        self.ensure(hands <= most && users <= self.largest.len(), || {
            format!("{} has {hands} hands and {users} users", name(process))
        });
        if let Some(shown) = grab.and_then(|grab| view.hand_reaction(user, grab)) {
            let force = norm(shown);
            self.digest.add_all(&shown);
            let fair = force <= MAX_FORCE || process == self.malicious();
            self.ensure(fair, || format!("{} displays {force} N", name(process)));
            // A hand that has only just taken hold is ahead of what the host has made of it.
            if self.now > self.guests[guest].2.saturating_add(SETTLED) {
                self.largest[process].0 = self.largest[process].0.max(force);
            }
        }
        let (vertex, mut target) = hand(&self.model, process, self.now);
        if let Some(device) = &mut self.devices[process] {
            let shown = grab.map(|grab| GrabKey { user, grab });
            let shown = view.grabs().iter().find(|grab| Some(grab.key) == shown);
            let displayed = shown.and_then(|own| Some((own.target, view.hand_reaction(user, own.key.grab)?)));
            device.publish(displayed, session.step());
            target = device.tool(target);
        }
        match grab {
            None => {
                self.guests[guest].1 = session.begin_grab(now, BODY, vertex, 0.12, target, hold()).ok();
                self.guests[guest].2 = self.now;
            }
            Some(grab) => {
                let _ = session.set_target(grab, target);
            }
        }
    }

    fn guest_sent(&mut self, guest: usize, channel: Channel, bytes: &[u8]) {
        if self.guests[guest].0 == self.malicious() {
            self.attacker.keep(&mut self.random, channel, bytes);
        }
    }
}

/// A host with guests, and the state of their processes.
struct Star {
    pair: Pair,
    apps: Apps,
    processes: Processes,
    /// The guest of each process in the pair; none for the host.
    guest: Vec<Option<usize>>,
    /// When a process that has lost its session reconnects.
    reconnects: Vec<Option<Duration>>,
    /// By how much the path of a process's next attempt is slower, which it gives up at once.
    late: Vec<Option<Duration>>,
    host_was_down: bool,
    /// Looks of the last second at which a process showed a tick that the host has made.
    compared: Vec<u32>,
    path: LinkConfig,
    random: Random,
}

fn host_session(model: &Arc<ModalModel>) -> Result<HostSession, String> {
    let config = HostSessionConfig { idle_timeout: IDLE, open: false, ..HostSessionConfig::default() };
    let mut host = HostSession::new(config).map_err(|e| e.to_string())?;
    host.add_body(BODY, "bar", model.clone(), StepSettings::default()).map_err(|e| e.to_string())?;
    host.add_rigid(CRATE, "crate", crate_at(0.0)).map_err(|e| e.to_string())?;
    Ok(host)
}

/// The rigid body swings for five seconds, and rests for five.
fn crate_at(tick: f64) -> RigidState {
    let (phase, period) = (tick.rem_euclid(400.0), 100.0);
    let (sine, cosine) = (phase.min(200.0) / period * std::f64::consts::TAU).sin_cos();
    // At 40 ticks a second.
    let speed = if phase < 200.0 { 0.5 * std::f64::consts::TAU / (period / 40.0) * cosine } else { 0.0 };
    RigidState { position: [0.5 * sine, 0.0, 0.0], linear: [speed, 0.0, 0.0], ..RigidState::default() }
}

fn body(model: &Arc<ModalModel>) -> Result<Body, String> {
    let config = BodyConfig { step: 1.0 / 40.0, ..BodyConfig::default() };
    Body::new(model.clone(), config).map_err(|e| e.to_string())
}

/// Runs the session of a seed.
pub(super) fn run(
    model: &Arc<ModalModel>,
    seed: u64,
    count: usize,
    faults: &[SimulatedFault],
    (random, mut memory): (Random, Memory),
) -> Result<Outcome, String> {
    let host = host_session(model)?;
    let mut pair = Pair::new(*host.config()).map_err(|e| e.to_string())?;
    pair.host = host;
    let apps = Apps {
        now: Duration::ZERO,
        model: model.clone(),
        body: body(model)?,
        held: BTreeMap::new(),
        known: BTreeMap::new(),
        truth: VecDeque::new(),
        guests: Vec::new(),
        largest: vec![(0.0, 0.0); count],
        devices: std::iter::repeat_with(|| None).take(count).collect(),
        device_record: DeviceRecord::default(),
        wrote: Vec::new(),
        attacker: Attacker::default(),
        random: Random::new(!seed),
        ticks: 0,
        digest: Digest::EMPTY,
        broken: None,
    };
    let mut random = random;
    let path = super::state::network(&mut random);
    let mut star = Star {
        pair,
        apps,
        processes: Processes::default(),
        guest: vec![None; count],
        reconnects: vec![Some(Duration::ZERO); count],
        late: vec![None; count],
        host_was_down: false,
        compared: vec![0; count],
        path,
        random,
    };
    let mut faults = faults.iter().peekable();
    let mut now = Duration::ZERO;
    while now < END {
        while let Some(fault) = faults.next_if(|fault| fault.at <= now) {
            star.begin(*fault);
        }
        star.look(now)?;
        now += LOOK;
        star.apps.now = now;
        star.pair.run_until(now, &mut star.apps);
        let held = memory.look();
        star.apps.ensure(held <= MAX_MEMORY[0], || format!("the session holds {held} bytes"));
        if now + Duration::from_secs(1) > END {
            star.agree();
        }
        if let Some(broken) = star.apps.broken.take() {
            return Err(broken);
        }
    }
    let held = memory.look();
    if held > MAX_MEMORY[1] {
        return Err(format!("the session holds {held} bytes at its end"));
    }
    if let Some(process) = (1..count - 1).find(|process| star.compared[*process] < COMPARED) {
        return Err(format!("{} shows nothing that the host has made", name(process)));
    }
    let shares = star.apps.largest[1..count - 1].iter().map(|(shown, truth)| shown / truth.max(1e-9));
    let share = shares.fold(0.0, f64::max);
    if share > MAX_SHARE {
        return Err(format!("a hand was displayed {share:.3} times the largest true reaction"));
    }
    Ok(Outcome {
        ticks: star.apps.ticks,
        share,
        device_record: star.apps.device_record,
        took: star.processes.took(),
        digest: star.apps.digest,
        memory: [memory.largest, held],
    })
}

impl Star {
    fn begin(&mut self, fault: SimulatedFault) {
        self.processes.begin(fault);
        if fault.kind == FaultKind::Crash {
            self.apps.devices[fault.process] = None;
        }
        match (fault.kind, self.guest[fault.process]) {
            (FaultKind::ClockJump, None) => self.pair.jump_host(fault.lasts),
            (FaultKind::ClockJump, Some(guest)) => self.pair.jump_guest(guest, fault.lasts),
            (FaultKind::SecondConnection | FaultKind::Crash, Some(guest)) => {
                self.pair.cut(guest);
                self.reconnects[fault.process] = Some(fault.at);
            }
            (FaultKind::LateReconnect, Some(guest)) => {
                self.pair.cut(guest);
                self.late[fault.process] = Some(fault.lasts);
                self.reconnects[fault.process] = Some(fault.at);
                return;
            }
            // The host's own end is in `look`.
            (FaultKind::Crash, None) => {}
            _ => return,
        }
        self.processes.take_last();
    }

    /// Does what is due: processes stall, links break, and who has lost the session comes back.
    fn look(&mut self, now: Duration) -> Result<(), String> {
        let down = self.processes.is_down(0, now);
        if self.host_was_down && !down {
            self.pair.restart_host(host_session(&self.apps.model)?);
            self.apps.body = body(&self.apps.model)?;
            self.apps.held.clear();
            self.apps.truth.clear();
        }
        self.host_was_down = down;
        for process in std::mem::take(&mut self.apps.wrote) {
            self.processes.write(process, now);
        }
        let host = if down { Stalled::from(true) } else { self.processes.take_stalls(0, now) };
        self.pair.stall_host(host);
        let malicious = self.apps.malicious();
        for process in 1..self.guest.len() {
            let stalled = self.processes.stalled(process, now);
            self.device(process, now)?;
            let partitioned =
                self.processes.is_partitioned(process, now) || self.processes.is_partitioned(0, now);
            if let Some(guest) = self.guest[process] {
                self.pair.stall_guest(guest, stalled);
                self.pair.part(guest, partitioned);
                if self.pair.guests[guest].session.user().is_some() {
                    self.processes.take(process, &[FaultKind::Partition, FaultKind::BadNetwork], now);
                    self.processes.take(0, &[FaultKind::Partition, FaultKind::BadNetwork], now);
                    self.processes.take_stalls(process, now);
                }
                let bad = self.processes.is_disturbed(process, now) || self.processes.is_disturbed(0, now);
                let link = if bad { super::state::disturbed(&self.path) } else { self.path.clone() };
                let end = &mut self.pair.guests[guest];
                for way in [&mut end.up, &mut end.down] {
                    if *way.config() != link {
                        way.reconfigure(link.clone()).map_err(|e| e.to_string())?;
                    }
                }
                if end.session.is_closed() && self.reconnects[process].is_none() {
                    let pause = Duration::from_millis(self.random.range(200, 600));
                    // Who was sent away for breaking the protocol stays away.
                    let stays_away = process == malicious && self.apps.attacker.now.is_some();
                    self.reconnects[process] = Some(if stays_away { END } else { now + pause });
                }
            }
            let due = self.reconnects[process].is_some_and(|at| at <= now);
            let runs = host == Stalled::default() && stalled == host;
            if due && runs && !partitioned && !self.processes.is_down(process, now) {
                self.connect(process)?;
            }
        }
        self.attack(now, malicious);
        Ok(())
    }

    /// Runs the loop of a guest's device, which ends and begins with its process.
    fn device(&mut self, process: usize, now: Duration) -> Result<(), String> {
        if process == self.apps.malicious() || self.processes.is_down(process, now) {
            return Ok(());
        }
        let apps = &mut self.apps;
        let device = match &mut apps.devices[process] {
            Some(device) => device,
            none => none.insert(DeviceLoop::new(&apps.model, process, now)?),
        };
        apps.device_record.add(device.run(&apps.model, now, self.processes.take_device(process, now))?);
        Ok(())
    }

    fn connect(&mut self, process: usize) -> Result<(), String> {
        if let Some(slower) = self.late[process].take() {
            self.attempt(process, slower)?;
            let late = self.guest[process].take();
            late.into_iter().for_each(|late| self.pair.abandon(late));
            self.processes.take(process, &[FaultKind::LateReconnect], self.apps.now);
        }
        self.attempt(process, Duration::ZERO)
    }

    /// Lets a process connect over a path that is slower by so much.
    fn attempt(&mut self, process: usize, slower: Duration) -> Result<(), String> {
        if let Some(before) = self.guest[process] {
            self.pair.cut(before);
        }
        let config = GuestSessionConfig { name: name(process), idle_timeout: IDLE, ..Default::default() };
        let path = PathConfig::symmetric(LinkConfig { delay: self.path.delay + slower, ..self.path.clone() });
        let model = self.apps.model.clone();
        // Every second guest has the model already.
        let cached = move |session: &mut GuestSession| {
            if process.is_multiple_of(2) {
                session.add_cached_model(model);
            }
        };
        self.apps.guests.push((process, None, Duration::MAX));
        let joined = self.pair.join_with(config, path, self.random.next(), cached);
        self.guest[process] = Some(joined.map_err(|e| format!("{} cannot join: {e}", name(process)))?);
        self.reconnects[process] = None;
        Ok(())
    }

    fn attack(&mut self, now: Duration, malicious: usize) {
        let before = std::mem::replace(&mut self.apps.attacker.now, self.processes.attack(now));
        let Some(guest) = self.guest[malicious] else { return };
        if before == Some(FaultKind::Flood) && self.apps.attacker.now.is_none() {
            for grab in FLOOD_GRABS {
                self.pair.send_as(guest, Channel::Message, GuestMessage::GrabEnd { grab }.encode());
            }
        }
        let packets = self.apps.attacker.packets(&mut self.random);
        if let Some(kind) = self.apps.attacker.now.filter(|_| !packets.is_empty()) {
            self.processes.take(malicious, &[kind], now);
        }
        for (channel, bytes) in packets {
            self.pair.send_as(guest, channel, bytes);
        }
        if self.apps.attacker.now == Some(FaultKind::Flood) {
            let grab = FLOOD_GRABS.start + self.random.range(0, FLOOD_GRABS.len() as u64) as u16;
            let message = match self.random.range(0, 2) {
                0 => GuestMessage::GrabEnd { grab },
                _ => GuestMessage::GrabBegin {
                    grab,
                    body: BODY.0,
                    vertex: self.random.range(0, 60) as u32,
                    radius: 0.01 * self.random.range(0, 120) as f64,
                    target: self.random_target(),
                    hold: hold(),
                },
            };
            self.pair.send_as(guest, Channel::Message, message.encode());
        }
    }

    /// A place within 20 cm of where hands are. A flood is many hands, not strong ones.
    fn random_target(&mut self) -> [f64; 3] {
        let (_, [x, y, z]) = hand(&self.apps.model, 1, self.apps.now);
        let mut away = || 0.01 * self.random.range(0, 41) as f64 - 0.2;
        [x + away(), y + away(), z + away()]
    }

    /// Checks that all have found back to each other.
    fn agree(&mut self) {
        let (size, tick) = (self.apps.size(), self.pair.tick());
        let honest = 1..self.apps.malicious();
        for process in honest.clone() {
            let name = name(process);
            let number = self.apps.known.get(&name).copied();
            let there = self.pair.host.users().any(|(_, user, n)| *n == *name && Some(user) == number);
            let session =
                self.guest[process].and_then(|guest| self.pair.guests.get(guest)).map(|g| &g.session);
            let Some(session) = session.filter(|session| there && session.user() == number) else {
                return self.apps.ensure(false, || format!("{name} is lost"));
            };
            let others = honest.clone().filter(|other| *other != process);
            let missing =
                others.map(super::star::name).find(|other| !session.users().any(|u| u.name == *other));
            let Some(view) = session.body(BODY).filter(|view| view.is_ready()) else {
                return self.apps.ensure(false, || format!("{name} has no body"));
            };
            let (shown, hands) = (view.tick(), view.grabs().len());
            let near = (tick.saturating_sub(39)..=tick + AHEAD).contains(&shown);
            let truth = self.apps.truth.iter().rev().find(|(tick, _)| *tick == shown);
            // There is none for a tick that the host has yet to make.
            self.compared[process] += u32::from(truth.is_some());
            let off = truth.zip(view.visual()).map_or(0.0, |((_, q), shown)| apart(q, &shown.q) / size);
            let held = view.grabs().iter().any(|grab| Some(grab.key.user) == number);
            self.apps.ensure(missing.is_none(), || format!("{name} does not know of {missing:?}"));
            self.apps.ensure(near, || format!("{name} shows tick {shown} of {tick}"));
            self.apps.ensure(held, || format!("{name} holds nothing, of {hands} hands"));
            self.apps.ensure(off <= AGREES, || format!("{name} is off by {:.2} %", 100.0 * off));
            let rigid = session.rigid(CRATE).map(|rigid| (rigid.tick(), rigid.visual().position[0]));
            let (at, shown) = rigid.unwrap_or((f64::NAN, f64::NAN));
            let near = (-(AHEAD as f64)..40.0).contains(&(tick as f64 - at));
            let off = (shown - crate_at(at).position[0]).abs();
            let agrees = near && off <= CRATE_AGREES;
            self.apps.ensure(agrees, || format!("{name} shows a crate at {shown} m for tick {at} of {tick}"));
        }
    }
}
