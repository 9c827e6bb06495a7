//! The plugin: sinks, rates and the schedule of the systems.

use std::path::PathBuf;

use bevy::{
    ecs::schedule::{InternedScheduleLabel, ScheduleLabel},
    prelude::*,
};
use pliant_body::{BodyStepTimes, PliantSystems};
use thiserror::Error;

use crate::{
    RerunScalars,
    blueprint::Plots,
    collect,
    worker::{Target, Worker},
};

/// Records what Pliant does. Add this plugin after `PliantBodyPlugin`.
pub struct RerunPlugin {
    application: String,
    file: Option<PathBuf>,
    file_limit: u64,
    folder_budget: u64,
    viewer: Option<u16>,
    spawn: bool,
    rates: RerunRecording,
    queue: usize,
    schedule: InternedScheduleLabel,
    titles: Vec<(String, String)>,
}

impl RerunPlugin {
    /// Default port of a viewer.
    pub const VIEWER_PORT: u16 = rerun::DEFAULT_SERVER_PORT;

    /// Default size at which the recording in a file ends, bytes: 16 GiB.
    pub const FILE_LIMIT: u64 = 16 << 30;

    /// Default of the bytes that all recordings in a folder may have together: 32 GiB.
    pub const FOLDER_BUDGET: u64 = 32 << 30;

    /// Records to the file `path` (`.rrd`) and overwrites it.
    ///
    /// If `path` is an existing folder or ends with a separator, each run records to a new file in
    /// that folder, which is created if needed. When its recordings have more bytes together than
    /// [`with_folder_budget`](Self::with_folder_budget), the oldest finished ones are removed
    /// ([`RerunStats::removed`]), and if there are none, the recording ends. Only files that this
    /// plugin has written are removed, told by their names and first bytes: a recording that is
    /// renamed stays.
    pub fn file(path: impl Into<PathBuf>) -> Self {
        Self { file: Some(path.into()), ..Self::none() }
    }

    /// Streams to the viewer on this machine. Starts a viewer if none runs and `rerun` is
    /// installed.
    pub fn viewer() -> Self {
        Self { viewer: Some(Self::VIEWER_PORT), ..Self::none() }
    }

    /// Records to `path` and streams to the viewer.
    pub fn both(path: impl Into<PathBuf>) -> Self {
        Self { viewer: Some(Self::VIEWER_PORT), ..Self::file(path) }
    }

    /// Records nothing. The plugin then adds no systems and collects nothing.
    pub fn none() -> Self {
        Self {
            application: "pliant".into(),
            file: None,
            file_limit: Self::FILE_LIMIT,
            folder_budget: Self::FOLDER_BUDGET,
            viewer: None,
            spawn: true,
            rates: RerunRecording::default(),
            queue: 256,
            schedule: FixedUpdate.intern(),
            titles: vec![
                ("displacement".into(), "Largest displacement".into()),
                ("contact".into(), "Contact".into()),
                ("device".into(), "Devices".into()),
                ("net".into(), "Network".into()),
                ("stress".into(), "Largest stress".into()),
                ("energy".into(), "Energy".into()),
                ("time".into(), "Time a tick".into()),
                ("frame".into(), "Time a frame".into()),
                ("step".into(), "Time of a step".into()),
                ("bodies".into(), "Bodies that are awake".into()),
            ],
        }
    }

    /// Sets the schedule of the collection, which must be the schedule of the bodies. Default:
    /// `FixedUpdate`.
    #[must_use]
    pub fn in_schedule(mut self, schedule: impl ScheduleLabel) -> Self {
        self.schedule = schedule.intern();
        self
    }

    /// Sets the name under which viewers list the recording. Default: `"pliant"`.
    #[must_use]
    pub fn with_application(mut self, name: impl Into<String>) -> Self {
        self.application = name.into();
        self
    }

    /// Sets the viewer's port. Default: [`VIEWER_PORT`](Self::VIEWER_PORT).
    #[must_use]
    pub fn with_viewer_port(mut self, port: u16) -> Self {
        self.viewer = self.viewer.map(|_| port);
        self
    }

    /// Sets the size at which the recording in a file ends, bytes. The app goes on without it.
    /// Default: [`FILE_LIMIT`](Self::FILE_LIMIT).
    #[must_use]
    pub fn with_file_limit(mut self, bytes: u64) -> Self {
        self.file_limit = bytes;
        self
    }

