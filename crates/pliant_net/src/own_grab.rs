//! The app's own grabs on bodies that a session steps, and its impulses, alike on a guest and a
//! peer.

use std::collections::BTreeMap;

use bevy::prelude::*;
use pliant_body::{BodyError, BodyRefused, BodyState, Grab, GrabForce, GrabOf, Impulse, VisualState};
use pliant_modal::{GrabConfig, ModalModel};
use pliant_stream::{BodyId, StreamError};

use crate::patch_kinematics::PatchPoint;
use crate::session_transform::SessionTransform;
use crate::view::BodyDisplay;

/// A grab of this app as the session has it.
pub(crate) struct OwnGrab {
    pub(crate) body: BodyId,
    vertex: u32,
    radius: f64,
    hold: GrabConfig,
    /// The session's number of the grab. `None`: the session did not take it.
    pub(crate) number: Option<u16>,
    point: Option<PatchPoint>,
}

impl OwnGrab {
    /// Begins a grab in a session, by `begin`, which returns the session's number for it.
    pub(crate) fn begin(
        body: BodyId,
        grab: &Grab,
        model: &ModalModel,
        begin: impl FnOnce(GrabConfig) -> Result<u16, StreamError>,
    ) -> Self {
        let (vertex, radius, hold) = (grab.vertex, grab.radius, hold_of(grab));
        let begun = begin(hold);
        if let Err(error) = &begun {
            debug!("a grab was not taken: {error}");
        }
        let point = PatchPoint::new(model, vertex, radius);
        Self { body, vertex, radius, hold, number: begun.ok(), point }
    }

    /// Returns whether the grab still holds the same patch of the same body in the same way. The
    /// comparison of spring and damper is by bits, so that a NaN value is sent, and refused, only
    /// once.
    pub(crate) fn is(&self, grab: &Grab, body: Option<BodyId>) -> bool {
        let bits = |hold: GrabConfig| (hold.stiffness.map(f64::to_bits), hold.relaxation.to_bits());
        let same = grab.vertex == self.vertex && grab.radius == self.radius;
        same && bits(hold_of(grab)) == bits(self.hold) && body == Some(self.body)
    }

    /// Writes the force that the session gives for the grab, N in its axes, to its component. A
    /// grab without one feels nothing. `most` limits the force, N in the app's world.
    pub(crate) fn write_force(
        &self,
        force: &mut Mut<GrabForce>,
        reaction: Option<[f64; 3]>,
        most: f64,
        display: &BodyDisplay,
        (place, state, visual): (&SessionTransform, &BodyState, &VisualState),
    ) {
        let new = reaction.zip(self.point.as_ref()).map(|(reaction, point)| {
            let new = display.force(reaction, point, place, state, visual);
            GrabForce { force: new.force.clamp_length_max(most), ..new }
        });
        force.set_if_neq(new.unwrap_or_default());
    }
}

impl AsRef<Self> for OwnGrab {
    fn as_ref(&self) -> &Self {
        self
    }
}

/// A session that the app's own grabs are sent to.
pub(crate) trait HandSession {
    /// What is kept of a grab.
    type Sent: AsRef<OwnGrab>;

    /// Begins a grab with its target in session coordinates.
    fn begin(&mut self, body: BodyId, grab: &Grab, model: &ModalModel, target: [f64; 3]) -> Self::Sent;

    /// Moves a hand to a target in session coordinates.
    fn lead(&mut self, sent: &mut Self::Sent, target: [f64; 3]);

    /// Ends a grab.
    fn end(&mut self, number: u16);
}

/// Sends the app's own grabs on the session's bodies: begins those that are new, moves those that
/// were `sent`, and ends those that hold something else or nothing.
pub(crate) fn send_grabs<'a, S: HandSession>(
    session: &mut S,
    sent: &mut BTreeMap<Entity, S::Sent>,
    grabs: &Query<(Entity, &Grab, &GrabOf)>,
    body_of: impl Fn(Entity) -> Option<(BodyId, &'a BodyState, &'a GlobalTransform)>,
) {
    sent.retain(|&entity, sent| {
        let own = sent.as_ref();
        let stays =
            grabs.get(entity).is_ok_and(|(_, grab, of)| own.is(grab, body_of(of.0).map(|(body, ..)| body)));
        if let (false, Some(number)) = (stays, own.number) {
            session.end(number);
        }
        stays
    });
    for (entity, grab, of) in grabs {
        let Some((body, state, transform)) = body_of(of.0) else { continue };
        let Some(place) = SessionTransform::of_body(transform, state) else { continue };
        let target = place.point_to_session(grab.target);
        match sent.get_mut(&entity) {
            Some(sent) => session.lead(sent, target),
            None => {
                sent.insert(entity, session.begin(body, grab, state.model(), target));
            }
        }
    }
}

/// Sends the app's impulses on the session's bodies, each once, and reports those that the session
/// does not take.
pub(crate) fn send_impulses<'a>(
    impulses: &mut MessageReader<Impulse>,
    refused: &mut Vec<BodyRefused>,
    body_of: impl Fn(Entity) -> Option<(BodyId, &'a BodyState, &'a GlobalTransform)>,
    mut send: impl FnMut(BodyId, u32, [f64; 3]) -> Result<(), StreamError>,
) {
    for &Impulse { body: entity, vertex, impulse } in impulses.read() {
        let Some((body, state, transform)) = body_of(entity) else { continue };
        let Some(place) = SessionTransform::of_body(transform, state) else { continue };
        if let Err(error) = send(body, vertex, place.force_to_session(impulse)) {
            warn!("{entity}: an impulse was refused: {error}");
            refused.push(BodyRefused { entity, error: BodyError::NotTaken { why: error.to_string() } });
        }
    }
}

/// Returns the spring and damper of a grab.
pub(crate) fn hold_of(grab: &Grab) -> GrabConfig {
    GrabConfig { stiffness: grab.stiffness, relaxation: grab.relaxation }
}
