//! The rigid bodies of a session at the host.

use std::collections::BTreeMap;
use std::time::Duration;

use nalgebra::Vector3;

use super::host::HostSession;
use super::host_peer::GuestPeer;
use crate::StreamError;
use crate::link::Budget;
use crate::state::{PeerId, RigidId, RigidState, TICK_LIMIT, Tick};
use crate::wire::{
    Datagram, HostMessage, MAX_NAME, MAX_RIGID_ENTRIES, MAX_RIGIDS, RIGID_ENTRY, RIGID_HEADER, RigidPoses,
};

/// Way and turn within which a rigid body counts as still, m and rad. Physics engines let resting
/// bodies tremble by less.
const STILL: [f64; 2] = [1e-4, 2e-4];
/// Time after which a rigid body that is still rests. It doubles each time that one moves again
/// within `SOON`, up to the second one, so that what creeps is not told to rest again and again.
const REST_AFTER: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(4)];
const SOON: Duration = Duration::from_secs(2);
/// Share of a guest's rate that rigid bodies may take.
const SHARE: f64 = 0.5;

/// The bytes that rigid bodies may take of a guest's rate (bit/s).
pub(super) fn rigid_budget(guest_rate: f64) -> Budget {
    let rate = (SHARE / 8.0 * guest_rate).min(1e12);
    // A tenth of a second at once: where all of a crowd begin to move, no queue comes of it.
    Budget::new(rate, (0.1 * rate).clamp(2048.0, 65_536.0))
}

#[derive(Debug, Default)]
pub(super) struct HostRigids {
    all: BTreeMap<RigidId, HostRigid>,
    last: Tick,
}

#[derive(Debug)]
struct HostRigid {
    name: String,
    state: RigidState,
    /// Where the rigid body is taken to stand still, and since when.
    stands: RigidState,
    since: Option<Duration>,
    resting: bool,
    patience: Duration,
    /// The state of a tick that is being published.
    next: Option<RigidState>,
}

impl HostRigid {
    /// Takes the state after a tick. Returns true when the rigid body comes to rest with it.
    fn step(&mut self, now: Duration, state: RigidState) -> bool {
        self.state = state;
        let stood = now.saturating_sub(*self.since.get_or_insert(now));
        if !is_still(&self.stands, &state) {
            if self.resting {
                let soon = stood < self.patience + SOON;
                self.patience = if soon { REST_AFTER[1].min(2 * self.patience) } else { REST_AFTER[0] };
            }
            (self.stands, self.since, self.resting) = (state, Some(now), false);
        } else if !self.resting && stood >= self.patience {
            self.resting = true;
            // Guests stop where it stands, so that what is less than a step of `STILL` is not sent.
            self.stands = RigidState { linear: [0.0; 3], angular: [0.0; 3], ..state };
            return true;
        }
        false
    }
}

fn is_still(a: &RigidState, b: &RigidState) -> bool {
    let way = (Vector3::from(a.position) - Vector3::from(b.position)).norm();
    let turn = a.turn().zip(b.turn()).map_or(f64::INFINITY, |(a, b)| a.angle_to(&b));
    way <= STILL[0] && turn <= STILL[1]
}

impl HostSession {
    /// Adds a rigid body to the session, and announces it to the guests at once.
    ///
    /// The session shows rigid bodies and moves none. What they do is up to the caller, such as a
    /// physics engine of the game, and so is their shape.
    ///
    /// # Errors
    /// Returns [`StreamError::Full`] beyond 1,024 rigid bodies, [`StreamError::Config`] for a name
    /// over 64 bytes or a number in use, and [`StreamError::NotFinite`] for a state out of range.
    pub fn add_rigid(&mut self, rigid: RigidId, name: &str, state: RigidState) -> Result<(), StreamError> {
        if self.rigids.all.len() >= MAX_RIGIDS {
            return Err(StreamError::Full { what: "rigid bodies", limit: MAX_RIGIDS });
        }
        let fail = |what, found: String, expected| Err(StreamError::Config { what, found, expected });
        if name.len() > MAX_NAME {
            return fail("rigid body's name", name.to_owned(), "at most 64 bytes");
        }
        if self.rigids.all.contains_key(&rigid) {
            return fail("rigid body", rigid.to_string(), "a number that is not in use");
        }
        if !state.is_valid() {
            return Err(StreamError::NotFinite { what: "rigid body" });
        }
        let name = name.to_owned();
        let entry = HostRigid {
            name,
            state,
            stands: state,
            since: None,
            resting: false,
            patience: REST_AFTER[0],
            next: None,
        };
        let message = entry.added(rigid, self.rigids.last);
        self.rigids.all.insert(rigid, entry);
        for p in self.peers.values_mut().filter(|p| p.user().is_some()) {
            p.send_message(&message, &mut self.out);
        }
        Ok(())
    }

    /// Removes a rigid body from the session.
    pub fn remove_rigid(&mut self, rigid: RigidId) {
        if self.rigids.all.remove(&rigid).is_none() {
            return;
        }
        for p in self.peers.values_mut() {
            p.rigids.remove(&rigid);
            if p.user().is_some() {
                p.send_message(&HostMessage::RigidRemoved { rigid: rigid.0 }, &mut self.out);
            }
        }
    }

    /// Iterates over the rigid bodies, and whether each rests, so that nothing is sent of it.
    pub fn rigids(&self) -> impl Iterator<Item = (RigidId, bool)> {
        self.rigids.all.iter().map(|(&rigid, entry)| (rigid, entry.resting))
    }

