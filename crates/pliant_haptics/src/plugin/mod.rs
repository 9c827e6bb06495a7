//! The Bevy plugin: devices as a resource, tools and grabs as components, buttons and faults as
//! messages.
//!
//! ```no_run
//! use bevy::prelude::*;
//! use pliant_body::{ModalBody, PliantBodyPlugin};
//! use pliant_haptics::{HandModel, HapticDevices, HapticTool, HapticsPlugin, LoopConfig, ToolGrip, VirtualDevice, VirtualConfig};
//!
//! fn main() {
//!     App::new()
//!         .add_plugins((DefaultPlugins, PliantBodyPlugin::default(), HapticsPlugin::default()))
//!         .add_systems(Startup, setup)
//!         .run();
//! }
//!
//! fn setup(mut commands: Commands, assets: Res<AssetServer>, mut devices: ResMut<HapticDevices>) -> Result {
//!     commands.spawn(ModalBody::new(assets.load("pip.modal")));
//!     let device = devices.add(VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM)?, LoopConfig::default())?;
//!     commands.spawn((HapticTool::new(device), ToolGrip::default(), Transform::from_xyz(0.0, 1.0, 0.0)));
//!     Ok(())
//! }
//! ```

mod devices;
mod local_model;
#[cfg(feature = "rumble")]
mod rumble;
#[cfg(feature = "render")]
mod show;
mod source;
mod tool;

use bevy::{
    ecs::schedule::{InternedScheduleLabel, ScheduleLabel},
    input::InputSystems,
    picking::PickingSystems,
    prelude::*,
};
use pliant_body::PliantSystems;

pub use devices::{DeviceId, DeviceStatus, HapticButton, HapticDevices, HapticFault, HapticNotice};
#[cfg(feature = "rumble")]
pub use rumble::{GamepadVibration, Rumble, ToolRumble};
#[cfg(feature = "render")]
pub use show::ForceArrow;
#[cfg(feature = "gamepad")]
pub use source::GamepadSource;
pub use source::{PointerSource, PointerToolSystems};
pub use tool::{HapticTool, HeldBy, ToolGrabs, ToolGrip, ToolOffset, ToolPose, ToolTouch};

/// The steps of the plugin in a tick, around [`PliantSystems`].
#[derive(SystemSet, Debug, Clone, PartialEq, Eq, Hash)]
pub enum HapticSystems {
    /// Before [`PliantSystems::Input`]: tools take the poses of their devices, and grabs take their
    /// targets from the tools.
    Move,
    /// After [`PliantSystems::Publish`]: each device's loop gets the local model update.
    LocalModel,
}

/// Adds haptic devices, their tools and grabs. The plugin needs `PliantBodyPlugin`. On a body that
/// is stepped elsewhere (a session over a network), the force on the hand comes from what the
/// session publishes.
pub struct HapticsPlugin {
    schedule: InternedScheduleLabel,
}

impl HapticsPlugin {
    /// Creates the plugin for the schedule that steps the bodies.
    pub fn new(schedule: impl ScheduleLabel) -> Self {
        Self { schedule: schedule.intern() }
    }
}

impl Default for HapticsPlugin {
    /// Creates the plugin for `FixedUpdate`.
    fn default() -> Self {
        Self::new(FixedUpdate)
    }
}

impl Plugin for HapticsPlugin {
    fn build(&self, app: &mut App) {
        app.init_resource::<HapticDevices>()
            .init_resource::<source::PointerButtons>()
            .register_type::<DeviceId>()
            .register_type::<HapticTool>()
            .register_type::<ToolPose>()
            .register_type::<ToolGrip>()
            .register_type::<ToolTouch>()
            .register_type::<ToolOffset>()
            .register_type::<HeldBy>()
            .register_type::<ToolGrabs>()
            .register_type::<HapticButton>()
            .register_type::<HapticFault>()
            .register_type::<HapticNotice>()
            .add_message::<HapticButton>()
            .add_message::<HapticFault>()
            .add_message::<HapticNotice>()
            .configure_sets(self.schedule, HapticSystems::Move.before(PliantSystems::Input))
            .configure_sets(self.schedule, HapticSystems::LocalModel.after(PliantSystems::Publish))
            // Buttons, faults and states are read every frame, even while the game is paused.
            .add_systems(
                PreUpdate,
                (
                    devices::read,
                    tool::place,
                    tool::grip,
                    tool::release_removed,
                    source::press.in_set(PointerToolSystems::Press),
                    source::point.in_set(PointerToolSystems::Move),
                )
                    .chain()
                    .after(InputSystems)
                    .after(PickingSystems::Backend),
            )
            .add_systems(
                self.schedule,
                (tool::update_tools, tool::lead_probes).chain().in_set(HapticSystems::Move),
            )
            .add_systems(self.schedule, local_model::publish.in_set(HapticSystems::LocalModel));
        #[cfg(feature = "gamepad")]
        app.add_systems(PreUpdate, source::steer.after(tool::grip).after(InputSystems));
        #[cfg(feature = "render")]
        app.register_type::<ForceArrow>();
        #[cfg(feature = "rumble")]
        app.init_resource::<rumble::Rumble>()
            .register_type::<rumble::ToolRumble>()
            .add_message::<bevy::input::gamepad::GamepadRumbleRequest>()
            .add_systems(PostUpdate, (rumble::follow_force, rumble::send).chain());
    }

    #[cfg(feature = "render")]
    fn finish(&self, app: &mut App) {
        if app.is_plugin_added::<bevy::gizmos::GizmoPlugin>() {
            app.add_systems(Update, show::draw);
        }
    }
}
