//! The network plugin and its system sets.

use std::convert::Infallible;
use std::sync::{Mutex, PoisonError};

use bevy::camera::visibility::VisibilitySystems;
use bevy::diagnostic::Diagnostics;
use bevy::ecs::schedule::{InternedScheduleLabel, ScheduleLabel};
use bevy::prelude::*;
use pliant_body::{PliantDisplaySystems, PliantSystems, is_fixed};
use pliant_stream::{DisconnectReason, StreamError};
use thiserror::Error;

use crate::guest::{self, Interest, JoinConfig, NetGuest};
use crate::host::{self, Holding, HostConfig, NetHost};
use crate::metrics::{self, NetStats, RateMarks};
use crate::peer::{self, NetPeer, PeerConfig};
use crate::recording::{RecordingError, SessionRecording};
use crate::remote::{self, RemoteBody, RemoteHands};
use crate::session::{self, Opened, SessionControl, SessionState};
use crate::shared_body::{RemoteRigid, SharedBody, SharedRigid};
use crate::transport::{Invite, InviteError, TransportError};
use crate::user::{HandOf, Hands, User, UserJoined, UserLeft, UserLink, Yourself};

/// Why a session could not begin.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum NetError {
    /// The socket or the keys could not be set up.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The file to record to, or to play, could not be used.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The text is no invite.
    #[error(transparent)]
    Invite(#[from] InviteError),
    /// The settings do not make a session.
    #[error("the session cannot begin with these settings: {0}")]
    Settings(#[from] StreamError),
    /// The other side was not reached, or did not admit this app.
    #[error("not joined: {0}")]
    NotJoined(DisconnectReason),
}

impl From<Infallible> for NetError {
    fn from(never: Infallible) -> Self {
        match never {}
    }
}

/// Sessions: hosts one, joins one, plays among peers, or plays a recording. Add it after
/// [`PliantBodyPlugin`](pliant_body::PliantBodyPlugin).
///
/// The default has no session: the app begins and leaves sessions while it runs, with
/// [`SessionCommands`](crate::SessionCommands). The other constructors open a session's socket at
/// once, so that a host's invite can be shown before the app runs, and issue the same command when
/// the app starts. The host admits no guest before the app runs.
///
/// The other participants receive a goodbye when the app leaves the session or ends (closed, or by
/// Ctrl-C if Bevy's `TerminalCtrlCHandlerPlugin` turns it into an exit).
pub struct NetPlugin {
    start: Mutex<Option<Opened>>,
    invite: Option<Invite>,
    schedule: InternedScheduleLabel,
}

/// System sets of the plugin.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub enum NetSystems {
    /// `PreUpdate`: received data is processed, and users, bodies and grabs are added and removed.
    Receive,
    /// Host, in the bodies' schedule, after [`PliantSystems::Publish`]: the step is sent. Rigid
    /// bodies ([`SharedRigid`]) follow in `FixedLast`, if the bodies' schedule is one of the fixed
    /// loop.
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
    pub fn host(config: HostConfig) -> Result<Self, NetError> {
        Ok(Self::new(Some(session::open_host(config)?)))
    }

    /// Joins the session of an invite. The outcome is known later, from [`NetGuest::state`],
    /// [`SessionJoined`](crate::SessionJoined) and [`SessionFailed`](crate::SessionFailed).
    ///
    /// # Errors
    /// [`NetError::Transport`] when the socket or the keys cannot be set up,
    /// [`NetError::Recording`] when the file to record to cannot be created.
    pub fn join(invite: &Invite, config: JoinConfig) -> Result<Self, NetError> {
        Ok(Self::new(Some(session::open_guest(invite, config)?)))
    }

    /// Plays a recorded session in a guest, at the speed at which it was recorded. Bodies, users
    /// and hands appear and disappear as they did in the recorded session. Nothing is sent, and
    /// this app's own grabs have no effect.
    pub fn replay(recording: SessionRecording, config: JoinConfig) -> Self {
        Self::new(Some(session::open_replay(recording, config)))
    }

    /// Plays among peers, each of which steps the bodies. Starts a new session if
    /// [`PeerConfig::join`] is `None`, otherwise joins the peers of the invite.
    ///
    /// # Errors
    /// [`NetError::Transport`] when a socket or the keys cannot be set up.
    pub fn peer(config: PeerConfig) -> Result<Self, NetError> {
        Ok(Self::new(Some(session::open_peer(config)?)))
    }

    fn new(start: Option<Opened>) -> Self {
        let invite = start.as_ref().and_then(Opened::invite);
        Self { start: Mutex::new(start), invite, schedule: FixedUpdate.intern() }
    }

    /// Sets the schedule in which the bodies are stepped. Default: `FixedUpdate`.
    pub fn in_schedule(mut self, schedule: impl ScheduleLabel) -> Self {
        self.schedule = schedule.intern();
        self
    }

    /// Returns the invite to this host or peer. `None` for a guest, and without a session.
    pub fn invite(&self) -> Option<&Invite> {
        self.invite.as_ref()
    }
}

