//! Feel it: the haptic device layer of Pliant. Whoever owns a device plugs it in and feels the body; whoever owns none has a virtual one.
//!
//! The force is closed at device rate, on a thread of its own, from the simulation's last word: a spring from the hand to where the held patch is, in
//! series with what the patch gives. Between the spring and the hand stands the [`Safety`] pipeline.
//!
//! ```
//! use pliant_haptics::{Hand, HapticLoop, LoopConfig, VirtualDevice, VirtualConfig};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let device = VirtualDevice::new(VirtualConfig::touch(), Hand::FIRM)?;
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
//! | [`HapticDevice`] | takes a wrench, holds it for a period, says where the hand is: [`VirtualDevice`], [`Positioned`], [`Replay`], `Inverse`, `OpenHaptics`, `ForceDimension` |
//! | [`LoopCore`] | a sample and a [`LocalModel`] in, a [`Wrench`] out: no clock, no thread, no allocation |
//! | [`Cycle`] | the core and a device, period by period: loss and return, calibration, buttons, counters; in real or virtual time |
//! | [`HapticLoop`] | a cycle on its thread, absolute scheduler, FIFO priority where allowed; lock-free ends for the app |
//! | `HapticsPlugin` | Bevy: devices as a resource, tools and grabs as components (feature `plugin`) |
//!
//! # Features
//!
//! `inverse` (default): the Haply Inverse3. `vendor` (default): 3D Systems and Force Dimension, libraries loaded at run time. `plugin`: Bevy; without it no
//! engine is compiled. `gamepad`, on top of it: gamepads as position sources; `rumble`: gamepads that buzz; `render`: the force drawn as an arrow.
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

pub use control_loop::core::{LoopConfig, LoopCore, StartError, Tick};
pub use control_loop::coupling::{Coupling, CouplingConfig, CouplingLimit};
pub use control_loop::cycle::{Cycle, LoopEvent, LoopReport, LoopState, Record, Sink};
pub use control_loop::histogram::Histogram;
pub use control_loop::local_body::ModalLocal;
pub use control_loop::local_model::{
    Contact, HeldGrab, LocalModel, MAX_CONTACTS, ModelWriter, PublishedGrab,
};
pub use control_loop::runner::{HapticLoop, StopSwitch};
pub use control_loop::scheduler::{LoopClock, RealScheduler, VirtualScheduler};
pub use control_loop::tool::ToolMap;
pub use device::find::{FindConfig, Found, OpenError, find_devices};
pub use device::hand::Hand;
#[cfg(feature = "inverse")]
pub use device::inverse::{Inverse, InverseConfig, InverseError, Spelling};
pub use device::positioned::{Positioned, PositionedHandle};
pub use device::record::{RecordError, Recorder, Replay};
pub use device::virtual_device::{VirtualConfig, VirtualDevice, VirtualHandle};
pub use device::{
    Calibration, DeviceInfo, Fault, HapticDevice, InfoError, Pacing, Period, Sample, Scheduler,
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
    ToolPose,
};
#[cfg(feature = "rumble")]
pub use plugin::{GamepadVibration, Rumble, ToolRumble};
pub use safety::{
    Allowed, Gain, Passivity, PassivityConfig, Port, Safety, SafetyConfig, Slew, StaleConfig, Thermal,
    ThermalConfig, VelocityCutConfig, Wanted, cap_damping, clamp_magnitude, stable_damping,
};
#[cfg(feature = "vendor")]
pub use vendor::{ForceDimension, ForceDimensionConfig, OpenHaptics, OpenHapticsConfig, VendorError};
