//! Components and messages through which a guest's app sees the session.

use std::sync::Arc;

use bevy::math::DVec3;
use bevy::prelude::*;
use bevy::reflect::reflect_remote;
use pliant_stream::{BodyId, DisconnectReason, Role, UserId};

use crate::plugin::NetError;

// The protocol's types do not depend on an engine. Reflection accesses their fields through these.

#[reflect_remote(BodyId)]
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub(crate) struct ReflectedBodyId(pub u16);

#[reflect_remote(UserId)]
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub(crate) struct ReflectedUserId(pub u16);

#[reflect_remote(Role)]
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub(crate) enum ReflectedRole {
    Hold,
    Watch,
}

/// The session's body that this entity tracks.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct RemoteBody(#[reflect(remote = ReflectedBodyId)] pub BodyId);

/// Another user's hand on a body.
#[derive(Reflect, Debug, Default, Clone, Copy, PartialEq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub struct RemoteHand {
    /// The user whose hand this is.
    #[reflect(remote = ReflectedUserId)]
    pub user: UserId,
    /// Surface vertex at the center of the patch.
    pub vertex: u32,
    /// Position of the hand, m, world.
    pub target: DVec3,
    /// The force that the body exerts on the hand, N, world.
    pub reaction: DVec3,
}

/// The hands of the other users on a guest's body at the displayed tick. At most
/// [`pliant_stream::MAX_GRABS`].
#[derive(Component, Reflect, Debug, Clone, Default, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct RemoteHands(pub Vec<RemoteHand>);

/// A body of the host has arrived. A message, and an event on the body's entity for observers.
#[derive(Message, EntityEvent, Reflect, Debug, Clone, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct BodyArrived {
    /// The entity of the body, with [`RemoteBody`], [`ModalBody`](pliant_body::ModalBody) and
    /// [`SharedBody`](crate::SharedBody).
    pub entity: Entity,
    /// Name of the body.
    pub name: String,
}

/// The host has removed a body from the session. An entity that the plugin spawned for the body is
/// despawned. An entity of the app stays, in the state in which it was last displayed, until the
/// app leaves the session
/// ([`SessionCommands::leave_session`](crate::SessionCommands::leave_session)). A message, and an
/// event on the body's entity for observers.
#[derive(Message, EntityEvent, Reflect, Debug, Clone, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct BodyLeft {
    /// The entity of the body.
    pub entity: Entity,
    /// Name of the body.
    pub name: String,
}

/// A rigid body of the host has come into the session. A message, and an event on the entity that
/// follows it, for observers.
#[derive(Message, EntityEvent, Reflect, Debug, Clone, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct RigidArrived {
    /// The entity, with [`RemoteRigid`](crate::RemoteRigid) and
    /// [`SharedRigid`](crate::SharedRigid).
    pub entity: Entity,
    /// Name of the rigid body.
    pub name: String,
}

/// The host has removed a rigid body from the session. An entity that the plugin spawned for it is
/// despawned, and one of the app stays where it was last shown. A message, and an event on the
/// entity for observers.
#[derive(Message, EntityEvent, Reflect, Debug, Clone, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct RigidLeft {
    /// The entity that has followed it.
    pub entity: Entity,
    /// Name of the rigid body.
    pub name: String,
}

/// The host has refused one of this app's grabs, or has taken it off the body. Despawn the grab, or
/// change its vertex or radius to try again. A message, and an event on the grab's entity for
/// observers.
#[derive(Message, EntityEvent, Reflect, Debug, Clone, PartialEq)]
#[reflect(Debug, Clone, PartialEq)]
pub struct GrabRefused {
    /// The entity of the grab.
    pub entity: Entity,
}

/// The guest has lost its connection to the host. Bodies keep their last displayed state, the
/// entities of the other users are despawned, and the guest tries to join again
/// ([`JoinConfig::rejoin`](crate::JoinConfig::rejoin)). A message, and an event for observers.
#[derive(Message, Event, Reflect, Debug, Clone, PartialEq)]
#[reflect(opaque)]
#[reflect(Debug, Clone, PartialEq)]
pub struct SessionLost {
    /// The reason.
    pub reason: DisconnectReason,
}

/// This app is in the session: it hosts one, or has joined one for the first time or again. A
/// message, and an event for observers.
#[derive(Message, Event, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(opaque)]
#[reflect(Debug, Clone, PartialEq)]
pub struct SessionJoined {
    /// The number of this app's user. It is the same as before if the host remembers this user's
    /// key.
    pub user: UserId,
    /// Whether the guest was in the session before, as after a [`SessionLost`].
    pub reconnected: bool,
}

/// A session that this app was in is over. What it displayed stays until the app leaves it
/// ([`SessionCommands::leave_session`](crate::SessionCommands::leave_session)) or begins another
/// one. A message, and an event for observers.
#[derive(Message, Event, Reflect, Debug, Clone, PartialEq)]
#[reflect(opaque)]
#[reflect(Debug, Clone, PartialEq)]
pub struct SessionClosed {
    /// The reason.
    pub reason: DisconnectReason,
}

/// A session could not begin: the socket could not be opened, the invite is none, or the other side
/// was not reached or did not admit this app. A message, and an event for observers.
#[derive(Message, Event, Reflect, Debug, Clone)]
#[reflect(opaque)]
#[reflect(Debug, Clone)]
pub struct SessionFailed {
    /// The reason.
    pub reason: Arc<NetError>,
}

pub(crate) fn register(app: &mut App) {
    app.register_type::<BodyArrived>()
        .register_type::<BodyLeft>()
        .register_type::<RigidArrived>()
        .register_type::<RigidLeft>()
        .register_type::<GrabRefused>()
        .register_type::<SessionLost>()
        .register_type::<SessionJoined>()
        .register_type::<SessionClosed>()
        .register_type::<SessionFailed>()
        .add_message::<BodyArrived>()
        .add_message::<BodyLeft>()
        .add_message::<RigidArrived>()
        .add_message::<RigidLeft>()
        .add_message::<GrabRefused>()
        .add_message::<SessionLost>()
        .add_message::<SessionJoined>()
        .add_message::<SessionClosed>()
        .add_message::<SessionFailed>();
}
