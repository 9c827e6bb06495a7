//! The guest's side in Bevy: bodies arrive and track the host's bodies, the local hands are sent,
//! and the forces on them are written.

mod bodies;
mod hands;
mod interest;
mod rigids;
mod session;
mod show;
mod source;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use bevy::platform::time::Instant;
use bevy::prelude::*;
use bevy::tasks::Task;
use pliant_body::BodyRefused;
use pliant_modal::ModalModel;
use pliant_stream::{
    BodyId, DisconnectReason, GuestSession, LinkStats, PeerId, RecoveryConfig, RigidId, State, StreamedBody,
    Tick, UserId,
};

use crate::metrics::{Ledger, NetStats};
use crate::remote::RemoteBody;
use crate::roster::Roster;
use crate::transport::{Carrier, Emulation, Endpoint, JoinOptions, Role};
use bodies::FollowedBody;
use hands::SentGrab;
use rigids::FollowedRigid;
use source::Source;

pub(crate) use hands::send_hands;
pub(crate) use interest::send_interest;
pub use interest::{CameraInterest, Interest};
pub(crate) use session::receive;
pub(crate) use show::show;

use crate::recording::{RecordingError, SessionRecorder, SessionRecording};

/// How to join a session.
#[derive(Debug)]
pub struct JoinConfig {
    /// Name of this user, at most 64 bytes. Default: `guest`.
    pub name: String,
    /// Key, limits, emulated link. Over a carrier of the app's own only
    /// [`Limits::idle_timeout`](crate::transport::Limits::idle_timeout) is used.
    pub transport: JoinOptions,
    /// How loss is repaired. Default: [`RecoveryConfig::default`].
    pub recovery: RecoveryConfig,
    /// Most modes to accept of each body, for weak machines and slow links. Of a body with reduced
    /// elasticity all come, refreshed the more rarely. Default: all.
    pub modes: Option<u16>,
    /// Whether to show the local hands, and report their forces, without the network's delay. A
    /// body that this guest holds is then stepped ahead to the current positions of the hands,
    /// instead of shown in the host's state of half a round trip ago. Default: true.
    pub predict_hand: bool,
    /// Largest force on one of the local hands that is reported, N, whatever the host sends. The
    /// direction is kept. Default: 1000.
    pub most_force: f64,
    /// Request no more of each body than the cameras see. Default `None`: everything, unless an
    /// [`Interest`] says otherwise.
    pub interest: Option<CameraInterest>,
    /// How long the guest tries to join again after it has lost the host or cannot reach it. Zero:
    /// it does not try. Default: 60 s.
    pub rejoin: Duration,
    /// Models that the host need not send, in addition to those in `Assets<ModalAsset>` when the
    /// connection opens. Default: none.
    pub models: Vec<Arc<ModalModel>>,
    /// File to which all received data is written, for
    /// [`NetPlugin::replay`](crate::NetPlugin::replay). Default: none.
    ///
    /// If this is an existing folder or ends with a separator, each session is written to a new
    /// file in that folder, which is created if needed. When its recordings have more than
    /// `record_budget` bytes together, the oldest finished ones are removed, and if there are none,
    /// the recording ends. Only files that Pliant has written are removed, told by their names and
    /// first bytes: a recording that is renamed stays.
    pub record: Option<PathBuf>,
    /// Most bytes of all recordings together, if `record` is a folder. Default: 32 GiB.
    pub record_budget: u64,
}

impl Default for JoinConfig {
    fn default() -> Self {
        Self {
            name: "guest".into(),
            transport: JoinOptions::default(),
            recovery: RecoveryConfig::default(),
            modes: None,
            predict_hand: true,
            most_force: 1000.0,
            interest: None,
            rejoin: Duration::from_secs(60),
            models: Vec::new(),
            record: None,
            record_budget: 32 << 30,
        }
    }
}

/// Connection state of a guest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GuestState {
    /// The host has not admitted this guest yet.
    Joining,
    /// The guest is in the session.
    In {
        /// The guest's user number.
        user: UserId,
    },
    /// The connection to the host is lost, and the guest tries to join again. Bodies keep their
    /// last displayed state.
    Lost {
        /// The reason.
        reason: DisconnectReason,
    },
    /// The session is over, or never began. Bodies keep their last displayed state.
    Closed {
        /// The reason.
        reason: DisconnectReason,
    },
}

/// The session that this app has joined.
#[derive(Resource)]
pub struct NetGuest {
    source: Source,
    config: JoinConfig,
    began: Instant,
    state: GuestState,
    role: Role,
    session: Option<GuestSession>,
    bodies: BTreeMap<BodyId, FollowedBody>,
    rigids: BTreeMap<RigidId, FollowedRigid>,
    /// Those of a lost session, which the next session may have again.
    orphan_rigids: Vec<FollowedRigid>,
    /// Bodies of a lost session, which the next session may have again.
    orphans: Vec<FollowedBody>,
    /// Bodies that the host has removed, on entities of the app, for when the app leaves.
    removed: Vec<FollowedBody>,
    users: Roster,
    grabs: BTreeMap<Entity, SentGrab>,
    /// Impulses of this frame that the session did not take.
    pub(crate) refused_impulses: Vec<BodyRefused>,
    /// Time up to which the session has been updated.
    advanced: Duration,
    /// Since when the cameras see less of a body than is requested.
    less_since: BTreeMap<BodyId, Duration>,
    rejoin: session::Rejoin,
    scratch: Vec<f64>,
    ledger: Ledger,
    /// Received models that are being decoded.
    being_read: Vec<([u8; 32], Task<Option<Arc<ModalModel>>>)>,
    /// The counts of earlier sessions.
    before: LinkStats,
}

