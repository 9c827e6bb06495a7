//! A host and its guests joined by emulated links in virtual time, for tests, demos and
//! measurements.
//!
//! Nothing sleeps. Time jumps to the next event: a step of the host, an arrival or a guest's next
//! tick. A [`World`] is the caller's side: what a game does around a session.

use std::collections::VecDeque;
use std::time::Duration;

use pliant_stream::emulator::{EmulatedLink, LinkConfig, Loss};
use pliant_stream::{
    Channel, GuestEvent, GuestSession, GuestSessionConfig, HostEvent, HostSession, HostSessionConfig, Output,
    PeerId, StreamError,
};

/// The caller's side of the sessions. All methods except [`World::step`] have a default. Each time
/// is that of the process's own clock ([`Pair::jump_host`], [`Pair::jump_guest`]).
pub trait World {
    /// Runs the host's step: simulate, then [`HostSession::publish`] every body with this tick.
    fn step(&mut self, now: Duration, tick: u64, host: &mut HostSession);
    /// Handles an event of the host.
    fn host_event(&mut self, _now: Duration, _event: HostEvent, _host: &mut HostSession) {}
    /// Handles an event of a guest.
    fn guest_event(
        &mut self,
        _now: Duration,
        _guest: usize,
        _event: GuestEvent,
        _session: &mut GuestSession,
    ) {
    }
    /// Called after a guest's bodies took `stepped` ticks (0 for a wake-up without a tick).
    fn guest_stepped(&mut self, _now: Duration, _guest: usize, _stepped: u64, _session: &mut GuestSession) {}
    /// Called with what a guest sends.
    fn guest_sent(&mut self, _guest: usize, _channel: Channel, _bytes: &[u8]) {}
}

/// The two directions between the host and one guest.
#[derive(Debug, Clone, PartialEq)]
pub struct PathConfig {
    /// Host to guest.
    pub down: LinkConfig,
    /// Guest to host.
    pub up: LinkConfig,
    /// Largest size of a datagram, bytes.
    pub max_datagram: usize,
}

impl PathConfig {
    /// The same settings both ways, with datagrams of up to 1,200 bytes.
    pub fn symmetric(link: LinkConfig) -> Self {
        Self { down: link.clone(), up: link, max_datagram: 1200 }
    }
}

/// Datagrams that wait for a thread that stands still, as in a transport's queues. Of more, the
/// oldest are dropped.
pub(crate) const WAITING: usize = 64;

/// Which threads of a process stand still.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Stalled {
    /// The thread of the app's frames: nothing is handled or stepped, and what arrives waits.
    pub app: bool,
    /// The thread of the network: nothing is received or sent, and what the app sends waits.
    pub network: bool,
}

impl From<bool> for Stalled {
    /// All threads, or none.
    fn from(all: bool) -> Self {
        Self { app: all, network: all }
    }
}

/// What waits between two threads of a process.
#[derive(Debug)]
pub(crate) struct Waiting<T> {
    messages: VecDeque<T>,
    datagrams: VecDeque<T>,
}

impl<T> Default for Waiting<T> {
    fn default() -> Self {
        Self { messages: VecDeque::new(), datagrams: VecDeque::new() }
    }
}

impl<T> Waiting<T> {
    /// Of more than `most` datagrams, the oldest is dropped.
    pub(crate) fn push(&mut self, channel: Channel, packet: T, most: usize) {
        if channel == Channel::Message {
            return self.messages.push_back(packet);
        }
        if self.datagrams.len() >= most {
            self.datagrams.pop_front();
        }
        self.datagrams.push_back(packet);
    }

    /// Takes the oldest message, or the oldest datagram where there is no message.
    pub(crate) fn pop(&mut self) -> Option<(Channel, T)> {
        let message = self.messages.pop_front().map(|packet| (Channel::Message, packet));
        message.or_else(|| Some((Channel::Datagram, self.datagrams.pop_front()?)))
    }
}

/// One direction between the host and a guest.
#[derive(Debug)]
struct Direction {
    reliable: EmulatedLink,
    /// Sent by an app whose network stands still.
    sent: Waiting<Vec<u8>>,
    /// Received for an app that may stand still, with the times of arrival.
    received: Waiting<(Duration, Vec<u8>)>,
}

impl Direction {
    fn new(link: &LinkConfig, seed: u64) -> Self {
        let reliable = EmulatedLink::new(reliable(link), seed);
        Self { reliable, sent: Waiting::default(), received: Waiting::default() }
    }

