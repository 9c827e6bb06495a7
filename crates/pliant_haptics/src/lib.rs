//! Haptic devices for Pliant: a player holds a soft body with a force feedback device and feels the
//! body's reaction. A virtual device replaces the hardware where none is present.
//!
//! The force loop runs at the rate of the device on its own thread. The loop computes the force
//! from the last [`LocalModel`] that the simulation published: a spring from the hand to the held
//! patch, in series with the compliance of the body at the patch. The force passes through the
//! [`Safety`] pipeline before the device applies the force to the hand.
//!
//! ```
//! use pliant_haptics::{HandModel, HapticLoop, LoopConfig, VirtualDevice, VirtualConfig};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let device = VirtualDevice::new(VirtualConfig::touch(), HandModel::FIRM)?;
//! let mut running = HapticLoop::start(device, LoopConfig::default())?;
//! println!("{}", running.coupling());
//! let stamp = running.report().tick.now;
//! running.publish(|model| {
//!     // In a game: `ModelWriter::write(&body, ..)` after every step.
//!     model.tick += 1;
//!     model.stamp = stamp;
//!     model.period = 0.01;
//!     model.count = 1;
//!     model.contacts[0].stiffness = [[200.0, 0.0, 0.0], [0.0, 200.0, 0.0], [0.0, 0.0, 200.0]];
//! });
//! println!("{:?} N", running.report().tick.wrench.force);
//! # Ok(())
//! # }
//! ```
//!
//! | Layer | What it is |
//! | --- | --- |
//! | [`HapticDevice`] | applies a wrench for one period and reports the hand's pose: [`VirtualDevice`], [`Positioned`], [`Replay`], `Inverse`, `OpenHaptics`, `ForceDimension` |
//! | [`LoopCore`] | computes a [`Wrench`] from a sample and a [`LocalModel`], without a clock, a thread or an allocation |
//! | [`Cycle`] | runs the core and a device period by period in real or virtual time: loss and return, calibration, buttons, counters |
//! | [`HapticLoop`] | runs a cycle on its own thread with an absolute scheduler, FIFO priority where allowed and lock-free ends for the app |
//! | `HapticsPlugin` | Bevy plugin: devices as a resource, tools and grabs as components (feature `plugin`) |
//!
//! # Features
//!
//! - `inverse` (default): the Haply Inverse3.
//! - `vendor` (default): 3D Systems and Force Dimension devices. The vendor libraries are loaded at
//!   run time.
//! - `plugin`: the Bevy plugin. No engine is compiled without this feature.
//! - `gamepad` (includes `plugin`): gamepads as position sources.
//! - `rumble` (includes `gamepad`): vibration of gamepads.
//! - `render` (includes `plugin`): draws the force as an arrow.
#![cfg_attr(docsrs, feature(doc_cfg))]
#![cfg_attr(
    test,
    allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a failed test should panic")
)]

mod control_loop;
mod device;
#[cfg(feature = "plugin")]
mod plugin;
mod safety;
#[cfg(feature = "vendor")]
mod vendor;

pub use control_loop::core::{LoopConfig, LoopCore, LoopTick, StartError};
pub use control_loop::coupling::{Coupling, CouplingConfig, CouplingLimit};
pub use control_loop::cycle::{Cycle, LoopEvent, LoopReport, LoopState, Record, Sink};
pub use control_loop::histogram::Histogram;
pub use control_loop::local_body::ModalLocal;
pub use control_loop::local_model::{
    HeldGrab, LocalModel, MAX_CONTACTS, MAX_PLANES, ModelWriter, PublishedGrab, ToolContact, TouchBall,
    TouchPlane,
};
pub use control_loop::runner::HapticLoop;
pub use control_loop::scheduler::{LoopClock, RealScheduler, VirtualScheduler};
pub use control_loop::stop::StopSwitch;
pub use control_loop::tool::ToolMap;
pub use device::find::{FindConfig, Found, OpenError, find_devices};
pub use device::hand::HandModel;
#[cfg(feature = "inverse")]
pub use device::inverse::{Inverse, InverseConfig, InverseError, Spelling};
pub use device::positioned::{Positioned, PositionedHandle};
pub use device::record::{RecordError, Recorder, Replay};
pub use device::virtual_device::{VirtualConfig, VirtualDevice, VirtualHandle};
pub use device::{
    Calibration, DeviceInfo, Fault, HapticDevice, InfoError, Pacing, Period, Sample, Scheduler, StopHandle,
    VibrationOutput, Wrench,
};
#[cfg(feature = "render")]
pub use plugin::ForceArrow;
#[cfg(feature = "gamepad")]
pub use plugin::GamepadSource;
#[cfg(feature = "plugin")]
pub use plugin::{
    DeviceId, DeviceStatus, HapticButton, HapticDevices, HapticFault, HapticNotice, HapticSystems,
    HapticTool, HapticsPlugin, HeldBy, PointerSource, PointerToolSystems, ToolGrabs, ToolGrip, ToolOffset,
    ToolPose, ToolTouch,
};
#[cfg(feature = "rumble")]
pub use plugin::{GamepadVibration, Rumble, ToolRumble};
pub use safety::{
    Allowed, Gain, Passivity, PassivityConfig, Port, Safety, SafetyConfig, SafetyError, Slew, StaleConfig,
    Thermal, ThermalConfig, VelocityCutConfig, Wanted, cap_damping, clamp_magnitude, stable_damping,
};
#[cfg(feature = "vendor")]
pub use vendor::{ForceDimension, ForceDimensionConfig, OpenHaptics, OpenHapticsConfig, VendorError};
