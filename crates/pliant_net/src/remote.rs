//! What a guest's app sees of the session: components on the bodies that follow the host's, and messages.

use bevy::math::DVec3;
use bevy::prelude::*;
use pliant_stream::{BodyId, UserId};

/// The session's body that this entity follows.
#[derive(Component, Debug, Clone, Copy, PartialEq, Eq)]
pub struct RemoteBody(pub BodyId);

/// Another user's hand on a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RemoteHand {
    /// Whose.
    pub user: UserId,
    /// Surface vertex in the middle of the patch.
    pub vertex: u32,
    /// Where the hand is, m, world.
    pub target: DVec3,
    /// The force that the body exerts on it, N, world.
    pub reaction: DVec3,
}

/// The hands of the others on a guest's body, at the tick that is shown. At most [`pliant_stream::MAX_GRABS`].
#[derive(Component, Debug, Clone, Default, PartialEq)]
pub struct RemoteHands(pub Vec<RemoteHand>);

/// A body of the host is here.
#[derive(Message, Debug, Clone, PartialEq)]
pub struct BodyArrived {
    /// The entity it arrived on: with [`RemoteBody`], [`ModalBody`](pliant_body::ModalBody) and [`SharedBody`](crate::SharedBody).
    pub entity: Entity,
    /// Its name.
    pub name: String,
}

/// The host has taken a body out of the session. An entity that was made for it is gone; one that the app had made stays, as it was last seen.
#[derive(Message, Debug, Clone, PartialEq)]
pub struct BodyLeft {
    /// The entity.
    pub entity: Entity,
    /// Its name.
    pub name: String,
}

/// The host has not let one of our grabs hold, or has taken it off the body. Despawn it, or change its vertex or radius to try again.
#[derive(Message, Debug, Clone, PartialEq)]
pub struct GrabRefused {
    /// The grab.
    pub entity: Entity,
}

/// The host cannot be heard any more. Bodies stand as they were last seen, the others' users are gone, and joining is tried again
/// ([`JoinConfig::rejoin`](crate::JoinConfig::rejoin)).
#[derive(Message, Debug, Clone, PartialEq)]
pub struct SessionLost {
    /// Why, in words.
    pub reason: String,
}

/// In the session: for the first time, or again.
#[derive(Message, Debug, Clone, Copy, PartialEq, Eq)]
pub struct SessionJoined {
    /// Our number: the same as before, where the host remembers us.
    pub user: UserId,
    /// After a [`SessionLost`].
    pub again: bool,
}

/// The session is over.
#[derive(Message, Debug, Clone, PartialEq)]
pub struct SessionClosed {
    /// Why, in words.
    pub reason: String,
}

pub(crate) fn register(app: &mut App) {
    app.add_message::<BodyArrived>()
        .add_message::<BodyLeft>()
        .add_message::<GrabRefused>()
        .add_message::<SessionLost>()
        .add_message::<SessionJoined>()
        .add_message::<SessionClosed>();
}
