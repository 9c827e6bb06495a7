//! The grabs on a body, and the shapes of the patches that they hold.

use std::sync::Arc;

use nalgebra::Vector3;

use super::{Body, GrabEntry, GrabId};
use crate::{GrabConfig, Hand, HeldPatch, HeldPlace, HeldShapes, Hold, Patch, StepError, error::finite};

impl Body {
    /// Maximum number of grabs on one body.
    pub const MAX_GRABS: usize = 32;

    /// Grabs a patch of the body.
    ///
    /// The target starts at the current position of the patch, so the grab itself moves nothing.
    ///
    /// # Errors
    /// Returns an error if a vertex is not on the surface, if the configuration is out of range, or
    /// if the body already has [`Body::MAX_GRABS`] grabs.
    pub fn grab(&mut self, patch: &Patch, config: GrabConfig) -> Result<GrabId, StepError> {
        if self.grabs.len() >= Self::MAX_GRABS {
            return Err(StepError::TooManyGrabs { limit: Self::MAX_GRABS });
        }
        config.check()?;
        let patch = HeldPatch::new(self.model(), patch, self.mode_count())?;
        let local = patch.rest() + self.patch_displacement(&patch);
        let target = self.state.frame.to_world(local);
        let id = GrabId(self.next_grab);
        self.next_grab += 1;
        let hold = Hold::Target { target, velocity: Vector3::zeros(), config };
        self.hands.push(Hand::new(Arc::new(patch), hold));
        self.grabs.push(GrabEntry { id, target, last_target: None, slip: Vector3::zeros(), config });
        self.kernel.prepare(&self.hands);
        Ok(id)
    }

    /// Releases a grab. Releasing a grab twice is not an error.
    pub fn release(&mut self, id: GrabId) {
        if let Ok(index) = self.find(id) {
            self.grabs.remove(index);
            self.hands.remove(index);
            if self.hands.is_empty() {
                // No shapes are always taken, and the state is this body's own.
                let _ = self.set_held_shapes(None);
            }
            self.kernel.prepare(&self.hands);
        }
    }

    /// Sets the own shapes of the patches that are held, with which a body of reduced elasticity
    /// feels the right force in a hand ([`HeldShapes`]). Linear elasticity does not use them.
    ///
    /// The shapes go when the last grab is released, and when the elasticity becomes linear.
    ///
    /// Under the same forces, the held patches are elsewhere with other shapes. The hands follow by
    /// as much, and come back to their targets within a second. What they feel goes over to the new
    /// force as smoothly.
    ///
    /// # Errors
    /// Returns [`StepError::OtherModel`] for shapes of another model. The old ones then stay.
    pub fn set_held_shapes(&mut self, shapes: Option<Arc<HeldShapes>>) -> Result<(), StepError> {
        let points = |body: &Self| -> Vec<Vector3<f64>> {
            body.hands.iter().map(|hand| body.kernel.hand_point(hand, &body.state)).collect()
        };
        let before = points(self);
        self.kernel.set_held_shapes(shapes, &mut self.state, &self.hands)?;
        self.kernel.prepare(&self.hands);
        let (after, frame) = (points(self), self.state.frame);
        for ((grab, before), after) in self.grabs.iter_mut().zip(before).zip(after) {
            let slip = grab.slip + frame.rotation() * (after - before);
            grab.slip = if slip.norm() <= self.kernel.model().size() { slip } else { Vector3::zeros() };
        }
        Ok(())
    }

    /// The own shapes of held patches that the steps use.
    pub fn held_shapes(&self) -> Option<&Arc<HeldShapes>> {
        self.kernel.held_shapes()
    }

