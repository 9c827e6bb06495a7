//! Settings and events of a peer.

use std::time::Duration;

use super::body::Repair;
use crate::session::DisconnectReason;
use crate::state::{PeerId, UserId};

/// Settings of a peer.
#[derive(Debug, Clone, PartialEq)]
pub struct PeerConfig {
    /// Number of this peer. Every peer has a different one, and the lowest number is right when
    /// states disagree.
    pub user: UserId,
    /// Display name, at most 64 bytes.
    pub name: String,
    /// Length of a step, s. Default: 1/40.
    pub step: f64,
    /// Repair of late inputs. Default: [`Repair::Rollback`].
    pub repair: Repair,
    /// Number of ticks over which the visible error fades. Default: 6.
    pub blend_ticks: u16,
    /// Number of earlier ticks that each datagram repeats, at most 15. Default: 4.
    pub repeats: usize,
    /// Silence after which a peer counts as gone. Default: 10 s.
    pub idle_timeout: Duration,
    /// Starts with this peer's own state (the first peer) instead of waiting for another's.
    /// Default: true.
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

/// An event at a peer.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum PeerEvent {
    /// This peer has a state and steps.
    Started,
    /// Another peer joined.
    Joined {
        /// User number.
        user: UserId,
        /// Display name.
        name: String,
    },
    /// Another peer left.
    Left {
        /// User number.
        user: UserId,
        /// The reason.
        reason: DisconnectReason,
    },
    /// A connection ended before its peer was accepted, because its hello was missing or invalid.
    /// No [`PeerEvent::Joined`] preceded this event. Close the connection.
    TurnedAway {
        /// The connection.
        peer: PeerId,
        /// The reason.
        reason: DisconnectReason,
    },
    /// This peer took another peer's state.
    Resynced {
        /// User number of the other peer.
        from: UserId,
    },
}
