//! A mesh of peers under faults.

mod process;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use pliant_modal::ModalModel;
use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss};
use pliant_stream::peer::{PeerSession, PeerSessionConfig};
use pliant_stream::{BodyId, Channel, PeerId, StepSettings, UserId};

use super::attack::Attacker;
use super::device::{DeviceLoop, DeviceRecord};
use super::schedule::Random;
use super::state::{Processes, network};
use super::{
    AGREES, Digest, END, FaultKind, HEALED, IDLE, LOOK, MAX_MEMORY, Memory, Outcome, SimulatedFault, apart,
};
use crate::pair::Waiting;

const BODY: BodyId = BodyId(1);
/// Ticks that may lie between two peers, or between a peer and its newest final tick, at the end.
const NEAR: u64 = 60;

/// What crosses a connection.
#[derive(Debug, Clone)]
enum Packet {
    Datagram(Vec<u8>),
    Message(Vec<u8>),
    /// The transport notifies the other side that the connection is closed.
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
    /// Until then, what is sent comes late.
    late_until: Duration,
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
    attacker: Attacker,
    path: LinkConfig,
    random: Random,
    now: Duration,
    ticks: u64,
    device_record: DeviceRecord,
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
        attacker: Attacker::default(),
        path,
        random: Random::new(!seed ^ random.next()),
        now: Duration::ZERO,
        ticks: 0,
        device_record: DeviceRecord::default(),
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
            // The malicious peer leaves at the end: where only some have kicked it, they differ
            // from the others for as long as it is in the session.
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
        device_record: mesh.device_record,
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

    /// The same over a path that is slower by so much, for as long: what a call begins with comes
    /// late, and what follows does not.
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
        self.wires.push(Wire { sides, late_until: self.now + slower });
        self.ensure(connected.is_ok(), || format!("process {from} cannot connect: {connected:?}"));
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
