//! What this peer does with the bodies itself.

use pliant_modal::GrabConfig;

use super::PeerSession;
use crate::StreamError;
use crate::state::{BodyId, in_range, next_free};
use crate::wire::{HeldAt, ImpulseAt, MAX_HELD, MAX_IMPULSES, check_hold};

impl PeerSession {
    /// Grabs a body at the next tick and returns the number of the grab.
    ///
    /// `hold` gives the hand's own spring and damper, capped at what devices have, or a grab as
    /// stiff as the patch allows ([`GrabConfig::default`]).
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownBody`] for an unknown body, [`StreamError::NotFinite`] for a
    /// target or radius out of range, [`StreamError::Config`] for a spring or damper out of range,
    /// [`StreamError::Model`] for a vertex that the model lacks or a radius larger than the body,
    /// and [`StreamError::Full`] beyond 16 grabs.
    pub fn begin_grab(
        &mut self,
        body: BodyId,
        vertex: u32,
        radius: f64,
        target: [f64; 3],
        hold: GrabConfig,
    ) -> Result<u16, StreamError> {
        let b = self.bodies.get(&body).ok_or(StreamError::UnknownBody(body))?;
        if !in_range(&target) || !(0.0..=1e9).contains(&radius) {
            return Err(StreamError::NotFinite { what: "grab" });
        }
        let hold = check_hold(hold)?;
        if vertex as usize >= b.model().surface().positions().len() {
            return Err(StreamError::Model(format!("vertex {vertex} is not on the surface")));
        }
        // The comparison uses the radius as the wire format rounds it.
        if f64::from(radius as f32) > b.model().size() {
            return Err(StreamError::Model(format!("a radius of {radius} m is larger than the body")));
        }
        if self.own.len() >= MAX_HELD {
            return Err(StreamError::Full { what: "grabs", limit: MAX_HELD });
        }
        let grab = next_free(&mut self.next_grab, |grab| !self.own.contains_key(&grab));
        self.own.insert(grab, HeldAt { body, grab, vertex, radius, target, hold }.rounded());
        Ok(grab)
    }

    /// Moves a hand. The body receives the new target at the next tick.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownGrab`] for an unknown grab and [`StreamError::NotFinite`] for
    /// a target out of range.
    pub fn set_target(&mut self, grab: u16, target: [f64; 3]) -> Result<(), StreamError> {
        if !in_range(&target) {
            return Err(StreamError::NotFinite { what: "target" });
        }
        let own = self.own.get_mut(&grab).ok_or(StreamError::UnknownGrab(grab))?;
        *own = HeldAt { target, ..*own }.rounded();
        Ok(())
    }

    /// Ends a grab at the next tick.
    pub fn end_grab(&mut self, grab: u16) {
        self.own.remove(&grab);
    }

    /// Applies an impulse (N s, world axes) to a surface vertex of a body at the next tick, at all
    /// peers. It brings the body at most
    /// [`MAX_IMPULSE_SPEED`](crate::MAX_IMPULSE_SPEED) and is rounded to single precision.
    ///
    /// # Errors
    /// Returns [`StreamError::UnknownBody`] for an unknown body, [`StreamError::NotFinite`] for an
    /// impulse out of range, [`StreamError::Model`] for a vertex that the model lacks,
    /// [`StreamError::State`] before this peer steps, and [`StreamError::Full`] beyond 8 impulses a
    /// tick.
    pub fn apply_impulse(&mut self, body: BodyId, vertex: u32, impulse: [f64; 3]) -> Result<(), StreamError> {
        let b = self.bodies.get(&body).ok_or(StreamError::UnknownBody(body))?;
        if !in_range(&impulse) {
            return Err(StreamError::NotFinite { what: "impulse" });
        }
        if vertex as usize >= b.model().surface().positions().len() {
            return Err(StreamError::Model(format!("vertex {vertex} is not on the surface")));
        }
        if !self.started {
            let (what, state) = ("apply_impulse", "not started");
            return Err(StreamError::State { what, state, needed: "a state from the others" });
        }
        if self.impulses.len() >= MAX_IMPULSES {
            return Err(StreamError::Full { what: "impulses", limit: MAX_IMPULSES });
        }
        self.impulses.push(ImpulseAt { body, vertex, impulse }.rounded());
        Ok(())
    }
}
