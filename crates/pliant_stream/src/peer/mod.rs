//! Peer to peer: every peer steps every body, and only the hands' targets cross.
//!
//! A peer steps at once, with its own hands as they are and the others' as they are forecast; when their targets arrive,
//! late, it goes back and steps again ([`Repair::Rollback`]), or takes the difference out by the paper's equations
//! ([`Repair::Compensate`]). Its own hand never waits. Each datagram says the last few ticks again; what is still missing
//! is asked for. Checksums of ticks for which all inputs are known are compared: the peer with the lowest number is right,
//! and the others take its state over when they disagree. A late joiner begins with its state too.
//!
//! Free bodies are stepped with their rigid frames, bodies that relax with their flows.

mod body;
mod config;
mod inputs;
mod other;
mod session;
mod wire;

pub use body::{PeerBody, Repair};
pub use config::{PeerConfig, PeerEvent};
pub use session::{PeerSession, digest};
pub use wire::{
    HeldAt, InputTick, PeerBodyState, PeerDatagram, PeerFrame, PeerGrip, PeerMessage, StateCheck,
};
