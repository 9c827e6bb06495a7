//! Settings and events of a peer.

use std::time::Duration;

use super::body::Repair;
use crate::session::DisconnectReason;
use crate::state::{PeerId, UserId};

/// Settings of a peer.
#[derive(Debug, Clone, PartialEq)]
pub struct PeerConfig {
    /// This peer's number; all have different ones, and the lowest is right when states disagree.
    pub user: UserId,
    /// A name for people, at most 64 bytes.
    pub name: String,
    /// Length of a step, s. Default: 1/40.
    pub step: f64,
    /// Default: [`Repair::Rollback`].
    pub repair: Repair,
    /// Ticks over which the shown error fades. Default: 6.
    pub blend_ticks: u16,
    /// Earlier ticks that each datagram repeats, at most 15. Default: 4.
    pub repeats: usize,
    /// A peer that is silent for so long is gone. Default: 10 s.
    pub idle_timeout: Duration,
    /// Begin with a state of one's own (the first peer) or wait for another's. Default: true.
    pub founds: bool,
}

impl Default for PeerConfig {
    fn default() -> Self {
        Self {
            user: UserId(1),
            name: "peer".into(),
            step: 1.0 / 40.0,
            repair: Repair::default(),
            blend_ticks: 6,
            repeats: 4,
            idle_timeout: Duration::from_secs(10),
            founds: true,
        }
    }
}

/// What happened at a peer.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum PeerEvent {
    /// This peer has a state and steps.
    Started,
    /// Another peer is here.
    Joined {
        /// Number.
        user: UserId,
        /// Name.
        name: String,
    },
    /// Another peer is gone.
    Left {
        /// Number.
        user: UserId,
        /// Why.
        reason: DisconnectReason,
    },
    /// A connection is over before its peer was let in: it said no hello in time, or one that does not hold. No
    /// [`PeerEvent::Joined`] came before. Close the connection.
    TurnedAway {
        /// Which connection.
        peer: PeerId,
        /// Why.
        reason: DisconnectReason,
    },
    /// Another peer's state was taken over.
    Resynced {
        /// Whose.
        from: UserId,
    },
}
