//! Writes the displayed state of the session to the bodies and the forces to the hands.

use bevy::prelude::*;
use pliant_body::{BodyState, GrabForce, VisualState};
use pliant_stream::GrabKey;

use super::NetGuest;
use crate::remote::{RemoteHand, RemoteHands};
use crate::session_transform::{SessionTransform, set_pose};
use crate::user::UserLink;

type FollowedBodies<'w, 's> = Query<
    'w,
    's,
    (
        &'static BodyState,
        &'static mut VisualState,
        &'static mut RemoteHands,
        &'static mut Transform,
        &'static GlobalTransform,
    ),
>;

/// `PostUpdate`: brings the session to the current time and writes what it displays.
pub(crate) fn show(
    guest: Option<ResMut<NetGuest>>,
    mut bodies: FollowedBodies,
    mut forces: Query<&mut GrabForce>,
    mut links: Query<&mut UserLink>,
) {
    let Some(mut guest) = guest else { return };
    let guest = &mut *guest;
    // NaN and negative limits give no force.
    let most_force = guest.config.most_force.max(0.0);
    let now = guest.now();
    let Some(session) = guest.session.as_mut() else { return };
    if let Some(most) = guest.line.max_datagram_size() {
        session.set_max_datagram(most);
    }
    guest.advance(now);
    let Some(session) = guest.session.as_mut() else { return };
    // In a replay no hand is local, so all hands are shown as remote.
    let user = session.user().filter(|_| !guest.line.is_replay());
    let step = session.step();
    for (&id, followed) in &mut guest.bodies {
        let Some(view) = session.body(id) else { continue };
        let Ok((state, mut shown, mut seen, mut transform, global)) = bodies.get_mut(followed.entity) else {
            continue;
        };
        followed.take(view);
        let fraction =
            if view.is_resting() { 1.0 } else { followed.phase.fraction(followed.tick, step, now) };
        if !followed.settled {
            followed.settled = fraction >= 1.0;
            followed.between(fraction, shown.q().len(), &mut guest.scratch);
            if let Err(error) = shown.snap(&guest.scratch) {
                debug!("a state of {} was not shown: {error}", followed.name);
            }
            if let (Some(from), Some(to)) = (followed.previous.1, followed.current.1) {
                set_pose(&mut transform, &from, &to, fraction, state.scale());
            }
        }
        let Some(place) = SessionTransform::of_body(global, state) else { continue };
        let pose = followed.current.1;
        let hand = |grab: &pliant_stream::GrabState| RemoteHand {
            user: grab.key.user,
            vertex: grab.vertex,
            target: place.point_to_world(grab.target),
            reaction: place.force_to_world(grab.reaction),
        };
        let others = view.grabs().iter().filter(|grab| Some(grab.key.user) != user).map(hand);
        seen.set_if_neq(RemoteHands(others.collect()));
        for (&entity, sent) in guest.grabs.iter().filter(|(_, sent)| sent.body == id) {
            let Ok(mut force) = forces.get_mut(entity) else { continue };
            let felt = sent.number.zip(user).and_then(|(grab, user)| {
                let key = GrabKey { user, grab };
                let confirmed = || Some(view.grabs().iter().find(|grab| grab.key == key)?.reaction);
                let reaction = match view.predicted_hand() {
                    Some(own) => own.reaction(grab).or_else(confirmed)?,
                    None => confirmed()?,
                };
                let body_point = sent.point.as_ref()?.at(shown.q(), state.warps());
                Some(GrabForce {
                    force: place.force_to_world(reaction).clamp_length_max(most_force),
                    point: place.body_point_to_world(pose, body_point),
                })
            });
            force.set_if_neq(felt.unwrap_or_default());
        }
    }
    let link = session.stats();
    let own = user.and_then(|user| guest.users.get(&user).copied());
    if let Some(mut shown) = own.and_then(|own| links.get_mut(own).ok()) {
        let new = UserLink { round_trip: link.round_trip, loss_in: link.loss_in, loss_out: link.loss_out };
        shown.set_if_neq(new);
    }
    for link in session.links().filter(|link| Some(link.user) != user) {
        let other = guest.users.get(&link.user).and_then(|&other| links.get_mut(other).ok());
        if let Some(mut shown) = other {
            shown.set_if_neq(UserLink::of(link));
        }
    }
    guest.flush();
}
