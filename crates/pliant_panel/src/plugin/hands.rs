//! The users of the hands, and the remote hands.

use bevy::{ecs::system::SystemParam, prelude::*};
use pliant_net::{HandOf, RemoteHands, User, Yourself};

use super::scene::HandKey;
use crate::bodies::HandView;

#[derive(SystemParam)]
pub(super) struct People<'w, 's> {
    users: Query<'w, 's, (&'static User, Has<Yourself>)>,
    hands: Query<'w, 's, &'static HandOf>,
    seen: Query<'w, 's, &'static RemoteHands>,
}

impl People<'_, '_> {
    /// Returns the name and the color of the user of a grab.
    ///
    /// On a host this is the guest for a guest's grab. For all other grabs it is the local user.
    /// Returns `None` outside a session.
    pub fn whose(&self, grab: Entity) -> Option<(String, [u8; 3])> {
        let user = match self.hands.get(grab) {
            Ok(of) => self.users.get(of.0).ok()?.0,
            Err(_) => self.users.iter().find(|(_, yourself)| *yourself)?.0,
        };
        Some((user.name.clone(), srgb(user.color)))
    }

    /// Returns the remote hands on a body, each with its key.
    pub fn others(&self, body: Entity) -> Vec<(HandKey, HandView)> {
        let mut views: Vec<(HandKey, HandView)> = Vec::new();
        for hand in self.seen.get(body).into_iter().flat_map(|seen| &seen.0) {
            let user = self.users.iter().map(|(user, _)| user).find(|user| user.id == hand.user);
            let number = hand.user.0;
            let of_user = |key: &HandKey| matches!(key, HandKey::Remote { user, .. } if *user == number);
            let nth = views.iter().filter(|(key, _)| of_user(key)).count();
            let view = HandView {
                name: user.map_or_else(|| format!("user {number}"), |user| user.name.clone()),
                color: user.map(|user| srgb(user.color)),
                force: hand.reaction.length(),
                ..default()
            };
            views.push((HandKey::Remote { body, user: number, nth }, view));
        }
        views
    }
}

/// Returns the bytes of a color.
pub(super) fn srgb(color: Color) -> [u8; 3] {
    let color = color.to_srgba();
    [color.red, color.green, color.blue].map(|x| (x.clamp(0.0, 1.0) * 255.0).round() as u8)
}
