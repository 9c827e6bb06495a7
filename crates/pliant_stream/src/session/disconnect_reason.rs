//! Why a session was refused or has ended.

use serde::{Deserialize, Serialize};

/// Says why a session was refused or has ended.
///
/// The reason crosses the network as a number ([`DisconnectReason::code`]). The last four reasons
/// are known to one side only and cross as [`DisconnectReason::Lost`].
/// [`Display`](std::fmt::Display) gives a text for people.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, thiserror::Error)]
#[serde(into = "u8", try_from = "u8")]
#[non_exhaustive]
pub enum DisconnectReason {
    /// One side left.
    #[error("left")]
    Left,
    /// Nothing arrived for the idle timeout, or the other side did not introduce itself in time.
    #[error("nothing arrived for too long")]
    Silent,
    /// The transport lost the connection.
    #[error("connection lost")]
    Lost,
    /// One side broke the protocol.
    #[error("protocol broken")]
    Protocol,
    /// The two sides have different protocol versions.
    #[error("other protocol version")]
    VersionMismatch,
    /// The host did not accept the guest.
    #[error("refused by the host")]
    Refused,
    /// The host or peer has no room left, or a model exceeds
    /// [`GuestSessionConfig::model_bytes`](super::GuestSessionConfig::model_bytes).
    #[error("full")]
    Full,
    /// The path's datagrams are too small, see [`MIN_DATAGRAM`](super::MIN_DATAGRAM).
    #[error("datagrams too small")]
    SmallDatagrams,
    /// The two peers have different bodies, step settings, surroundings or steps.
    #[error("other bodies or settings")]
    SceneMismatch,
    /// The host asks for a token, and none was presented.
    #[error("the host asks for a token and the invite has none")]
    MissingToken,
    /// The host does not know the token.
    #[error("wrong token")]
    UnknownToken,
    /// The token has expired.
    #[error("the token has expired")]
    ExpiredToken,
    /// The token only permits to watch, and among peers everybody holds.
    #[error("the token only permits to watch, and among peers everybody holds")]
    WatchOnly,
    /// The user number is another peer's.
    #[error("the user number is taken")]
    NumberTaken,
    /// The host removed the guest.
    #[error("removed by the host")]
    Kicked,
    /// The same user has connected anew, and the new connection replaces this one.
    #[error("replaced by a newer connection of the same user")]
    Replaced,
    /// The other side does not read the messages that are sent to it.
    #[error("messages are not read")]
    Unread,
    /// The host presents another key than the invite names: it is another host, or a man in the
    /// middle.
    #[error("the host shows another key than the invite says")]
    WrongKey,
    /// The host's name has no address.
    #[error("the host's name does not resolve")]
    UnknownHost,
    /// This side's own settings do not make a session.
    #[error("the session cannot begin with these settings")]
    InvalidSettings,
    /// The recording of a session has been played to its end.
    #[error("the recording is over")]
    RecordingOver,
}

impl DisconnectReason {
    /// The reasons that cross the network, each at the index of its number.
    const ON_THE_WIRE: [Self; 17] = [
        Self::Left,
        Self::Silent,
        Self::Lost,
        Self::Protocol,
        Self::VersionMismatch,
        Self::Refused,
        Self::Full,
        Self::SmallDatagrams,
        Self::SceneMismatch,
        Self::MissingToken,
        Self::UnknownToken,
        Self::ExpiredToken,
        Self::WatchOnly,
        Self::NumberTaken,
        Self::Kicked,
        Self::Replaced,
        Self::Unread,
    ];

    /// Returns whether the ends have lost each other, and neither has sent the other away: nothing
    /// arrived, the connection was lost, messages were not read in time, or a host did not answer.
    pub fn is_loss(self) -> bool {
        matches!(self, Self::Silent | Self::Lost | Self::Unread | Self::UnknownHost)
    }

    /// Number of the reason on the wire.
    pub fn code(self) -> u8 {
        let known = Self::ON_THE_WIRE.contains(&self);
        if known { self as u8 } else { Self::Lost as u8 }
    }

    /// Returns the reason with this number, or `None` for a number that this version does not know.
    pub fn from_code(code: u8) -> Option<Self> {
        Self::ON_THE_WIRE.get(usize::from(code)).copied()
    }
}

impl From<DisconnectReason> for u8 {
    fn from(reason: DisconnectReason) -> Self {
        reason.code()
    }
}

impl TryFrom<u8> for DisconnectReason {
    type Error = &'static str;

    fn try_from(code: u8) -> Result<Self, Self::Error> {
        Self::from_code(code).ok_or("an unknown reason")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_reason_has_the_same_number_in_messages_and_as_a_code() {
        for (code, reason) in (0..).zip(DisconnectReason::ON_THE_WIRE) {
            assert_eq!(postcard::to_allocvec(&reason).unwrap(), [code]);
            assert_eq!(postcard::from_bytes(&[code]), Ok(reason));
            assert_eq!((reason.code(), DisconnectReason::from_code(code)), (code, Some(reason)));
        }
        // What only one side can know is neither sent nor taken.
        for local in [DisconnectReason::WrongKey, DisconnectReason::RecordingOver] {
            assert_eq!(local.code(), DisconnectReason::Lost.code());
            assert!(postcard::from_bytes::<DisconnectReason>(&[local as u8]).is_err());
        }
    }
}
