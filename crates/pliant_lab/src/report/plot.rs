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
    /// A broad gray line that others may cover, for what is true.
    pub(super) broad: bool,
}

impl Series {
    /// A series without percentiles.
    pub(super) fn new(name: impl Into<String>, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points, late: Vec::new(), scattered: false, broad: false }
    }

    /// A series of points (median and 99th percentile of a time, error).
    pub(super) fn timed(name: impl Into<String>, points: Vec<([f64; 2], f64)>) -> Self {
        Self {
            name: name.into(),
            points: points.iter().map(|(x, y)| (x[0], *y)).collect(),
            late: points.iter().map(|(x, _)| x[1]).collect(),
            scattered: false,
            broad: false,
        }
    }

    pub(super) fn scattered(self) -> Self {
        Self { scattered: true, ..self }
    }

    pub(super) fn broad(self) -> Self {
        Self { broad: true, ..self }
    }
}

/// The axes of a figure.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Axes {
    /// Lines over linear axes.
    Linear,
    /// Marked points over logarithmic axes.
    Logarithmic,
    /// Marked points; only y is logarithmic, as x has a zero.
    LogarithmicError,
}

/// A figure: points with cost along x and error along y, or curves over time.
pub(super) struct Figure {
    /// File name without extension.
    pub(super) file: String,
    pub(super) title: String,
    pub(super) x: String,
    pub(super) y: String,
    pub(super) axes: Axes,
    pub(super) series: Vec<Series>,
    /// Error of the reference itself, in the unit of y.
    pub(super) reference_error: Option<f64>,
    /// The text below the figure.
    pub(super) words: String,
    /// Small plots below this one, in the same picture: one for each line, with a scale of its own,
    /// so that none hides another. They have a CSV file of their own, and no text.
    pub(super) below: Option<Box<Figure>>,
}

impl Figure {
    /// Names of the files that [`write`] makes.
    pub(super) fn files(&self) -> Vec<String> {
        let mut files: Vec<String> =
            ["csv", "svg", "png"].map(|extension| format!("{}.{extension}", self.file)).into();
        files.extend(self.below.iter().map(|below| format!("{}.csv", below.file)));
        files
    }

    /// Links to the figure's CSV files.
    pub(super) fn data(&self) -> String {
        let below = self.below.iter().map(|below| format!(", [data of the small plots]({}.csv)", below.file));
        format!("[data]({}.csv){}", self.file, below.collect::<String>())
    }
}

/// Width of a picture, and height of its main plot.
const SIZE: (u32, u32) = (860, 480);
/// Height of the title above the small plots, of each small plot, and of the ticks below the last.
const SMALL_TITLE: u32 = 30;
const SMALL: u32 = 84;
const SMALL_TICKS: u32 = 44;
/// Height of a row of the legend, which is below all plots, and the number of its columns.
const ROW: u32 = 20;
const COLUMNS: u32 = 2;

fn color(index: usize) -> RGBColor {
    const COLORS: [RGBColor; 11] = [
        RGBColor(27, 158, 119),
        RGBColor(217, 95, 2),
        RGBColor(117, 112, 179),
        RGBColor(231, 41, 138),
        RGBColor(102, 166, 30),
        RGBColor(166, 118, 29),
        RGBColor(31, 120, 180),
        RGBColor(90, 90, 90),
        RGBColor(0, 0, 0),
        RGBColor(227, 26, 28),
        RGBColor(230, 171, 2),
    ];
    COLORS[index % COLORS.len()]
}

/// Writes the figure as CSV, SVG and PNG into a folder.
pub(super) fn write(folder: &Path, figure: &Figure) -> Result<(), LabError> {
    static FONT: OnceLock<bool> = OnceLock::new();
    FONT.get_or_init(|| {
        register_font("sans-serif", FontStyle::Normal, epaint_default_fonts::UBUNTU_LIGHT).is_ok()
    });
    for figure in std::iter::once(figure).chain(figure.below.as_deref()) {
        write_csv(folder, figure)?;
    }
    let svg = folder.join(format!("{}.svg", figure.file));
    let size = (SIZE.0, SIZE.1 + smalls_height(figure) + legend_height(figure));
    draw_all(&SVGBackend::new(&svg, size).into_drawing_area(), figure)
        .map_err(|_| LabError::Plot(svg.clone()))?;
    let png = folder.join(format!("{}.png", figure.file));
    draw_all(&BitMapBackend::new(&png, size).into_drawing_area(), figure)
        .map_err(|_| LabError::Plot(png.clone()))
}

