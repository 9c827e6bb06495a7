//! The app's local hands on the session's bodies.

use std::collections::VecDeque;
use std::time::Duration;

use bevy::prelude::*;
use pliant_body::{BodyState, Grab, GrabOf, Impulse};
use pliant_modal::ModalModel;
use pliant_stream::{BodyId, GuestSession, StreamError};

use super::NetGuest;
use crate::own_grab::{self, HandSession, OwnGrab, send_grabs};
use crate::remote::RemoteBody;

/// A local grab and what of it was sent to the host.
pub(super) struct SentGrab {
    pub(super) own: OwnGrab,
    /// The target that was last sent, in session coordinates, and for how many ticks it has been
    /// sent.
    target: [f64; 3],
    times: u8,
    path: HandPath,
    /// The body's tick when the target was sent.
    tick: u64,
}

/// `PostUpdate`: sends the app's own grabs and impulses on the session's bodies to the host.
pub(crate) fn send_hands(
    guest: Option<ResMut<NetGuest>>,
    bodies: Query<(&RemoteBody, &BodyState, &GlobalTransform)>,
    grabs: Query<(Entity, &Grab, &GrabOf)>,
    mut impulses: MessageReader<Impulse>,
) {
    let Some(mut guest) = guest else { return };
    let guest = &mut *guest;
    let now = guest.now();
    let body_of = |entity| bodies.get(entity).ok().map(|(body, state, transform)| (body.0, state, transform));
    own_grab::send_impulses(&mut impulses, &mut guest.refused_impulses, body_of, |body, vertex, impulse| {
        let needed = "a session";
        let none = StreamError::State { what: "apply_impulse", state: "not in", needed };
        let session = guest.session.as_mut().ok_or(none)?;
        session.apply_impulse(now, body, vertex, impulse)
    });
    let Some(session) = guest.session.as_mut().filter(|session| session.user().is_some()) else { return };
    send_grabs(&mut GuestHands { session, now }, &mut guest.grabs, &grabs, body_of);
}

/// The session with the time of the frame.
struct GuestHands<'a> {
    session: &'a mut GuestSession,
    now: Duration,
}

impl HandSession for GuestHands<'_> {
    type Sent = SentGrab;

    fn begin(&mut self, body: BodyId, grab: &Grab, model: &ModalModel, target: [f64; 3]) -> SentGrab {
        let own = OwnGrab::begin(body, grab, model, |hold| {
            self.session.begin_grab(self.now, body, grab.vertex, grab.radius, target, hold)
        });
        let path = HandPath(VecDeque::from([(self.now, target)]));
        SentGrab { own, target, times: 0, path, tick: 0 }
    }

    /// The target is sent by [`NetGuest::advance`].
    fn lead(&mut self, sent: &mut SentGrab, target: [f64; 3]) {
        sent.path.push(self.now, target);
    }

    fn end(&mut self, number: u16) {
        self.session.end_grab(number);
    }
}

impl AsRef<OwnGrab> for SentGrab {
    fn as_ref(&self) -> &OwnGrab {
        &self.own
    }
}

/// Recent positions of a hand, one per frame of the app.
///
/// Frames, the app's fixed steps and the session's ticks have different rates. A hand that is
/// sampled at the ticks moves by zero, one or two of its steps per tick, and a stiff grab turns
/// this into force. The mean over a tick moves evenly, with a delay of half a tick.
struct HandPath(VecDeque<(Duration, [f64; 3])>);

/// Longest history: a tick of 0.1 s at 240 frames per second, with some margin.
const PLACES: usize = 32;

impl HandPath {
    fn push(&mut self, at: Duration, place: [f64; 3]) {
        if self.0.len() >= PLACES {
            self.0.pop_front();
        }
        self.0.push_back((at, place));
    }

    /// Returns the mean position in the time `span` before `at`. The hand is assumed to move
    /// straight between positions.
    fn mean(&self, at: Duration, span: Duration) -> [f64; 3] {
        let (Some(first), Some(last)) = (self.0.front(), self.0.back()) else { return [0.0; 3] };
        let from = at.saturating_sub(span);
        // The hand was at the first position before that, and is at the last position after that.
        let ends = [(from.min(first.0), first.1), (at.max(last.0), last.1)];
        let corners = || [ends[0]].into_iter().chain(self.0.iter().copied()).chain([ends[1]]);
        let mut sum = (0.0, [0.0; 3]);
        let mut rests = true;
        for ((begins, here), (ends, there)) in corners().zip(corners().skip(1)) {
            let (low, high) = (begins.max(from), ends.min(at));
            let Some(passed) = high.checked_sub(low).filter(|passed| !passed.is_zero()) else { continue };
            let share = |t: Duration| (t - begins).as_secs_f64() / (ends - begins).as_secs_f64();
            let middle = 0.5 * (share(low) + share(high));
            rests &= here == there && here == last.1;
            sum.0 += passed.as_secs_f64();
            (0..3).for_each(|i| sum.1[i] += passed.as_secs_f64() * (here[i] + (there[i] - here[i]) * middle));
        }
        // A hand at rest must give its exact position.
        if rests || sum.0 <= 0.0 { last.1 } else { sum.1.map(|x| x / sum.0) }
    }
}

