//! Messages among peers beside their sessions: introductions, and the check that all peers have the
//! same bodies.

use bytes::{Buf, BufMut, Bytes, BytesMut};
use pliant_stream::{BodyId, UserId};

use crate::transport::Invite;

/// Kind: a message of the peers' session.
const SESSION: u8 = 0;
/// Kind: a new peer's join request to the peer of the invite, with its own invite and scene.
const INTRODUCE: u8 = 16;
/// Kind: the answer to the join request, with the new peer's number and the other peers.
const WELCOME: u8 = 17;
/// Kind: a new peer's introduction to the other peers.
const MEMBER: u8 = 18;

/// Most bodies among peers.
pub(super) const MOST_BODIES: usize = 256;
/// Most other peers, as in [`pliant_stream::peer`].
pub(super) const MOST_PEERS: usize = 64;
const LONGEST_INVITE: usize = 512;

/// What all peers must have in common: the step (ns) and the bodies, each with the digest of its
/// model and step settings.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct PeerScene {
    pub(super) step_ns: u64,
    pub(super) bodies: Vec<(BodyId, [u8; 32])>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum MeshMessage {
    Session(Bytes),
    Introduce { scene: PeerScene, invite: Invite },
    Welcome { number: UserId, from: UserId, others: Vec<(UserId, Invite)> },
    Member { number: UserId, scene: PeerScene, invite: Invite },
}

impl MeshMessage {
    pub(super) fn to_message(&self) -> Bytes {
        let mut to = BytesMut::new();
        match self {
            Self::Session(bytes) => {
                to.put_u8(SESSION);
                to.put_slice(bytes);
            }
            Self::Introduce { scene, invite } => {
                to.put_u8(INTRODUCE);
                put_scene(&mut to, scene);
                put_invite(&mut to, invite);
            }
            Self::Welcome { number, from, others } => {
                to.put_u8(WELCOME);
                to.put_u16_le(number.0);
                to.put_u16_le(from.0);
                let others = &others[..others.len().min(MOST_PEERS)];
                to.put_u8(others.len() as u8);
                for (number, invite) in others {
                    to.put_u16_le(number.0);
                    put_invite(&mut to, invite);
                }
            }
            Self::Member { number, scene, invite } => {
                to.put_u8(MEMBER);
                to.put_u16_le(number.0);
                put_scene(&mut to, scene);
                put_invite(&mut to, invite);
            }
        }
        to.freeze()
    }

    /// Reads any bytes. Returns `None` for an invalid message.
    pub(super) fn read(mut bytes: Bytes) -> Option<Self> {
        let from = &mut bytes;
        let message = match from.try_get_u8().ok()? {
            SESSION => return Some(Self::Session(bytes)),
            INTRODUCE => Self::Introduce { scene: get_scene(from)?, invite: get_invite(from)? },
            WELCOME => {
                let [number, of] = [from.try_get_u16_le().ok()?, from.try_get_u16_le().ok()?].map(UserId);
                let count = usize::from(from.try_get_u8().ok()?);
                let other = |_| Some((UserId(from.try_get_u16_le().ok()?), get_invite(from)?));
                let others = (0..count).map(other).collect::<Option<Vec<_>>>()?;
                if others.len() > MOST_PEERS {
                    return None;
                }
                Self::Welcome { number, from: of, others }
            }
            MEMBER => {
                let number = UserId(from.try_get_u16_le().ok()?);
                Self::Member { number, scene: get_scene(from)?, invite: get_invite(from)? }
            }
            _ => return None,
        };
        bytes.is_empty().then_some(message)
    }
}

fn put_scene(to: &mut BytesMut, scene: &PeerScene) {
    to.put_u64_le(scene.step_ns);
    let bodies = &scene.bodies[..scene.bodies.len().min(MOST_BODIES)];
    to.put_u16_le(bodies.len() as u16);
    for (body, hash) in bodies {
        to.put_u16_le(body.0);
        to.put_slice(hash);
    }
}

fn get_scene(from: &mut Bytes) -> Option<PeerScene> {
    let step_ns = from.try_get_u64_le().ok()?;
    let count = usize::from(from.try_get_u16_le().ok()?);
    if count > MOST_BODIES {
        return None;
    }
    let body = |_| {
        let body = BodyId(from.try_get_u16_le().ok()?);
        let mut hash = [0; 32];
        from.try_copy_to_slice(&mut hash).ok()?;
        Some((body, hash))
    };
    Some(PeerScene { step_ns, bodies: (0..count).map(body).collect::<Option<Vec<_>>>()? })
}

fn put_invite(to: &mut BytesMut, invite: &Invite) {
    let invite = invite.to_string();
    let invite = if invite.len() <= LONGEST_INVITE { invite.as_str() } else { "" };
    to.put_u16_le(invite.len() as u16);
    to.put_slice(invite.as_bytes());
}

fn get_invite(from: &mut Bytes) -> Option<Invite> {
    let length = usize::from(from.try_get_u16_le().ok()?);
    if length > LONGEST_INVITE || length > from.len() {
        return None;
    }
    std::str::from_utf8(&from.split_to(length)).ok()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::{Fingerprint, Token};

    #[test]
    fn what_peers_say_is_written_and_read_and_checked() {
        let invite = Invite::new("192.0.2.7:4433".parse().unwrap(), Fingerprint([7; 32]));
        let scene =
            PeerScene { step_ns: 25_000_000, bodies: vec![(BodyId(3), [1; 32]), (BodyId(9), [2; 32])] };
        let messages = [
            MeshMessage::Introduce {
                scene: scene.clone(),
                invite: invite.clone().with_token(Token([5; 16])),
            },
            MeshMessage::Welcome {
                number: UserId(3),
                from: UserId(1),
                others: vec![(UserId(4), invite.clone()), (UserId(2), invite.clone())],
            },
            MeshMessage::Member { number: UserId(3), scene, invite },
        ];
        for message in messages {
            let bytes = message.to_message();
            assert_eq!(MeshMessage::read(bytes.clone()), Some(message.clone()));
            for cut in 0..bytes.len() {
                assert_eq!(MeshMessage::read(bytes.slice(..cut)), None, "cut to {cut} of {message:?}");
            }
            // A message with any byte changed is refused or read as something else, and never
            // panics.
            for at in 0..bytes.len() {
                let mut wrong = bytes.to_vec();
                wrong[at] ^= 0xa5;
                MeshMessage::read(wrong.into());
            }
        }
        let session = MeshMessage::Session(Bytes::from_static(b"abc"));
        assert_eq!(MeshMessage::read(session.to_message()), Some(session));
        assert_eq!(MeshMessage::read(Bytes::from_static(&[99])), None);
    }
}
