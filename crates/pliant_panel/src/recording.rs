//! The recording for the rerun viewer.

use bevy_egui::egui::Ui;

use crate::trace::short;

/// The recording as the panel shows it.
#[derive(Debug, Clone, Default)]
pub struct RecordingView {
    /// Records. A knob.
    pub on: bool,
    /// Sinks that listen: the file, the viewer.
    pub sinks: usize,
    /// Ticks recorded.
    pub ticks: u64,
    /// Ticks that a sink had no room for.
    pub dropped: u64,
    /// Shapes a second. A knob.
    pub shapes_hz: f64,
}

/// Shows the recording.
pub fn show(ui: &mut Ui, recording: &mut RecordingView) {
    if recording.sinks == 0 {
        ui.weak("Nothing records: no file was named, and no viewer answers.");
        return;
    }
    ui.horizontal(|ui| {
        ui.checkbox(&mut recording.on, "record");
        let sinks = if recording.sinks == 1 { "1 sink".into() } else { format!("{} sinks", recording.sinks) };
        ui.label(format!("{} ticks to {sinks}, {} dropped", recording.ticks, recording.dropped));
    });
    ui.add(
        bevy_egui::egui::Slider::new(&mut recording.shapes_hz, 0.0..=60.0)
            .text("shapes a second")
            .max_decimals(0),
    )
    .on_hover_text(format!("Shapes drawn in the recording, now {} a second.", short(recording.shapes_hz)));
}
