//! Figures and lines of text from anybody.

use std::{borrow::Cow, sync::Arc};

use bevy::prelude::*;

use crate::frame::{Line, Metric, Samples, Scalar};

/// Figures to be plotted over time, and lines for the log. Written by whoever has them, taken by [`RerunPlugin`](crate::RerunPlugin) every
/// tick for which figures are due ([`RerunRecording::metrics_hz`](crate::RerunRecording::metrics_hz)); while they are off, or nothing is recorded, what is
/// set is forgotten. Systems of a crate that should work without the plugin ask for `Option<ResMut<RerunScalars>>`.
///
/// ```
/// # use bevy::prelude::*;
/// # use pliant_rerun::RerunScalars;
/// fn report(mut figures: ResMut<RerunScalars>) {
///     figures.set("error/shown", "%", 0.4);
/// }
/// ```
///
/// The first part of the path names the plot: figures with the same first part and the same unit share one.
#[derive(Resource, Debug, Default)]
pub struct RerunScalars {
    pub(crate) scalars: Vec<Scalar>,
    pub(crate) lines: Vec<Line>,
    /// Figures whose names are kept by those who set them.
    pub(crate) measured: Vec<(Arc<Metric>, f64)>,
    /// Of the devices' own loops.
    pub(crate) samples: Vec<Samples>,
}

impl RerunScalars {
    /// Most entries that are kept when nobody takes them.
    const LIMIT: usize = 4096;

    /// Plots `value` (in `unit`, which may be empty) at this tick as `path`, parts divided by `/`. Of several values for one path in a tick the
    /// last one counts; one that is not finite leaves a gap.
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

    /// Writes a line into the recording's log.
    pub fn say(&mut self, text: impl Into<String>) {
        self.line(false, text.into());
    }

    /// Writes a warning into the recording's log.
    pub fn warn(&mut self, text: impl Into<String>) {
        self.line(true, text.into());
    }

    #[cfg(feature = "haptics")]
    pub(crate) fn measured(&mut self, figure: &Arc<Metric>, value: f64) {
        if self.measured.len() < Self::LIMIT {
            self.measured.push((figure.clone(), value));
        }
    }

    /// Forgets figures that nobody took at their time.
    pub(crate) fn forget_metrics(&mut self) {
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
