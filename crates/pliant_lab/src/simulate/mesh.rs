//! A mesh of peers under faults.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use pliant_modal::ModalModel;
use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss};
use pliant_stream::peer::{PeerEvent, PeerSession, PeerSessionConfig};
use pliant_stream::{BodyId, Channel, DisconnectReason, GrabKey, Output, PeerId, StepSettings, UserId};

use super::device::{DeviceLoop, Felt};
use super::mischief::Mischief;
use super::schedule::Random;
use super::state::{Processes, disturbed, network};
use super::{
    AGREES, Digest, END, FaultKind, HEALED, IDLE, LOOK, MAX_FORCE, MAX_MEMORY, Memory, Outcome,
    SimulatedFault, apart, hand, hold, norm,
};
use crate::pair::{Stalled, WAITING, Waiting};

const BODY: BodyId = BodyId(1);
/// Ticks that may lie between two peers, or between a peer and its newest final tick, at the end.
const NEAR: u64 = 60;

/// What crosses a connection.
#[derive(Debug, Clone)]
enum Packet {
    Datagram(Vec<u8>),
    Message(Vec<u8>),
    /// The transport tells the other side that the connection is closed.
    Close,
}

/// One side of a connection.
#[derive(Debug)]
struct Side {
    process: usize,
    /// How often the process had been started when the connection began.
    life: u32,
    /// Datagrams and messages that this side sends.
    links: [EmulatedLink<Packet>; 2],
    /// The session of this side knows the connection.
    open: bool,
    closed: bool,
    /// Sent while the network of this side stands still, and received while its app does.
    sent: Waiting<Packet>,
    received: Waiting<Packet>,
}

/// A connection. Its number is its [`PeerId`] on both sides.
#[derive(Debug)]
struct Wire {
    sides: [Side; 2],
}

/// A peer's process.
struct Node {
    session: Option<PeerSession>,
    life: u32,
    ahead: Duration,
    grab: Option<u16>,
    device: Option<DeviceLoop>,
    /// Whom it looks for, and when it tries next.
    missed: BTreeMap<usize, Duration>,
    /// When it tries to join, as long as it has no number.
    join: Option<Duration>,
    /// Its final states, to compare.
    finals: VecDeque<(u64, Vec<f64>)>,
    size: f64,
}

struct Mesh {
    model: Arc<ModalModel>,
    nodes: Vec<Node>,
    wires: Vec<Wire>,
    processes: Processes,
    mischief: Mischief,
    path: LinkConfig,
    random: Random,
    now: Duration,
    ticks: u64,
    felt: Felt,
    digest: Digest,
    broken: Option<String>,
}

/// The number of a process among peers, which belongs to its key.
fn number(process: usize) -> UserId {
    UserId(u16::try_from(process).unwrap_or(0) + 1)
}

fn process_of(user: UserId) -> usize {
    usize::from(user.0).wrapping_sub(1)
}

