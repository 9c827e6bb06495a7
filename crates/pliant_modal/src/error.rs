//! What can go wrong, and what was expected instead.

use thiserror::Error;

/// A model whose parts do not fit together, or a patch that does not fit its model.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum ModelError {
    /// An array has another length than the counts ask for.
    #[error("{what}: expected {expected} entries, got {got}")]
    Length {
        /// Which array.
        what: &'static str,
        /// The length that the counts ask for.
        expected: usize,
        /// The length it has.
        got: usize,
    },
    /// A number is NaN, infinite or out of its range.
    #[error("{what}[{index}]: expected {expected}, got {got}")]
    Value {
        /// Which quantity.
        what: &'static str,
        /// Its place in the array (0 for a scalar).
        index: usize,
        /// The range that is allowed.
        expected: &'static str,
        /// What came.
        got: f64,
    },
    /// A triangle or a site names a vertex that is not there.
    #[error("{what}[{index}] names vertex {vertex}, but the surface has {count}")]
    Vertex {
        /// Which list.
        what: &'static str,
        /// The entry.
        index: usize,
        /// The vertex it names.
        vertex: u32,
        /// How many there are.
        count: usize,
    },
    /// A text or a list is longer than a model keeps.
    #[error("{what}: expected at most {most} {unit}, got {got}")]
    TooLong {
        /// Which one.
        what: &'static str,
        /// The longest that is kept.
        most: usize,
        /// What is counted.
        unit: &'static str,
        /// Its length.
        got: usize,
    },
    /// Nothing to simulate or nothing to see.
    #[error("a model needs at least one {0}")]
    Empty(&'static str),
}

/// A `.modal` file that cannot be read or written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FileError {
    /// The operating system refused.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: String,
        /// Why.
        source: std::io::Error,
    },
    /// What the file holds is no model.
    #[error("{path}: {source}")]
    In {
        /// The file.
        path: String,
        /// What is wrong with it.
        source: Box<FileError>,
    },
    /// The first bytes are not those of a `.modal` file.
    #[error("not a .modal file: expected it to begin with \"PLIANTMB\", got {0:?}")]
    Magic(Vec<u8>),
    /// A `.modal` file of another version of the format.
    #[error(".modal format version {got}; this build reads version {expected}: bake the body again")]
    Version {
        /// The version that this build reads.
        expected: u32,
        /// The version of the file.
        got: u32,
    },
    /// The file ends early or goes on too long.
    #[error("cut or padded .modal file: expected {expected} bytes of {what}, got {got}")]
    Truncated {
        /// Which part.
        what: &'static str,
        /// Bytes that the header promises.
        expected: u64,
        /// Bytes that are there.
        got: u64,
    },
    /// The content is not what was written.
    #[error("altered .modal file: its content hashes to {got}, its header says {expected}")]
    Hash {
        /// The hash in the header.
        expected: String,
        /// The hash of what came.
        got: String,
    },
    /// The description inside cannot be decoded.
    #[error("the .modal file's description cannot be decoded: {0}")]
    Decode(String),
    /// The parts do not fit together.
    #[error("the .modal file's content is inconsistent: {0}")]
    Model(#[from] ModelError),
}

/// A body that cannot be made, touched or stepped.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum StepError {
    /// A number from outside is NaN, infinite or out of its range; the body keeps its last good state.
    #[error("{what}: expected {expected}, got {got}")]
    Input {
        /// Which input.
        what: &'static str,
        /// What is allowed.
        expected: &'static str,
        /// What came.
        got: f64,
    },
    /// The state became non-finite in a step; the body was put back to the state before it (see [`Body::step`](crate::Body::step)).
    #[error("the step made {what} non-finite; the body was put back to the state before it")]
    Diverged {
        /// What became non-finite.
        what: &'static str,
    },
    /// A grab that is not (or no longer) on this body.
    #[error("no such grab on this body")]
    NoGrab,
    /// More grabs than a body takes.
    #[error("a body takes at most {limit} grabs")]
    TooManyGrabs {
        /// The limit.
        limit: usize,
    },
    /// A vertex that the surface does not have.
    #[error("vertex {vertex} is not on the surface, which has {count}")]
    Vertex {
        /// The vertex named.
        vertex: u32,
        /// How many there are.
        count: usize,
    },
    /// A slice of another length than the body's modes or vertices.
    #[error("{what}: expected {expected} entries, got {got}")]
    Length {
        /// Which slice.
        what: &'static str,
        /// The length expected.
        expected: usize,
        /// The length that came.
        got: usize,
    },
}

impl StepError {
    pub(crate) fn check(what: &'static str, expected: &'static str, ok: bool, got: f64) -> Result<(), Self> {
        if ok { Ok(()) } else { Err(Self::Input { what, expected, got }) }
    }
}

pub(crate) fn finite(what: &'static str, values: &[f64]) -> Result<(), StepError> {
    match values.iter().find(|v| !v.is_finite()) {
        None => Ok(()),
        Some(&got) => Err(StepError::Input { what, expected: "finite numbers", got }),
    }
}
