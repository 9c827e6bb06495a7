//! The recording's section of the live panel.

use bevy::prelude::*;

use crate::panel::{Panel, PanelRecording, recording::RecordingView};
use crate::rerun::{RerunColor, RerunRecording, RerunStats};

/// Shows the recording in the live panel, and applies the panel's knobs to it.
///
/// The panel and the recording do not know each other, so this plugin copies between them. It is a
/// part of [`PliantPlugins`](crate::PliantPlugins), and adds nothing to an app without a
/// [`RerunPlugin`](crate::rerun::RerunPlugin) or without a
/// [`PanelPlugin`](crate::panel::PanelPlugin).
#[derive(Debug, Clone, Copy, Default)]
pub struct RecordingPanelPlugin;

impl Plugin for RecordingPanelPlugin {
    fn build(&self, _: &mut App) {}

    fn finish(&self, app: &mut App) {
        // All plugins have been built by now, in whatever order they were added.
        let world = app.world();
        if world.contains_resource::<Panel>() && world.contains_resource::<RerunRecording>() {
            app.init_resource::<PanelRecording>()
                .add_systems(Last, exchange.run_if(|panel: Res<Panel>| panel.open));
        }
    }
}

/// Applies the knobs that have changed since the last frame, and shows the recording as it is.
fn exchange(
    mut panel: ResMut<PanelRecording>,
    mut last: Local<Option<RecordingView>>,
    mut settings: ResMut<RerunRecording>,
    stats: Res<RerunStats>,
) {
    if last.as_ref().is_some_and(|last| *last != **panel) {
        let wanted = RerunRecording {
            on: panel.on,
            shapes_hz: panel.shapes_hz,
            modes_hz: panel.modes_hz,
            color: if panel.stress { RerunColor::Stress } else { RerunColor::Displacement },
            ..*settings
        };
        settings.set_if_neq(wanted);
    }
    let view = RecordingView {
        on: settings.on,
        sinks: stats.sinks,
        ticks: stats.collected,
        dropped: stats.dropped,
        removed: stats.removed,
        shapes_hz: settings.shapes_hz,
        modes_hz: settings.modes_hz,
        stress: settings.color == RerunColor::Stress,
    };
    *last = Some(view.clone());
    **panel = view;
}

#[cfg(test)]
mod tests {
    use super::*;

    fn app(more: impl FnOnce(&mut App)) -> App {
        let mut app = App::new();
        app.add_plugins((MinimalPlugins, RecordingPanelPlugin));
        more(&mut app);
        app.finish();
        app.cleanup();
        app.update();
        app
    }

    #[test]
    fn the_panel_shows_the_recording_and_its_knobs_change_it_and_nothing_else() {
        let odd = RerunRecording { shapes_hz: f64::INFINITY, modes_hz: 1.0 / 3.0, ..default() };
        let mut app = app(|app| {
            app.insert_resource(odd).init_resource::<Panel>();
            app.insert_resource(RerunStats { sinks: 1, collected: 7, removed: 2, ..default() });
        });
        let now = |app: &App| *app.world().resource::<RerunRecording>();
        app.update();
        assert_eq!(now(&app), odd, "looked at, and left as it is");
        let seen = app.world().resource::<PanelRecording>();
        assert_eq!((seen.sinks, seen.ticks, seen.removed, seen.on, seen.stress), (1, 7, 2, true, false));

        let mut knobs = app.world_mut().resource_mut::<PanelRecording>();
        (knobs.on, knobs.stress, knobs.modes_hz) = (false, true, 2.0);
        app.update();
        let wanted = RerunRecording { on: false, color: RerunColor::Stress, modes_hz: 2.0, ..odd };
        assert_eq!(now(&app), wanted);
        // A change elsewhere is shown, and stays.
        app.world_mut().resource_mut::<RerunRecording>().on = true;
        app.update();
        assert!(now(&app).on && app.world().resource::<PanelRecording>().on);
    }

    #[test]
    fn an_app_without_a_recording_has_no_such_section() {
        let app = app(|app| {
            app.init_resource::<Panel>();
        });
        assert!(!app.world().contains_resource::<PanelRecording>());
    }
}
