//! The plugin: scene files as assets, and apps that are built for one scene.

use std::path::PathBuf;
#[cfg(feature = "net")]
use std::sync::{Mutex, PoisonError};

use bevy::{
    asset::io::file::FileAssetReader,
    ecs::schedule::{InternedScheduleLabel, ScheduleLabel},
    prelude::*,
};

use super::needs::compiled;
use super::{SceneError, SceneFailed, SceneFile, SceneFileLoader, SceneInstance, hands, spawn};
use crate::body::PliantSystems;

/// Loads scene files as assets. Add it after [`PliantPlugins`](crate::PliantPlugins).
///
/// The `default()` plugin spawns the bodies and the hands of each [`SceneInstance`]. Baked bodies
/// need a `BakePlugin` in the app, and tools need a `HapticsPlugin`.
///
/// The default plugin does not open a `network` or a `recording`, because an app has one session
/// and one recording, which are set up when the app is built. It sends [`SceneFailed`] for each of
/// them and spawns the rest of the scene. If the game has its own session and recording, the bodies
/// of the scene appear in them; in the session, only those that are `shared`.
///
/// A scene that is [opened](Self::open) exists from the start of the app, with the session, the
/// device and the recording that it asks for.
///
/// ```no_run
/// use bevy::prelude::*;
/// use pliant::{prelude::*, scene::{SceneFile, SceneFilePlugin}};
///
/// # fn main() -> Result<(), pliant::scene::SceneError> {
/// let scene = SceneFilePlugin::open(SceneFile::read("assets/scenes/solo.ron")?)?;
/// App::new().add_plugins((DefaultPlugins, PliantPlugins::default(), scene)).run();
/// # Ok(()) }
/// ```
pub struct SceneFilePlugin {
    schedule: InternedScheduleLabel,
    role: NetworkRole,
    file: Option<SceneFile>,
    #[cfg(feature = "net")]
    network: Mutex<Option<super::network::Opened>>,
    #[cfg(feature = "net")]
    invite: Option<crate::net::Invite>,
}

/// The owner of an instance.
#[derive(Component, Debug, Default, Clone, Copy, PartialEq, Eq)]
pub(super) enum NetworkRole {
    /// A game that has its own session and recording, or none.
    #[default]
    Asset,
    /// An app that was built for the scene.
    Opened,
    /// The guest beside a host.
    Guest,
}

/// The folder of assets, for files that Bevy does not load.
#[derive(Resource, Debug, Clone)]
#[cfg_attr(
    not(any(feature = "net", feature = "bake")),
    expect(dead_code, reason = "read by guests and bakes")
)]
pub(super) struct AssetRoot(pub(super) PathBuf);

impl Default for SceneFilePlugin {
    /// Creates a plugin for scenes that the game loads; their hands move in `FixedUpdate`.
    fn default() -> Self {
        Self {
            schedule: FixedUpdate.intern(),
            role: NetworkRole::Asset,
            file: None,
            #[cfg(feature = "net")]
            network: Mutex::new(None),
            #[cfg(feature = "net")]
            invite: None,
        }
    }
}

impl SceneFilePlugin {
    /// Creates a plugin for an app that plays one scene.
    ///
    /// The session is opened at once, so that its invite is known before the app runs. The device
    /// and the recording are opened with the app.
    ///
    /// # Errors
    /// Returns [`SceneErrorKind::Feature`](super::SceneErrorKind::Feature) if the program was
    /// compiled without a feature that the scene needs, and
    /// [`SceneErrorKind::Open`](super::SceneErrorKind::Open) if the session's socket or the
    /// recording's file cannot be opened. The other files of the scene are read when the app runs,
    /// and their errors are sent as [`SceneFailed`]; [`SceneFile::check_files`] reads them
    /// beforehand.
    pub fn open(file: SceneFile) -> Result<Self, SceneError> {
        if let Some(lacking) = file.lacking(compiled).into_iter().next() {
            return Err(lacking);
        }
        // The recording is checked before the session opens, so that no invite is given for a scene
        // that is not played.
        if let Some(error) = file.recording_writable(true) {
            return Err(error);
        }
        #[cfg(feature = "net")]
        let opened =
            file.scene().network.as_ref().map(|entry| super::network::open(&file, entry)).transpose()?;
        Ok(Self {
            role: NetworkRole::Opened,
            #[cfg(feature = "net")]
            invite: opened.as_ref().and_then(|opened| opened.net.invite().cloned()),
            #[cfg(feature = "net")]
            network: Mutex::new(opened),
            file: Some(file),
            ..Self::default()
        })
    }

