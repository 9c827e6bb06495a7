//! Byte formats of datagrams and messages.
//!
//! Datagrams are encoded by hand, and `docs/protocol.md` describes them byte by byte. Reliable
//! messages use postcard. Every parser accepts arbitrary bytes: it checks lengths, finiteness and
//! ranges, allocates at most in proportion to the bytes given, and returns an error instead of
//! panicking.

pub(crate) mod bits;
mod bytes;
mod datagram;
mod frame;
mod hold;
mod inputs;
mod message;
mod peer_message;
mod rigids;
mod slice;

pub(crate) use bytes::{Reader, WIDE_LIMIT, Writer, round24};
pub use datagram::{Clock, Datagram, Nack, NackRun, ReceiverReport, TargetEntry, Targets};
pub(crate) use datagram::{MAX_NACK_RUN, MAX_NACK_RUNS, MAX_TARGETS};
pub(crate) use frame::MAX_PARTS;
pub use frame::{AccelerationCoding, Accelerations, FrameGrab, Repeat, RepeatGrab, TickFrame};
pub use inputs::{HeldAt, ImpulseAt, InputTick, Inputs, StateCheck};
pub(crate) use inputs::{MAX_HELD, MAX_IMPULSES, MAX_TICKS};
pub use message::{BodyInfo, GuestMessage, HostMessage, Payload, SnapshotBytes, StreamSubscription};
pub(crate) use message::{MAX_BODIES, MAX_CACHED, MAX_NAME, MAX_RIGIDS, check_hold};
pub(crate) use peer_message::{MAX_ADDRESS, MAX_PEERS, MAX_SETS};
pub use peer_message::{PeerBodyState, PeerFrame, PeerHandState, PeerMessage, PeerShapes};
pub use rigids::RigidPoses;
pub(crate) use rigids::{ENTRY as RIGID_ENTRY, HEADER as RIGID_HEADER, MAX_ENTRIES as MAX_RIGID_ENTRIES};
pub use slice::{Slice, SliceEntry};

/// Version of the formats in this module. The two sides of a session must agree.
pub const PROTOCOL_VERSION: u16 = 9;