impl NetGuest {
    pub(crate) fn join(mut config: JoinConfig, carrier: Box<dyn Carrier>) -> Result<Self, RecordingError> {
        let (record, budget) = (config.record.take(), config.record_budget);
        let recorder = record.map(|path| SessionRecorder::create(&path, budget)).transpose()?;
        Ok(Self::new(config, Source::Live { carrier, recorder }))
    }

    pub(crate) fn replay(config: JoinConfig, recording: SessionRecording) -> Self {
        Self::new(config, Source::replay(recording))
    }

    fn new(config: JoinConfig, source: Source) -> Self {
        Self {
            source,
            config,
            began: Instant::now(),
            state: GuestState::Joining,
            role: Role::Hold,
            session: None,
            bodies: BTreeMap::new(),
            rigids: BTreeMap::new(),
            orphan_rigids: Vec::new(),
            orphans: Vec::new(),
            removed: Vec::new(),
            users: Roster::default(),
            grabs: BTreeMap::new(),
            refused_impulses: Vec::new(),
            advanced: Duration::ZERO,
            less_since: BTreeMap::new(),
            rejoin: session::Rejoin::default(),
            scratch: Vec::new(),
            ledger: Ledger::default(),
            being_read: Vec::new(),
            before: LinkStats::default(),
        }
    }

    /// Returns the connection state.
    pub fn state(&self) -> &GuestState {
        &self.state
    }

    /// Returns what this guest's token permits. [`Role::Hold`] before the host has sent the role.
    pub fn role(&self) -> Role {
        self.role
    }

    /// Returns the session, with details such as ticks, repairs, confirmed states and the playout
    /// delay. `None` before the connection is open.
    pub fn session(&self) -> Option<&GuestSession> {
        self.session.as_ref()
    }

    /// Returns the session's view of the body that an entity tracks.
    pub fn body(&self, body: RemoteBody) -> Option<&StreamedBody> {
        self.session.as_ref()?.body(body.0)
    }

    /// Returns the displayed state of a body and its tick. While this guest's own hand holds the
    /// body, the state is the predicted copy ([`StreamedBody::predicted_hand`]). Otherwise it is
    /// the visual state of the confirmed stream. The host may not have reached the tick of a
    /// predicted copy yet.
    pub fn visual_state(&self, body: RemoteBody) -> Option<(Tick, &State)> {
        let view = self.body(body)?;
        visual_state_of(view)
    }

    /// Whether there is a link that [`set_emulation`](Self::set_emulation) changes: neither in a
    /// replay nor over a carrier of the app's own.
    pub fn may_emulate(&self) -> bool {
        self.source.endpoint().is_some()
    }

    /// Returns the emulated link under the session, if there is one.
    pub fn emulation(&self) -> Option<Emulation> {
        self.source.endpoint().and_then(Endpoint::emulation)
    }

    /// Sets, replaces or removes the emulated link under the session, at any time.
    pub fn set_emulation(&self, emulation: Option<Emulation>) {
        if let Some(endpoint) = self.source.endpoint() {
            endpoint.set_emulation(emulation);
        }
    }

    /// Returns the QUIC endpoint. `None` for a replay, and over a carrier of the app's own.
    pub fn endpoint(&self) -> Option<&Endpoint> {
        self.source.endpoint()
    }

    /// Returns whether this is a recorded session.
    pub fn is_replay(&self) -> bool {
        self.source.is_replay()
    }

    /// Returns whether the guest has been in the session.
    pub(crate) fn was_in(&self) -> bool {
        self.rejoin.was_in
    }

    /// Ends the connection, without waiting for its goodbye.
    pub(crate) fn end_connection(&self) {
        self.source.end();
    }

    fn now(&self) -> Duration {
        self.began.elapsed()
    }

    fn flush(&mut self) {
        let Some(session) = &mut self.session else { return };
        while let Some(output) = session.poll_output() {
            self.source.send(output);
        }
    }

    pub(crate) fn metrics(&mut self) -> NetStats {
        let mut stats = NetStats::default();
        let line = self.source.stats();
        let mut links = self.before;
        if let Some(session) = &self.session {
            links.add_counts(&session.stats());
        }
        stats.count(&links, &self.ledger.sum(line.iter().map(|line| (PeerId::HOST, *line))));
        let (Some(session), Some(transport)) = (&self.session, line) else { return stats };
        stats.add(&session.stats(), &transport);
        for view in session.bodies() {
            let counts = view.counts();
            stats.displayed_ticks += counts.stepped;
            stats.guessed += counts.guessed;
            stats.recovered += counts.repaired;
            stats.snapshots += counts.snapshots;
            let followed = self.bodies.get(&view.id());
            if let (Some(visual), Some(confirmed), Some(followed)) =
                (view.visual(), view.confirmed(), followed)
                && followed.peak > 0.0
            {
                let off = visual.q.iter().zip(&confirmed.q).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
                stats.visual_offset = stats.visual_offset.max(off / followed.peak);
            }
        }
        stats
    }
}

fn visual_state_of(view: &StreamedBody) -> Option<(Tick, &State)> {
    match view.predicted_hand() {
        Some(own) => Some((own.tick(), own.visual())),
        None => Some((view.tick(), view.visual()?)),
    }
}
