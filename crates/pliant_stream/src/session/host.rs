//! The host's side of a session: streams the bodies to all guests.

mod receive;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use pliant_modal::{ModalModel, StepSettings};

use super::budgets::{GuestBudgets, impulses_of_all};
use super::host_config::{HostEvent, HostSessionConfig};
use super::host_peer::{GuestPeer, Standing};
use super::host_rigids::HostRigids;
use super::upload::Upload;
use super::{DisconnectReason, LinkStats, MIN_DATAGRAM, Output};
use crate::codec::encoder::Encoder;
use crate::link::{AwayBudgets, Events, SharedBudgets};
use crate::newmark::Newmark;
use crate::state::{
    BodyId, GrabKey, PeerId, Placement, Role, Tick, UserId, UserInfo, UserLinkInfo, next_free,
};
use crate::wire::{BodyInfo, HostMessage, MAX_NAME, PROTOCOL_VERSION, StreamSubscription};
use crate::{StreamError, Surroundings};

/// Encoders of a body that are kept while nobody receives their stream. A guest that changes its
/// subscription again and again costs no new one each time, with the patches of all hands.
const SPARE_ENCODERS: usize = 8;

/// Key of an encoder: the subscription and the datagram size in bytes.
pub(super) type StreamKey = (StreamSubscription, usize);

#[derive(Debug)]
pub(super) struct HostBody {
    pub(super) id: BodyId,
    pub(super) name: String,
    pub(super) model: Arc<ModalModel>,
    pub(super) bytes: Arc<[u8]>,
    pub(super) hash: [u8; 32],
    pub(super) settings: StepSettings,
    pub(super) placement: Option<Placement>,
    pub(super) around: Surroundings,
    pub(super) last: Option<Tick>,
    pub(super) resting: bool,
    /// The visible amplitudes of the modes, for the encoders.
    pub(super) visible: OnceLock<Vec<f64>>,
    /// One encoder per subscription and datagram size, with some that nobody receives any more.
    pub(super) streams: BTreeMap<StreamKey, Encoder>,
}

impl HostBody {
    /// Retires the encoders of all streams but those in `keys`, and drops those that have been
    /// retired for longest.
    pub(super) fn retire_streams(&mut self, keys: &BTreeSet<StreamKey>) {
        let mut spare: Vec<(Tick, StreamKey)> = Vec::new();
        for (key, encoder) in self.streams.iter_mut().filter(|(key, _)| !keys.contains(key)) {
            encoder.retire();
            spare.push((encoder.last(), *key));
        }
        spare.sort_unstable();
        for (_, key) in spare.iter().rev().skip(SPARE_ENCODERS) {
            self.streams.remove(key);
        }
    }

    /// Describes the body to a guest; `None` before the guest has sent its subscription.
    pub(super) fn info(&self, guest: &GuestPeer) -> Option<BodyInfo> {
        let subscription = self.subscribed(guest.subscription?);
        Some(BodyInfo {
            body: self.id.0,
            name: self.name.clone(),
            hash: self.hash,
            modes: Encoder::modes_for(&subscription, self.model.mode_count(), guest.link.max_datagram) as u16,
            settings: self.settings,
            around: self.around.clone(),
        })
    }

    /// Returns what a subscription means for this body.
    ///
    /// Of a body with reduced elasticity a stream has all modes, because without those that shorten
    /// it a body hardly bends. Who asks for fewer gets them refreshed more rarely. A stream of
    /// accelerations, which has all of them in each frame, then has as many bytes as without.
    fn subscribed(&self, mut subscription: StreamSubscription) -> StreamSubscription {
        let modes = self.model.mode_count().min(usize::from(u16::MAX)) as u16;
        if self.settings.is_reduced(&self.model) && subscription.modes < modes {
            let times = modes.div_ceil(subscription.modes.max(1)).min(255) as u8;
            subscription.refresh = subscription.refresh.saturating_mul(times);
            subscription.modes = modes;
        }
        subscription
    }
}