    /// Sets the bytes that all recordings in a folder may have together, if [`file`](Self::file)
    /// names a folder. Default: [`FOLDER_BUDGET`](Self::FOLDER_BUDGET).
    #[must_use]
    pub fn with_folder_budget(mut self, bytes: u64) -> Self {
        self.folder_budget = bytes;
        self
    }

    /// Sets whether to start a viewer if none runs. Default: `true`.
    #[must_use]
    pub fn with_spawn(mut self, spawn: bool) -> Self {
        self.spawn = spawn;
        self
    }

    /// Sets how often shapes are drawn, Hz of simulated time ([`RerunRecording::shapes_hz`]).
    ///
    /// Zero or less draws none. A body of 3,500 vertices takes about 100 kB per drawing before
    /// compression. Default: `20.0`.
    #[must_use]
    pub fn with_shapes_hz(mut self, hz: f64) -> Self {
        self.rates.shapes_hz = hz;
        self
    }

    /// Sets all rates and the color of surfaces. Default: [`RerunRecording::default`].
    #[must_use]
    pub fn with_rates(mut self, rates: RerunRecording) -> Self {
        self.rates = rates;
        self
    }

    /// Sets the quantity that colors a surface. Default: [`RerunColor::Displacement`].
    #[must_use]
    pub fn with_color(mut self, color: RerunColor) -> Self {
        self.rates.color = color;
        self
    }

    /// Sets how many ticks may wait for a sink before ticks are dropped. Default: `256`.
    #[must_use]
    pub fn with_queue(mut self, ticks: usize) -> Self {
        self.queue = ticks;
        self
    }

    /// Sets the title of the plot of the metrics under `area/`.
    #[must_use]
    pub fn with_title(mut self, area: impl Into<String>, title: impl Into<String>) -> Self {
        self.titles.push((area.into(), title.into()));
        self
    }
}

/// Selects how a body is recorded. Default: [`Surface`](Self::Surface), also without this
/// component.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub enum RerunStyle {
    /// Draws a shaded surface, colored by displacement or stress.
    #[default]
    Surface,
    /// Draws the vertices only, so that another body is visible through this one.
    Points,
    /// Does not draw the body. Its metrics are still plotted.
    Hidden,
}

/// The system set of the plugin in a tick, after [`PliantSystems::Publish`].
///
/// Systems that set [`RerunScalars`] for the same tick must run before this set.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub struct RerunSystems;

/// Settings of the recording, which may be changed at any time.
///
/// The resource exists only if a [`RerunPlugin`] has a sink.
///
/// Rates are in Hz of simulated time. A rate above that of the ticks, or an infinite rate, means
/// every tick. Zero, a negative rate or NaN means never, and nothing is gathered.
#[derive(Resource, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Resource, Default, Clone, PartialEq)]
pub struct RerunRecording {
    /// Whether to record. `false` collects nothing and leaves a gap in the recording. Default:
    /// `true`.
    pub on: bool,
    /// Rate of drawings of shapes, Hz. Default: `20.0`.
    pub shapes_hz: f64,
    /// Rate of metrics, Hz. Default: infinite, every tick.
    pub metrics_hz: f64,
    /// Rate of drawings of hands with their reactions, and of the forces where bodies touch, Hz.
    /// Default: infinite, every tick.
    pub hands_hz: f64,
    /// Rate of drawings of mode energies and spectra, Hz. Default: `4.0`.
    pub modes_hz: f64,
    /// Quantity that colors a surface. Default: [`RerunColor::Displacement`].
    pub color: RerunColor,
    /// Whether to record every period of the device loops (`device/NAME/loop/`, with the feature
    /// `haptics`) while metrics are recorded. At 1 kHz this takes about 70 kB per second and
    /// device. The recording then consumes the records that `HapticDevices::records` would return
    /// to other readers. Default: `false`.
    pub device_loops: bool,
}

impl Default for RerunRecording {
    fn default() -> Self {
        Self {
            on: true,
            shapes_hz: 20.0,
            metrics_hz: f64::INFINITY,
            hands_hz: f64::INFINITY,
            modes_hz: 4.0,
            color: RerunColor::default(),
            device_loops: false,
        }
    }
}

/// The quantity that colors a recorded surface.
#[derive(Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Default, Clone, PartialEq)]
pub enum RerunColor {
    /// The distance of each point from its rest position. The last color stands for 0.3 of the
    /// body's size.
    #[default]
    Displacement,
    /// The von Mises stress in the skin, computed in plane stress from the strain of the triangles.
    /// The last color stands for 0.2 of Young's modulus.
    Stress,
}

