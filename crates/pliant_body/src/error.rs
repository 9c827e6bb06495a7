//! The inputs that this plugin refuses, and their errors.

use bevy::prelude::*;
use pliant_modal::{ModelError, StepError};
use thiserror::Error;

/// The reason why an input to a body was refused. The body continues from its last valid state.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BodyError {
    /// The target of a grab is NaN or infinite.
    #[error("the target of a grab must be finite meters, got {target:?}; it keeps its last good one")]
    TargetNotFinite {
        /// The refused target, m.
        target: [f64; 3],
    },
    /// The model does not have the patch of a grab or an attachment.
    #[error("the patch holds nothing: {0}")]
    Patch(ModelError),
    /// The body refused the grab.
    #[error("the grab was refused: {0}")]
    Grab(StepError),
    /// The entity's transform cannot place a body.
    #[error(
        "a body needs a finite transform with a positive, uniform scale, got translation {translation} and scale {scale}; \
         it stays where it was"
    )]
    Placement {
        /// The refused translation, m.
        translation: Vec3,
        /// The refused scale.
        scale: Vec3,
    },
    /// The settings of a [`ModalBody`](crate::ModalBody) do not make a body of this model.
    #[error("the body could not be made from its model and settings: {0}")]
    Build(StepError),
    /// The [`SavedState`](crate::SavedState) of a loaded body does not fit its model. The body
    /// starts at rest.
    #[error("the saved state of the body does not fit: {0}; it starts at rest")]
    Saved(StepError),
    /// A step failed. The body keeps the state before it.
    #[error("the step was refused: {0}")]
    Step(StepError),
    /// The vertex of an [`Impulse`](crate::Impulse) or a [`Push`](crate::Push) does not exist, a
    /// number is NaN or infinite, or the resulting velocity of the body is not finite.
    #[error("the impulse was refused: {0}")]
    Impulse(StepError),
    /// The settings or the target of a [`TouchProbe`](crate::TouchProbe) are out of range.
    #[error("the probe touches nothing: {0}")]
    Probe(StepError),
    /// The entity of an [`Impulse`](crate::Impulse) or a [`Push`](crate::Push) is not a body, or
    /// its model is not loaded yet.
    #[error("the impulse was refused: this entity is no body, or its model is not there yet")]
    NoBody,
    /// The body of a [`Push`](crate::Push) is remote.
    #[error("the push was refused: this body is driven remotely and is not stepped here")]
    NotLocal,
    /// Who drives the body, such as a session, did not take an [`Impulse`](crate::Impulse).
    #[error("the impulse was refused: {why}")]
    NotTaken {
        /// The reason.
        why: String,
    },
    /// The body of a [`SurfaceAnchor`](crate::SurfaceAnchor) does not exist or was despawned.
    #[error("there is no body whose surface this entity could follow; it stays where it is")]
    NoSurface,
    /// The surface of the body does not have the place of a
    /// [`SurfaceAnchor`](crate::SurfaceAnchor).
    #[error("the body has no such place on its surface; the entity stays where it is")]
    NoSurfacePlace,
    /// The soft or the rigid body of an attachment does not exist, or the surface does not have its
    /// place.
    #[error("the attachment holds nothing: its bodies or its place on the surface do not exist")]
    NotAttached,
    /// The body refused an attachment or its point.
    #[error("the attachment was refused: {0}")]
    Attachment(StepError),
    /// An obstacle has a number that is not finite or out of range. Bodies do not touch it.
    #[error("the obstacle was refused: {0}")]
    Obstacle(StepError),
    /// The friction of a body is not finite or out of range. The body keeps its former friction.
    #[error("the friction was refused: {0}")]
    Friction(StepError),
    /// A visual state has the wrong number of modes.
    #[error("a visual state needs {expected} modal coordinates, got {found}")]
    VisualLength {
        /// Number of modes of the body.
        expected: usize,
        /// Number of coordinates in the refused state.
        found: usize,
    },
    /// A modal coordinate of a visual state is NaN or infinite.
    #[error("modal coordinate {mode} of a visual state must be finite, got {value}")]
    VisualNotFinite {
        /// Index of the first mode that is not finite.
        mode: usize,
        /// The value of that mode, kg^1/2 m.
        value: f64,
    },
    /// A number of a pose is NaN or infinite.
    #[error("the pose of a body must be finite, got origin {origin:?} m and orientation {orientation:?}")]
    PoseNotFinite {
        /// The refused origin, m.
        origin: [f64; 3],
        /// The refused quaternion, x, y, z, w.
        orientation: [f64; 4],
    },
}

/// Reports a refused input of a user or a remote source. Observe it on the entity or on all.
///
/// The plugin triggers this event once and logs it with the entity's name.
#[derive(EntityEvent, Reflect, Debug)]
#[reflect(Debug, from_reflect = false)]
pub struct BodyRefused {
    /// The entity of the refused component, or the entity that a message named: a body, a grab, an
    /// attachment or a surface anchor.
    pub entity: Entity,
    /// The error: the expected and the actual input.
    #[reflect(ignore)]
    pub error: BodyError,
}
