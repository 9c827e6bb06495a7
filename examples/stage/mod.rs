//! The stage that the examples share: window or none, light, floor, a camera to look around with, keys and figures on screen, and a
//! command line. An example adds [`Stage`] where a game adds `DefaultPlugins`, and its own file shows only what it teaches.
#![allow(dead_code, unused_imports, reason = "each example uses the part of the stage that it needs")]

mod hands;
mod options;
mod run;
mod text;
mod view;

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
pub use options::{Options, display};
pub use run::{Awaited, Unattended};
pub use text::Readout;
pub use view::Look;

/// The project's assets, from the crate that owns the examples.
pub const ASSETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets");

/// What an example stands on; a plugin group in place of `DefaultPlugins`.
///
/// With `--headless` there is no window and no renderer, and every frame is a sixtieth of a second however long it takes. With
/// `--screenshot` frames are as long, so that the picture shows the same moment on a slow renderer and on a fast one.
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
    /// A stage for an example that has no options of its own.
    pub fn new(title: &'static str) -> Self {
        Self::with(title, Options::parse())
    }

    /// A stage for an example that parsed the command line itself, the stage's [`Options`] flattened into its own.
    pub fn with(title: &'static str, mut options: Options) -> Self {
        if let Err(error) = options.settle() {
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

    /// One more thing to say in the line of keys, such as `"left mouse: pull"`. Those of the stage itself follow.
    pub fn key(mut self, key: &'static str) -> Self {
        self.keys.push(key);
        self
    }

    /// Where the camera looks from. Default: a body of a third of a metre, that stands on the floor.
    pub fn look(mut self, look: Look) -> Self {
        self.look = Some(look);
        self
    }

    /// No floor.
    pub fn floating(mut self) -> Self {
        self.floor = false;
        self
    }

    /// No camera, light or floor: the example brings its own.
    pub fn bare(mut self) -> Self {
        self.look = None;
        self
    }

    /// The clock is the wall's, without a window too: for what runs on threads of its own, such as a device.
    pub fn real_time(mut self) -> Self {
        self.real_time = true;
        self
    }

    /// The moment that `--screenshot` shows when the command line names none, s from when the bodies are there. Default: 2.
    pub fn picture_at(mut self, seconds: f64) -> Self {
        self.picture_at = seconds;
        self
    }
}

impl PluginGroup for Stage {
    fn build(self) -> PluginGroupBuilder {
        let plugins = DefaultPlugins.build().set(AssetPlugin { file_path: ASSETS.into(), ..default() });
        let plugins = if self.options.headless {
            let pace = Duration::from_millis(if self.real_time { 4 } else { 0 });
            plugins
                .set(LogPlugin {
                    level: Level::WARN,
                    // They warn that there is no renderer; that is what was asked for.
                    filter: format!("{DEFAULT_FILTER},bevy_render=off,bevy_gizmos_render=off"),
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
                .add(ScheduleRunnerPlugin::run_loop(pace))
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
                // In a picture nothing may be missing because its shader is still being compiled.
                .set(RenderPlugin {
                    synchronous_pipeline_compilation: self.options.screenshot.is_some(),
                    ..default()
                })
        };
        plugins.add(StagePlugin(self))
    }
}

/// The window's pixels, however dense the screen.
pub fn resolution(options: &Options) -> WindowResolution {
    let resolution = WindowResolution::new(options.size.0, options.size.1);
    match options.scale {
        Some(scale) if scale.is_finite() && scale > 0.0 => resolution.with_scale_factor_override(scale),
        _ => resolution,
    }
}

/// Light, floor, camera and words, for a window that is not a [`Stage`]'s: that of an app which runs by its own clock.
pub struct Setting {
    /// Stands above the [`Readout`].
    pub title: String,
    /// Stand below, with those of the camera and Esc.
    pub keys: Vec<&'static str>,
    /// Where the camera looks from; `None`: no camera, light or floor.
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

/// In `PreUpdate`: what is typed into the panel is taken off `ButtonInput<KeyCode>`, but for the panel's own key. What must be heard whatever has the
/// keyboard runs before.
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

/// Run condition: the pointer is not the panel's.
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
            // The scene goes on when the window is not looked at.
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