/// Runs the session of a seed.
pub(super) fn run(
    model: &Arc<ModalModel>,
    seed: u64,
    count: usize,
    faults: &[SimulatedFault],
    (mut random, mut memory): (Random, Memory),
) -> Result<Outcome, String> {
    let path = network(&mut random);
    let mut mesh = Mesh {
        model: model.clone(),
        nodes: Vec::new(),
        wires: Vec::new(),
        processes: Processes::default(),
        mischief: Mischief::default(),
        path,
        random: Random::new(!seed ^ random.next()),
        now: Duration::ZERO,
        ticks: 0,
        felt: Felt::default(),
        digest: Digest::EMPTY,
        broken: None,
    };
    for process in 0..count {
        let session = mesh.session(number(process), true)?;
        mesh.nodes.push(Node {
            session: Some(session),
            life: 0,
            ahead: Duration::ZERO,
            grab: None,
            device: None,
            missed: BTreeMap::new(),
            join: None,
            finals: VecDeque::new(),
            size: 0.0,
        });
    }
    // Each peer calls those with lower numbers.
    for process in 0..count {
        for other in 0..process {
            mesh.dial(process, other, Some(number(other)));
        }
    }
    let mut faults = faults.iter().peekable();
    while mesh.now < END {
        while let Some(fault) = faults.next_if(|fault| fault.at <= mesh.now) {
            mesh.begin(*fault);
        }
        if mesh.now >= HEALED {
            // Who was sent away by some and not by others makes them differ for as long as it is
            // there.
            mesh.nodes[count - 1].session = None;
        }
        let present = if mesh.now < HEALED { count } else { count - 1 };
        for process in 0..present {
            mesh.turn(process)?;
        }
        mesh.now += LOOK;
        let held = memory.look();
        mesh.ensure(held <= MAX_MEMORY[0], || format!("the session holds {held} bytes"));
        if mesh.now + Duration::from_secs(1) > END {
            mesh.agree();
        }
        if let Some(broken) = mesh.broken.take() {
            return Err(broken);
        }
    }
    let held = memory.look();
    if held > MAX_MEMORY[1] {
        return Err(format!("the session holds {held} bytes at its end"));
    }
    Ok(Outcome {
        ticks: mesh.ticks,
        share: 0.0,
        felt: mesh.felt,
        took: mesh.processes.took(),
        digest: mesh.digest,
        memory: [memory.largest, held],
    })
}

impl Mesh {
    fn ensure(&mut self, holds: bool, what: impl FnOnce() -> String) {
        if !holds && self.broken.is_none() {
            self.broken = Some(format!("{:.3} s: {}", self.now.as_secs_f64(), what()));
        }
    }

    fn malicious(&self) -> usize {
        self.nodes.len() - 1
    }

    fn session(&self, user: UserId, founds: bool) -> Result<PeerSession, String> {
        let config = PeerSessionConfig { user, founds, idle_timeout: IDLE, ..PeerSessionConfig::default() };
        let mut session = PeerSession::new(config).map_err(|e| e.to_string())?;
        let added = session.add_body(BODY, self.model.clone(), &StepSettings::default());
        added.map_err(|e| e.to_string())?;
        Ok(session)
    }

    fn begin(&mut self, fault: SimulatedFault) {
        // Somebody has to stay who is in the session, and from whom the others get the state.
        let others = (0..self.malicious()).filter(|other| *other != fault.process);
        let started = |node: &Node| node.session.as_ref().is_some_and(|session| session.tick() > 0);
        let alone = !others.clone().any(|other| started(&self.nodes[other]));
        if fault.kind == FaultKind::Crash && alone {
            return;
        }
        self.processes.begin(fault);
        let lives = self.nodes[fault.process].session.is_some();
        if lives && matches!(fault.kind, FaultKind::ClockJump | FaultKind::Crash) {
            self.processes.take_last();
        }
        match fault.kind {
            FaultKind::ClockJump => self.nodes[fault.process].ahead += fault.lasts,
            FaultKind::Crash => {
                let node = &mut self.nodes[fault.process];
                (node.session, node.device) = (None, None);
            }
            FaultKind::SecondConnection | FaultKind::LateReconnect => {
                // It calls somebody who does not know yet that the old connection is of no use. A
                // late call arrives after the one that follows.
                let other = others.clone().nth(self.random.index(others.count().max(1))).unwrap_or(0);
                let known = self.nodes[fault.process].session.as_ref().is_some_and(|s| s.tick() > 0);
                if known && other != fault.process {
                    self.processes.take_last();
                    if fault.kind == FaultKind::LateReconnect {
                        self.dial_over(fault.lasts, fault.process, other, Some(number(other)));
                    }
                    self.dial(fault.process, other, Some(number(other)));
                }
            }
            _ => {}
        }
    }

    /// Connects a process to another. The other one learns of it from the first message.
    fn dial(&mut self, from: usize, to: usize, user: Option<UserId>) {
        self.dial_over(Duration::ZERO, from, to, user);
    }

