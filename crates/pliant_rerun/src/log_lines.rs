//! The app's own log lines, for the recording's.

use bevy::{
    log::{
        BoxedLayer, Level,
        tracing::{Event, Subscriber, field::Visit},
        tracing_subscriber::{Layer, layer::Context},
    },
    prelude::*,
};
use crossbeam_channel::{Receiver, Sender, bounded};

use crate::frame::Line;

/// Lines that wait for a tick at most; those beyond are left out.
const MOST: usize = 1024;

/// Letters of a line at most.
const LONGEST: usize = 2000;

/// What was logged since the last tick.
#[derive(Resource)]
pub(crate) struct LogLines(pub Receiver<Line>);

/// A layer for `LogPlugin`: what Bevy, Pliant and the game log (`info!` and above, as far as `LogPlugin` lets it through) is then in the
/// recording's `log`, at the tick at which it was logged. Lines that no recording takes are forgotten, and more than 1024 a tick left out.
///
/// ```no_run
/// use bevy::{log::LogPlugin, prelude::*};
///
/// App::new().add_plugins(DefaultPlugins.set(LogPlugin { custom_layer: pliant_rerun::log_layer, ..default() }));
/// ```
pub fn log_layer(app: &mut App) -> Option<BoxedLayer> {
    let (lines, taken) = bounded(MOST);
    app.insert_resource(LogLines(taken));
    Some(Box::new(Lines(lines)))
}

/// Puts events in the queue; never waits.
pub(crate) struct Lines(pub Sender<Line>);

impl<S: Subscriber> Layer<S> for Lines {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let data = event.metadata();
        // The recorder's own threads would otherwise record what they say of their recording.
        if *data.level() > Level::INFO || data.target().starts_with("re_") || self.0.is_full() {
            return;
        }
        let mut text = Text { message: String::new(), fields: String::new() };
        event.record(&mut text);
        let Text { message, fields } = text;
        let text = format!("{}: {message}{fields}", data.target());
        let text = text.chars().take(LONGEST).collect();
        self.0.try_send(Line { warning: *data.level() <= Level::WARN, text }).ok();
    }
}

struct Text {
    message: String,
    fields: String,
}

impl Visit for Text {
    fn record_debug(&mut self, field: &bevy::log::tracing::field::Field, value: &dyn std::fmt::Debug) {
        match field.name() {
            "message" => self.message = format!("{value:?}"),
            // What the `log` crate's events carry of their place.
            name if name.starts_with("log.") => {}
            name => self.fields += &format!(" {name}={value:?}"),
        }
    }
}