    fn send(
        &mut self,
        datagrams: &mut EmulatedLink,
        from: Stalled,
        now: Duration,
        (channel, bytes): (Channel, Vec<u8>),
    ) {
        if from.network {
            return self.sent.push(channel, bytes, WAITING);
        }
        let link = if channel == Channel::Datagram { datagrams } else { &mut self.reliable };
        let size = bytes.len();
        link.send(now, bytes, size);
    }

    /// What the network's threads do: sends what has waited, and receives for the app `to`.
    fn pass(
        &mut self,
        datagrams: &mut EmulatedLink,
        [from, to]: [Stalled; 2],
        partitioned: bool,
        now: Duration,
    ) {
        while let Some(packet) = (!from.network).then(|| self.sent.pop()).flatten() {
            self.send(datagrams, from, now, packet);
        }
        if to.network {
            return;
        }
        // An app that runs reads at once.
        let most = if to.app { WAITING } else { usize::MAX };
        while let Some(bytes) = (!partitioned).then(|| self.reliable.poll(now)).flatten() {
            self.received.push(Channel::Message, (now, bytes), most);
        }
        while let Some(bytes) = datagrams.poll(now) {
            if !partitioned {
                self.received.push(Channel::Datagram, (now, bytes), most);
            }
        }
    }
}

/// The link for messages beside one for datagrams.
fn reliable(link: &LinkConfig) -> LinkConfig {
    LinkConfig {
        jitter: link.jitter
            + match link.loss {
                Loss::Random(p) => link.delay.mul_f64(3.0 * p.clamp(0.0, 0.9)),
                _ => Duration::ZERO,
            },
        keep_order: true,
        loss: Loss::None,
        reorder: 0.0,
        duplicate: 0.0,
        queue_bytes: usize::MAX,
        trace: None,
        ..link.clone()
    }
}

/// One guest and its links.
#[derive(Debug)]
pub struct GuestEnd {
    /// The session.
    pub session: GuestSession,
    /// Link for datagrams, host to guest.
    pub down: EmulatedLink,
    /// Link for datagrams, guest to host.
    pub up: EmulatedLink,
    to_guest: Direction,
    to_host: Direction,
    connected: bool,
    /// What this guest has sent before it was cut off still arrives.
    lingers: bool,
    stalled: Stalled,
    partitioned: bool,
    /// The host that this guest was connected to is gone.
    lost: bool,
    /// The guest's clock minus the virtual time.
    ahead: Duration,
}

/// A host and its guests in virtual time.
#[derive(Debug)]
pub struct Pair {
    /// The host's session.
    pub host: HostSession,
    /// The guests in the order in which they were added. Guest `k` is [`PeerId`] `k + 1` to the
    /// host.
    pub guests: Vec<GuestEnd>,
    now: Duration,
    step: Duration,
    next_step: Duration,
    tick: u64,
    paused: bool,
    stalled: Stalled,
    /// The host's clock minus the virtual time.
    ahead: Duration,
    clock: Option<fn() -> Duration>,
    spent: Duration,
}

impl Pair {
    /// Creates a host without guests. Its first step (tick 1) is one step away.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for settings out of range.
    pub fn new(config: HostSessionConfig) -> Result<Self, StreamError> {
        let step = Duration::from_secs_f64(config.newmark.h.clamp(1e-5, 1.0));
        let host = HostSession::new(config)?;
        Ok(Self {
            host,
            guests: Vec::new(),
            now: Duration::ZERO,
            step,
            next_step: step,
            tick: 0,
            paused: false,
            stalled: Stalled::default(),
            ahead: Duration::ZERO,
            clock: None,
            spent: Duration::ZERO,
        })
    }

    /// The current virtual time.
    pub fn now(&self) -> Duration {
        self.now
    }

    /// The host's last tick.
    pub fn tick(&self) -> u64 {
        self.tick
    }

    /// Starts to measure the guests' sessions with this clock: decoding, correcting and stepping.
    pub fn measure_guests(&mut self, clock: Option<fn() -> Duration>) {
        self.clock = clock;
        self.spent = Duration::ZERO;
    }

    /// Time spent in the guests' sessions since [`Pair::measure_guests`].
    pub fn guests_spent(&self) -> Duration {
        self.spent
    }

    /// Stops or continues the host's steps. A pause stops the tick numbers, and the host does not
    /// catch up on steps.
    pub fn pause(&mut self, paused: bool) {
        self.paused = paused;
        self.next_step = self.next_step.max(self.now);
    }

