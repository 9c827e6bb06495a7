//! Bodies of a session.

use bevy::prelude::*;

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
