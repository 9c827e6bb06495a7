//! Peer to peer: every peer steps every body, and the peers exchange the targets of their hands.
//!
//! A peer steps at once, with its own hands as they are and the remote hands extrapolated. When
//! late targets arrive, the peer rolls back and steps again ([`LateInputRepair::Rollback`]), or
//! removes the difference by the paper's equations ([`LateInputRepair::Compensate`]). Its own hand
//! never waits. Each datagram repeats the last few ticks, and ticks that are still missing are
//! requested. Peers compare checksums of ticks for which all inputs are known. The peer with the
//! lowest number is right, and the others take its state when the checksums disagree. A late joiner
//! starts with its state too.
//!
//! Free bodies are stepped with their rigid frames, and bodies that relax with their viscoelastic
//! state.

mod body;
mod columns;
mod config;
mod inputs;
mod other;
mod session;

pub use body::{LateInputRepair, PeerBody};
pub use config::{PeerEvent, PeerSessionConfig};
#[cfg(test)]
pub(crate) use inputs::InputLog;
pub use session::PeerSession;
