//! Reliable messages between host and guest: encoded with postcard and checked after decoding.

use pliant_modal::{ContactState, GrabConfig, StepSettings};
use serde::{Deserialize, Serialize};

use super::{AccelerationCoding, WIDE_LIMIT};
use crate::session::{DisconnectReason, MAX_MESSAGE};
use crate::state::{
    MAX_GRABS, MAX_MODES, Placement, RigidState, TICK_LIMIT, UserInfo, UserLinkInfo, in_range,
};
use crate::{StreamError, Surroundings};

/// Longest name of a user or a body, bytes of UTF-8.
pub(crate) const MAX_NAME: usize = 64;
/// Largest number of models that a guest may name as cached.
pub(crate) const MAX_CACHED: usize = 256;
/// Largest number of bodies in a session.
pub(crate) const MAX_BODIES: usize = 1024;
/// Largest number of rigid bodies in a session.
pub(crate) const MAX_RIGIDS: usize = 1024;

/// Payload of the frames of a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Payload {
    /// The modal accelerations, as in the paper's stream.
    Accelerations(AccelerationCoding),
    /// The reactions of the grabs. The receiver has the model and steps it.
    Forces,
}

/// The stream that a guest requests from the host's encoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct StreamSubscription {
    /// Payload of the frames.
    pub payload: Payload,
    /// Largest number of modes (the first ones). The host lowers it to what the model has and the
    /// path carries.
    pub modes: u16,
    /// Number of earlier ticks that each frame repeats, 0..=7.
    pub repeats: u8,
    /// Number of frames per full refresh of (q, v); 0 for no refresh.
    pub refresh: u8,
}

/// A body as the host announces it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BodyInfo {
    /// Number of the body.
    pub body: u16,
    /// Display name, at most 64 bytes.
    pub name: String,
    /// Hash of the model.
    pub hash: [u8; 32],
    /// Number of modes in this guest's frames.
    pub modes: u16,
    /// Step settings of the body at the host.
    pub settings: StepSettings,
    /// What stands still around the body.
    pub around: Surroundings,
}

/// The encoder's own copy of the receiver's state at a tick. A receiver that takes it has no error
/// against the stream.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SnapshotBytes {
    /// Number of the body.
    pub body: u16,
    /// The tick after which the state holds.
    pub tick: u64,
    /// Modal coordinates, kg^1/2 m.
    pub q: Vec<f64>,
    /// Velocities.
    pub v: Vec<f64>,
    /// Accelerations.
    pub a: Vec<f64>,
    /// Viscoelastic state of a body that relaxes; empty for an elastic body.
    pub z: Vec<f64>,
    /// Modal forces that the streamed reactions do not explain (gravity, contacts); empty when the
    /// reactions explain all.
    pub load: Vec<f64>,
    /// Mean force of each hand on the body over the last step, N, world axes: user, grab, force.
    pub means: Vec<(u16, u16, [f64; 3])>,
    /// What the contacts of the last step have left for the next.
    pub contacts: ContactState,
    /// The rigid pose of a free body.
    pub pose: Option<RigidState>,
    /// The body sleeps from this tick on.
    pub resting: bool,
}

/// Messages from guest to host.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum GuestMessage {
    /// The first message.
    Hello {
        /// [`super::PROTOCOL_VERSION`].
        version: u16,
        /// Display name, at most 64 bytes.
        name: String,
        /// The requested stream.
        subscription: StreamSubscription,
        /// Hashes of models that need not be sent.
        cached: Vec<[u8; 32]>,
    },
    /// A grab begins.
    GrabBegin {
        /// The guest's number for the grab.
        grab: u16,
        /// The body.
        body: u16,
        /// Surface vertex at the center of the patch.
        vertex: u32,
        /// Radius of the patch, m.
        radius: f64,
        /// First target, world, m.
        target: [f64; 3],
        /// The hand's own spring and damper, capped at what devices have ([`GrabConfig::capped`]).
        hold: GrabConfig,
    },
    /// A grab ends.
    GrabEnd {
        /// The guest's number for the grab.
        grab: u16,
    },
    /// Requests a snapshot of a body.
    SnapshotRequest {
        /// The body.
        body: u16,
    },
    /// Limits how many modes of a body the host sends.
    Interest {
        /// The body.
        body: u16,
        /// The limit; 0 sends nothing, and `None` sends what the guest subscribed to.
        modes: Option<u16>,
    },
    /// The last message.
    Goodbye {
        /// The reason.
        reason: DisconnectReason,
    },
    /// An impulse on a body, at the host's next tick.
    Impulse {
        /// The body.
        body: u16,
        /// The surface vertex.
        vertex: u32,
        /// The impulse, N s, world axes.
        impulse: [f64; 3],
    },
}

