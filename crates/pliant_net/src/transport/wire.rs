//! Messages on the stream. Each is a length of four bytes, little-endian, and then that many bytes.
//!
//! The guest opens the one bidirectional stream and sends its token (16 bytes, or none) as the
//! first message. The host answers with a message of one byte, the guest's role (0 hold, 1 watch),
//! or with a goodbye. From then on, messages and datagrams belong to the application.
//!
//! The last message of either end is a goodbye: the largest length, and then one byte, the number
//! of the reason. QUIC sends the close of a connection once, and a stream until it has arrived.

use bytes::{Bytes, BytesMut};
use pliant_stream::DisconnectReason;
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
    /// The other end has said goodbye.
    #[error("goodbye: {0}")]
    Goodbye(DisconnectReason),
    /// The stream or the connection ended.
    #[error("the stream ended: {0}")]
    Ended(#[from] ReadExactError),
}

/// The length in place of which a goodbye follows.
const GOODBYE: u32 = u32::MAX;
/// Longest message, bytes.
pub(super) const LONGEST: usize = (GOODBYE - 1) as usize;

/// Step in which the message buffer grows, bytes. Memory grows with the bytes that have arrived,
/// not with the announced length.
const READ_STEP: usize = 64 << 10;

pub(super) async fn read_message(stream: &mut RecvStream, most: usize) -> Result<Bytes, ReadMessageError> {
    let mut length = [0; 4];
    stream.read_exact(&mut length).await?;
    let announced = u32::from_le_bytes(length);
    if announced == GOODBYE {
        let mut code = [0];
        stream.read_exact(&mut code).await?;
        return Err(ReadMessageError::Goodbye(reason_with_code(code[0])));
    }
    let announced = announced as usize;
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
    let length = u32::try_from(length.min(LONGEST)).unwrap_or(0);
    stream.write_all(&length.to_le_bytes()).await
}

/// Says goodbye, and waits until it has arrived.
pub(super) async fn write_goodbye(
    stream: &mut SendStream,
    reason: DisconnectReason,
) -> Result<(), WriteError> {
    let [a, b, c, d] = GOODBYE.to_le_bytes();
    stream.write_all(&[a, b, c, d, reason.code()]).await?;
    // A stream that is closed already, or a connection that has ended, needs no goodbye.
    let _ = stream.finish();
    let _ = stream.stopped().await;
    Ok(())
}

/// Returns the reason with a number. A later version may have more reasons.
pub(super) fn reason_with_code(code: u8) -> DisconnectReason {
    DisconnectReason::from_code(code).unwrap_or(DisconnectReason::Left)
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
