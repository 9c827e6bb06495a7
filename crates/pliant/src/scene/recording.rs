//! The recording that a scene asks for.

use super::RecordingEntry;
use crate::rerun::RerunPlugin;

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
        plugin.with_application(name).with_shapes_hz(self.shapes_hz)
    }
}