/// Messages from host to guest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum HostMessage {
    /// The answer to [`GuestMessage::Hello`].
    Welcome {
        /// [`super::PROTOCOL_VERSION`].
        version: u16,
        /// The guest's user number.
        user: u16,
        /// Length of a step, ns.
        step_ns: u64,
        /// Newmark's beta of the acceleration streams.
        beta: f64,
        /// Newmark's gamma of the acceleration streams.
        gamma: f64,
        /// The other users in the session.
        users: Vec<UserInfo>,
    },
    /// A body joins the session, or its step settings change. Its model follows if the guest lacks
    /// it, then a snapshot.
    BodyAdded(BodyInfo),
    /// The host has placed an anchored body, after its [`HostMessage::BodyAdded`].
    BodyPlaced {
        /// The body.
        body: u16,
        /// Where it is.
        placement: Placement,
    },
    /// A body leaves the session.
    BodyRemoved {
        /// The body.
        body: u16,
    },
    /// A piece of a model's bytes, in order.
    ModelChunk {
        /// Hash of the model.
        hash: [u8; 32],
        /// Offset of the piece in the model's bytes.
        offset: u64,
        /// Length of the whole model, bytes.
        total: u64,
        /// The piece.
        bytes: Vec<u8>,
    },
    /// The state of a body.
    Snapshot(SnapshotBytes),
    /// A user joined.
    UserJoined(UserInfo),
    /// A user left.
    UserLeft {
        /// User number.
        user: u16,
        /// The reason.
        reason: DisconnectReason,
    },
    /// Quality of the host's links to its guests.
    Links(Vec<UserLinkInfo>),
    /// The host refused or ended a grab.
    GrabRefused {
        /// The guest's number for the grab.
        grab: u16,
    },
    /// The last message.
    Goodbye {
        /// The reason.
        reason: DisconnectReason,
    },
    /// A rigid body joins the session. All that rest are known from this and from
    /// [`HostMessage::RigidsRest`]; of those that move, datagrams tell.
    RigidAdded {
        /// Number of the rigid body.
        rigid: u16,
        /// Name, at most 64 bytes.
        name: String,
        /// The tick after which the state holds.
        tick: u64,
        /// Where it is, and how it moves.
        state: RigidState,
    },
    /// Rigid bodies that have come to rest, and where.
    RigidsRest {
        /// The tick after which they rest.
        tick: u64,
        /// Numbers and states, at most 1,024.
        rigids: Vec<(u16, RigidState)>,
    },
    /// A rigid body leaves the session.
    RigidRemoved {
        /// Number of the rigid body.
        rigid: u16,
    },
}

pub(super) fn decode<'a, M: Deserialize<'a>>(what: &'static str, bytes: &'a [u8]) -> Result<M, StreamError> {
    if bytes.len() > MAX_MESSAGE {
        return Err(StreamError::Invalid {
            what,
            found: format!("{} bytes", bytes.len()),
            expected: "at most MAX_MESSAGE bytes",
        });
    }
    let invalid = |found: String, expected| StreamError::Invalid { what, found, expected };
    match postcard::take_from_bytes(bytes) {
        Ok((message, [])) => Ok(message),
        Ok((_, rest)) => Err(invalid(format!("{} bytes too many", rest.len()), "one message")),
        Err(e) => Err(invalid(e.to_string(), "a postcard message of this version")),
    }
}

pub(super) fn encode<M: Serialize>(message: &M) -> Vec<u8> {
    // Every message is plain data, so serializing it to a growing buffer cannot fail.
    postcard::to_stdvec(message).unwrap_or_default()
}

pub(super) fn check(
    what: &'static str,
    ok: bool,
    found: impl ToString,
    expected: &'static str,
) -> Result<(), StreamError> {
    if ok { Ok(()) } else { Err(StreamError::Invalid { what, found: found.to_string(), expected }) }
}

/// Returns whether all numbers are within [`WIDE_LIMIT`].
pub(super) fn wide_range(values: &[f64]) -> bool {
    values.iter().all(|x| x.abs() <= WIDE_LIMIT)
}

/// Checks a hand's own spring and damper, and caps them at what devices have.
pub(crate) fn check_hold(hold: GrabConfig) -> Result<GrabConfig, StreamError> {
    match hold.check() {
        Ok(()) => Ok(hold.capped()),
        Err(error) => Err(StreamError::Config {
            what: "hold",
            found: error.to_string(),
            expected: "a spring above 0 N/m, a damper of 0 s or more",
        }),
    }
}

fn check_user(user: &UserInfo) -> Result<(), StreamError> {
    check("name", user.name.len() <= MAX_NAME, user.name.len(), "at most 64 bytes")
}

impl GuestMessage {
    /// Encodes this message.
    pub fn encode(&self) -> Vec<u8> {
        encode(self)
    }

