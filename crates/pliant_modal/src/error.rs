//! Errors of models, files and steps.

use thiserror::Error;

/// Error of a model whose parts do not match, or of a patch that does not match its model.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum ModelError {
    /// An array has another length than the counts require.
    #[error("{what}: expected {expected} entries, got {got}")]
    Length {
        /// Name of the array.
        what: &'static str,
        /// Length that the counts require.
        expected: usize,
        /// Length of the array.
        got: usize,
    },
    /// A number is NaN, infinite or out of its range.
    #[error("{what}[{index}]: expected {expected}, got {got}")]
    Value {
        /// Name of the quantity.
        what: &'static str,
        /// Index in the array (0 for a scalar).
        index: usize,
        /// The allowed range.
        expected: &'static str,
        /// The value that was given.
        got: f64,
    },
    /// A triangle or a site names a vertex that does not exist.
    #[error("{what}[{index}] names vertex {vertex}, but the surface has {count}")]
    Vertex {
        /// Name of the list.
        what: &'static str,
        /// Index of the entry in the list.
        index: usize,
        /// The vertex that the entry names.
        vertex: u32,
        /// Number of vertices of the surface.
        count: usize,
    },
    /// A text or a list exceeds the maximum length in a model.
    #[error("{what}: expected at most {most} {unit}, got {got}")]
    TooLong {
        /// Name of the text or list.
        what: &'static str,
        /// Maximum length.
        most: usize,
        /// Unit of the length.
        unit: &'static str,
        /// Length of the text or list.
        got: usize,
    },
    /// The model has no mode, no surface vertex or no triangle.
    #[error("a model needs at least one {0}")]
    Empty(&'static str),
}

/// Error of reading or writing a `.modal` file.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FileError {
    /// The operating system reported an error.
    #[error("{path}: {source}")]
    Io {
        /// Path of the file.
        path: String,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The content of the file is not a valid model.
    #[error("{path}: {source}")]
    In {
        /// Path of the file.
        path: String,
        /// Error in the content.
        source: Box<FileError>,
    },
    /// The first bytes are not those of a `.modal` file.
    #[error("not a .modal file: expected it to begin with \"PLIANTMB\", got {0:?}")]
    Magic(Vec<u8>),
    /// The file has another version of the format.
    #[error(".modal format version {got}; this build reads version {expected}: bake the body again")]
    Version {
        /// The version that this build reads.
        expected: u32,
        /// The version of the file.
        got: u32,
    },
    /// The file is too short or too long.
    #[error("cut or padded .modal file: expected {expected} bytes of {what}, got {got}")]
    Truncated {
        /// Name of the part.
        what: &'static str,
        /// Number of bytes that the header promises.
        expected: u64,
        /// Number of bytes present.
        got: u64,
    },
    /// The content does not match the hash in the header.
    #[error("altered .modal file: its content hashes to {got}, its header says {expected}")]
    Hash {
        /// The hash in the header.
        expected: String,
        /// The hash of the content.
        got: String,
    },
    /// The description inside the file cannot be decoded.
    #[error("the .modal file's description cannot be decoded: {0}")]
    Decode(String),
    /// The parts of the model do not match.
    #[error("the .modal file's content is inconsistent: {0}")]
    Model(#[from] ModelError),
}

/// Error of making, changing or stepping a body.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum StepError {
    /// An input is NaN, infinite or out of range. The body keeps its last good state.
    #[error("{what}: expected {expected}, got {got}")]
    Input {
        /// Name of the input.
        what: &'static str,
        /// The allowed range.
        expected: &'static str,
        /// The value that was given.
        got: f64,
    },
    /// The state became non-finite in a step. The body returned to the state before the step (see
    /// [`Body::step`](crate::Body::step)).
    #[error("the step made {what} non-finite; the body was put back to the state before it")]
    Diverged {
        /// Name of the quantity that became non-finite.
        what: &'static str,
    },
    /// The grab does not exist on this body, or was released.
    #[error("no such grab on this body")]
    NoGrab,
    /// The attachment does not exist on this body, or has ended.
    #[error("no such attachment on this body")]
    NoAttachment,
    /// The shapes of held patches were made for another model.
    #[error("the shapes of held patches are those of another model")]
    OtherModel,
    /// The body already has the maximum number of grabs.
    #[error("a body takes at most {limit} grabs")]
    TooManyGrabs {
        /// Maximum number of grabs.
        limit: usize,
    },
    /// A vertex that the surface does not have.
    #[error("vertex {vertex} is not on the surface, which has {count}")]
    Vertex {
        /// The vertex that was given.
        vertex: u32,
        /// Number of vertices of the surface.
        count: usize,
    },
    /// The length of a slice does not match the modes or vertices of the body.
    #[error("{what}: expected {expected} entries, got {got}")]
    Length {
        /// Name of the slice.
        what: &'static str,
        /// The expected length.
        expected: usize,
        /// The length that was given.
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