    /// The same over a path that is slower by so much.
    fn dial_over(&mut self, slower: Duration, from: usize, to: usize, user: Option<UserId>) {
        let peer = PeerId(self.wires.len() as u64);
        let own = self.now + self.nodes[from].ahead;
        let Some(session) = &mut self.nodes[from].session else { return };
        let connected = session.connect(own, peer, user, 1200);
        let lives = [self.nodes[from].life, self.nodes[to].life];
        let path = LinkConfig { delay: self.path.delay + slower, ..self.path.clone() };
        let reliable = LinkConfig { loss: Loss::None, keep_order: true, ..path.clone() };
        let mut side = |process, life, open| Side {
            process,
            life,
            links: [
                EmulatedLink::new(path.clone(), self.random.next()),
                EmulatedLink::new(reliable.clone(), self.random.next()),
            ],
            open,
            closed: false,
            sent: Waiting::default(),
            received: Waiting::default(),
        };
        let sides = [side(from, lives[0], true), side(to, lives[1], false)];
        self.wires.push(Wire { sides });
        self.ensure(connected.is_ok(), || format!("process {from} cannot connect: {connected:?}"));
    }

    /// One look of a process: it reads, steps and sends.
    fn turn(&mut self, process: usize) -> Result<(), String> {
        let now = self.now;
        if self.processes.is_down(process, now) {
            return Ok(());
        }
        self.device(process)?;
        let stalled = self.processes.take_stalls(process, now);
        self.transfer(process, stalled);
        if stalled.app {
            return Ok(());
        }
        if self.nodes[process].session.is_none() {
            let fresh = self.session(UserId::HOST, false)?;
            let node = &mut self.nodes[process];
            (node.session, node.grab, node.join) = (Some(fresh), None, Some(now));
            node.life += 1;
            node.missed.clear();
            node.finals.clear();
        }
        self.read(process);
        self.work(process);
        self.events(process);
        self.send(process);
        self.look_for(process);
        Ok(())
    }

    fn is_parted(&self, a: usize, b: usize) -> bool {
        self.processes.is_parted(a, self.now) || self.processes.is_parted(b, self.now)
    }

    /// Runs the loop of the process's device, which ends and begins with it.
    fn device(&mut self, process: usize) -> Result<(), String> {
        if process == self.malicious() {
            return Ok(());
        }
        let device = match &mut self.nodes[process].device {
            Some(device) => device,
            none => none.insert(DeviceLoop::new(&self.model, process, self.now)?),
        };
        let state = self.processes.take_device(process, self.now);
        self.felt.add(device.run(&self.model, self.now, state)?);
        Ok(())
    }

    /// What the thread of a process's network does: it sends what has waited, and receives.
    fn transfer(&mut self, process: usize, stalled: Stalled) {
        if stalled.network {
            return;
        }
        let most = if stalled.app { WAITING } else { usize::MAX };
        for index in 0..self.wires.len() {
            for at in 0..2 {
                if self.wires[index].sides[at].process != process {
                    continue;
                }
                while let Some((channel, packet)) = self.wires[index].sides[at].sent.pop() {
                    self.put((index, at), channel, packet);
                }
                if self.wires[index].sides[at].closed {
                    continue;
                }
                let parted = self.is_parted(process, self.wires[index].sides[1 - at].process);
                let [a, b] = &mut self.wires[index].sides;
                let (side, other) = if at == 0 { (a, b) } else { (b, a) };
                while let Some(packet) = (!parted).then(|| other.links[1].poll(self.now)).flatten() {
                    side.received.push(Channel::Message, packet, most);
                }
                while let Some(packet) = other.links[0].poll(self.now) {
                    if !parted {
                        side.received.push(Channel::Datagram, packet, most);
                    }
                }
            }
        }
    }

