//! The attachments of a body to points of other things.

use super::Body;
use crate::{AttachedTo, AttachmentId, HeldPatch, Patch, StepError, contact::Attachment};

impl Body {
    /// Largest number of attachments of one body.
    pub const MAX_ATTACHMENTS: usize = 64;

    /// Attaches a patch of the body to a point, as by a ball joint. [`Islands`](crate::Islands)
    /// step a body together with the rigid body that it is attached to.
    ///
    /// Where the patch is away from the point, it is drawn there at no more than half of the
    /// body's size in a second. Three attachments that are not on one line hold the rotation too.
    /// The first call chooses the contact sites of the model, which takes a fraction of a second.
    ///
    /// # Errors
    /// Returns an error if a vertex is not on the surface, if a number is not finite, or if the
    /// body already has [`Body::MAX_ATTACHMENTS`].
    pub fn attach(&mut self, patch: &Patch, to: AttachedTo) -> Result<AttachmentId, StepError> {
        let (limit, count) = (Self::MAX_ATTACHMENTS, self.contacts.attachments.len());
        StepError::check("attachments of a body", "at most 64", count < limit, count as f64 + 1.0)?;
        let patch = HeldPatch::new(self.model(), patch, self.mode_count())?;
        let attachment = Attachment::new(patch, to)?;
        if self.contacts.places.is_none() {
            self.kernel.prepare_contacts(&mut self.contacts)?;
        }
        let id = attachment.id;
        self.contacts.attachments.push(attachment);
        Ok(id)
    }

    /// Ends an attachment. Ending it twice is not an error.
    pub fn detach(&mut self, id: AttachmentId) {
        self.contacts.attachments.retain(|attachment| attachment.id != id);
    }

    /// Attaches the patch of an attachment to another point.
    ///
    /// # Errors
    /// Returns an error if a number is not finite, or if there is no such attachment. The old point
    /// then stays.
    pub fn set_attachment(&mut self, id: AttachmentId, to: AttachedTo) -> Result<(), StepError> {
        let mut all = self.contacts.attachments.iter_mut();
        all.find(|attachment| attachment.id == id).ok_or(StepError::NoAttachment)?.move_to(to)
    }

    /// Mean force of an attachment on the body over the last step, N, world axes.
    ///
    /// # Errors
    /// Returns [`StepError::NoAttachment`] if there is no such attachment.
    pub fn attachment_force(&self, id: AttachmentId) -> Result<[f64; 3], StepError> {
        Ok(self.attachment(id)?.force.into())
    }

    /// Where the patch of an attachment is, m, world axes. Its residual flexibility is not in it.
    ///
    /// # Errors
    /// Returns [`StepError::NoAttachment`] if there is no such attachment.
    pub fn attachment_position(&self, id: AttachmentId) -> Result<[f64; 3], StepError> {
        let patch = &self.attachment(id)?.patch;
        let local = patch.rest() + patch.displacement(&self.state.q, self.kernel.warps());
        Ok(self.state.frame.to_world(local).into())
    }

    /// The attachments of the body, oldest first, and what each is attached to.
    pub fn attachments(&self) -> impl Iterator<Item = (AttachmentId, AttachedTo)> + '_ {
        self.contacts.attachments.iter().map(|attachment| (attachment.id, attachment.to))
    }

    fn attachment(&self, id: AttachmentId) -> Result<&Attachment, StepError> {
        let mut all = self.contacts.attachments.iter();
        all.find(|attachment| attachment.id == id).ok_or(StepError::NoAttachment)
    }
}
