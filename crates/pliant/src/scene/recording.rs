//! The recording that a scene asks for.

use super::{ColourEntry, RecordingEntry};
use crate::rerun::{RerunColour, RerunPlugin, RerunRecording};

impl RecordingEntry {
    /// The plugin, not yet in an app.
    pub(super) fn plugin(&self, title: &str) -> RerunPlugin {
        let plugin = match (&self.file, self.viewer) {
            (Some(file), true) => RerunPlugin::both(file),
            (Some(file), false) => RerunPlugin::file(file),
            (None, true) => RerunPlugin::viewer(),
            (None, false) => RerunPlugin::none(),
        };
        let name = if title.trim().is_empty() { "pliant scene" } else { title };
        plugin.with_application(name).with_rates(self.rates())
    }

    /// How often what is recorded.
    fn rates(&self) -> RerunRecording {
        RerunRecording {
            on: true,
            shapes_hz: self.shapes_hz,
            figures_hz: self.figures_hz.unwrap_or(f64::INFINITY),
            hands_hz: self.hands_hz.unwrap_or(f64::INFINITY),
            modes_hz: self.modes_hz,
            colour: match self.colour {
                ColourEntry::Displacement => RerunColour::Displacement,
                ColourEntry::Stress => RerunColour::Stress,
            },
            device_loops: self.device_loops,
        }
    }
}