    /// The patches that are held and where they are, oldest first. Where a hand still comes back
    /// from the place that other shapes put it to ([`Body::set_held_shapes`]), it is taken for
    /// back: shapes for the place on the way would put it elsewhere again.
    pub fn held_places(&self) -> impl ExactSizeIterator<Item = HeldPlace> + Clone + '_ {
        let back = self.state.frame.rotation().inverse();
        self.hands.iter().zip(&self.grabs).map(move |(hand, grab)| {
            let (vertex, radius) = hand.patch.center_and_radius();
            let displacement = self.patch_displacement(&hand.patch) - back * grab.slip;
            HeldPlace { vertex, radius, displacement: displacement.into() }
        })
    }

    /// Mean displacement of a patch from rest, m, body axes.
    pub(super) fn patch_displacement(&self, patch: &HeldPatch) -> Vector3<f64> {
        let own = self.kernel.held_shapes().map(|shapes| shapes.displacement(patch, &self.state.s));
        patch.displacement(&self.state.q, self.kernel.warps()) + own.unwrap_or_default()
    }

    /// Makes the own shapes of the held patches anew where those that the body has do not suffice
    /// ([`HeldShapes::wanted`]). That takes half a second for a hand and up to ten seconds for two:
    /// a game makes them beside its frames.
    /// Returns whether the body has got others.
    ///
    /// # Errors
    /// Returns the errors of [`HeldShapes::of_places`].
    pub fn make_held_shapes(&mut self) -> Result<bool, StepError> {
        // A kernel of fewer coordinates does not use shapes.
        let whole = self.mode_count() == self.model().mode_count();
        if !whole || !self.config.settings.is_reduced(self.model()) {
            return Ok(false);
        }
        let own = self.held_shapes().map(|shapes| &**shapes);
        let Some(places) = HeldShapes::wanted(self.model(), self.held_places(), own) else {
            return Ok(false);
        };
        if places == self.without {
            return Ok(false);
        }
        let shapes = HeldShapes::of_places(self.model(), &places)?.map(Arc::new);
        // Of the same patches and of more, the old ones are better than none.
        let is_of = |own: &HeldShapes, place: &HeldPlace| own.places().any(|made| made.key() == place.key());
        let serve =
            |own: &Arc<HeldShapes>| !places.is_empty() && places.iter().all(|place| is_of(own, place));
        let changes = shapes.is_some() || self.held_shapes().is_some_and(|own| !serve(own));
        if shapes.is_none() {
            self.without = places;
        }
        if changes {
            self.set_held_shapes(shapes)?;
        }
        Ok(changes)
    }

    /// The grabs on the body, oldest first.
    pub fn grabs(&self) -> impl Iterator<Item = GrabId> + '_ {
        self.grabs.iter().map(|g| g.id)
    }

    /// Moves the target of a grab (m, world axes).
    ///
    /// # Errors
    /// Returns an error if the target is not finite (the old target then stays) or if there is no
    /// such grab.
    pub fn set_target(&mut self, id: GrabId, target: [f64; 3]) -> Result<(), StepError> {
        finite("grab target", &target)?;
        let index = self.find(id)?;
        self.grabs[index].target = target.into();
        Ok(())
    }

    /// The target of a grab, m, world axes.
    ///
    /// # Errors
    /// Returns [`StepError::NoGrab`] if there is no such grab.
    pub fn target(&self, id: GrabId) -> Result<[f64; 3], StepError> {
        Ok(self.grabs[self.find(id)?].target.into())
    }

    /// Current position of the grabbed patch, m, world axes.
    ///
    /// # Errors
    /// Returns [`StepError::NoGrab`] if there is no such grab.
    pub fn grab_position(&self, id: GrabId) -> Result<[f64; 3], StepError> {
        let patch = &self.hands[self.find(id)?].patch;
        let local = patch.rest() + self.patch_displacement(patch);
        Ok(self.state.frame.to_world(local).into())
    }

    /// The reaction at the end of the last step: the force that the body exerts on the hand, N,
    /// world axes.
    ///
    /// # Errors
    /// Returns [`StepError::NoGrab`] if there is no such grab.
    pub fn reaction(&self, id: GrabId) -> Result<[f64; 3], StepError> {
        Ok((-self.hands[self.find(id)?].pull).into())
    }

    /// The force that the body exerted on the hand over the last step, N, world axes.
    ///
    /// This force times the step length is the impulse on the hand. [`reaction`](Self::reaction) is
    /// the force at the end of the step.
    ///
    /// # Errors
    /// Returns [`StepError::NoGrab`] if there is no such grab.
    pub fn mean_reaction(&self, id: GrabId) -> Result<[f64; 3], StepError> {
        Ok((-self.hands[self.find(id)?].mean).into())
    }

    /// Sets the value that [`mean_reaction`](Self::mean_reaction) returns. The next step uses this
    /// value.
    ///
    /// A copy of a body that takes over a [`State`](crate::State) must take over this value too.
    ///
    /// # Errors
    /// Returns an error if there is no such grab or a number is not finite.
    pub fn set_mean_reaction(&mut self, id: GrabId, force: [f64; 3]) -> Result<(), StepError> {
        finite("mean reaction", &force)?;
        let index = self.find(id)?;
        self.hands[index].mean = -Vector3::from(force);
        Ok(())
    }

    /// The compliance of a grab within one step (3x3, m/N, body axes).
    ///
    /// It is the residual flexibility of the patch plus the compliance of the hand's own spring.
    /// Where the material relaxes, the residual flexibility is multiplied by
    /// [`Relaxation::creep`](crate::Relaxation::creep) of one step.
    ///
    /// # Errors
    /// Returns [`StepError::NoGrab`] if there is no such grab.
    pub fn compliance(&self, id: GrabId) -> Result<[[f64; 3]; 3], StepError> {
        let c = self.kernel.compliance(&self.hands[self.find(id)?], &self.state.q);
        Ok(std::array::from_fn(|i| std::array::from_fn(|j| c[(i, j)])))
    }

    /// Viscoelastic state of the residual flexibility under a grab, m, body axes.
    ///
    /// It is the `z` of the compliance that the modes leave out, and holds the creep under the
    /// forces so far. It is zero where the material does not relax. A copy of a body that takes
    /// over a [`State`](crate::State) must take over this value too.
    ///
    /// # Errors
    /// Returns [`StepError::NoGrab`] if there is no such grab.
    pub fn grab_viscoelastic_state(&self, id: GrabId) -> Result<[f64; 3], StepError> {
        Ok(self.hands[self.find(id)?].viscoelastic.into())
    }

    /// Sets the value that [`grab_viscoelastic_state`](Self::grab_viscoelastic_state) returns.
    ///
    /// This does nothing where the material does not relax.
    ///
    /// # Errors
    /// Returns an error if there is no such grab or a number is not finite.
    pub fn set_grab_viscoelastic_state(
        &mut self,
        id: GrabId,
        viscoelastic: [f64; 3],
    ) -> Result<(), StepError> {
        finite("grab viscoelastic state", &viscoelastic)?;
        let index = self.find(id)?;
        if self.config.settings.relaxation.is_some() {
            self.hands[index].viscoelastic = viscoelastic.into();
        }
        Ok(())
    }

    fn find(&self, id: GrabId) -> Result<usize, StepError> {
        self.grabs.iter().position(|g| g.id == id).ok_or(StepError::NoGrab)
    }
}