/// Height of the small plots together.
fn smalls_height(figure: &Figure) -> u32 {
    let smalls = figure.below.as_ref().map_or(0, |below| below.series.len() as u32);
    if smalls == 0 { 0 } else { SMALL_TITLE + smalls * SMALL + SMALL_TICKS }
}

fn legend_height(figure: &Figure) -> u32 {
    let entries = figure.series.len() as u32 + u32::from(reference(figure).is_some());
    (entries.div_ceil(COLUMNS) + 1) * ROW
}

/// The error of the reference, where it is drawn. One far below all points would squeeze the plot,
/// so that only the text states it.
fn reference(figure: &Figure) -> Option<f64> {
    let all = figure.series.iter().flat_map(|s| &s.points);
    let least = all.map(|p| p.1).fold(f64::INFINITY, f64::min);
    figure.reference_error.filter(|error| *error > 0.1 * least)
}

fn write_csv(folder: &Path, figure: &Figure) -> Result<(), LabError> {
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
    Ok(std::fs::write(folder.join(format!("{}.csv", figure.file)), csv)?)
}

fn draw_all<B: DrawingBackend>(
    area: &DrawingArea<B, Shift>,
    figure: &Figure,
) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
    area.fill(&WHITE)?;
    let (plot, rest) = area.split_vertically(SIZE.1);
    let (smalls, legend) = rest.split_vertically(smalls_height(figure));
    draw(&plot, figure)?;
    if let Some(below) = &figure.below {
        draw_smalls(&smalls, figure, below)?;
    }
    draw_legend(&legend, figure)?;
    area.present()
}

/// The lines and their names.
fn draw_legend<B: DrawingBackend>(
    area: &DrawingArea<B, Shift>,
    figure: &Figure,
) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
    let marked = figure.axes != Axes::Linear;
    let names = figure.series.iter().enumerate().map(|(index, series)| {
        (series.name.as_str(), style(index, series), marked.then_some(index), !series.scattered)
    });
    let own = reference(figure).map(|_| ("the reference's own error", BLACK.stroke_width(1), None, true));
    for (entry, (name, style, mark, line)) in names.chain(own).enumerate() {
        let (row, column) = (entry as u32 / COLUMNS, entry as u32 % COLUMNS);
        let x = (84 + column * (SIZE.0 - 96) / COLUMNS) as i32;
        let y = (ROW / 2 + row * ROW) as i32;
        if line {
            area.draw(&PathElement::new(vec![(x, y), (x + 24, y)], style))?;
        }
        if let Some(index) = mark {
            let at = EmptyElement::at((x + 12, y));
            match index % 4 {
                0 => area.draw(&(at + Circle::new((0, 0), MARK, style.filled())))?,
                1 => area.draw(&(at + TriangleMarker::new((0, 0), MARK + 1, style.filled())))?,
                2 => area.draw(&(at + Cross::new((0, 0), MARK, style)))?,
                _ => area.draw(&(at + Rectangle::new(SQUARE, style.filled())))?,
            }
        }
        area.draw(&Text::new(name, (x + 32, y - 8), ("sans-serif", 14).into_font()))?;
    }
    Ok(())
}

/// Size of a mark, pixels.
const MARK: i32 = 4;
const SQUARE: [(i32, i32); 2] = [(-3, -3), (3, 3)];

/// How a line is drawn.
fn style(index: usize, series: &Series) -> ShapeStyle {
    if series.broad { RGBColor(205, 205, 205).stroke_width(8) } else { color(index).stroke_width(2) }
}

