//! The recording of what happens.

use bevy_egui::egui::Ui;

use crate::{knob::knob, trace::short};

/// The recording as the panel shows it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RecordingView {
    /// Whether data is recorded. A knob.
    pub on: bool,
    /// Number of connected sinks: the file, the viewer.
    pub sinks: usize,
    /// Number of recorded ticks.
    pub ticks: u64,
    /// Number of ticks dropped because a sink's queue was full.
    pub dropped: u64,
    /// Number of older recordings that were removed from the folder of this one to make room.
    pub removed: u64,
    /// Drawings of shapes per second, Hz. A knob.
    pub shapes_hz: f64,
    /// Drawings of mode energies and spectra per second, Hz. A knob.
    pub modes_hz: f64,
    /// Whether surfaces are colored by stress instead of displacement. A knob.
    pub stress: bool,
}

/// Shows the recording.
pub fn show(ui: &mut Ui, recording: &mut RecordingView) {
    if recording.sinks == 0 {
        ui.weak(if recording.ticks == 0 {
            "Nothing records: no file was named, and no viewer answers.".into()
        } else {
            format!("Nothing records any more after {} ticks: the log says why.", recording.ticks)
        });
        return;
    }
    ui.horizontal(|ui| {
        ui.checkbox(&mut recording.on, "record");
        let sinks = if recording.sinks == 1 { "1 sink".into() } else { format!("{} sinks", recording.sinks) };
        ui.label(format!("{} ticks to {sinks}, {} dropped", recording.ticks, recording.dropped));
    });
    if recording.removed > 0 {
        let recordings = if recording.removed == 1 { "recording was" } else { "recordings were" };
        ui.label(format!("{} older {recordings} removed to make room", recording.removed));
    }
    let every = if recording.shapes_hz.is_finite() {
        format!("now {} a second", short(recording.shapes_hz))
    } else {
        "now every one".into()
    };
    knob(ui, &mut recording.shapes_hz, 0.0..=60.0, |slider| slider.text("shapes a second").max_decimals(0))
        .on_hover_text(format!("Shapes drawn in the recording, {every}."));
    knob(ui, &mut recording.modes_hz, 0.0..=20.0, |slider| slider.text("bars a second").max_decimals(0))
        .on_hover_text("The energies of the modes and the spectrum; zero leaves them out.");
    ui.checkbox(&mut recording.stress, "color by stress")
        .on_hover_text("Off, surfaces are colored by displacement.");
}
