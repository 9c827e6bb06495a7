//! Errors of this crate.

use crate::{BodyId, PeerId, RigidId};

/// Says why a call was refused or bytes could not be decoded.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum StreamError {
    /// Received bytes ended too early.
    #[error("{what}: needs {needed} bytes at offset {offset}, {left} are left")]
    Truncated {
        /// The field that was being read.
        what: &'static str,
        /// Byte offset at which the field starts.
        offset: usize,
        /// Number of bytes that the field needs.
        needed: usize,
        /// Number of bytes that are left.
        left: usize,
    },
    /// Received bytes hold a value that the format does not allow.
    #[error("{what}: {found}, expected {expected}")]
    Invalid {
        /// The field.
        what: &'static str,
        /// The value found.
        found: String,
        /// The allowed values.
        expected: &'static str,
    },
    /// A setting is outside its range.
    #[error("setting {what}: {found}, expected {expected}")]
    Config {
        /// The setting.
        what: &'static str,
        /// The value found.
        found: String,
        /// The allowed range.
        expected: &'static str,
    },
    /// A number is NaN or infinite.
    #[error("{what} is not finite")]
    NotFinite {
        /// Name of the number.
        what: &'static str,
    },
    /// A slice has the wrong length.
    #[error("{what}: {found} values, expected {expected}")]
    Length {
        /// Name of the slice.
        what: &'static str,
        /// Length of the slice.
        found: usize,
        /// The length that the slice must have.
        expected: usize,
    },
    /// The session does not stream this body.
    #[error("body {0} is not part of this session")]
    UnknownBody(BodyId),
    /// The session does not have this rigid body.
    #[error("rigid body {0} is not part of this session")]
    UnknownRigid(RigidId),
    /// The session does not know this peer.
    #[error("peer {0} is not part of this session")]
    UnknownPeer(PeerId),
    /// No grab with this number is held.
    #[error("grab {0} is not held")]
    UnknownGrab(u16),
    /// A bounded table is full.
    #[error("{what} is full: at most {limit}")]
    Full {
        /// The table.
        what: &'static str,
        /// Largest number of entries.
        limit: usize,
    },
    /// A published tick does not exceed the last one.
    #[error("tick {found} published after tick {last}: ticks ascend")]
    TickOrder {
        /// The last tick published.
        last: u64,
        /// The tick given.
        found: u64,
    },
    /// The session's state does not allow the call.
    #[error("session is {state}: {what} needs {needed}")]
    State {
        /// The call.
        what: &'static str,
        /// The state of the session.
        state: &'static str,
        /// The state that the call needs.
        needed: &'static str,
    },
    /// The modal model or one of its patches or settings was rejected.
    #[error("modal model: {0}")]
    Model(String),
}
