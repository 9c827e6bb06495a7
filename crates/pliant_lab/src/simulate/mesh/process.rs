//! A turn of a peer's process: its network, its app and its device.

use std::time::Duration;

use pliant_stream::emulator::LinkConfig;
use pliant_stream::peer::{PeerEvent, PeerSession};
use pliant_stream::{Channel, DisconnectReason, GrabKey, Output, PeerId, UserId};

use super::{BODY, Mesh, Packet, number, packet, process_of};
use crate::pair::{Stalled, WAITING};
use crate::simulate::device::DeviceLoop;
use crate::simulate::state::disturbed;
use crate::simulate::{FaultKind, MAX_FORCE, apart, hand, hold, norm};

impl Mesh {
    /// One look of a process: it reads, steps and sends.
    pub(super) fn turn(&mut self, process: usize) -> Result<(), String> {
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

    fn is_partitioned(&self, a: usize, b: usize) -> bool {
        self.processes.is_partitioned(a, self.now) || self.processes.is_partitioned(b, self.now)
    }

    /// Runs the loop of the process's device, which ends and begins with it.
    pub(super) fn device(&mut self, process: usize) -> Result<(), String> {
        if process == self.malicious() {
            return Ok(());
        }
        let device = match &mut self.nodes[process].device {
            Some(device) => device,
            none => none.insert(DeviceLoop::new(&self.model, process, self.now)?),
        };
        let state = self.processes.take_device(process, self.now);
        self.device_record.add(device.run(&self.model, self.now, state)?);
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
                let partitioned = self.is_partitioned(process, self.wires[index].sides[1 - at].process);
                let [a, b] = &mut self.wires[index].sides;
                let (side, other) = if at == 0 { (a, b) } else { (b, a) };
                while let Some(packet) = (!partitioned).then(|| other.links[1].poll(self.now)).flatten() {
                    side.received.push(Channel::Message, packet, most);
                }
                while let Some(packet) = other.links[0].poll(self.now) {
                    if !partitioned {
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
        self.ensure(force <= MAX_FORCE, || format!("process {process} displays {force} N"));
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
                    let sent = session.introduce(&others);
                    self.ensure(sent.is_ok(), || format!("process {process} introduces nobody: {sent:?}"));
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
    pub(super) fn is_there(&self, process: usize, other: usize) -> bool {
        let Some(session) = &self.nodes[process].session else { return false };
        (0..self.wires.len()).any(|wire| session.user_of(PeerId(wire as u64)) == Some(number(other)))
    }

    pub(super) fn send(&mut self, process: usize) {
        let malicious = process == self.malicious();
        self.attacker.now = self.processes.attack(self.now);
        let mut out: Vec<(usize, Packet)> = Vec::new();
        let node = &mut self.nodes[process];
        let Some(session) = &mut node.session else { return };
        while let Some(Output { peer, channel, bytes }) = session.poll_output() {
            let index = usize::try_from(peer.0).unwrap_or(usize::MAX);
            if malicious {
                self.attacker.keep(&mut self.random, channel, &bytes);
            }
            out.push((index, packet(channel, bytes.to_vec())));
        }
        for (index, wire) in self.wires.iter_mut().enumerate() {
            for side in wire.sides.iter_mut().filter(|side| side.process == process && !side.closed) {
                if side.open && side.life == node.life && session.stats(PeerId(index as u64)).is_none() {
                    out.push((index, Packet::Close));
                } else if malicious && side.open {
                    let lies = self.attacker.packets(&mut self.random);
                    if let Some(kind) = self.attacker.now.filter(|_| !lies.is_empty()) {
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
        let wire = &mut self.wires[index];
        let (late, sides) = (now < wire.late_until, &mut wire.sides);
        let bad = sides.iter().any(|side| self.processes.is_disturbed(side.process, now));
        let link = &mut sides[at].links[usize::from(channel == Channel::Message)];
        let path = if bad { disturbed(&self.path) } else { self.path.clone() };
        if !late && link.config().delay != self.path.delay {
            let _ = link.reconfigure(LinkConfig { delay: self.path.delay, ..link.config().clone() });
        }
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
}
