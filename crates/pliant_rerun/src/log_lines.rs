//! The app's own log lines for the recording's log.

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

/// Maximum number of lines that wait for a tick. Further lines are dropped.
const MAX: usize = 1024;

/// Maximum number of characters of a line.
const LONGEST: usize = 2000;

/// The lines logged since the last tick.
#[derive(Resource)]
pub(crate) struct LogLines(pub Receiver<Line>);

/// A layer for `LogPlugin` that adds the app's log lines to the recording's `log`.
///
/// The layer records what Bevy, Pliant and the game log (`info!` and above, subject to the filter
/// of `LogPlugin`), at the tick of the log call. Lines are dropped if nothing is recorded, and
/// beyond 1024 lines per tick.
///
/// ```no_run
/// use bevy::{log::LogPlugin, prelude::*};
///
/// App::new().add_plugins(DefaultPlugins.set(LogPlugin { custom_layer: pliant_rerun::log_layer, ..default() }));
/// ```
pub fn log_layer(app: &mut App) -> Option<BoxedLayer> {
    let (lines, taken) = bounded(MAX);
    app.insert_resource(LogLines(taken));
    Some(Box::new(Lines(lines)))
}

/// Puts log events into the queue without waiting.
pub(crate) struct Lines(pub Sender<Line>);

impl<S: Subscriber> Layer<S> for Lines {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let data = event.metadata();
        // Lines of the recorder's own threads are left out, because they would record the
        // recording.
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
            // Events of the `log` crate carry their source location in these fields.
            name if name.starts_with("log.") => {}
            name => self.fields += &format!(" {name}={value:?}"),
        }
    }
}
