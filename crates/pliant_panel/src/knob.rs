//! Sliders that change nothing by being looked at.

use std::ops::RangeInclusive;

use bevy_egui::egui::{Response, Slider, SliderClamping, Ui, emath::Numeric};

/// A slider over `value`, which only somebody's hand or word changes: what lies outside `range`, or between the decimals shown, stays as it is until then.
/// Egui's own clamps and rounds in every frame, and a field that the focus passes through gives back what it shows.
pub(crate) fn knob<N: Numeric>(
    ui: &mut Ui,
    value: &mut N,
    range: RangeInclusive<N>,
    dress: impl FnOnce(Slider<'_>) -> Slider<'_>,
) -> Response {
    let mut moved = *value;
    let response = ui.add(dress(Slider::new(&mut moved, range).clamping(SliderClamping::Edits)));
    // What was typed was taken as it was typed: all that comes when the field is left is its own rounded text.
    if response.changed() && !response.lost_focus() {
        *value = moved;
    }
    response
}