    fn read(&mut self, process: usize) {
        let own = self.now + self.nodes[process].ahead;
        let node = &mut self.nodes[process];
        for (index, wire) in self.wires.iter_mut().enumerate() {
            let peer = PeerId(index as u64);
            for side in wire.sides.iter_mut().filter(|side| side.process == process && !side.closed) {
                while let Some((_, packet)) = side.received.pop() {
                    let Some(session) = node.session.as_mut().filter(|_| side.life == node.life) else {
                        continue;
                    };
                    if !side.open && matches!(packet, Packet::Message(_)) {
                        side.open = session.accept(own, peer, 1200).is_ok();
                    }
                    match packet {
                        Packet::Datagram(bytes) => session.on_datagram(own, peer, &bytes),
                        Packet::Message(bytes) => session.on_message(own, peer, &bytes),
                        Packet::Close => session.disconnect(peer, DisconnectReason::Lost),
                    }
                }
            }
        }
    }

    /// The hand moves, and the session steps.
    fn work(&mut self, process: usize) {
        let own = self.now + self.nodes[process].ahead;
        let (vertex, mut target) = hand(&self.model, process, self.now);
        let malicious = number(self.malicious());
        let node = &mut self.nodes[process];
        let Some(session) = &mut node.session else { return };
        if let Some(device) = &node.device {
            target = device.tool(target);
        }
        match node.grab {
            None => node.grab = session.begin_grab(BODY, vertex, 0.12, target, hold()).ok(),
            Some(grab) => {
                let _ = session.set_target(grab, target);
            }
        }
        let stepped = session.update(own);
        self.ticks += stepped;
        let Some(body) = session.body(BODY).filter(|_| stepped > 0) else { return };
        let finite = body.visual().is_finite() && body.live().is_finite();
        self.digest.add_all(&body.visual().q);
        body.grabs().iter().for_each(|grab| self.digest.add_all(&grab.reaction));
        let honest = body.grabs().iter().filter(|grab| grab.key.user != malicious);
        let force = honest.map(|grab| norm(grab.reaction)).fold(0.0, f64::max);
        let hands = body.grabs().len();
        if let Some(device) = &mut node.device {
            let key = node.grab.map(|grab| GrabKey { user: number(process), grab });
            let own = body.grabs().iter().find(|grab| Some(grab.key) == key);
            device.publish(own.map(|own| (own.target, own.reaction)), 1.0 / 40.0);
        }
        let confirmed = session.confirmed();
        if let Some(state) = session.state_at(BODY, confirmed) {
            let size = apart(&state.q, &vec![0.0; state.q.len()]);
            node.size = node.size.max(size);
            node.finals.retain(|(tick, _)| *tick < confirmed);
            node.finals.push_back((confirmed, state.q.clone()));
            if node.finals.len() > 128 {
                node.finals.pop_front();
            }
        }
        let most = 16 * self.nodes.len();
        self.ensure(finite, || format!("process {process} shows what is not finite"));
        self.ensure(force <= MAX_FORCE, || format!("process {process} is told of {force} N"));
        self.ensure(hands <= most, || format!("process {process} has {hands} hands"));
    }

