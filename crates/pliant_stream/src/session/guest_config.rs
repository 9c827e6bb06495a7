//! Settings and events of a guest.

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::ModalModel;

use super::DisconnectReason;
use crate::recovery::RecoveryConfig;
use crate::state::{BodyId, Placement, RigidId, UserId, UserInfo};

/// Settings of a guest.
#[derive(Debug, Clone, PartialEq)]
pub struct GuestSessionConfig {
    /// Display name, at most 64 bytes.
    pub name: String,
    /// Loss repair. Default: [`RecoveryConfig::default`].
    pub recovery: RecoveryConfig,
    /// Largest number of modes of each body that the guest receives, for slow machines and narrow
    /// links. Of a body with reduced elasticity all come, refreshed the more rarely. Accelerations
    /// of all are in each frame. Default: all.
    pub modes: Option<u16>,
    /// Steps a newer copy of each body that this guest holds, in which the guest's own hands do not
    /// wait for the round trip; see
    /// [`StreamedBody::predicted_hand`](super::StreamedBody::predicted_hand). Default: true.
    pub predict_hand: bool,
    /// Largest number of bytes of models that a host may send, counting complete models and
    /// downloads in progress. The guest leaves a host that exceeds the limit, with
    /// [`DisconnectReason::Full`]. Models that the application added itself do not count. Default:
    /// 1 GiB.
    pub model_bytes: u64,
    /// Passes downloaded models out as bytes ([`GuestEvent::ModelCame`]), so that the caller can
    /// decode them elsewhere and return them by
    /// [`GuestSession::give_model`](super::GuestSession::give_model). Decoding takes long compared
    /// with a frame. Default: false, the session decodes at once.
    pub models_apart: bool,
    /// Silence after which the host counts as gone. Default: 10 s.
    pub idle_timeout: Duration,
}

impl Default for GuestSessionConfig {
    fn default() -> Self {
        Self {
            name: "guest".to_owned(),
            recovery: RecoveryConfig::default(),
            modes: None,
            predict_hand: true,
            model_bytes: 1 << 30,
            models_apart: false,
            idle_timeout: Duration::from_secs(10),
        }
    }
}

/// An event at a guest.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum GuestEvent {
    /// The host accepted the guest.
    Welcomed {
        /// The guest's user number.
        user: UserId,
    },
    /// The host announced a body. Its model may still be missing.
    BodyAnnounced {
        /// The body.
        body: BodyId,
        /// Name of the body.
        name: String,
    },
    /// Bytes of a model arrived.
    ModelProgress {
        /// Hash of the model.
        hash: [u8; 32],
        /// Number of bytes received.
        received: u64,
        /// Total number of bytes.
        total: u64,
    },
    /// A model has arrived and must be decoded ([`GuestSessionConfig::models_apart`]).
    ModelCame {
        /// Hash of the model.
        hash: [u8; 32],
        /// A `.modal` file. The bytes come from the host and are not checked.
        bytes: Arc<[u8]>,
    },
    /// Model and state of a body have arrived, and the body can be shown.
    BodyReady {
        /// The body.
        body: BodyId,
        /// Its model, which the caller may also cache.
        model: Arc<ModalModel>,
    },
    /// The host changed the step settings of a body.
    /// [`StreamedBody::info`](super::StreamedBody::info) has the new settings. Hands on the body
    /// stay.
    BodyChanged {
        /// The body.
        body: BodyId,
    },
    /// The host placed an anchored body, or moved it.
    BodyPlaced {
        /// The body.
        body: BodyId,
        /// Where it is.
        placement: Placement,
    },
    /// A body left the session.
    BodyGone {
        /// The body.
        body: BodyId,
    },
    /// A rigid body has come into the session
    /// ([`GuestSession::rigid`](super::GuestSession::rigid)).
    RigidArrived {
        /// The rigid body.
        rigid: RigidId,
        /// Its name.
        name: String,
    },
    /// A rigid body has left the session.
    RigidGone {
        /// The rigid body.
        rigid: RigidId,
    },
    /// The state of a body was replaced by a snapshot.
    Resynced {
        /// The body.
        body: BodyId,
    },
    /// Frames of a body are missing. The body stands still until frames arrive again.
    Stalled {
        /// The body.
        body: BodyId,
    },
    /// Another user joined.
    UserJoined(UserInfo),
    /// Another user left.
    UserLeft {
        /// User number.
        user: UserId,
        /// The reason.
        reason: DisconnectReason,
    },
    /// The host refused or ended one of the guest's grabs.
    GrabRefused {
        /// The guest's number for the grab.
        grab: u16,
    },
    /// The session is over.
    Closed {
        /// The reason.
        reason: DisconnectReason,
    },
}
