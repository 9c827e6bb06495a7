//! The people of a session, as entities.

use std::time::Duration;

use bevy::prelude::*;
use pliant_stream::UserId;

use crate::transport::Role;

/// A user of the session. Every app has an entity for each, itself included ([`Yourself`]).
#[derive(Component, Debug, Clone, PartialEq)]
pub struct User {
    /// The number that the host gave. The user at the host is [`UserId::HOST`].
    pub id: UserId,
    /// What the user is called, at most 64 bytes. From outside: show it, do not trust it.
    pub name: String,
    /// A color of the user's own, the same in every app.
    pub color: Color,
    /// What the user may do.
    pub role: Role,
}

impl User {
    pub(crate) fn new(id: UserId, name: &str, role: Role) -> Self {
        Self { id, name: printable(name), color: color_of(id), role }
    }
}

/// A name from outside, fit for a screen.
pub(crate) fn printable(name: &str) -> String {
    name.chars().filter(|c| !c.is_control()).collect()
}

/// The color of a user: hues a golden angle apart, so that neighbours by number differ well however many come.
pub fn color_of(user: UserId) -> Color {
    const GOLDEN_ANGLE: f32 = 137.507_76;
    Color::hsl((200.0 + GOLDEN_ANGLE * f32::from(user.0)) % 360.0, 0.7, 0.55)
}

/// Marks the entity of this app's own user.
#[derive(Component, Debug, Clone, Copy, PartialEq, Eq)]
pub struct Yourself;

/// How well a user is reached. On the host: on every guest's entity. On a guest: on its own entity, for the way to the host, and on the other guests', as the
/// host says about once a second. Among peers: on every other peer's.
#[derive(Component, Debug, Clone, Copy, PartialEq, Default)]
pub struct UserLink {
    /// Smoothed round trip; zero before the first measurement.
    pub round_trip: Duration,
    /// Share of that user's datagrams that do not arrive here, 0 to 1.
    pub loss_in: f64,
    /// Share of the datagrams to that user that do not arrive there, 0 to 1.
    pub loss_out: f64,
}

/// The user whose hand a [`Grab`](pliant_body::Grab) is. Despawned on a host, a guest's grab lets go, and the guest is told
/// ([`GrabRefused`](crate::GrabRefused)).
#[derive(Component, Debug, Clone, Copy, PartialEq, Eq)]
#[relationship(relationship_target = Hands)]
pub struct HandOf(#[entities] pub Entity);

/// The grabs of a user, oldest first. They are despawned with it: who leaves lets go.
#[derive(Component, Debug, Default)]
#[relationship_target(relationship = HandOf, linked_spawn)]
pub struct Hands(Vec<Entity>);

/// Somebody has joined.
#[derive(Message, Debug, Clone, PartialEq)]
pub struct UserJoined {
    /// The user's entity, with [`User`].
    pub entity: Entity,
    /// Its number.
    pub id: UserId,
    /// Its name.
    pub name: String,
    /// The same user was here before, under the same number: by its key.
    pub back: bool,
}

/// Somebody has left. The entity is gone.
#[derive(Message, Debug, Clone, PartialEq)]
pub struct UserLeft {
    /// The number it had.
    pub id: UserId,
    /// The name it had.
    pub name: String,
    /// Why, in words.
    pub reason: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_differ_in_hue_and_names_hold_no_control_characters() {
        let hue = |n| Hsla::from(color_of(UserId(n))).hue;
        for n in 0..20 {
            for m in n + 1..20 {
                let apart = (hue(n) - hue(m)).abs();
                // Twenty points of the golden-angle sequence are nowhere nearer than this on the circle.
                assert!(apart.min(360.0 - apart) > 7.0, "users {n} and {m}: {apart} degrees");
            }
        }
        assert_eq!(User::new(UserId(1), "a\u{1b}[31mb\n", Role::Hold).name, "a[31mb");
    }
}
