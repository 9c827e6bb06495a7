//! The plugin: sinks, rates, and the systems' place in the app.

use std::path::PathBuf;

use bevy::{
    ecs::schedule::{InternedScheduleLabel, ScheduleLabel},
    prelude::*,
};
use pliant_body::PliantSystems;
use thiserror::Error;

use crate::{
    RerunScalars,
    blueprint::Plots,
    collect,
    worker::{Target, Worker},
};

/// Records what Pliant does. Add it after `PliantBodyPlugin`.
pub struct RerunPlugin {
    application: String,
    file: Option<PathBuf>,
    viewer: Option<u16>,
    spawn: bool,
    rates: RerunRecording,
    queue: usize,
    schedule: InternedScheduleLabel,
    titles: Vec<(String, String)>,
}

impl RerunPlugin {
    /// The port that a viewer listens on by default.
    pub const VIEWER_PORT: u16 = rerun::DEFAULT_SERVER_PORT;

    /// Records to `path` (`.rrd`), anew.
    pub fn file(path: impl Into<PathBuf>) -> Self {
        Self { file: Some(path.into()), ..Self::none() }
    }

    /// Streams to the viewer on this machine, started if none runs and `rerun` is installed.
    pub fn viewer() -> Self {
        Self { viewer: Some(Self::VIEWER_PORT), ..Self::none() }
    }

    /// Records to `path` and streams to the viewer.
    pub fn both(path: impl Into<PathBuf>) -> Self {
        Self { viewer: Some(Self::VIEWER_PORT), ..Self::file(path) }
    }

    /// Records nothing: the plugin then adds no system, and nothing is collected.
    pub fn none() -> Self {
        Self {
            application: "pliant".into(),
            file: None,
            viewer: None,
            spawn: true,
            rates: RerunRecording::default(),
            queue: 256,
            schedule: FixedUpdate.intern(),
            titles: vec![
                ("displacement".into(), "Largest displacement".into()),
                ("device".into(), "Devices".into()),
                ("net".into(), "Network".into()),
                ("stress".into(), "Largest stress".into()),
                ("energy".into(), "Energy".into()),
                ("time".into(), "Time a tick".into()),
                ("frame".into(), "Time a frame".into()),
                ("bodies".into(), "Bodies that are awake".into()),
            ],
        }
    }

    /// Collects in `schedule`, which has to be that of the bodies. Default: `FixedUpdate`.
    #[must_use]
    pub fn in_schedule(mut self, schedule: impl ScheduleLabel) -> Self {
        self.schedule = schedule.intern();
        self
    }

    /// The name under which viewers list the recording. Default: `"pliant"`.
    #[must_use]
    pub fn with_application(mut self, name: impl Into<String>) -> Self {
        self.application = name.into();
        self
    }

    /// The viewer's port. Default: [`VIEWER_PORT`](Self::VIEWER_PORT).
    #[must_use]
    pub fn with_viewer_port(mut self, port: u16) -> Self {
        self.viewer = self.viewer.map(|_| port);
        self
    }

    /// Whether to start a viewer where none runs. Default: `true`.
    #[must_use]
    pub fn with_spawn(mut self, spawn: bool) -> Self {
        self.spawn = spawn;
        self
    }

    /// How often shapes are drawn, Hz of simulated time ([`RerunRecording::shapes_hz`]). Zero or less draws none. Default: `20.0`. A body of 3,500 vertices takes about 100 kB a drawing before compression.
    #[must_use]
    pub fn with_shapes_hz(mut self, hz: f64) -> Self {
        self.rates.shapes_hz = hz;
        self
    }

    /// Every rate, and what the color of a surface says. Default: [`RerunRecording::default`].
    #[must_use]
    pub fn with_rates(mut self, rates: RerunRecording) -> Self {
        self.rates = rates;
        self
    }

    /// What the color of a surface says. Default: [`RerunColor::Displacement`].
    #[must_use]
    pub fn with_color(mut self, color: RerunColor) -> Self {
        self.rates.color = color;
        self
    }

    /// How many ticks may wait for a sink before one is dropped. Default: `256`.
    #[must_use]
    pub fn with_queue(mut self, ticks: usize) -> Self {
        self.queue = ticks;
        self
    }

    /// Titles the plot of the figures under `area/`.
    #[must_use]
    pub fn with_title(mut self, area: impl Into<String>, title: impl Into<String>) -> Self {
        self.titles.push((area.into(), title.into()));
        self
    }
}

/// How a body is recorded. Default: [`Surface`](Self::Surface), also without this component.
#[derive(Component, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Component, Default, Clone, PartialEq)]
pub enum RerunStyle {
    /// As a shaded surface, colored by displacement.
    #[default]
    Surface,
    /// As its vertices only: a ghost through which another body is seen.
    Points,
    /// Not drawn; its figures are plotted.
    Hidden,
}

/// The plugin's place in a tick: after [`PliantSystems::Publish`]. Whoever sets [`RerunScalars`] in the same tick does so before.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub struct RerunSystems;

