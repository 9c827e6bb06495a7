//! The bytes: datagrams written by hand and described byte by byte in `docs/protocol.md`; reliable messages in postcard.
//!
//! Every parser takes any bytes at all: it checks lengths, finiteness and range, allocates at most in proportion to the
//! bytes it was given, and returns an error instead of panicking.

mod bits;
mod bytes;
mod datagram;
mod frame;
mod message;
mod slice;

pub(crate) use bytes::{Reader, WIDE_LIMIT, Writer, round24};
pub use datagram::{Clock, Datagram, Nack, NackRun, Report, TargetEntry, Targets};
pub(crate) use datagram::{MAX_NACK_RUNS, MAX_TARGETS};
pub(crate) use frame::MAX_PARTS;
pub use frame::{AccelerationCoding, Accelerations, Frame, FrameGrab, Repeat, RepeatGrab};
pub use message::{BodyInfo, GuestMessage, HostMessage, Payload, SnapshotBytes, StreamSubscription};
pub(crate) use message::{MAX_BODIES, MAX_CACHED, MAX_NAME};
pub use slice::{Slice, SliceEntry};

/// Version of everything in this module. The two sides of a session must agree.
pub const PROTOCOL_VERSION: u16 = 2;
