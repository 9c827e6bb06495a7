//! The plugin: gathers published data, shows it, and applies the knobs.

mod scene;

#[cfg(feature = "haptics")]
mod devices;
#[cfg(feature = "net")]
mod emulator;
#[cfg(feature = "net")]
mod hands;
#[cfg(feature = "net")]
mod session;

use bevy::prelude::*;
use bevy_egui::{EguiContexts, EguiPlugin, EguiPrimaryContextPass, egui, input::EguiWantsInput};
use pliant_body::BodyStepTimes;

use crate::recording::{self, RecordingView};

/// Shows the panel as a window over the scene. Adds [`EguiPlugin`] if it is missing.
#[derive(Debug, Clone, Copy)]
pub struct PanelPlugin {
    /// Key that opens and closes the panel. Default: `F1`.
    pub key: KeyCode,
    /// Whether the panel is open from the start. Default: `true`.
    pub open: bool,
    /// The only section that is unfolded at first. Default: `None`, all sections.
    pub only: Option<PanelSection>,
}

/// A section of the panel.
#[derive(Reflect, Debug, Default, Clone, Copy, PartialEq, Eq, Hash)]
#[reflect(Default, Clone, PartialEq)]
pub enum PanelSection {
    /// Pause, single steps, speed and step time.
    #[default]
    Time,
    /// The bodies and the hands on them.
    Bodies,
    /// Users, network and emulator.
    Session,
    /// Haptic devices.
    Devices,
    /// The recording, see [`PanelRecording`].
    Recording,
}

impl Default for PanelPlugin {
    fn default() -> Self {
        Self { key: KeyCode::F1, open: true, only: None }
    }
}

/// The panel's own settings, which may be changed at any time.
#[derive(Resource, Reflect, Debug, Clone, Copy, PartialEq)]
#[reflect(Resource, Default, Clone, PartialEq)]
pub struct Panel {
    /// Whether the panel is open. Default: `true`.
    pub open: bool,
    /// Magnification of the panel, multiplied by the window's scale factor. Default: `1.0`.
    pub zoom: f32,
    /// Key that opens and closes the panel. Default: `F1`.
    #[reflect(ignore)]
    pub key: KeyCode,
    /// The only section that is unfolded when the panel is first shown. Default: `None`, all
    /// sections.
    pub only: Option<PanelSection>,
}

impl Default for Panel {
    fn default() -> Self {
        Self { open: true, zoom: 1.0, key: KeyCode::F1, only: None }
    }
}

/// The recording that the panel shows. Whoever records inserts it, keeps it up to date, and applies
/// the knobs that the panel changes. Without it the panel has no such section.
#[derive(Resource, Debug, Clone, PartialEq, Default, Deref, DerefMut)]
pub struct PanelRecording(pub RecordingView);

impl Plugin for PanelPlugin {
    fn build(&self, app: &mut App) {
        if !app.is_plugin_added::<EguiPlugin>() {
            app.add_plugins(EguiPlugin::default());
        }
        app.register_type::<Panel>()
            .insert_resource(Panel { open: self.open, key: self.key, only: self.only, ..default() })
            .init_resource::<scene::SceneHistories>()
            .init_resource::<BodyStepTimes>()
            .add_systems(Update, toggle.run_if(resource_exists::<ButtonInput<KeyCode>>))
            .add_systems(EguiPrimaryContextPass, draw.run_if(|panel: Res<Panel>| panel.open));
        #[cfg(feature = "haptics")]
        // Bodies behind the panel are covered by egui's picking backend. A device's pointer reads
        // the buttons themselves.
        app.init_resource::<devices::DeviceHistories>()
            .configure_sets(PreUpdate, pliant_haptics::PointerToolSystems::Press.run_if(not(wants_pointer)));
        #[cfg(feature = "net")]
        app.init_resource::<session::SessionHistories>();
    }
}

/// Run condition: the pointer is over the panel, or a part of the panel is being dragged.
///
/// Use it for the wheel and the buttons in the scene. Grabs of bodies and tools through the panel
/// are already prevented. Returns `false` without a panel.
///
/// ```
/// # use bevy::prelude::*;
/// # fn zoom() {}
/// # let mut app = App::new();
/// app.add_systems(Update, zoom.run_if(not(pliant_panel::wants_pointer)));
/// ```
pub fn wants_pointer(wants: Option<Res<EguiWantsInput>>) -> bool {
    wants.is_some_and(|wants| wants.wants_any_pointer_input())
}

/// Run condition: a part of the panel has the keyboard focus, for example a number field.
///
/// Use it for the keys of the scene. Returns `false` without a panel.
pub fn wants_keyboard(wants: Option<Res<EguiWantsInput>>) -> bool {
    wants.is_some_and(|wants| wants.wants_any_keyboard_input())
}

fn toggle(keys: Res<ButtonInput<KeyCode>>, mut panel: ResMut<Panel>) {
    if keys.just_pressed(panel.key) {
        panel.open = !panel.open;
    }
}

fn draw(
    mut contexts: EguiContexts,
    panel: Res<Panel>,
    mut scene: scene::SceneParam,
    #[cfg(feature = "net")] mut session: session::Session,
    #[cfg(feature = "haptics")] mut devices: devices::Devices,
    mut recording: Option<ResMut<PanelRecording>>,
) -> Result {
    let context = contexts.ctx_mut()?.clone();
    if context.zoom_factor() != panel.zoom && panel.zoom.is_finite() {
        context.set_zoom_factor(panel.zoom.clamp(0.25, 8.0));
    }
    let screen = context.content_rect();
    let section = |ui: &mut egui::Ui, which: PanelSection, show: &mut dyn FnMut(&mut egui::Ui)| {
        let title = format!("{which:?}");
        egui::CollapsingHeader::new(egui::RichText::new(&title).strong())
            .id_salt(("pliant section", &title))
            .default_open(panel.only.is_none_or(|only| only == which))
            .show(ui, show);
    };
    egui::Window::new("Pliant")
        // The height of the window follows its content. This size only leaves room for it.
        .default_size([300.0, 4096.0])
        .constrain_to(screen.shrink(12.0))
        .default_pos([screen.right() - 330.0, screen.top() + 12.0])
        .resizable([true, false])
        .show(&context, |ui| {
            #[cfg(feature = "haptics")]
            if devices.are_there() {
                devices.show_stop(ui);
            }
            // The area is as high as its content, but not higher than the screen.
            egui::ScrollArea::vertical().auto_shrink([false, true]).max_height(screen.height() - 90.0).show(
                ui,
                |ui| {
                    ui.spacing_mut().slider_width = 150.0;
                    section(ui, PanelSection::Time, &mut |ui| scene.show_time(ui));
                    section(ui, PanelSection::Bodies, &mut |ui| scene.show_bodies(ui));
                    #[cfg(feature = "net")]
                    if session.is_there() {
                        section(ui, PanelSection::Session, &mut |ui| session.show(ui));
                    }
                    #[cfg(feature = "haptics")]
                    if devices.are_there() {
                        section(ui, PanelSection::Devices, &mut |ui| devices.show(ui));
                    }
                    if let Some(recording) = &mut recording {
                        section(ui, PanelSection::Recording, &mut |ui| recording::show(ui, recording));
                    }
                    ui.weak(format!("{:?} opens and closes", panel.key));
                },
            );
        });
    Ok(())
}
