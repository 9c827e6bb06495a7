//! The plugin, and when its systems run.

use std::sync::{Mutex, PoisonError};

use bevy::diagnostic::Diagnostics;
use bevy::ecs::schedule::{InternedScheduleLabel, ScheduleLabel};
use bevy::prelude::*;
use pliant_body::{PliantDisplaySystems, PliantSystems};

use crate::figures::{self, NetStats, RateMarks};
use crate::guest::{self, JoinConfig, NetGuest};
use crate::host::{self, HostConfig, NetHost};
use crate::scene::SharedBody;
use crate::seen;
use crate::transport::{Endpoint, Invite, TransportError};
use crate::user::{UserJoined, UserLeft};

/// Hosts or joins a session. Add it after [`PliantBodyPlugin`](pliant_body::PliantBodyPlugin).
///
/// The socket is open from the constructor on, so that a host's invite can be shown before the app runs; nobody is let in before it does.
/// When the app ends, or [`NetHost`] or [`NetGuest`] is removed, the others are told.
pub struct NetPlugin {
    start: Mutex<Option<Start>>,
    invite: Option<Invite>,
    schedule: InternedScheduleLabel,
}

enum Start {
    Host(Box<HostConfig>, Endpoint),
    Join(Box<JoinConfig>, Endpoint),
}

/// The plugin's systems.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub enum NetSystems {
    /// `PreUpdate`: what came is taken in; users, bodies and grabs come and go.
    Receive,
    /// Host, in the bodies' schedule, after [`PliantSystems::Publish`]: the step is sent.
    Send,
    /// Guest, `PostUpdate`, before the surfaces are written: own hands are sent, shapes and forces are shown.
    Show,
}

impl NetPlugin {
    /// Hosts a session. Guests are let in once the app runs.
    ///
    /// # Errors
    /// [`TransportError`] when the socket or the keys cannot be set up.
    pub fn host(mut config: HostConfig) -> Result<Self, TransportError> {
        let endpoint = Endpoint::host(std::mem::take(&mut config.transport))?;
        let invite = Some(endpoint.invite());
        Ok(Self::new(Start::Host(Box::new(config), endpoint), invite))
    }

    /// Joins the session of an invite. That the host is there and lets us in shows later: [`NetGuest::state`],
    /// [`SessionClosed`](crate::SessionClosed).
    ///
    /// # Errors
    /// [`TransportError`] when the socket or the keys cannot be set up.
    pub fn join(invite: &Invite, mut config: JoinConfig) -> Result<Self, TransportError> {
        let endpoint = Endpoint::join(invite, std::mem::take(&mut config.transport))?;
        Ok(Self::new(Start::Join(Box::new(config), endpoint), None))
    }

    fn new(start: Start, invite: Option<Invite>) -> Self {
        Self { start: Mutex::new(Some(start)), invite, schedule: FixedUpdate.intern() }
    }

    /// The schedule in which the bodies are stepped, where it is not `FixedUpdate`.
    pub fn in_schedule(mut self, schedule: impl ScheduleLabel) -> Self {
        self.schedule = schedule.intern();
        self
    }

    /// What guests paste to join this host. `None` for a guest.
    pub fn invite(&self) -> Option<&Invite> {
        self.invite.as_ref()
    }
}

impl Plugin for NetPlugin {
    fn build(&self, app: &mut App) {
        let start = self.start.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some(start) = start else {
            error!("a NetPlugin can be added to one app only; this app has no network");
            return;
        };
        figures::register(app);
        app.init_resource::<NetStats>()
            .init_resource::<RateMarks>()
            .register_type::<SharedBody>()
            .add_message::<UserJoined>()
            .add_message::<UserLeft>()
            .add_systems(Last, measure);
        match start {
            Start::Host(config, endpoint) => {
                let mut start = Some((config, endpoint));
                let begin = move |world: &mut World| {
                    let Some((config, endpoint)) = start.take() else { return };
                    if let Err(error) = NetHost::start(world, endpoint, &config) {
                        error!("the session cannot be hosted: {error}");
                    }
                };
                app.add_systems(PreStartup, begin)
                    .add_systems(PreUpdate, host::receive.in_set(NetSystems::Receive))
                    .add_systems(
                        self.schedule,
                        (
                            host::move_hands.before(PliantSystems::Input),
                            host::publish.in_set(NetSystems::Send).after(PliantSystems::Publish),
                        ),
                    )
                    .add_systems(PostUpdate, host::finish);
            }
            Start::Join(config, endpoint) => {
                seen::register(app);
                let mut start = Some((config, endpoint));
                let begin = move |world: &mut World| {
                    let Some((config, endpoint)) = start.take() else { return };
                    world.insert_resource(NetGuest::new(*config, endpoint));
                };
                app.add_systems(PreStartup, begin)
                    .add_systems(PreUpdate, guest::receive.in_set(NetSystems::Receive))
                    .add_systems(
                        PostUpdate,
                        (guest::send_hands, guest::show)
                            .chain()
                            .in_set(NetSystems::Show)
                            .before(PliantDisplaySystems::Interpolate),
                    );
            }
        }
    }
}

/// `Last`: the figures of this frame.
fn measure(
    host: Option<Res<NetHost>>,
    guest: Option<Res<NetGuest>>,
    mut stats: ResMut<NetStats>,
    mut marks: ResMut<RateMarks>,
    mut diagnostics: Diagnostics,
) {
    let new = host.map(|host| host.figures()).or_else(|| guest.map(|guest| guest.figures()));
    let mut new = new.unwrap_or_default();
    new.keep_rates(&stats, &mut marks, &mut diagnostics);
    new.measure(&mut diagnostics);
    stats.set_if_neq(new);
}
