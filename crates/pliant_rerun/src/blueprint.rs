//! The layout that ships with a recording: the scene on the left with the modes' bars and the log under it, plots on the right.

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

/// Plots that have a place of their own; those beyond share the last one, as tabs.
const MOST_CELLS: usize = 8;

/// Bodies whose bars have a tab; the others' are there to be opened by hand.
const MOST_TABS: usize = 12;

/// How the program runs, not what bodies, hands and the network do: one place, in tabs.
const HOUSEKEEPING: [&str; 3] = ["time", "frame", "bodies"];

/// What is looked at first comes first; areas that are not named here, a game's own, are where the gap is.
const FIRST: [&str; 2] = ["reaction", "displacement"];
const LAST: [&str; 5] = ["energy", "stress", "device", "net", "time"];

/// Of the units of one area, those whose tab is in front.
const UNITS: [&str; 4] = ["ms", "N", "%", "kbit/s"];

/// One plot: figures with one first part of their path and one unit.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Plot {
    pub title: String,
    pub area: String,
    pub contents: Vec<String>,
    /// Lines in it.
    pub lines: usize,
}

/// The plots of a recording: figures with one first part of their path and one unit share an axis.
#[derive(Debug, Clone, Default)]
pub(crate) struct Plots {
    titles: BTreeMap<String, String>,
    /// Area, unit, paths.
    seen: BTreeMap<(String, String), BTreeSet<String>>,
    /// The unit of each path that was noted.
    known: HashMap<String, String>,
    /// Bar charts: area, names.
    bars: BTreeMap<&'static str, BTreeSet<String>>,
    changed: bool,
    log: bool,
}

impl Plots {
    /// `titles`: names of plots for the first part of a figure's path, where that is not a good one itself.
    pub fn new(titles: impl IntoIterator<Item = (String, String)>) -> Self {
        Self { titles: titles.into_iter().collect(), ..Self::default() }
    }

    /// Notes a figure; `true` when it is a new one.
    pub fn note(&mut self, path: &str, unit: &str) -> bool {
        // Asked for every figure of every tick.
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

    /// Notes that there are lines of text.
    pub fn note_log(&mut self) {
        self.changed |= !self.log;
        self.log = true;
    }

    /// Whether the layout is another one since this was last asked.
    pub fn take_changed(&mut self) -> bool {
        std::mem::take(&mut self.changed)
    }

    /// The plots of each place, in the order of the places: those of one area share one.
    pub fn cells(&self) -> Vec<Vec<Plot>> {
        let mut cells: BTreeMap<(usize, &str), Vec<(usize, Plot)>> = BTreeMap::new();
        for ((area, unit), paths) in &self.seen {
            let title = self.titles.get(area).map_or_else(|| capital(area), Clone::clone);
            let title = if unit.is_empty() { title } else { format!("{title} ({unit})") };
            let alone = self.seen.keys().filter(|(other, _)| other == area).count() == 1;
            let contents = if alone {
                // Figures that are yet to come find their place by themselves.
                vec![format!("{}/**", path(area))]
            } else {
                paths.iter().map(|p| path(p).to_string()).collect()
            };
            let cell = if HOUSEKEEPING.contains(&area.as_str()) { HOUSEKEEPING[0] } else { area };
            let place = match FIRST.iter().position(|first| *first == cell) {
                Some(place) => place,
                None => LAST.iter().position(|last| *last == cell).map_or(FIRST.len(), |p| 10 + p),
            };
            let front = HOUSEKEEPING.iter().position(|other| other == area).unwrap_or(0) * UNITS.len();
            let front = front + UNITS.iter().position(|other| other == unit).unwrap_or(UNITS.len());
            let plot = Plot { title, area: area.clone(), contents, lines: paths.len() };
            cells.entry((place, cell)).or_default().push((front, plot));
        }
        let cells = cells.into_values().map(|mut plots| {
            plots.sort_by_key(|(front, _)| *front);
            plots.into_iter().map(|(_, plot)| plot).collect()
        });
        let mut cells: Vec<Vec<Plot>> = cells.collect();
        let beyond: Vec<Plot> = cells.drain(MOST_CELLS.min(cells.len())..).flatten().collect();
        if let Some(last) = cells.last_mut() {
            last.extend(beyond);
        }
        cells
    }

    /// The bar charts of an area: one, or a tab for each body.
    fn bar_views(&self, area: &str, title: &str) -> Option<ContainerLike> {
        let names = self.bars.get(area)?;
        let view = |title: String, name: &str| {
            let entity = EntityPath::from(vec![EntityPathPart::new(area), EntityPathPart::new(name)]);
            BarChartView::new(title).with_origin(entity.clone()).with_contents([entity.to_string()])
        };
        if names.len() == 1 {
            return names.first().map(|name| view(title.to_owned(), name).into());
        }
        let tabs = names.iter().take(MOST_TABS).map(|name| view(format!("{title}: {name}"), name).into());
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
        // Bars and text want the width: they go under the scene.
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
            // In pairs, and one that is left over has a row of its own: a grid would leave a hole beside it.
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
                // At the newest: a live viewer keeps up, and a file opens on a scene that is all there.
                TimePanel::new()
                    .with_state(PanelState::Collapsed)
                    .with_timeline(crate::SIM_TIME)
                    .with_play_state(PlayState::Following),
            );
        // By way of a memory, as the SDK's own blueprints have no legends.
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

/// The legend of the plot that this message of a blueprint is about, if it is one: none where there is one line only, whose name the title
/// tells, and else where lines begin and not where they go on.
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
    // The SDK does not export this archetype by its type.
    let legend = DynamicArchetype::new("rerun.blueprint.archetypes.PlotLegend")
        .with_component::<Corner2D>("corner", [Corner2D::LeftTop])
        .with_component::<Visible>("visible", [!single.contains(&*title)]);
    let entity = chunk.entity_path().join(&EntityPath::from("PlotLegend"));
    let now = TimePoint::default().with(Timeline::new_sequence("blueprint"), 0);
    let legend = Chunk::builder(entity).with_archetype_auto_row(now, &legend).build().ok()?;
    Some(LogMsg::ArrowMsg(store.clone(), legend.to_arrow_msg().ok()?))
}

fn area(path: &str) -> &str {
    path.split('/').find(|part| !part.is_empty()).unwrap_or("figures")
}

fn capital(word: &str) -> String {
    let mut letters = word.replace('_', " ").chars().collect::<Vec<_>>();
    if let Some(first) = letters.first_mut() {
        *first = first.to_ascii_uppercase();
    }
    letters.into_iter().collect()
}
