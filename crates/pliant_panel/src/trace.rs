//! The recent values of a metric, and their plot.

use std::collections::VecDeque;

use bevy_egui::egui::{self, Color32, Sense, TextStyle, Ui, Vec2};
use egui_plot::{Legend, Line, Plot, PlotPoints};

/// The values of a metric over the last seconds, with a maximum number of points.
///
/// The oldest points are dropped first.
#[derive(Debug, Clone)]
pub struct Trace {
    points: VecDeque<[f64; 2]>,
    span: f64,
    most: usize,
}

impl Trace {
    /// Makes an empty trace that keeps `span` seconds and at most `most` points.
    pub fn new(span: f64, most: usize) -> Self {
        Self { points: VecDeque::new(), span, most: most.max(2) }
    }

    /// Adds `value` at `time` (s).
    ///
    /// A time or a value that is not finite is ignored. A time before the last one clears the trace
    /// first.
    pub fn push(&mut self, time: f64, value: f64) {
        if !time.is_finite() || !value.is_finite() {
            return;
        }
        match self.points.back().map(|last| last[0]) {
            Some(last) if time < last => self.points.clear(),
            Some(last) if time == last => {
                self.points.pop_back();
            }
            _ => {}
        }
        self.points.push_back([time, value]);
        while self.points.len() > self.most
            || self.points.front().is_some_and(|first| first[0] < time - self.span)
        {
            self.points.pop_front();
        }
    }

    /// Returns the newest value.
    pub fn last(&self) -> Option<f64> {
        self.points.back().map(|point| point[1])
    }

    /// Returns the number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }
}

impl Default for Trace {
    /// Returns a trace of ten seconds and 600 points.
    fn default() -> Self {
        Self::new(10.0, 600)
    }
}

/// Draws a small plot of traces over time, with `unit` at the values. Draws nothing if there are no
/// points.
pub fn plot<'a>(
    ui: &mut Ui,
    id: &str,
    unit: &str,
    traces: impl IntoIterator<Item = (&'a str, &'a Trace, Color32)>,
) {
    let lines: Vec<(String, Vec<[f64; 2]>, Color32)> = traces
        .into_iter()
        .filter(|(_, trace, _)| !trace.is_empty())
        .map(|(name, trace, color)| (name.to_owned(), trace.points.iter().copied().collect(), color))
        .collect();
    let Some(newest) = lines.iter().filter_map(|line| line.1.last()).map(|p| p[0]).reduce(f64::max) else {
        return;
    };
    let unit = unit.to_owned();
    let mut plot = Plot::new(id.to_owned())
        .height(72.0)
        .show_x(false)
        .allow_drag(false)
        .allow_zoom(false)
        .allow_scroll(false)
        .allow_boxed_zoom(false)
        .include_y(0.0)
        .include_x(newest - 10.0)
        .include_x(newest)
        .show_axes([false, true])
        .y_axis_min_width(46.0)
        .y_axis_formatter(move |mark, _| format!("{} {unit}", short(mark.value)));
    if lines.len() > 1 {
        plot = plot.legend(Legend::default().position(egui_plot::Corner::LeftTop).background_alpha(0.4));
    }
    plot.show(ui, |plot| {
        for (name, points, color) in lines {
            plot.line(Line::new(name, PlotPoints::from(points)).color(color).width(1.5));
        }
    });
}

/// Formats a number with at most three significant digits.
pub(crate) fn short(value: f64) -> String {
    let size = value.abs();
    if size == 0.0 {
        "0".into()
    } else if !(1e-2..1e4).contains(&size) {
        format!("{value:.1e}")
    } else if size >= 100.0 {
        format!("{value:.0}")
    } else if size >= 10.0 {
        format!("{value:.1}")
    } else {
        format!("{value:.2}")
    }
}

/// Draws a dot in a color, because the font has no glyph for it.
pub(crate) fn dot(ui: &mut Ui, color: Color32) {
    let side = 0.7 * ui.text_style_height(&TextStyle::Body);
    let (place, _) = ui.allocate_exact_size(Vec2::splat(side), Sense::hover());
    ui.painter().circle_filled(place.center(), 0.45 * side, color);
}

/// Returns a color for the line number `index` of several lines.
pub(crate) fn color(index: usize) -> Color32 {
    // Hues a golden angle apart differ between neighbors, for any number of lines.
    let hue = (0.56 + 0.381_966 * index as f32).fract();
    egui::ecolor::Hsva::new(hue, 0.6, 0.95, 1.0).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trace_keeps_its_span_and_never_more_points_than_it_may() {
        let mut trace = Trace::new(2.0, 100);
        for i in 0..1000 {
            trace.push(f64::from(i) * 0.1, f64::from(i));
        }
        assert_eq!((trace.len(), trace.last()), (21, Some(999.0)));
        trace.push(f64::NAN, 1.0);
        trace.push(100.0, f64::INFINITY);
        assert_eq!(trace.last(), Some(999.0));
        for i in 0..1000 {
            trace.push(100.0 + f64::from(i) * 1e-4, 0.0);
        }
        assert_eq!(trace.len(), 100);
        trace.push(3.0, 7.0);
        assert_eq!((trace.len(), trace.last()), (1, Some(7.0)), "time went back: a new run");
    }

    #[test]
    fn numbers_are_short_whatever_their_size() {
        for (value, text) in [
            (0.0, "0"),
            (1234.5, "1234"),
            (12.345, "12.3"),
            (1.234, "1.23"),
            (-0.056, "-0.06"),
            (1e-5, "1.0e-5"),
            (3e7, "3.0e7"),
        ] {
            assert_eq!(short(value), text);
        }
    }
}