/// The host of a session: a state machine without sockets or clock; see [`super`].
#[derive(Debug)]
pub struct HostSession {
    pub(super) config: HostSessionConfig,
    /// The user at the host, if there is one.
    host_user: Option<UserInfo>,
    pub(super) peers: BTreeMap<PeerId, GuestPeer>,
    pub(super) bodies: BTreeMap<BodyId, HostBody>,
    pub(super) rigids: HostRigids,
    pub(super) out: VecDeque<Output>,
    events: Events<HostEvent>,
    next_user: u16,
    pub(super) upload: Upload,
    pub(super) encoded: u64,
    pub(super) encoders_made: u64,
    /// What all guests together may cost the host.
    shared: SharedBudgets,
    /// Work for the app since it was last asked for, vertices of new patches.
    work: usize,
    /// Budgets of the users that are away.
    away: AwayBudgets<GuestBudgets>,
    /// Counts of the connections that have ended.
    gone: LinkStats,
}

impl HostSession {
    /// Creates a session without bodies or guests.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a setting out of range.
    pub fn new(config: HostSessionConfig) -> Result<Self, StreamError> {
        config.newmark.check()?;
        let upload = Upload::new(&config)?;
        if config.guest_rate.is_nan() || config.guest_rate < 1.0 {
            return Err(StreamError::Config {
                what: "guest_rate",
                found: config.guest_rate.to_string(),
                expected: "at least 1 bit a second",
            });
        }
        Ok(Self {
            config,
            host_user: None,
            peers: BTreeMap::new(),
            bodies: BTreeMap::new(),
            rigids: HostRigids::default(),
            out: VecDeque::new(),
            events: Events::default(),
            next_user: 1,
            upload,
            encoded: 0,
            encoders_made: 0,
            shared: SharedBudgets::of_all(impulses_of_all()),
            work: 0,
            away: AwayBudgets::default(),
            gone: LinkStats::default(),
        })
    }

    /// The settings.
    pub fn config(&self) -> &HostSessionConfig {
        &self.config
    }

    /// Sets the name of the user at the host, whom guests see as [`UserId::HOST`]. Without a call
    /// there is no such user. Guests that have joined before the call do not learn of it.
    ///
    /// # Errors
    /// Returns [`StreamError::Config`] for a name over 64 bytes.
    pub fn set_host_user(&mut self, name: &str) -> Result<(), StreamError> {
        if name.len() > MAX_NAME {
            let (what, found) = ("name", name.to_owned());
            return Err(StreamError::Config { what, found, expected: "at most 64 bytes" });
        }
        self.host_user = Some(UserInfo { user: UserId::HOST, role: Role::Hold, name: name.to_owned() });
        Ok(())
    }

    /// Adds a connection whose datagrams carry at most `max_datagram` bytes.
    ///
    /// When there is no room, the oldest connection without a hello is removed to make room.
    ///
    /// # Errors
    /// Returns [`StreamError::Full`] when there is no room. The caller then closes the connection.
    pub fn connect(&mut self, now: Duration, peer: PeerId, max_datagram: usize) -> Result<(), StreamError> {
        if self.peers.len() >= self.config.max_guests
            && let Some(silent) = self.peers.values().find(|p| p.standing == Standing::Silent).map(|p| p.id)
        {
            self.drop_peer(silent, DisconnectReason::Silent, true);
        }
        if self.peers.len() >= self.config.max_guests {
            return Err(StreamError::Full { what: "guests", limit: self.config.max_guests });
        }
        self.peers.insert(peer, GuestPeer::new(peer, now, max_datagram, &self.config));
        Ok(())
    }

    /// Removes a connection that the transport closed.
    pub fn disconnect(&mut self, peer: PeerId, reason: DisconnectReason) {
        self.drop_peer(peer, reason, false);
    }

    /// Ends a guest's session and sends the reason to the guest.
    pub fn kick(&mut self, peer: PeerId, reason: DisconnectReason) {
        self.drop_peer(peer, reason, true);
    }

    /// Sets a new datagram size of a guest's path.
    pub fn set_max_datagram(&mut self, peer: PeerId, bytes: usize) {
        let Some(p) = self.peers.get_mut(&peer) else { return };
        if p.link.max_datagram == bytes {
            return;
        }
        p.link.max_datagram = bytes;
        // A new size means another encoder, whose receivers start from a snapshot.
        let streaming = std::mem::take(&mut p.streaming);
        p.due.extend(streaming);
        if bytes < MIN_DATAGRAM && p.user().is_some() {
            self.drop_peer(peer, DisconnectReason::SmallDatagrams, true);
        }
    }

