//! The stage that the examples share.
//!
//! The stage provides a window or none, light, a floor, a camera, keys and metrics on the screen,
//! and a command line. An example adds [`Stage`] where a game adds `DefaultPlugins`.
#![allow(dead_code, unused_imports, reason = "each example uses the part of the stage that it needs")]

mod hands;
mod options;
mod run;
mod text;
mod view;
mod window;

use std::time::Duration;

use bevy::{
    app::{PluginGroupBuilder, ScheduleRunnerPlugin},
    log::{DEFAULT_FILTER, Level, LogPlugin},
    prelude::*,
    render::{RenderPlugin, settings::WgpuSettings},
    window::{ExitCondition, PresentMode, WindowResolution},
    winit::{WinitPlugin, WinitSettings},
};
use clap::Parser;

pub use hands::draw_hand;
pub use options::Options;
pub use run::{Awaited, Unattended};
pub use text::Readout;
pub use view::Look;

/// The project's assets, from the crate that owns the examples.
pub const ASSETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets");

/// A plugin group for an example, in place of `DefaultPlugins`.
///
/// With `--headless` there is no window and no renderer, and every frame advances the time by 1/60
/// s, however long it takes. With `--screenshot` the frames advance the time by the same step, so
/// that slow and fast renderers picture the same moment.
#[derive(Clone, Debug)]
pub struct Stage {
    title: &'static str,
    keys: Vec<&'static str>,
    look: Option<Look>,
    floor: bool,
    real_time: bool,
    picture_at: f64,
    options: Options,
}

impl Stage {
    /// Creates a stage for an example without options of its own.
    pub fn new(title: &'static str) -> Self {
        Self::with(title, Options::parse())
    }

    /// Creates a stage for an example that has flattened the stage's [`Options`] into its own.
    pub fn with(title: &'static str, mut options: Options) -> Self {
        if let Err(error) = options.check_window() {
            eprintln!("{title}: {error}");
            std::process::exit(2);
        }
        Self {
            title,
            keys: Vec::new(),
            look: Some(Look::default()),
            floor: true,
            real_time: false,
            picture_at: 2.0,
            options,
        }
    }

    /// Adds a key to the line of keys, such as `"left mouse: pull"`, before those of the stage.
    pub fn key(mut self, key: &'static str) -> Self {
        self.keys.push(key);
        self
    }

    /// Sets the position of the camera. Default: fits a body of a third of a meter on the floor.
    pub fn look(mut self, look: Look) -> Self {
        self.look = Some(look);
        self
    }

    /// Removes the floor.
    pub fn floating(mut self) -> Self {
        self.floor = false;
        self
    }

    /// Removes the camera, the light and the floor; the example has its own.
    pub fn bare(mut self) -> Self {
        self.look = None;
        self
    }

    /// Uses the wall clock, also without a window, for work on other threads such as a device loop.
    pub fn real_time(mut self) -> Self {
        self.real_time = true;
        self
    }

    /// Sets the default moment of `--screenshot`, s after the bodies exist. Default: 2.
    pub fn picture_at(mut self, seconds: f64) -> Self {
        self.picture_at = seconds;
        self
    }
}

impl PluginGroup for Stage {
    fn build(self) -> PluginGroupBuilder {
        let plugins = DefaultPlugins.build().set(AssetPlugin { file_path: ASSETS.into(), ..default() });
        let plugins = if self.options.headless {
            let pause = Duration::from_millis(if self.real_time { 4 } else { 0 });
            plugins
                .set(LogPlugin {
                    level: Level::WARN,
                    // These crates would warn that there is no renderer, which is intended.
                    filter: format!(
                        "{DEFAULT_FILTER},bevy_render=off,bevy_gizmos_render=off,bevy_gltf=error"
                    ),
                    ..default()
                })
                .set(WindowPlugin {
                    primary_window: None,
                    exit_condition: ExitCondition::DontExit,
                    ..default()
                })
                .set(RenderPlugin {
                    render_creation: WgpuSettings { backends: None, ..default() }.into(),
                    ..default()
                })
                .disable::<WinitPlugin>()
                .add(ScheduleRunnerPlugin::run_loop(pause))
        } else {
            plugins
                .set(WindowPlugin {
                    primary_window: Some(Window {
                        title: format!("Pliant: {}", self.title),
                        resolution: resolution(&self.options),
                        present_mode: PresentMode::AutoVsync,
                        ..default()
                    }),
                    ..default()
                })
                // In a picture, no object may be missing because its shader is still being
                // compiled.
                .set(RenderPlugin {
                    synchronous_pipeline_compilation: self.options.screenshot.is_some(),
                    ..default()
                })
        };
        plugins.add(StagePlugin(self))
    }
}

