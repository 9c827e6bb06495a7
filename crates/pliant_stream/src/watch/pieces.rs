//! Long contents in pieces: a model or a surface as the frames of one group.

use crate::StreamError;

/// Length of a piece, bytes.
pub const MAX_PIECE: usize = 1 << 16;

/// Cuts contents into the frames of a group, each of at most [`MAX_PIECE`] bytes.
pub fn pieces(contents: &[u8]) -> impl Iterator<Item = &[u8]> {
    contents.chunks(MAX_PIECE)
}

/// Puts the pieces of contents of a known length together. Memory grows with what arrives, and
/// never beyond that length.
#[derive(Debug)]
pub struct Assembler {
    expected: usize,
    bytes: Vec<u8>,
}

impl Assembler {
    /// Expects contents of `expected` bytes, as the catalog says.
    ///
    /// # Errors
    /// [`StreamError::Full`] for more bytes than `most`.
    pub fn new(expected: u64, most: usize) -> Result<Self, StreamError> {
        match usize::try_from(expected) {
            Ok(expected) if expected <= most => Ok(Self { expected, bytes: Vec::new() }),
            _ => Err(StreamError::Full { what: "bytes of watched contents", limit: most }),
        }
    }

    /// Takes the next piece. Returns the contents once they are complete.
    ///
    /// # Errors
    /// [`StreamError::Invalid`] for an empty piece, and for more bytes than expected.
    pub fn push(&mut self, piece: &[u8]) -> Result<Option<Vec<u8>>, StreamError> {
        let left = self.expected - self.bytes.len();
        if piece.is_empty() || piece.len() > left {
            return Err(StreamError::Invalid {
                what: "piece of watched contents",
                found: format!("{} bytes with {left} missing", piece.len()),
                expected: "a part of what is missing",
            });
        }
        self.bytes.extend_from_slice(piece);
        Ok((self.bytes.len() == self.expected).then(|| std::mem::take(&mut self.bytes)))
    }

    /// The share that has arrived, 0 to 1.
    pub fn progress(&self) -> f64 {
        if self.expected == 0 { 1.0 } else { self.bytes.len() as f64 / self.expected as f64 }
    }
}
