//! The layout in a recording: the scene on the left with the mode bars and the log below it, plots
//! on the right.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use rerun::{
    DynamicArchetype, EntityPath, EntityPathPart, RecordingStreamBuilder, TimePoint, Timeline,
    blueprint::{
        BarChartView, Blueprint, BlueprintActivation, BlueprintPanel, ContainerLike, Horizontal,
        SelectionPanel, Spatial3DView, Tabs, TextLogView, TimePanel, TimeSeriesView, Vertical,
        components::{Corner2D, PanelState, PlayState},
    },
    components::Visible,
    log::{Chunk, LogMsg},
};

use crate::recorder::path;

/// Maximum number of places for plots. Further plots share the last place, as tabs.
const MAX_CELLS: usize = 8;

/// Maximum number of bodies whose bars have a tab. The bars of other bodies can be opened manually.
const MAX_TABS: usize = 12;

/// Areas about how the program runs, as opposed to bodies, hands and the network. They share one
/// place, in tabs.
const HOUSEKEEPING: [&str; 4] = ["time", "step", "frame", "bodies"];

/// Areas whose plots come first. Areas that are named neither here nor in `LAST`, such as a game's
/// own areas, come between them.
const FIRST: [&str; 2] = ["reaction", "displacement"];
const LAST: [&str; 5] = ["energy", "stress", "device", "net", "time"];

/// Units whose tabs come first within an area.
const UNITS: [&str; 4] = ["ms", "N", "%", "kbit/s"];

/// One plot: metrics with the same first part of their path and the same unit.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Plot {
    pub title: String,
    pub area: String,
    pub contents: Vec<String>,
    /// Number of lines in the plot.
    pub lines: usize,
}

/// The plots of a recording. Metrics with the same first part of their path and the same unit share
/// an axis.
#[derive(Debug, Clone, Default)]
pub(crate) struct Plots {
    titles: BTreeMap<String, String>,
    /// Noted paths by area and unit.
    seen: BTreeMap<(String, String), BTreeSet<String>>,
    /// The unit of each noted path.
    known: HashMap<String, String>,
    /// Bar charts: names by area.
    bars: BTreeMap<&'static str, BTreeSet<String>>,
    changed: bool,
    log: bool,
}

impl Plots {
    /// Makes an empty layout. `titles` maps the first part of a metric's path to the title of its
    /// plot.
    pub fn new(titles: impl IntoIterator<Item = (String, String)>) -> Self {
        Self { titles: titles.into_iter().collect(), ..Self::default() }
    }

    /// Notes a metric. Returns `true` if it is new.
    pub fn note(&mut self, path: &str, unit: &str) -> bool {
        // This runs for every metric of every tick, so a known metric returns early.
        if self.known.get(path).is_some_and(|known| known == unit) {
            return false;
        }
        self.known.insert(path.to_owned(), unit.to_owned());
        let key = (area(path).to_owned(), unit.trim().to_owned());
        let new = self.seen.entry(key).or_default().insert(path.to_owned());
        self.changed |= new;
        new
    }

    /// Notes a bar chart `area/name`.
    pub fn note_bars(&mut self, area: &'static str, name: &str) {
        let names = self.bars.entry(area).or_default();
        if !names.contains(name) {
            self.changed |= names.insert(name.to_owned());
        }
    }

    /// Notes that there are log lines.
    pub fn note_log(&mut self) {
        self.changed |= !self.log;
        self.log = true;
    }

    /// Whether the layout has changed since the last call.
    pub fn take_changed(&mut self) -> bool {
        std::mem::take(&mut self.changed)
    }

