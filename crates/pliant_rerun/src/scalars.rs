//! Metrics and log lines from any system.

use std::{borrow::Cow, sync::Arc};

use bevy::prelude::*;

use crate::frame::{Line, Metric, Samples, Scalar};

/// Metrics to plot over time, and lines for the log.
///
/// Any system may write them. [`RerunPlugin`](crate::RerunPlugin) takes them in every tick for
/// which metrics are due ([`RerunRecording::metrics_hz`](crate::RerunRecording::metrics_hz)). While
/// metrics are off or nothing is recorded, the values are dropped. Systems that should also work
/// without the plugin use `Option<ResMut<RerunScalars>>`.
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_rerun::RerunScalars;
/// fn report(mut figures: ResMut<RerunScalars>) {
///     figures.set("error/shown", "%", 0.4);
/// }
/// ```
///
/// The first part of the path selects the plot: metrics with the same first part and the same unit
/// share one plot.
#[derive(Resource, Debug, Default)]
pub struct RerunScalars {
    pub(crate) scalars: Vec<Scalar>,
    pub(crate) lines: Vec<Line>,
    /// Metrics whose names are stored by the systems that set them.
    pub(crate) measured: Vec<(Arc<Metric>, f64)>,
    /// Samples of the device loops.
    pub(crate) samples: Vec<Samples>,
    /// Number of times that metrics may have been lost. What is only set when it changes is then
    /// set again.
    pub(crate) lost: u64,
}

impl RerunScalars {
    /// Maximum number of entries that are kept until they are taken.
    const LIMIT: usize = 4096;

    /// Plots `value` at this tick as `path`, in `unit`, which may be empty.
    ///
    /// Parts of the path are separated by `/`. If a path gets several values in a tick, the last
    /// one counts. A value that is not finite leaves a gap.
    pub fn set(
        &mut self,
        path: impl Into<Cow<'static, str>>,
        unit: impl Into<Cow<'static, str>>,
        value: f64,
    ) {
        let path = path.into();
        if let Some(known) = self.scalars.iter_mut().find(|scalar| scalar.path == path) {
            known.value = value;
        } else if self.scalars.len() < Self::LIMIT {
            self.scalars.push(Scalar { path, unit: unit.into(), value });
        }
    }

    /// Writes a line to the recording's log.
    pub fn log(&mut self, text: impl Into<String>) {
        self.line(false, text.into());
    }

    /// Writes a warning to the recording's log.
    pub fn warn(&mut self, text: impl Into<String>) {
        self.line(true, text.into());
    }

    pub(crate) fn measured(&mut self, metric: &Arc<Metric>, value: f64) {
        if self.measured.len() < Self::LIMIT {
            self.measured.push((metric.clone(), value));
        }
    }

    /// Drops metrics that were not taken at their time.
    pub(crate) fn forget_metrics(&mut self) {
        self.lost += 1;
        self.scalars.clear();
        self.measured.clear();
        self.samples.clear();
    }

    fn line(&mut self, warning: bool, text: String) {
        if self.lines.len() < Self::LIMIT {
            self.lines.push(Line { warning, text });
        }
    }
}