impl Default for NetPlugin {
    /// Begins without a session.
    fn default() -> Self {
        Self::new(None)
    }
}

impl Plugin for NetPlugin {
    fn build(&self, app: &mut App) {
        let start = self.start.lock().unwrap_or_else(PoisonError::into_inner).take();
        metrics::register(app);
        remote::register(app);
        app.insert_resource(SessionControl::starting(start))
            .init_resource::<SessionState>()
            .init_resource::<NetStats>()
            .init_resource::<RateMarks>()
            .register_type::<SessionState>()
            .register_type::<SharedBody>()
            .register_type::<SharedRigid>()
            .register_type::<RemoteRigid>()
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
            .add_message::<UserLeft>();
        #[cfg(feature = "watch")]
        app.register_type::<crate::watch::WatchView>();
        // The systems of all roles are there, and those of the role that the app has run.
        app.add_systems(PreStartup, session::start)
            .add_systems(PreUpdate, session::follow.run_if(session::is_busy).in_set(NetSystems::Receive))
            .add_systems(
                self.schedule,
                (
                    host::move_hands.before(PliantSystems::Input),
                    host::publish.in_set(NetSystems::Send).after(PliantSystems::Publish),
                )
                    .run_if(resource_exists::<NetHost>),
            )
            .add_systems(
                PostUpdate,
                (
                    host::finish.run_if(resource_exists::<NetHost>),
                    (guest::send_hands, guest::show)
                        .chain()
                        .in_set(NetSystems::Show)
                        .before(PliantDisplaySystems::Interpolate)
                        .run_if(resource_exists::<NetGuest>),
                    guest::send_interest
                        .after(VisibilitySystems::UpdateFrusta)
                        .run_if(resource_exists::<NetGuest>),
                    (peer::send_hands, peer::show)
                        .chain()
                        .in_set(NetSystems::Show)
                        .before(PliantDisplaySystems::Interpolate)
                        .run_if(resource_exists::<NetPeer>),
                ),
            )
            .add_systems(Last, measure);
        // A physics engine moves rigid bodies after the bodies of a tick, and before its end.
        let last = if is_fixed(self.schedule) { FixedLast.intern() } else { self.schedule };
        app.add_systems(
            last,
            host::publish_rigids
                .in_set(NetSystems::Send)
                .after(host::publish)
                .run_if(resource_exists::<NetHost>),
        );
    }
}

/// `Last`: updates the metrics of this frame, and logs impulses that no session took.
fn measure(
    host: Option<ResMut<NetHost>>,
    mut guest: Option<ResMut<NetGuest>>,
    mut peer: Option<ResMut<NetPeer>>,
    mut commands: Commands,
    mut stats: ResMut<NetStats>,
    mut marks: ResMut<RateMarks>,
    mut diagnostics: Diagnostics,
) {
    let refused = guest.as_mut().map(|guest| std::mem::take(&mut guest.refused_impulses));
    let of_peer = peer.as_mut().map(|peer| std::mem::take(&mut peer.refused_impulses));
    refused.into_iter().chain(of_peer).flatten().for_each(|refused| commands.trigger(refused));
    let new = host.map(|mut host| host.metrics()).or_else(|| guest.map(|mut guest| guest.metrics()));
    let new = new.or_else(|| peer.map(|mut peer| peer.metrics()));
    let Some(mut new) = new else {
        if stats.set_if_neq(NetStats::default()) {
            *marks = RateMarks::default();
        }
        return;
    };
    new.keep_rates(&stats, &mut marks, &mut diagnostics);
    new.measure(&mut diagnostics);
    stats.set_if_neq(new);
}
