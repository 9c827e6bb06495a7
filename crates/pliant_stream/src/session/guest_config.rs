//! Settings and events of a guest.

use std::sync::Arc;
use std::time::Duration;

use pliant_modal::ModalModel;

use super::DisconnectReason;
use crate::recovery::RecoveryConfig;
use crate::state::{BodyId, UserId};

/// Settings of a guest.
#[derive(Debug, Clone, PartialEq)]
pub struct GuestConfig {
    /// A name for people, at most 64 bytes.
    pub name: String,
    /// How loss is repaired. Default: [`RecoveryConfig::default`].
    pub recovery: RecoveryConfig,
    /// Take at most so many modes of each body: for weak machines and thin links. Default: all.
    pub modes: Option<u16>,
    /// Step a newer copy of each body that this guest holds, in which its own hands do not wait for the round trip; see
    /// [`BodyView::predicted_hand`](super::BodyView::predicted_hand). Default: true.
    pub predict_own_hand: bool,
    /// Most bytes of models that a host may send, those that are here and those on their way together; a host that sends
    /// more is left with [`DisconnectReason::Full`]. Models that the application named itself do not count. Default: 1 GiB.
    pub model_bytes: u64,
    /// Models that have arrived are handed out as bytes ([`GuestEvent::ModelCame`]) for the caller to read elsewhere, and taken back by
    /// [`GuestSession::give_model`](super::GuestSession::give_model): reading one takes long for a frame. Default: false, they are read at once.
    pub models_apart: bool,
    /// A host that is silent for so long is gone. Default: 10 s.
    pub idle_timeout: Duration,
}

impl Default for GuestConfig {
    fn default() -> Self {
        Self {
            name: "guest".to_owned(),
            recovery: RecoveryConfig::default(),
            modes: None,
            predict_own_hand: true,
            model_bytes: 1 << 30,
            models_apart: false,
            idle_timeout: Duration::from_secs(10),
        }
    }
}

/// What happened at a guest.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum GuestEvent {
    /// The host let us in.
    Welcomed {
        /// Our number.
        user: UserId,
    },
    /// The host announced a body; its model may still be on the way.
    BodyAnnounced {
        /// Which.
        body: BodyId,
        /// Its name.
        name: String,
    },
    /// Bytes of a model arrived.
    ModelProgress {
        /// Which model.
        hash: [u8; 32],
        /// Bytes that are here.
        received: u64,
        /// Bytes in all.
        total: u64,
    },
    /// A model is here, to be read ([`GuestConfig::models_apart`]).
    ModelCame {
        /// Which model.
        hash: [u8; 32],
        /// A `.modal` file, if the host is honest.
        bytes: Arc<[u8]>,
    },
    /// Model and state of a body are here: it can be shown.
    BodyReady {
        /// Which.
        body: BodyId,
        /// Its model, for the caller's cache too.
        model: Arc<ModalModel>,
    },
    /// The host steps a body otherwise from now on: [`BodyView::info`](super::BodyView::info) says how. Hands on it stay.
    BodyChanged {
        /// Which.
        body: BodyId,
    },
    /// A body left the session.
    BodyGone {
        /// Which.
        body: BodyId,
    },
    /// The state of a body was taken over anew.
    Resynced {
        /// Which.
        body: BodyId,
    },
    /// Frames of a body fail: it stands still until they come again.
    Stalled {
        /// Which.
        body: BodyId,
    },
    /// Somebody else came.
    UserJoined {
        /// Number.
        user: UserId,
        /// Name.
        name: String,
    },
    /// Somebody else left.
    UserLeft {
        /// Number.
        user: UserId,
    },
    /// The host did not accept one of our grabs, or ended it.
    GrabRefused {
        /// Our number for it.
        grab: u16,
    },
    /// The session is over.
    Closed {
        /// Why.
        reason: DisconnectReason,
    },
}
