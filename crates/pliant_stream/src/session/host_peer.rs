//! The host's state of one guest.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use super::budgets::{GuestBudgets, impulses_of_one};
use super::host_config::HostSessionConfig;
use super::host_rigids::rigid_budget;
use super::regulator::Regulator;
use super::{DisconnectReason, Output};
use crate::link::{Budget, Link, SharedBudgets, micros};
use crate::state::{BodyId, PeerId, RigidId, Role, Tick, UserId, UserInfo};
use crate::wire::{Clock, Datagram, HostMessage, StreamSubscription};

/// Largest number of grabs of one guest.
pub(crate) const MAX_GUEST_GRABS: usize = 16;
/// Largest number of queued resends for one guest.
const MAX_RESENDS: usize = 512;

/// Stage of a guest's join.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Standing {
    /// The guest is connected and has not sent a hello.
    Silent,
    /// The guest has sent a hello and waits for the application to accept it.
    Asking,
    /// The guest is in the session.
    Joined(UserId),
}

/// A model that is being sent.
#[derive(Debug, Clone)]
pub(crate) struct Transfer {
    pub(crate) hash: [u8; 32],
    pub(crate) bytes: Arc<[u8]>,
    pub(crate) offset: usize,
}

/// A grab as the guest announced it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AnnouncedGrab {
    pub(crate) body: BodyId,
    /// The newest input received.
    pub(crate) input: Option<u32>,
}

#[derive(Debug)]
pub(crate) struct GuestPeer {
    pub(crate) id: PeerId,
    pub(crate) link: Link,
    pub(crate) standing: Standing,
    pub(crate) name: String,
    pub(crate) role: Role,
    pub(crate) subscription: Option<StreamSubscription>,
    pub(crate) cached: BTreeSet<[u8; 32]>,
    pub(crate) transfers: VecDeque<Transfer>,
    /// Bodies that were announced to the guest.
    pub(crate) announced: BTreeSet<BodyId>,
    /// Bodies whose snapshot is due at their next tick.
    pub(crate) due: BTreeSet<BodyId>,
    /// Bodies whose snapshot was sent and whose frames are streamed.
    pub(crate) streaming: BTreeSet<BodyId>,
    /// Limits of the modes that are sent per body; 0 sends nothing. A body without an entry has no
    /// limit.
    pub(crate) interest: BTreeMap<BodyId, u16>,
    pub(crate) grabs: BTreeMap<u16, AnnouncedGrab>,
    pub(crate) resends: VecDeque<(Duration, BodyId, Tick)>,
    /// The last tick of each rigid body that was sent in a datagram.
    pub(crate) rigids: BTreeMap<RigidId, Tick>,
    /// Bytes of datagrams of rigid bodies.
    pub(crate) rigid_bytes: Budget,
    /// The last clock request: the guest's stamp, and the time at which it came at the earliest.
    ping: Option<(u64, Duration)>,
    /// Bytes of messages that the transport has accepted and not sent, as last reported.
    pub(crate) unsent: usize,
    /// What the guest may ask of the host. This outlives the connection.
    pub(crate) budgets: GuestBudgets,
    /// What is the guest's own of the budgets that all guests share.
    pub(crate) share: SharedBudgets,
    pub(crate) regulator: Regulator,
}

impl GuestPeer {
    pub(crate) fn new(id: PeerId, now: Duration, max_datagram: usize, config: &HostSessionConfig) -> Self {
        Self {
            id,
            link: Link::new(id, now, max_datagram),
            standing: Standing::Silent,
            name: String::new(),
            role: Role::Hold,
            subscription: None,
            cached: BTreeSet::new(),
            transfers: VecDeque::new(),
            announced: BTreeSet::new(),
            due: BTreeSet::new(),
            streaming: BTreeSet::new(),
            interest: BTreeMap::new(),
            grabs: BTreeMap::new(),
            resends: VecDeque::new(),
            rigids: BTreeMap::new(),
            rigid_bytes: rigid_budget(config.guest_rate),
            ping: None,
            unsent: 0,
            budgets: GuestBudgets::new(config.model_rate),
            share: SharedBudgets::of_one(now, impulses_of_one(now)),
            regulator: Regulator::default(),
        }
    }

    pub(crate) fn user(&self) -> Option<UserId> {
        match self.standing {
            Standing::Joined(user) => Some(user),
            Standing::Silent | Standing::Asking => None,
        }
    }

    /// Describes the guest to the others; `None` before it has joined.
    pub(crate) fn info(&self) -> Option<UserInfo> {
        Some(UserInfo { user: self.user()?, role: self.role, name: self.name.clone() })
    }

    /// Sends a frame that was encoded for several guests. Returns false when the frame is longer
    /// than the path carries.
    pub(crate) fn send_frame(&mut self, body: &[u8], out: &mut VecDeque<Output>) -> bool {
        if body.len() + 3 > self.link.max_datagram {
            return false;
        }
        self.link.send_datagram(|sequence| Datagram::wrap_frame(sequence, body), out);
        true
    }

    /// Takes a clock request that has come `at` a time, and the stamp of the guest's clock in it.
    pub(crate) fn take_ping(&mut self, at: Duration, t1: u64) {
        self.ping = Some((t1, at.saturating_sub(self.link.waited(at))));
    }

    /// When the clock request came that waits for the next update.
    pub(crate) fn asked_at(&self) -> Option<Duration> {
        self.ping.map(|(_, came)| came)
    }

    /// Answers the last clock request.
    pub(crate) fn send_pong(&mut self, now: Duration, out: &mut VecDeque<Output>) {
        let Some((t1, came)) = self.ping.take() else { return };
        let clock = Clock { t1, t2: micros(came), t3: micros(now), ..self.link.clock() };
        self.link.send_datagram(|sequence| Datagram::Pong(clock).encode(sequence), out);
    }

    pub(crate) fn send_message(&mut self, message: &HostMessage, out: &mut VecDeque<Output>) {
        self.link.send_message(message.encode(), out);
    }

    pub(crate) fn say_goodbye(&mut self, reason: DisconnectReason, out: &mut VecDeque<Output>) {
        self.send_message(&HostMessage::Goodbye { reason }, out);
    }

    /// Queues a resend in order of the due times, unless the same one is queued.
    pub(crate) fn queue_resend(&mut self, due: Duration, body: BodyId, tick: Tick) {
        let entry = (due, body, tick);
        if self.resends.len() < MAX_RESENDS && !self.resends.contains(&entry) {
            let at = self.resends.partition_point(|r| r.0 <= due);
            self.resends.insert(at, entry);
        }
    }
}
