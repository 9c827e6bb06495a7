//! Bodies of a session.

use bevy::prelude::*;
use bevy::reflect::reflect_remote;
use pliant_stream::RigidId;

/// A body that all users of the session see and may hold.
///
/// On a host, next to a [`ModalBody`](pliant_body::ModalBody), this component streams the body. On
/// a guest, the app may put it on an entity for the body of this name. The body then arrives on
/// that entity, which keeps its transform and its other components (a material, for example). If
/// there is no such entity, the plugin spawns one at the host's transform.
#[derive(Component, Reflect, Debug, Default, Clone, PartialEq, Eq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct SharedBody {
    /// Name of the body in the session, at most 64 bytes. Bodies of the same name are matched in
    /// the order in which they arrive.
    pub name: String,
}

impl SharedBody {
    /// Creates a shared body called `name`.
    pub fn named(name: impl Into<String>) -> Self {
        Self { name: name.into() }
    }
}

/// A rigid body that all users of a host's session see: a crate, a lift, a ball of the game's
/// physics engine.
///
/// On a host, next to a `Transform`, this component tells the guests where the entity is after each
/// tick. Who moves it is the app's choice: a physics engine, an animation, a system. Nothing is
/// sent of what rests. On a guest, the app may put it on an entity for the rigid body of this name,
/// which then follows the host's, with its own mesh and scale. If there is no such entity, the
/// plugin spawns one without a mesh, and [`RigidArrived`](crate::RigidArrived) tells of it.
///
/// An entity that follows has [`RemoteRigid`], and nothing else may move it: where the app has a
/// physics engine, the entity is a kinematic rigid body for it. Among peers the component does
/// nothing.
#[derive(Component, Reflect, Debug, Default, Clone, PartialEq, Eq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct SharedRigid {
    /// Name of the rigid body in the session, at most 64 bytes. Rigid bodies of the same name are
    /// matched in the order in which they arrive.
    pub name: String,
}

impl SharedRigid {
    /// Creates a shared rigid body called `name`.
    pub fn named(name: impl Into<String>) -> Self {
        Self { name: name.into() }
    }
}

/// The session's rigid body that this entity of a guest follows.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct RemoteRigid(#[reflect(remote = ReflectedRigidId)] pub RigidId);

#[reflect_remote(RigidId)]
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Debug, Default, Clone, PartialEq)]
pub(crate) struct ReflectedRigidId(pub u16);
