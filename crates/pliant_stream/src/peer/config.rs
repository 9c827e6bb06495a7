//! Settings and events of a peer.

use std::time::Duration;

use super::body::LateInputRepair;
use crate::session::DisconnectReason;
use crate::state::{PeerId, UserId};

/// Settings of a peer.
#[derive(Debug, Clone, PartialEq)]
pub struct PeerSessionConfig {
    /// Number of this peer. Every peer has a different one, and the lowest number is right when
    /// states disagree. A peer that does not found the session may have [`UserId::HOST`], which
    /// stands for none: it requests a number from the first peer that it connects to.
    pub user: UserId,
    /// Display name, at most 64 bytes.
    pub name: String,
    /// Where peers that join later reach this peer, at most 512 bytes. The session passes it on.
    /// Default: empty.
    pub address: String,
    /// Length of a step, s. Default: 1/40.
    pub step: f64,
    /// Repair of late inputs. Default: [`LateInputRepair::Rollback`].
    pub repair: LateInputRepair,
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

impl Default for PeerSessionConfig {
    fn default() -> Self {
        Self {
            user: UserId(1),
            name: "peer".into(),
            address: String::new(),
            step: 1.0 / 40.0,
            repair: LateInputRepair::default(),
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
    /// Another peer requests a number. Answer with
    /// [`PeerSession::welcome`](super::PeerSession::welcome), or close the connection.
    JoinRequest {
        /// The connection.
        peer: PeerId,
    },
    /// This peer has been given its number.
    Welcomed {
        /// User number.
        user: UserId,
        /// The other peers in the session, as user numbers and addresses. Connect to them.
        others: Vec<(UserId, String)>,
    },
    /// Another peer joined.
    Joined {
        /// The connection.
        peer: PeerId,
        /// User number.
        user: UserId,
        /// Display name.
        name: String,
        /// Where peers that join later reach the other peer; empty if nowhere.
        address: String,
    },
    /// Another peer is connected with peers that this one does not have in its session. Of two
    /// that are introduced to each other, the one with the higher number should connect.
    Introduced {
        /// The connection that introduced them.
        peer: PeerId,
        /// User numbers and addresses.
        others: Vec<(UserId, String)>,
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
