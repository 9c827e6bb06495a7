//! A seeded emulation of a bad network: one direction of a path, in virtual time.
//!
//! A [`EmulatedLink`] takes each payload with its send time and returns it at its arrival time, or
//! never. The link owns no clock. The same calls with the same seed give the same result, to the
//! microsecond, and the same [`EmulatedLink::hash`]. A path needs two links, one per direction,
//! each with its own seed.
//!
//! ```
//! use std::time::Duration;
//! use pliant_stream::emulator::{EmulatedLink, LinkConfig, Preset};
//!
//! let mut link = EmulatedLink::new(LinkConfig::preset(Preset::Paper1), 7);
//! link.send(Duration::ZERO, b"hello".to_vec(), 5);
//! if let Some(at) = link.next_wakeup() {
//!     assert!(at >= Duration::from_millis(98));
//!     assert_eq!(link.poll(at), Some(b"hello".to_vec()));
//! }
//! ```

mod link;
mod loss;
mod preset;

pub use link::{EmulatedLink, LinkConfig, LinkCounts};
pub use loss::{Loss, PathTrace, TraceEntry};
pub use preset::Preset;