    /// Accepts a guest that has asked to join.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownPeer`] for an unknown connection and [`StreamError::State`]
    /// when the guest has not asked to join.
    pub fn accept(&mut self, now: Duration, peer: PeerId) -> Result<UserId, StreamError> {
        self.accept_as(now, peer, None, Role::Hold)
    }

    /// Accepts a guest that has asked to join, under the number that it had `before`, in a role.
    /// The number is for a guest that reconnects. When it is in use, or is the host's own, the
    /// guest gets a new number. The grabs of a guest that may only watch are refused.
    ///
    /// # Errors
    /// Returns the errors of [`HostSession::accept`].
    pub fn accept_as(
        &mut self,
        now: Duration,
        peer: PeerId,
        before: Option<UserId>,
        role: Role,
    ) -> Result<UserId, StreamError> {
        let p = self.peers.get(&peer).ok_or(StreamError::UnknownPeer(peer))?;
        if p.standing != Standing::Asking {
            return Err(StreamError::State {
                what: "accept",
                state: "not asking",
                needed: "a peer that has asked to join",
            });
        }
        self.admit(now, peer, before, role);
        self.peers.get(&peer).and_then(GuestPeer::user).ok_or(StreamError::UnknownPeer(peer))
    }

    /// Refuses a guest that has asked to join.
    pub fn refuse(&mut self, peer: PeerId) {
        self.drop_peer(peer, DisconnectReason::Refused, true);
    }

    /// Refuses or ends a guest's grab and notifies the guest. No event follows.
    pub fn refuse_grab(&mut self, key: GrabKey) {
        for peer in self.peers.values_mut().filter(|p| p.user() == Some(key.user)) {
            if peer.grabs.remove(&key.grab).is_some() {
                peer.send_message(&HostMessage::GrabRefused { grab: key.grab }, &mut self.out);
            }
        }
    }

    /// Limits how many modes of a body a guest receives.
    ///
    /// The limit is rounded up to the next of 1, 2, 3, 4, 6, 8, 12 and so on, so that guests share
    /// encoders. It never raises what the guest subscribed to. With 0 the guest receives nothing of
    /// the body, and `None` removes the limit. A change starts with a snapshot. Returns false for
    /// an unknown guest, or a body that was not announced to the guest.
    pub fn set_interest(&mut self, peer: PeerId, body: BodyId, modes: Option<u16>) -> bool {
        let Some(p) = self.peers.get_mut(&peer).filter(|p| p.announced.contains(&body)) else { return false };
        let before = p.interest.get(&body).copied();
        let same = |a: u16, b: u16| (a == 0) == (b == 0) && step_up(a) == step_up(b);
        if before == modes || before.zip(modes).is_some_and(|(a, b)| same(a, b)) {
            return true;
        }
        match modes {
            Some(modes) => p.interest.insert(body, modes),
            None => p.interest.remove(&body),
        };
        if modes == Some(0) {
            p.streaming.remove(&body);
            p.due.remove(&body);
            p.resends.retain(|r| r.1 != body);
        } else {
            p.due.insert(body);
        }
        true
    }

    /// Iterates over the guests in the session.
    pub fn users(&self) -> impl Iterator<Item = (PeerId, UserId, &str)> {
        self.peers.values().filter_map(|p| p.user().map(|u| (p.id, u, p.name.as_str())))
    }

    /// Metrics of a guest's connection.
    pub fn stats(&self, peer: PeerId) -> Option<LinkStats> {
        self.peers.get(&peer).map(|p| p.link.stats())
    }

    /// Counts of all connections, including those that have ended, so they never decrease. Times,
    /// shares and the level are zero.
    pub fn totals(&self) -> LinkStats {
        let mut sum = self.gone;
        self.peers.values().for_each(|p| sum.add_counts(&p.link.stats));
        sum
    }