    /// Streams where rigid bodies are after a step, to all guests. Those that are left out stand
    /// still from then on.
    ///
    /// Each tick tells the newest state of each rigid body that moves, and nothing is sent twice: a
    /// guest that misses a datagram goes on by the velocities. Where all do not fit into half of
    /// [`guest_rate`](super::HostSessionConfig::guest_rate), those whose last state is the oldest
    /// come first. What stays within 0.1 mm and 0.0002 rad for a quarter of a second rests: guests
    /// are told so reliably, and nothing more is sent of it until it has moved by more.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownRigid`] for an unknown rigid body, [`StreamError::TickOrder`]
    /// for a tick that does not ascend or is out of range, and [`StreamError::NotFinite`] for a
    /// state out of range. Nothing is sent in these cases.
    pub fn publish_rigids(
        &mut self,
        now: Duration,
        tick: Tick,
        states: &[(RigidId, RigidState)],
    ) -> Result<(), StreamError> {
        if tick <= self.rigids.last || tick >= TICK_LIMIT {
            return Err(StreamError::TickOrder { last: self.rigids.last, found: tick });
        }
        if let Some((unknown, _)) = states.iter().find(|(rigid, _)| !self.rigids.all.contains_key(rigid)) {
            return Err(StreamError::UnknownRigid(*unknown));
        }
        if !states.iter().all(|(_, state)| state.is_valid()) {
            return Err(StreamError::NotFinite { what: "rigid body" });
        }
        self.rigids.last = tick;
        let mut rest = Vec::new();
        let mut moving = Vec::new();
        for (rigid, state) in states {
            if let Some(entry) = self.rigids.all.get_mut(rigid) {
                entry.next = Some(*state);
            }
        }
        for (&rigid, entry) in &mut self.rigids.all {
            let left_out = RigidState { linear: [0.0; 3], angular: [0.0; 3], ..entry.state };
            let state = entry.next.take().unwrap_or(left_out);
            if entry.step(now, state) {
                rest.push((rigid.0, entry.stands));
            } else if !entry.resting {
                moving.push((rigid, state));
            }
        }
        let message = (!rest.is_empty()).then_some(HostMessage::RigidsRest { tick, rigids: rest });
        for p in self.peers.values_mut().filter(|p| p.user().is_some()) {
            if let Some(message) = &message {
                p.send_message(message, &mut self.out);
            }
            for poses in p.rigids_due(now, tick, &moving) {
                let datagram = Datagram::Rigids(RigidPoses { tick, poses });
                p.link.send_datagram(|sequence| datagram.encode(sequence), &mut self.out);
            }
        }
        Ok(())
    }

    /// Tells a guest that joins of all rigid bodies.
    pub(super) fn announce_rigids(&mut self, peer: PeerId) {
        let Some(p) = self.peers.get_mut(&peer) else { return };
        for (&rigid, entry) in &self.rigids.all {
            p.send_message(&entry.added(rigid, self.rigids.last), &mut self.out);
        }
        let resting = self.rigids.all.iter().filter(|(_, entry)| entry.resting);
        let rigids: Vec<_> = resting.map(|(rigid, entry)| (rigid.0, entry.stands)).collect();
        if !rigids.is_empty() {
            let tick = self.rigids.last;
            p.send_message(&HostMessage::RigidsRest { tick, rigids }, &mut self.out);
        }
    }
}

impl HostRigid {
    fn added(&self, rigid: RigidId, tick: Tick) -> HostMessage {
        HostMessage::RigidAdded { rigid: rigid.0, name: self.name.clone(), tick, state: self.state }
    }
}

impl GuestPeer {
    /// Chooses what a guest is told of the rigid bodies that move, one list for each datagram.
    fn rigids_due(
        &mut self,
        now: Duration,
        tick: Tick,
        moving: &[(RigidId, RigidState)],
    ) -> Vec<Vec<(RigidId, RigidState)>> {
        let room = self.link.max_datagram.saturating_sub(RIGID_HEADER) / RIGID_ENTRY;
        let room = room.min(MAX_RIGID_ENTRIES);
        // On a path that is congested, each level doubles the price of a byte.
        let price = f64::from(1_u32 << self.regulator.level().min(16));
        let bytes = |count: usize| price * (RIGID_HEADER + count * RIGID_ENTRY) as f64;
        let mut due: Vec<usize> = (0..moving.len()).collect();
        let datagrams = moving.len().div_ceil(room.max(1)) as f64;
        let all = price * (datagrams * RIGID_HEADER as f64 + (moving.len() * RIGID_ENTRY) as f64);
        if !self.rigid_bytes.has(now, all) {
            // Those that a guest knows the least of come first.
            due.sort_by_cached_key(|&at| self.rigids.get(&moving[at].0).copied().unwrap_or(0));
        }
        let mut sent: Vec<Vec<(RigidId, RigidState)>> = Vec::new();
        let mut due = &due[..];
        while room > 0 && !due.is_empty() {
            let mut count = due.len().min(room);
            while count > 1 && !self.rigid_bytes.has(now, bytes(count)) {
                count -= 1;
            }
            // The first may cost more than there is, so that something is told on any path.
            let paid = self.rigid_bytes.spend(now, bytes(count))
                || (sent.is_empty() && count == 1 && self.rigid_bytes.spend_or_owe(now, bytes(1)));
            if !paid {
                break;
            }
            let (these, rest) = due.split_at(count);
            let these: Vec<_> = these.iter().map(|&at| moving[at]).collect();
            self.rigids.extend(these.iter().map(|(rigid, _)| (*rigid, tick)));
            sent.push(these);
            due = rest;
        }
        sent
    }
}
