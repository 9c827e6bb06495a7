//! Sliders that change a value only when the user edits it.

use std::ops::RangeInclusive;

use bevy_egui::egui::{Response, Slider, SliderClamping, Ui, emath::Numeric};

/// Adds a slider over `value`, which changes only by the user's input.
///
/// A value outside `range`, or between the shown decimals, stays as it is until then. Egui's own
/// slider clamps and rounds in every frame, and its field writes back the shown text when the focus
/// passes through it.
pub(crate) fn knob<N: Numeric>(
    ui: &mut Ui,
    value: &mut N,
    range: RangeInclusive<N>,
    dress: impl FnOnce(Slider<'_>) -> Slider<'_>,
) -> Response {
    let mut moved = *value;
    let response = ui.add(dress(Slider::new(&mut moved, range).clamping(SliderClamping::Edits)));
    // A typed value was already applied while it was typed. The change on leaving the field is only
    // its rounded text.
    if response.changed() && !response.lost_focus() {
        *value = moved;
    }
    response
}
