//! What this plugin refuses, and how it says so.

use bevy::prelude::*;
use pliant_modal::{ModelError, StepError};
use thiserror::Error;

/// Why an input to a body was refused. The body goes on from its last good state.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BodyError {
    /// A grab's target is NaN or infinite.
    #[error("the target of a grab must be finite metres, got {target:?}; it keeps its last good one")]
    TargetNotFinite {
        /// The target that came, m.
        target: [f64; 3],
    },
    /// A grab of a patch that the model does not have.
    #[error("this grab holds nothing: {0}")]
    Patch(ModelError),
    /// A grab that the body does not take.
    #[error("the grab was refused: {0}")]
    Grab(StepError),
    /// The entity's transform cannot place a body.
    #[error(
        "a body needs a finite transform with a positive, uniform scale, got translation {translation} and scale {scale}; \
         it stays where it was"
    )]
    Placement {
        /// Translation that came, m.
        translation: Vec3,
        /// Scale that came.
        scale: Vec3,
    },
    /// The settings of a [`ModalBody`](crate::ModalBody) do not make a body of this model.
    #[error("the body could not be made from its model and settings: {0}")]
    Build(StepError),
    /// A step failed; the state before it is kept.
    #[error("the step was refused: {0}")]
    Step(StepError),
    /// A [`Impulse`](crate::Impulse) or [`Push`](crate::Push) at a vertex that the body lacks, with a number that is NaN or infinite, or so
    /// hard that the body's velocity is no number any more.
    #[error("the blow was refused: {0}")]
    Blow(StepError),
    /// A [`Impulse`](crate::Impulse) or [`Push`](crate::Push) at an entity that is no body, or whose model is not there yet.
    #[error("the blow was refused: this entity is no body, or its model is not there yet")]
    NoBody,
    /// A [`Impulse`](crate::Impulse) or [`Push`](crate::Push) at a body that somebody else moves.
    #[error("the blow was refused: this body is driven remotely and is not stepped here")]
    NotLocal,
    /// A shown state with the wrong number of modes.
    #[error("a shown state needs {expected} modal coordinates, got {found}")]
    VisualLength {
        /// Modes of the body.
        expected: usize,
        /// Coordinates that came.
        found: usize,
    },
    /// A shown state with a coordinate that is NaN or infinite.
    #[error("modal coordinate {mode} of a shown state must be finite, got {value}")]
    VisualNotFinite {
        /// The first mode that is not finite.
        mode: usize,
        /// Its value, kg^1/2 m.
        value: f64,
    },
    /// A pose with a number that is NaN or infinite.
    #[error("the pose of a body must be finite, got origin {origin:?} m and orientation {orientation:?}")]
    PoseNotFinite {
        /// The origin that came, m.
        origin: [f64; 3],
        /// The quaternion that came, x, y, z, w.
        orientation: [f64; 4],
    },
}

/// Sent (and logged once, with the entity's name) when something that a user or a remote wrote was refused.
#[derive(Message, Reflect, Debug)]
#[reflect(from_reflect = false)]
pub struct BodyRefused {
    /// The entity whose component was refused, or that a message named: a body or a grab.
    pub entity: Entity,
    /// What was expected and what came.
    #[reflect(ignore)]
    pub error: BodyError,
}