/// Counters of the recording.
#[derive(Resource, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Resource, Default, Clone, PartialEq)]
pub struct RerunStats {
    /// Number of collected ticks.
    pub collected: u64,
    /// Number of shapes of bodies in the collected ticks.
    pub shapes: u64,
    /// Number of ticks dropped because a sink's queue was full, summed over all sinks.
    pub dropped: u64,
    /// Number of connected sinks.
    pub sinks: usize,
    /// Number of older recordings that were removed from the folder of this one, because all
    /// together had more bytes than [`RerunPlugin::with_folder_budget`].
    pub removed: u64,
}

/// The reason why a recording could not be started.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RerunError {
    /// The file cannot be written, or its folder cannot be created.
    #[error("cannot record to {path}: {source}")]
    File {
        /// The requested path.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The application name of the recording is empty.
    #[error("a recording's application name must not be empty, got {name:?}")]
    Application {
        /// The requested name.
        name: String,
    },
    /// The thread could not be started.
    #[error("cannot start the recording thread: {0}")]
    Thread(std::io::Error),
}

impl Plugin for RerunPlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<RerunScalars>().init_resource::<RerunStats>().register_type::<RerunStyle>();
        let targets = [
            self.file.clone().map(|path| Target::File {
                path,
                limit: self.file_limit,
                budget: self.folder_budget,
            }),
            self.viewer.map(|port| Target::Viewer { port, spawn: self.spawn }),
        ];
        let plots = Plots::new(self.titles.iter().cloned());
        let mut workers = Vec::new();
        let (spare, logged) = crossbeam_channel::bounded(self.queue.max(1));
        for target in targets.into_iter().flatten() {
            match Worker::start(&self.application, &target, self.queue, plots.clone(), spare.clone()) {
                Ok(worker) => workers.push(worker),
                // A game without its recording is better than no game, so the error is only logged.
                Err(error) => error!("{error}"),
            }
        }
        if workers.is_empty() {
            return;
        }
        app.world_mut().resource_mut::<RerunStats>().sinks = workers.len();
        app.insert_resource(collect::Collector::new(workers, logged))
            .insert_resource(self.rates)
            .register_type::<RerunRecording>()
            .init_resource::<collect::Hands>()
            .init_resource::<collect::WantedData>()
            .init_resource::<BodyStepTimes>()
            .add_observer(collect::note_refusal)
            .add_systems(
                self.schedule,
                (
                    collect::decide.in_set(Deciding).run_if(collect::somebody_listens),
                    collect::collect.in_set(RerunSystems).run_if(collect::somebody_listens),
                    collect::forget.in_set(RerunSystems).run_if(not(collect::somebody_listens)),
                    crate::cost::log_elasticity
                        .in_set(Gathering)
                        .run_if(collect::wants_text)
                        .run_if(collect::somebody_listens),
                    crate::cost::plot_step_times.in_set(Gathering).run_if(collect::wants_metrics),
                ),
            )
            .configure_sets(
                self.schedule,
                (Deciding.after(PliantSystems::Publish).before(Gathering), Gathering.before(RerunSystems)),
            )
            .add_systems(Last, collect::close_at_exit.run_if(on_message::<AppExit>));
        #[cfg(feature = "net")]
        app.add_systems(
            self.schedule,
            (
                crate::net::log_users
                    .run_if(resource_exists::<pliant_net::SessionState>)
                    .run_if(collect::somebody_listens),
                crate::net::log_connection.run_if(collect::wants_text),
                crate::net::log_metrics.run_if(collect::wants_metrics),
                (crate::net::see_whose_hands, crate::net::see_other_hands).run_if(collect::wants_hands),
            )
                .in_set(Gathering),
        );
        #[cfg(feature = "contact")]
        app.add_systems(
            self.schedule,
            (
                crate::contact::see_contacts.run_if(collect::wants_hands),
                crate::contact::plot_contacts.run_if(collect::wants_metrics),
            )
                .in_set(Gathering),
        );
        #[cfg(feature = "haptics")]
        app.add_systems(
            self.schedule,
            (
                crate::haptics::log_devices.run_if(collect::wants_text),
                crate::haptics::see_devices.run_if(collect::wants_metrics),
                crate::haptics::take_samples.run_if(collect::wants_metrics),
            )
                .in_set(Gathering)
                .run_if(resource_exists::<pliant_haptics::HapticDevices>),
        );
    }
}

/// The set that decides what is recorded of a tick.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
struct Deciding;

/// The set that gathers the data, before [`RerunSystems`] makes the frame.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
struct Gathering;
