//! Bevy plugin that carries Pliant's streaming sessions over QUIC: soft bodies that several people hold at the same time.
//!
//! A host steps the bodies; guests see them, take hold of them and feel them. Both are one plugin:
//!
//! ```no_run
//! use bevy::prelude::*;
//! use pliant_body::{ModalBody, PliantBodyPlugin};
//! use pliant_net::{HostConfig, JoinConfig, NetPlugin, SharedBody};
//!
//! # fn host() -> Result<(), pliant_net::transport::TransportError> {
//! let net = NetPlugin::host(HostConfig::default())?;
//! println!("join with {}", net.invite().unwrap());
//! App::new().add_plugins((DefaultPlugins, PliantBodyPlugin::default(), net)).add_systems(Startup, setup).run();
//! # Ok(()) }
//!
//! fn setup(mut commands: Commands, assets: Res<AssetServer>) {
//!     commands.spawn((ModalBody::new(assets.load("pip.modal")), SharedBody::named("pip")));
//! }
//!
//! # fn guest(invite: &str) -> Result<(), Box<dyn std::error::Error>> {
//! // Elsewhere: the bodies arrive by themselves.
//! let net = NetPlugin::join(&invite.parse()?, JoinConfig::default())?;
//! App::new().add_plugins((DefaultPlugins, PliantBodyPlugin::default(), net)).run();
//! # Ok(()) }
//! ```
//!
//! | Written by you | Read by you |
//! | --- | --- |
//! | [`SharedBody`] on a body (host) | [`NetStats`]: round trip, loss, repair, rates |
//! | [`Grab`](pliant_body::Grab) and [`GrabOf`](pliant_body::GrabOf), on guests as on a host | [`GrabForce`](pliant_body::GrabForce): the reaction, in step with what is shown |
//! | [`HostConfig`], [`JoinConfig`] | [`User`], [`UserLink`], [`Hands`]: who is there, how well reached, holding what |
//! | | [`BodyArrived`], [`BodyLeft`], [`UserJoined`], [`UserLeft`], [`GrabRefused`], [`SessionClosed`]: messages |
//! | | [`SeenHands`] on a guest's bodies: where the others' hands are |
//!
//! Whoever is dragged by the pointer, by a script or by a device on a guest's [`Driven::Remote`](pliant_body::Driven::Remote) body makes a
//! [`Grab`](pliant_body::Grab) as for a body of its own; this plugin sends it and writes the force.
//!
//! Nothing that comes from outside stops an app: it is checked, counted ([`NetStats::rejected`]) and logged at debug. What is defended and
//! what is not is in `THREATS.md`.
//!
//! [`transport`] is the layer below, which knows neither bodies nor Bevy.
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod felt;
mod figures;
mod guest;
mod host;
mod phase;
mod place;
mod plugin;
mod scene;
mod seen;
pub mod transport;
mod user;

pub use figures::{
    LOSS_IN, LOSS_OUT, NACKS, NetStats, RATE_IN, RATE_OUT, RECOVERED, ROUND_TRIP, SHOWN_OFFSET,
};
pub use guest::{GuestState, JoinConfig, NetGuest};
pub use host::{Holding, HostConfig, NetHost};
pub use plugin::{NetPlugin, NetSystems};
pub use scene::SharedBody;
pub use seen::{BodyArrived, BodyLeft, GrabRefused, RemoteBody, SeenHand, SeenHands, SessionClosed};
pub use transport::{Access, Emulation, Fingerprint, HostOptions, Identity, Invite, JoinOptions, Token};
pub use user::{HandOf, Hands, User, UserJoined, UserLeft, UserLink, Yourself, colour_of};

/// What the end of a connection is to the session.
fn end_of(reason: &transport::CloseReason) -> pliant_stream::EndReason {
    use pliant_stream::EndReason;
    use transport::CloseReason;
    match reason {
        CloseReason::ByUs | CloseReason::ByPeer { .. } => EndReason::Left,
        CloseReason::TimedOut => EndReason::Silent,
        CloseReason::Protocol { .. } => EndReason::Protocol,
        CloseReason::Refused { .. } => EndReason::Refused,
        _ => EndReason::Lost,
    }
}