    /// Creates a plugin for the part of the scene that a guest beside the host has.
    #[cfg(feature = "net")]
    pub(super) fn guest(file: SceneFile) -> Self {
        Self { role: NetworkRole::Guest, file: Some(file), ..Self::default() }
    }

    /// Sets the schedule in which the bodies are stepped. Default: `FixedUpdate`.
    pub fn in_schedule(mut self, schedule: impl ScheduleLabel) -> Self {
        self.schedule = schedule.intern();
        self
    }

    /// Returns the invite of a scene that hosts or is a peer; others use it to join.
    #[cfg(feature = "net")]
    pub fn invite(&self) -> Option<&crate::net::Invite> {
        self.invite.as_ref()
    }
}

impl Plugin for SceneFilePlugin {
    fn build(&self, app: &mut App) {
        let folder = app.get_added_plugins::<AssetPlugin>();
        let folder = folder.first().map_or("assets", |plugin| plugin.file_path.as_str());
        let root = FileAssetReader::get_base_path().join(folder);
        app.insert_resource(AssetRoot(root))
            .init_asset::<SceneFile>()
            .init_asset_loader::<SceneFileLoader>()
            .add_message::<SceneFailed>()
            .add_systems(PostUpdate, (spawn::watch, spawn::make).chain().after(TransformSystems::Propagate))
            .add_observer(spawn::watch_settings)
            .add_systems(self.schedule, (spawn::begin, hands::play).chain().before(PliantSystems::Input));
        #[cfg(feature = "bake")]
        app.add_observer(spawn::watch_bakes);
        let Some(file) = &self.file else {
            self.build_devices(app);
            return;
        };
        let scene = file.scene();
        if let Some(hz) = scene.step_hz {
            app.insert_resource(Time::<Fixed>::from_hz(hz));
        }
        #[cfg(feature = "bake")]
        if scene.bodies.iter().any(|body| body.bake.is_some())
            && !app.is_plugin_added::<crate::body::BakePlugin>()
        {
            app.add_plugins(crate::body::BakePlugin::default());
        }
        #[cfg(feature = "net")]
        if let Some(opened) = self.network.lock().unwrap_or_else(PoisonError::into_inner).take() {
            super::network::build(app, opened, file);
        }
        if self.role == NetworkRole::Opened {
            #[cfg(feature = "haptics")]
            if scene.device.is_some() && !app.is_plugin_added::<crate::haptics::HapticsPlugin>() {
                app.add_plugins(crate::haptics::HapticsPlugin::new(self.schedule));
            }
        }
        #[cfg(feature = "rerun")]
        let unrecorded = self.record(app, file);
        #[cfg(not(feature = "rerun"))]
        let unrecorded: Option<SceneError> = None;
        self.build_devices(app);
        let (file, role) = (file.clone(), self.role);
        let spawn = move |mut commands: Commands, mut files: ResMut<Assets<SceneFile>>| {
            let instance = SceneInstance(files.add(file.clone()));
            let instance = commands.spawn((instance, role, Name::new("scene"))).id();
            if let Some(error) = unrecorded.clone() {
                commands.queue(move |world: &mut World| spawn::fail(world, instance, error));
            }
        };
        app.add_systems(Startup, spawn);
    }
}

#[cfg(feature = "rerun")]
impl SceneFilePlugin {
    /// Adds the recording that the scene asks for; returns the error if the recording is not made.
    fn record(&self, app: &mut App, file: &SceneFile) -> Option<SceneError> {
        use super::{SceneErrorKind, locate::Step::Field};
        use crate::rerun::{RerunPlugin, RerunRecording};
        let scene = file.scene();
        let recording = scene.recording.as_ref().filter(|_| self.role == NetworkRole::Opened)?;
        let failed = |kind, message: &str| Some(file.error(&[Field("recording")], kind, message.into()));
        if app.is_plugin_added::<RerunPlugin>() {
            return failed(
                SceneErrorKind::Feature,
                "this scene asks for a recording, and this app makes one already; the bodies are in that one",
            );
        }
        app.add_plugins(recording.plugin(&scene.title).in_schedule(self.schedule));
        // The resource exists only while a recording is active.
        if app.world().contains_resource::<RerunRecording>() {
            return None;
        }
        failed(SceneErrorKind::Open, "the recording cannot be started; the line above says why")
    }
}

impl SceneFilePlugin {
    #[cfg(feature = "haptics")]
    fn build_devices(&self, app: &mut App) {
        use crate::haptics::HapticSystems;
        app.add_observer(super::device::close).add_systems(
            self.schedule,
            super::device::play.after(spawn::begin).before(HapticSystems::Move).before(PliantSystems::Input),
        );
    }

    #[cfg(not(feature = "haptics"))]
    fn build_devices(&self, _: &mut App) {}
}
