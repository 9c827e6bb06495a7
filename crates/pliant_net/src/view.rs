//! Display of bodies that a session steps, alike on a guest and a peer.

use std::sync::Arc;
use std::time::Duration;

use bevy::prelude::*;
use pliant_body::{BodyState, GrabForce, VisualState};
use pliant_modal::HeldShapes;
use pliant_stream::{GrabState, RigidState, UserId};

use crate::patch_kinematics::PatchPoint;
use crate::phase::Phase;
use crate::remote::{RemoteHand, RemoteHands};
use crate::session_transform::{SessionTransform, set_pose};

/// What is written of a body that a session steps.
pub(crate) type DisplayedBodies<'w, 's> = Query<
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

/// The own shapes of held patches, and their coordinates.
pub(crate) type Held<'a> = Option<(&'a Arc<HeldShapes>, &'a [f64])>;

/// A state to display.
#[derive(Debug, Default, Clone)]
struct Displayed {
    q: Vec<f64>,
    pose: Option<RigidState>,
    shapes: Option<Arc<HeldShapes>>,
    s: Vec<f64>,
}

/// The last two states of a body, between which it is displayed.
#[derive(Debug, Default)]
pub(crate) struct BodyDisplay {
    phase: Phase,
    tick: u64,
    previous: Displayed,
    current: Displayed,
    /// Whether the newest state is displayed and no newer one has arrived.
    shows_newest: bool,
}

impl BodyDisplay {
    /// Takes over the state of a tick.
    pub(crate) fn take(&mut self, tick: u64, q: &[f64], pose: Option<RigidState>, held: Held<'_>) {
        let first = self.current.q.len() != q.len();
        if tick == self.tick && !first {
            // A correction may have moved the state of this tick, but the display goes on from the
            // state that it has.
            return;
        }
        self.tick = tick;
        self.shows_newest = false;
        std::mem::swap(&mut self.previous, &mut self.current);
        let (shapes, s) = held.unzip();
        let to = &mut self.current;
        to.q.clear();
        to.q.extend_from_slice(q);
        to.s.clear();
        to.s.extend_from_slice(s.unwrap_or_default());
        (to.pose, to.shapes) = (pose, shapes.cloned());
        if first {
            self.previous.clone_from(&self.current);
        }
    }

    /// Writes the state of the time `now` between the two ticks, which are `step` seconds apart.
    /// Modes that the session does not carry are at rest. A body that is `resting` is displayed in
    /// its newest state.
    pub(crate) fn write(
        &mut self,
        (step, now, resting): (f64, Duration, bool),
        state: &BodyState,
        visual: &mut Mut<VisualState>,
        transform: &mut Mut<Transform>,
        scratch: &mut Vec<f64>,
    ) {
        let fraction = if resting { 1.0 } else { self.phase.fraction(self.tick, step, now) };
        if self.shows_newest {
            return;
        }
        self.shows_newest = fraction >= 1.0;
        scratch.clear();
        let (from, to) = (&self.previous, &self.current);
        let between = |(from, to): (&f64, &f64)| from + (to - from) * fraction;
        scratch.extend(from.q.iter().zip(&to.q).map(between));
        scratch.resize(visual.q().len(), 0.0);
        let is_held = to.shapes.is_some() || visual.held().is_some();
        if (is_held || scratch != visual.q())
            && let Err(error) = visual.snap(scratch)
        {
            debug!("a state was not displayed: {error}");
        }
        if is_held {
            let same = from.shapes.as_ref().map(Arc::as_ptr) == to.shapes.as_ref().map(Arc::as_ptr);
            let first = if same { &from.s } else { &to.s };
            scratch.clear();
            scratch.extend(first.iter().zip(&to.s).map(between));
            visual.hold(to.shapes.as_ref().map(|shapes| (shapes, &scratch[..])));
        }
        if let (Some(from), Some(to)) = (from.pose, to.pose) {
            set_pose(transform, &from, &to, fraction, state.scale());
        }
    }

    /// The force on a local hand at a point of the body, in this app's world.
    pub(crate) fn force(
        &self,
        reaction: [f64; 3],
        point: &PatchPoint,
        place: &SessionTransform,
        state: &BodyState,
        visual: &VisualState,
    ) -> GrabForce {
        let point = point.at(visual.q(), state.warps(), visual.held());
        GrabForce {
            force: place.force_to_world(reaction),
            point: place.body_point_to_world(self.current.pose, point),
        }
    }
}

/// The hands on a body of all users but `own`, in this app's world.
pub(crate) fn remote_hands(
    grabs: &[GrabState],
    own: Option<UserId>,
    place: &SessionTransform,
) -> RemoteHands {
    let others = grabs.iter().filter(|grab| Some(grab.key.user) != own);
    let hand = |grab: &GrabState| RemoteHand {
        user: grab.key.user,
        vertex: grab.vertex,
        target: place.point_to_world(grab.target),
        reaction: place.force_to_world(grab.reaction),
    };
    RemoteHands(others.map(hand).collect())
}