    /// Sends what is due and drops guests that are silent. Call this once a frame and at
    /// [`HostSession::next_wakeup`].
    pub fn update(&mut self, now: Duration) {
        let ids: Vec<PeerId> = self.peers.keys().copied().collect();
        for id in ids {
            self.resend_due(now, id);
            let Some(p) = self.peers.get_mut(&id) else { continue };
            if p.link.is_silent(now, self.config.idle_timeout) {
                self.drop_peer(id, DisconnectReason::Silent, true);
                continue;
            }
            let (bytes, round_trips) = (p.link.stats.bytes_out, p.link.last_round_trips());
            p.regulator.judge(now, bytes, round_trips, self.config.guest_rate);
            p.link.stats.level = p.regulator.level();
            p.send_pong(now, &mut self.out);
            p.link.updated(now);
        }
        self.send_models(now);
    }

    /// Latest time at which to call [`HostSession::update`] if nothing happens before.
    pub fn next_wakeup(&self) -> Option<Duration> {
        let each = self.peers.values().flat_map(|p| {
            let model = self.upload.ready_at(p);
            let resend = p.resends.iter().map(|r| r.0).min();
            [Some(p.link.silent_at(self.config.idle_timeout)), model, resend, p.asked_at()]
        });
        each.flatten().min()
    }

    /// Returns the next datagram or message to send.
    ///
    /// Nothing is dropped here, so fetch the outputs after each call. The requests of one guest add
    /// no more than its budgets allow: 4,000 ticks, 2 snapshots and 200 messages a second (1,024
    /// ticks, 16 snapshots and 400 messages at once).
    pub fn poll_output(&mut self) -> Option<Output> {
        self.out.pop_front()
    }

    /// Returns the next event.
    pub fn poll_event(&mut self) -> Option<HostEvent> {
        self.events.pop()
    }

    /// Number of events that were dropped because the application did not fetch them. Of 4,096 that
    /// wait, the oldest movement of a hand or impulse goes first.
    pub fn dropped_events(&self) -> u64 {
        self.events.dropped()
    }

    /// Number of frames encoded so far. One frame is encoded for each body, tick and kind of
    /// receiver (payload, modes, datagram size), however many guests receive it.
    pub fn encoded(&self) -> u64 {
        self.encoded
    }

    /// Number of encoders made so far. Each one makes the patches of all hands on its body anew.
    pub fn encoders_made(&self) -> u64 {
        self.encoders_made
    }

    pub(super) fn event(&mut self, event: HostEvent) {
        // Who moves a hand often must not hide that others come, go, grab and let go.
        self.events.push_sparing(event, |event| {
            matches!(event, HostEvent::GrabMoved { .. } | HostEvent::Impulse { .. })
        });
    }

    fn admit(&mut self, now: Duration, peer: PeerId, before: Option<UserId>, role: Role) {
        let taken: BTreeSet<u16> = self.peers.values().filter_map(|p| p.user().map(|u| u.0)).collect();
        let free = |number: u16| number != 0 && !taken.contains(&number);
        // There are fewer guests than numbers.
        let number = before
            .map(|user| user.0)
            .filter(|&number| free(number))
            .unwrap_or_else(|| next_free(&mut self.next_user, free));
        let user = UserId(number);
        let users = self.host_user.clone().into_iter().chain(self.peers.values().filter_map(GuestPeer::info));
        let users: Vec<UserInfo> = users.collect();
        let Some(p) = self.peers.get_mut(&peer) else { return };
        p.standing = Standing::Joined(user);
        p.role = role;
        if let Some(budgets) = self.away.take(user) {
            p.budgets = budgets;
        }
        p.link.received_at(now);
        let Newmark { h, beta, gamma } = self.config.newmark;
        let step_ns = (h * 1e9).round() as u64;
        let welcome =
            HostMessage::Welcome { version: PROTOCOL_VERSION, user: number, step_ns, beta, gamma, users };
        p.send_message(&welcome, &mut self.out);
        let name = p.name.clone();
        let joined = HostMessage::UserJoined(UserInfo { user, role, name: name.clone() });
        for other in self.peers.values_mut().filter(|p| p.id != peer && p.user().is_some()) {
            other.send_message(&joined, &mut self.out);
        }
        self.event(HostEvent::Joined { peer, user, name });
        let bodies: Vec<BodyId> = self.bodies.keys().copied().collect();
        for body in bodies {
            self.announce(peer, body);
        }
        self.announce_rigids(peer);
    }

