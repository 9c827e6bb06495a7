//! The session: its users and its network.

use bevy::{ecs::system::SystemParam, prelude::*};
use bevy_egui::egui::Ui;
use pliant_net::{
    Emulation, GuestState, Hands, NetGuest, NetHost, NetPeer, NetStats, PeerState, SessionCommands, User,
    UserLink, Yourself,
};

use super::{emulator, hands::srgb};
use crate::{
    Trace,
    network::{self, NetworkView, UserView},
};

/// Data of the network that the panel keeps between frames.
#[derive(Resource, Default)]
pub(super) struct SessionHistories {
    round_trips: Trace,
    rates: Trace,
    /// Whether "other" was chosen among the emulated networks.
    other: bool,
}

#[derive(SystemParam)]
pub(super) struct Session<'w, 's> {
    commands: Commands<'w, 's>,
    host: Option<Res<'w, NetHost>>,
    guest: Option<Res<'w, NetGuest>>,
    peer: Option<ResMut<'w, NetPeer>>,
    stats: Option<Res<'w, NetStats>>,
    histories: ResMut<'w, SessionHistories>,
    time: Res<'w, Time<Real>>,
    users: Query<'w, 's, (&'static User, Has<Yourself>, Option<&'static Hands>, Option<&'static UserLink>)>,
}

impl Session<'_, '_> {
    pub fn is_there(&self) -> bool {
        self.stats.is_some() && (self.host.is_some() || self.guest.is_some() || self.peer.is_some())
    }

    pub fn show(&mut self, ui: &mut Ui) {
        let Some(stats) = &self.stats else { return };
        let now = self.time.elapsed_secs_f64();
        let round_trip_ms = stats.round_trip.as_secs_f64() * 1e3;
        let rate = [stats.bytes_in_per_s * 8e-3, stats.bytes_out_per_s * 8e-3];
        self.histories.round_trips.push(now, round_trip_ms);
        self.histories.rates.push(now, rate[0]);
        let dropped = stats.dropped;
        let mut users: Vec<_> = self.users.iter().collect();
        users.sort_by_key(|(user, ..)| user.id);
        let mut view = NetworkView {
            role: self.role(),
            invite: self.invite(),
            way_out: self.way_out(),
            emulator: self
                .may_emulate()
                .then(|| emulator::view_of(self.emulation().as_ref(), self.histories.other)),
            round_trip_ms,
            loss: [stats.loss_in * 100.0, stats.loss_out * 100.0],
            rate,
            jitter_ms: stats.jitter.as_secs_f64() * 1e3,
            repaired: self.host.is_none().then_some([stats.guessed, stats.recovered]),
            nacks: stats.nacks,
            snapshots: stats.snapshots,
            dropped: dropped.send_queue_full
                + dropped.receive_queue_full
                + dropped.too_large
                + dropped.not_connected,
            queueing: stats.queueing,
            visual_offset: self.guest.is_some().then_some(stats.visual_offset * 100.0),
            round_trips: std::mem::take(&mut self.histories.round_trips),
            rates: std::mem::take(&mut self.histories.rates),
            users: users
                .into_iter()
                .map(|(user, yourself, hands, link)| UserView {
                    name: user.name.clone(),
                    color: srgb(user.color),
                    yourself,
                    hands: hands.map_or(0, |hands| hands.iter().count()),
                    round_trip_ms: link
                        .map(|link| link.round_trip.as_secs_f64() * 1e3)
                        .filter(|ms| *ms > 0.0),
                    loss: link
                        .filter(|link| !link.round_trip.is_zero())
                        .map(|link| [link.loss_in * 100.0, link.loss_out * 100.0]),
                })
                .collect(),
            ..default()
        };
        let before = view.emulator.clone();
        network::show(ui, &mut view);
        (self.histories.round_trips, self.histories.rates) = (view.round_trips, view.rates);
        if view.copy
            && let Some(invite) = view.invite
        {
            ui.ctx().copy_text(invite);
        }
        if let (Some(before), Some(wanted)) = (before, view.emulator)
            && before != wanted
        {
            let now = self.emulation();
            // A network that was changed from its preset, or chosen as "other", is shown as "other"
            // until a preset is chosen again.
            self.histories.other = wanted.other() || (wanted.preset == before.preset && wanted.preset > 0);
            self.emulate(emulator::emulation_of(&before, &wanted, now.as_ref()));
        }
        if view.leave {
            self.commands.leave_session();
        }
    }

    fn role(&self) -> String {
        match (&self.host, &self.guest, &self.peer) {
            (Some(_), ..) => "host".into(),
            (None, Some(guest), _) => match guest.state() {
                GuestState::Joining => "guest, joining".into(),
                GuestState::In { .. } => "guest".into(),
                GuestState::Lost { reason } => format!("guest, waiting for the host: {reason}"),
                GuestState::Closed { reason } => format!("not in the session: {reason}"),
            },
            (None, None, Some(peer)) => match peer.state() {
                PeerState::Joining => "peer, joining".into(),
                PeerState::In { .. } => "peer".into(),
                PeerState::Closed { reason } => format!("not in the session: {reason}"),
            },
            (None, None, None) => String::new(),
        }
    }

    fn invite(&self) -> Option<String> {
        match (&self.host, &self.peer) {
            (Some(host), _) => host.invite().map(|invite| invite.to_string()),
            (None, Some(peer)) => Some(peer.invite().to_string()),
            (None, None) => None,
        }
    }

    fn way_out(&self) -> Option<&'static str> {
        match (&self.host, &self.guest, &self.peer) {
            (Some(_), ..) => Some("End the session"),
            (None, Some(guest), _) => {
                (!matches!(guest.state(), GuestState::Closed { .. })).then_some("Leave")
            }
            (None, None, Some(peer)) => {
                (!matches!(peer.state(), PeerState::Closed { .. })).then_some("Leave")
            }
            (None, None, None) => None,
        }
    }

    /// Whether the session has a network to emulate. The playback of a recording has none, and one
    /// over a carrier of the app's own neither.
    fn may_emulate(&self) -> bool {
        match (&self.host, &self.guest, &self.peer) {
            (Some(host), ..) => host.may_emulate(),
            (None, Some(guest), _) => guest.may_emulate(),
            (None, None, Some(peer)) => peer.may_emulate(),
            (None, None, None) => false,
        }
    }

    fn emulation(&self) -> Option<Emulation> {
        match (&self.host, &self.guest, &self.peer) {
            (Some(host), ..) => host.emulation(),
            (None, Some(guest), _) => guest.emulation(),
            (None, None, Some(peer)) => peer.emulation(),
            (None, None, None) => None,
        }
    }

    fn emulate(&mut self, emulation: Option<Emulation>) {
        if let Some(host) = &self.host {
            host.set_emulation(emulation);
        } else if let Some(guest) = &self.guest {
            guest.set_emulation(emulation);
        } else if let Some(peer) = &mut self.peer {
            peer.set_emulation(emulation);
        }
    }
}
