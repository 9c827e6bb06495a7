//! Patches that are attached to a point of something else, as by a ball joint.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

use nalgebra::Vector3;

use crate::{HeldPatch, StepError, error::finite};

/// Name of an attachment. No other one of the program has it, so that a body that is made anew does
/// not have that of another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct AttachmentId(u64);

/// The point to which a patch is attached.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AttachedTo {
    /// A point of the [`Rigid`](crate::Rigid) body of this key, which gives way. Without such a
    /// body in a step, the attachment has no force in it.
    Rigid {
        /// Key of the rigid body.
        key: [u64; 2],
        /// The point, m, axes of the rigid body, from its center of mass.
        point: [f64; 3],
    },
    /// A point that gives no way.
    World {
        /// Where it is at the beginning of the next step, m, world axes.
        point: [f64; 3],
        /// Its velocity in the next step, m/s, world axes.
        velocity: [f64; 3],
    },
}

impl AttachedTo {
    fn check(&self) -> Result<(), StepError> {
        let (point, velocity) = match self {
            Self::Rigid { point, .. } => (point, &[0.0; 3]),
            Self::World { point, velocity } => (point, velocity),
        };
        finite("point of an attachment", point)?;
        finite("velocity of an attachment", velocity)
    }
}

/// A patch of a body that is attached to a point. Both turn freely about each other.
///
/// The law of the step is that of a contact that sticks, for pulls as for pushes: at the end of
/// the step the surface, with its residual flexibility under the force, is where the point is.
/// A distance that was there before is made up for as a penetration is.
#[derive(Debug, Clone)]
pub(crate) struct Attachment {
    pub(crate) id: AttachmentId,
    pub(crate) patch: Arc<HeldPatch>,
    pub(crate) to: AttachedTo,
    /// Force on the body over the last step, N, world axes.
    pub(crate) force: Vector3<f64>,
    /// About the largest force of the last steps, N.
    pub(crate) largest: f64,
}

impl Attachment {
    pub(crate) fn new(patch: HeldPatch, to: AttachedTo) -> Result<Self, StepError> {
        static NEXT: AtomicU64 = AtomicU64::new(1);
        to.check()?;
        let id = AttachmentId(NEXT.fetch_add(1, Ordering::Relaxed));
        Ok(Self { id, patch: Arc::new(patch), to, force: Vector3::zeros(), largest: 0.0 })
    }

    /// Attaches the patch to another point. The old one stays where the new one is not finite.
    pub(crate) fn move_to(&mut self, to: AttachedTo) -> Result<(), StepError> {
        to.check()?;
        self.to = to;
        Ok(())
    }
}
