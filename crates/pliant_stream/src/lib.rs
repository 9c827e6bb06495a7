//! What crosses the network, and what repairs it when some of it does not arrive.
//!
//! A host steps soft bodies and streams them; guests follow, hold on to them and feel them. Everything here is a state
//! machine: no socket, no clock, no thread, no randomness without a seed. `(now, datagrams in) -> (datagrams out, state)`.
//!
//! A whole session, a host and a guest and two hands over a network that loses packets, in virtual time:
//!
//! ```
//! use std::sync::Arc;
//! use pliant_modal::ModalModel;
//! use pliant_stream::{RecoveryConfig, emulator::{LinkConfig, Preset}, experiment::Experiment};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let model = Arc::new(ModalModel::read("../../assets/bud.modal")?);
//! let network = LinkConfig::preset(Preset::Paper1); // 9 % lost, 196 ms there and back
//! let session = Experiment { seconds: 5.0, ..Experiment::new(model, network, RecoveryConfig::default()) };
//! let seen = session.run()?;
//! println!("{} frames lost, shown within {:.3} % of the truth (rms)", seen.lost, seen.rms_percent);
//! assert!(seen.lost > 0 && seen.rms_percent < 0.5);
//! # Ok(())
//! # }
//! ```
//!
//! Over a network of one's own: a [`HostSession`] and a [`GuestSession`], whose bytes the caller carries ([`session`] says when to call what;
//! [`pair`] does it over the emulator).
//!
//! | module | what it holds |
//! | --- | --- |
//! | [`session`] | [`HostSession`] and [`GuestSession`]: hello, models by hash, snapshot, streaming, resync, goodbye |
//! | [`peer`] | peer to peer: every peer steps, only targets cross, late ones are stepped again |
//! | [`recovery`] | what a receiver does about loss: the paper's prediction and compensation, and the force-driven way |
//! | [`encoder`] | frames in a closed loop: rounding does not add up |
//! | [`quanta`] | how coarse each mode may be |
//! | [`wire`] | the bytes; every parser takes anything |
//! | [`emulator`] | a seeded bad network |
//! | [`pair`] | host and guests joined by emulated links in virtual time: for tests |
//! | [`experiment`] | a session measured: errors, forces, bytes |
//! | [`newmark`] | the identities that make compensation exact |

#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

pub mod check;
pub mod clock;
pub mod emulator;
pub mod encoder;
mod error;
pub mod experiment;
mod experiment_peers;
mod link;
pub mod newmark;
pub mod pair;
pub mod peer;
pub mod playout;
pub mod quanta;
pub mod recovery;
mod replica;
pub mod session;
#[cfg(test)]
mod side_by_side;
mod state;
pub mod wire;

pub use error::StreamError;
pub use newmark::Newmark;
pub use pliant_modal::StepSettings;
pub use recovery::{Playout, Policy, Predict, RecoveryConfig, RepairCounts};
pub use session::{
    BodyView, Channel, EndReason, GuestConfig, GuestEvent, GuestSession, HostConfig, HostEvent, HostSession,
    LinkStats, MAX_MESSAGE, MIN_DATAGRAM, Output, OwnHand,
};
pub use state::{
    BodyId, GrabKey, GrabState, MAGNITUDE_LIMIT, MAX_GRABS, MAX_MODES, PeerId, Pose, State, TICK_LIMIT, Tick,
    TickState, UserId,
};