/// One small plot for each line of `below`, in the color that the line has in the figure.
fn draw_smalls<B: DrawingBackend>(
    area: &DrawingArea<B, Shift>,
    figure: &Figure,
    below: &Figure,
) -> Result<(), DrawingAreaErrorKind<B::ErrorType>> {
    let (title, mut rest) = area.split_vertically(SMALL_TITLE);
    title.draw(&Text::new(below.title.as_str(), (84, 8), ("sans-serif", 15).into_font()))?;
    let all = below.series.iter().flat_map(|s| &s.points);
    let xs = range(all.map(|p| p.0), false);
    for (number, series) in below.series.iter().enumerate() {
        let last = number + 1 == below.series.len();
        let (own, others) = rest.split_vertically(SMALL + if last { SMALL_TICKS } else { 0 });
        rest = others;
        let most = series.points.iter().map(|p| p.1.abs()).fold(0.0, f64::max);
        let reach = 1.1 * most.max(1e-6);
        let mut chart = ChartBuilder::on(&own)
            .caption(format!("{}: at most {}", series.name, label(most)), ("sans-serif", 13))
            .margin_left(12)
            .margin_right(12)
            .margin_top(2)
            .margin_bottom(4)
            .x_label_area_size(if last { SMALL_TICKS } else { 0 })
            .y_label_area_size(72)
            .build_cartesian_2d(xs.clone(), -reach..reach)?;
        chart
            .configure_mesh()
            .x_desc(if last { below.x.as_str() } else { "" })
            .light_line_style(TRANSPARENT)
            .y_labels(5)
            .x_label_formatter(&|v| label(*v))
            .y_label_formatter(&|v| label(*v))
            .label_style(("sans-serif", 13))
            .draw()?;
        let index = figure.series.iter().position(|s| s.name == series.name).unwrap_or(number);
        chart.draw_series(LineSeries::new(series.points.iter().copied(), color(index).stroke_width(1)))?;
    }
    Ok(())
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
    let marked = figure.axes != Axes::Linear;
    let (log_x, log_y) = (figure.axes == Axes::Logarithmic, marked);
    let all = || figure.series.iter().flat_map(|s| s.points.iter().copied());
    let late = || figure.series.iter().flat_map(|s| s.late.iter().copied());
    let xs = range(all().map(|p| p.0).chain(late()), log_x);
    let reference = reference(figure);
    let ys = range(all().map(|p| p.1).chain(reference), log_y);
    let mut chart = ChartBuilder::on(area);
    chart.caption(&figure.title, ("sans-serif", 20)).margin(12).x_label_area_size(44).y_label_area_size(72);
    // The coordinate systems are different types, so a macro draws all of them.
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
                let style = style(index, series);
                let points: Vec<(f64, f64)> = series
                    .points
                    .iter()
                    .copied()
                    .filter(|p| p.1.is_finite() && (!log_y || p.1 > 0.0) && (!log_x || p.0 > 0.0))
                    .map(|p| (p.0, p.1.clamp(ys.start, ys.end)))
                    .collect();
                let joined = if series.scattered { &points[..0] } else { &points[..] };
                // Every other line is dashed, so that it hides only parts of one below it.
                if marked && index % 2 == 1 {
                    let joined = joined.iter().copied();
                    chart.draw_series(DashedLineSeries::new(joined, 8, 6, style))?;
                } else {
                    chart.draw_series(LineSeries::new(joined.iter().copied(), style))?;
                }
                // Draw a whisker from the median to the 99th percentile.
                for (point, late) in series.points.iter().zip(&series.late) {
                    if point.1 > 0.0 {
                        let y = point.1.clamp(ys.start, ys.end);
                        let whisker = style.color.mix(0.5);
                        chart.draw_series(LineSeries::new([(point.0, y), (*late, y)], whisker))?;
                    }
                }
                if marked {
                    let (points, full) = (points.iter().copied(), style.filled());
                    match index % 4 {
                        0 => {
                            chart.draw_series(points.map(|p| Circle::new(p, MARK, full)))?;
                        }
                        1 => {
                            chart.draw_series(points.map(|p| TriangleMarker::new(p, MARK + 1, full)))?;
                        }
                        2 => {
                            chart.draw_series(points.map(|p| Cross::new(p, MARK, style)))?;
                        }
                        _ => {
                            let square = |p| EmptyElement::at(p) + Rectangle::new(SQUARE, full);
                            chart.draw_series(points.map(square))?;
                        }
                    }
                }
            }
            if let Some(error) = reference {
                let line = [(xs.start, error), (xs.end, error)];
                chart.draw_series(LineSeries::new(line, BLACK.stroke_width(1)))?;
            }
        }};
    }
    match figure.axes {
        Axes::Linear => body!(chart.build_cartesian_2d(xs.clone(), ys.clone())?),
        Axes::Logarithmic => {
            body!(chart.build_cartesian_2d(xs.clone().log_scale(), ys.clone().log_scale())?)
        }
        Axes::LogarithmicError => body!(chart.build_cartesian_2d(xs.clone(), ys.clone().log_scale())?),
    }
    Ok(())
}

fn label(v: f64) -> String {
    // What is left of a subtraction is the zero of its axis.
    if v.abs() < 1e-12 || (1e-2..1e4).contains(&v.abs()) {
        format!("{v:.4}").trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        format!("{v:.0e}")
    }
}