    fn events(&mut self, process: usize) {
        let malicious = self.malicious();
        while let Some(event) = self.nodes[process].session.as_mut().and_then(PeerSession::poll_event) {
            match event {
                PeerEvent::JoinRequest { peer } => {
                    let index = usize::try_from(peer.0).unwrap_or(usize::MAX);
                    let Some(wire) = self.wires.get(index) else { continue };
                    let asks = wire.sides.iter().map(|side| side.process).find(|other| *other != process);
                    let asks = asks.unwrap_or(process);
                    let others: Vec<(UserId, String)> = (0..self.nodes.len())
                        .filter(|other| *other != process && *other != asks)
                        .filter(|other| self.is_there(process, *other))
                        .map(|other| (number(other), String::new()))
                        .collect();
                    let Some(session) = &mut self.nodes[process].session else { continue };
                    if session.welcome(peer, number(asks), &others).is_err() {
                        // Its old connection is not yet noticed to be gone. It tries again.
                        session.disconnect(peer, DisconnectReason::Full);
                    }
                }
                PeerEvent::Welcomed { others, .. } => {
                    self.nodes[process].join = None;
                    for (user, _) in others {
                        let at = self.now;
                        self.nodes[process].missed.insert(process_of(user), at);
                    }
                }
                PeerEvent::Joined { user, .. } => {
                    // Its app keeps the numbers of all.
                    self.processes.write(process, self.now);
                    self.nodes[process].missed.remove(&process_of(user));
                    let others: Vec<(UserId, String)> = (0..self.nodes.len())
                        .filter(|other| *other != process && self.is_there(process, *other))
                        .map(|other| (number(other), String::new()))
                        .collect();
                    let Some(session) = &mut self.nodes[process].session else { continue };
                    let told = session.introduce(&others);
                    self.ensure(told.is_ok(), || format!("process {process} tells nobody: {told:?}"));
                }
                PeerEvent::Introduced { others, .. } => {
                    // A liar may tell of anybody.
                    let real = others.into_iter().map(|(user, _)| process_of(user));
                    for other in real.filter(|other| *other < process) {
                        let at = self.now;
                        self.nodes[process].missed.entry(other).or_insert(at);
                    }
                }
                PeerEvent::Left { user, reason } => {
                    let other = process_of(user);
                    use DisconnectReason::{Full, Lost, NumberTaken, Silent};
                    let lost = matches!(reason, Silent | Lost | Full | NumberTaken);
                    let honest = process != malicious && other != malicious;
                    self.ensure(lost || !honest, || {
                        format!("process {other} sends {process} away: {reason}")
                    });
                    // The one with the higher number calls.
                    if lost && other < process && other < self.nodes.len() {
                        let at = self.now + Duration::from_millis(self.random.range(500, 1500));
                        self.nodes[process].missed.insert(other, at);
                    }
                }
                _ => {}
            }
        }
    }

    /// Returns whether a process is in session with another.
    fn is_there(&self, process: usize, other: usize) -> bool {
        let Some(session) = &self.nodes[process].session else { return false };
        (0..self.wires.len()).any(|wire| session.user_of(PeerId(wire as u64)) == Some(number(other)))
    }

    fn send(&mut self, process: usize) {
        let malicious = process == self.malicious();
        self.mischief.now = self.processes.attack(self.now);
        let mut out: Vec<(usize, Packet)> = Vec::new();
        let node = &mut self.nodes[process];
        let Some(session) = &mut node.session else { return };
        while let Some(Output { peer, channel, bytes }) = session.poll_output() {
            let index = usize::try_from(peer.0).unwrap_or(usize::MAX);
            if malicious {
                self.mischief.keep(&mut self.random, channel, &bytes);
            }
            out.push((index, packet(channel, bytes.to_vec())));
        }
        for (index, wire) in self.wires.iter_mut().enumerate() {
            for side in wire.sides.iter_mut().filter(|side| side.process == process && !side.closed) {
                if side.open && side.life == node.life && session.stats(PeerId(index as u64)).is_none() {
                    out.push((index, Packet::Close));
                } else if malicious && side.open {
                    let lies = self.mischief.packets(&mut self.random);
                    if let Some(kind) = self.mischief.now.filter(|_| !lies.is_empty()) {
                        self.processes.take(process, &[kind], self.now);
                    }
                    out.extend(lies.into_iter().map(|(channel, bytes)| (index, packet(channel, bytes))));
                }
            }
        }
        let now = self.now;
        let stalled = self.processes.stalled(process, now).network;
        for (index, packet) in out {
            let Some(wire) = self.wires.get_mut(index) else { continue };
            let at = usize::from(wire.sides[0].process != process);
            let other = wire.sides[1 - at].process;
            // Something is sent, which a partition or a bad network meets.
            for end in [process, other] {
                self.processes.take(end, &[FaultKind::Partition, FaultKind::BadNetwork], now);
            }
            wire.sides[at].closed |= matches!(packet, Packet::Close);
            let channel =
                if matches!(packet, Packet::Datagram(_)) { Channel::Datagram } else { Channel::Message };
            if stalled {
                wire.sides[at].sent.push(channel, packet, WAITING);
            } else {
                self.put((index, at), channel, packet);
            }
        }
    }

