//! Whose hand is whose, and the hands that are on other machines.

use std::collections::HashMap;

use bevy::{ecs::system::SystemParam, prelude::*};
use pliant_net::{HandOf, SeenHands, User, Yourself};

use crate::{Trace, bodies::HandView};

/// What the panel remembers of the hands on other machines: by body, user, and which of the user's.
#[derive(Resource, Default)]
pub(super) struct Histories {
    forces: HashMap<(Entity, u16, usize), Trace>,
}

#[derive(SystemParam)]
pub(super) struct People<'w, 's> {
    users: Query<'w, 's, (&'static User, Has<Yourself>)>,
    hands: Query<'w, 's, &'static HandOf>,
    seen: Query<'w, 's, &'static SeenHands>,
    histories: ResMut<'w, Histories>,
}

impl People<'_, '_> {
    /// Name and colour of whose hand a grab is: a guest's at its host, one's own anywhere else. `None` outside a session.
    pub fn whose(&self, grab: Entity) -> Option<(String, [u8; 3])> {
        let user = match self.hands.get(grab) {
            Ok(of) => self.users.get(of.0).ok()?.0,
            Err(_) => self.users.iter().find(|(_, yourself)| *yourself)?.0,
        };
        Some((user.name.clone(), srgb(user.colour)))
    }

    /// The hands that others have on a body, as the session shows them at `now` (s).
    pub fn others(&mut self, body: Entity, now: f64) -> Vec<HandView> {
        let Self { users, seen, histories, .. } = self;
        histories.forces.retain(|(body, ..), _| seen.contains(*body));
        let mut views: Vec<(u16, HandView)> = Vec::new();
        for hand in seen.get(body).into_iter().flat_map(|seen| &seen.0) {
            let user = users.iter().map(|(user, _)| user).find(|user| user.id == hand.user);
            let number = hand.user.0;
            let nth = views.iter().filter(|(of, _)| *of == number).count();
            let trace = histories.forces.entry((body, number, nth)).or_default();
            let force = hand.reaction.length();
            trace.push(now, force);
            let view = HandView {
                name: user.map_or_else(|| format!("user {number}"), |user| user.name.clone()),
                colour: user.map(|user| srgb(user.colour)),
                force,
                forces: trace.clone(),
            };
            views.push((number, view));
        }
        views.into_iter().map(|(_, view)| view).collect()
    }
}

/// A colour's bytes.
pub(super) fn srgb(colour: Color) -> [u8; 3] {
    let colour = colour.to_srgba();
    [colour.red, colour.green, colour.blue].map(|x| (x.clamp(0.0, 1.0) * 255.0).round() as u8)
}
