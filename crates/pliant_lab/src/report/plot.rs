//! Figures as SVG, PNG and CSV. The font is compiled in, so none needs to be installed.

use std::{fmt::Write, path::Path, sync::OnceLock};

use plotters::{
    coord::Shift,
    prelude::*,
    style::{FontStyle, register_font},
};

use crate::LabError;

/// One line of a figure.
pub(super) struct Series {
    pub(super) name: String,
    pub(super) points: Vec<(f64, f64)>,
    /// If x is the median of a time: the 99th percentile of that time at each point.
    pub(super) late: Vec<f64>,
    /// Points without a line between them, for settings that are not steps of one parameter.
    pub(super) scattered: bool,
}

impl Series {
    /// A series without percentiles.
    pub(super) fn new(name: impl Into<String>, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points, late: Vec::new(), scattered: false }
    }

    /// A series of points (median and 99th percentile of a time, error).
    pub(super) fn timed(name: impl Into<String>, points: Vec<([f64; 2], f64)>) -> Self {
        Self {
            name: name.into(),
            points: points.iter().map(|(x, y)| (x[0], *y)).collect(),
            late: points.iter().map(|(x, _)| x[1]).collect(),
            scattered: false,
        }
    }

    pub(super) fn scattered(self) -> Self {
        Self { scattered: true, ..self }
    }
}

/// A figure: points with cost along x and error along y, or curves over time.
pub(super) struct Figure {
    /// File name without extension.
    pub(super) file: String,
    pub(super) title: String,
    pub(super) x: String,
    pub(super) y: String,
    /// Draw both axes logarithmic with marked points. Otherwise draw lines over linear axes.
    pub(super) logarithmic: bool,
    pub(super) series: Vec<Series>,
    /// Error of the reference itself, in the unit of y.
    pub(super) reference_error: Option<f64>,
    /// The text below the figure.
    pub(super) words: String,
}

const SIZE: (u32, u32) = (860, 520);

fn color(index: usize) -> RGBColor {
    const COLORS: [RGBColor; 9] = [
        RGBColor(27, 158, 119),
        RGBColor(217, 95, 2),
        RGBColor(117, 112, 179),
        RGBColor(231, 41, 138),
        RGBColor(102, 166, 30),
        RGBColor(166, 118, 29),
        RGBColor(31, 120, 180),
        RGBColor(90, 90, 90),
        RGBColor(0, 0, 0),
    ];
    COLORS[index % COLORS.len()]
}

/// Writes the figure as CSV, SVG and PNG into a folder.
pub(super) fn write(folder: &Path, figure: &Figure) -> Result<(), LabError> {
    static FONT: OnceLock<bool> = OnceLock::new();
    FONT.get_or_init(|| {
        register_font("sans-serif", FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT).is_ok()
    });
    let timed = figure.series.iter().any(|series| !series.late.is_empty());
    let late = if timed { ",99th percentile of x" } else { "" };
    let mut csv = format!("series,\"{}\",\"{}\",reference error{late}\n", figure.x, figure.y);
    let reference = figure.reference_error.map_or(String::new(), |e| format!("{e:.6e}"));
    for series in &figure.series {
        for (index, (x, y)) in series.points.iter().enumerate() {
            let late = series.late.get(index).map_or(String::new(), |late| format!(",{late:.4e}"));
            // Writing to a string cannot fail.
            let _ = writeln!(csv, "\"{}\",{x:.4e},{y:.3e},{reference}{late}", series.name);
        }
    }
    std::fs::write(folder.join(format!("{}.csv", figure.file)), csv)?;
    let svg = folder.join(format!("{}.svg", figure.file));
    draw(&SVGBackend::new(&svg, SIZE).into_drawing_area(), figure)
        .map_err(|_| LabError::Plot(svg.clone()))?;
    let png = folder.join(format!("{}.png", figure.file));
    draw(&BitMapBackend::new(&png, SIZE).into_drawing_area(), figure).map_err(|_| LabError::Plot(png.clone()))
}

fn range(values: impl Iterator<Item = f64>, logarithmic: bool) -> std::ops::Range<f64> {
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for v in values.filter(|v| v.is_finite() && (!logarithmic || *v > 0.0)) {
        (low, high) = (low.min(v), high.max(v));
    }
    if low > high {
        return 0.1..1.0;
    }
    if logarithmic {
        return low / 1.6..high * 1.6;
    }
    let margin = 0.05 * (high - low).max(1e-12);
    low - margin..high + margin
}

