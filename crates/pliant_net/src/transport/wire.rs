//! Messages on the stream. Each is a length of four bytes, little-endian, and then that many bytes.
//!
//! The guest opens the one bidirectional stream and sends its token (16 bytes, or none) as the
//! first message. The host answers with a message of one byte, the guest's role (0 hold, 1 watch).
//! From then on, messages and datagrams belong to the application.

use bytes::{Bytes, BytesMut};
use quinn::{ReadExactError, RecvStream, SendStream, WriteError};
use thiserror::Error;

use super::invite::Token;

/// Why no message could be read.
#[derive(Debug, Error)]
pub(super) enum ReadMessageError {
    /// The peer announced a message longer than allowed.
    #[error("a message of {announced} bytes where at most {most} are allowed")]
    TooLong {
        /// Bytes announced.
        announced: usize,
        /// Bytes allowed.
        most: usize,
    },
    /// The stream or the connection ended.
    #[error("the stream ended: {0}")]
    Ended(#[from] ReadExactError),
}

/// Step in which the message buffer grows, bytes. Memory grows with the bytes that have arrived,
/// not with the announced length.
const READ_STEP: usize = 64 << 10;

pub(super) async fn read_message(stream: &mut RecvStream, most: usize) -> Result<Bytes, ReadMessageError> {
    let mut length = [0; 4];
    stream.read_exact(&mut length).await?;
    let announced = u32::from_le_bytes(length) as usize;
    if announced > most {
        return Err(ReadMessageError::TooLong { announced, most });
    }
    let mut message = BytesMut::new();
    while message.len() < announced {
        let have = message.len();
        message.resize(announced.min(have + READ_STEP), 0);
        stream.read_exact(&mut message[have..]).await?;
    }
    Ok(message.freeze())
}

pub(super) async fn write_prefix(stream: &mut SendStream, length: usize) -> Result<(), WriteError> {
    // `Endpoint::send_message` refuses longer messages.
    let length = u32::try_from(length).unwrap_or(u32::MAX);
    stream.write_all(&length.to_le_bytes()).await
}

pub(super) fn token_to_message(token: Option<Token>) -> Vec<u8> {
    token.map(|token| token.0.to_vec()).unwrap_or_default()
}

/// Returns the token in a first message, or `Err` if the message is not a token.
pub(super) fn token_from_message(message: &[u8]) -> Result<Option<Token>, ()> {
    match message.len() {
        0 => Ok(None),
        _ => <[u8; 16]>::try_from(message).map(|bytes| Some(Token(bytes))).map_err(|_| ()),
    }
}

/// Longest first message, bytes.
pub(super) const TOKEN_MESSAGE: usize = 16;
