//! Metrics and hands of several ticks, sent as columns: one message per line of a plot instead of
//! one per value.

use std::collections::HashMap;

use rerun::{
    Arrows3D, Color, EntityPath, LineStrips3D, Points3D, RecordingStream, RecordingStreamError, Scalars,
    TimeColumn,
};

use crate::{SIM_TIME, TICK, WALL_TIME, frame::RecordedFrame, recorder::path};

/// A moment on the three timelines.
#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct Moment {
    pub tick: u64,
    /// Simulated time, s.
    pub time: f64,
    /// Wall time, s since the epoch.
    pub wall: f64,
}

impl Moment {
    pub fn of(frame: &RecordedFrame) -> Self {
        Self { tick: frame.tick, time: frame.time, wall: frame.wall }
    }

    /// Returns the moment that is `seconds` earlier in the same tick.
    pub fn before(self, seconds: f64) -> Self {
        Self { time: self.time - seconds, wall: self.wall - seconds, ..self }
    }
}

/// Moments that wait to be sent, as three columns.
#[derive(Debug, Default)]
struct Moments(Vec<Moment>);

impl Moments {
    fn take(&mut self) -> [TimeColumn; 3] {
        let ticks = self.0.iter().map(|at| i64::try_from(at.tick).unwrap_or(i64::MAX));
        let columns = [
            TimeColumn::new_sequence(TICK, ticks),
            TimeColumn::new_duration_secs(SIM_TIME, self.0.iter().map(|at| at.time)),
            TimeColumn::new_timestamp_secs_since_epoch(WALL_TIME, self.0.iter().map(|at| at.wall)),
        ];
        self.0.clear();
        columns
    }
}

/// One line of a plot.
#[derive(Debug)]
struct ColumnSeries {
    entity: EntityPath,
    moments: Moments,
    values: Vec<f64>,
}

/// The metrics that wait to be sent.
#[derive(Debug, Default)]
pub(crate) struct Columns {
    series: HashMap<String, ColumnSeries>,
    waiting: usize,
}

impl Columns {
    /// Number of waiting values at which they are sent, regardless of the time.
    const MAX: usize = 1 << 14;

    pub fn push(&mut self, name: &str, at: Moment, value: f64) {
        if !self.series.contains_key(name) {
            let series = ColumnSeries { entity: path(name), moments: Moments::default(), values: Vec::new() };
            self.series.insert(name.to_owned(), series);
        }
        if let Some(series) = self.series.get_mut(name) {
            series.moments.0.push(at);
            series.values.push(value);
            self.waiting += 1;
        }
    }

    /// Whether the values should be sent now.
    pub fn is_full(&self) -> bool {
        self.waiting >= Self::MAX
    }

    pub fn send(&mut self, stream: &RecordingStream) -> Result<(), RecordingStreamError> {
        self.waiting = 0;
        let mut result = Ok(());
        for series in self.series.values_mut().filter(|series| !series.values.is_empty()) {
            let times = series.moments.take();
            let columns = Scalars::new(series.values.drain(..)).columns_of_unit_batches();
            let sent = columns
                .map_err(RecordingStreamError::from)
                .and_then(|columns| stream.send_columns(series.entity.clone(), times, columns));
            // A series that cannot be sent does not hold up the others.
            result = result.and(sent);
        }
        result
    }
}

/// The hands of several ticks.
#[derive(Debug, Default)]
pub(crate) struct HandColumns {
    moments: Moments,
    /// Number of hands of each tick.
    counts: Vec<usize>,
    arrows: Vec<[f32; 3]>,
    points: Vec<[f32; 3]>,
    targets: Vec<[f32; 3]>,
    labels: Vec<String>,
    colors: Vec<Color>,
}

impl HandColumns {
    /// Begins a tick, to which the following hands belong.
    pub fn begin(&mut self, at: Moment) {
        self.moments.0.push(at);
        self.counts.push(0);
    }

    pub fn push(&mut self, arrow: [f32; 3], point: [f32; 3], target: [f32; 3], label: String, color: Color) {
        let Some(count) = self.counts.last_mut() else { return };
        *count += 1;
        self.arrows.push(arrow);
        self.points.push(point);
        self.targets.push(target);
        self.labels.push(label);
        self.colors.push(color);
    }

    pub fn send(&mut self, stream: &RecordingStream) -> Result<(), RecordingStreamError> {
        if self.counts.is_empty() {
            return Ok(());
        }
        let counts = std::mem::take(&mut self.counts);
        let lengths = || counts.iter().copied();
        let times = self.moments.take();
        let lines = self.points.iter().zip(&self.targets).map(|(&from, &to)| [from, to]);
        let lines = LineStrips3D::new(lines).with_colors(self.colors.iter().copied()).columns(lengths())?;
        stream.send_columns("world/hands/lines", times.clone(), lines)?;
        let targets = Points3D::new(self.targets.drain(..)).with_colors(self.colors.iter().copied());
        stream.send_columns("world/hands/targets", times.clone(), targets.columns(lengths())?)?;
        let arrows = Arrows3D::from_vectors(self.arrows.drain(..))
            .with_origins(self.points.drain(..))
            .with_labels(self.labels.drain(..))
            .with_colors(self.colors.drain(..));
        stream.send_columns("world/hands/reactions", times, arrows.columns(lengths())?)
    }
}
