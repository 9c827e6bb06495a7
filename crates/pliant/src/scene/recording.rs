//! The recording that a scene asks for.

use super::{ColorEntry, RecordingEntry};
use crate::rerun::{RerunColor, RerunPlugin, RerunRecording};

impl RecordingEntry {
    /// Returns the plugin for the recording; the caller adds it to an app.
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

    /// Returns how often each kind of data is recorded.
    fn rates(&self) -> RerunRecording {
        RerunRecording {
            on: true,
            shapes_hz: self.shapes_hz,
            metrics_hz: self.metrics_hz.unwrap_or(f64::INFINITY),
            hands_hz: self.hands_hz.unwrap_or(f64::INFINITY),
            modes_hz: self.modes_hz,
            color: match self.color {
                ColorEntry::Displacement => RerunColor::Displacement,
                ColorEntry::Stress => RerunColor::Stress,
            },
            device_loops: self.device_loops,
        }
    }
}
