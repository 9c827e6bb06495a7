//! What can go wrong, and what was expected.

use crate::{BodyId, PeerId};

/// Why a call was refused or bytes could not be read.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum StreamError {
    /// Bytes from outside ended too early.
    #[error("{what}: needs {needed} bytes at offset {offset}, {left} are left")]
    Truncated {
        /// The field that was being read.
        what: &'static str,
        /// Where it starts.
        offset: usize,
        /// How many bytes it needs.
        needed: usize,
        /// How many there are.
        left: usize,
    },
    /// Bytes from outside hold a value that the format does not allow.
    #[error("{what}: {found}, expected {expected}")]
    Invalid {
        /// The field.
        what: &'static str,
        /// What it held.
        found: String,
        /// What it may hold.
        expected: &'static str,
    },
    /// A setting is outside its range.
    #[error("setting {what}: {found}, expected {expected}")]
    Config {
        /// The setting.
        what: &'static str,
        /// Its value.
        found: String,
        /// Its range.
        expected: &'static str,
    },
    /// A number is NaN or infinite.
    #[error("{what} is not finite")]
    NotFinite {
        /// The number's name.
        what: &'static str,
    },
    /// A slice has the wrong length.
    #[error("{what}: {found} values, expected {expected}")]
    Length {
        /// The slice's name.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length it must have.
        expected: usize,
    },
    /// A body that this session does not stream.
    #[error("body {0} is not part of this session")]
    UnknownBody(BodyId),
    /// A peer that this session does not know.
    #[error("peer {0} is not part of this session")]
    UnknownPeer(PeerId),
    /// A grab that is not held.
    #[error("grab {0} is not held")]
    UnknownGrab(u16),
    /// A bounded table is full.
    #[error("{what} is full: at most {limit}")]
    Full {
        /// The table.
        what: &'static str,
        /// Its bound.
        limit: usize,
    },
    /// A tick that does not follow the last one.
    #[error("tick {found} published after tick {last}: ticks ascend")]
    TickOrder {
        /// The last tick published.
        last: u64,
        /// The tick offered.
        found: u64,
    },
    /// The session is not in a state in which the call makes sense.
    #[error("session is {state}: {what} needs {needed}")]
    State {
        /// What was asked.
        what: &'static str,
        /// The state it is in.
        state: &'static str,
        /// The state it must be in.
        needed: &'static str,
    },
    /// The modal model or one of its patches refused.
    #[error("modal model: {0}")]
    Model(String),
}