    /// Sends from one side of a connection.
    fn put(&mut self, (index, at): (usize, usize), channel: Channel, packet: Packet) {
        let now = self.now;
        let sides = &mut self.wires[index].sides;
        let bad = sides.iter().any(|side| self.processes.is_disturbed(side.process, now));
        let link = &mut sides[at].links[usize::from(channel == Channel::Message)];
        let path = if bad { disturbed(&self.path) } else { self.path.clone() };
        let path = LinkConfig { delay: link.config().delay, ..path };
        if channel == Channel::Datagram && *link.config() != path {
            let _ = link.reconfigure(path);
        }
        let size = match &packet {
            Packet::Datagram(bytes) | Packet::Message(bytes) => bytes.len(),
            Packet::Close => 0,
        };
        link.send(now, packet, size);
    }

    /// Calls those who are missed, and somebody to join by.
    fn look_for(&mut self, process: usize) {
        let now = self.now;
        if let Some(at) = self.nodes[process].join.filter(|at| *at <= now) {
            let next = at.max(now) + Duration::from_millis(self.random.range(700, 1500));
            self.nodes[process].join = Some(next);
            let others: Vec<usize> = (0..self.malicious()).filter(|other| *other != process).collect();
            let other = others[self.random.index(others.len())];
            // An earlier attempt is given up.
            self.nodes[process].session = self.session(UserId::HOST, false).ok();
            self.nodes[process].life += 1;
            self.nodes[process].grab = None;
            self.dial(process, other, None);
            self.send(process);
        }
        let due: Vec<usize> = self.nodes[process]
            .missed
            .iter()
            .filter(|(_, at)| **at <= now)
            .map(|(other, _)| *other)
            .collect();
        for other in due {
            let at = now + Duration::from_millis(self.random.range(700, 1500));
            self.nodes[process].missed.insert(other, at);
            if self.is_there(process, other) {
                self.nodes[process].missed.remove(&other);
                continue;
            }
            self.dial(process, other, Some(number(other)));
        }
    }

    /// Checks that all have found back to each other, and have one state.
    fn agree(&mut self) {
        let honest = 0..self.malicious();
        for process in honest.clone() {
            for other in honest.clone().filter(|other| *other != process) {
                let there = self.is_there(process, other);
                self.ensure(there, || format!("process {process} has lost {other}"));
            }
        }
        if self.broken.is_some() {
            return;
        }
        let ticks = |node: &Node| node.session.as_ref().map(|s| (s.tick(), s.confirmed()));
        let all: Vec<(u64, u64)> = self.nodes[honest.clone()].iter().filter_map(ticks).collect();
        let newest = all.iter().map(|t| t.0).max().unwrap_or(0);
        for (process, (tick, last)) in all.iter().enumerate() {
            self.ensure(tick + NEAR > newest, || format!("process {process} is at tick {tick} of {newest}"));
            self.ensure(last + NEAR > *tick, || {
                format!("process {process} knows all up to {last} of {tick}")
            });
        }
        let size = self.nodes.iter().map(|node| node.size).fold(0.0, f64::max);
        for process in honest.skip(1) {
            let (first, own) = (&self.nodes[0].finals, &self.nodes[process].finals);
            let both = own.iter().rev().find_map(|(tick, q)| {
                let of_first = first.iter().find(|(t, _)| t == tick)?;
                Some((*tick, apart(&of_first.1, q)))
            });
            let Some((tick, off)) = both else {
                return self.ensure(false, || format!("processes 0 and {process} have no tick in common"));
            };
            let off = off / size;
            self.ensure(off <= AGREES, || {
                format!("processes 0 and {process} differ by {:.2} % at tick {tick}", 100.0 * off)
            });
        }
    }
}

fn packet(channel: Channel, bytes: Vec<u8>) -> Packet {
    match channel {
        Channel::Datagram => Packet::Datagram(bytes),
        Channel::Message => Packet::Message(bytes),
    }
}