/// Whether a recording goes on, and how finely; may be changed at any time. There only while a [`RerunPlugin`] has a sink.
///
/// Rates are in Hz of simulated time: one above that of the ticks (also an infinite one) is every tick, zero or less (or NaN) is none, and nothing is gathered for it.
#[derive(Resource, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Resource, Default, Clone, PartialEq)]
pub struct RerunRecording {
    /// Off: nothing is collected, and the recording has a gap. Default: `true`.
    pub on: bool,
    /// How often shapes are drawn. Default: `20.0`.
    pub shapes_hz: f64,
    /// How often figures are recorded. Default: infinite, every tick.
    pub metrics_hz: f64,
    /// How often hands are drawn, with their reactions. Default: infinite, every tick.
    pub hands_hz: f64,
    /// How often the energies of the modes and the spectrum are drawn. Default: `4.0`.
    pub modes_hz: f64,
    /// What the color of a surface says. Default: [`RerunColor::Displacement`].
    pub color: RerunColor,
    /// Whether every period of the devices' loops is recorded (`device/NAME/loop/`, with the feature `haptics`) while figures are: at 1 kHz about
    /// 70 kB a second and device. The recording then takes what `HapticDevices::records` would give to others. Default: `false`.
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

/// What the color of a recorded surface says.
#[derive(Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Default, Clone, PartialEq)]
pub enum RerunColor {
    /// How far each point is from where it rests: the last color at 0.3 of the body's size.
    #[default]
    Displacement,
    /// Von Mises stress in the skin, in plane stress from how the triangles are stretched: the last color at 0.2 of Young's modulus.
    Stress,
}

/// What became of the frames.
#[derive(Resource, Reflect, Debug, Default, Clone, Copy, PartialEq, Eq)]
#[reflect(Resource, Default, Clone, PartialEq)]
pub struct RerunStats {
    /// Ticks collected.
    pub collected: u64,
    /// Shapes of bodies in them.
    pub shapes: u64,
    /// Ticks that a sink had no room for, summed over sinks.
    pub dropped: u64,
    /// Sinks that still listen.
    pub sinks: usize,
}

/// Why a recording could not be started.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RerunError {
    /// The file cannot be written.
    #[error("cannot record to {path}: {source}")]
    File {
        /// The path that was asked for.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The name of the recording is not one.
    #[error("a recording's application name must not be empty, got {name:?}")]
    Application {
        /// The name that was asked for.
        name: String,
    },
    /// No thread.
    #[error("cannot start the recording thread: {0}")]
    Thread(std::io::Error),
}

impl Plugin for RerunPlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<RerunScalars>().init_resource::<RerunStats>().register_type::<RerunStyle>();
        let targets = [
            self.file.clone().map(Target::File),
            self.viewer.map(|port| Target::Viewer { port, spawn: self.spawn }),
        ];
        let plots = Plots::new(self.titles.iter().cloned());
        let mut workers = Vec::new();
        let (spare, logged) = crossbeam_channel::bounded(self.queue.max(1));
        for target in targets.into_iter().flatten() {
            match Worker::start(&self.application, &target, self.queue, plots.clone(), spare.clone()) {
                Ok(worker) => workers.push(worker),
                // A game without its recording is better than no game.
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
            .init_resource::<collect::Wanted>()
            .add_systems(
                self.schedule,
                (
                    collect::decide.in_set(Deciding).run_if(collect::somebody_listens),
                    collect::collect.in_set(RerunSystems).run_if(collect::somebody_listens),
                    collect::forget.in_set(RerunSystems).run_if(not(collect::somebody_listens)),
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
                crate::net::say_who_comes_and_goes
                    .run_if(
                        resource_exists::<Messages<pliant_net::UserJoined>>
                            .and_then(resource_exists::<Messages<pliant_net::UserLeft>>)
                            .and_then(resource_exists::<Messages<pliant_net::GrabRefused>>)
                            .and_then(resource_exists::<Messages<pliant_net::SessionClosed>>),
                    )
                    .run_if(collect::somebody_listens),
                crate::net::say_how_it_stands.run_if(collect::wants_text),
                crate::net::log_metrics.run_if(collect::wants_metrics),
                (crate::net::see_whose_hands, crate::net::see_other_hands).run_if(collect::wants_hands),
            )
                .in_set(Gathering),
        );
        #[cfg(feature = "haptics")]
        app.add_systems(
            self.schedule,
            (
                crate::haptics::say_how_they_are.run_if(collect::wants_text),
                crate::haptics::see_devices.run_if(collect::wants_metrics),
                crate::haptics::take_samples.run_if(collect::wants_metrics),
            )
                .in_set(Gathering)
                .run_if(resource_exists::<pliant_haptics::HapticDevices>),
        );
    }
}

/// What is wanted of a tick is decided,
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
struct Deciding;

/// and gathered by those who have it, before the frame is made in [`RerunSystems`].
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
struct Gathering;
