//! The layout that ships with a recording: the scene on the left with the modes' bars and the log under it, plots on the right.

use std::collections::{BTreeMap, BTreeSet};

use rerun::{
    EntityPath, EntityPathPart,
    blueprint::{
        BarChartView, Blueprint, BlueprintActivation, BlueprintPanel, ContainerLike, Horizontal,
        SelectionPanel, Spatial3DView, Tabs, TextLogView, TimePanel, TimeSeriesView, Vertical,
        components::{PanelState, PlayState},
    },
};

use crate::recorder::path;

/// Plots that have a place of their own; beyond, those of the machinery share one.
const MOST_PLOTS: usize = 8;

/// Bodies whose bars have a tab; the others' are there to be opened by hand.
const MOST_TABS: usize = 12;

/// Whether figures are about how the program runs and not about bodies, hands and what the network does to them.
fn is_housekeeping(area: &str, unit: &str) -> bool {
    area == "time" || (area == "net" && matches!(unit, "" | "/s"))
}

/// The plots of a recording: figures with one first part of their path and one unit share an axis.
#[derive(Debug, Clone, Default)]
pub(crate) struct Plots {
    titles: BTreeMap<String, String>,
    /// Area, unit, paths.
    seen: BTreeMap<(String, String), BTreeSet<String>>,
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

    fn view(&self, area: &str, unit: &str, paths: &BTreeSet<String>) -> TimeSeriesView {
        let title = self.titles.get(area).map_or_else(|| capital(area), Clone::clone);
        let title = if unit.is_empty() { title } else { format!("{title} ({unit})") };
        let view = TimeSeriesView::new(title).with_origin(path(area));
        let alone = self.seen.keys().filter(|(other, _)| other == area).count() == 1;
        if alone {
            // Figures that are yet to come find their place by themselves.
            view.with_contents([format!("{}/**", path(area))])
        } else {
            view.with_contents(paths.iter().map(|p| path(p).to_string()))
        }
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
        let of = |housekeeping: bool| -> Vec<ContainerLike> {
            let plots =
                self.seen.iter().filter(|((area, unit), _)| is_housekeeping(area, unit) == housekeeping);
            plots.map(|((area, unit), paths)| self.view(area, unit, paths).into()).collect()
        };
        let (mut plots, mut others) = (of(false), of(true));
        if plots.len() + others.len() <= MOST_PLOTS {
            plots.append(&mut others);
        }
        // Bars and text want the width: they go under the scene.
        let bars = [("modes", "Energy of each mode (J)"), ("spectrum", "Spectrum (m over Hz)")];
        let bars: Vec<_> = bars.iter().filter_map(|(area, title)| self.bar_views(area, title)).collect();
        let (mut left, mut shares): (Vec<ContainerLike>, Vec<f32>) = (vec![scene.into()], vec![4.0]);
        if !bars.is_empty() {
            left.push(Horizontal::new(bars).into());
            shares.push(1.6);
        }
        if self.log {
            left.push(TextLogView::new("Log").with_origin(path("log")).into());
            shares.push(1.2);
        }
        let left = Vertical::new(left).with_row_shares(shares);
        // What tells of the machinery and not of the bodies shares one place, in tabs.
        if !others.is_empty() {
            plots.push(Tabs::new(others).with_name("More").into());
        }
        let root: ContainerLike = match plots.len() {
            0 => Horizontal::new([left.into()]).into(),
            1..=4 => Horizontal::new([left.into(), Vertical::new(plots).into()])
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
        Blueprint::new(root)
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
            )
            .send(recording, BlueprintActivation::default())
    }
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
