//! The network plugin and its system sets.

use std::sync::{Mutex, PoisonError};

use bevy::camera::visibility::VisibilitySystems;
use bevy::diagnostic::Diagnostics;
use bevy::ecs::schedule::{InternedScheduleLabel, ScheduleLabel};
use bevy::prelude::*;
use pliant_body::{PliantDisplaySystems, PliantSystems};
use thiserror::Error;

use crate::guest::{self, Interest, JoinConfig, NetGuest};
use crate::host::{self, Holding, HostConfig, NetHost};
use crate::metrics::{self, NetStats, RateMarks};
use crate::peer::{self, NetPeer, PeerConfig};
use crate::recording::{RecordingError, SessionRecording};
use crate::remote::{self, RemoteBody, RemoteHands};
use crate::shared_body::SharedBody;
use crate::transport::{Endpoint, Invite, TransportError};
use crate::user::{HandOf, Hands, User, UserJoined, UserLeft, UserLink, Yourself};

/// Why a session could not be set up.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum NetError {
    /// The socket or the keys could not be set up.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The file to record to, or to play, could not be used.
    #[error(transparent)]
    Recording(#[from] RecordingError),
}

/// Hosts a session, joins one, plays among peers, or plays a recording. Add it after
/// [`PliantBodyPlugin`](pliant_body::PliantBodyPlugin).
///
/// The constructor opens the socket, so that a host's invite can be shown before the app runs. The
/// host admits no guest before the app runs. The other participants receive a goodbye when the app
/// ends (closed, or by Ctrl-C if Bevy's `TerminalCtrlCHandlerPlugin` turns it into an exit), or
/// when [`NetHost`], [`NetGuest`] or [`NetPeer`] is removed.
pub struct NetPlugin {
    start: Mutex<Option<Start>>,
    invite: Option<Invite>,
    schedule: InternedScheduleLabel,
}

enum Start {
    Host(Box<HostConfig>, Endpoint),
    Join(Box<NetGuest>),
    Peer(Box<NetPeer>),
}

/// System sets of the plugin.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub enum NetSystems {
    /// `PreUpdate`: received data is processed, and users, bodies and grabs are added and removed.
    Receive,
    /// Host, in the bodies' schedule, after [`PliantSystems::Publish`]: the step is sent.
    Send,
    /// Guest and peer, `PostUpdate`, before the surfaces are written: the local hands are sent, and
    /// shapes and forces are displayed.
    Show,
}

impl NetPlugin {
    /// Hosts a session. Guests are admitted once the app runs.
    ///
    /// # Errors
    /// [`NetError::Transport`] when the socket or the keys cannot be set up.
    pub fn host(mut config: HostConfig) -> Result<Self, NetError> {
        let endpoint = Endpoint::host(std::mem::take(&mut config.transport))?;
        let invite = Some(endpoint.invite());
        Ok(Self::new(Start::Host(Box::new(config), endpoint), invite))
    }

    /// Joins the session of an invite. The outcome is known later, from [`NetGuest::state`],
    /// [`SessionJoined`](crate::SessionJoined) and [`SessionClosed`](crate::SessionClosed).
    ///
    /// # Errors
    /// [`NetError::Transport`] when the socket or the keys cannot be set up,
    /// [`NetError::Recording`] when the file to record to cannot be created.
    pub fn join(invite: &Invite, mut config: JoinConfig) -> Result<Self, NetError> {
        let limits = config.transport.limits.clone();
        let endpoint = Endpoint::join(invite, std::mem::take(&mut config.transport))?;
        config.transport.limits = limits;
        Ok(Self::new(Start::Join(Box::new(NetGuest::join(config, endpoint)?)), None))
    }

    /// Plays a recorded session in a guest, at the speed at which it was recorded. Bodies, users
    /// and hands appear and disappear as they did in the recorded session. Nothing is sent, and
    /// this app's own grabs have no effect.
    pub fn replay(recording: SessionRecording, mut config: JoinConfig) -> Self {
        config.models.extend(recording.models.iter().cloned());
        Self::new(Start::Join(Box::new(NetGuest::replay(config, recording))), None)
    }

    /// Plays among peers, each of which steps the bodies. Starts a new session if
    /// [`PeerConfig::join`] is `None`, otherwise joins the peers of the invite.
    ///
    /// # Errors
    /// [`NetError::Transport`] when a socket or the keys cannot be set up.
    pub fn peer(config: PeerConfig) -> Result<Self, NetError> {
        let peer = NetPeer::open(config)?;
        let invite = Some(peer.invite());
        Ok(Self::new(Start::Peer(Box::new(peer)), invite))
    }

    fn new(start: Start, invite: Option<Invite>) -> Self {
        Self { start: Mutex::new(Some(start)), invite, schedule: FixedUpdate.intern() }
    }

    /// Sets the schedule in which the bodies are stepped. Default: `FixedUpdate`.
    pub fn in_schedule(mut self, schedule: impl ScheduleLabel) -> Self {
        self.schedule = schedule.intern();
        self
    }

    /// Returns the invite to this host or peer. `None` for a guest.
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
        metrics::register(app);
        remote::register_types(app);
        app.init_resource::<NetStats>()
            .init_resource::<RateMarks>()
            .register_type::<SharedBody>()
            .register_type::<Holding>()
            .register_type::<Interest>()
            .register_type::<RemoteBody>()
            .register_type::<RemoteHands>()
            .register_type::<User>()
            .register_type::<Yourself>()
            .register_type::<UserLink>()
            .register_type::<HandOf>()
            .register_type::<Hands>()
            .register_type::<NetStats>()
            .register_type::<UserJoined>()
            .register_type::<UserLeft>()
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
            Start::Join(guest) => {
                remote::register(app);
                app.insert_resource(*guest)
                    .add_systems(PreUpdate, guest::receive.in_set(NetSystems::Receive))
                    .add_systems(
                        PostUpdate,
                        (guest::send_hands, guest::show)
                            .chain()
                            .in_set(NetSystems::Show)
                            .before(PliantDisplaySystems::Interpolate),
                    )
                    .add_systems(
                        PostUpdate,
                        (guest::look, guest::send_interest).chain().after(VisibilitySystems::UpdateFrusta),
                    );
            }
            Start::Peer(peer) => {
                remote::register(app);
                app.insert_resource(*peer)
                    .add_systems(PreUpdate, peer::receive.in_set(NetSystems::Receive))
                    .add_systems(
                        PostUpdate,
                        (peer::send_hands, peer::show)
                            .chain()
                            .in_set(NetSystems::Show)
                            .before(PliantDisplaySystems::Interpolate),
                    );
            }
        }
    }
}

/// `Last`: updates the metrics of this frame.
fn measure(
    host: Option<ResMut<NetHost>>,
    guest: Option<ResMut<NetGuest>>,
    peer: Option<ResMut<NetPeer>>,
    mut stats: ResMut<NetStats>,
    mut marks: ResMut<RateMarks>,
    mut diagnostics: Diagnostics,
) {
    let new = host.map(|mut host| host.metrics()).or_else(|| guest.map(|mut guest| guest.metrics()));
    let new = new.or_else(|| peer.map(|mut peer| peer.metrics()));
    let mut new = new.unwrap_or_default();
    new.keep_rates(&stats, &mut marks, &mut diagnostics);
    new.measure(&mut diagnostics);
    stats.set_if_neq(new);
}
