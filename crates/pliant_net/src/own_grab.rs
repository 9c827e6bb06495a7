//! The app's own grabs on bodies that a session steps, alike on a guest and a peer.

use bevy::prelude::*;
use pliant_body::{BodyState, Grab, GrabForce, VisualState};
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
        let point = PatchPoint::new(model, vertex, radius).ok();
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

/// Returns the spring and damper of a grab.
pub(crate) fn hold_of(grab: &Grab) -> GrabConfig {
    GrabConfig { stiffness: grab.stiffness, relaxation: grab.relaxation }
}