    /// Decodes arbitrary bytes and checks every bound.
    ///
    /// # Errors
    /// Returns [`StreamError::Invalid`] with the name of the field.
    pub fn decode(bytes: &[u8]) -> Result<Self, StreamError> {
        let mut message: Self = decode("guest message", bytes)?;
        match &mut message {
            Self::Hello { name, subscription, cached, .. } => {
                check("name", name.len() <= MAX_NAME, name.len(), "at most 64 bytes")?;
                check("cached models", cached.len() <= MAX_CACHED, cached.len(), "at most 256")?;
                check("repeats", subscription.repeats <= 7, subscription.repeats, "0..=7")?;
                check("modes", subscription.modes >= 1, subscription.modes, "at least 1")?;
            }
            Self::GrabBegin { radius, target, hold, .. } => {
                check("radius", *radius >= 0.0 && in_range(&[*radius]), radius, "0..=1e9 m")?;
                check("target", in_range(target), format!("{target:?}"), "finite meters")?;
                *hold = check_hold(*hold)?;
            }
            Self::Impulse { impulse, .. } => {
                check("impulse", in_range(impulse), format!("{impulse:?}"), "finite N s, at most 1e9")?;
            }
            Self::GrabEnd { .. }
            | Self::SnapshotRequest { .. }
            | Self::Interest { .. }
            | Self::Goodbye { .. } => {}
        }
        Ok(message)
    }
}

impl HostMessage {
    /// Encodes this message.
    pub fn encode(&self) -> Vec<u8> {
        encode(self)
    }

    /// Decodes arbitrary bytes and checks every bound.
    ///
    /// # Errors
    /// Returns [`StreamError::Invalid`] with the name of the field.
    pub fn decode(bytes: &[u8]) -> Result<Self, StreamError> {
        let message: Self = decode("host message", bytes)?;
        match &message {
            Self::Welcome { step_ns, beta, gamma, users, .. } => {
                check("step", (10_000..=1_000_000_000).contains(step_ns), step_ns, "10 us to 1 s")?;
                check("beta", (0.0..=1.0).contains(beta), beta, "0..=1")?;
                check("gamma", (0.0..=1.0).contains(gamma), gamma, "0..=1")?;
                users.iter().try_for_each(check_user)?;
            }
            Self::BodyAdded(info) => {
                check("name", info.name.len() <= MAX_NAME, info.name.len(), "at most 64 bytes")?;
                let modes = usize::from(info.modes);
                check("modes", (1..=MAX_MODES).contains(&modes), modes, "1..=4096")?;
                let settings = &info.settings;
                if let Err(error) = settings.check() {
                    check("settings", false, error, "settings in their ranges")?;
                }
                if let Err(error) = info.around.check() {
                    check("surroundings", false, error, "at most 256 obstacles in their ranges")?;
                }
            }
            Self::Snapshot(s) => {
                check("snapshot tick", s.tick < TICK_LIMIT, s.tick, "below 2^48")?;
                let modes = s.q.len();
                check("snapshot modes", (1..=MAX_MODES).contains(&modes), modes, "1..=4096")?;
                let equal = s.v.len() == modes
                    && s.a.len() == modes
                    && [&s.load, &s.z].iter().all(|x| x.is_empty() || x.len() == modes);
                check("snapshot lengths", equal, s.v.len(), "the same for q, v, a, z and load")?;
                let hands = s.means.len();
                check("snapshot hands", hands <= MAX_GRABS, hands, "at most 64")?;
                let finite = in_range(&s.q)
                    && s.means.iter().all(|(_, _, pull)| in_range(pull))
                    && in_range(&s.v)
                    && in_range(&s.z);
                let finite = finite && wide_range(&s.a) && wide_range(&s.load);
                let finite = finite && s.contacts.is_valid() && s.pose.is_none_or(|pose| pose.is_valid());
                check("snapshot", finite, "a number out of range", "finite numbers")?;
            }
            Self::BodyPlaced { placement, .. } => {
                let expected = "a unit quaternion, a scale above 1e-6 and numbers below 1e6";
                check("placement", placement.is_valid(), format!("{placement:?}"), expected)?;
            }
            Self::UserJoined(user) => check_user(user)?,
            Self::RigidAdded { name, tick, state, .. } => {
                check("name", name.len() <= MAX_NAME, name.len(), "at most 64 bytes")?;
                check("rigid tick", *tick < TICK_LIMIT, tick, "below 2^48")?;
                check("rigid body", state.is_valid(), format!("{state:?}"), "a pose in range")?;
            }
            Self::RigidsRest { tick, rigids } => {
                check("rigid tick", *tick < TICK_LIMIT, tick, "below 2^48")?;
                check("rigid bodies", rigids.len() <= MAX_RIGIDS, rigids.len(), "at most 1024")?;
                let valid = rigids.iter().all(|(_, state)| state.is_valid());
                check("rigid bodies", valid, "a number out of range", "poses in range")?;
            }
            Self::BodyRemoved { .. }
            | Self::RigidRemoved { .. }
            | Self::ModelChunk { .. }
            | Self::UserLeft { .. }
            | Self::Links(_)
            | Self::GrabRefused { .. }
            | Self::Goodbye { .. } => {}
        }
        Ok(message)
    }
}
