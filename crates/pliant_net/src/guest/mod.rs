//! A guest's side in Bevy: bodies arrive and follow the host's, own hands are sent, what they feel is written.

mod bodies;
mod hands;
mod interest;
mod session;
mod show;
mod source;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bevy::prelude::*;
use bevy::tasks::Task;
use pliant_modal::ModalModel;
use pliant_stream::{BodyId, BodyView, GuestSession, LinkStats, PeerId, RecoveryConfig, State, Tick, UserId};

use crate::metrics::{Ledger, NetStats};
use crate::remote::RemoteBody;
use crate::scene::{Person, Reach};
use crate::transport::{Emulation, Endpoint, JoinOptions, Role};
use bodies::FollowedBody;
use hands::SentGrab;
use source::Source;

pub(crate) use hands::send_hands;
pub use interest::{CameraInterest, Interest};
pub(crate) use interest::{look, say_interest};
pub(crate) use session::receive;
pub(crate) use show::show;

use crate::recording::{Recorder, Recording, RecordingError};

/// How to join a session.
#[derive(Debug)]
pub struct JoinConfig {
    /// What this user is called, at most 64 bytes. Default: `guest`.
    pub name: String,
    /// Key, limits, emulated link.
    pub transport: JoinOptions,
    /// How loss is repaired. Default: [`RecoveryConfig::default`].
    pub recovery: RecoveryConfig,
    /// Take at most so many modes of each body: for weak machines and thin links. Default: all.
    pub modes: Option<u16>,
    /// Show and feel the own hands at once: a body that this guest holds is stepped on to where the hands are now, instead of shown as the
    /// host had it half a round trip ago. Default: true.
    pub predict_own_hand: bool,
    /// Most force that one of the own hands is told of, N, whatever the host says; the direction stays. Default: 1000.
    pub most_force: f64,
    /// Ask for no more of each body than the cameras see. Default `None`: everything, unless an [`Interest`] says otherwise.
    pub interest: Option<CameraInterest>,
    /// When the host cannot be heard any more, or is not there yet, joining is tried again for so long. Zero: never. Default: 60 s.
    pub rejoin: Duration,
    /// Models that need not be sent, beside those that are in `Assets<ModalAsset>` when the connection opens. Default: none.
    pub models: Vec<Arc<ModalModel>>,
    /// Write everything that comes to this file, for [`NetPlugin::replay`](crate::NetPlugin::replay). Default: no.
    pub record: Option<PathBuf>,
}

impl Default for JoinConfig {
    fn default() -> Self {
        Self {
            name: "guest".into(),
            transport: JoinOptions::default(),
            recovery: RecoveryConfig::default(),
            modes: None,
            predict_own_hand: true,
            most_force: 1000.0,
            interest: None,
            rejoin: Duration::from_secs(60),
            models: Vec::new(),
            record: None,
        }
    }
}

/// Where a guest stands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GuestState {
    /// The host has not let us in yet.
    Joining,
    /// In the session.
    In {
        /// Our number.
        user: UserId,
    },
    /// The host cannot be heard; joining is tried again. Bodies stand as they were last seen.
    Lost {
        /// Why, in words.
        reason: String,
    },
    /// It is over, or never began; bodies stay as they were last seen.
    Closed {
        /// Why, in words.
        reason: String,
    },
}

/// The session that this app has joined.
#[derive(Resource)]
pub struct NetGuest {
    line: Source,
    config: JoinConfig,
    began: Instant,
    state: GuestState,
    role: Role,
    session: Option<GuestSession>,
    bodies: BTreeMap<BodyId, FollowedBody>,
    /// Bodies of a session that was lost: the next one may have them again.
    orphans: Vec<FollowedBody>,
    placements: BTreeMap<BodyId, Transform>,
    users: BTreeMap<UserId, Entity>,
    people: BTreeMap<UserId, Person>,
    reaches: Vec<Reach>,
    grabs: BTreeMap<Entity, SentGrab>,
    /// The session was brought to this time.
    advanced: Duration,
    /// Somebody asked to leave.
    leaving: bool,
    wanted: BTreeMap<BodyId, interest::Said>,
    retry: session::Retry,
    scratch: Vec<f64>,
    ledger: Ledger,
    /// Models that have come and are being read.
    being_read: Vec<([u8; 32], Task<Option<Arc<ModalModel>>>)>,
    /// The counts of sessions that are over.
    before: LinkStats,
}

