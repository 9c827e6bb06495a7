//! The layout that ships with a recording: the scene on the left, a plot for every kind of figure on the right.

use std::collections::{BTreeMap, BTreeSet};

use rerun::{
    EntityPath,
    blueprint::{
        Blueprint, BlueprintActivation, BlueprintPanel, ContainerLike, Grid, Horizontal, SelectionPanel,
        Spatial3DView, TextLogView, TimePanel, TimeSeriesView, Vertical,
        components::{PanelState, PlayState},
    },
};

use crate::recorder::path;

/// The plots of a recording: figures with one first part of their path and one unit share an axis.
#[derive(Debug, Clone, Default)]
pub(crate) struct Plots {
    titles: BTreeMap<String, String>,
    /// Area, unit, paths.
    seen: BTreeMap<(String, String), BTreeSet<String>>,
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

    /// Sends the layout with the recording.
    pub fn send(&self, recording: &rerun::RecordingStream) -> Result<(), rerun::RecordingStreamError> {
        let scene = Spatial3DView::new("Scene").with_origin(EntityPath::from("world"));
        let mut plots: Vec<ContainerLike> =
            self.seen.iter().map(|((area, unit), paths)| self.view(area, unit, paths).into()).collect();
        // Text wants the width: it goes under the scene.
        let left: ContainerLike = if self.log {
            let log = TextLogView::new("Log").with_origin(path("log"));
            Vertical::new([scene.into(), log.into()]).with_row_shares([4.0, 1.0]).into()
        } else {
            scene.into()
        };
        let root: ContainerLike = match plots.len() {
            0 => Horizontal::new([left]).into(),
            1..=4 => {
                Horizontal::new([left, Vertical::new(plots).into()]).with_column_shares([3.0, 2.0]).into()
            }
            // An odd one out would leave a hole in two columns; the grid fills row by row.
            _ => {
                let plots = Grid::new(plots.drain(..)).with_grid_columns(2);
                Horizontal::new([left, plots.into()]).with_column_shares([1.0, 1.0]).into()
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
