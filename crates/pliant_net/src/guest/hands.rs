//! The app's own hands on the session's bodies.

use std::time::Duration;

use bevy::prelude::*;
use pliant_body::{BodyState, Grab, GrabOf};
use pliant_modal::GrabConfig;
use pliant_stream::BodyId;

use super::NetGuest;
use crate::felt::PatchPoint;
use crate::place::Place;
use crate::seen::RemoteBody;

/// A grab of ours as the host was told of it.
pub(super) struct SentGrab {
    pub(super) body: BodyId,
    vertex: u32,
    radius: f64,
    /// As last said, in session coordinates, and how many ticks it has been said for.
    target: [f64; 3],
    times: u8,
    /// Where the hand was at the end of the last frame, and where it is at the end of this one.
    path: [[f64; 3]; 2],
    /// The body's tick when the target was said.
    tick: u64,
    /// The session's number; `None`: refused.
    pub(super) number: Option<u16>,
    pub(super) point: Option<PatchPoint>,
}

/// `PostUpdate`: the app's own grabs on the session's bodies are told to the host.
pub(crate) fn send_hands(
    guest: Option<ResMut<NetGuest>>,
    bodies: Query<(&RemoteBody, &BodyState, &GlobalTransform)>,
    grabs: Query<(Entity, &Grab, &GrabOf)>,
) {
    let Some(mut guest) = guest else { return };
    let guest = &mut *guest;
    let now = guest.now();
    let Some(session) = guest.session.as_mut().filter(|session| session.user().is_some()) else { return };
    guest.grabs.retain(|&entity, sent| {
        let stays = grabs.get(entity).is_ok_and(|(_, grab, of)| {
            let same = grab.vertex == sent.vertex && grab.radius == sent.radius;
            same && bodies.get(of.0).is_ok_and(|(body, ..)| body.0 == sent.body)
        });
        if let (false, Some(number)) = (stays, sent.number) {
            session.end_grab(number);
        }
        stays
    });
    for (entity, grab, of) in &grabs {
        let Ok((body, state, transform)) = bodies.get(of.0) else { continue };
        let Some(place) = Place::of_body(transform, state) else { continue };
        let target = place.point_to_session(grab.target);
        match guest.grabs.get_mut(&entity) {
            None => {
                let hold = GrabConfig { stiffness: grab.stiffness, relaxation: grab.relaxation };
                let begun = session.begin_grab(now, body.0, grab.vertex, grab.radius, target, hold);
                if let Err(error) = &begun {
                    debug!("a grab was not sent: {error}");
                }
                let point = PatchPoint::new(state.model(), grab.vertex, grab.radius).ok();
                let sent = SentGrab {
                    body: body.0,
                    vertex: grab.vertex,
                    radius: grab.radius,
                    target,
                    times: 0,
                    path: [target; 2],
                    tick: 0,
                    number: begun.ok(),
                    point,
                };
                guest.grabs.insert(entity, sent);
            }
            Some(sent) => sent.path = [sent.path[1], target],
        }
    }
}

/// A target that stays is said so often, tick by tick, before there is silence: until then the host knows that the hand stands still, and does not
/// have to guess.
const SAID: u8 = 6;
/// Hands are read so often a tick.
const READS: f64 = 4.0;
/// A frame that has taken longer is not gone through bit by bit.
const LONGEST_FRAME: f64 = 0.25;

impl NetGuest {
    /// Brings the session to now. The hands are read along the way from where they were to where they are, and each says one target for each tick of
    /// its body, whatever the frames: the host plays them back one a tick.
    pub(super) fn advance(&mut self, now: Duration) {
        let Some(session) = &mut self.session else { return };
        let from = std::mem::replace(&mut self.advanced, now);
        let frame = now.saturating_sub(from);
        let part = Duration::from_secs_f64(session.step() / READS);
        let moving = self.grabs.values().any(|sent| sent.number.is_some());
        let parts = if moving && frame.as_secs_f64() < LONGEST_FRAME {
            (frame.as_secs_f64() / part.as_secs_f64()).ceil().max(1.0) as u32
        } else {
            1
        };
        for k in 1..=parts {
            let share = f64::from(k) / f64::from(parts);
            session.update(from + frame.mul_f64(share).min(frame));
            for sent in self.grabs.values_mut() {
                let Some(number) = sent.number else { continue };
                let Some(view) = session.body(sent.body) else { continue };
                // A body that rests or stands still has no ticks: once a frame, so that a hand wakes it.
                let steps = !view.is_resting() && !view.is_stalled();
                let due = if steps { view.tick() != sent.tick } else { k == parts };
                let target = std::array::from_fn(|i| {
                    let [before, after] = [sent.path[0][i], sent.path[1][i]];
                    if k == parts { after } else { before + (after - before) * share }
                });
                sent.times = if target == sent.target { sent.times } else { 0 };
                let enough = if steps { SAID } else { 1 };
                if !due || sent.times >= enough {
                    continue;
                }
                match session.set_target(number, target) {
                    Ok(()) => {
                        (sent.target, sent.tick, sent.times) =
                            (target, view_tick(session, sent.body), sent.times + 1)
                    }
                    Err(error) => debug!("a target was not sent: {error}"),
                }
            }
        }
    }
}

fn view_tick(session: &pliant_stream::GuestSession, body: BodyId) -> u64 {
    session.body(body).map_or(0, pliant_stream::BodyView::tick)
}
