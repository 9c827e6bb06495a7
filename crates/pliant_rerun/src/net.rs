//! What the network tells: who comes and goes, and the hands of the others.
//!
//! Its figures (round trip, loss, rates) need nothing here: they are diagnostics, and are recorded like all others.

use bevy::prelude::*;
use pliant_net::{GrabRefused, SeenHands, SessionClosed, User, UserJoined, UserLeft};

use crate::{RerunScalars, collect::OtherHands, frame::Hand};

pub(crate) fn say_who_comes_and_goes(
    mut joined: MessageReader<UserJoined>,
    mut left: MessageReader<UserLeft>,
    mut refused: MessageReader<GrabRefused>,
    mut closed: MessageReader<SessionClosed>,
    mut own: ResMut<RerunScalars>,
) {
    for user in joined.read() {
        own.say(format!("{} joined", user.name));
    }
    for user in left.read() {
        own.say(format!("{} left: {}", user.name, user.reason));
    }
    for grab in refused.read() {
        own.warn(format!("the host refused a grab: {grab:?}"));
    }
    for session in closed.read() {
        own.warn(format!("the session ended: {}", session.reason));
    }
}

pub(crate) fn see_other_hands(
    mut others: ResMut<OtherHands>,
    bodies: Query<&SeenHands>,
    users: Query<&User>,
) {
    others.0.clear();
    for hand in bodies.iter().flat_map(|hands| &hands.0) {
        let user = users.iter().find(|user| user.id == hand.user);
        let name = user.map_or_else(|| format!("user {}", hand.user.0), |user| user.name.replace('/', " "));
        others.0.push(Hand {
            name: name.into(),
            force: hand.reaction.into(),
            // The others' patches are not known to the micrometre here; their targets are.
            point: hand.target.into(),
            target: hand.target.into(),
        });
    }
}
