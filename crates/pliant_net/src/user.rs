//! The users of a session, as entities.

use std::time::Duration;

use bevy::prelude::*;
use pliant_stream::{DisconnectReason, UserId, UserLinkInfo};

use crate::remote::{ReflectedRole, ReflectedUserId};
use crate::transport::Role;

/// A user of the session. Every app has one entity for each user, including its own ([`Yourself`]).
#[derive(Component, Reflect, Debug, Clone, PartialEq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct User {
    /// The number that the host gave the user. The user at the host is [`UserId::HOST`].
    #[reflect(remote = ReflectedUserId)]
    pub id: UserId,
    /// Name of the user, at most 64 bytes. The name comes from the network: display it, but do not
    /// trust it.
    pub name: String,
    /// The user's color, the same in every app.
    pub color: Color,
    /// What the user may do.
    #[reflect(remote = ReflectedRole)]
    pub role: Role,
}

impl UserLink {
    /// The link as the host describes it.
    pub(crate) fn of(link: &UserLinkInfo) -> Self {
        let [loss_in, loss_out] = link.losses();
        Self { round_trip: link.round_trip(), loss_in, loss_out }
    }
}

impl Default for User {
    /// The user at the host, without a name.
    fn default() -> Self {
        Self::new(UserId::HOST, "", Role::default())
    }
}

impl User {
    pub(crate) fn new(id: UserId, name: &str, role: Role) -> Self {
        Self { id, name: printable(name), color: color_of(id), role }
    }
}

/// Longest name of a user that is sent, bytes.
const LONGEST_NAME: usize = 64;

/// Cuts a name to the length that is sent, at a character boundary.
pub(crate) fn shortened(name: &str) -> &str {
    let end = (0..=LONGEST_NAME.min(name.len())).rev().find(|&end| name.is_char_boundary(end));
    &name[..end.unwrap_or(0)]
}

/// Removes the control characters from a name, so that it can be displayed.
pub(crate) fn printable(name: &str) -> String {
    name.chars().filter(|c| !c.is_control()).collect()
}

/// Returns the color of a user. Consecutive users' hues are a golden angle apart, so that users
/// with consecutive numbers differ well, whatever their count.
pub fn color_of(user: UserId) -> Color {
    const GOLDEN_ANGLE: f32 = 137.507_76;
    Color::hsl((200.0 + GOLDEN_ANGLE * f32::from(user.0)) % 360.0, 0.7, 0.55)
}

/// Marks the entity of this app's own user.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct Yourself;

/// Quality of the link to a user.
///
/// A host has it on every guest's entity. A guest has it on its own entity for the link to the
/// host, and on the other guests' entities with the host's values, which arrive about once a
/// second. A peer has it on every other peer's entity.
#[derive(Component, Reflect, Debug, Clone, Copy, PartialEq, Default)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
pub struct UserLink {
    /// Smoothed round trip. Zero before the first measurement.
    pub round_trip: Duration,
    /// Share of that user's datagrams that do not arrive here, 0 to 1.
    pub loss_in: f64,
    /// Share of the datagrams to that user that do not arrive there, 0 to 1.
    pub loss_out: f64,
}

/// The user whose hand a [`Grab`](pliant_body::Grab) is. Despawning the entity on a host ends a
/// guest's grab, and the guest receives [`GrabRefused`](crate::GrabRefused).
#[derive(Component, FromTemplate, Reflect, Debug, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Debug, Default, Clone, PartialEq)]
#[relationship(relationship_target = Hands)]
pub struct HandOf(#[entities] pub Entity);

impl Default for HandOf {
    /// The hand of no user.
    fn default() -> Self {
        Self(Entity::PLACEHOLDER)
    }
}

/// The grabs of a user, oldest first. They are despawned with the user.
#[derive(Component, Reflect, Debug, Default)]
#[reflect(Component, Debug, Default)]
#[relationship_target(relationship = HandOf, linked_spawn)]
pub struct Hands(Vec<Entity>);

/// A user has joined. A message, and an event on the user's entity for observers.
#[derive(Message, EntityEvent, Reflect, Debug, Clone, PartialEq)]
#[reflect(opaque)]
#[reflect(Debug, Clone, PartialEq)]
pub struct UserJoined {
    /// The user's entity, with [`User`].
    pub entity: Entity,
    /// The user's number.
    pub id: UserId,
    /// The user's name.
    pub name: String,
    /// Whether the same user, recognized by its key, was here before under the same number.
    pub back: bool,
}

/// A user has left. The entity is despawned. A message, and an event for observers.
#[derive(Message, Event, Reflect, Debug, Clone, PartialEq)]
#[reflect(opaque)]
#[reflect(Debug, Clone, PartialEq)]
pub struct UserLeft {
    /// The number that the user had.
    pub id: UserId,
    /// The name that the user had.
    pub name: String,
    /// The reason.
    pub reason: DisconnectReason,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbors_differ_in_hue_and_names_hold_no_control_characters() {
        let hue = |n| Hsla::from(color_of(UserId(n))).hue;
        for n in 0..20 {
            for m in n + 1..20 {
                let apart = (hue(n) - hue(m)).abs();
                // On the hue circle no two of the first twenty points of the golden-angle sequence
                // are closer.
                assert!(apart.min(360.0 - apart) > 7.0, "users {n} and {m}: {apart} degrees");
            }
        }
        assert_eq!(User::new(UserId(1), "a\u{1b}[31mb\n", Role::Hold).name, "a[31mb");
        assert_eq!(shortened(&"ä".repeat(40)), "ä".repeat(32), "cut at a character boundary");
    }
}
