//! Bevy plugin that carries Pliant's streaming sessions over QUIC: soft bodies that several people hold at the same time.
//!
//! A host steps the bodies (and may play too); guests see them, take hold of them and feel them. Among peers ([`NetPlugin::peer`]) every one steps
//! them. All are one plugin:
//!
//! ```no_run
//! use bevy::prelude::*;
//! use pliant_body::{ModalBody, PliantBodyPlugin};
//! use pliant_net::{HostConfig, JoinConfig, NetPlugin, SharedBody};
//!
//! # fn host() -> Result<(), pliant_net::NetError> {
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
//! | [`HostConfig`], [`JoinConfig`], [`PeerConfig`] | [`User`], [`UserLink`], [`Hands`]: who is there, how well reached, holding what |
//! | [`Holding`] on a host's body: whose hands may be on it | [`BodyArrived`], [`BodyLeft`], [`UserJoined`], [`UserLeft`], [`GrabRefused`]: messages |
//! | [`Interest`] on a guest's body: how many modes it wants | [`SessionJoined`], [`SessionLost`], [`SessionClosed`]: messages |
//! | | [`RemoteHands`] on a guest's bodies: where the others' hands are |
//!
//! Whoever is dragged by the pointer, by a script or by a device on a guest's [`Driven::Remote`](pliant_body::Driven::Remote) body makes a
//! [`Grab`](pliant_body::Grab) as for a body of its own; this plugin sends it and writes the force.
//!
//! A guest that loses its host waits and joins again ([`JoinConfig::rejoin`]), under the number it had: its key is its lasting name. What it receives may
//! be recorded ([`JoinConfig::record`]) and played again ([`NetPlugin::replay`]).
//!
//! Nothing that comes from outside stops an app: it is checked, counted ([`NetStats::rejected`]) and logged at debug. What is defended and
//! what is not is in `THREATS.md`.
//!
//! [`transport`] is the layer below, which knows neither bodies nor Bevy.
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod guest;
mod host;
mod metrics;
mod patch_kinematics;
mod peer;
mod phase;
mod plugin;
mod recording;
mod remote;
mod scene;
mod session_transform;
pub mod transport;
mod user;

pub use metrics::{
    DROPPED, JITTER, LOSS_IN, LOSS_OUT, NACKS, NetStats, QUEUE, RATE_IN, RATE_OUT, RECOVERED, ROUND_TRIP,
    SHOWN_OFFSET,
};
/// The networks that an [`Emulation`] is made of.
pub use pliant_stream::emulator;

pub use guest::{CameraInterest, GuestState, Interest, JoinConfig, NetGuest};
pub use host::{Holding, HostConfig, NetHost};
pub use peer::{NetPeer, PeerConfig, PeerState};
pub use plugin::{NetError, NetPlugin, NetSystems};
pub use recording::{Recording, RecordingError};
pub use remote::{
    BodyArrived, BodyLeft, GrabRefused, RemoteBody, RemoteHand, RemoteHands, SessionClosed, SessionJoined,
    SessionLost,
};
pub use scene::SharedBody;
pub use transport::{
    Access, Emulation, Fingerprint, Grant, HostOptions, Identity, Invite, JoinOptions, Role, Token,
};
pub use user::{HandOf, Hands, User, UserJoined, UserLeft, UserLink, Yourself, color_of};

/// What the end of a connection is to the session.
fn end_of(reason: &transport::CloseReason) -> pliant_stream::DisconnectReason {
    use pliant_stream::DisconnectReason;
    use transport::CloseReason;
    match reason {
        CloseReason::ByUs => DisconnectReason::Left,
        CloseReason::ByPeer { reason, .. } => *reason,
        CloseReason::TimedOut => DisconnectReason::Silent,
        CloseReason::Protocol { .. } => DisconnectReason::Protocol,
        CloseReason::Refused { .. } => DisconnectReason::Refused,
        _ => DisconnectReason::Lost,
    }
}