    /// Sends the quality of the host's links to all guests in the session.
    pub fn send_links(&mut self, links: Vec<UserLinkInfo>) {
        let message = HostMessage::Links(links);
        for peer in self.peers.values_mut().filter(|p| p.user().is_some()) {
            peer.send_message(&message, &mut self.out);
        }
    }

    pub(super) fn send_snapshot(&mut self, peer: PeerId, body: BodyId) {
        let (Some(p), Some(b)) = (self.peers.get_mut(&peer), self.bodies.get(&body)) else { return };
        let Some(key) = stream_key(p, b) else { return };
        if let Some(encoder) = b.streams.get(&key).filter(|encoder| !encoder.is_fresh()) {
            p.send_message(&HostMessage::Snapshot(encoder.snapshot(b.resting)), &mut self.out);
        }
    }

    fn resend_due(&mut self, now: Duration, peer: PeerId) {
        let Some(p) = self.peers.get_mut(&peer) else { return };
        while let Some(&(due, body, tick)) = p.resends.front() {
            if due > now {
                return;
            }
            p.resends.pop_front();
            let Some(b) = self.bodies.get(&body) else { continue };
            let Some(key) = stream_key(p, b) else { continue };
            for bytes in b.streams.get(&key).into_iter().flat_map(|e| e.resend(tick)) {
                p.send_frame(&bytes, &mut self.out);
            }
        }
    }

    pub(super) fn drop_peer(&mut self, peer: PeerId, reason: DisconnectReason, goodbye: bool) {
        let Some(mut p) = self.peers.remove(&peer) else { return };
        if goodbye {
            p.say_goodbye(reason, &mut self.out);
        }
        self.gone.add_counts(&p.link.stats);
        let user = p.user();
        if let Some(user) = user {
            for (grab, held) in &p.grabs {
                self.event(HostEvent::GrabEnded { key: GrabKey { user, grab: *grab }, body: held.body });
            }
            self.away.keep(user, p.budgets);
            for other in self.peers.values_mut().filter(|p| p.user().is_some()) {
                other.send_message(&HostMessage::UserLeft { user: user.0, reason }, &mut self.out);
            }
        }
        self.event(HostEvent::Left { peer, user, reason });
    }
}

/// Rounds up to the next of 1, 2, 3, 4, 6, 8, 12 and so on. However often guests change their
/// limits, a body has at most two encoders for each doubling of its modes.
fn step_up(modes: u16) -> u16 {
    let whole = modes.checked_next_power_of_two().unwrap_or(u16::MAX);
    let between = whole / 4 * 3;
    if between >= modes && between > 0 { between } else { whole }
}

/// Returns the stream of a body that a guest receives: its subscription, reduced to what its path
/// carries. The result is `None` when the guest takes nothing of the body.
pub(super) fn stream_key(peer: &GuestPeer, body: &HostBody) -> Option<StreamKey> {
    let model_modes = body.model.mode_count();
    let mut subscription = peer.subscription?;
    if let Some(&most) = peer.interest.get(&body.id) {
        if most == 0 {
            return None;
        }
        subscription.modes = subscription.modes.min(step_up(most));
    }
    subscription = peer.regulator.cut(body.subscribed(subscription), model_modes);
    subscription.modes = Encoder::modes_for(&subscription, model_modes, peer.link.max_datagram) as u16;
    Some((subscription, peer.link.max_datagram))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interest_is_taken_up_to_few_steps() {
        let steps: BTreeSet<u16> = (1..=4096).map(step_up).collect();
        assert_eq!(steps.iter().copied().take(8).collect::<Vec<_>>(), [1, 2, 3, 4, 6, 8, 12, 16]);
        assert_eq!(steps.len(), 24, "{steps:?}");
        assert!(
            (1..=4096).all(|modes| step_up(modes) >= modes && step_up(modes) <= modes + modes.div_ceil(2))
        );
        assert_eq!(step_up(u16::MAX), u16::MAX);
    }
}
