//! What is shown of a copy: corrections of it fade, in position and velocity.

use pliant_modal::ModalModel;

use crate::recovery::{Blend, PoseBlend};
use crate::state::{RigidState, State};

/// The visual state of a copy, with its offsets from the copy.
#[derive(Debug)]
pub(crate) struct VisualCopy {
    pub state: State,
    /// The visual rigid frame of a free body.
    pub pose: Option<RigidState>,
    blend: Blend,
    pose_blend: PoseBlend,
}

impl VisualCopy {
    /// Shows a state. Corrections fade over `ticks` steps of `h` seconds.
    pub(crate) fn new(model: &ModalModel, state: State, h: f64, ticks: u16) -> Self {
        let (blend, pose_blend) = (Blend::new(h, ticks), PoseBlend::new(h, ticks));
        let mut made = Self { state: State::default(), pose: None, blend, pose_blend };
        made.show(model, &state);
        made
    }

    /// Removes all offsets.
    pub(crate) fn clear(&mut self) {
        self.blend.clear();
        self.pose_blend.clear();
    }

    /// Ages all offsets by one tick.
    pub(crate) fn advance(&mut self) {
        self.blend.advance();
        self.pose_blend.advance();
    }

    /// Whether the visual frame still differs from that of the copy.
    pub(crate) fn is_turning(&self) -> bool {
        !self.pose_blend.is_empty()
    }

    /// Adds the offset of a correction that moved the copy from `before` to `now`.
    pub(crate) fn add(&mut self, model: &ModalModel, before: &State, now: &State) {
        self.blend.add(
            before.q.iter().zip(&now.q).map(|(b, n)| b - n),
            before.v.iter().zip(&now.v).map(|(b, n)| b - n),
        );
        if model.is_free() {
            let of = |state: &State| RigidState::of_frame(model, &state.frame);
            self.pose_blend.add(&of(before), &of(now));
        }
    }

    /// Shows the copy with its offsets.
    pub(crate) fn show(&mut self, model: &ModalModel, now: &State) {
        self.state.clone_from(now);
        self.blend.apply(&mut self.state.q, &mut self.state.v);
        let pose = model.is_free().then(|| RigidState::of_frame(model, &now.frame));
        self.pose = pose.map(|pose| self.pose_blend.apply(&pose));
    }
}