    /// Stalls or continues the host's process, or one thread of it. Afterwards the host catches up
    /// on a quarter of a second at most, like an app with Bevy's clock.
    pub fn stall_host(&mut self, stalled: impl Into<Stalled>) {
        self.stalled = stalled.into();
        self.next_step = self.next_step.max(self.now.saturating_sub(Duration::from_millis(250)));
    }

    /// Stalls or continues a guest's process, as [`Pair::stall_host`] does for the host.
    pub fn stall_guest(&mut self, guest: usize, stalled: impl Into<Stalled>) {
        if let Some(g) = self.guests.get_mut(guest) {
            g.stalled = stalled.into();
        }
    }

    /// Replaces the host by a new one, as when its process was killed and started again. Its ticks
    /// begin anew. Nothing passes from and to the guests of before, and they get no goodbye.
    pub fn restart_host(&mut self, host: HostSession) {
        self.host = host;
        self.tick = 0;
        self.next_step = self.now + self.step;
        self.guests.iter_mut().for_each(|g| g.lost = true);
    }

    /// Parts a guest from the host, or joins them again. Datagrams are lost meanwhile, and messages
    /// wait, since a transport sends them again.
    pub fn part(&mut self, guest: usize, partitioned: bool) {
        if let Some(g) = self.guests.get_mut(guest) {
            g.partitioned = partitioned;
        }
    }

    /// Sends bytes to the host over a guest's links, beside what its session sends.
    pub fn send_as(&mut self, guest: usize, channel: Channel, bytes: Vec<u8>) {
        let now = self.now;
        if let Some(g) = self.guests.get_mut(guest).filter(|g| g.connected) {
            g.to_host.send(&mut g.up, g.stalled, now, (channel, bytes));
        }
    }

    /// Lets the host's clock jump ahead.
    pub fn jump_host(&mut self, by: Duration) {
        self.ahead += by;
    }

    /// Lets a guest's clock jump ahead.
    pub fn jump_guest(&mut self, guest: usize, by: Duration) {
        if let Some(g) = self.guests.get_mut(guest) {
            g.ahead += by;
        }
    }

    /// Joins a guest over a path and returns its index. Reliable messages arrive in order after the
    /// path's delay plus a random delay that stands for resending lost packets.
    ///
    /// # Errors
    /// Returns the [`StreamError`] of [`GuestSession::new`] or [`HostSession::connect`].
    pub fn join(
        &mut self,
        config: GuestSessionConfig,
        path: PathConfig,
        seed: u64,
    ) -> Result<usize, StreamError> {
        self.join_with(config, path, seed, |_| {})
    }

    /// Joins a guest as [`Pair::join`] does, but calls `prepare` with the session before the
    /// session connects. `prepare` can add cached models.
    ///
    /// # Errors
    /// As [`Pair::join`].
    pub fn join_with(
        &mut self,
        config: GuestSessionConfig,
        path: PathConfig,
        seed: u64,
        prepare: impl FnOnce(&mut GuestSession),
    ) -> Result<usize, StreamError> {
        let index = self.guests.len();
        let peer = PeerId(index as u64 + 1);
        let mut session = GuestSession::new(config, path.max_datagram)?;
        prepare(&mut session);
        self.host.connect(self.now + self.ahead, peer, path.max_datagram)?;
        session.connect(self.now)?;
        self.guests.push(GuestEnd {
            session,
            to_guest: Direction::new(&path.down, seed ^ 0x5157),
            to_host: Direction::new(&path.up, seed ^ 0x7515),
            down: EmulatedLink::new(path.down, seed),
            up: EmulatedLink::new(path.up, seed ^ 0xFFFF_0000),
            connected: true,
            lingers: false,
            stalled: Stalled::default(),
            partitioned: false,
            lost: false,
            ahead: Duration::ZERO,
        });
        Ok(index)
    }

    /// Cuts off a guest without notice, as when a process is killed. Nothing passes after that.
    pub fn cut(&mut self, guest: usize) {
        if let Some(g) = self.guests.get_mut(guest) {
            (g.connected, g.lingers) = (false, false);
        }
    }

    /// Gives up a guest's attempt to join. What it has sent still arrives, and what is sent to it
    /// does not.
    pub fn abandon(&mut self, guest: usize) {
        self.cut(guest);
        self.guests.get_mut(guest).into_iter().for_each(|g| g.lingers = true);
    }