    /// Returns the plots of each place, in order. The plots of one area share a place.
    pub fn cells(&self) -> Vec<Vec<Plot>> {
        let mut cells: BTreeMap<(usize, &str), Vec<(usize, Plot)>> = BTreeMap::new();
        for ((area, unit), paths) in &self.seen {
            let title = self.titles.get(area).map_or_else(|| capital(area), Clone::clone);
            let title = if unit.is_empty() { title } else { format!("{title} ({unit})") };
            let alone = self.seen.keys().filter(|(other, _)| other == area).count() == 1;
            let contents = if alone {
                // With this pattern, later metrics of the area appear in the plot by themselves.
                vec![format!("{}/**", path(area))]
            } else {
                paths.iter().map(|p| path(p).to_string()).collect()
            };
            let cell = if HOUSEKEEPING.contains(&area.as_str()) { HOUSEKEEPING[0] } else { area };
            let place = match FIRST.iter().position(|first| *first == cell) {
                Some(place) => place,
                None => LAST.iter().position(|last| *last == cell).map_or(FIRST.len(), |p| 10 + p),
            };
            let front = HOUSEKEEPING.iter().position(|other| other == area).unwrap_or(0) * (UNITS.len() + 1);
            let front = front + UNITS.iter().position(|other| other == unit).unwrap_or(UNITS.len());
            let plot = Plot { title, area: area.clone(), contents, lines: paths.len() };
            cells.entry((place, cell)).or_default().push((front, plot));
        }
        let cells = cells.into_values().map(|mut plots| {
            plots.sort_by_key(|(front, _)| *front);
            plots.into_iter().map(|(_, plot)| plot).collect()
        });
        let mut cells: Vec<Vec<Plot>> = cells.collect();
        let beyond: Vec<Plot> = cells.drain(MAX_CELLS.min(cells.len())..).flatten().collect();
        if let Some(last) = cells.last_mut() {
            last.extend(beyond);
        }
        cells
    }

    /// Returns the bar charts of an area: a single chart, or a tab for each body.
    fn bar_views(&self, area: &str, title: &str) -> Option<ContainerLike> {
        let names = self.bars.get(area)?;
        let view = |title: String, name: &str| {
            let entity = EntityPath::from(vec![EntityPathPart::new(area), EntityPathPart::new(name)]);
            BarChartView::new(title).with_origin(entity.clone()).with_contents([entity.to_string()])
        };
        if names.len() == 1 {
            return names.first().map(|name| view(title.to_owned(), name).into());
        }
        let tabs = names.iter().take(MAX_TABS).map(|name| view(format!("{title}: {name}"), name).into());
        Some(Tabs::new(tabs).into())
    }

