//! Streams soft bodies over a network that loses packets, and repairs the loss at the receiver.
//!
//! A host steps the bodies and streams them. Guests track the bodies, hold them and receive the
//! forces on their hands. Every type in this crate is a state machine: it owns no socket, no clock,
//! no thread and no randomness without a seed, and maps
//! `(now, datagrams in) -> (datagrams out, state)`.
//!
//! The example runs a host and a guest over a lossy network in virtual time. The caller carries the
//! bytes, here through the [`emulator`]. The module [`session`] says when to call which function:
//!
//! ```
//! use std::{sync::Arc, time::Duration};
//! use pliant_modal::{Body, BodyConfig, ModalModel};
//! use pliant_stream::emulator::{EmulatedLink, LinkConfig, Preset};
//! use pliant_stream::{
//!     BodyId, Channel, GuestSessionConfig, GuestSession, HostSessionConfig, HostSession, PeerId, StepSettings,
//!     TickState,
//! };
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let (id, guest_id, start) = (BodyId(1), PeerId(1), Duration::ZERO);
//! let model = Arc::new(ModalModel::read("../../assets/bud.modal")?);
//! let mut body = Body::new(model.clone(), BodyConfig { step: 1.0 / 40.0, ..Default::default() })?;
//! let mut host = HostSession::new(HostSessionConfig::default())?; // 40 ticks a second
//! host.add_body(id, "bud", model.clone(), StepSettings::default())?;
//! let mut guest = GuestSession::new(GuestSessionConfig::default(), 1200)?;
//! guest.add_cached_model(model);
//! host.connect(start, guest_id, 1200)?;
//! guest.connect(start)?;
//!
//! let lossy = LinkConfig::preset(Preset::Paper1); // 9 % lost, 196 ms there and back
//! let [mut down, mut up] = [1, 2].map(|seed| EmulatedLink::<Vec<u8>>::new(lossy.clone(), seed));
//! for tick in 1..=400 {
//!     let now = tick as u32 * Duration::from_millis(25);
//!     body.push(0, [0.0, 0.0, 0.1 * (0.1 * tick as f64).sin()])?;
//!     body.step()?;
//!     let (q, v, a) = (body.q(), body.v(), body.a());
//!     let state = TickState { tick, q, v, a, z: &[], pose: None, grabs: &[], resting: false };
//!     host.publish(now, id, &state)?;
//!     // Datagrams may be lost; messages are the transport's to deliver.
//!     while let Some(bytes) = down.poll(now) { guest.on_datagram(now, &bytes); }
//!     while let Some(bytes) = up.poll(now) { host.on_datagram(now, guest_id, &bytes); }
//!     host.update(now);
//!     guest.update(now);
//!     while let Some(out) = host.poll_output() {
//!         match out.channel {
//!             Channel::Datagram => down.send(now, out.bytes.to_vec(), out.bytes.len()),
//!             Channel::Message => guest.on_message(now, &out.bytes),
//!         }
//!     }
//!     while let Some(out) = guest.poll_output() {
//!         match out.channel {
//!             Channel::Datagram => up.send(now, out.bytes.to_vec(), out.bytes.len()),
//!             Channel::Message => host.on_message(now, guest_id, &out.bytes),
//!         }
//!     }
//! }
//! let view = guest.body(id).ok_or("the body has not arrived")?;
//! println!("shown: tick {} of 400, {} frames lost", view.tick(), down.counts().lost);
//! assert!(view.tick() > 380 && down.counts().lost > 0);
//! # Ok(())
//! # }
//! ```
//!
//! | module | contents |
//! | --- | --- |
//! | [`session`] | [`HostSession`], [`GuestSession`]: handshake, models, snapshots, streaming, resync |
//! | [`peer`] | peer to peer: every peer steps, only hand targets are sent, late ones are stepped again |
//! | [`recovery`] | loss repair: prediction and compensation after the paper, and force-driven recovery |
//! | [`codec`] | closed-loop frame encoding, in which rounding does not add up; quantization per mode |
//! | [`wire`] | byte formats; every parser accepts arbitrary bytes |
//! | [`watch`] | what watchers without number get over relays: catalog, models, bodies, hands |
//! | [`emulator`] | a seeded emulator of a bad network |
//! | [`newmark`] | the identities that make compensation exact |

#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

pub mod clock;
pub mod codec;
pub mod emulator;
mod error;
mod hand_playout;
mod link;
pub mod newmark;
pub mod peer;
pub mod playout;
mod prediction;
pub mod recovery;
mod replica;
pub mod session;
#[cfg(test)]
mod side_by_side;
mod state;
mod surroundings;
pub mod watch;
pub mod wire;

pub use error::StreamError;
pub use hand_playout::HandPlayout;
pub use newmark::Newmark;
pub use pliant_modal::StepSettings;
pub use recovery::{Playout, Policy, Predict, RecoveryConfig, RepairCounts};
pub use session::{
    Channel, DisconnectReason, GuestEvent, GuestSession, GuestSessionConfig, HostEvent, HostSession,
    HostSessionConfig, LinkStats, MAX_MESSAGE, MIN_DATAGRAM, Output, PredictedHand, StreamedBody,
    StreamedRigid,
};
pub use state::{
    BodyId, GrabKey, GrabState, MAGNITUDE_LIMIT, MAX_GRABS, MAX_IMPULSE_SPEED, MAX_MODES, PeerId, Placement,
    RigidId, RigidState, Role, State, TICK_LIMIT, Tick, TickState, UserId, UserInfo, UserLinkInfo, next_free,
};
pub use surroundings::Surroundings;