fn draw<B: DrawingBackend>(
    area: &DrawingArea<B, Shift>,
    figure: &Figure,
) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
    area.fill(&WHITE)?;
    let all = || figure.series.iter().flat_map(|s| s.points.iter().copied());
    let late = || figure.series.iter().flat_map(|s| s.late.iter().copied());
    let xs = range(all().map(|p| p.0).chain(late()), figure.logarithmic);
    // A reference error far below all points would squeeze the plot, so only the text states it.
    let least = all().map(|p| p.1).fold(f64::INFINITY, f64::min);
    let reference = figure.reference_error.filter(|error| *error > 0.1 * least);
    let ys = range(all().map(|p| p.1).chain(reference), figure.logarithmic);
    let mut chart = ChartBuilder::on(area);
    chart.caption(&figure.title, ("sans-serif", 20)).margin(12).x_label_area_size(44).y_label_area_size(72);
    // The two coordinate systems are different types, so a macro draws both.
    macro_rules! body {
        ($chart:expr) => {{
            let mut chart = $chart;
            chart
                .configure_mesh()
                .x_desc(&figure.x)
                .y_desc(&figure.y)
                .light_line_style(TRANSPARENT)
                .x_label_formatter(&|v| label(*v))
                .y_label_formatter(&|v| label(*v))
                .label_style(("sans-serif", 14))
                .draw()?;
            for (index, series) in figure.series.iter().enumerate() {
                let color = color(index);
                let points: Vec<(f64, f64)> = series
                    .points
                    .iter()
                    .copied()
                    .filter(|p| p.1.is_finite() && (!figure.logarithmic || (p.1 > 0.0 && p.0 > 0.0)))
                    .map(|p| (p.0, p.1.clamp(ys.start, ys.end)))
                    .collect();
                let joined = if series.scattered { &points[..0] } else { &points[..] };
                chart
                    .draw_series(LineSeries::new(joined.iter().copied(), color.stroke_width(2)))?
                    .label(&series.name)
                    .legend(move |(x, y)| PathElement::new(vec![(x, y), (x + 18, y)], color.stroke_width(2)));
                // Draw a whisker from the median to the 99th percentile.
                for (point, late) in series.points.iter().zip(&series.late) {
                    if point.1 > 0.0 {
                        let y = point.1.clamp(ys.start, ys.end);
                        chart.draw_series(LineSeries::new([(point.0, y), (*late, y)], color.mix(0.5)))?;
                    }
                }
                if figure.logarithmic {
                    chart.draw_series(points.iter().map(|p| Circle::new(*p, 3, color.filled())))?;
                }
            }
            if let Some(error) = reference {
                chart
                    .draw_series(LineSeries::new(
                        [(xs.start, error), (xs.end, error)],
                        BLACK.stroke_width(1),
                    ))?
                    .label("the reference's own error")
                    .legend(|(x, y)| PathElement::new(vec![(x, y), (x + 18, y)], BLACK.stroke_width(1)));
            }
            chart
                .configure_series_labels()
                .position(freest(all(), &xs, &ys, figure.logarithmic))
                .background_style(WHITE.mix(0.8))
                .border_style(RGBColor(200, 200, 200))
                .label_font(("sans-serif", 14))
                .draw()?;
        }};
    }
    if figure.logarithmic {
        body!(chart.build_cartesian_2d(xs.clone().log_scale(), ys.clone().log_scale())?);
    } else {
        body!(chart.build_cartesian_2d(xs.clone(), ys.clone())?);
    }
    area.present()
}

/// The corner with the fewest points, where the legend covers the least.
fn freest(
    points: impl Iterator<Item = (f64, f64)>,
    xs: &std::ops::Range<f64>,
    ys: &std::ops::Range<f64>,
    logarithmic: bool,
) -> SeriesLabelPosition {
    use SeriesLabelPosition::{LowerLeft, LowerRight, UpperLeft, UpperRight};
    let share = |v: f64, range: &std::ops::Range<f64>| {
        let at = |v: f64| if logarithmic { v.ln() } else { v };
        (at(v) - at(range.start)) / (at(range.end) - at(range.start))
    };
    let mut counts = [0usize; 4];
    for (x, y) in points {
        let (x, y) = (share(x, xs), share(y, ys));
        let corners = [(x > 0.5, y > 0.55), (x < 0.5, y > 0.55), (x < 0.5, y < 0.45), (x > 0.5, y < 0.45)];
        for (count, (beside, level)) in counts.iter_mut().zip(corners) {
            *count += usize::from(beside && level);
        }
    }
    let all = counts.into_iter().zip([UpperRight, UpperLeft, LowerLeft, LowerRight]);
    all.min_by_key(|(count, _)| *count).map_or(UpperRight, |(_, corner)| corner)
}

fn label(v: f64) -> String {
    // What is left of a subtraction is the zero of its axis.
    if v.abs() < 1e-12 || (1e-2..1e4).contains(&v.abs()) {
        format!("{v:.4}").trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        format!("{v:.0e}")
    }
}
