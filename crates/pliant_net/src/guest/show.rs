//! Writes the displayed state of the session to the bodies and the forces to the hands.

use std::collections::BTreeMap;

use bevy::prelude::*;
use pliant_body::{GrabForce, HeldShapesCache, ModalBody};
use pliant_stream::{BodyId, GuestSession};

use super::bodies::FollowedBody;
use super::rigids::show_rigids;
use super::{NetGuest, visual_state_of};
use crate::session_transform::SessionTransform;
use crate::shared_body::RemoteRigid;
use crate::user::UserLink;
use crate::view::{DisplayedBodies, remote_hands};

/// `PostUpdate`: brings the session to the current time and writes what it displays.
pub(crate) fn show(
    guest: Option<ResMut<NetGuest>>,
    mut places: ParamSet<(DisplayedBodies, TransformHelper, Query<&mut Transform>)>,
    rigids: Query<(Entity, &RemoteRigid, Option<&ChildOf>)>,
    mut forces: Query<&mut GrabForce>,
    mut links: Query<&mut UserLink>,
    wanted: Query<&ModalBody>,
    cache: Option<ResMut<HeldShapesCache>>,
) {
    let Some(mut guest) = guest else { return };
    let guest = &mut *guest;
    // NaN and negative limits give no force.
    let most_force = guest.config.most_force.max(0.0);
    let now = guest.now();
    let Some(session) = guest.session.as_mut() else { return };
    if let Some(most) = guest.source.max_datagram_size() {
        session.set_max_datagram(most);
    }
    guest.advance(now);
    let Some(session) = guest.session.as_mut() else { return };
    // In a replay no hand is local, so all hands are shown as remote.
    let user = session.user().filter(|_| !guest.source.is_replay());
    let step = session.step();
    let mut bodies = places.p0();
    for (&id, followed) in &mut guest.bodies {
        let Some(view) = session.body(id) else { continue };
        let Ok((state, mut visual, mut hands, mut transform, global)) = bodies.get_mut(followed.entity)
        else {
            continue;
        };
        // The predicted copy steps together with the confirmed one, whose ticks determine the time.
        if let Some((_, shown)) = visual_state_of(view) {
            let pose = view.predicted_hand().map_or_else(|| view.pose(), |own| own.pose());
            followed.peak = followed.peak.max(shown.q.iter().map(|q| q * q).sum::<f64>().sqrt());
            followed.display.take(view.tick(), &shown.q, pose, view.held_shapes());
        }
        let at = (step, now, view.is_resting());
        followed.display.write(at, state, &mut visual, &mut transform, &mut guest.scratch);
        let Some(place) = SessionTransform::of_body(global, state) else { continue };
        hands.set_if_neq(remote_hands(view.grabs(), user, &place));
        for (&entity, sent) in guest.grabs.iter().filter(|(_, sent)| sent.own.body == id) {
            let Ok(mut force) = forces.get_mut(entity) else { continue };
            let reaction = sent.own.number.zip(user).and_then(|(grab, user)| view.hand_reaction(user, grab));
            let at = (&place, state, &*visual);
            sent.own.write_force(&mut force, reaction, most_force, &followed.display, at);
        }
    }
    shape_held(session, &guest.bodies, &bodies, &wanted, cache);
    show_rigids(session, &rigids, &mut places);
    let link = session.stats();
    let own = user.and_then(|user| guest.users.get(user));
    if let Some(mut shown) = own.and_then(|own| links.get_mut(own).ok()) {
        let new = UserLink { round_trip: link.round_trip, loss_in: link.loss_in, loss_out: link.loss_out };
        shown.set_if_neq(new);
    }
    for link in session.links().filter(|link| Some(link.user) != user) {
        let other = guest.users.get(link.user).and_then(|other| links.get_mut(other).ok());
        if let Some(mut shown) = other {
            shown.set_if_neq(UserLink::of(link));
        }
    }
    guest.flush();
}

/// Gives the held bodies the own shapes of their patches as soon as these are made.
fn shape_held(
    session: &mut GuestSession,
    followed: &BTreeMap<BodyId, FollowedBody>,
    bodies: &DisplayedBodies,
    wanted: &Query<&ModalBody>,
    cache: Option<ResMut<HeldShapesCache>>,
) {
    let Some(mut cache) = cache else { return };
    for (&id, followed) in followed {
        let (Some(view), Ok((state, ..)), Ok(wanted)) =
            (session.body(id), bodies.get(followed.entity), wanted.get(followed.entity))
        else {
            continue;
        };
        let held = if wanted.held_shapes { view.held_places() } else { Vec::new() };
        let own = view.held_shapes().map(|(shapes, _)| shapes);
        if let Some(shapes) = cache.change(state.model(), held, own) {
            session.set_held_shapes(id, shapes);
        }
    }
}