/// Number of ticks for which an unchanged target is sent. The host then knows that the hand stands
/// still, and need not extrapolate.
const REST_REPEATS: u8 = 6;
/// Samples of the hands per tick.
const READS: f64 = 4.0;
/// Longest frame that is divided into parts, s.
const LONGEST_FRAME: f64 = 0.25;

impl NetGuest {
    /// Brings the session to `now`. Each hand is sampled along its path and sends one target for
    /// each tick of its body, whatever the frame rate, because the host plays back one target per
    /// tick.
    pub(super) fn advance(&mut self, now: Duration) {
        let Some(session) = &mut self.session else { return };
        let from = std::mem::replace(&mut self.advanced, now);
        let frame = now.saturating_sub(from);
        let tick = Duration::from_secs_f64(session.step());
        let part = tick.div_f64(READS);
        let moving = self.grabs.values().any(|sent| sent.own.number.is_some());
        let parts = if moving && frame.as_secs_f64() < LONGEST_FRAME {
            (frame.as_secs_f64() / part.as_secs_f64()).ceil().max(1.0) as u32
        } else {
            1
        };
        for k in 1..=parts {
            let share = f64::from(k) / f64::from(parts);
            let at = from + frame.mul_f64(share).min(frame);
            session.update(at);
            for sent in self.grabs.values_mut() {
                let Some(number) = sent.own.number else { continue };
                let Some(view) = session.body(sent.own.body) else { continue };
                // A body that rests or has stalled has no ticks. Its hands send once a frame, so
                // that a hand can wake it.
                let steps = !view.is_resting() && !view.is_stalled();
                let due = if steps { view.tick() != sent.tick } else { k == parts };
                let target = sent.path.mean(at, tick);
                sent.times = if target == sent.target { sent.times } else { 0 };
                let enough = if steps { REST_REPEATS } else { 1 };
                if !due || sent.times >= enough {
                    continue;
                }
                match session.set_target(number, target) {
                    Ok(()) => {
                        (sent.target, sent.tick, sent.times) =
                            (target, view_tick(session, sent.own.body), sent.times + 1)
                    }
                    Err(error) => debug!("a target was not sent: {error}"),
                }
            }
        }
    }
}

fn view_tick(session: &GuestSession, body: BodyId) -> u64 {
    session.body(body).map_or(0, pliant_stream::StreamedBody::tick)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hand_that_moves_in_the_apps_steps_is_read_evenly() {
        // The hand moves in steps of 1 mm at 40 Hz, seen by frames of 7 ms, and is sampled at 40 Hz
        // out of phase.
        let ms = Duration::from_millis;
        let mut path = HandPath(VecDeque::new());
        let mut read = Vec::new();
        for frame in 0..400u64 {
            let now = ms(1_000 + 7 * frame);
            path.push(now, [1e-3 * (7 * frame / 25) as f64, 0.0, 0.0]);
            let tick = (7 * frame + 11) / 25;
            if (7 * (frame + 1) + 11) / 25 != tick {
                read.push(path.mean(now, ms(25))[0]);
            }
        }
        let bends = read.windows(3).skip(2).map(|w| (w[0] - 2.0 * w[1] + w[2]).abs());
        let worst = bends.fold(0.0, f64::max);
        // Without the mean, the hand stands still in one tick and moves by two steps in the next,
        // which is 2 mm.
        assert!(worst < 0.6e-3, "{worst}");
        // A hand at rest must give its position to the bit.
        let place = [0.1, 0.2, 0.3];
        (0..PLACES as u64).for_each(|k| path.push(ms(10_000 + k), place));
        assert_eq!(path.mean(ms(10_040), ms(5)), place);
        assert_eq!(HandPath(VecDeque::new()).mean(ms(5), ms(1)), [0.0; 3]);
    }
}