    /// Sends the layout with the recording.
    pub fn send(&self, recording: &rerun::RecordingStream) -> Result<(), rerun::RecordingStreamError> {
        let scene = Spatial3DView::new("Scene").with_origin(EntityPath::from("world"));
        let view = |plot: &Plot| -> ContainerLike {
            TimeSeriesView::new(plot.title.as_str())
                .with_origin(path(&plot.area))
                .with_contents(plot.contents.iter().cloned())
                .into()
        };
        let cells = self.cells();
        let single: BTreeSet<&str> =
            cells.iter().flatten().filter(|plot| plot.lines == 1).map(|plot| plot.title.as_str()).collect();
        let plots: Vec<ContainerLike> = cells
            .iter()
            .map(|plots| match plots.as_slice() {
                [plot] => view(plot),
                plots => Tabs::new(plots.iter().map(view).collect::<Vec<_>>()).into(),
            })
            .collect();
        // Bars and text need the width, so they are below the scene.
        let bars = [("modes", "Energy of each mode (J)"), ("spectrum", "Spectrum (m over Hz)")];
        let bars: Vec<_> = bars.iter().filter_map(|(area, title)| self.bar_views(area, title)).collect();
        let (mut left, mut shares): (Vec<ContainerLike>, Vec<f32>) = (vec![scene.into()], vec![4.0]);
        if !bars.is_empty() {
            left.push(Horizontal::new(bars).into());
            shares.push(1.5);
        }
        if self.log {
            left.push(TextLogView::new("Log").with_origin(path("log")).into());
            shares.push(1.0);
        }
        let left = Vertical::new(left).with_row_shares(shares);
        let root: ContainerLike = match plots.len() {
            0 => Horizontal::new([left.into()]).into(),
            1..=3 => Horizontal::new([left.into(), Vertical::new(plots).into()])
                .with_column_shares([3.0, 2.0])
                .into(),
            // Plots stand in pairs, and a remaining plot has its own row. A grid would leave a hole
            // beside it.
            count => {
                let rows = count.div_ceil(2);
                let mut plots = plots.into_iter();
                let pairs = (0..rows).map(|_| Horizontal::new(plots.by_ref().take(2)).into());
                let plots = Vertical::new(pairs.collect::<Vec<ContainerLike>>());
                Horizontal::new([left.into(), plots.into()]).with_column_shares([1.0, 1.15]).into()
            }
        };
        let blueprint = Blueprint::new(root)
            .with_auto_views(false)
            .with_auto_layout(false)
            .with_blueprint_panel(BlueprintPanel::from_state(PanelState::Collapsed))
            .with_selection_panel(SelectionPanel::from_state(PanelState::Collapsed))
            .with_time_panel(
                // The time panel follows the newest data: a live viewer stays current, and a file
                // opens on a complete scene.
                TimePanel::new()
                    .with_state(PanelState::Collapsed)
                    .with_timeline(crate::SIM_TIME)
                    .with_play_state(PlayState::Following),
            );
        // The blueprint passes through a memory stream, because the SDK's own blueprints have no
        // legends.
        let application = recording.store_info().map(|info| info.application_id().clone());
        let Some(application) = application else { return Ok(()) };
        let (stream, memory) = RecordingStreamBuilder::new(application).memory()?;
        blueprint.send(&stream, BlueprintActivation::default())?;
        stream.flush_blocking().ok();
        let mut messages = Vec::new();
        let mut activation = None;
        for message in memory.take() {
            match message {
                LogMsg::BlueprintActivationCommand(command) => activation = Some(command),
                message if message.store_id().is_blueprint() => messages.push(message),
                _ => {}
            }
        }
        let legends: Vec<LogMsg> = messages.iter().filter_map(|message| legend(message, &single)).collect();
        messages.extend(legends);
        if let Some(activation) = activation {
            recording.send_blueprint(messages, activation);
        }
        Ok(())
    }
}

/// Returns the legend of the plot that this blueprint message describes, if it describes a plot.
///
/// A plot with a single line has no visible legend, because its title names the line. In other
/// plots the legend is where lines begin, not where they continue.
fn legend(message: &LogMsg, single: &BTreeSet<&str>) -> Option<LogMsg> {
    let LogMsg::ArrowMsg(store, data) = message else { return None };
    let chunk = Chunk::from_arrow_msg(data).ok()?;
    let text = |name: &str| {
        let column =
            chunk.components().values().find(|column| column.descriptor.to_string().ends_with(name))?;
        let array = column.list_array.values();
        let array = array.as_any().downcast_ref::<rerun::external::arrow::array::StringArray>()?;
        array.iter().flatten().next().map(str::to_owned)
    };
    if text("class_identifier")? != "TimeSeries" {
        return None;
    }
    let title = text("display_name")?;
    // The SDK does not export the type of this archetype.
    let legend = DynamicArchetype::new("rerun.blueprint.archetypes.PlotLegend")
        .with_component::<Corner2D>("corner", [Corner2D::LeftTop])
        .with_component::<Visible>("visible", [!single.contains(&*title)]);
    let entity = chunk.entity_path().join(&EntityPath::from("PlotLegend"));
    let now = TimePoint::default().with(Timeline::new_sequence("blueprint"), 0);
    let legend = Chunk::builder(entity).with_archetype_auto_row(now, &legend).build().ok()?;
    Some(LogMsg::ArrowMsg(store.clone(), legend.to_arrow_msg().ok()?))
}

fn area(path: &str) -> &str {
    path.split('/').find(|part| !part.is_empty()).unwrap_or("metrics")
}

fn capital(word: &str) -> String {
    let mut letters = word.replace('_', " ").chars().collect::<Vec<_>>();
    if let Some(first) = letters.first_mut() {
        *first = first.to_ascii_uppercase();
    }
    letters.into_iter().collect()
}