    /// Runs until the time `until`.
    pub fn run_until(&mut self, until: Duration, world: &mut dyn World) {
        loop {
            self.exchange(world);
            let Some(next) = self.next_time().filter(|t| *t <= until) else { break };
            self.now = self.now.max(next);
            if !self.paused && !self.stalled.app && self.now >= self.next_step {
                self.tick += 1;
                self.next_step += self.step;
                world.step(self.now + self.ahead, self.tick, &mut self.host);
            }
        }
        self.now = self.now.max(until);
    }

    fn next_time(&self) -> Option<Duration> {
        let steps = !self.paused && !self.stalled.app;
        let mut next = steps.then(|| self.next_step.max(self.now));
        let mut take = |t: Option<Duration>| {
            next = match (next, t) {
                (Some(a), Some(b)) => Some(a.min(b)),
                (a, b) => a.or(b),
            };
        };
        let host = self.host.next_wakeup().map(|t| t.saturating_sub(self.ahead));
        take(host.filter(|_| !self.stalled.app));
        for g in self.guests.iter().filter(|g| g.connected) {
            // What arrives at a network that stalls waits, and messages wait for the network.
            for (link, stalled) in [
                (&g.down, g.stalled.network),
                (&g.to_guest.reliable, g.stalled.network || g.partitioned),
                (&g.up, self.stalled.network),
                (&g.to_host.reliable, self.stalled.network || g.partitioned),
            ] {
                take(link.next_wakeup().filter(|_| !stalled));
            }
            if g.stalled.app {
                continue;
            }
            // Serving a wake-up does not change its time, so the next one must lie later to avoid
            // an endless loop.
            let later = self.now + Duration::from_micros(1);
            take(g.session.next_wakeup(self.now + g.ahead).map(|t| t.saturating_sub(g.ahead).max(later)));
        }
        next
    }

    /// Delivers everything that has arrived by now, and sends all output.
    fn exchange(&mut self, world: &mut dyn World) {
        let now = self.now;
        let host_now = now + self.ahead;
        for (index, g) in self.guests.iter_mut().enumerate() {
            let peer = PeerId(index as u64 + 1);
            g.to_host.pass(&mut g.up, [g.stalled, self.stalled], g.partitioned, now);
            g.to_guest.pass(&mut g.down, [self.stalled, g.stalled], g.partitioned, now);
            // Messages come first, so that a snapshot is handled before a frame of the same arrival
            // time.
            while let Some((channel, (at, bytes))) =
                (!self.stalled.app).then(|| g.to_host.received.pop()).flatten()
            {
                match channel {
                    _ if !(g.connected || g.lingers) || g.lost => {}
                    Channel::Message => self.host.on_message(host_now, peer, &bytes),
                    Channel::Datagram => self.host.on_datagram(at + self.ahead, peer, &bytes),
                }
            }
            if g.stalled.app {
                continue;
            }
            let began = self.clock.map(|c| c());
            while let Some((channel, (at, bytes))) = g.to_guest.received.pop() {
                match channel {
                    _ if !g.connected => {}
                    Channel::Message => g.session.on_message(now + g.ahead, &bytes),
                    Channel::Datagram => g.session.on_datagram(at + g.ahead, &bytes),
                }
            }
            if let (Some(clock), Some(began)) = (self.clock, began) {
                self.spent += clock().saturating_sub(began);
            }
        }
        if !self.stalled.app {
            self.host.update(host_now);
            while let Some(event) = self.host.poll_event() {
                world.host_event(host_now, event, &mut self.host);
            }
        }
        for (index, g) in self.guests.iter_mut().enumerate().filter(|(_, g)| g.connected && !g.stalled.app) {
            let own = now + g.ahead;
            let began = self.clock.map(|c| c());
            let stepped = g.session.update(own);
            if let (Some(clock), Some(began)) = (self.clock, began) {
                self.spent += clock().saturating_sub(began);
            }
            while let Some(event) = g.session.poll_event() {
                world.guest_event(own, index, event, &mut g.session);
            }
            world.guest_stepped(own, index, stepped, &mut g.session);
            // This update sends the targets that were just set.
            g.session.update(own);
            while let Some(Output { channel, bytes, .. }) = g.session.poll_output() {
                world.guest_sent(index, channel, &bytes);
                g.to_host.send(&mut g.up, g.stalled, now, (channel, bytes.to_vec()));
            }
        }
        while let Some(Output { peer, channel, bytes }) = self.host.poll_output() {
            let index = usize::try_from(peer.0.wrapping_sub(1)).unwrap_or(usize::MAX);
            let Some(g) = self.guests.get_mut(index) else { continue };
            g.to_guest.send(&mut g.down, self.stalled, now, (channel, bytes.to_vec()));
        }
    }
}
