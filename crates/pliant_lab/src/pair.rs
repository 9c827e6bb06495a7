//! A host and its guests joined by emulated links in virtual time, for tests, demos and
//! measurements.
//!
//! Nothing sleeps. Time jumps to the next event: a step of the host, an arrival or a guest's next
//! tick. A [`World`] is the caller's side: what a game does around a session.

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

/// One guest and its links.
#[derive(Debug)]
pub struct GuestEnd {
    /// The session.
    pub session: GuestSession,
    /// Link for datagrams, host to guest.
    pub down: EmulatedLink,
    /// Link for datagrams, guest to host.
    pub up: EmulatedLink,
    reliable_down: EmulatedLink,
    reliable_up: EmulatedLink,
    connected: bool,
    stalled: bool,
    parted: bool,
    /// The host that this guest was connected to is gone.
    lost: bool,
    /// The guest's clock minus the virtual time.
    ahead: Duration,
}

impl GuestEnd {
    fn send(&mut self, now: Duration, channel: Channel, bytes: Vec<u8>) {
        let link = match channel {
            Channel::Datagram => &mut self.up,
            Channel::Message => &mut self.reliable_up,
        };
        let size = bytes.len();
        link.send(now, bytes, size);
    }
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
    stalled: bool,
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
            stalled: false,
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

    /// Stalls or continues the host's process: nothing is read, stepped or sent. What arrives
    /// waits. Afterwards the host catches up on a quarter of a second at most, like an app with
    /// Bevy's clock.
    pub fn stall_host(&mut self, stalled: bool) {
        self.stalled = stalled;
        self.next_step = self.next_step.max(self.now.saturating_sub(Duration::from_millis(250)));
    }

    /// Stalls or continues a guest's process, as [`Pair::stall_host`] does for the host.
    pub fn stall_guest(&mut self, guest: usize, stalled: bool) {
        if let Some(g) = self.guests.get_mut(guest) {
            g.stalled = stalled;
        }
    }

    /// Replaces the host by a new one, as when its process was killed and started again. Its ticks
    /// begin anew. Nothing passes from and to the guests of before, and they are not told.
    pub fn restart_host(&mut self, host: HostSession) {
        self.host = host;
        self.tick = 0;
        self.next_step = self.now + self.step;
        self.guests.iter_mut().for_each(|g| g.lost = true);
    }

    /// Parts a guest from the host, or joins them again. Datagrams are lost meanwhile, and messages
    /// wait, since a transport sends them again.
    pub fn part(&mut self, guest: usize, parted: bool) {
        if let Some(g) = self.guests.get_mut(guest) {
            g.parted = parted;
        }
    }

    /// Sends bytes to the host over a guest's links, beside what its session sends.
    pub fn send_as(&mut self, guest: usize, channel: Channel, bytes: Vec<u8>) {
        let now = self.now;
        if let Some(g) = self.guests.get_mut(guest).filter(|g| g.connected) {
            g.send(now, channel, bytes);
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
        let reliable = |link: &LinkConfig| LinkConfig {
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
        };
        self.guests.push(GuestEnd {
            session,
            reliable_down: EmulatedLink::new(reliable(&path.down), seed ^ 0x5157),
            reliable_up: EmulatedLink::new(reliable(&path.up), seed ^ 0x7515),
            down: EmulatedLink::new(path.down, seed),
            up: EmulatedLink::new(path.up, seed ^ 0xFFFF_0000),
            connected: true,
            stalled: false,
            parted: false,
            lost: false,
            ahead: Duration::ZERO,
        });
        Ok(index)
    }

    /// Cuts off a guest without notice, as when a process is killed. Nothing passes after that.
    pub fn cut(&mut self, guest: usize) {
        if let Some(g) = self.guests.get_mut(guest) {
            g.connected = false;
        }
    }

    /// Runs until the time `until`.
    pub fn run_until(&mut self, until: Duration, world: &mut dyn World) {
        loop {
            self.exchange(world);
            let Some(next) = self.next_time().filter(|t| *t <= until) else { break };
            self.now = self.now.max(next);
            if !self.paused && !self.stalled && self.now >= self.next_step {
                self.tick += 1;
                self.next_step += self.step;
                world.step(self.now + self.ahead, self.tick, &mut self.host);
            }
        }
        self.now = self.now.max(until);
    }

    fn next_time(&self) -> Option<Duration> {
        let steps = !self.paused && !self.stalled;
        let mut next = steps.then(|| self.next_step.max(self.now));
        let mut take = |t: Option<Duration>| {
            next = match (next, t) {
                (Some(a), Some(b)) => Some(a.min(b)),
                (a, b) => a.or(b),
            };
        };
        let host = self.host.next_wakeup().map(|t| t.saturating_sub(self.ahead));
        take(host.filter(|_| !self.stalled));
        for g in self.guests.iter().filter(|g| g.connected) {
            // What arrives at a process that stalls waits, and messages wait for the network.
            for (link, stalled) in [
                (&g.down, g.stalled),
                (&g.reliable_down, g.stalled || g.parted),
                (&g.up, self.stalled),
                (&g.reliable_up, self.stalled || g.parted),
            ] {
                take(link.next_wakeup().filter(|_| !stalled));
            }
            if g.stalled {
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
            if !self.stalled {
                // Poll the reliable link first, so that a snapshot is handled before a frame of the
                // same arrival time.
                while let Some(bytes) = (!g.parted).then(|| g.reliable_up.poll(now)).flatten() {
                    if g.connected && !g.lost {
                        self.host.on_message(host_now, peer, &bytes);
                    }
                }
                while let Some(bytes) = g.up.poll(now) {
                    if g.connected && !g.lost && !g.parted {
                        self.host.on_datagram(host_now, peer, &bytes);
                    }
                }
            }
            if g.stalled {
                continue;
            }
            let began = self.clock.map(|c| c());
            while let Some(bytes) = (!g.parted).then(|| g.reliable_down.poll(now)).flatten() {
                if g.connected {
                    g.session.on_message(now + g.ahead, &bytes);
                }
            }
            while let Some(bytes) = g.down.poll(now) {
                if g.connected && !g.parted {
                    g.session.on_datagram(now + g.ahead, &bytes);
                }
            }
            if let (Some(clock), Some(began)) = (self.clock, began) {
                self.spent += clock().saturating_sub(began);
            }
        }
        if !self.stalled {
            self.host.update(host_now);
            while let Some(event) = self.host.poll_event() {
                world.host_event(host_now, event, &mut self.host);
            }
        }
        for (index, g) in self.guests.iter_mut().enumerate().filter(|(_, g)| g.connected && !g.stalled) {
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
                g.send(now, channel, bytes.to_vec());
            }
        }
        while let Some(Output { peer, channel, bytes }) = self.host.poll_output() {
            let index = usize::try_from(peer.0.wrapping_sub(1)).unwrap_or(usize::MAX);
            let Some(g) = self.guests.get_mut(index) else { continue };
            let link = match channel {
                Channel::Datagram => &mut g.down,
                Channel::Message => &mut g.reliable_down,
            };
            link.send(now, bytes.to_vec(), bytes.len());
        }
    }
}
