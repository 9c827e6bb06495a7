//! The session: its users, its network.

use bevy::{ecs::system::SystemParam, prelude::*};
use bevy_egui::egui::Ui;
use pliant_net::{GuestState, Hands, NetGuest, NetHost, NetStats, User, UserLink, Yourself};

use crate::{
    Trace,
    network::{self, NetworkView, UserView},
};

/// What the panel remembers of the network.
#[derive(Resource, Default)]
pub(super) struct Histories {
    round_trips: Trace,
    rates: Trace,
}

#[derive(SystemParam)]
pub(super) struct Session<'w, 's> {
    host: Option<Res<'w, NetHost>>,
    guest: Option<Res<'w, NetGuest>>,
    stats: Option<Res<'w, NetStats>>,
    histories: ResMut<'w, Histories>,
    time: Res<'w, Time<Real>>,
    users: Query<'w, 's, (&'static User, Has<Yourself>, Option<&'static Hands>, Option<&'static UserLink>)>,
}

impl Session<'_, '_> {
    pub fn is_there(&self) -> bool {
        self.stats.is_some() && (self.host.is_some() || self.guest.is_some())
    }

    pub fn show(&mut self, ui: &mut Ui) {
        let Some(stats) = &self.stats else { return };
        let now = self.time.elapsed_secs_f64();
        let round_trip_ms = stats.round_trip.as_secs_f64() * 1e3;
        let rate = [stats.bytes_in_per_s * 8e-3, stats.bytes_out_per_s * 8e-3];
        self.histories.round_trips.push(now, round_trip_ms);
        self.histories.rates.push(now, rate[0]);
        let mut users: Vec<_> = self.users.iter().collect();
        users.sort_by_key(|(user, ..)| user.id);
        let mut view = NetworkView {
            role: match (&self.host, &self.guest) {
                (Some(_), _) => "host".into(),
                (None, Some(guest)) => match guest.state() {
                    GuestState::Joining => "guest, joining".into(),
                    GuestState::In { .. } => "guest".into(),
                    GuestState::Lost { reason } => format!("guest, waiting for the host: {reason}"),
                    GuestState::Closed { reason } => format!("not in the session: {reason}"),
                },
                (None, None) => String::new(),
            },
            invite: self.host.as_ref().map(|host| host.invite().to_string()),
            round_trip_ms,
            loss: [stats.loss_in * 100.0, stats.loss_out * 100.0],
            rate,
            repaired: [stats.guessed, stats.recovered],
            round_trips: self.histories.round_trips.clone(),
            rates: self.histories.rates.clone(),
            users: users
                .into_iter()
                .map(|(user, yourself, hands, link)| {
                    let colour = user.colour.to_srgba();
                    UserView {
                        name: user.name.clone(),
                        colour: [colour.red, colour.green, colour.blue]
                            .map(|x| (x.clamp(0.0, 1.0) * 255.0) as u8),
                        yourself,
                        hands: hands.map_or(0, |hands| hands.iter().count()),
                        round_trip_ms: link
                            .map(|link| link.round_trip.as_secs_f64() * 1e3)
                            .filter(|ms| *ms > 0.0),
                    }
                })
                .collect(),
            ..default()
        };
        network::show(ui, &mut view);
        if view.copy
            && let Some(invite) = view.invite
        {
            ui.ctx().copy_text(invite);
        }
    }
}
