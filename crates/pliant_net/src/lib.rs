//! Bevy plugin for Pliant sessions, in which several people hold the same soft bodies. Sessions
//! have QUIC connections of their own, or ride on a game's netcode ([`CarrierPort`]).
//!
//! A host steps the bodies and may also hold them. Guests see the bodies, hold them and feel their
//! forces. Among peers ([`NetPlugin::peer`]) every peer steps the bodies. One plugin covers all
//! three cases:
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
//! | You write | You read |
//! | --- | --- |
//! | [`SharedBody`] on a body of the host | [`NetStats`]: round trip, loss, repair, rates |
//! | [`Grab`](pliant_body::Grab) and [`GrabOf`](pliant_body::GrabOf), on guests and on the host | [`GrabForce`](pliant_body::GrabForce): the reaction, in step with the displayed shape |
//! | [`HostConfig`], [`JoinConfig`], [`PeerConfig`] | [`User`], [`UserLink`], [`Hands`]: the users, the quality of their connections, their grabs |
//! | [`Holding`] on a host's body: whose hands may be on it | [`BodyArrived`], [`BodyLeft`], [`UserJoined`], [`UserLeft`], [`GrabRefused`]: messages, and events for observers |
//! | [`SharedRigid`] on a crate of the host's game | [`RigidArrived`], [`RigidLeft`] on guests: messages, and events for observers |
//! | [`Interest`] on a guest's body: how many modes the guest wants | [`SessionJoined`], [`SessionLost`], [`SessionClosed`], [`SessionFailed`]: messages, and events for observers |
//! | [`SessionCommands`]: sessions that begin and end while the app runs, also over the app's own [`Carrier`] | [`SessionState`]: a resource |
//! | | [`RemoteHands`] on a guest's bodies: where the other users' hands are |
//!
//! A pointer, a script or a device drags a guest's [`Driven::Remote`](pliant_body::Driven::Remote)
//! body with a [`Grab`](pliant_body::Grab), like a local body. This plugin sends the grab and
//! writes the force.
//!
//! A guest that loses its host waits and joins again ([`JoinConfig::rejoin`]). The guest keeps its
//! user number, because its key identifies it permanently. The guest can record the data that it
//! receives ([`JoinConfig::record`]), and [`NetPlugin::replay`] plays such a recording.
//!
//! No data from the network stops an app: invalid data is counted ([`NetStats::rejected`]) and
//! logged at debug level. `THREATS.md` lists the attacks that the crate defends against and those
//! that it does not.
//!
//! [`transport`] is the layer below. It knows neither bodies nor Bevy.
#![cfg_attr(docsrs, feature(doc_cfg))]
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod guest;
mod host;
mod known_users;
mod metrics;
mod own_grab;
mod patch_kinematics;
mod peer;
mod phase;
mod plugin;
mod recording;
mod remote;
mod retry;
mod roster;
mod session;
mod session_transform;
mod shared_body;
pub mod transport;
mod user;
mod view;
#[cfg(feature = "watch")]
pub mod watch;

pub use metrics::{
    DROPPED, JITTER, LOSS_IN, LOSS_OUT, NACKS, NetStats, QUEUE, RATE_IN, RATE_OUT, RECOVERED, ROUND_TRIP,
    VISUAL_OFFSET,
};
/// Why a session was refused or has ended.
pub use pliant_stream::DisconnectReason;
/// Network models for an [`Emulation`].
pub use pliant_stream::emulator;

pub use guest::{CameraInterest, GuestState, Interest, JoinConfig, NetGuest};
pub use host::{Holding, HostConfig, NetHost};
pub use peer::{NetPeer, PeerConfig, PeerState};
pub use plugin::{NetError, NetPlugin, NetSystems};
pub use recording::{RecordingError, SessionRecording};
pub use remote::{
    BodyArrived, BodyLeft, GrabRefused, RemoteBody, RemoteHand, RemoteHands, RigidArrived, RigidLeft,
    SessionClosed, SessionFailed, SessionJoined, SessionLost,
};
pub use session::{SessionCommands, SessionState};
pub use shared_body::{RemoteRigid, SharedBody, SharedRigid};
pub use transport::{
    Access, Carrier, CarrierPort, Emulation, Fingerprint, Grant, HostOptions, Identity, Invite, JoinOptions,
    MeshCarrier, Role, Token,
};
pub use user::{HandOf, Hands, User, UserJoined, UserLeft, UserLink, Yourself, color_of};