impl NetGuest {
    pub(crate) fn join(mut config: JoinConfig, endpoint: Endpoint) -> Result<Self, RecordingError> {
        let recorder = config.record.take().map(|path| Recorder::create(&path)).transpose()?;
        Ok(Self::new(config, Source::Quic { endpoint, recorder }))
    }

    pub(crate) fn replay(config: JoinConfig, recording: Recording) -> Self {
        Self::new(config, Source::replay(recording))
    }

    fn new(config: JoinConfig, line: Source) -> Self {
        Self {
            line,
            config,
            began: Instant::now(),
            state: GuestState::Joining,
            role: Role::Hold,
            session: None,
            bodies: BTreeMap::new(),
            orphans: Vec::new(),
            placements: BTreeMap::new(),
            users: BTreeMap::new(),
            people: BTreeMap::new(),
            reaches: Vec::new(),
            grabs: BTreeMap::new(),
            advanced: Duration::ZERO,
            leaving: false,
            wanted: BTreeMap::new(),
            retry: session::Retry::default(),
            scratch: Vec::new(),
            ledger: Ledger::default(),
            being_read: Vec::new(),
            before: LinkStats::default(),
        }
    }

    /// Where we stand.
    pub fn state(&self) -> &GuestState {
        &self.state
    }

    /// What our token lets us do; [`Role::Hold`] before the host has said.
    pub fn role(&self) -> Role {
        self.role
    }

    /// The session, for those who want to know more: ticks, repairs, hidden states, playout delay. `None` before the connection is
    /// open.
    pub fn session(&self) -> Option<&GuestSession> {
        self.session.as_ref()
    }

    /// The session's view of the body that an entity follows.
    pub fn body(&self, body: RemoteBody) -> Option<&BodyView> {
        self.session.as_ref()?.body(body.0)
    }

    /// The state that a body is shown in, and the tick it stands for: that of the newer copy while this guest's own hand holds it
    /// ([`BodyView::predicted_hand`]), that of the confirmed stream otherwise. The host's tick of a newer copy may still be to come.
    pub fn shown(&self, body: RemoteBody) -> Option<(Tick, &State)> {
        let view = self.body(body)?;
        shown_of(view)
    }

    /// Leaves the session: the host is told, the connection is closed, and it is not tried again. The state is
    /// [`GuestState::Closed`] from the next frame on; bodies stay as they were last seen.
    pub fn leave(&mut self) {
        self.leaving = true;
    }

    /// The emulated link under the session, if there is one.
    pub fn emulation(&self) -> Option<Emulation> {
        self.line.endpoint().and_then(Endpoint::emulation)
    }

    /// Puts an emulated link under the session, another one, or none, at any time.
    pub fn set_emulation(&self, emulation: Option<Emulation>) {
        if let Some(endpoint) = self.line.endpoint() {
            endpoint.set_emulation(emulation);
        }
    }

    /// The transport below; `None` for a replay.
    pub fn endpoint(&self) -> Option<&Endpoint> {
        self.line.endpoint()
    }

    fn now(&self) -> Duration {
        self.began.elapsed()
    }

    fn flush(&mut self) {
        let Some(session) = &mut self.session else { return };
        while let Some(output) = session.poll_output() {
            self.line.send(output);
        }
    }

    pub(crate) fn metrics(&mut self) -> NetStats {
        let mut stats = NetStats::default();
        let line = self.line.stats();
        let mut links = self.before;
        if let Some(session) = &self.session {
            links.add_counts(&session.stats());
        }
        stats.count(&links, &self.ledger.sum(line.iter().map(|line| (PeerId::HOST, *line))));
        let (Some(session), Some(transport)) = (&self.session, line) else { return stats };
        stats.add(&session.stats(), &transport);
        for view in session.bodies() {
            let counts = view.counts();
            stats.shown += counts.stepped;
            stats.guessed += counts.guessed;
            stats.recovered += counts.repaired;
            stats.snapshots += counts.snapshots;
            let followed = self.bodies.get(&view.id());
            if let (Some(shown), Some(hidden), Some(followed)) = (view.visual(), view.confirmed(), followed)
                && followed.peak > 0.0
            {
                let off = shown.q.iter().zip(&hidden.q).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
                stats.shown_offset = stats.shown_offset.max(off / followed.peak);
            }
        }
        stats
    }
}

fn shown_of(view: &BodyView) -> Option<(Tick, &State)> {
    match view.predicted_hand() {
        Some(own) => Some((own.tick(), own.visual())),
        None => Some((view.tick(), view.visual()?)),
    }
}