/// Returns the size of the window in pixels, with the scale factor of the options.
pub fn resolution(options: &Options) -> WindowResolution {
    let resolution = WindowResolution::new(options.size.0, options.size.1);
    match options.scale {
        Some(scale) if scale.is_finite() && scale > 0.0 => resolution.with_scale_factor_override(scale),
        _ => resolution,
    }
}

/// Light, floor, camera and text for a window without a [`Stage`], such as an app with its own
/// clock.
pub struct Setting {
    /// Title above the [`Readout`].
    pub title: String,
    /// Keys shown below, with those of the camera and Esc.
    pub keys: Vec<&'static str>,
    /// Position of the camera; `None`: no camera, light or floor.
    pub look: Option<Look>,
    pub floor: bool,
}

impl Plugin for Setting {
    fn build(&self, app: &mut App) {
        text::build(app, &self.title, &self.keys, self.look.is_some());
        #[cfg(feature = "panel")]
        app.add_systems(
            PreUpdate,
            keep_typed_from_scene
                .run_if(resource_exists::<pliant::panel::Panel>.and_then(pliant::panel::wants_keyboard))
                .in_set(SceneKeys)
                .after(bevy::input::InputSystems),
        );
        if let Some(look) = self.look {
            view::build(app, look, self.floor);
        }
    }
}

/// The systems in `PreUpdate` that remove keys typed into the panel from `ButtonInput<KeyCode>`.
///
/// The panel's own key stays. A system that must receive every key runs before this set.
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub struct SceneKeys;

#[cfg(feature = "panel")]
fn keep_typed_from_scene(mut keys: ResMut<ButtonInput<KeyCode>>, panel: Res<pliant::panel::Panel>) {
    let typed: Vec<KeyCode> = keys.get_pressed().copied().filter(|key| *key != panel.key).collect();
    for key in typed {
        keys.release(key);
        keys.clear_just_pressed(key);
        keys.clear_just_released(key);
    }
}

/// Run condition: the panel does not use the pointer.
#[cfg(feature = "panel")]
fn scene_has_pointer(panel: Option<Res<pliant::panel::bevy_egui::input::EguiWantsInput>>) -> bool {
    !pliant::panel::wants_pointer(panel)
}

#[cfg(not(feature = "panel"))]
fn scene_has_pointer() -> bool {
    true
}

struct StagePlugin(Stage);

impl Plugin for StagePlugin {
    fn build(&self, app: &mut App) {
        let stage = &self.0;
        if !stage.options.headless {
            // The scene continues while the window is not in focus.
            app.insert_resource(WinitSettings::continuous());
            #[cfg(feature = "panel")]
            app.add_plugins(stage.options.panel());
            let panel: &[&str] = if cfg!(feature = "panel") { &["F1: panel"] } else { &[] };
            let keys = [stage.keys.as_slice(), &["Space: pause", "full stop: one step"], panel].concat();
            app.add_plugins(Setting {
                title: stage.title.into(),
                keys,
                look: stage.look,
                floor: stage.floor,
            });
        }
        app.init_resource::<Readout>();
        run::build(app, &stage.options, stage.real_time, stage.picture_at);
    }
}
