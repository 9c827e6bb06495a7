//! The plugin: scene files as assets, and whole scenes with what they need of an app.

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

/// Scene files as assets; add it after [`PliantPlugins`](crate::PliantPlugins).
///
/// By `default()` it only makes what a [`SceneInstance`] asks for: bodies and hands; baked bodies where the app has a `BakePlugin`, tools where it has a
/// `HapticsPlugin`. A `network` and a `recording` are not opened then, which the message [`SceneFailed`] says, and the rest of the scene is there: an app
/// has one session and one recording, from when it is built. Where the game has its own, the scene's bodies are in them, those that are `shared` in the
/// session. A scene that is [opened](Self::open) is there from the start, with the session, the device and the recording that it asks for.
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
    role: Role,
    file: Option<SceneFile>,
    #[cfg(feature = "net")]
    network: Mutex<Option<super::network::Opened>>,
    #[cfg(feature = "net")]
    invite: Option<crate::net::Invite>,
}

/// Whose an instance is.
#[derive(Component, Debug, Default, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    /// A game's, which has its own session and recording, or none.
    #[default]
    Asset,
    /// The app was built for it.
    Opened,
    /// It is what the guest beside a host has.
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
    /// Scenes are loaded by the game; their hands move in `FixedUpdate`.
    fn default() -> Self {
        Self {
            schedule: FixedUpdate.intern(),
            role: Role::Asset,
            file: None,
            #[cfg(feature = "net")]
            network: Mutex::new(None),
            #[cfg(feature = "net")]
            invite: None,
        }
    }
}

impl SceneFilePlugin {
    /// The app is for this scene: the session is opened now, so that its invite is known before the app runs; the device and the recording with
    /// the app.
    ///
    /// # Errors
    /// [`SceneErrorKind::Feature`](super::SceneErrorKind::Feature) when the program was compiled without what the scene asks for, [`SceneErrorKind::Open`](super::SceneErrorKind::Open) when the session's
    /// socket or the recording's file cannot be opened. The other files that it names are read with the app ([`SceneFailed`]);
    /// [`SceneFile::check_files`] reads them before.
    pub fn open(file: SceneFile) -> Result<Self, SceneError> {
        if let Some(lacking) = file.lacking(compiled).into_iter().next() {
            return Err(lacking);
        }
        // Before the session: nobody is invited to a scene that is not played.
        if let Some(error) = file.recording_writable(true) {
            return Err(error);
        }
        #[cfg(feature = "net")]
        let opened =
            file.scene().network.as_ref().map(|entry| super::network::open(&file, entry)).transpose()?;
        Ok(Self {
            role: Role::Opened,
            #[cfg(feature = "net")]
            invite: opened.as_ref().and_then(|opened| opened.net.invite().cloned()),
            #[cfg(feature = "net")]
            network: Mutex::new(opened),
            file: Some(file),
            ..Self::default()
        })
    }

    /// What a guest beside the host has of the scene.
    #[cfg(feature = "net")]
    pub(super) fn guest(file: SceneFile) -> Self {
        Self { role: Role::Guest, file: Some(file), ..Self::default() }
    }

    /// The schedule in which the bodies are stepped, where it is not `FixedUpdate`.
    pub fn in_schedule(mut self, schedule: impl ScheduleLabel) -> Self {
        self.schedule = schedule.intern();
        self
    }

    /// What others paste to join a scene that hosts or is a peer.
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
            .add_systems(
                PostUpdate,
                (spawn::watch, spawn::watch_settings, spawn::make).chain().after(TransformSystems::Propagate),
            )
            .add_systems(self.schedule, (spawn::begin, hands::play).chain().before(PliantSystems::Input));
        #[cfg(feature = "bake")]
        app.add_systems(PostUpdate, spawn::watch_bakes);
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
        if self.role == Role::Opened {
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
    /// Adds the recording that the scene asks for; returns what keeps it from being made.
    fn record(&self, app: &mut App, file: &SceneFile) -> Option<SceneError> {
        use super::{SceneErrorKind, locate::Step::Field};
        use crate::rerun::{RerunPlugin, RerunRecording};
        let scene = file.scene();
        let recording = scene.recording.as_ref().filter(|_| self.role == Role::Opened)?;
        let failed = |kind, message: &str| Some(file.error(&[Field("recording")], kind, message.into()));
        if app.is_plugin_added::<RerunPlugin>() {
            return failed(
                SceneErrorKind::Feature,
                "this scene asks for a recording, and this app makes one already; the bodies are in that one",
            );
        }
        app.add_plugins(recording.plugin(&scene.title).in_schedule(self.schedule));
        // There while something records.
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
